"""Irradiance against scipy, and derivatives of whole images against central differences at fixed visibility.

An image is everything from vertices, light and albedo to what a classifier sees: shading, box filter, background,
clamp and encoding, and the pixels around the mesh.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, patchwork, scipy_irradiance

from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.geometry.mesh import Mesh
from renderer.image import background_term, tonemap
from renderer.light.harmonics import DIFFUSE_DEGREE, nonzero_coefficients
from renderer.settings import ImageSettings
from renderer.surface import shading
from renderer.surface.albedo import surface_albedo
from renderer.surface.shading import radiance
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import choose

EPS = torch.finfo(torch.float64).eps
RASTERIZER = choose("numpy")
DEGREES = [0, 1, 2, 3, 6, 13, DIFFUSE_DEGREE]
SPECIAL = [[0.0, 0.0, 1.0], [-0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-1.0, -0.0, 0.0], [0.0, -1.0, -0.0], [1e-9, 0.0, 1.0]]


def irradiance(normals: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
    return shading.irradiance(normals.T, light, light.dtype)


def some_normals(count: int) -> torch.Tensor:
    """Of unit length or not; poles and the equator, too."""
    return torch.cat([3 * draw(count, 3), torch.tensor(SPECIAL, dtype=torch.float64)])


@pytest.mark.parametrize("degree", DEGREES)
def test_irradiance_is_scipys(degree):
    normals, light = some_normals(100), draw((degree + 1) ** 2, 3)
    expected = scipy_irradiance(normals, light).T
    np.testing.assert_allclose(irradiance(normals, light), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 6, DIFFUSE_DEGREE])
def test_derivatives_of_irradiance_are_central_differences(degree):
    inputs = [tensor.requires_grad_(True) for tensor in (some_normals(4), draw((degree + 1) ** 2, 3, seed=1))]
    assert torch.autograd.gradcheck(irradiance, inputs, fast_mode=degree > 6)


def test_the_irradiance_of_short_and_of_zero_normals_is_finite_and_no_gradient_is_nan():
    """It is of the order of 1 / length, so that it may overflow; a zero vector's is zero."""
    for dtype in (torch.float64, torch.float32):
        tiny = torch.finfo(dtype).smallest_normal
        lengths = torch.tensor([1, 64, 1 / 16, 0]).repeat_interleave(len(SPECIAL))[:, None]
        normals = (torch.tensor(SPECIAL).repeat(4, 1) * lengths).to(dtype).mul(tiny).requires_grad_(True)
        lit = irradiance(normals, draw(49, 3).to(dtype))
        (gradient,) = torch.autograd.grad(lit.sum(), normals)
        assert lit.isfinite().all() and not gradient.isnan().any() and not gradient[-len(SPECIAL) :].any()


