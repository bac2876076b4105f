"""NumPy arrays and lists are taken wherever tensors are, and give the same result."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import augment
import renderer
from augment.progress import Phases
from renderer import harmonics, skylight
from renderer.camera import Camera
from tests.tetrahedron import (
    CLASSIFIER,
    IMAGES,
    LAMP,
    LIGHT,
    MESH,
    SIZE,
    operator,
    render,
    small_scene,
)

LABELS = torch.tensor([1, 0])


def render_scene(scene: augment.Scene) -> Tensor:
    examples = torch.arange(len(scene))
    return scene.render(scene.conditions(examples), examples)


def perspective(*fields: Any) -> Tensor:
    polar, azimuth, width, right, distance = fields
    camera = renderer.PerspectiveCamera(polar, azimuth, width, right, distance=distance)
    return render(cameras=camera)


def mesh_with(**changed: Any) -> Tensor:
    return render(mesh=replace(MESH, **changed))


CALLS: dict[str, tuple[Tensor, Callable[[Any], Tensor]]] = {
    "light": (LIGHT, lambda x: render(light=x)),
    "light in double precision": (LIGHT.double(), lambda x: render(light=x).double()),
    "background image": (IMAGES[0], lambda x: render(background=x)),
    "background color": (torch.tensor([0.25, 0.5, 1.0]), lambda x: render(background=x)),
    "background": (torch.tensor(0.25), lambda x: render(background=x)),
    "vertices": (torch.from_numpy(MESH.vertices) * 0.75, lambda x: render(vertices=x)),
    "albedo": (torch.rand(4, 3), lambda x: render(albedo=x)),
    "lights": (torch.rand(1, 3), lambda x: render(lights=[(LAMP, x)], light=None)),
    "roughness": (0.25 + 0.5 * torch.rand(4), lambda x: render(gloss=renderer.Gloss(x, 0.0, 0.5))),
    "specular_factor": (torch.tensor(0.5), lambda x: render(gloss=renderer.Gloss(0.3, 0.0, x))),
    "camera": (torch.tensor([57.0, 28.5, 4.0, 0.25, 8.0]), lambda x: perspective(*x)),
    "orbit": (torch.tensor([2.0, 57.0, 28.5]), lambda x: render(cameras=orbit_of(x))),
    "operator's lights": (torch.stack([LIGHT, 2 * LIGHT]), lambda x: operator().image(x)),
    "operator's radiance": (LIGHT, lambda x: operator().radiance(x)),
    "operator's background": (IMAGES[0], lambda x: operator().image(LIGHT, x)),
    # The tetrahedron covers 13 pixels.
    "radiance_gradient": (torch.rand(3, 13), lambda x: operator().light_gradient(x)),
    "vertices of a mesh": (torch.from_numpy(MESH.vertices) / 2, lambda x: mesh_with(vertices=x)),
    "faces of a mesh": (torch.from_numpy(MESH.faces), lambda x: mesh_with(faces=x)),
    "colors of a mesh": (torch.rand(4, 3, 3), lambda x: mesh_with(corner_colors=x)),
    "a mesh": (
        torch.from_numpy(MESH.vertices),
        lambda x: render(mesh=renderer.Mesh.plain(x, MESH.faces.tolist(), torch.rand(3).tolist())),
    ),
    "directions": (torch.rand(4, 3), lambda x: harmonics.basis(x, 3)),
    "radiance": (torch.rand(8, 16, 3), lambda x: harmonics.project(x, 2)),
    "coefficients": (LIGHT, lambda x: harmonics.rotate(x, torch.eye(3))),
    "rotation": (torch.eye(3).roll(1, 0), lambda x: harmonics.rotate(LIGHT, x)),
    # Arrays and lists are converted to radians in float64, as a float64 tensor is.
    "zenith": (
        torch.tensor([15.0, 30.0], dtype=torch.float64),
        lambda x: skylight.coefficients(x, 30.0, 3.0),
    ),
    "light of a scene": (
        LIGHT,
        lambda x: render_scene(augment.build_scene([(MESH, "a")], SIZE, light=x, samples=1)),
    ),
    "lights of a scene": (LIGHT, lambda x: render_scene(small_scene().changed(lights=x))),
    "backgrounds of a scene": (
        IMAGES[:1],
        lambda x: render_scene(small_scene().changed(backgrounds=x)),
    ),
    "examples": (
        torch.tensor([1, 0]),
        lambda x: small_scene().render(small_scene().conditions(LABELS), x),
    ),
    "images": (IMAGES, CLASSIFIER),
    "labels": (
        torch.tensor([3, 1]),
        lambda x: (
            augment.AugmentationService(
                augment.AugmentationSettings(), small_scene(), x, 0, Phases()
            ).labels
        ),
    ),
}


def orbit_of(values: Any) -> list[Camera]:
    width, polar, azimuth = values
    return renderer.orbit_cameras(2, width, polar, azimuth)


@pytest.mark.parametrize("convert", [Tensor.numpy, Tensor.tolist], ids=["array", "list"])
@pytest.mark.parametrize("name", CALLS)
def test_an_array_or_a_list_gives_what_the_tensor_gives(name, convert):
    tensor, call = CALLS[name]
    torch.manual_seed(0)
    expected = call(tensor)
    torch.manual_seed(0)
    torch.testing.assert_close(call(convert(tensor)), expected, rtol=1e-6, atol=1e-7)
