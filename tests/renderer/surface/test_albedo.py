"""Albedo at the samples: textures compared with SciPy, and gradients by texel and by face."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from oracles import bilinear, draw_uniform, fragments_of, linear_of, patchwork, square, textured

from renderer.camera import OrthographicCamera
from renderer.mesh import Mesh
from renderer.settings import ENCODINGS, ImageSettings
from renderer.surface.albedo import face_albedo, paint_faces, surface_albedo, with_added_albedo
from renderer.surface.gloss import sample_gloss
from renderer.visibility.fragments import Fragments

EPS = torch.finfo(torch.float64).eps
# Camera whose image shows x to the right and y up, from -1 to 1.
ABOVE = OrthographicCamera(0, -90.0, 2.0)
# Texture coordinates of a square that fills this image.
UNIT_UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


def view(mesh: Mesh, size: int, samples: int = 1, camera: OrthographicCamera = ABOVE) -> Fragments:
    return fragments_of(mesh, camera, ImageSettings(size, samples))


def random_texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def poster(texture: np.ndarray, uvs=UNIT_UVS, color=(1.0, 1.0, 1.0)) -> Mesh:
    mesh = square(1, color=color)
    return textured(mesh, np.asarray(uvs)[mesh.faces], texture)


def patchwork_sphere() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    return patchwork(sphere.vertices, sphere.faces)


def decoded(colors: np.ndarray, encoding: str) -> np.ndarray:
    return linear_of(colors) if encoding == "srgb" else colors


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_texture_lookup_is_scipys_linear_interpolation_of_linear_texels_and_repeats(encoding):
    height = 5
    width = 7
    texture = random_texture(height, width)
    # float32 holds this parallelogram exactly.
    uvs = np.array([[-1.25, -0.75], [2.125, 0.25], [2.5, 2.0], [-0.875, 1.0]])
    mesh = poster(texture, uvs)
    fragments = view(mesh, 23)
    x, y = (fragments.positions().numpy().T + 1) / 2
    u, v = (uvs[0] + np.outer(x, uvs[1] - uvs[0]) + np.outer(y, uvs[3] - uvs[0])).T
    texels = decoded(texture / 255, encoding)
    expected = bilinear(texels, (1 - v) * height - 0.5, u * width - 0.5)
    albedo = surface_albedo(mesh, fragments, encoding)
    np.testing.assert_allclose(albedo, expected, atol=64 * EPS)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_corner_colors_are_decoded_and_then_interpolated(encoding):
    """The weights of a triangle with edges along x and y are linear in x and y."""
    colors = np.array([[0.0, 0.5, 1.0], [1.0, 0.25, 0.5], [0.125, 0.0, 0.75]])
    mesh = Mesh.plain([[-1, -1, 0], [3, -1, 0], [-1, 3, 0]], [[0, 1, 2]], colors)
    fragments = view(mesh, 8)
    x, y = (fragments.positions().numpy().T + 1) / 4
    expected = np.stack([1 - x - y, x, y], axis=1) @ decoded(colors, encoding)
    albedo = surface_albedo(mesh, fragments, encoding)
    np.testing.assert_allclose(albedo, expected, rtol=0, atol=16 * EPS)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_texture_multiplies_the_corner_color(encoding):
    mesh = poster(np.full((3, 3, 3), 51, dtype=np.uint8), color=(1, 0.5, 0))
    expected = decoded(np.array(0.2), encoding) * decoded(np.array([1, 0.5, 0]), encoding)
    albedo = surface_albedo(mesh, view(mesh, 3), encoding)
    np.testing.assert_allclose(albedo, np.tile(expected, (9, 1)), rtol=16 * EPS)


TEXTURED = [(poster(random_texture(3, 4)), ABOVE)]
TEXTURED.append((patchwork_sphere(), OrthographicCamera(57.3, 22.9, 1.7)))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("mesh", "camera"), TEXTURED)
def test_the_textures_of_a_mesh_as_parameters_give_its_albedo(mesh, camera, encoding):
    fragments = view(mesh, 6, 3, camera)
    textures = [torch.from_numpy(decoded(texture / 255, encoding)) for texture in mesh.textures]
    albedo = surface_albedo(mesh, fragments, encoding, textures)
    expected = surface_albedo(mesh, fragments, encoding)
    torch.testing.assert_close(albedo, expected, rtol=0, atol=16 * EPS)


def mid_tone_sphere() -> Mesh:
    """Return a sphere with linear colors from 0.2 to 0.8, so that adding 0.15 clamps nothing."""
    mesh = patchwork_sphere()
    has_texture = (mesh.texture_ids >= 0)[:, None, None]
    colors = np.where(has_texture, 1.0, 0.2 + 0.6 * mesh.corner_colors).astype(np.float32)
    textures = tuple((51 + 0.6 * texture).astype(np.uint8) for texture in mesh.textures)
    return replace(mesh, corner_colors=colors, textures=textures)


@pytest.mark.parametrize("albedo_scale", [1.0, 0.5, 1.2])
def test_albedo_added_to_a_face_is_added_at_its_samples_where_nothing_is_clamped(albedo_scale):
    mesh = mid_tone_sphere()
    fragments = view(mesh, 16, 2)
    added = 0.1 * (draw_uniform(len(mesh.faces), 3) - 0.5)
    scaled = surface_albedo(mesh, fragments, "linear") * albedo_scale
    expected = scaled + face_albedo(added, fragments)
    painted = paint_faces(mesh, fragments, "linear", albedo_scale, added)
    torch.testing.assert_close(painted, expected, rtol=0, atol=8 * EPS)


@pytest.mark.parametrize("albedo_scale", [1.0, 3.0])
def test_a_painted_albedo_stays_within_zero_and_one_or_what_it_was(albedo_scale):
    mesh = patchwork_sphere()
    fragments = view(mesh, 16, 2)
    large = torch.full((len(mesh.faces), 3), 9.0, dtype=torch.float64)
    assert (paint_faces(mesh, fragments, "srgb", albedo_scale, -large) == 0).all()
    brightest = paint_faces(mesh, fragments, "srgb", albedo_scale, large)
    assert brightest.min() >= 1 - 4 * EPS
    assert brightest.max() <= albedo_scale * (1 + 4 * EPS)


def with_even_colors_on_textures(mesh: Mesh) -> Mesh:
    first_colors = mesh.corner_colors[:, :1].repeat(3, axis=1)
    has_texture = (mesh.texture_ids >= 0)[:, None, None]
    return replace(mesh, corner_colors=np.where(has_texture, first_colors, mesh.corner_colors))


@pytest.mark.parametrize(
    ("encoding", "albedo_scale"), [("linear", 1.0), ("linear", 0.5), ("srgb", 2.0)]
)
@pytest.mark.parametrize("angle", [17.0, 86.0, 160.0])
def test_colors_and_textures_hold_the_added_albedo(encoding, albedo_scale, angle):
    """Colors at corners have float32 precision, and texels are rounded to 8 bits."""
    mesh = with_even_colors_on_textures(patchwork_sphere())
    added = 0.6 * (draw_uniform(len(mesh.faces), 3) - 0.5)
    painted, new_albedo_scale = with_added_albedo(mesh, added.numpy(), encoding, albedo_scale)
    assert 1 <= new_albedo_scale <= max(1, albedo_scale)

    fragments = view(mesh, 24, 2, OrthographicCamera(angle, angle, 2.0))
    expected = paint_faces(mesh, fragments, encoding, albedo_scale, added)
    found = surface_albedo(painted, fragments, encoding) * new_albedo_scale
    error = (found - expected).abs().amax(1)
    is_untextured = torch.from_numpy(mesh.texture_ids < 0)[fragments.faces][
        fragments.sample_to_seen_face
    ]
    assert is_untextured.any()
    assert not is_untextured.all()
    assert error[is_untextured].max() < 1e-6
    # The curve that decodes texels is steepest at 1.
    largest_slope = 2.4 / 1.055 if encoding == "srgb" else 1.0
    largest_error = 0.5 / 255 * largest_slope * new_albedo_scale
    assert error[~is_untextured].max() < largest_error + 1e-5


COLORS = np.array([[0.2] * 3, [0.9, 0.2, 0.2], [0.8] * 3, [0.4] * 3])


@pytest.mark.parametrize(("side", "tolerance"), [(64, 1.1 / 255), (8, 0.01), (3, 0.01), (2, 0.01)])
def test_corners_of_different_colors_are_painted_into_the_texels_between_them(side, tolerance):
    """Texels hold the product with the interpolated colors of the corners, rounded to 8 bits."""
    texture = np.full((side, side, 3), 255, np.uint8)
    texture[0, 0] = 100
    mesh = poster(texture, color=COLORS)
    fragments = view(mesh, 32)
    painted, _ = with_added_albedo(mesh, np.zeros((2, 3)), "linear")
    assert (painted.corner_colors == 1).all()
    expected = surface_albedo(mesh, fragments, "linear")
    found = surface_albedo(painted, fragments, "linear")
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
@pytest.mark.parametrize("value", [100, 255])
def test_the_given_mesh_stays_as_it_was(encoding, value):
    mesh = poster(np.full((2, 2, 3), value, np.uint8), color=COLORS)
    before = mesh.corner_colors.copy()
    with_added_albedo(mesh, np.full((2, 3), 0.1), encoding)
    assert np.array_equal(mesh.corner_colors, before)


def test_a_face_within_a_texel_enlarges_no_texture():
    """The colors of its corners differ, and it is 0.0001 wide in the texture."""
    uvs = np.float32([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1e-4, 1e-4], [0, 1e-4]]])
    mesh = replace(poster(random_texture(64, 64), color=COLORS), corner_uvs=uvs)
    painted, _ = with_added_albedo(mesh, np.zeros((2, 3)), "linear")
    assert painted.textures[0].size < 4 * 64 * 64 * 3


@pytest.mark.parametrize("side", [1, 5])
def test_corners_hold_the_product_with_a_texture_of_equal_texels(side):
    mesh = poster(np.full((side, side, 3), 100, np.uint8), color=COLORS)
    fragments = view(mesh, 32)
    painted, _ = with_added_albedo(mesh, np.full((2, 3), 0.05), "srgb", 1.5)
    added = torch.full((2, 3), 0.05, dtype=torch.float64)
    expected = paint_faces(mesh, fragments, "srgb", 1.5, added)
    found = surface_albedo(painted, fragments, "srgb")
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("side", [1, 4])
def test_a_gloss_texture_that_is_larger_keeps_its_texels(side):
    texture = random_texture(side, side)
    wave = np.sin(np.arange(8) / 8 * 2 * np.pi)
    gloss = np.rint(155 + 50 * wave[:, None, None] + 50 * wave[:, None]).repeat(2, 2)
    gloss = gloss.astype(np.uint8)
    mesh = replace(poster(texture), gloss=np.ones((2, 3), np.float32), gloss_textures=(gloss,))
    painted, _ = with_added_albedo(mesh, np.zeros((2, 3)), "srgb")
    fragments = view(mesh, 8)
    before, after = (sample_gloss(one, fragments, None) for one in (mesh, painted))
    torch.testing.assert_close(after.roughness, before.roughness, rtol=0, atol=0.03 * (side > 1))


@pytest.mark.parametrize("albedo_scale", [1.1, 1.7, 1.95, 2.15, 3.3])
def test_files_hold_no_color_above_one(albedo_scale):
    mesh = patchwork_sphere()
    added = np.zeros((len(mesh.faces), 3))
    painted, _ = with_added_albedo(mesh, added, "linear", albedo_scale)
    assert painted.corner_colors.max() <= 1


def test_the_float32_gradient_of_a_painted_albedo_is_the_same_on_several_threads_and_on_one():
    """Each value of the gradient is a sum over 65,536 samples, always in one order."""
    mesh = poster(random_texture(16, 16))
    fragments = view(mesh, 128, samples=2)

    def gradient(threads: int) -> list[torch.Tensor]:
        torch.set_num_threads(threads)
        hue = torch.tensor([0.2, -0.3], requires_grad=True)
        added = torch.tensor([[0.1, 0.0, -0.1], [0.0, 0.05, 0.02]], requires_grad=True)
        albedo = paint_faces(mesh, fragments, "srgb", 1.0, added, hue)
        weights = torch.linspace(-1, 1, albedo.numel()).view_as(albedo)
        return list(torch.autograd.grad((weights * albedo).sum(), [hue, added]))

    before = torch.get_num_threads()
    try:
        expected, *others = [gradient(threads) for threads in (1, 4, 4)]
    finally:
        torch.set_num_threads(before)
    for found in others:
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
