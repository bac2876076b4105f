"""Side by side on one scene: this renderer, plain autograd through its shading, and Mitsuba 3."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product

import torch
from torch import Tensor

from renderer import reference, shading
from renderer.transfer import DEGREE, Operator
from train.studies.renderer_speed import mitsuba_peer
from train.studies.renderer_speed.errors import Exact
from train.studies.renderer_speed.mitsuba_peer import MitsubaPeer
from train.studies.renderer_speed.panels import SAMPLES, Bench, Entries, row_of
from train.studies.renderer_speed.results import Row
from train.studies.renderer_speed.scenes import View, coefficients
from train.studies.renderer_speed.steps import seen, shade_by_face, vertex_step

DIRECT, AUTOGRAD, WHOLE = "operator, direct", "operator, autograd", "operator, direct, whole images in and out"
ANALYTIC, BY_FACE, BY_SAMPLE = "analytic", "plain autograd, face by face", "plain autograd, sample by sample"
KEPT, REFRESHED = "visibility kept", "re-rasterised"
BY_FACE_KEPT = f"{BY_FACE}, {KEPT}"

COARSER, FINER = 2, 4  # samples per side: as attacks have by default, and as many in all as Mitsuba has
SHADINGS = {ANALYTIC: shading.radiance, BY_FACE: shade_by_face, BY_SAMPLE: reference.radiance}


def by_light(bench: Bench, size: int, with_mitsuba: bool) -> list[Row]:
    """Radiance of a light of degree 6, and the gradient of a scalar loss on it by the light."""

    def entries() -> Entries:
        view, light = bench.view(bench.plan.mesh, size), bench.light()
        operator, exact = view.operator(SAMPLES), Exact(view, _irradiance)
        row = row_of(view, f"gradient by the light, {size}²", "", SAMPLES, **exact.light_errors(operator, light))
        for name, call in _light_gradients(view, operator, light).items():
            yield replace(row, setting=name), call
        image, by_face = _shaded_by_face(view, light)
        errors = exact.errors(image, by_face(), exact.by_light[: len(light)])
        yield replace(row, setting=BY_FACE_KEPT, samples=1, **errors), by_face
        if with_mitsuba:
            peer = MitsubaPeer(view)
            differentiate = partial(peer.light_gradient, view.image_gradient.cpu().float().numpy())
            image, gradient = torch.from_numpy(peer.image()), torch.from_numpy(differentiate())
            errors = exact.errors(image, gradient, exact.by_light[: len(light)])
            yield replace(row, setting=mitsuba_peer.NAME, samples=mitsuba_peer.SAMPLES, **errors), differentiate

    return bench.timed(entries())


def _light_gradients(view: View, operator: Operator, light: Tensor) -> dict[str, Callable[[], Tensor]]:
    upstream, image_gradient = view.upstream(operator.pixels), view.image_gradient.flatten(1).float()

    def direct() -> Tensor:
        operator.radiance(light)
        return operator.light_gradient(upstream)

    def autograd() -> Tensor:
        variable = light.clone().requires_grad_()
        return torch.autograd.grad((operator.radiance(variable) * upstream).sum(), variable)[0]

    def whole() -> Tensor:
        view.canvas(operator.radiance(light), operator.pixels)
        return operator.light_gradient(image_gradient.index_select(1, operator.pixels))

    return {DIRECT: direct, AUTOGRAD: autograd, WHOLE: whole}


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


def by_vertices(bench: Bench, size: int, with_mitsuba: bool) -> list[Row]:
    """An image, and the gradient of a scalar loss on it by the vertices."""

    def entries() -> Entries:
        view, light = bench.view(bench.plan.mesh, size), bench.light()
        exact = Exact(view, _irradiance)
        row = row_of(view, f"gradient by the vertices, {size}²", "", 1)
        for samples, name in (*product((1, COARSER), SHADINGS), (FINER, ANALYTIC)):
            shade = SHADINGS[name]
            found = replace(row, samples=samples**2, **exact.vertex_errors(view, samples, light, shade))
            if samples == 1:
                yield replace(found, setting=f"{name}, {KEPT}"), vertex_step(view, 1, light, kept=True, shade=shade)
            yield replace(found, setting=rasterised(name, samples)), vertex_step(view, samples, light, shade=shade)
        if with_mitsuba:
            peer = MitsubaPeer(view)
            call = partial(peer.vertex_gradient, view.image_gradient.cpu().float().numpy())
            errors = exact.errors(torch.from_numpy(peer.image()), torch.from_numpy(call()), exact.by_vertices)
            yield replace(row, setting=mitsuba_peer.NAME, samples=mitsuba_peer.SAMPLES, **errors), call

    return bench.timed(entries())


def rasterised(name: str, samples: int) -> str:
    """The row of a shading whose every step rasterises anew, with so many samples per side of a pixel."""
    return f"{name}, {REFRESHED}, {samples}² samples"


def _irradiance(normals: Tensor) -> Tensor:
    """Of the light as Mitsuba is given it, cut off after degree 6."""
    return reference.irradiance(normals, coefficients(DEGREE))
