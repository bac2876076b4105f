"""Fractions with their intervals, and tables, as text for people."""

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Table:
    """A table with a title, which may be empty. As text: Markdown below the title, aligned on a console, too.

    On a terminal that is too narrow, columns go on in further tables, which repeat the first one.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]

    @property
    def known(self) -> "Table":
        """Without the columns in which every cell is unknown, "-"."""
        kept = [index for index in range(len(self.header)) if any(row[index] != "-" for row in self.rows)]
        rows = [[row[index] for index in kept] for row in self.rows]
        return Table(self.title, [self.header[index] for index in kept], rows)

    def __str__(self) -> str:
        room = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
        lines = [[as_text(cell) for cell in line] for line in (self.header, *self.rows)]
        first, *others = (_aligned(cells) for cells in zip(*lines, strict=True))
        parts = [[first]]
        for column in others:
            if len(parts[-1]) > 1 and _width([*parts[-1], column]) > room:
                parts.append([first])
            parts[-1].append(column)
        tables = ("\n".join(f"| {' | '.join(cells)} |" for cells in zip(*part, strict=True)) for part in parts)
        return "\n\n".join(filter(None, [self.title and f"{self.title}:", *tables]))


def _aligned(cells: Sequence[str]) -> list[str]:
    """A column's cells, a line beneath the first, in one width."""
    width = max(map(len, cells))
    return [cell.ljust(width) for cell in (cells[0], "-" * width, *cells[1:])]


def _width(columns: Sequence[Sequence[str]]) -> int:
    return sum(len(column[0]) + 3 for column in columns) + 1


def as_text(value: object) -> str:
    """A cell: numbers with three significant digits, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def fraction(hits: int, n: int) -> dict[str, Any]:
    """hits / n with its 95 % Wilson score interval (Wilson 1927).

    Returns {value, low, high, hits, n}, the first three in [0, 1], or None with n = 0.
    """
    if n == 0:
        return {"value": None, "low": None, "high": None, "hits": 0, "n": 0}
    from scipy.stats import binomtest  # takes a second to import

    ends = binomtest(hits, n).proportion_ci(method="wilson")
    return {"value": hits / n, "low": float(ends.low), "high": float(ends.high), "hits": hits, "n": n}


def format_fraction(result: Mapping[str, Any]) -> str:
    """A result of `fraction`: hits of n [low, high]; "-" where n is 0."""
    return "{hits} of {n} [{low:.0%}, {high:.0%}]".format(**result) if result["n"] else "-"


def format_interval(metric: Mapping[str, Any], sign: str = "") -> str:
    """A metric's value [low, high], or the value alone without an interval; "-" where it is unknown or absent.

    sign: "+" to show that of positive numbers, too.
    """
    if metric.get("value") is None:
        return "-"
    value, *ends = (f"{metric[name]:{sign}.3f}" for name in ("value", "low", "high") if name in metric)
    return f"{value} [{', '.join(ends)}]" if ends else value
