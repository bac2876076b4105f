"""Time against error, panel by panel: choices at one workload, which have a front, and workloads at one choice."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

from renderer.image import ImageSettings
from renderer.transfer import DEGREE
from renderer.visibility import Backend
from train.studies.renderer_speed.descent import bend, lit_from_opposite
from train.studies.renderer_speed.errors import Exact
from train.studies.renderer_speed.measure import Clock, relative_error
from train.studies.renderer_speed.results import Row
from train.studies.renderer_speed.scenes import View, coefficients, ellipsoid
from train.studies.renderer_speed.steps import LAYOUTS, laid_out, light_step, vertex_step

SAMPLES = ImageSettings().samples
DTYPES = (torch.float32, torch.bfloat16, torch.float64)  # the default first

Entries = Iterable[tuple[Row, Callable[[], object]]]


@dataclass(frozen=True)
class Plan:
    """Every axis that is measured. small, large, sizes: of images in pixels. samples: per side of a pixel. mesh and
    vertices: how many of the latter a mesh has about. views: of each mesh whose operators are built."""

    small: int = 32
    large: int = 224
    mesh: int = 10_000
    sizes: tuple[int, ...] = (32, 64, 128, 224, 512)
    vertices: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
    variables: tuple[int, ...] = (100, 1_000, 10_000, 100_000, 300_000, 1_000_000)
    degrees: tuple[int, ...] = (2, 4, 6, 8, 10, 12)
    samples: tuple[int, ...] = (1, 2, 4, 8, 16)
    shaped_samples: tuple[int, ...] = (2, 4, 8, 16)
    directions: tuple[int, ...] = (64, 128, 256, 512, 1024, 2048)
    converged: tuple[int, int, int] = (2**14, 2**13, 2**8)  # directions, patches and theirs
    workload_samples: int = 4
    batches: tuple[int, ...] = (1, 10, 100, 1_000)
    views: int = 10
    refreshes: tuple[int, ...] = (1, 2, 5, 10)
    steps: int = 20
    rounds: int = 21


QUICK = Plan(
    small=8,
    large=12,
    mesh=160,
    sizes=(8, 12),
    vertices=(40, 160),
    variables=(100,),
    degrees=(2, 6),
    samples=(1, 8),
    shaped_samples=(2, 8),
    directions=(64, 512),
    converged=(2**10, 2**8, 2**6),
    batches=(1, 4),
    views=1,
    refreshes=(1, 2),
    steps=2,
    rounds=1,
)


@dataclass(frozen=True)
class Bench:
    """What every panel needs: the plan, the clock, the rasterisers (the default first) and the device."""

    plan: Plan
    clock: Clock
    backends: tuple[Backend, ...]
    device: torch.device

    def view(self, vertices: int, size: int) -> View:
        return View(ellipsoid(vertices), size, self.backends[0], self.device)

    def light(self, degree: int = DEGREE, dtype: torch.dtype = torch.float32) -> Tensor:
        return coefficients(degree).to(self.device, dtype)

    def timed(self, entries: Entries, share: float = 1.0) -> list[Row]:
        """The entries' rows with their times, from this share of the plan's rounds."""
        rows, calls = zip(*entries, strict=True)
        times = self.clock.medians(dict(enumerate(calls)), max(1, round(share * self.plan.rounds)))
        return [replace(row, time_ms=times[index]) for index, row in enumerate(rows)]


def row_of(view: View, panel: str, setting: str, samples: int, **found: Any) -> Row:
    """Of a view with so many samples per side of a pixel, in float32 and at the default degree unless found says so."""
    vertices = len(view.mesh.vertices)
    axes: dict[str, Any] = {"degree": DEGREE, "dtype": "float32", "size": view.size, "vertices": vertices}
    return Row(panel=panel, setting=setting, samples=samples**2, **axes | found)


def light_steps(bench: Bench, size: int) -> list[Row]:
    """A step of an attack on the light, by degree, dtype and layout of the operator."""

    def entries() -> Entries:
        view = bench.view(bench.plan.mesh, size)
        exact = Exact(view)
        for degree in bench.plan.degrees:
            wide = view.operator(SAMPLES, degree, torch.float64)
            for dtype in DTYPES:
                light = bench.light(degree, torch.promote_types(dtype, torch.float32))
                for layout in LAYOUTS:
                    operator = laid_out(wide, layout, dtype)
                    setting = f"degree {degree}, {_name(dtype)}, {layout}"
                    chosen = (degree, dtype, layout) == (DEGREE, DTYPES[0], LAYOUTS[0])
                    axes = {"degree": degree, "dtype": _name(dtype), "layout": layout, "batch": 1}
                    errors = exact.light_errors(operator, light)
                    row = row_of(view, f"light step, {size}²", setting, SAMPLES, default=chosen, **axes, **errors)
                    yield row, light_step(view, operator, light)

    return bench.timed(entries(), share=3)


def builds(bench: Bench) -> list[Row]:
    """An operator for one view, by samples, degree and rasteriser."""

    def entries() -> Entries:
        view, plan = bench.view(bench.plan.mesh, bench.plan.small), bench.plan
        exact, panel = Exact(view), f"building an operator, {view.size}²"
        for choice in product(bench.backends, plan.samples, plan.degrees):
            backend, samples, degree = choice
            drawn = replace(view, backend=backend)
            setting = f"{samples}² samples, degree {degree}, {backend.name}"
            chosen = choice == (bench.backends[0], SAMPLES, DEGREE)
            axes = {"degree": degree, "layout": LAYOUTS[0], "rasteriser": backend.name}
            errors = exact.light_errors(drawn.operator(samples, degree), bench.light(degree))
            row = row_of(view, panel, setting, samples, default=chosen, **axes, **errors)
            yield row, partial(drawn.operator, samples, degree)

    return bench.timed(entries())


def vertex_steps(bench: Bench) -> list[Row]:
    """A step of an attack on the vertices that rasterises anew, by samples, degree, dtype and rasteriser."""

    def entries() -> Entries:
        view, plan = bench.view(bench.plan.mesh, bench.plan.small), bench.plan
        exact, panel = Exact(view), f"vertex step, {view.size}²"
        for choice in product(bench.backends, plan.samples, plan.degrees[:4], (torch.float32, torch.float64)):
            backend, samples, degree, dtype = choice
            drawn, light = replace(view, backend=backend), bench.light(degree, dtype)
            setting = f"{samples}² samples, degree {degree}, {_name(dtype)}, {backend.name}"
            chosen = choice == (bench.backends[0], SAMPLES, DEGREE, DTYPES[0])
            axes = {"degree": degree, "dtype": _name(dtype), "refresh": 1, "rasteriser": backend.name}
            errors = exact.vertex_errors(drawn, samples, light)
            row = row_of(view, panel, setting, samples, default=chosen, **axes, **errors)
            yield row, vertex_step(drawn, samples, light)

    return bench.timed(entries(), share=1 / 3)


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
            axes = {"refresh": every, "rasteriser": view.backend.name}
            row = row_of(view, f"vertex descent, {view.size}²", setting, SAMPLES, **axes, **found)
            yield row, partial(bend, view, SAMPLES, light, target, steps, every)

    return [replace(row, time_ms=row.time_ms / steps) for row in bench.timed(entries(), share=1 / 5)]


def batches(bench: Bench) -> list[Row]:
    """A light step for many lights on one operator; time is per light."""

    def entries() -> Entries:
        view, light = bench.view(bench.plan.mesh, bench.plan.small), bench.light()
        operator = view.operator(SAMPLES)
        errors = Exact(view).light_errors(operator, light)
        for count in bench.plan.batches:
            setting, axes = f"{count:,} lights" if count > 1 else "1 light", {"layout": LAYOUTS[0], "batch": count}
            row = row_of(view, f"light step by lights, {view.size}²", setting, SAMPLES, **axes, **errors)
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
    of_light = row_of(view, panel, "light step", samples, batch=1, **exact.light_errors(operator, light))
    yield of_light, light_step(view, operator, light)
    yield replace(of_light, setting="operator", rasteriser=view.backend.name), partial(view.operator, samples)
    of_vertices = replace(of_light, samples=1, **exact.vertex_errors(view, 1, light))
    yield replace(of_vertices, setting="vertex step, visibility kept"), vertex_step(view, 1, light, kept=True)
    refreshed = replace(of_vertices, setting="vertex step, refreshed", rasteriser=view.backend.name)
    yield refreshed, vertex_step(view, 1, light)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
