"""A small mesh, its view, light, scene and classifier, by which tests call the public functions."""

from functools import cache
from typing import Any

import torch
from torch import Tensor

import augment
import renderer
from renderer.light.lamps import Lamps
from tests.helpers import bright_or_dark

SIZE = 8
VERTICES = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
FACES = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
MESH = renderer.Mesh.plain(VERTICES, FACES, color=(1.0, 0.5, 0.0))
CAMERA = renderer.OrthographicCamera(57.3, 28.6, 4.0)
LIGHT = renderer.load_light("grace")
LAMP = Lamps(((2.0, 2.0, 2.0),))
IMAGES = torch.rand(3, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
CLASSIFIER = augment.Classifier(bright_or_dark, SIZE, ("orange", "other"))


def render(**changed: Any) -> Tensor:
    given: dict[str, Any] = {"mesh": MESH, "cameras": CAMERA, "light": LIGHT, "size": SIZE}
    return renderer.render(**given | {"samples": 1} | changed)


@cache
def operator() -> renderer.TransferOperator:
    return renderer.precompute_transfer(MESH, CAMERA, SIZE, samples=1)


@cache
def small_scene() -> augment.Scene:
    return augment.build_scene([(MESH, "orange")], SIZE, views=2, light="uniform", samples=1)