def test_second_derivatives_are_refused_rather_than_wrong():
    light = draw(49, 3).requires_grad_(True)
    normals = draw(5, 3).requires_grad_(True)
    (gradient,) = torch.autograd.grad(irradiance(normals, light).pow(2).sum(), normals, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def solid(closed: bool = True) -> Mesh:
    """A dented icosahedron, or two thirds of it."""
    shape = trimesh.creation.icosahedron()
    return patchwork(shape.vertices, shape.faces[: 20 if closed else 13])


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

    def normals(self, vertices: torch.Tensor, smooth: bool) -> torch.Tensor | None:
        return shading.normals_in_sight(self.fragments, vertices, torch.from_numpy(self.mesh.faces)) if smooth else None


SCENES = {
    "solid": Scene(solid()),
    "open, from in front": Scene(solid(closed=False)),
    "open, from behind": Scene(solid(closed=False), BEHIND),
    "one sample per pixel": Scene(solid(), size=9, samples=1),
    "from close by": Scene(solid(), PerspectiveCamera(1.0, 0.4, 2.2, distance=1.8)),
}
all_scenes = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
flat_and_smooth = pytest.mark.parametrize("smooth", [False, True], ids=["flat", "smooth"])


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
        albedo = surface_albedo(self.scene.mesh, fragments, self.encoding, textures)
        lit = radiance(fragments, vertices, light, albedo, self.scene.normals(vertices, self.smooth))
        background = torch.tensor([[0.3], [0.6], [0.1]], dtype=lit.dtype)
        return fragments, (lit, fragments.coverage[None].to(lit), background, self.encoding)

    def __call__(self, *inputs) -> torch.Tensor:
        fragments, parts = self.parts(*inputs)
        canvas = parts[2].expand(3, self.scene.size**2)
        return canvas.index_copy(1, fragments.pixels, tonemap(*parts))

    def clamped(self, *inputs) -> torch.Tensor:
        lit, *around = self.parts(*inputs)[1]
        composite = lit + background_term(*around)
        return (composite < 0) | (composite > 1)


def slope(function, inputs, steps, length: float = 1e-5) -> torch.Tensor:
    """Derivative of a function along steps, to the fourth order in their length."""

    def at(distance: float) -> torch.Tensor:
        return function(*(tensor + distance * step for tensor, step in zip(inputs, steps, strict=True)))

    with torch.no_grad():
        return (8 * (at(length) - at(-length)) - (at(2 * length) - at(-2 * length))) / (12 * length)


@all_scenes
@flat_and_smooth
def test_derivatives_of_images_are_central_differences(scene, smooth):
    """By vertices, light and texels each alone, and by all of them at once."""
    image = Image(scene, "srgb" if smooth else "linear", smooth)
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


@all_scenes
@flat_and_smooth
def test_gradients_are_exactly_zero_where_nothing_is_visible_or_clamped(scene, smooth):
    """By the light: bands 3 and 5. By the vertices: those of no visible face (nor of a neighbor, where normals are
    smooth). By everything: pixels of the background, and clamped ones."""
    image, fragments = Image(scene, "srgb", smooth), scene.fragments
    inputs = image.inputs()
    values = image(*inputs)
    by_vertex, by_light, *_ = torch.autograd.grad(values, inputs, draw(3, scene.size**2), retain_graph=True)
    unlit = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
    assert not by_light[unlit].any() and by_light[~unlit].all()
    moving = np.unique(fragments.corners)
    if smooth:
        moving = np.unique(scene.mesh.faces[np.isin(scene.mesh.faces, moving).any(axis=1)])
    still = np.setdiff1d(np.arange(len(by_vertex)), moving)
    assert not by_vertex[still].any() and by_vertex[moving].any(dim=1).all()

    background = torch.ones(3, scene.size**2).index_fill(1, fragments.pixels, 0)
    at_an_end = torch.zeros_like(background).index_copy(1, fragments.pixels, image.clamped(*inputs).float())
    assert at_an_end.any()
    for upstream in (background, at_an_end):
        gradients = torch.autograd.grad(values, inputs, upstream.double(), retain_graph=True)
        assert not any(gradient.any() for gradient in gradients)


def test_smooth_radiance_on_an_octahedron_is_that_of_the_direction_to_the_surface():
    """Its vertex normals are its corners, and so the normal at a sample is the point there itself."""
    hull = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]))
    scene = Scene(Mesh.plain(hull.vertices, hull.faces), size=24, samples=1)
    fragments, light = scene.fragments, draw(49, 3)
    albedo = surface_albedo(scene.mesh, fragments, "linear").double()
    lit = radiance(fragments, scene.vertices(), light, albedo, scene.normals(scene.vertices(), smooth=True))
    right, up, back = scene.camera.axes()
    across = fragments.positions().numpy() * scene.camera.width / 2
    # The faces' planes are n · p = 1.
    normals = np.sign(scene.mesh.vertices[fragments.corners[fragments.face]].sum(axis=1))
    foot = across @ np.stack([right, up])
    points = foot + ((1 - (normals * foot).sum(axis=1)) / (normals @ back))[:, None] * back
    inside = (np.sign(points) == normals).all(axis=1)  # corners are snapped to 1/256 of a sample
    assert inside.mean() > 0.95 and len(inside) > 100
    expected = scipy_irradiance(points[inside], light).T
    np.testing.assert_allclose(lit[:, inside], expected, rtol=0, atol=400 * EPS)
