"""The page that a run leaves in docs/: what was measured, on what, and whether it is enough."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from train.report.tables import markdown, shown
from train.studies.page import filled, joined
from train.studies.renderer_speed.results import Row, compared, pareto_front, verdict
from train.studies.renderer_speed.scaling import Point
from train.studies.renderer_speed.skipping import Saving
from train.studies.renderer_speed.vertices import Vertices, section
from train.studies.targets import Target, table_of


@dataclass(frozen=True)
class Findings:
    """What a run measured.

    choices: panels with a default. comparisons: with plain autograd and, where asked for, with Mitsuba.
    workloads: by size, vertices and lights. notes: what could not be measured. reference: (its samples per side, the
    image's size, its own relative error) of the large image.
    """

    targets: Sequence[Target]
    choices: Sequence[Sequence[Row]]
    descent: Sequence[Row]
    comparisons: Sequence[Sequence[Row]]
    vertices: Vertices
    workloads: Sequence[Sequence[Row]]
    savings: Sequence[Saving]
    scaling: Sequence[Point]
    notes: Sequence[str]
    reference: tuple[int, int, float]

    @property
    def panels(self) -> list[Sequence[Row]]:
        """Those that have a front."""
        return [*self.choices, self.descent, *self.comparisons, self.vertices.rows]


WHY_NOT = """\
At 32² one light's image and gradient are some twenty operations on a few thousand numbers, whose cost is Python's and
torch's for each operation and not the arithmetic; a light among 100 costs a fraction of it
([Light step by lights](#light-step-by-lights-32)). Plain autograd face by face shades each face once and keeps
visibility; it is the fastest other way that runs here.
"""


def page(findings: Findings, command: str, machine: str) -> str:
    """The whole page, in Markdown."""
    samples, size, uncertainty = findings.reference
    header = filled(
        __file__,
        command=command,
        machine=machine,
        reference_samples=samples,
        reference_size=size,
        uncertainty=shown(uncertainty),
    )
    sections = [
        header,
        *findings.notes,
        "## Targets",
        table_of(findings.targets),
        WHY_NOT,
        "## Choices",
        "The error that counts is the larger of the two. All settings, not only the fronts, are in "
        "[renderer_pareto.csv](renderer_pareto.csv).",
        "![Fronts of time and error](renderer_pareto.png)",
        *_choices(findings.choices),
        *_descent(findings.descent),
        "## Side by side",
        *_comparisons(findings.comparisons),
        section(findings.vertices, command, machine),
        "## What a scene does not need",
        _savings(findings.savings),
        "## How it grows",
        *_growth(findings),
    ]
    return joined(sections)


def _choices(panels: Sequence[Sequence[Row]]) -> Iterator[str]:
    for rows in panels:
        front = pareto_front(rows)
        shown_rows = sorted({*front, *(row for row in rows if row.default)}, key=lambda row: row.time_ms)
        yield f"### {_title(rows)}"
        yield verdict(rows)
        lines = [(row.setting, *_numbers(row), row in front, "default" if row.default else "") for row in shown_rows]
        yield markdown(["setting", "ms", "image's error", "gradient's error", "front", ""], lines)


def _descent(rows: Sequence[Row]) -> Iterator[str]:
    yield f"### {_title(rows)}"
    yield (
        "The vertices move until the image looks lit from the other side, in unit steps of 0.05. The error is the "
        "final image's, against the descent whose visibility is refreshed in every step."
    )
    lines = [(row.setting, row.time_ms, row.image_error, row.cost) for row in rows]
    yield markdown(["visibility", "ms per step", "final image's error", "share of the cost that is left"], lines)


def _comparisons(panels: Sequence[Sequence[Row]]) -> Iterator[str]:
    yield "The light is cut after degree 6 in the reference too, since that is what all are given."
    for rows in panels:
        yield f"### {_title(rows)}"
        yield compared(rows)


def _savings(savings: Sequence[Saving]) -> str:
    lines = [
        (s.what, s.all_ms, s.needed_ms, f"{shown(s.all_ms / s.needed_ms)}×", _mb(s.all_bytes), _mb(s.needed_bytes))
        for s in savings
    ]
    return markdown(["what", "ms with all", "ms without", "saved", "MB with all", "MB without"], lines)


def _growth(findings: Findings) -> Iterator[str]:
    yield (
        "The paper's scaling figure, and every kind of work by size, by vertices and by lights; the numbers are in "
        "[renderer_scaling.csv](renderer_scaling.csv) and [renderer_pareto.csv](renderer_pareto.csv)."
    )
    yield "![How time and memory grow](renderer_scaling.png)"
    methods = list(dict.fromkeys(point.method for point in findings.scaling))
    header = ["variables", *(f"{method}: {unit}" for method in methods for unit in ("ms", "MB"))]
    by_count: dict[int, dict[str, tuple[float, float]]] = {point.variables: {} for point in findings.scaling}
    for point in findings.scaling:
        by_count[point.variables][point.method] = point.time_ms, point.memory_mb
    lines = [(count, *(value for method in methods for value in found[method])) for count, found in by_count.items()]
    yield markdown(header, lines)
    *_, by_lights = findings.workloads
    yield f"### {_title(by_lights)}"
    yield markdown(["on one operator", "ms for each"], [(row.setting, row.time_ms) for row in by_lights])


def _title(rows: Sequence[Row]) -> str:
    panel = rows[0].panel
    return panel[0].upper() + panel[1:]


def _numbers(row: Row) -> tuple[float | None, ...]:
    return row.time_ms, row.image_error, row.gradient_error


def _mb(count: int | None) -> float | None:
    return None if count is None else count / 1e6
