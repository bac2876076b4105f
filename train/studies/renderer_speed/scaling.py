"""How time and memory grow: by lights, by the image's size, by vertices and, the paper's figure, by variables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from train.report.tables import markdown
from train.studies.renderer_speed.bench import SAMPLES, Bench, Entries, row_of
from train.studies.renderer_speed.comparison import SHADINGS
from train.studies.renderer_speed.measure import peak_bytes
from train.studies.renderer_speed.reference import Exact
from train.studies.renderer_speed.results import Row
from train.studies.renderer_speed.scenes import View
from train.studies.renderer_speed.steps import light_step, seen, vertex_step


def batches(bench: Bench) -> list[Row]:
    """A light step for many lights on one operator; time is per light."""

    def entries() -> Entries:
        view, light = bench.view(bench.plan.mesh, bench.plan.small), bench.light()
        operator = view.operator(SAMPLES)
        errors = Exact(view).light_errors(operator, light)
        for count in bench.plan.batches:
            setting = f"{count:,} lights" if count > 1 else "1 light"
            row = row_of(view, f"light step by lights, {view.size}²", setting, SAMPLES, batch=count, **errors)
            yield row, light_step(view, operator, light.expand(count, -1, -1))

    return [replace(row, time_ms=row.time_ms / (row.batch or 1)) for row in bench.timed(entries())]


def workloads(bench: Bench, axis: str) -> list[Row]:
    """Four kinds of work by the image's `size` or by the mesh's `vertices`, each kind in turns over the whole axis.

    Operators at `workload_samples`, geometry at one sample per pixel.
    """
    plan = bench.plan
    axes = {"size": [(plan.mesh, size) for size in plan.sizes], "vertices": [(n, plan.large) for n in plan.vertices]}
    works = [list(_works(bench, bench.view(*place), f"by {axis}")) for place in axes[axis]]
    return [row for kind in zip(*works, strict=True) for row in bench.timed(kind, share=1 / 2)]


def _works(bench: Bench, view: View, panel: str) -> Entries:
    samples, light = bench.plan.workload_samples, bench.light()
    exact, operator = Exact(view), view.operator(samples)
    of_light = row_of(view, panel, "light step", samples, **exact.light_errors(operator, light))
    yield of_light, light_step(view, operator, light)
    yield replace(of_light, setting="operator"), partial(view.operator, samples)
    of_vertices = replace(of_light, samples=1, **exact.vertex_errors(view, 1, light))
    yield replace(of_vertices, setting="vertex step, visibility kept"), vertex_step(view, 1, light, kept=True)
    yield replace(of_vertices, setting="vertex step, refreshed"), vertex_step(view, 1, light)


@dataclass(frozen=True)
class Point:
    """One gradient by all coordinates of all vertices, visibility kept: median time and peak of allocated memory."""

    variables: int
    method: str
    time_ms: float
    memory_mb: float
    size: int


def measure(bench: Bench) -> list[Point]:
    """Images of `plan.sizes[-1]`² pixels at one sample each, with a light of degree 6."""
    points, size = [], bench.plan.sizes[-1]
    for variables in bench.plan.variables:
        view = bench.view(variables // 3, size)
        calls = {method: _gradient(bench, view, shade) for method, shade in SHADINGS.items()}
        times = bench.clock.medians(calls, max(1, bench.clock.rounds // 3))
        points += [
            Point(view.mesh.vertices.size, method, times[method], peak_bytes(call, bench.device) / 1e6, size)
            for method, call in calls.items()
        ]
    return points


def _gradient(bench: Bench, view: View, shade: Callable[..., Tensor]) -> Callable[[], Tensor]:
    light, variable = bench.light(), view.vertices().requires_grad_()
    fragments, albedo, _ = seen(view, 1, variable)
    upstream = view.upstream(fragments.pixels)
    return lambda: torch.autograd.grad((shade(fragments, variable, light, albedo) * upstream).sum(), variable)[0]


def table(points: Sequence[Point]) -> str:
    """In Markdown, a line for each number of variables."""
    methods = list(dict.fromkeys(point.method for point in points))
    found: dict[int, list[float]] = {}
    for point in points:
        found.setdefault(point.variables, []).extend((point.time_ms, point.memory_mb))
    header = ["variables", *(f"{method}: {unit}" for method in methods for unit in ("ms", "MB"))]
    return markdown(header, [(count, *values) for count, values in found.items()])
