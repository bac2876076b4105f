"""Estimates with their intervals, and tables, as text for people."""

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """Value of a metric with its 95% interval.

    Attributes:
        value: Value of the metric. None if it is unknown.
        low: Low end of the interval. None if the interval is unknown.
        high: High end of the interval. None if the interval is unknown.
    """

    value: float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Proportion(Estimate):
    """Fraction of images for which something is true, with its Wilson interval.

    Attributes:
        hits: Number of images for which it is true.
        n: Number of images. If it is 0, the fraction is unknown.
    """

    hits: int = 0
    n: int = 0


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


def fraction(hits: int, n: int) -> Proportion:
    """Compute hits / n with its 95% Wilson score interval (Wilson 1927).

    Args:
        hits: Number of images for which something is true.
        n: Number of images. If it is 0, the fraction is unknown.

    Returns:
        Fraction with its interval, all in [0, 1].
    """
    if n == 0:
        return Proportion()
    # This import takes a second.
    from scipy.stats import binomtest

    ends = binomtest(hits, n).proportion_ci(method="wilson")
    return Proportion(
        value=hits / n,
        low=float(ends.low),
        high=float(ends.high),
        hits=hits,
        n=n,
    )


def format_fraction(proportion: Proportion) -> str:
    """Write a proportion as text.

    Args:
        proportion: Fraction of images, as `fraction` returns it.

    Returns:
        Text such as "8 of 40 [10%, 35%]", or "-" without images.
    """
    if proportion.n == 0:
        return "-"
    counts = f"{proportion.hits} of {proportion.n}"
    return f"{counts} [{proportion.low:.0%}, {proportion.high:.0%}]"


def format_interval(estimate: Estimate | None, sign: str = "") -> str:
    """Write the value of a metric with its interval as text.

    Args:
        estimate: Value and interval. None if the metric is not there.
        sign: "+" to show the sign of positive numbers, too.

    Returns:
        Text such as "0.500 [0.250, 0.750]". The interval is left out if it is
        unknown. If the value is unknown, the text is "-".
    """
    if estimate is None or estimate.value is None:
        return "-"
    value = f"{estimate.value:{sign}.3f}"
    if estimate.low is None or estimate.high is None:
        return value
    return f"{value} [{estimate.low:{sign}.3f}, {estimate.high:{sign}.3f}]"
