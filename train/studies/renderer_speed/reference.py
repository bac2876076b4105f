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
        self._pixel, self._face, self._weight = _mean([*found.values()], len(view.mesh.faces))
        self._seen = torch.unique(self._face)
        self._faces = torch.from_numpy(view.mesh.faces)

    def image(self, irradiance: Irradiance) -> Tensor:
        """(3, size, size) radiance under a light given as its irradiance of unit normals (N, 3) → (N, 3)."""
        return self._image(irradiance, self._pixel, self._face, self._weight)

    def uncertainty(self, irradiance: Irradiance) -> float:
        """The image's own relative error, as half the difference between two halves of its samples."""
        first, second = (self._image(irradiance, *half) for half in self._halves)
        return float((first - second).norm() / (first + second).norm())

    def light_gradient(self, degree: int = 20) -> Tensor:
        """((degree + 1)², 3): the image gradient pulled back to the light's coefficients."""
        light = torch.zeros((degree + 1) ** 2, 3, dtype=torch.float64, requires_grad=True)
        shade = reference.irradiance(self._normals(self._vertices()), light)
        return torch.autograd.grad((shade * self._pulled()).sum(), light)[0]

    def vertex_gradient(self, irradiance: Irradiance) -> Tensor:
        """(V, 3): the image gradient pulled back to the vertices, with visibility held fixed."""
        vertices = self._vertices().requires_grad_()
        return torch.autograd.grad((irradiance(self._normals(vertices)) * self._pulled()).sum(), vertices)[0]

    def _vertices(self) -> Tensor:
        return torch.from_numpy(self.view.mesh.vertices)

    def _normals(self, vertices: Tensor) -> Tensor:
        """(G, 3) of the faces seen; all of them face the camera, the mesh being closed."""
        return reference.unit(reference.doubled_area_vectors(vertices[self._faces[self._seen]]))

    def _image(self, irradiance: Irradiance, pixel: Tensor, face: Tensor, weight: Tensor) -> Tensor:
        shade = torch.zeros(len(self._faces), 3, dtype=torch.float64)
        shade[self._seen] = irradiance(self._normals(self._vertices())) * torch.tensor(ALBEDO, dtype=torch.float64)
        size = self.view.size
        pixels = torch.zeros(size**2, 3, dtype=torch.float64).index_add(0, pixel, shade[face] * weight[:, None])
        return pixels.T.unflatten(1, (size, size))

    def _pulled(self) -> Tensor:
        """(G, 3) the image gradient's sum over what each seen face covers, times albedo."""
        image_gradient = self.view.image_gradient.cpu().flatten(1).T
        sums = torch.zeros(len(self._faces), 3, dtype=torch.float64)
        sums.index_add_(0, self._face, image_gradient[self._pixel] * self._weight[:, None])
        return sums[self._seen] * torch.tensor(ALBEDO, dtype=torch.float64)


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
