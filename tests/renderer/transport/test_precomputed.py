"""Shadows that a mesh casts on itself, against closed forms and a ray caster in float64. See also test_mitsuba."""

import math
import sys
from dataclasses import replace

import hard_meshes as hard
import numpy as np
import pytest
import torch
import torch.nn.functional as F
import trimesh
from oracles import mesh_of, scipy_basis

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.light.harmonics import nonzero_coefficients
from renderer.light.presets import ambient, load_light
from renderer.rendering import precompute_transfer, render
from renderer.settings import ImageSettings
from renderer.transport import precomputed, rays
from renderer.transport.operators import TransferOperator, build_operators
from renderer.visibility.rasterizers import choose

RASTERIZER = choose("numpy")
ABOVE = OrthographicCamera(0, 0, 2.0)
FLOAT32 = torch.finfo(torch.float32).eps
QUADRATURE = 0.015  # of the brightest: what 512 directions misjudge of a shadowed pixel, root mean square


def operator_of(mesh: Mesh, camera=ABOVE, dtype=torch.float64, **settings) -> TransferOperator:
    chosen = ImageSettings(**{"size": 6, "samples": 1, "shadows": True} | settings)
    [operator] = build_operators(mesh, [camera], chosen, RASTERIZER, dtype=dtype)
    return operator


def all_rows(operator: TransferOperator) -> torch.Tensor:
    """(C, 49, P) float64."""
    transfer = (operator.transfer * operator.albedo[:, None]).double()
    return transfer.new_zeros(3, 49, transfer.shape[2]).index_copy(1, operator.nonzero, transfer)


def sky_fraction(operator: TransferOperator) -> torch.Tensor:
    """(3, P), the radiance of white pixels under a white sky, over that under an open one."""
    return operator.radiance(ambient(torch.ones(3, dtype=torch.float64))) / operator.coverage / math.pi


