"""Choices at one workload, panel by panel, each with a front of time and error."""

from dataclasses import replace
from functools import partial
from itertools import product

import torch
from torch import Tensor

from renderer.mesh import normalise
from renderer.shapes import solid
from renderer.subdivision import subdivide
from renderer.transfer import DEGREE, Operator
from renderer.transport import rays
from train.studies.quadrature import quadrature
from train.studies.renderer_speed.bench import SAMPLES, Bench, Entries, row_of
from train.studies.renderer_speed.measure import relative_error
from train.studies.renderer_speed.reference import Exact
from train.studies.renderer_speed.results import Row
from train.studies.renderer_speed.steps import LAYOUTS, bend, laid_out, light_step, lit_from_opposite, vertex_step

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float64": torch.float64}  # the default first
TRANSPORTS = ("shadows", "bounces:3")
FINEST = 16  # samples per side of a pixel


def measure(bench: Bench) -> list[list[Row]]:
    """All panels."""
    plan = bench.plan
    steps = [bench.timed(light_steps(bench, size), share=3) for size in (plan.small, plan.large)]
    geometry = [bench.timed(builds(bench)), bench.timed(vertex_steps(bench), share=1 / 3)]
    return [*steps, *geometry, *(bench.timed(shaped_builds(bench, each), share=1 / 5) for each in TRANSPORTS)]


def light_steps(bench: Bench, size: int) -> Entries:
    """A step of an attack on the light, by degree, dtype and layout of the operator."""
    view = bench.view(bench.plan.mesh, size)
    exact, chosen = Exact(view), (DEGREE, next(iter(DTYPES)), LAYOUTS[0])
    for degree in bench.plan.degrees:
        wide = view.operator(SAMPLES, degree, torch.float64)
        for (name, dtype), layout in product(DTYPES.items(), LAYOUTS):
            light = bench.light(degree, torch.promote_types(dtype, torch.float32))
            operator = laid_out(wide, layout, dtype)
            setting, default = f"degree {degree}, {name}, {layout}", (degree, name, layout) == chosen
            errors = exact.light_errors(operator, light)
            row = row_of(view, f"light step, {size}²", setting, SAMPLES, default=default, degree=degree, **errors)
            yield row, light_step(view, operator, light)


def builds(bench: Bench) -> Entries:
    """An operator for one view, by samples, degree and rasteriser."""
    view, plan = bench.view(bench.plan.mesh, bench.plan.small), bench.plan
    exact, panel = Exact(view), f"building an operator, {view.size}²"
    for choice in product(bench.backends, plan.samples, plan.degrees):
        backend, samples, degree = choice
        drawn, default = replace(view, backend=backend), choice == (bench.backends[0], SAMPLES, DEGREE)
        setting = f"{samples}² samples, degree {degree}, {backend.name}"
        errors = exact.light_errors(drawn.operator(samples, degree), bench.light(degree))
        row = row_of(view, panel, setting, samples, default=default, degree=degree, **errors)
        yield row, partial(drawn.operator, samples, degree)


def vertex_steps(bench: Bench) -> Entries:
    """A step of an attack on the vertices that rasterises anew, by samples, degree, dtype and rasteriser."""
    view, plan = bench.view(bench.plan.mesh, bench.plan.small), bench.plan
    exact, panel = Exact(view), f"vertex step, {view.size}²"
    for choice in product(bench.backends, plan.samples, plan.degrees[:4], ("float32", "float64")):
        backend, samples, degree, name = choice
        drawn, light = replace(view, backend=backend), bench.light(degree, DTYPES[name])
        setting = f"{samples}² samples, degree {degree}, {name}, {backend.name}"
        default = choice == (bench.backends[0], SAMPLES, DEGREE, "float32")
        errors = exact.vertex_errors(drawn, samples, light)
        row = row_of(view, panel, setting, samples, default=default, degree=degree, **errors)
        yield row, vertex_step(drawn, samples, light)


def shaped_builds(bench: Bench, transport: str) -> Entries:
    """An operator of a cup with shadows or bounces, by samples and directions.

    The reference is the same operator with many more rays, patches and samples, whose light is cut after degree 6, too.
    """
    plan, light = bench.plan, bench.light()
    cup = normalise(subdivide(normalise(solid("cup", 0)), plan.mesh))
    view = replace(bench.view(plan.mesh, plan.small), mesh=cup, transport=transport)

    def built(samples: int, directions: int) -> Operator:
        with quadrature(directions):
            return view.operator(samples)

    def seen(operator: Operator) -> tuple[Tensor, Tensor]:
        image = view.canvas(operator.radiance(light), operator.pixels)
        return image, operator.light_gradient(view.upstream(operator.pixels))

    with quadrature(*plan.converged):
        exact = seen(view.operator(FINEST))
    for directions, samples in product(plan.directions, plan.shaped_samples):
        image_error, gradient_error = map(relative_error, seen(built(samples, directions)), exact)
        row = row_of(
            view,
            f"building an operator with {transport}, {view.size}²",
            f"{samples}² samples, {directions:,} directions",
            samples,
            default=(directions, samples) == (rays.DIRECTIONS, SAMPLES),
            image_error=image_error,
            gradient_error=gradient_error,
        )
        yield row, partial(built, samples, directions)


def refreshes(bench: Bench) -> list[Row]:
    """A descent on the vertices with visibility refreshed every so many steps; time is per step.

    The error is the final image's, against that of the descent with visibility refreshed in every step.
    """
    view, light, steps = bench.view(bench.plan.mesh, bench.plan.small), bench.light(), bench.plan.steps
    target = lit_from_opposite(view, SAMPLES, light)
    start, _ = bend(view, SAMPLES, light, target, steps=0, every=1)
    _, exact = bend(view, SAMPLES, light, target, steps, every=1)

    def entries() -> Entries:
        for every in bench.plan.refreshes:
            cost, image = bend(view, SAMPLES, light, target, steps, every)
            setting = f"refreshed every {every} steps" if every > 1 else "refreshed in every step"
            found = {"image_error": relative_error(image, exact), "cost": cost / start}
            row = row_of(view, f"vertex descent, {view.size}²", setting, SAMPLES, **found)
            yield row, partial(bend, view, SAMPLES, light, target, steps, every)

    return [replace(row, time_ms=row.time_ms / steps) for row in bench.timed(entries(), share=1 / 5)]
