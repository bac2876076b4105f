import math
import re

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, mesh_of, patchwork

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.image import ImageSettings
from renderer.light.harmonics import nonzero_coefficients
from renderer.mesh import Mesh
from renderer.rasterizer import choose
from renderer.transfer import build_operators

EPS = torch.finfo(torch.float64).eps
RASTERIZER = choose("numpy")
ABOVE = OrthographicCamera(0, 0, 2.0)  # right is +y, up is -x


def square(half: float, center=(0.0, 0.0, 0.0)) -> Mesh:
    """Facing up."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Mesh.plain(corners + center, [[0, 1, 2], [0, 2, 3]])


def test_coverage_of_a_square_on_sample_borders_is_its_area_in_each_pixel():
    """Half-width 5/8 at 8 pixels of 1/4: two pixels' worth and a half on either side of the center."""
    (operator,) = build_operators(square(0.625), [ABOVE], ImageSettings(size=8, samples=4), RASTERIZER)
    along = [0, 0.5, 1, 1, 1, 1, 0.5, 0]
    coverage = torch.zeros(64).index_copy(0, operator.pixels, operator.coverage)
    np.testing.assert_array_equal(coverage.view(8, 8), np.outer(along, along))


def test_the_image_is_upright():
    """From θ = π/2 on the +x side, up is up and right is +y."""
    corners = [[0, 0.5, 0.5], [0, 1, 0.5], [0, 1, 1], [0, 0.5, 1]]
    mesh = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    (operator,) = build_operators(mesh, [OrthographicCamera(math.pi / 2, 0, 2.0)], ImageSettings(4, 2), RASTERIZER)
    assert operator.pixels.tolist() == [3]


BALL, FINE = (trimesh.creation.icosphere(subdivisions=count) for count in (1, 2))
DENTED = patchwork(FINE.vertices, FINE.faces)
LAYOUTS = {  # mesh, samples, channels of the transfer
    "one color": (mesh_of(BALL, (0.8, 0.4, 0.1)), 3, 1),
    "one sample per pixel": (DENTED, 1, 1),
    "mixed albedos": (DENTED, 3, 3),
    "empty": (square(0.1, center=(20, 0, 0)), 2, 1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_radiance_is_linear_in_the_light_with_the_gradient_of_central_differences(layout):
    """In batches of any shape; bands 3 and 5, 18 coefficients, have a gradient of exactly zero."""
    mesh, samples, channels = LAYOUTS[layout]
    settings = ImageSettings(6, samples)
    [operator] = build_operators(mesh, orbit_cameras(1, 2.2), settings, RASTERIZER, dtype=torch.float64)
    assert operator.transfer.shape == (channels, 31, len(operator.pixels)) and operator.transfer.dtype == torch.float64
    for batch in ((0,), (1,), (2, 3)):
        lights = draw(*batch, 49, 3)
        expected = [operator.radiance(light) for light in lights.flatten(0, -3)]
        found = operator.radiance(lights)
        assert found.shape == (*batch, 3, len(operator.pixels))
        for single, values in zip(expected, found.flatten(0, -3), strict=True):
            torch.testing.assert_close(values, single, rtol=0, atol=64 * EPS)

    light, step = draw(49, 3).requires_grad_(True), draw(49, 3, seed=2)
    upstream = draw(3, len(operator.pixels), seed=1)
    (gradient,) = torch.autograd.grad(operator.radiance(light), light, upstream)
    assert torch.equal(operator.light_gradient(upstream), gradient)
    # A step of any length gives the derivative, to the rounding of 31 terms of some 1.
    change = (operator.radiance(light + step) - operator.radiance(light - step)) / 2
    assert (gradient * step).sum().item() == pytest.approx((change * upstream).sum().item(), abs=1e-11)
    unlit = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
    assert unlit.sum() == 18 and not gradient[unlit].any()
    assert gradient[~unlit].all() == (len(operator.pixels) > 0)


@pytest.mark.parametrize("shape", [(36, 3), (49, 1), (49,), (2, 31, 3), (0, 3)])
def test_lights_of_another_degree_are_refused(shape):
    [operator] = build_operators(square(0.5), [ABOVE], ImageSettings(4, 1), RASTERIZER)
    with pytest.raises(InputError, match=rf"lights of shape {re.escape(str(shape))} .* degree 6"):
        operator.radiance(torch.zeros(shape))
