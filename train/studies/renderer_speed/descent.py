"""A small attack on the vertices, whose visibility may be refreshed less often than in every step."""

import torch
from torch import Tensor

from renderer import shading
from renderer.image import develop
from train.studies.renderer_speed.scenes import BACKGROUND, View
from train.studies.renderer_speed.steps import Seen, seen

STEP = 0.05  # L2 norm, over all coordinates


def bend(view: View, samples: int, light: Tensor, target: Tensor, steps: int, every: int) -> tuple[float, Tensor]:
    """(cost, image) after so many steps towards a target (3, size, size), visibility refreshed `every` so many.

    The cost is the mean squared difference; image and cost are of the mesh as it is then seen.
    """
    vertices = view.vertices()
    for step in range(steps):
        if step % every == 0:
            sight = seen(view, samples, vertices)
        variable = vertices.clone().requires_grad_()
        cost = (image(view, sight, variable, light) - target).square().mean()
        (gradient,) = torch.autograd.grad(cost, variable)
        vertices = vertices - STEP * gradient / gradient.norm()
    last = image(view, seen(view, samples, vertices), vertices, light)
    return float((last - target).square().mean()), last


def lit_from_opposite(view: View, samples: int, light: Tensor) -> Tensor:
    """The target: the mesh as it is, under a light whose band 1 has turned around."""
    opposite = light.clone()
    opposite[1:4] *= -1
    return image(view, seen(view, samples, view.vertices()), view.vertices(), opposite)


def image(view: View, sight: Seen, vertices: Tensor, light: Tensor) -> Tensor:
    """(3, size, size) in [0, 1]."""
    fragments, albedo, coverage = sight
    radiance = shading.radiance(fragments, vertices, light, albedo)
    return view.canvas(develop(radiance, coverage, light.new_full((1, 1), BACKGROUND)), fragments.pixels, BACKGROUND)
