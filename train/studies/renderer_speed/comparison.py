"""Side by side on one scene: this renderer, plain autograd through its shading, and Mitsuba 3."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product

import torch
from torch import Tensor

from renderer import reference, shading
from renderer.transfer import DEGREE
from train.studies.renderer_speed import mitsuba_peer
from train.studies.renderer_speed.bench import SAMPLES, Bench, Entries, row_of
from train.studies.renderer_speed.mitsuba_peer import MitsubaPeer
from train.studies.renderer_speed.reference import Exact
from train.studies.renderer_speed.scenes import View, coefficients
from train.studies.renderer_speed.steps import seen, shade_by_face, vertex_step

OPERATOR = "operator"
ANALYTIC, BY_FACE, BY_SAMPLE = "analytic", "plain autograd, face by face", "plain autograd, sample by sample"
KEPT, REFRESHED = "visibility kept", "re-rasterised"
BY_FACE_KEPT = f"{BY_FACE}, {KEPT}"
COARSER = 2  # samples per side, as attacks have by default
SHADINGS = {ANALYTIC: shading.radiance, BY_FACE: shade_by_face, BY_SAMPLE: reference.radiance}


def by_light(bench: Bench, size: int, with_mitsuba: bool) -> Entries:
    """Radiance of a light of degree 6, and the gradient of a scalar loss on it by the light."""
    view, light = bench.view(bench.plan.mesh, size), bench.light()
    operator, exact = view.operator(SAMPLES), Exact(view, _irradiance)
    upstream, exact_gradient = view.upstream(operator.pixels), exact.by_light[: len(light)]

    def differentiate() -> Tensor:
        operator.radiance(light)
        return operator.light_gradient(upstream)

    errors = exact.light_errors(operator, light)
    row = row_of(view, f"gradient by the light, {size}²", OPERATOR, SAMPLES, **errors)
    yield row, differentiate
    image, by_face = _shaded_by_face(view, light)
    yield replace(row, setting=BY_FACE_KEPT, samples=1, **exact.errors(image, by_face(), exact_gradient)), by_face
    if with_mitsuba:
        peer = MitsubaPeer(view)
        call = partial(peer.light_gradient, view.image_gradient.cpu().float().numpy())
        errors = exact.errors(torch.from_numpy(peer.image()), torch.from_numpy(call()), exact_gradient)
        yield replace(row, setting=mitsuba_peer.NAME, samples=mitsuba_peer.SAMPLES, **errors), call


def _shaded_by_face(view: View, light: Tensor) -> tuple[Tensor, Callable[[], Tensor]]:
    """(the image, what renders it and finds its gradient by the light) without an operator, with visibility kept."""
    vertices = view.vertices(light.dtype)
    fragments, albedo, _ = seen(view, 1, vertices)
    upstream = view.upstream(fragments.pixels, light.dtype)

    def differentiate() -> Tensor:
        variable = light.clone().requires_grad_()
        radiance = shade_by_face(fragments, vertices, variable, albedo)
        return torch.autograd.grad((radiance * upstream).sum(), variable)[0]

    return view.canvas(shade_by_face(fragments, vertices, light, albedo), fragments.pixels), differentiate


def by_vertices(bench: Bench, size: int, with_mitsuba: bool) -> Entries:
    """An image, and the gradient of a scalar loss on it by the vertices."""
    view, light = bench.view(bench.plan.mesh, size), bench.light()
    exact = Exact(view, _irradiance)
    row = row_of(view, f"gradient by the vertices, {size}²", "", 1)
    for samples, (name, shade) in product((1, COARSER), SHADINGS.items()):
        found = replace(row, samples=samples**2, **exact.vertex_errors(view, samples, light, shade))
        if samples == 1:
            yield replace(found, setting=f"{name}, {KEPT}"), vertex_step(view, 1, light, kept=True, shade=shade)
        yield replace(found, setting=rasterised(name, samples)), vertex_step(view, samples, light, shade=shade)
    if with_mitsuba:
        peer = MitsubaPeer(view)
        call = partial(peer.vertex_gradient, view.image_gradient.cpu().float().numpy())
        errors = exact.errors(torch.from_numpy(peer.image()), torch.from_numpy(call()), exact.by_vertices)
        yield replace(row, setting=mitsuba_peer.NAME, samples=mitsuba_peer.SAMPLES, **errors), call


def rasterised(name: str, samples: int) -> str:
    """The row of a shading whose every step rasterises anew, with so many samples per side of a pixel."""
    return f"{name}, {REFRESHED}, {samples}² samples"


def _irradiance(normals: Tensor) -> Tensor:
    """Of the light as Mitsuba is given it, cut off after degree 6."""
    return reference.irradiance(normals, coefficients(DEGREE))
