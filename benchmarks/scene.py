"""The scene of the renderer's benchmark: an ellipsoid under a probe and a sun, and the image it converges to."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from benchmarks.common import relative_error
from renderer import reference
from renderer.albedo import surface_albedo
from renderer.camera import OrthographicCamera
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings
from renderer.light.basis import Harmonics
from renderer.light.harmonics import basis
from renderer.light.presets import probe
from renderer.mesh import Mesh
from renderer.rasterizer import Rasterizer
from renderer.transfer import DEGREE, TransferOperator, build_operators

SAMPLES = ImageSettings().samples  # the renderer's default, per side of a pixel
ALBEDO = (0.8, 0.5, 0.3)
CAMERA = OrthographicCamera(1.0, 0.5, 2.4)
SUN_FROM = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
SUN = torch.tensor([0.9, 0.8, 0.6], dtype=torch.float64)  # irradiance head on
PROBE = probe("grace")[:9].double() / 2

Row = dict[str, Any]
Shading = Callable[[Fragments, Tensor, Tensor, Tensor], Tensor]


def ellipsoid(subdivisions: int) -> Mesh:
    """A closed mesh of 10·4^subdivisions + 2 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh.plain(ball.vertices * (1.0, 0.9, 0.8), ball.faces, ALBEDO)


