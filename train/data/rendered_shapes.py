"""A small labeled data set of renders of generated solids in soft front lighting.

It is rendered when it is first used, so that training needs no download.
"""

import math
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

import augment
import renderer
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.build import load_backgrounds
from augment.scene.objects import SceneObject
from augment.scene.scene import Scene
from renderer.camera import OrthographicCamera
from renderer.errors import require_memory
from renderer.image import to_bytes
from renderer.light.files import ambient, directional
from renderer.mesh import Mesh, normalize
from renderer.settings import ImageSettings
from renderer.solids import SOLIDS, solid
from renderer.visibility import choose
from train import console
from train.data.cache import TensorCache, content_hash, source_key
from train.data.sets import DataSet, Split

CLASSES = tuple(sorted(SOLIDS))
SETTINGS = ImageSettings(samples=4)
# Each generated solid is rendered once for each pair of a camera and a background.
CAMERAS = 5
BACKGROUNDS = 4
# Hash of the code that renders the data set. It is part of the key in the cache,
# so that the data set is rendered again after a change of the code.
_MODULES = (renderer.__file__, augment.__file__, __file__)
CODE = source_key(*(Path(module).parent for module in _MODULES))


def load_shapes(
    train: int,
    test: int,
    size: int,
    seed: int,
    cache: TensorCache | None = None,
) -> DataSet:
    """Render a data set with one class for each kind of solid, or read it from a cache.

    `train` and `test` are numbers of images of each class. Every 20 of them show another shape.
    """
    count = len(CLASSES) * (train + test)
    require_memory(f"{count} images of {size} pixels", 3 * size**2 * count, torch.device("cpu"))
    cache = cache or TensorCache()
    settings = replace(SETTINGS, size=size)
    splits = []
    for split_name, images_per_class in (("train", train), ("test", test)):
        key = content_hash([CODE, CLASSES, images_per_class, seed, split_name, settings])
        cached = cache.read(key)
        if cached is None:
            cached = {"images": _render(split_name, images_per_class, seed, settings)}
            cache.write(key, cached)
        console.debug("%s images: %d", split_name, len(cached["images"]))
        labels = torch.arange(len(CLASSES)).repeat_interleave(images_per_class)
        splits.append(Split(cached["images"], labels))
    return DataSet(CLASSES, splits[0], splits[1], rendered=True)


def soft_front_light(
    to_camera: Float[Tensor, " 3"], draws: torch.Generator
) -> Float[Tensor, "49 3"]:
    """Draw uniform ambient light plus a directional light from near the camera.

    The direction, color and strength of the light are random. `to_camera` is a unit vector; the
    spherical harmonics have linear RGB.
    """
    direction = F.normalize(to_camera + 0.5 * torch.randn(3, generator=draws), dim=0)
    tint = 1 + 0.05 * torch.randn(3, generator=draws)
    strength = 0.9 + 0.2 * torch.rand(1, generator=draws)
    return ambient(0.2 * strength * tint) + directional(direction, 0.45 * strength * tint)


def _render(
    split_name: str, images_per_class: int, seed: int, settings: ImageSettings
) -> UInt8[Tensor, "_ 3 size size"]:
    """Render the images of all classes for one split of the data set. They are sorted by class."""
    solids_per_class = math.ceil(images_per_class / (CAMERAS * BACKGROUNDS))
    draws = generator(seed, split_name)
    images = []
    for name in progress(CLASSES, f"{split_name} images"):
        images_of_class = []
        for _ in range(solids_per_class):
            mesh = solid(name, int(torch.randint(2**31, (1,), generator=draws)))
            images_of_class.append(_render_solid(mesh, settings, draws))
        images.append(torch.cat(images_of_class)[:images_per_class])
    return torch.cat(images)


def _render_solid(
    mesh: Mesh, settings: ImageSettings, draws: torch.Generator
) -> UInt8[Tensor, "_ 3 size size"]:
    """Render one solid for each pair of a random camera and a random background.

    Each image has another light.
    """
    polar, azimuth, width = torch.rand(3, CAMERAS, generator=draws, dtype=torch.float64).tolist()
    cameras = []
    for index in range(CAMERAS):
        polar_angle = 40 + 45 * polar[index]
        camera = OrthographicCamera(polar_angle, 360 * azimuth[index], 2 + width[index])
        cameras.append(camera)
    backgrounds = torch.rand(BACKGROUNDS, generator=draws).tolist()
    lights = []
    for camera in cameras:
        to_camera = torch.tensor(camera.axes()[2], dtype=torch.float32)
        lights += [soft_front_light(to_camera, draws) for _ in backgrounds]
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
