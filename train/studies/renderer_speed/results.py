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
    """Time and error of one setting, and the setting itself; None where an axis has no meaning.

    panel: what is compared with what. time_ms: median. image_error, gradient_error: relative root mean square against
    the converged reference. default: what the renderer does when it is not told otherwise. samples: of a whole pixel.
    cost: what a descent left of the cost it began with.
    """

    panel: str
    setting: str
    time_ms: float = math.nan
    image_error: float | None = None
    gradient_error: float | None = None
    default: bool = False
    degree: int | None = None
    samples: int | None = None
    dtype: str | None = None
    rasteriser: str | None = None
    layout: str | None = None
    batch: int | None = None
    size: int | None = None
    vertices: int | None = None
    refresh: int | None = None
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


def verdict(rows: Sequence[Row]) -> str:
    """Whether the default among the rows lies on their front, in a sentence."""
    default = next(row for row in rows if row.default)
    better = dominators(default, rows)
    if not better:
        return f"The default, {default.setting}, lies on the front."
    best = better[0]
    where = "lies within the noise of" if best.time_ms > (1 - NOISE) * default.time_ms else "does not lie on"
    return (
        f"The default, {default.setting}, {where} the front: {best.setting} takes {best.time_ms / default.time_ms:.2f} "
        f"of its time at {best.error / default.error:.2f} of its error."
    )


def compared(rows: Sequence[Row]) -> str:
    """A Markdown table of who took how long, and how much longer than the fastest."""
    fastest = min(row.time_ms for row in rows)
    header = ["who", "samples per pixel", "ms", "image's error", "gradient's error", "of the fastest"]
    return markdown(
        header,
        [
            (r.setting, r.samples, r.time_ms, r.image_error, r.gradient_error, f"{shown(r.time_ms / fastest)}×")
            for r in rows
        ],
    )


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
