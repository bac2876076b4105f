"""What a measurement leaves: rows of time and error, the front among them, and CSV files."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from train.report.tables import markdown, shown

NOISE = 0.05  # of a median: times closer than that may change places from run to run


@dataclass(frozen=True)
class Row:
    """Time and error of one setting; None where there is none.

    panel: what is compared with what. time_ms: median. image_error, gradient_error: relative root mean square against
    the converged reference. default: what the renderer does when it is not told otherwise. samples: of a whole pixel.
    batch: of lights. cost: what a descent left of the cost it began with.
    """

    panel: str
    setting: str
    time_ms: float = math.nan
    image_error: float | None = None
    gradient_error: float | None = None
    default: bool = False
    degree: int | None = None
    samples: int | None = None
    batch: int | None = None
    size: int | None = None
    vertices: int | None = None
    cost: float | None = None

    @property
    def error(self) -> float:
        """The larger of the image's and the gradient's, to the three digits that the reference is good for."""
        return float(f"{max(error for error in (self.image_error, self.gradient_error) if error is not None):.3g}")


def dominators(row: Row, rows: Iterable[Row]) -> list[Row]:
    """The others that are no slower and no less accurate, and better in one of the two; the fastest first."""
    better = [
        other
        for other in rows
        if other.time_ms <= row.time_ms
        and other.error <= row.error
        and (other.time_ms, other.error) != (row.time_ms, row.error)
    ]
    return sorted(better, key=lambda other: other.time_ms)


def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """The rows that no other one dominates, from the fastest to the most accurate."""
    return sorted((row for row in rows if not dominators(row, rows)), key=lambda row: row.time_ms)


def verdict(default: Row, rows: Sequence[Row]) -> str:
    """Whether the default among the rows lies on their front, and what is better where it does not."""
    better = dominators(default, rows)
    if not better:
        return "yes"
    best = better[0]
    where = "within the noise" if best.time_ms > (1 - NOISE) * default.time_ms else "**no**"
    return (
        f"{where}: {best.setting} takes {best.time_ms / default.time_ms:.2f} of its time at "
        f"{best.error / default.error:.2f} of its error"
    )


def defaults(panels: Iterable[Sequence[Row]]) -> str:
    """A Markdown table of the default in each panel."""
    header = ["work", "settings", "default", "ms", "image's error", "gradient's error", "on the front"]
    lines = [
        (row.panel, len(rows), row.setting, row.time_ms, row.image_error, row.gradient_error, verdict(row, rows))
        for rows in panels
        for row in rows
        if row.default
    ]
    return markdown(header, lines)


def compared(rows: Sequence[Row]) -> str:
    """A Markdown table of who took how long, and how much longer than the fastest."""
    fastest = min(row.time_ms for row in rows)
    header = ["who", "samples per pixel", "ms", "image's error", "gradient's error", "of the fastest"]
    lines = [
        (row.setting, row.samples, row.time_ms, row.image_error, row.gradient_error, times(row.time_ms / fastest))
        for row in rows
    ]
    return markdown(header, lines)


def times(ratio: float) -> str:
    """As a person reads it."""
    return f"{shown(ratio)}×"


def write_csv(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """One line per record, with four significant digits, and a column per key; the first record has them all."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _plain(value) for key, value in record.items()} for record in records)


def records(panels: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
    """The rows of panels for `write_csv`, with a column that tells who lies on the panel's front."""
    return [asdict(row) | {"front": row in pareto_front(rows)} for rows in panels for row in rows]


def _plain(value: object) -> object:
    return f"{value:.4g}" if isinstance(value, float) else value
