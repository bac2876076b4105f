"""The page's section on attacks that move vertices, which can be measured by itself."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from train.report.tables import shown
from train.studies.page import joined
from train.studies.renderer_speed import comparison, rasterising, targets
from train.studies.renderer_speed.panels import Bench
from train.studies.renderer_speed.rasterising import Drawn
from train.studies.renderer_speed.results import Row, compared
from train.studies.targets import table_of

WHY_NOT = """\
Plain autograd sample by sample is `renderer.reference`; face by face it shades each face once, as the analytic
derivative does, which is the fastest other way that runs here. Rasterising anew is the same work for all: with
visibility kept, the ratio to that way is {kept}×, and no rasteriser brings it beyond. The light is cut after degree 6
in the reference too, since that is what all are given.
"""


@dataclass(frozen=True)
class Vertices:
    """rows: a gradient by the vertices, side by side. drawn: rasterising alone. start: what numba takes at first."""

    rows: Sequence[Row]
    drawn: Sequence[Drawn]
    start: str


def measure(bench: Bench, with_mitsuba: bool) -> Vertices:
    rows = comparison.by_vertices(bench, bench.plan.large, with_mitsuba)
    return Vertices(rows, rasterising.measure(bench), rasterising.starting(bench))


def section(found: Vertices, command: str, machine: str) -> str:
    """In Markdown, headed by the command that measures it."""
    times = {row.setting: row.time_ms for row in found.rows}
    kept = times[comparison.BY_FACE_KEPT] / times[f"{comparison.ANALYTIC}, {comparison.KEPT}"]
    return joined(
        [
            "## Vertices",
            f"`{command}`: {machine}.",
            table_of([*targets.by_vertices(found.rows), rasterising.target(found.drawn)]),
            WHY_NOT.format(kept=shown(kept)),
            compared(found.rows),
            "One view rasterised, without back faces; `auto` takes `compiled` where numba is and no GPU draws:",
            rasterising.table(found.drawn),
            found.start,
        ]
    )


def put(section: str, page: str) -> str:
    """The page with this section in place of the one before."""
    return re.sub(r"^## Vertices$.*?(?=^## )", lambda _: section + "\n", page, count=1, flags=re.M | re.S)
