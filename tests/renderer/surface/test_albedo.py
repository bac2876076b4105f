"""Albedo at the samples: textures against scipy, and derivatives by texel and by face."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from oracles import linear_of, patchwork
from scipy.ndimage import map_coordinates

from renderer.camera import OrthographicCamera
from renderer.geometry.mesh import Mesh
from renderer.io.texture_bake import with_added_albedo
from renderer.settings import ENCODINGS, ImageSettings
from renderer.surface.albedo import face_albedo, painted_albedo, surface_albedo
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import choose

EPS = torch.finfo(torch.float64).eps
ABOVE = OrthographicCamera(0, -math.pi / 2, 2.0)  # x is right, y is up
ALL_OF_IT = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
UNIT_UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
HALVES = [[0, 1, 2], [0, 2, 3]]


def view(mesh: Mesh, size: int, samples: int = 1, camera: OrthographicCamera = ABOVE) -> Fragments:
    settings = ImageSettings(size, samples)
    [fragments] = build_fragments(mesh.vertices, mesh.faces, [camera], settings, choose("numpy"))
    return fragments


def random_texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def poster(texture: np.ndarray, uvs=UNIT_UVS, color=(1.0, 1.0, 1.0)) -> Mesh:
    """The whole image, one texture on it."""
    uvs = np.asarray(uvs, dtype=np.float32)[HALVES]
    ids = np.zeros(2, dtype=np.int32)
    return replace(Mesh.plain(ALL_OF_IT, HALVES, color), corner_uvs=uvs, texture_ids=ids, textures=(texture,))


def draw(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def dented() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    return patchwork(sphere.vertices, sphere.faces)


def decoded(colors: np.ndarray, encoding: str) -> np.ndarray:
    return linear_of(colors) if encoding == "srgb" else colors


# ---------------------------------------------------------------------------- as the mesh has it


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_texture_lookup_is_scipys_linear_interpolation_of_linear_texels_and_repeats(encoding):
    texture = random_texture(5, 7)
    uvs = np.array([[-1.25, -0.75], [2.125, 0.25], [2.5, 2.0], [-0.875, 1.0]])  # a parallelogram, in float32 exactly
    mesh = poster(texture, uvs)
    fragments = view(mesh, 23)
    x, y = (fragments.positions().numpy().T + 1) / 2
    u, v = (uvs[0] + np.outer(x, uvs[1] - uvs[0]) + np.outer(y, uvs[3] - uvs[0])).T
    at = np.stack([(1 - v) * 5 - 0.5, u * 7 - 0.5])
    texels = decoded(texture / 255, encoding)
    expected = [map_coordinates(texels[..., c], at, order=1, mode="grid-wrap") for c in range(3)]
    np.testing.assert_allclose(surface_albedo(mesh, fragments, encoding), np.stack(expected, axis=1), atol=64 * EPS)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_corner_colors_are_decoded_and_then_interpolated(encoding):
    """Over a triangle whose corners are the image's and two beyond it: weights are the coordinates."""
    colors = np.array([[0.0, 0.5, 1.0], [1.0, 0.25, 0.5], [0.125, 0.0, 0.75]])
    mesh = Mesh.plain([[-1, -1, 0], [3, -1, 0], [-1, 3, 0]], [[0, 1, 2]], colors)
    fragments = view(mesh, 8)
    x, y = (fragments.positions().numpy().T + 1) / 4
    expected = np.stack([1 - x - y, x, y], axis=1) @ decoded(colors, encoding)
    np.testing.assert_allclose(surface_albedo(mesh, fragments, encoding), expected, rtol=0, atol=16 * EPS)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_texture_multiplies_the_corner_color(encoding):
    mesh = poster(np.full((3, 3, 3), 51, dtype=np.uint8), color=(1, 0.5, 0))
    expected = decoded(np.array(0.2), encoding) * decoded(np.array([1, 0.5, 0]), encoding)
    albedo = surface_albedo(mesh, view(mesh, 3), encoding)
    np.testing.assert_allclose(albedo, np.tile(expected, (9, 1)), rtol=16 * EPS)


# ---------------------------------------------------------------------------- as a parameter

TEXTURED = [(dented(), OrthographicCamera(1.0, 0.4, 1.7)), (poster(random_texture(3, 4)), ABOVE)]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("mesh", "camera"), TEXTURED)
def test_the_textures_of_a_mesh_as_parameters_give_its_albedo(mesh, camera, encoding):
    fragments = view(mesh, 6, 3, camera)
    textures = [torch.from_numpy(decoded(texture / 255, encoding)) for texture in mesh.textures]
    albedo = surface_albedo(mesh, fragments, encoding, textures)
    torch.testing.assert_close(albedo, surface_albedo(mesh, fragments, encoding), rtol=0, atol=16 * EPS)


@pytest.mark.parametrize(("mesh", "camera"), TEXTURED)
def test_albedo_per_texel_has_the_derivative_of_central_differences(mesh, camera):
    fragments = view(mesh, 3, 2, camera)
    inputs = [draw(*texture.shape).requires_grad_(True) for texture in mesh.textures]
    assert torch.autograd.gradcheck(lambda *given: surface_albedo(mesh, fragments, "srgb", given), inputs)


# ---------------------------------------------------------------------------- what is added to faces


