"""Steps of gradient descent on the light and on the vertices of the benchmark's scene."""

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks import reference
from benchmarks.scene import BACKGROUND, Result, View, VisibleSurface
from renderer.image import tonemap
from renderer.operators.apply import TransferOperator
from renderer.surface import shading
from renderer.visibility.fragments import Fragments

# A function of fragments with S samples and P covered pixels, vertices (V, 3),
# light ((degree + 1)², 3) and albedo (S, 3) to the radiance (3, P).
Shading = Callable[[Fragments, Tensor, Tensor, Tensor], Tensor]


def shade_by_face(fragments: Fragments, vertices: Tensor, light: Tensor, albedo: Tensor) -> Tensor:
    """Compute the same radiance as `shading.radiance`, with operations of torch alone.

    Each face is shaded once, instead of once for each of its samples. This is
    the cheapest way for autograd.

    Args:
        fragments: The S visible samples and the P covered pixels.
        vertices: Vertices of the mesh, shape (V, 3).
        light: SH coefficients, shape ((degree + 1)², 3).
        albedo: Linear albedo of the samples, shape (S, 3).

    Returns:
        Radiance of the covered pixels, shape (3, P).
    """
    normals = reference.face_normals(vertices[fragments.corners])
    irradiance = reference.irradiance(normals * fragments.facing.to(vertices), light)
    radiance_of_samples = irradiance[fragments.sample_to_seen_face] * albedo / fragments.samples**2
    black = radiance_of_samples.new_zeros(len(fragments.pixels), 3)
    return black.index_add(0, fragments.sample_to_pixel, radiance_of_samples).T


ANALYTIC = "analytic"
AUTOGRAD = "plain autograd, face by face"
SHADINGS: dict[str, Shading] = {ANALYTIC: shading.radiance, AUTOGRAD: shade_by_face}


class LightStep:
    """Render a light, and differentiate a scalar loss of the image by the light.

    Args:
        view: View that the operator renders. It has the gradient of the loss by
            the image.
        operator: Operator from the light to the image.
        light: SH coefficients, shape ((degree + 1)², 3).
    """

    def __init__(self, view: View, operator: TransferOperator, light: Tensor):
        self.operator = operator
        self.light = light
        self.image_gradient = view.image_gradient_at(operator.pixels, light.dtype)
        self.coverage = operator.coverage.to(light.dtype)[None]
        self.background = light.new_full((1, 1), BACKGROUND)

    def __call__(self) -> Result:
        """Render the light, and return the radiance and the gradient by the light."""
        light = self.light.clone().requires_grad_()
        radiance = self.operator.radiance(light)
        image = tonemap(radiance, self.coverage, self.background)
        [gradient] = torch.autograd.grad((image * self.image_gradient).sum(), light)
        return Result(self.operator.pixels, radiance.detach(), gradient)


class VertexStep:
    """Render vertices, and differentiate a scalar loss of the image by the vertices.

    Args:
        view: View of the mesh. It has the gradient of the loss by the image.
        samples: Samples per side of a pixel.
        light: SH coefficients, shape ((degree + 1)², 3).
        shade: Shading of the visible samples.
        is_rasterized_once: Whether all steps use the samples that were visible
            at the beginning. False rasterizes the mesh in every step.
    """

    def __init__(
        self,
        view: View,
        samples: int,
        light: Tensor,
        shade: Shading = shading.radiance,
        is_rasterized_once: bool = False,
    ):
        self.view = view
        self.samples = samples
        self.light = light
        self.shade = shade
        self.vertices = view.vertices(light.dtype)
        self.background = light.new_full((1, 1), BACKGROUND)
        self.image_gradient = view.image_gradient.to(light.dtype)
        self.kept_surface: VisibleSurface | None = None
        if is_rasterized_once:
            self.kept_surface = view.visible_surface(samples, self.vertices)

    def __call__(self) -> Result:
        """Render the vertices, and return the radiance and the gradient by the vertices."""
        vertices = self.vertices.clone().requires_grad_()
        surface = self.kept_surface
        if surface is None:
            surface = self.view.visible_surface(self.samples, vertices)
        pixels = surface.fragments.pixels
        radiance = self.shade(surface.fragments, vertices, self.light, surface.albedo)
        image = tonemap(radiance, surface.coverage, self.background)
        loss = (image * self.image_gradient[:, pixels]).sum()
        [gradient] = torch.autograd.grad(loss, vertices)
        return Result(pixels, radiance.detach(), gradient)
