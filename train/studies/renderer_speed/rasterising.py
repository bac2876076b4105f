"""Rasterising alone, by faces, size and back end, and what the compiled one takes to start."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from tempfile import TemporaryDirectory

import numpy as np

from train.report.tables import markdown, shown
from train.studies.renderer_speed.panels import Bench
from train.studies.renderer_speed.scenes import CAMERA, ellipsoid
from train.studies.targets import Target

COMPILED, PLAIN = "compiled", "software"
MOST = 100_000  # vertices
START = (
    "import time, renderer.visibility; start = time.process_time(); import renderer.visibility.compiled; "
    "print(time.process_time() - start)"
)


@dataclass(frozen=True)
class Drawn:
    """One view of a closed mesh: median milliseconds by back end, and how many samples compiled and software differ
    in, None where there is no compiled one."""

    faces: int
    size: int
    times: dict[str, float]
    unlike: int | None

    @property
    def ratio(self) -> float | None:
        return None if self.unlike is None else self.times[PLAIN] / self.times[COMPILED]


def measure(bench: Bench) -> list[Drawn]:
    """Each mesh of the plan, but for the largest, at each size up to the large one."""
    vertices = [count for count in bench.plan.vertices if count <= MOST]
    sizes = [size for size in bench.plan.sizes if size <= bench.plan.large]
    return [_draw(bench, count, size) for count in vertices for size in sizes]


def _draw(bench: Bench, vertices: int, size: int) -> Drawn:
    mesh = ellipsoid(vertices)
    points = CAMERA.project(mesh.vertices)[None]
    calls = {each.name: partial(each.rasterise, points, mesh.faces, size, closed=True) for each in bench.backends}
    unlike = int(np.sum(calls[COMPILED]() != calls[PLAIN]())) if COMPILED in calls else None
    return Drawn(len(mesh.faces), size, bench.clock.medians(calls), unlike)


def target(drawn: Sequence[Drawn]) -> Target:
    """Over all of them."""
    what, asked = "rasterising alone: compiled against software", "at least 3× faster, the same samples"
    ratios = [each.ratio for each in drawn if each.ratio is not None]
    if not ratios:
        return Target(what, asked, "not measured", None)
    unlike = sum(each.unlike or 0 for each in drawn)
    found = f"{shown(min(ratios))}× to {shown(max(ratios))}×, {unlike or 'no'} samples differ"
    return Target(what, asked, found, min(ratios) >= 3 and not unlike)


def table(drawn: Sequence[Drawn]) -> str:
    """A line per mesh and size."""
    names = list(drawn[0].times)
    header = ["faces", "size", *(f"{name}: ms" for name in names), "compiled against software"]
    lines = [(each.faces, each.size, *each.times.values(), each.ratio and f"{shown(each.ratio)}×") for each in drawn]
    return markdown(header, lines)


def starting(bench: Bench) -> str:
    """What a process spends before it first rasterises with numba, as a sentence; nothing where that is not there."""
    if COMPILED not in [backend.name for backend in bench.backends]:
        return ""
    with TemporaryDirectory() as folder:
        first, later = _seconds_to_start(folder), _seconds_to_start(folder)
    return (
        f"To start numba, a process spends {shown(later)} s of the CPU, and {shown(first)} s where its cache has no "
        "machine code yet."
    )


def _seconds_to_start(cache: str) -> float:
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    run = subprocess.run([sys.executable, "-c", START], env=environment, capture_output=True, text=True, check=True)
    return float(run.stdout)