def middling(colors_differ: bool) -> Mesh:
    """`dented` between 0.2 and 0.8 in linear light, so that adding up to 0.15 clamps nothing."""
    mesh = dented()
    colors = mesh.corner_colors if colors_differ else mesh.corner_colors[:, :1].repeat(3, axis=1)
    colors = np.where((mesh.texture_ids >= 0)[:, None, None], 1.0, 0.2 + 0.6 * colors).astype(np.float32)
    textures = tuple((51 + 0.6 * each).astype(np.uint8) for each in mesh.textures)
    return replace(mesh, corner_colors=colors, textures=textures)


@pytest.mark.parametrize("albedo_scale", [1.0, 0.5, 1.2])
def test_albedo_added_to_a_face_is_added_at_its_samples_where_nothing_is_clamped(albedo_scale):
    mesh = middling(True)
    fragments, added = view(mesh, 16, 2), 0.1 * (draw(len(mesh.faces), 3) - 0.5)
    expected = surface_albedo(mesh, fragments, "linear") * albedo_scale + face_albedo(added, fragments)
    torch.testing.assert_close(
        painted_albedo(mesh, fragments, "linear", albedo_scale, added), expected, rtol=0, atol=8 * EPS
    )


@pytest.mark.parametrize("albedo_scale", [1.0, 3.0])
def test_a_painted_albedo_stays_within_zero_and_one_or_what_it_was(albedo_scale):
    mesh = dented()
    fragments = view(mesh, 16, 2)
    much = torch.full((len(mesh.faces), 3), 9.0, dtype=torch.float64)
    assert (painted_albedo(mesh, fragments, "srgb", albedo_scale, -much) == 0).all()
    most = painted_albedo(mesh, fragments, "srgb", albedo_scale, much)
    assert most.min() >= 1 - 4 * EPS and most.max() <= albedo_scale * (1 + 4 * EPS)


def test_the_derivative_by_the_added_albedo_is_that_of_finite_differences():
    shape = trimesh.creation.icosahedron()
    mesh = patchwork(shape.vertices, shape.faces)
    fragments, added = view(mesh, 5), (0.3 * (draw(20, 3) - 0.5)).requires_grad_()
    assert torch.autograd.gradcheck(lambda values: painted_albedo(mesh, fragments, "srgb", 1.5, values), [added])


@pytest.mark.parametrize(("encoding", "albedo_scale"), [("linear", 1.0), ("linear", 0.5), ("srgb", 2.0)])
def test_colors_and_textures_hold_the_added_albedo(encoding, albedo_scale):
    """Colors at corners to float32; texels, in which no colors vary, to half of a step of 8 bits, encoded."""
    mesh = dented()
    even = mesh.corner_colors[:, :1].repeat(3, axis=1)
    mesh = replace(mesh, corner_colors=np.where((mesh.texture_ids >= 0)[:, None, None], even, mesh.corner_colors))
    added = 0.6 * (draw(len(mesh.faces), 3) - 0.5)
    painted, new_albedo_scale = with_added_albedo(mesh, added.numpy(), encoding, albedo_scale)
    assert 1 <= new_albedo_scale <= max(1, albedo_scale)
    bare = torch.from_numpy(mesh.texture_ids < 0)
    steepest = 2.4 / 1.055 if encoding == "srgb" else 1.0  # slope of the curve, at 1
    step = 0.5 / 255 * steepest * new_albedo_scale
    for polar in (0.3, 1.5, 2.8):
        fragments = view(mesh, 24, 2, OrthographicCamera(polar, polar, 2.0))
        expected = painted_albedo(mesh, fragments, encoding, albedo_scale, added)
        off = (surface_albedo(painted, fragments, encoding) * new_albedo_scale - expected).abs().amax(1)
        without = bare[fragments.faces][fragments.face]
        assert without.any() and not without.all()
        assert off[without].max() < 1e-6 and off[~without].max() < step + 1e-5


def test_corners_of_different_colors_are_painted_into_the_texels_between_them():
    """A texture of one color, under a blend of four: the blend, to what texels can tell."""
    mesh = poster(
        np.full((64, 64, 3), 255, np.uint8), color=np.array([[0.2] * 3, [0.9, 0.2, 0.2], [0.8] * 3, [0.4] * 3])
    )
    fragments, nothing = view(mesh, 32), np.zeros((2, 3))
    painted, _ = with_added_albedo(mesh, nothing, "linear")
    assert (painted.corner_colors == 1).all()
    expected = surface_albedo(mesh, fragments, "linear")
    torch.testing.assert_close(surface_albedo(painted, fragments, "linear"), expected, rtol=0, atol=1.1 / 255)


def test_the_float32_gradient_of_a_painted_albedo_is_the_same_on_several_threads_and_on_one():
    """Half a million samples of two faces add up to each value of the gradient, in one order."""
    mesh = poster(random_texture(16, 16))
    fragments = view(mesh, 256, samples=3)

    def gradient(threads: int) -> list[torch.Tensor]:
        torch.set_num_threads(threads)
        hue = torch.tensor([0.2, -0.3], requires_grad=True)
        added = torch.tensor([[0.1, 0.0, -0.1], [0.0, 0.05, 0.02]], requires_grad=True)
        albedo = painted_albedo(mesh, fragments, "srgb", 1.0, added, hue)
        weights = torch.linspace(-1, 1, albedo.numel()).view_as(albedo)
        return list(torch.autograd.grad((weights * albedo).sum(), [hue, added]))

    before = torch.get_num_threads()
    try:
        expected, *again = gradient(1), *(gradient(4) for _ in range(4))
    finally:
        torch.set_num_threads(before)
    for found in again:
        for values, exact in zip(found, expected, strict=True):
            assert torch.equal(values, exact)
