"""Fractions with their intervals, and tables, as text for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Table:
    """A table with a title, which may be empty. As text: Markdown below the title, aligned on a console, too."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]

    def __str__(self) -> str:
        lines = [[as_text(cell) for cell in line] for line in (self.header, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        lines.insert(1, ["-" * width for width in widths])
        padded = ([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in padded)
        return f"{self.title}:\n\n{table}" if self.title else table


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