def coefficients(degree: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    """The light's ((degree + 1)², 3), cut off after `degree`."""
    light = basis(SUN_FROM, degree)[:, None] * SUN
    count = min(len(PROBE), len(light))
    light[:count] += PROBE[:count]
    return light.to(device, dtype)


def whole_irradiance(normals: Tensor) -> Tensor:
    """(N, 3) at unit normals (N, 3) float64: the sun's series sums to the clamped cosine."""
    return reference.irradiance(normals, PROBE) + (normals @ SUN_FROM).clamp(min=0)[:, None] * SUN


def cut_irradiance(normals: Tensor) -> Tensor:
    """Of the light cut off after the default degree, as every renderer in a comparison is given it."""
    return reference.irradiance(normals, coefficients(DEGREE))


@dataclass(frozen=True)
class View:
    """One mesh from one camera at one size."""

    mesh: Mesh
    size: int
    rasterizer: Rasterizer
    device: str = "cpu"

    def operator(
        self, samples: int = SAMPLES, degree: int = DEGREE, dtype: torch.dtype = torch.float32
    ) -> TransferOperator:
        settings, light = ImageSettings(self.size, samples), Harmonics(degree)
        [operator] = build_operators(self.mesh, [CAMERA], settings, self.rasterizer, basis=light, dtype=dtype)
        return operator.to(self.device)

    def rasterized(self, samples: int, vertices: Tensor) -> tuple[Fragments, Tensor, Tensor]:
        """(fragments, albedo (S, 3), coverage (1, P)) of the mesh with its vertices there."""
        positions, settings = vertices.detach().double().cpu().numpy(), ImageSettings(self.size, samples)
        [found] = build_fragments(positions, self.mesh.faces, [CAMERA], settings, self.rasterizer, self.mesh.closed)
        fragments = found.to(self.device)
        albedo = surface_albedo(self.mesh, fragments, "linear").to(vertices.dtype)
        return fragments, albedo, fragments.coverage.to(vertices.dtype)[None]

    def vertices(self, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.from_numpy(self.mesh.vertices).to(self.device, dtype)

    def canvas(self, values: Tensor, pixels: Tensor) -> Tensor:
        """(3, size, size) with values (3, P) where the mesh is, else 0."""
        return values.new_zeros(3, self.size**2).index_copy(1, pixels, values).unflatten(1, (self.size, self.size))

    @cached_property
    def image_gradient(self) -> Tensor:
        """(3, size, size) float64 normal numbers: the gradient of a loss by the image."""
        generator = torch.Generator().manual_seed(0)
        return torch.randn(3, self.size, self.size, dtype=torch.float64, generator=generator).to(self.device)

    def upstream(self, pixels: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(3, P) the image's gradient at the covered pixels."""
        return self.image_gradient.flatten(1)[:, pixels].to(dtype)


# ---------------------------------------------------------------------------- reference


class Converged:
    """Image and gradients of a view to which all methods converge: float64, plain autograd, up to 64² samples."""

    shifts, finest, resolution = 4, 16, 2048  # rasterizations per side; samples of a pixel and of an image in each

    def __init__(self, view: View, irradiance: Callable[[Tensor], Tensor] = whole_irradiance):
        self._view = view
        self._pixel, self._face, self._weight = self._coverage()
        gradient = view.image_gradient.cpu()
        light = torch.zeros(21**2, 3, dtype=torch.float64, requires_grad=True)
        vertices = torch.from_numpy(view.mesh.vertices).requires_grad_()
        image = self.render(lambda normals: reference.irradiance(normals, light), vertices.detach())
        [self.by_light] = torch.autograd.grad((image * gradient).sum(), light)
        image = self.render(irradiance, vertices)
        [self.by_vertices] = torch.autograd.grad((image * gradient).sum(), vertices)
        self.image = image.detach()

    def _coverage(self) -> tuple[Tensor, Tensor, Tensor]:
        """(pixel, face, weight): the share of each pixel that each face covers, in several shifted rasterizations."""
        size, faces, closed = self._view.size, self._view.mesh.faces, self._view.mesh.closed
        samples = min(self.finest, max(1, self.resolution // size))
        keys = []
        for shift in product(range(self.shifts), repeat=2):
            points = CAMERA.project(self._view.mesh.vertices)
            points[:, :2] += 2 * ((np.array(shift) + 0.5) / self.shifts - 0.5) / (size * samples)
            ids = self._view.rasterizer.rasterize(points[None], faces, size * samples, closed=closed)[0]
            row, column = np.nonzero(ids >= 0)
            keys.append((row // samples * size + column // samples) * len(faces) + ids[row, column])
        key, count = np.unique(np.concatenate(keys), return_counts=True)
        weight = count / (self.shifts * samples) ** 2
        return torch.from_numpy(key // len(faces)), torch.from_numpy(key % len(faces)), torch.from_numpy(weight)

    def render(self, irradiance: Callable[[Tensor], Tensor], vertices: Tensor) -> Tensor:
        """(3, size, size) radiance; visibility is the view's. The mesh is closed: every visible face faces us."""
        faces, index = self._face.unique(return_inverse=True)
        corners = vertices[torch.from_numpy(self._view.mesh.faces)[faces]]
        normals = reference.unit(reference.doubled_area_vectors(corners))
        shade = (irradiance(normals) * torch.tensor(ALBEDO, dtype=torch.float64))[index] * self._weight[:, None]
        size = self._view.size
        return (
            torch.zeros(size**2, 3, dtype=torch.float64).index_add(0, self._pixel, shade).T.unflatten(1, (size, size))
        )

    def errors(self, image: Tensor, gradient: Tensor, expected: Tensor) -> Row:
        return {
            "image_error": relative_error(image, self.image),
            "gradient_error": relative_error(gradient, expected),
        }

    def of_operator(self, operator: TransferOperator, light: Tensor) -> Row:
        """The gradient is compared on the coefficients that the light has."""
        variable = light.clone().requires_grad_()
        radiance = operator.radiance(variable)
        upstream = self._view.upstream(operator.pixels, light.dtype)
        [gradient] = torch.autograd.grad((radiance * upstream).sum(), variable)
        image = self._view.canvas(radiance.detach(), operator.pixels)
        return self.errors(image, gradient, self.by_light[: len(light)])

    def of_shading(self, samples: int, light: Tensor, shade: Shading) -> Row:
        variable = self._view.vertices(light.dtype).requires_grad_()
        fragments, albedo, _ = self._view.rasterized(samples, variable)
        radiance = shade(fragments, variable, light, albedo)
        [gradient] = torch.autograd.grad(
            (radiance * self._view.upstream(fragments.pixels, light.dtype)).sum(), variable
        )
        return self.errors(self._view.canvas(radiance.detach(), fragments.pixels), gradient, self.by_vertices)
