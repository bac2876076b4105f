"""The page's section on attacks that move vertices, which can be measured by itself."""

from collections.abc import Mapping
from functools import partial
from itertools import product

import numpy as np

from train.command_line.entry_points import command_line
from train.report.tables import shown
from train.studies.page import filled
from train.studies.renderer_speed import comparison, targets
from train.studies.renderer_speed.bench import Bench
from train.studies.renderer_speed.results import Row, compared, times
from train.studies.renderer_speed.scenes import CAMERA, ellipsoid
from train.studies.targets import Target, table_of

COMPILED, PLAIN = "compiled", "software"
MOST = 100_000  # vertices, of meshes that are rasterised alone


def measure(bench: Bench, with_mitsuba: bool, machine: str) -> tuple[list[Row], str]:
    """(Who takes how long for a gradient by the vertices, the section in Markdown)."""
    rows = bench.timed(comparison.by_vertices(bench, bench.plan.large, with_mitsuba))
    taken = {row.setting: row.time_ms for row in rows}
    section = filled(
        __file__,
        command=command_line(),
        machine=machine,
        targets=table_of([*targets.by_vertices(rows), _rasterising(bench)]),
        kept=shown(taken[comparison.BY_FACE_KEPT] / taken[f"{comparison.ANALYTIC}, {comparison.KEPT}"]),
        rows=compared(rows),
    )
    return rows, section


def _rasterising(bench: Bench) -> Target:
    """One view of each mesh of the plan, but for the largest, at each size up to the large one."""
    backends = [each for each in bench.backends if each.name in (COMPILED, PLAIN)]
    if len(backends) < 2:
        return compiled({}, 0)
    counts = [count for count in bench.plan.vertices if count <= MOST]
    sizes = [size for size in bench.plan.sizes if size <= bench.plan.large]
    ratios, unlike = {}, 0
    for count, size in product(counts, sizes):
        mesh = ellipsoid(count)
        points = CAMERA.project(mesh.vertices)[None]
        calls = {each.name: partial(each.rasterise, points, mesh.faces, size, closed=True) for each in backends}
        unlike += int(np.sum(calls[COMPILED]() != calls[PLAIN]()))
        ms = bench.clock.medians(calls)
        ratios[f"{len(mesh.faces):,} faces, {size}²"] = ms[PLAIN] / ms[COMPILED]
    return compiled(ratios, unlike)


def compiled(ratios: Mapping[str, float], unlike: int) -> Target:
    """How many times as fast as the plain one the compiled rasteriser is, by what is drawn, if it is there; and in how
    many samples they differ."""
    what, asked = "rasterising alone: compiled against software", "at least 3× faster, the same samples"
    if not ratios:
        return Target(what, asked, "not measured", None)
    (slow, least), *_, (fast, most) = sorted(ratios.items(), key=lambda each: each[1])
    found = f"{times(least)} ({slow}) to {times(most)} ({fast}), {unlike or 'no'} samples differ"
    return Target(what, asked, found, least >= 3 and not unlike)
