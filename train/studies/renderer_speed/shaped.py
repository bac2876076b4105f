"""Building an operator with shadows and bounces: time against error by samples and directions, of a cup."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from renderer.mesh import normalise
from renderer.shapes import solid
from renderer.subdivision import subdivide
from renderer.transfer import Operator
from renderer.transport import rays
from train.studies.quadrature import quadrature
from train.studies.renderer_speed.measure import relative_error
from train.studies.renderer_speed.panels import SAMPLES, Bench, Entries, row_of
from train.studies.renderer_speed.results import Row
from train.studies.renderer_speed.scenes import View

TRANSPORTS = ("shadows", "bounces:3")
FINEST = 16  # samples per side of a pixel


def builds(bench: Bench) -> Iterator[list[Row]]:
    """A panel for each transport. The reference is the same operator with many more rays, patches and samples, whose
    light is cut after degree 6, too."""
    plan = bench.plan
    cup = normalise(subdivide(normalise(solid("cup", 0)), plan.mesh))
    for transport in TRANSPORTS:
        view = replace(bench.view(plan.mesh, plan.small), mesh=cup, transport=transport)
        yield bench.timed(_entries(bench, view), share=1 / 5)


def _entries(bench: Bench, view: View) -> Entries:
    with quadrature(*bench.plan.converged):
        exact = view.operator(FINEST)
    panel = f"building an operator with {view.transport}, {view.size}²"
    for directions in bench.plan.directions:
        for samples in bench.plan.shaped_samples:
            chosen = (directions, samples) == (rays.DIRECTIONS, SAMPLES)
            setting = f"{samples}² samples, {directions:,} directions"
            errors = _errors(bench, view, _built(view, samples, directions), exact)
            row = row_of(view, panel, setting, samples, default=chosen, rasteriser=view.backend.name, **errors)
            yield row, partial(_built, view, samples, directions)


def _built(view: View, samples: int, directions: int) -> Operator:
    with quadrature(directions):
        return view.operator(samples)


def _errors(bench: Bench, view: View, operator: Operator, exact: Operator) -> dict[str, float]:
    light = bench.light()
    images = [view.canvas(each.radiance(light), each.pixels) for each in (operator, exact)]
    slopes = [each.light_gradient(view.upstream(each.pixels)) for each in (operator, exact)]
    return {"image_error": relative_error(*images), "gradient_error": relative_error(*slopes)}
