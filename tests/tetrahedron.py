"""A small mesh, its view and its light, by which tests call the public functions."""

from typing import Any

import torch
from torch import Tensor

import renderer
from renderer.light.lamps import Lamps

SIZE = 8
MESH = renderer.Mesh.plain(
    [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]],
    [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
    color=(1.0, 0.5, 0.0),
)
CAMERA = renderer.OrthographicCamera(57.3, 28.6, 4.0)
LIGHT = renderer.load_light("grace")
LAMP = Lamps(((2.0, 2.0, 2.0),))
IMAGES = torch.rand(3, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))


def render(**changed: Any) -> Tensor:
    given: dict[str, Any] = {"mesh": MESH, "cameras": CAMERA, "light": LIGHT, "size": SIZE}
    return renderer.render(**given | {"samples": 1} | changed)
