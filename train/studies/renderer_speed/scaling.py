"""The paper's scaling figure: derivatives by hand against autograd through the whole shading graph, by variables."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from train.studies.renderer_speed.comparison import SHADINGS
from train.studies.renderer_speed.measure import peak_bytes
from train.studies.renderer_speed.panels import Bench
from train.studies.renderer_speed.scenes import View
from train.studies.renderer_speed.steps import seen


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
