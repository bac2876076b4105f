"""A small labeled data set that the project renders itself, so that the experiment runs with nothing downloaded.

Training and test images stand in soft, even light, as stock photographs do. The held-out images, written to a
folder and scored like photographs, show other instances in hard light from one side: every class under the same
lights before the same cameras, so that the classes differ in their shape and color alone. They are renders.
"""

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

import augment
from augment.build import load_backgrounds
from augment.objects import SceneObject
from augment.scene import Conditions, Scene
from augment.utils import generator, progress
from renderer.cache import RENDERER, TensorCache, content_key, source_key
from renderer.camera import OrthographicCamera
from renderer.image import ImageSettings, to_bytes
from renderer.light.presets import ambient, directional
from renderer.mesh import Mesh, normalize
from renderer.rasterizer import choose
from renderer.shapes import SOLIDS, solid
from train import console
from train.data import DataSet, Split

CLASSES = tuple(sorted(SOLIDS))
SETTINGS = ImageSettings(samples=4)
VIEWS, BACKGROUNDS = 5, 4  # images per instance: every view on every background, each in a light of its own
HELD_OUT, HELD_OUT_PER_CLASS = "held out", 60
SOURCE = "rendered, hard light"
CODE = RENDERER + source_key(Path(augment.__file__).parent, Path(__file__).parent)

Lights = Callable[[Tensor, torch.Generator], Tensor]


def load_shapes(train: int, test: int, size: int, seed: int, cache: TensorCache | None = None) -> DataSet:
    """That many training and test images of every class, in even light; whole instances (20 images) each."""
    parts = {"train": train, "test": test}
    return DataSet(CLASSES, *(_render_split(part, count, size, seed, cache) for part, count in parts.items()))


def write_held_out(folder: Path, size: int, seed: int, cache: TensorCache | None = None) -> None:
    """Class folders of PNG images in hard light; photos.csv calls them rendered and numbers the lights."""
    split = _render_split(HELD_OUT, HELD_OUT_PER_CLASS, size, seed, cache)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "photos.csv", "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["path", "source_tag", "light"])
        pairs = zip(split.images, split.labels, strict=True)
        for number, (image, label) in enumerate(progress(pairs, "writing images", len(split))):
            path = Path(CLASSES[label]) / f"rendered_{number:04d}.png"
            (folder / path).parent.mkdir(exist_ok=True)
            Image.fromarray(image.permute(1, 2, 0).numpy()).save(folder / path)
            rows.writerow([path.as_posix(), SOURCE, number % HELD_OUT_PER_CLASS])


def even_light(back: Tensor, draws: torch.Generator) -> Tensor:
    """A lamp near the camera and bright surroundings. back: (3,), towards the camera. Coefficients (49, 3)."""
    direction = F.normalize(back + 0.5 * torch.randn(3, generator=draws), dim=0)
    tint = 1 + 0.05 * torch.randn(3, generator=draws)
    strength = 0.9 + 0.2 * torch.rand(1, generator=draws)
    return ambient(0.2 * strength * tint) + directional(direction, 0.45 * strength * tint)


def hard_light(back: Tensor, draws: torch.Generator) -> Tensor:
    """One lamp of any color from above, far to one side of the camera, in dim surroundings. (49, 3)"""
    upward = torch.tensor([0.0, 0.0, 0.5])
    direction = F.normalize(torch.randn(3, generator=draws) + upward - 0.3 * back, dim=0)
    tint = torch.tensor([1.0, 0.8, 0.6]).lerp(torch.tensor([0.6, 0.8, 1.0]), torch.rand(1, generator=draws))
    strength = 0.5 + 1.2 * torch.rand(1, generator=draws)
    return ambient(0.06 * tint) + directional(direction, strength * tint)


def _render_split(part: str, per_class: int, size: int, seed: int, cache: TensorCache | None) -> Split:
    cache, settings = cache or TensorCache(), replace(SETTINGS, size=size)
    key = content_key(CODE, CLASSES, per_class, seed, part, settings)
    cached = cache.read(key)
    if cached is None:
        cached = {"images": _render(part, per_class, seed, settings)}
        cache.write(key, cached)
    console.info("%s images: %d", part, len(cached["images"]))
    return Split(cached["images"], torch.arange(len(CLASSES)).repeat_interleave(per_class))


def _render(part: str, per_class: int, seed: int, settings: ImageSettings) -> Tensor:
    """Images of every class, in order: uint8 (classes × per_class, 3, size, size)."""
    instances = math.ceil(per_class / (VIEWS * BACKGROUNDS))
    light = hard_light if part == HELD_OUT else even_light
    draws = seeds = generator(seed, part)
    images = []
    for name in progress(CLASSES, f"{part} images"):
        if part == HELD_OUT:  # all classes under the same lights before the same cameras
            draws, seeds = generator(seed, part), generator(seed, part, name)
        meshes = (solid(name, int(torch.randint(2**31, (1,), generator=seeds))) for _ in range(instances))
        images.append(torch.cat([_portraits(mesh, light, settings, draws) for mesh in meshes])[:per_class])
    return torch.cat(images)


def _portraits(mesh: Mesh, light: Lights, settings: ImageSettings, draws: torch.Generator) -> Tensor:
    """20 images of one instance: uint8 (20, 3, size, size)."""
    polar, azimuth, width = torch.rand(3, VIEWS, generator=draws, dtype=torch.float64)
    cameras = [
        OrthographicCamera(math.radians(40 + 45 * p), 2 * math.pi * a, 2 + w)
        for p, a, w in zip(polar.tolist(), azimuth.tolist(), width.tolist(), strict=True)
    ]
    backgrounds = torch.rand(BACKGROUNDS, generator=draws).tolist()
    towards = [torch.tensor(camera.axes()[2], dtype=torch.float32) for camera in cameras for _ in backgrounds]
    lights = torch.stack([light(back, draws) for back in towards])
    images = load_backgrounds(backgrounds, settings.size)
    scene = Scene.grid([SceneObject("", normalize(mesh))], cameras, images, lights, settings, choose("numpy"))
    return to_bytes(scene.render(Conditions(lights), torch.arange(len(scene))).flatten(0, 1))