def dented(seed=0) -> Mesh:
    """A closed, lumpy ball: dents that see their own other side."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    depth = np.random.default_rng(seed).uniform(0.5, 1.0, (len(ball.vertices), 1))
    return Mesh.plain(ball.vertices * depth, ball.faces, np.random.default_rng(seed).uniform(0.1, 1, (len(depth), 3)))


def pit(depth: float) -> Mesh:
    """A square hole of width 1, seen from above: floor and four walls, facing inward."""
    corners = [[x, y, z] for z in (0, depth) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    sides = ((0, 1), (1, 2), (2, 3), (3, 0))
    walls = [face for a, b in sides for face in ([a, 4 + a, b], [b, 4 + a, 4 + b])]
    return Mesh.plain(corners, [[0, 1, 2], [0, 2, 3], *walls])


CONVEX = {
    "a ball": mesh_of(trimesh.creation.icosphere(subdivisions=3)),
    "a cube": mesh_of(trimesh.creation.box()),
    "an open square": Mesh.plain([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]),
}


@pytest.mark.parametrize("mesh", CONVEX.values(), ids=CONVEX)
def test_a_convex_mesh_has_the_operator_of_direct_light_to_the_bit(mesh):
    camera = OrthographicCamera(57.3, 17.2, 2.2)
    direct = operator_of(mesh, camera, shadows=False)
    for bounces in (0, 2):
        shaped = operator_of(mesh, camera, bounces=bounces)
        assert torch.equal(shaped.transfer, direct.transfer)
        assert torch.equal(shaped.nonzero, nonzero_coefficients(6))


@pytest.mark.parametrize("bounces", [0, 2])
def test_a_face_blocks_the_light_from_below_it_that_smooth_normals_would_receive(bounces, monkeypatch):
    """On the octahedron |x| + |y| + |z| = 1, the smooth normal n at p is p / |p|. Its face leaves (1 + cos) / 2 of an
    even sky, by the angle between the normals, and of other light its integral over max(n·d, 0) above the face."""
    monkeypatch.setattr(rays, "DIRECTIONS", 2**14)
    hull, camera = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)])), OrthographicCamera(0, 0, 2.1)
    built = operator_of(mesh_of(hull), camera, size=8, normals="smooth", bounces=bounces)
    row, column = np.divmod(built.pixels.numpy(), 8)
    right, up, back = camera.axes()
    points = 2.1 * ((column[:, None] + 0.5) / 8 - 0.5) * right + 2.1 * (0.5 - (row[:, None] + 0.5) / 8) * up
    points += (1 - abs(points).sum(axis=1, keepdims=True)) * back
    normals, faces = points / np.linalg.norm(points, axis=1, keepdims=True), np.sign(points) / math.sqrt(3)
    even = (1 + (normals * faces).sum(axis=1)) / 2
    assert even.min() < 0.9
    np.testing.assert_allclose(sky_fraction(built)[0], even, atol=1e-3)

    heights, weights = np.polynomial.legendre.leggauss(128)
    z, azimuth = (grid.ravel() for grid in np.meshgrid(heights, np.arange(256) * math.pi / 128, indexing="ij"))
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    received = (normals @ directions.T).clip(0) * (faces @ directions.T > 0) * weights.repeat(256) * math.pi / 128
    np.testing.assert_allclose(all_rows(built)[0].T, received @ scipy_basis(directions, 6), atol=4e-3)


def test_a_mesh_with_too_many_faces_to_compare_is_found_convex_by_its_rays(monkeypatch):
    monkeypatch.setattr(rays, "COMPARISONS", 0)
    assert torch.equal(operator_of(CONVEX["a ball"]).nonzero, nonzero_coefficients(6))
    assert len(operator_of(dented()).nonzero) == 49


@pytest.mark.parametrize("bounces", [0, 1])
def test_a_mesh_outside_the_image_has_no_pixels_and_faces_without_area_do_no_harm(bounces, monkeypatch):
    monkeypatch.setattr(precomputed, "PATCHES", 2**7)
    outside = OrthographicCamera(0, 0, 1.0, right=20.0)
    assert not operator_of(dented(), outside, bounces=bounces).transfer.numel()
    thin = replace(hard.heap(), faces=np.concatenate([hard.heap().faces[:-1], [[0, 0, 1]]]))
    assert operator_of(thin, bounces=bounces).transfer.isfinite().all()


@pytest.mark.parametrize("depth", [0.25, 0.5, 1.0])
def test_the_sky_over_the_middle_of_a_pit_has_a_squares_configuration_factor(depth):
    """The configuration factor of a square parallel to a surface, over its middle (Howell's catalog, B-3)."""
    side = 0.5 / depth
    far = math.hypot(1, side)
    fraction = 4 * side / (math.pi * far) * math.atan(side / far)
    [middle] = sky_fraction(operator_of(pit(depth), OrthographicCamera(0, 0, 0.01), size=1))[0].tolist()
    assert middle == pytest.approx(fraction, abs=QUADRATURE)


@pytest.mark.parametrize(
    ("mesh", "samples", "tolerance"),
    [(dented(1), 1, 1e-6), (hard.heap(), 3, 1e-6), (pit(3.0), 3, 0.5)],
    ids=["dented", "heap", "pit"],
)
def test_a_white_mesh_in_a_white_furnace_brightens_with_bounces_to_the_sky(mesh, samples, tolerance, monkeypatch):
    """No pixel is brighter than under an open sky or darker than black: what is lost is a sum over directions, what is
    there a closed form. As a white mesh absorbs no light, it becomes as bright as the sky, in a deep pit slowly."""
    monkeypatch.setattr(precomputed, "PATCHES", 2**7)
    white = replace(mesh, corner_colors=np.ones_like(mesh.corner_colors))
    before = sky_fraction(operator_of(white, size=12, samples=samples))
    assert before.min() >= -QUADRATURE and before.min() < 0.96
    for bounces in (1, 2, 8, 100):
        fraction = sky_fraction(operator_of(white, size=12, samples=samples, bounces=bounces))
        assert (fraction >= before - 1e-9).all() and fraction.max() <= 1 + 1e-9
        before = fraction
    torch.testing.assert_close(before, torch.ones_like(before), rtol=0, atol=tolerance)


def test_missing_embree_is_reported_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(InputError, match=r"pip install embreex, or set shadows=false"):
        operator_of(dented())


@pytest.mark.parametrize("degree", [2, 6])
def test_render_shows_the_operators_shadows_also_of_moved_vertices(degree):
    cameras, light = orbit_cameras(2, 2.2), load_light("grace").double()[: (degree + 1) ** 2]
    shown = {"size": 12, "normals": "flat", "shadows": True, "rasterizer": "numpy"}
    stretched = replace(dented(), vertices=dented().vertices * [1.0, 0.5, 1.0])
    images = render(dented(), cameras, light, vertices=torch.from_numpy(stretched.vertices), **shown)
    expected = [
        operator.image(F.pad(light, (0, 0, 0, 49 - len(light))))
        for operator in precompute_transfer(stretched, cameras, **shown)
    ]
    torch.testing.assert_close(images, torch.stack(expected), rtol=0, atol=10 * FLOAT32)


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_render_differentiates_shadows_by_the_light_and_freezes_them_by_the_vertices(normals):
    light, vertices = ambient(torch.full((3,), 0.1).double()).requires_grad_(), torch.from_numpy(dented().vertices)
    vertices.requires_grad_()
    shown = {"size": 6, "normals": normals, "rasterizer": "numpy"}
    gradients = []
    for shadows in (True, False):
        image = render(dented(), ABOVE, light, vertices=vertices, shadows=shadows, **shown)
        gradients.append(torch.autograd.grad(image.sum(), (light, vertices)))
    torch.testing.assert_close(gradients[0][0], all_rows(operator_of(dented(), samples=2, normals=normals)).sum(2).T)
    assert torch.equal(gradients[0][1], gradients[1][1])
