"""Irradiance against scipy, and derivatives of whole images against central differences with visibility held fixed.

An image is everything from vertices, light and albedo to what a classifier sees: shading, box filter, background,
clamp and encoding, and the pixels around the mesh.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
import torch
import trimesh
from scipy.special import sph_harm_y_all

from renderer.albedo import face_albedo, surface_albedo, textured_albedo
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.errors import InputError
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings, background_term, clamped, tonemap
from renderer.light.harmonics import MAX_DEGREE, lambertian_factors, nonzero_coefficients
from renderer.mesh import Mesh
from renderer.rasterizer import choose
from renderer.shading import irradiance, radiance
from renderer.transfer import build_operators

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
RASTERIZER = choose("numpy")
DEGREES = [0, 1, 2, 3, 6, 13, MAX_DEGREE]
SPECIAL = [[0.0, 0.0, 1.0], [-0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-1.0, -0.0, 0.0], [0.0, -1.0, -0.0], [1e-9, 0.0, 1.0]]


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def some_normals(count: int) -> torch.Tensor:
    """Of unit length or not; poles and the equator, too."""
    return torch.cat([3 * draw(count, 3), torch.tensor(SPECIAL, dtype=torch.float64)])


def scipy_irradiance(normals: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(3, N) Σ A_l U_lm Y_lm(n), with scipy's complex harmonics; A_l is proven in test_harmonics."""
    degree = math.isqrt(len(light)) - 1
    x, y, z = normals.T
    values = sph_harm_y_all(degree, degree, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))
    total = np.zeros((3, len(normals)))
    for l, factor in enumerate(lambertian_factors(degree).tolist()):
        for m in range(-l, l + 1):
            part = values[l, abs(m)].real if m >= 0 else values[l, abs(m)].imag
            real = part if m == 0 else math.sqrt(2) * (-1) ** m * part
            total += factor * np.outer(light[l * l + l + m], real)
    return total


def brightest(light: torch.Tensor) -> float:
    """What no irradiance exceeds: Σ A_l √((2l + 1) / 4π) |U_l|, since the squares of a band add up to (2l + 1) / 4π."""
    l = torch.arange(math.isqrt(len(light)), dtype=torch.float64)
    norms = torch.stack([band.norm(dim=0).max() for band in light.detach().double().split((2 * l + 1).long().tolist())])
    return float((lambertian_factors(len(l) - 1).abs() * ((2 * l + 1) / (4 * math.pi)).sqrt() * norms).sum())


# ---------------------------------------------------------------------------- irradiance


@pytest.mark.parametrize("degree", DEGREES)
def test_irradiance_is_scipys(degree):
    normals, light = some_normals(100), draw((degree + 1) ** 2, 3)
    expected = scipy_irradiance(normals.numpy(), light.numpy())
    np.testing.assert_allclose(irradiance(normals, light), expected, rtol=0, atol=1e-13 * brightest(light))


@pytest.mark.parametrize("degree", [0, 1, 2, 6, MAX_DEGREE])
def test_derivatives_of_irradiance_are_central_differences(degree):
    inputs = [tensor.requires_grad_(True) for tensor in (some_normals(4), draw((degree + 1) ** 2, 3, seed=1))]
    assert torch.autograd.gradcheck(irradiance, inputs, fast_mode=degree > 6)


def test_bands_that_reach_no_surface_have_a_gradient_of_exactly_zero():
    for degree, dead in ((6, 18), (MAX_DEGREE, sum(2 * l + 1 for l in range(3, MAX_DEGREE, 2)))):
        light = draw((degree + 1) ** 2, 3).requires_grad_(True)
        (gradient,) = torch.autograd.grad(irradiance(some_normals(20), light).sum(), light)
        mask = torch.ones(len(light), dtype=torch.bool).index_fill(0, nonzero_coefficients(degree), False)
        assert mask.sum() == dead
        assert not gradient[mask].any() and gradient[~mask].any(dim=1).all()


