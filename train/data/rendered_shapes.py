"""A small labeled data set of renders of generated solids in soft front lighting.

It is rendered when it is first used, so that training needs no download, and is then cached.
"""

import io
import math
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Generator, Tensor

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
from renderer.io.files import atomic_write
from renderer.light.files import ambient, directional
from renderer.mesh import normalize
from renderer.settings import ImageSettings
from renderer.solids import SOLIDS, solid
from renderer.visibility import choose
from train import console
from train.data.sets import DataSet, Split, content_hash

CLASSES = tuple(sorted(SOLIDS))
SETTINGS = ImageSettings(samples=4)
# Each generated solid is rendered once for each pair of a camera and a background.
CAMERAS = 5
BACKGROUNDS = 4


def source_key(*packages: Path) -> str:
    """Hash the source code of packages, and the versions of torch and NumPy.

    As part of the key of a cache, the hash makes cached results of other code unused.
    """
    paths = [(path, folder) for folder in packages for path in folder.rglob("*.py")]
    files = sorted((path.relative_to(of).as_posix(), path.read_bytes()) for path, of in paths)
    return content_hash([torch.__version__, np.__version__, files])


# The data set is rendered again after a change of the code that renders it.
_MODULES = (renderer.__file__, augment.__file__, __file__)
CODE = source_key(*(Path(module).parent for module in _MODULES))


def cache_folder(choice: str | None) -> Path | None:
    """Return the folder of the cache that a user chooses.

    "auto" is a folder in $XDG_CACHE_HOME or ~/.cache, and None is no cache.
    """
    if not choice:
        return None
    if choice != "auto":
        return Path(os.path.expanduser(choice))
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches, "parametric-norm-balls") if os.path.isabs(caches) else None


def load_shapes(train: int, test: int, size: int, seed: int, cache: Path | None = None) -> DataSet:
    """Render a data set with one class for each kind of solid, or read it from the folder `cache`.

    `train` and `test` are numbers of images of each class. Every 20 of them show another shape.
    """
    count = len(CLASSES) * (train + test)
    require_memory(f"{count} images of {size} pixels", 3 * size**2 * count, torch.device("cpu"))
    settings = replace(SETTINGS, size=size)
    splits = []
    for split_name, images_per_class in (("train", train), ("test", test)):
        # All that determines the images, so that other settings use another file of the cache.
        key = content_hash([CODE, CLASSES, images_per_class, seed, split_name, settings])
        images = read_cached(cache, key) if cache else None
        if images is None:
            solids_per_class = math.ceil(images_per_class / (CAMERAS * BACKGROUNDS))
            draws = generator(seed, split_name)
            of_classes = []
            for name in progress(CLASSES, f"{split_name} images"):
                of_class = [_render_solid(name, settings, draws) for _ in range(solids_per_class)]
                of_classes.append(torch.cat(of_class)[:images_per_class])
            images = torch.cat(of_classes)
            if cache:
                write_cached(cache, key, images)
        # The images are in the order of their classes.
        labels = torch.arange(len(CLASSES)).repeat_interleave(images_per_class)
        splits.append(Split(images, labels))
    return DataSet(CLASSES, splits[0], splits[1], rendered=True)


def read_cached(cache: Path, key: str) -> Tensor | None:
    """Read a tensor from a folder. None if there is no such file, or if it is damaged."""
    # zipfile compares the checksum of the array. It and NumPy raise errors of many types for a
    # damaged file.
    with suppress(Exception), open(cache / f"{key}.npz", "rb") as file, np.load(file) as archive:
        return torch.from_numpy(archive["images"])
    return None


def write_cached(cache: Path, key: str, images: Tensor) -> None:
    """Write a tensor to a folder, so that other processes never read a partly written file."""
    content = io.BytesIO()
    np.savez(content, images=images.numpy())
    try:
        cache.mkdir(parents=True, exist_ok=True)
        atomic_write(cache / f"{key}.npz", content.getvalue())
    except OSError as error:
        console.warning(f"the rendered images are not cached: {error}")


def soft_front_light(to_camera: Float[Tensor, " 3"], draws: Generator) -> Float[Tensor, "49 3"]:
    """Draw uniform ambient light plus a directional light from near the camera.

    The direction, color and strength of the light are random. `to_camera` is a unit vector; the
    spherical harmonics have linear RGB.
    """
    direction = F.normalize(to_camera + 0.5 * torch.randn(3, generator=draws), dim=0)
    tint = 1 + 0.05 * torch.randn(3, generator=draws)
    strength = 0.9 + 0.2 * torch.rand(1, generator=draws)
    return ambient(0.2 * strength * tint) + directional(direction, 0.45 * strength * tint)


def _render_solid(name: str, settings: ImageSettings, draws: Generator) -> UInt8[Tensor, "_ 3 S S"]:
    """Render a random solid in another light for each pair of random camera and background."""
    mesh = solid(name, int(torch.randint(2**31, (1,), generator=draws)))
    # Three random numbers in [0, 1] for each camera.
    numbers = torch.rand(3, CAMERAS, generator=draws, dtype=torch.float64).T.tolist()
    cameras = [
        OrthographicCamera(40 + 45 * polar, 360 * azimuth, 2 + width)
        for polar, azimuth, width in numbers
    ]
    grays = torch.rand(BACKGROUNDS, generator=draws).tolist()
    sides = [torch.tensor(camera.axes()[2], dtype=torch.float32) for camera in cameras]
    # Each pair of camera and background has a light of its own, from the side of the camera.
    lights = [soft_front_light(to_camera, draws) for to_camera in sides for _ in grays]
    shown = ([SceneObject("", normalize(mesh))], cameras, load_backgrounds(grays, settings.size))
    scene = Scene.grid(*shown, torch.stack(lights), settings, choose("numpy"))
    examples = torch.arange(len(scene))
    return to_bytes(scene.render(scene.conditions(examples), examples).flatten(0, 1))
