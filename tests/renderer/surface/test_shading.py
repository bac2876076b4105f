"""Irradiance against SciPy, and derivatives of whole images against central differences."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, fragments_of, patchwork, scipy_irradiance
from torch import Tensor

from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.image import background_term, tonemap
from renderer.light.harmonics import DIFFUSE_DEGREE, basis, lambertian_factors
from renderer.mesh import Mesh
from renderer.normals import normal_groups
from renderer.settings import MAX_DEGREE, ImageSettings
from renderer.surface import shading
from renderer.surface.albedo import surface_albedo
from renderer.surface.shading import radiance
from renderer.visibility.fragments import Fragments

EPS = torch.finfo(torch.float64).eps
# Poles and directions on the equator, with both signs of zero.
SPECIAL = [[0.0, 0.0, 1.0], [-0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-1.0, -0.0, 0.0]]
SPECIAL += [[0.0, -1.0, -0.0], [1e-9, 0.0, 1.0]]


def irradiance(normals: Tensor, light: Tensor) -> Tensor:
    return shading.irradiance(normals.T, light)


def some_normals(count: int) -> Tensor:
    return torch.cat([3 * draw(count, 3), torch.tensor(SPECIAL, dtype=torch.float64)])


@pytest.mark.parametrize("degree", [0, 1, 3, 6, DIFFUSE_DEGREE, DIFFUSE_DEGREE + 1, MAX_DEGREE - 1])
def test_irradiance_is_scipys_of_degrees_up_to_the_diffuse_one(degree):
    normals = some_normals(100)
    light = draw((degree + 1) ** 2, 3)
    lower_degrees = light[: (DIFFUSE_DEGREE + 1) ** 2]
    expected = scipy_irradiance(normals, lower_degrees).T
    np.testing.assert_allclose(irradiance(normals, light), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 6, DIFFUSE_DEGREE + 1])
def test_derivatives_of_irradiance_are_central_differences(degree):
    normals = some_normals(4).requires_grad_()
    light = draw((degree + 1) ** 2, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(irradiance, (normals, light), fast_mode=degree > 2)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_short_and_zero_normals_have_finite_irradiance_and_no_gradient_that_is_nan(dtype):
    """A gradient is of the order of 1 / length, so it may overflow. That of zero is zero."""
    tiny = torch.finfo(dtype).smallest_normal
    lengths = torch.tensor([1, 64, 1 / 16, 0]).repeat_interleave(len(SPECIAL))[:, None]
    directions = torch.tensor(SPECIAL).repeat(4, 1)
    normals = ((directions * lengths).to(dtype) * tiny).requires_grad_()
    values = irradiance(normals, draw(49, 3).to(dtype))
    [gradient] = torch.autograd.grad(values.sum(), normals)
    assert values.isfinite().all()
    assert not gradient.isnan().any()
    assert not gradient[-len(SPECIAL) :].any()


def test_a_zero_normal_has_the_irradiance_of_the_harmonics_at_the_zero_vector():
    """An operator holds this value, and `render` shows the same."""
    light = draw(49, 3)
    zero_normal = torch.zeros(1, 3, dtype=torch.float64)
    rows = basis(zero_normal, 6) * lambertian_factors(6)
    expected = (rows @ light).T
    torch.testing.assert_close(irradiance(zero_normal, light), expected, rtol=0, atol=1e-12)


def test_second_derivatives_are_refused_instead_of_wrong():
    light = draw(49, 3).requires_grad_()
    normals = draw(5, 3).requires_grad_()
    total = irradiance(normals, light).pow(2).sum()
    [gradient] = torch.autograd.grad(total, normals, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        gradient.sum().backward()


def dented_icosahedron(face_count: int = 20, crease: float = 180) -> Mesh:
    """Return a dented icosahedron, or an open part of it, which is sharp beyond an angle."""
    shape = trimesh.creation.icosahedron()
    mesh = patchwork(shape.vertices, shape.faces[:face_count])
    return replace(mesh, normal_ids=normal_groups(mesh.vertices, mesh.faces, crease=crease))


IN_FRONT = OrthographicCamera(57.3, 22.9, 2.2)
BEHIND = OrthographicCamera(122.7, 202.9, 2.2)
CLOSE = PerspectiveCamera(57.3, 22.9, 2.2, distance=1.8)


@dataclass(frozen=True)
class Scene:
    """A mesh before a camera, with flat or smooth normals."""

    mesh: Mesh
    camera: Camera = IN_FRONT
    size: int = 5
    samples: int = 3
    smooth: bool = False

    @cached_property
    def fragments(self) -> Fragments:
        return fragments_of(self.mesh, self.camera, ImageSettings(self.size, self.samples))

    def vertices(self) -> Tensor:
        return torch.from_numpy(self.mesh.vertices.copy())

    def normals(self, vertices: Tensor) -> Tensor | None:
        """Return the normals that `radiance` takes. Flat normals are None."""
        if not self.smooth:
            return None
        return shading.normals_in_sight(self.mesh, self.fragments, vertices)


SCENES = {
    "closed": Scene(dented_icosahedron()),
    "closed, partly sharp": Scene(dented_icosahedron(crease=50), smooth=True),
    "open, from behind, smooth": Scene(dented_icosahedron(13), BEHIND, smooth=True),
    "one sample per pixel": Scene(dented_icosahedron(), size=9, samples=1),
    "from close by": Scene(dented_icosahedron(), CLOSE),
}


class Image:
    """Image values (3, size²) as a function of vertices, light and textures."""

    def __init__(self, scene: Scene, encoding: str) -> None:
        self.scene = scene
        self.encoding = encoding

    def inputs(self) -> list[Tensor]:
        """Return vertices (V, 3), light (49, 3) and two textures; some values are clamped."""
        light = 1.5 * draw(49, 3, seed=1)
        light[0] = 1.0
        textures = [torch.from_numpy(texture / 255) for texture in self.scene.mesh.textures]
        tensors = [self.scene.vertices(), light, *textures]
        return [tensor.requires_grad_() for tensor in tensors]

    def tonemap_arguments(self, vertices: Tensor, light: Tensor, *textures: Tensor) -> tuple:
        """Return radiance (3, P), coverage (1, P), the background (3, 1) and the encoding."""
        fragments = self.scene.fragments
        albedo = surface_albedo(self.scene.mesh, fragments, self.encoding, textures)
        values = radiance(fragments, vertices, light, albedo, self.scene.normals(vertices))
        background = torch.tensor([[0.3], [0.6], [0.1]], dtype=values.dtype)
        coverage = fragments.coverage[None].to(values)
        return values, coverage, background, self.encoding

    def __call__(self, *inputs: Tensor) -> Tensor:
        arguments = self.tonemap_arguments(*inputs)
        _, _, background, _ = arguments
        canvas = background.expand(3, self.scene.size**2)
        return canvas.index_copy(1, self.scene.fragments.pixels, tonemap(*arguments))

    def is_clamped(self, *inputs: Tensor) -> Tensor:
        values, *around = self.tonemap_arguments(*inputs)
        composite = values + background_term(*around)
        return (composite < 0) | (composite > 1)


def move(inputs: Sequence[Tensor], steps: Sequence[Tensor], distance: float) -> list[Tensor]:
    return [tensor.detach() + distance * step for tensor, step in zip(inputs, steps, strict=True)]


def fourth_order_difference(function, inputs, steps, length) -> Tensor:
    near = function(*move(inputs, steps, length)) - function(*move(inputs, steps, -length))
    far = function(*move(inputs, steps, 2 * length)) - function(*move(inputs, steps, -2 * length))
    return (8 * near - far) / (12 * length)


# The indices of the moved inputs: vertices, light and textures alone and at once.
MOVED = [[0], [1], [2], [3], [0, 1, 2, 3]]


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_derivatives_of_images_are_central_differences(scene):
    """A few hundred values round by 1e-16 / length, with a length of 1e-5."""
    image = Image(scene, "srgb" if scene.smooth else "linear")
    inputs = image.inputs()
    assert image.is_clamped(*inputs).any()
    upstream = draw(3, scene.size**2, seed=2)
    gradients = torch.autograd.grad(image(*inputs), inputs, upstream)
    directions = [draw(*tensor.shape, seed=3 + index) for index, tensor in enumerate(inputs)]
    for moved in MOVED:
        steps = [direction * (index in moved) for index, direction in enumerate(directions)]
        # The finite difference must not cross the value at which `is_clamped` changes.
        for distance in (2e-5, -2e-5):
            clamped_after = image.is_clamped(*move(inputs, steps, distance))
            assert torch.equal(clamped_after, image.is_clamped(*inputs))
        difference = fourth_order_difference(image, inputs, steps, 1e-5)
        expected = float((difference * upstream).sum())
        products = zip(gradients, steps, strict=True)
        found = sum(float((gradient * step).sum()) for gradient, step in products)
        assert found == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_smooth_radiance_on_an_octahedron_is_that_of_the_direction_to_the_surface():
    """The vertex normals are the corners, so the normal at a sample is the point itself."""
    hull = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]))
    mesh = Mesh.plain(hull.vertices, hull.faces, crease=180)
    scene = Scene(mesh, size=24, samples=1, smooth=True)
    fragments = scene.fragments
    vertices = scene.vertices()
    light = draw(49, 3)
    albedo = surface_albedo(mesh, fragments, "linear").double()
    found = radiance(fragments, vertices, light, albedo, scene.normals(vertices))

    right, up, back = scene.camera.axes()
    in_plane = fragments.positions().numpy() * scene.camera.width / 2 @ np.stack([right, up])
    # The plane of a face with signs n of its octant is n · p = 1.
    corners = mesh.vertices[fragments.corners[fragments.sample_to_seen_face]]
    octants = np.sign(corners.sum(axis=1))
    depths = (1 - (octants * in_plane).sum(axis=1)) / (octants @ back)
    points = in_plane + depths[:, None] * back
    # Corners are snapped to 1/256 of a sample, so a few points are beside their face.
    is_inside = (np.sign(points) == octants).all(axis=1)
    assert len(is_inside) > 100
    assert is_inside.mean() > 0.95
    expected = scipy_irradiance(points[is_inside], light).T
    np.testing.assert_allclose(found[:, is_inside], expected, rtol=0, atol=400 * EPS)