def test_the_irradiance_of_short_and_of_zero_normals_is_finite_and_no_gradient_is_nan():
    """It is of the order of 1 / length, so that it may overflow; a zero vector's is zero."""
    for dtype in (torch.float64, torch.float32, torch.float16):
        tiny = torch.finfo(dtype).smallest_normal
        lengths = torch.tensor([1, 64, 1 / 16, 0]).repeat_interleave(len(SPECIAL))[:, None]
        normals = (torch.tensor(SPECIAL).repeat(4, 1) * lengths).to(dtype).mul(tiny).requires_grad_(True)
        lit = irradiance(normals, draw(49, 3).to(dtype))
        (gradient,) = torch.autograd.grad(lit.sum(), normals)
        assert lit.isfinite().all() and not gradient.isnan().any() and not gradient[-len(SPECIAL) :].any()


@pytest.mark.parametrize("shape", [(10, 3), (49, 1), (49,), (3, 49)])
def test_a_light_that_is_not_of_whole_bands_and_three_channels_is_refused(shape):
    with pytest.raises(InputError, match="light"):
        irradiance(draw(2, 3), torch.zeros(shape, dtype=torch.float64))


def test_second_derivatives_are_refused_rather_than_wrong():
    light = draw(49, 3).requires_grad_(True)
    normals = draw(5, 3).requires_grad_(True)
    (gradient,) = torch.autograd.grad(irradiance(normals, light).pow(2).sum(), normals, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


# ---------------------------------------------------------------------------- scenes


def solid(seed: int = 0, closed: bool = True) -> Mesh:
    """A dented icosahedron with two textures and bare faces, vertex colors on all; or two thirds of it."""
    draws = np.random.default_rng(seed)
    shape = trimesh.creation.icosahedron()
    faces = shape.faces[: 20 if closed else 13]
    mesh = Mesh.plain(shape.vertices * draws.uniform(0.7, 1, (12, 1)), faces)
    return replace(
        mesh,
        corner_colors=draws.uniform(0.1, 1, (len(faces), 3, 3)).astype(np.float32),
        corner_uvs=draws.uniform(-1, 2, (len(faces), 3, 2)).astype(np.float32),
        texture_ids=(np.arange(len(faces), dtype=np.int32) % 3) - 1,
        textures=tuple(
            draws.integers(0, 256, (height, width, 3), dtype=np.uint8) for height, width in [(3, 4), (2, 3)]
        ),
    )


def with_faces(mesh: Mesh, rows) -> Mesh:
    """The faces of these indices, which may come up again."""
    per_face = {name: getattr(mesh, name)[rows] for name in ("faces", "corner_colors", "corner_uvs", "texture_ids")}
    return replace(mesh, **per_face)


def turned_round(mesh: Mesh) -> Mesh:
    """Clockwise faces."""
    per_corner = {name: getattr(mesh, name)[:, ::-1].copy() for name in ("faces", "corner_colors", "corner_uvs")}
    return replace(mesh, **per_corner)


def spoiled(mesh: Mesh) -> Mesh:
    """With three more faces that have no area, each in its own way, and every face a second time."""
    count = len(mesh.faces)
    mesh = with_faces(mesh, [*range(count), 0, 1, 2, *range(count)])
    mesh.faces[count : count + 3] = [[0, 0, 0], [1, 1, 2], [3, 4, 4]]
    return mesh


IN_FRONT, BEHIND = OrthographicCamera(1.0, 0.4, 2.2), OrthographicCamera(math.pi - 1.0, 0.4 + math.pi, 2.2)


@dataclass(frozen=True)
class Scene:
    mesh: Mesh
    camera: Camera = IN_FRONT
    size: int = 5
    samples: int = 3

    @cached_property
    def fragments(self) -> Fragments:
        settings = ImageSettings(self.size, self.samples)
        [fragments] = build_fragments(self.mesh.vertices, self.mesh.faces, [self.camera], settings, RASTERIZER)
        return fragments

    def vertices(self) -> torch.Tensor:
        return torch.from_numpy(self.mesh.vertices.copy())

    def all_faces(self, smooth: bool) -> torch.Tensor | None:
        return torch.from_numpy(self.mesh.faces) if smooth else None


SCENES = {
    "solid": Scene(solid()),
    "open, from in front": Scene(solid(closed=False)),
    "open, from behind": Scene(solid(closed=False), BEHIND),
    "wound the other way": Scene(turned_round(solid())),
    "spoiled": Scene(spoiled(solid())),
    "one sample per pixel": Scene(solid(), size=9, samples=1),
    "from close by": Scene(solid(), PerspectiveCamera(1.0, 0.4, 2.2, distance=1.8)),
}
each_scene = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
flat_and_smooth = pytest.mark.parametrize("smooth", [False, True], ids=["flat", "smooth"])


# ---------------------------------------------------------------------------- images


@dataclass(frozen=True)
class Image:
    """A scene as a function of vertices (V, 3), light (49, 3) and textures: (3, size²) image values."""

    scene: Scene
    encoding: str
    smooth: bool

    def inputs(self) -> list[torch.Tensor]:
        """A light that leaves some values below black, some above white and most between."""
        light = 1.5 * draw(49, 3, seed=1)
        light[0] = 1.0
        textures = [torch.from_numpy(texture / 255) for texture in self.scene.mesh.textures]
        return [tensor.requires_grad_(True) for tensor in (self.scene.vertices(), light, *textures)]

    def parts(self, vertices, light, *textures) -> tuple[Fragments, tuple]:
        """What `tonemap` takes."""
        fragments = self.scene.fragments
        albedo = textured_albedo(self.scene.mesh, fragments, textures, self.encoding)
        lit = radiance(fragments, vertices, light, albedo, self.scene.all_faces(self.smooth))
        background = torch.tensor([[0.3], [0.6], [0.1]], dtype=lit.dtype)
        return fragments, (lit, fragments.coverage[None].to(lit), background, self.encoding)

    def __call__(self, *inputs) -> torch.Tensor:
        fragments, parts = self.parts(*inputs)
        canvas = parts[2].expand(3, self.scene.size**2)
        return canvas.index_copy(1, fragments.pixels, tonemap(*parts))

    def clamped(self, *inputs) -> torch.Tensor:
        lit, *around = self.parts(*inputs)[1]
        return clamped(lit + background_term(*around))


def slope(function, inputs, steps, length: float = 1e-5) -> torch.Tensor:
    """Derivative of a function along steps, to the fourth order in their length."""

    def at(distance: float) -> torch.Tensor:
        return function(*(tensor + distance * step for tensor, step in zip(inputs, steps, strict=True)))

    with torch.no_grad():
        return (8 * (at(length) - at(-length)) - (at(2 * length) - at(-2 * length))) / (12 * length)


@each_scene
@flat_and_smooth
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_derivatives_of_images_are_central_differences(scene, smooth, encoding):
    """By vertices, light and texels each alone, and by all of them at once."""
    image = Image(scene, encoding, smooth)
    inputs = image.inputs()
    upstream = draw(3, scene.size**2, seed=2)
    gradients = torch.autograd.grad(image(*inputs), inputs, upstream)
    directions = [draw(*tensor.shape, seed=3 + index) for index, tensor in enumerate(inputs)]
    for moved in ([0], [1], [2], [3], range(4)):
        steps = [direction * (index in moved) for index, direction in enumerate(directions)]
        for distance in (2e-5, -2e-5):  # no value comes to the clamp on the way
            nudged = [tensor.detach() + distance * step for tensor, step in zip(inputs, steps, strict=True)]
            assert torch.equal(image.clamped(*nudged), image.clamped(*inputs))
        expected = (slope(image, inputs, steps) * upstream).sum()
        found = sum((gradient * step).sum() for gradient, step in zip(gradients, steps, strict=True))
        # What is left out is of the order of length⁴; a few hundred values round by 1e-16 / length.
        assert found.item() == pytest.approx(expected.item(), rel=1e-8, abs=1e-8)


@flat_and_smooth
def test_albedo_per_face_has_the_derivative_of_central_differences(smooth):
    scene = SCENES["solid"]
    fragments, vertices, light = scene.fragments, scene.vertices(), draw(49, 3)

    def lit(albedo: torch.Tensor) -> torch.Tensor:
        return radiance(fragments, vertices, light, face_albedo(albedo, fragments), scene.all_faces(smooth))

    albedo = draw(len(scene.mesh.faces), 3).requires_grad_(True)
    assert torch.autograd.gradcheck(lit, albedo)
    (gradient,) = torch.autograd.grad(lit(albedo).sum(), albedo)
    unseen = np.setdiff1d(np.arange(len(albedo)), fragments.faces)
    assert len(unseen) and not gradient[unseen].any()


# ---------------------------------------------------------------------------- zeros


@each_scene
@flat_and_smooth
def test_what_no_sample_sees_has_a_gradient_of_exactly_zero(scene, smooth):
    """Coefficients of the dead bands, vertices of no seen face (nor of a neighbor's, where normals are smooth)."""
    image = Image(scene, "linear", smooth)
    inputs = image.inputs()
    fragments = scene.fragments
    by_vertex, by_light, *_ = torch.autograd.grad(image(*inputs), inputs, draw(3, scene.size**2))
    dead = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
    assert not by_light[dead].any() and by_light[~dead].all()
    moving = np.unique(fragments.corners)
    if smooth:
        moving = np.unique(scene.mesh.faces[np.isin(scene.mesh.faces, moving).any(axis=1)])
    still = np.setdiff1d(np.arange(len(by_vertex)), moving)
    assert not by_vertex[still].any() and by_vertex[moving].any(dim=1).all()


@each_scene
@flat_and_smooth
def test_background_and_clamped_pixels_have_a_gradient_of_exactly_zero(scene, smooth):
    image = Image(scene, "srgb", smooth)
    inputs = image.inputs()
    values = image(*inputs)
    fragments = scene.fragments
    around = torch.ones(3, scene.size**2).index_fill(1, fragments.pixels, 0)
    at_an_end = torch.zeros_like(around).index_copy(1, fragments.pixels, image.clamped(*inputs).float())
    assert at_an_end.any()
    for upstream in (around, at_an_end):
        gradients = torch.autograd.grad(values, inputs, upstream.double(), retain_graph=True)
        assert not any(gradient.any() for gradient in gradients)


# ---------------------------------------------------------------------------- radiance


def lit_and_gradients(scene: Scene, smooth: bool, dtype=torch.float64) -> tuple[torch.Tensor, ...]:
    """Radiance and its gradients by vertices, light and albedo."""
    albedo = surface_albedo(scene.mesh, scene.fragments, "linear")
    inputs = [tensor.to(dtype).requires_grad_(True) for tensor in (scene.vertices(), draw(49, 3), albedo)]
    lit = radiance(scene.fragments, *inputs, scene.all_faces(smooth))
    upstream = draw(*lit.shape, seed=1).to(dtype)
    return lit.detach(), *torch.autograd.grad(lit, inputs, upstream)


@each_scene
@pytest.mark.parametrize("color", [None, (0.9, 0.5, 0.2)], ids=["its own colors", "one color"])
def test_flat_radiance_is_the_operators(scene, color):
    mesh = scene.mesh if color is None else Mesh.plain(scene.mesh.vertices, scene.mesh.faces, color)
    scene = replace(scene, mesh=mesh)
    settings = ImageSettings(scene.size, scene.samples)
    [operator] = build_operators(mesh, [scene.camera], settings, RASTERIZER, dtype=torch.float64)
    assert len(operator.transfer) == (3 if color is None and scene.samples > 1 else 1)
    lit, _, by_light, _ = lit_and_gradients(scene, smooth=False)
    light = draw(49, 3)
    torch.testing.assert_close(lit, operator.radiance(light), rtol=0, atol=16 * EPS * brightest(light))
    by_operator = operator.light_gradient(draw(*lit.shape, seed=1))
    torch.testing.assert_close(by_light, by_operator, rtol=0, atol=64 * EPS * float(by_operator.abs().max()))


def test_smooth_radiance_on_an_octahedron_is_that_of_the_direction_to_the_surface():
    """Its vertex normals are its corners, and so the normal at a sample is the point there itself."""
    hull = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]))
    scene = Scene(Mesh.plain(hull.vertices, hull.faces), size=24, samples=1)
    fragments, light = scene.fragments, draw(49, 3)
    lit, *_ = lit_and_gradients(scene, smooth=True)
    right, up, back = scene.camera.axes()
    across = fragments.positions().numpy() * scene.camera.width / 2
    # The faces' planes are n · p = 1.
    normals = np.sign(scene.mesh.vertices[fragments.corners[fragments.face]].sum(axis=1))
    foot = across @ np.stack([right, up])
    points = foot + ((1 - (normals * foot).sum(axis=1)) / (normals @ back))[:, None] * back
    expected = scipy_irradiance(points, light.numpy())
    inside = (np.sign(points) == normals).all(axis=1)  # corners are snapped to 1/256 of a sample
    assert inside.mean() > 0.95 and len(inside) > 100
    np.testing.assert_allclose(lit[:, inside], expected[:, inside], rtol=0, atol=64 * EPS * brightest(light))


# ---------------------------------------------------------------------------- generated meshes and lights
