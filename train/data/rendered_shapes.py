"""A small labeled data set of solids in soft, uniform lighting.

It is rendered when it is needed, so that training needs no download.
"""

import math
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

import augment
import renderer
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.build import load_backgrounds
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from renderer.camera import OrthographicCamera
from renderer.geometry.mesh import Mesh, normalize
from renderer.geometry.shapes import SOLIDS, solid
from renderer.image import to_bytes
from renderer.light.presets import ambient, directional
from renderer.settings import ImageSettings
from renderer.visibility.rasterizers import choose
from train import console
from train.data.cache import TensorCache, source_key
from train.data.sets import DataSet, Split
from train.system.hashing import content_hash

CLASSES = tuple(sorted(SOLIDS))
SETTINGS = ImageSettings(samples=4)
# An instance of a solid is shown from each view before each background, every time in a light of
# its own.
VIEWS = 5
BACKGROUNDS = 4
# Hash of the code that renders. It is part of the key of the cache, since other
# code may render other images.
_MODULES = (renderer.__file__, augment.__file__, __file__)
CODE = source_key(*(Path(module).parent for module in _MODULES))


def load_shapes(
    train: int,
    test: int,
    size: int,
    seed: int,
    cache: TensorCache | None = None,
) -> DataSet:
    """Render images of every solid in soft front lighting, or read them from a cache.

    Args:
        train: The number of training images of each class. An instance of a solid has 20.
        test: The number of test images of each class.
        size: The pixels per side.
        seed: The seed of shapes, views and lights.
        cache: Where the images are kept; None renders them every time.

    Returns:
        The data set.
    """
    cache = cache or TensorCache()
    settings = replace(SETTINGS, size=size)
    splits = []
    for part, count in (("train", train), ("test", test)):
        key = content_hash([CODE, CLASSES, count, seed, part, settings])
        cached = cache.read(key)
        if cached is None:
            cached = {"images": _render(part, count, seed, settings)}
            cache.write(key, cached)
        console.debug("%s images: %d", part, len(cached["images"]))
        labels = torch.arange(len(CLASSES)).repeat_interleave(count)
        splits.append(Split(cached["images"], labels))
    return DataSet(CLASSES, splits[0], splits[1], rendered=True)


def soft_front_light(back: Tensor, draws: torch.Generator) -> Tensor:
    """Draw a light: a lamp near the camera, and bright surroundings.

    Args:
        back: The direction towards the camera, shape (3,).
        draws: The random generator.

    Returns:
        The coefficients of the light, shape (49, 3).
    """
    direction = F.normalize(back + 0.5 * torch.randn(3, generator=draws), dim=0)
    tint = 1 + 0.05 * torch.randn(3, generator=draws)
    strength = 0.9 + 0.2 * torch.rand(1, generator=draws)
    return ambient(0.2 * strength * tint) + directional(direction, 0.45 * strength * tint)


def _render(part: str, per_class: int, seed: int, settings: ImageSettings) -> Tensor:
    """Render the images of every class.

    Args:
        part: "train" or "test", which decides the random draws.
        per_class: Number of images of each class.
        seed: Seed of shapes, views and lights.
        settings: Settings of the images, with their size.

    Returns:
        Images in the order of the classes, uint8, shape
        (classes · per_class, 3, size, size).
    """
    instances = math.ceil(per_class / (VIEWS * BACKGROUNDS))
    draws = generator(seed, part)
    images = []
    for name in progress(CLASSES, f"{part} images"):
        portraits = []
        for _ in range(instances):
            mesh = solid(name, int(torch.randint(2**31, (1,), generator=draws)))
            portraits.append(_portraits(mesh, settings, draws))
        images.append(torch.cat(portraits)[:per_class])
    return torch.cat(images)


def _portraits(mesh: Mesh, settings: ImageSettings, draws: torch.Generator) -> Tensor:
    """Render one instance of a solid from VIEWS views before BACKGROUNDS backgrounds.

    Args:
        mesh: Mesh of the solid.
        settings: Settings of the images.
        draws: Random generator of cameras, backgrounds and lights.

    Returns:
        Images, uint8, shape (VIEWS · BACKGROUNDS, 3, size, size).
    """
    polar, azimuth, width = torch.rand(3, VIEWS, generator=draws, dtype=torch.float64).tolist()
    cameras = []
    for view in range(VIEWS):
        polar_angle = 40 + 45 * polar[view]
        camera = OrthographicCamera(polar_angle, 360 * azimuth[view], 2 + width[view])
        cameras.append(camera)
    backgrounds = torch.rand(BACKGROUNDS, generator=draws).tolist()
    lights = []
    for camera in cameras:
        back = torch.tensor(camera.axes()[2], dtype=torch.float32)
        lights += [soft_front_light(back, draws) for _ in backgrounds]
    scene = Scene.grid(
        [SceneObject("", normalize(mesh))],
        cameras,
        load_backgrounds(backgrounds, settings.size),
        torch.stack(lights),
        settings,
        choose("numpy"),
    )
    examples = torch.arange(len(scene))
    images = scene.render(scene.conditions(examples), examples)
    return to_bytes(images.flatten(0, 1))
