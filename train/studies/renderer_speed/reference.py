"""What the images and gradients of a view converge to: float64, many samples, plain autograd; and how far a path is."""

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from renderer import reference, shading
from renderer.transfer import Operator
from train.studies.renderer_speed.measure import relative_error
from train.studies.renderer_speed.scenes import ALBEDO, CAMERA, View, irradiance
from train.studies.renderer_speed.steps import Shading, seen

RESOLUTION = 2048  # samples per side and rasterisation, at most
SAMPLES = 16  # of a pixel per side and rasterisation, at most
SHIFTS = 4  # rasterisations per side of a pixel, shifted against each other

Irradiance = Callable[[Tensor], Tensor]


class Converged:
    """A view of a closed mesh of one colour: how much of each pixel each face covers, and what follows from it.

    samples: per pixel and side.
    """

    def __init__(self, view: View):
        self.view = view
        each = min(SAMPLES, max(1, RESOLUTION // view.size))
        self.samples = each * SHIFTS
        found = {shift: _coverage(view, each, shift) for shift in product(range(SHIFTS), range(SHIFTS))}
        halves = [[part for shift, part in found.items() if sum(shift) % 2 == half] for half in (0, 1)]
        self._halves = [_mean(half, len(view.mesh.faces)) for half in halves]
        self._whole = _mean([*found.values()], len(view.mesh.faces))

    def image(self, irradiance: Irradiance, vertices: Tensor | None = None) -> Tensor:
        """(3, size, size) radiance under a light given as its irradiance of unit normals (N, 3) → (N, 3).

        vertices: that are shaded, (V, 3), in place of the view's own, which are seen.
        """
        return self._image(irradiance, self._vertices() if vertices is None else vertices, *self._whole)

    def uncertainty(self, irradiance: Irradiance) -> float:
        """The image's own relative error, as half the difference between two halves of its samples."""
        first, second = (self._image(irradiance, self._vertices(), *half) for half in self._halves)
        return float((first - second).norm() / (first + second).norm())

    def light_gradient(self, degree: int = 20) -> Tensor:
        """((degree + 1)², 3): the image gradient pulled back to the light's coefficients."""
        light = torch.zeros((degree + 1) ** 2, 3, dtype=torch.float64, requires_grad=True)
        return self._pulled_back(self.image(lambda normals: reference.irradiance(normals, light)), light)

    def vertex_gradient(self, irradiance: Irradiance) -> Tensor:
        """(V, 3): the image gradient pulled back to the vertices, with visibility held fixed."""
        vertices = self._vertices().requires_grad_()
        return self._pulled_back(self.image(irradiance, vertices), vertices)

    def _vertices(self) -> Tensor:
        return torch.from_numpy(self.view.mesh.vertices)

    def _image(self, irradiance: Irradiance, vertices: Tensor, pixel: Tensor, face: Tensor, weight: Tensor) -> Tensor:
        """Of the faces seen, all of which face the camera, the mesh being closed."""
        seen, face = face.unique(return_inverse=True)
        normals = reference.unit(reference.doubled_area_vectors(vertices[torch.from_numpy(self.view.mesh.faces)[seen]]))
        shade = irradiance(normals) * torch.tensor(ALBEDO, dtype=torch.float64)
        size = self.view.size
        pixels = torch.zeros(size**2, 3, dtype=torch.float64).index_add(0, pixel, shade[face] * weight[:, None])
        return pixels.T.unflatten(1, (size, size))

    def _pulled_back(self, image: Tensor, variable: Tensor) -> Tensor:
        return torch.autograd.grad((image * self.view.image_gradient.cpu()).sum(), variable)[0]


class Exact:
    """What a view converges to under a light: image (3, size, size), by_light (441, 3) and by_vertices (V, 3)."""

    def __init__(self, view: View, irradiance: Irradiance = irradiance):
        converged = Converged(view)
        self._view, self.image = view, converged.image(irradiance)
        self.by_light, self.by_vertices = converged.light_gradient(), converged.vertex_gradient(irradiance)

    def light_errors(self, operator: Operator, light: Tensor) -> dict[str, Any]:
        """Of an operator. Cutting the light off is an error of its image, not of the gradient by what is left."""
        variable = light.clone().requires_grad_()
        radiance = operator.radiance(variable)
        upstream = self._view.upstream(operator.pixels, light.dtype)
        (gradient,) = torch.autograd.grad((radiance * upstream).sum(), variable)
        image = self._view.canvas(radiance.detach(), operator.pixels)
        return self.errors(image, gradient, self.by_light[: len(light)])

    def vertex_errors(
        self, view: View, samples: int, light: Tensor, shade: Shading = shading.radiance
    ) -> dict[str, Any]:
        """Of a way to shade. view: the same one, perhaps with another rasteriser."""
        variable = view.vertices(light.dtype).requires_grad_()
        fragments, albedo, _ = seen(view, samples, variable)
        radiance = shade(fragments, variable, light, albedo)
        upstream = view.upstream(fragments.pixels, light.dtype)
        (gradient,) = torch.autograd.grad((radiance * upstream).sum(), variable)
        return self.errors(view.canvas(radiance.detach(), fragments.pixels), gradient, self.by_vertices)

    def errors(self, image: Tensor, gradient: Tensor, exact_gradient: Tensor) -> dict[str, Any]:
        """As fields of a `Row`."""
        return {
            "image_error": relative_error(image, self.image),
            "gradient_error": relative_error(gradient, exact_gradient),
        }


def _coverage(view: View, samples: int, shift: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(keys pixel × F + face, the share of the pixel that the face covers), samples shifted within their cells."""
    resolution, faces = view.size * samples, view.mesh.faces
    points = CAMERA.project(view.mesh.vertices)
    points[:, :2] += 2 * ((np.array(shift) + 0.5) / SHIFTS - 0.5) / resolution
    ids = view.backend.rasterise(points[None], faces, resolution, closed=view.mesh.closed)[0]
    row, column = np.nonzero(ids >= 0)
    pixel = row // samples * view.size + column // samples
    keys, counts = np.unique(pixel * len(faces) + ids[row, column], return_counts=True)
    return keys, counts / samples**2


def _mean(parts: list[tuple[np.ndarray, np.ndarray]], faces: int) -> tuple[Tensor, Tensor, Tensor]:
    """(pixel (R,), face (R,), weight (R,)), the mean over several samplings."""
    keys, weights = (np.concatenate(values) for values in zip(*parts, strict=True))
    keys, index = np.unique(keys, return_inverse=True)
    weight = np.bincount(index, weights) / len(parts)
    return torch.from_numpy(keys // faces), torch.from_numpy(keys % faces), torch.from_numpy(weight)
