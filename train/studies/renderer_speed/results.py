"""What a measurement leaves: rows of time and error, the front among them, targets, CSV files and Markdown tables."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

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


@dataclass(frozen=True)
class Target:
    """What is asked, what this run found, and whether that is enough: None where it could not be measured."""

    what: str
    asked: str
    found: str
    passed: bool | None


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


def write_csv(path: Path, records: Sequence[dict]) -> None:
    """One line per record, with four significant digits, and a column per key; the first record has them all."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _plain(value) for key, value in record.items()} for record in records)


def records(panels: Sequence[Sequence[Row]]) -> list[dict]:
    """The rows of panels for `write_csv`, with a column that tells who lies on the panel's front."""
    return [asdict(row) | {"front": row in pareto_front(rows)} for rows in panels for row in rows]


def markdown(header: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    cells = [list(header), ["---"] * len(header), *([shown(cell) for cell in line] for line in lines)]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells) + "\n"


def targets_table(targets: Sequence[Target]) -> str:
    """A Markdown table of targets, those that are missed in bold."""
    lines = [(t.what, t.asked, t.found, "—" if t.passed is None else "yes" if t.passed else "**no**") for t in targets]
    return markdown(["what", "asked", "found", "met"], lines)


def shown(value: object) -> str:
    """A value for people to read: three significant digits, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _plain(value: object) -> object:
    return f"{value:.4g}" if isinstance(value, float) else value
