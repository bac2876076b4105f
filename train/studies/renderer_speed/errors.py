"""How far a path is from what its view converges to: of the image, and of a gradient."""

from typing import Any

import torch
from torch import Tensor

from renderer import shading
from renderer.transfer import Operator
from train.studies.renderer_speed.measure import relative_error
from train.studies.renderer_speed.reference import Converged, Irradiance
from train.studies.renderer_speed.scenes import View, irradiance
from train.studies.renderer_speed.steps import Shading, seen


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
