"""What is timed: steps of attacks on the light and on the vertices, and descents, without a classifier."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from renderer import reference, shading
from renderer.albedo import surface_albedo
from renderer.fragments import Fragments
from renderer.image import develop
from renderer.transfer import Operator
from train.studies.renderer_speed.scenes import BACKGROUND, View

LAYOUTS = ("one channel", "three channels", "pixel-major")  # the default first
STEP = 0.05  # of a descent: L2 norm, over all coordinates

Shading = Callable[[Fragments, Tensor, Tensor, Tensor], Tensor]
Seen = tuple[Fragments, Tensor, Tensor]  # with albedo (S, 3) and coverage (1, P)


def light_step(view: View, operator: Operator, lights: Tensor) -> Callable[[], Tensor]:
    """Lights (..., 49, 3) → image → gradient of a scalar loss by the lights, by autograd."""
    upstream = view.upstream(operator.pixels, lights.dtype)
    coverage, background = operator.coverage.to(lights.dtype)[None], lights.new_full((1, 1), BACKGROUND)

    def step() -> Tensor:
        variable = lights.clone().requires_grad_()
        image = develop(operator.radiance(variable), coverage, background)
        return torch.autograd.grad((image * upstream).sum(), variable)[0]

    return step


def vertex_step(
    view: View, samples: int, light: Tensor, kept: bool = False, shade: Shading = shading.radiance
) -> Callable[[], Tensor]:
    """Vertices (V, 3), in the light's dtype → image → gradient of a scalar loss by the vertices.

    kept: visibility and albedo stay as they were at first; otherwise every step projects and rasterises the mesh anew.
    """
    vertices, background = view.vertices(light.dtype), light.new_full((1, 1), BACKGROUND)
    image_gradient = view.image_gradient.flatten(1).to(light.dtype)
    before = seen(view, samples, vertices)

    def step() -> Tensor:
        variable = vertices.clone().requires_grad_()
        fragments, albedo, coverage = before if kept else seen(view, samples, variable)
        image = develop(shade(fragments, variable, light, albedo), coverage, background)
        loss = (image * image_gradient.index_select(1, fragments.pixels)).sum()
        return torch.autograd.grad(loss, variable)[0]

    return step


def seen(view: View, samples: int, vertices: Tensor) -> Seen:
    """The mesh with its vertices there: projected, rasterised, and its albedo looked up."""
    fragments = view.fragments(samples, vertices.detach().double().cpu().numpy())
    albedo = surface_albedo(view.mesh, fragments, "linear").to(vertices.dtype)
    return fragments, albedo, fragments.coverage.to(vertices.dtype)[None]


def shade_by_face(fragments: Fragments, vertices: Tensor, light: Tensor, albedo: Tensor) -> Tensor:
    """`reference.radiance` with each face shaded once, not each sample: plain autograd at its cheapest."""
    normals = reference.unit(reference.doubled_area_vectors(vertices[fragments.corners]))
    irradiance = reference.irradiance(normals * fragments.facing.to(vertices), light)
    shade = irradiance[fragments.face] * albedo / fragments.samples**2
    return shade.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel, shade).T


def laid_out(wide: Operator, layout: str, dtype: torch.dtype) -> Operator:
    """A one-channel operator in another dtype and layout; pixel-major: a pixel's coefficients are neighbours."""
    transfer, albedo = wide.transfer, wide.albedo
    if layout == "three channels":
        transfer, albedo = transfer * albedo[:, None], torch.ones_like(albedo)
    if layout == "pixel-major":
        transfer = transfer.mT.contiguous().mT
    return replace(wide, transfer=transfer.to(dtype), albedo=albedo.to(dtype), coverage=wide.coverage.to(dtype))


def bend(view: View, samples: int, light: Tensor, target: Tensor, steps: int, every: int) -> tuple[float, Tensor]:
    """(cost, image) after so many steps towards a target (3, size, size), visibility refreshed `every` so many.

    The cost is the mean squared difference; image and cost are of the mesh as it is then seen.
    """
    vertices = view.vertices()
    for step in range(steps):
        if step % every == 0:
            sight = seen(view, samples, vertices)
        variable = vertices.clone().requires_grad_()
        cost = (_image(view, sight, variable, light) - target).square().mean()
        (gradient,) = torch.autograd.grad(cost, variable)
        vertices = vertices - STEP * gradient / gradient.norm()
    last = _image(view, seen(view, samples, vertices), vertices, light)
    return float((last - target).square().mean()), last


def lit_from_opposite(view: View, samples: int, light: Tensor) -> Tensor:
    """The target: the mesh as it is, under a light whose band 1 has turned around."""
    opposite = light.clone()
    opposite[1:4] *= -1
    return _image(view, seen(view, samples, view.vertices()), view.vertices(), opposite)


def _image(view: View, sight: Seen, vertices: Tensor, light: Tensor) -> Tensor:
    """(3, size, size) in [0, 1]."""
    fragments, albedo, coverage = sight
    radiance = shading.radiance(fragments, vertices, light, albedo)
    return view.canvas(develop(radiance, coverage, light.new_full((1, 1), BACKGROUND)), fragments.pixels, BACKGROUND)
