"""A small labeled data set of solids, rendered here in soft, even light, so that training needs no download."""

import math
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

import augment
import renderer
from augment.build import load_backgrounds
from augment.objects import SceneObject
from augment.scene import Conditions, Scene
from augment.utils import generator, progress
from renderer.camera import OrthographicCamera
from renderer.image import ImageSettings, to_bytes
from renderer.light.presets import ambient, directional
from renderer.mesh import Mesh, normalize
from renderer.rasterizer import choose
from renderer.shapes import SOLIDS, solid
from train import console
from train.cache import TensorCache, source_key
from train.checkpoint import content_hash
from train.data import DataSet, Split

CLASSES = tuple(sorted(SOLIDS))
SETTINGS = ImageSettings(samples=4)
VIEWS, BACKGROUNDS = 5, 4  # images per instance: every view on every background, each in a light of its own
CODE = source_key(*(Path(module).parent for module in (renderer.__file__, augment.__file__, __file__)))


def load_shapes(train: int, test: int, size: int, seed: int, cache: TensorCache | None = None) -> DataSet:
    """That many training and test images of every solid, in even light; whole instances (20 images) each."""
    cache, settings, splits = cache or TensorCache(), replace(SETTINGS, size=size), []
    for part, count in (("train", train), ("test", test)):
        key = content_hash([CODE, CLASSES, count, seed, part, settings])
        if (cached := cache.read(key)) is None:
            cached = {"images": _render(part, count, seed, settings)}
            cache.write(key, cached)
        console.info("%s images: %d", part, len(cached["images"]))
        splits.append(Split(cached["images"], torch.arange(len(CLASSES)).repeat_interleave(count)))
    return DataSet(CLASSES, splits[0], splits[1], rendered=True)


def even_light(back: Tensor, draws: torch.Generator) -> Tensor:
    """A lamp near the camera and bright surroundings. back: (3,), towards the camera. Coefficients (49, 3)."""
    direction = F.normalize(back + 0.5 * torch.randn(3, generator=draws), dim=0)
    tint = 1 + 0.05 * torch.randn(3, generator=draws)
    strength = 0.9 + 0.2 * torch.rand(1, generator=draws)
    return ambient(0.2 * strength * tint) + directional(direction, 0.45 * strength * tint)


def _render(part: str, per_class: int, seed: int, settings: ImageSettings) -> Tensor:
    """Images of every class, in order: uint8 (classes × per_class, 3, size, size)."""
    instances, draws, images = math.ceil(per_class / (VIEWS * BACKGROUNDS)), generator(seed, part), []
    for name in progress(CLASSES, f"{part} images"):
        meshes = (solid(name, int(torch.randint(2**31, (1,), generator=draws))) for _ in range(instances))
        images.append(torch.cat([_portraits(mesh, settings, draws) for mesh in meshes])[:per_class])
    return torch.cat(images)


def _portraits(mesh: Mesh, settings: ImageSettings, draws: torch.Generator) -> Tensor:
    """20 images of one instance: uint8 (20, 3, size, size)."""
    polar, azimuth, width = torch.rand(3, VIEWS, generator=draws, dtype=torch.float64)
    cameras = [
        OrthographicCamera(math.radians(40 + 45 * p), 2 * math.pi * a, 2 + w)
        for p, a, w in zip(polar.tolist(), azimuth.tolist(), width.tolist(), strict=True)
    ]
    backgrounds = torch.rand(BACKGROUNDS, generator=draws).tolist()
    towards = [torch.tensor(camera.axes()[2], dtype=torch.float32) for camera in cameras for _ in backgrounds]
    lights = torch.stack([even_light(back, draws) for back in towards])
    images = load_backgrounds(backgrounds, settings.size)
    scene = Scene.grid([SceneObject("", normalize(mesh))], cameras, images, lights, settings, choose("numpy"))
    return to_bytes(scene.render(Conditions(lights), torch.arange(len(scene))).flatten(0, 1))
