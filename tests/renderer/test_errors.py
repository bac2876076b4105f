"""No NaN goes into the renderer: every function that takes numbers names the tensor that holds something else."""

import math
from dataclasses import replace

import pytest
import torch

from renderer.camera import OrthographicCamera
from renderer.errors import LARGEST, InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.normals import face_normals, vertex_normals
from renderer.image import tonemap
from renderer.light.harmonics import basis, project, rotate
from renderer.settings import ImageSettings
from renderer.surface.albedo import face_albedo, surface_albedo
from renderer.surface.shading import irradiance, normals_in_sight, radiance
from renderer.transport.operators import build_operators
from renderer.visibility.fragments import build_fragments
from renderer.visibility.rasterizers import choose

MESH = Mesh.plain([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
CAMERA, SETTINGS, RASTERIZER = OrthographicCamera(0, 0, 2.0), ImageSettings(2, 2), choose("numpy")
[FRAGMENTS] = build_fragments(MESH.vertices, MESH.faces, [CAMERA], SETTINGS, RASTERIZER)
[OPERATOR] = build_operators(MESH, [CAMERA], SETTINGS, RASTERIZER)
FACES = torch.from_numpy(MESH.faces)
GOOD = {
    "vertices": torch.from_numpy(MESH.vertices),
    "light": torch.ones(49, 3),
    "albedo": surface_albedo(MESH, FRAGMENTS, "linear").contiguous(),
}


def lit(name: str, spoiled: torch.Tensor, smooth: bool = False) -> torch.Tensor:
    parts = {**GOOD, name: spoiled}
    return radiance(
        FRAGMENTS, **parts, normals=normals_in_sight(FRAGMENTS, parts["vertices"], FACES) if smooth else None
    )


def painted(corner_colors: torch.Tensor) -> Mesh:
    return replace(MESH, corner_colors=corner_colors.numpy())


FINITE = [  # the tensor's name, a good one, who takes it: positions and directions may be of any size
    ("directions", torch.ones(2, 3), lambda x: basis(x, 6)),
    ("radiance", torch.ones(4, 8, 3), lambda x: project(x, 2)),
    ("radiance", torch.ones(28, 3), lambda x: project(lambda _: x, 2, quadrature_degree=6)),
    ("coefficients", torch.ones(9, 3), lambda x: rotate(x, torch.eye(3))),
    ("rotation", torch.eye(3), lambda x: rotate(torch.ones(9, 3), x)),
    ("vertices", torch.ones(4, 3), lambda x: face_normals(x, FACES)),
    ("vertices", torch.ones(4, 3), lambda x: vertex_normals(x, FACES)),
    ("vertices", torch.ones(4, 3), lambda x: build_fragments(x.numpy(), MESH.faces, [CAMERA], SETTINGS, RASTERIZER)),
    ("vertices", GOOD["vertices"], lambda x: lit("vertices", x)),
    ("vertices", GOOD["vertices"], lambda x: lit("vertices", x, smooth=True)),
]  # fmt: skip
BOUNDED = [  # what is multiplied with each other
    ("texture", torch.ones(2, 2, 3), lambda x: surface_albedo(MESH, FRAGMENTS, "linear", [torch.ones(3, 3, 3), x])),
    ("albedo", torch.ones(2, 3), lambda x: face_albedo(x, FRAGMENTS)),
    ("corner_colors", torch.ones(2, 3, 3), lambda x: surface_albedo(painted(x), FRAGMENTS, "srgb")),
    ("light", torch.ones(9, 3), lambda x: irradiance(torch.ones(3, 2), x, x.dtype)),
    ("light", GOOD["light"], lambda x: lit("light", x)),
    ("albedo", GOOD["albedo"], lambda x: lit("albedo", x)),
    ("albedo", GOOD["albedo"], lambda x: lit("albedo", x, smooth=True)),
    ("albedo_scale", torch.ones(1), lambda x: build_operators(MESH, [CAMERA], SETTINGS, RASTERIZER, x.item())),
    ("lights", torch.ones(2, 49, 3), OPERATOR.radiance),
    ("radiance_gradient", torch.ones(2, 3, 4), OPERATOR.light_gradient),
    ("radiance", torch.ones(3, 4), lambda x: tonemap(x, torch.ones(1, 4), torch.ones(3, 1))),
    ("coverage", torch.ones(1, 4), lambda x: tonemap(torch.ones(3, 4), x, torch.ones(3, 1))),
    ("background", torch.ones(3, 1), lambda x: tonemap(torch.ones(3, 4), torch.ones(1, 4), x)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "good", "take"), FINITE + BOUNDED)
@pytest.mark.parametrize("bad", [math.nan, -math.inf])
def test_nan_and_infinity_are_refused_by_the_name_of_the_tensor(name, good, take, bad):
    good = good.clone()
    take(good)
    for at in (0, -1):
        spoiled = good.clone()
        spoiled.view(-1)[at] = bad
        with pytest.raises(InputError, match=f"^{name} holds NaN.* infinity.*: give finite values$"):
            take(spoiled)


@pytest.mark.parametrize(("name", "good", "take"), BOUNDED)
def test_magnitudes_that_would_overflow_are_refused_by_name(name, good, take):
    take(good * LARGEST * 0.99)
    with pytest.raises(InputError, match=f"^{name} holds .* magnitudes beyond 1e\\+12: give finite values$"):
        take(good * LARGEST * 1.01)
