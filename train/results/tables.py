"""Metrics with their 95% intervals, and tables, as text for people."""

import csv
import io
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from renderer.io.files import atomic_write

# What a 95% interval is over. Images of few objects say nothing about other objects.
OBJECTS = "objects"
IMAGES = "images"
THESE_OBJECTS = "images, for these objects"
RANGE = "lowest and highest"  # of several seeds, which are no interval
NORMAL_QUANTILE = NormalDist().inv_cdf(0.975)


@dataclass(frozen=True)
class Estimate:
    """Value of a metric with its 95% interval.

    Attributes:
        value: Value of the metric. None if it is unknown.
        low: Low end of the interval. None if the interval is unknown.
        high: High end of the interval. None if the interval is unknown.
        over: What the interval is over, such as OBJECTS. Empty if it is unknown.
    """

    value: float | None = None
    low: float | None = None
    high: float | None = None
    over: str = ""


@dataclass(frozen=True)
class Proportion(Estimate):
    """Fraction of images that meet a condition, with its 95% interval.

    Attributes:
        hits: Number of images that meet the condition.
        n: Number of images. If it is 0, the fraction is unknown.
    """

    hits: int = 0
    n: int = 0


@dataclass(frozen=True)
class Table:
    """Table with a title. `str` converts it to Markdown with aligned columns.

    If the terminal is too narrow for all columns, they are divided into several
    tables below each other. Each of them repeats the first column.

    Attributes:
        title: Title above the table. It may be empty.
        header: Titles of the columns.
        rows: One list of cells for each row. `as_text` converts the cells to
            text.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]

    @property
    def without_unknown_columns(self) -> "Table":
        """Copy of the table without the columns whose cells are all "-", for unknown."""
        is_known = [any(cell != "-" for cell in cells) for cells in zip(*self.rows, strict=True)]
        rows = [[*compress(row, is_known)] for row in self.rows]
        return Table(self.title, [*compress(self.header, is_known)], rows)

    def __str__(self) -> str:
        lines = [[as_text(cell) for cell in line] for line in (self.header, *self.rows)]
        columns = []
        for header, *cells in zip(*lines, strict=True):
            width = max(map(len, (header, *cells)))
            columns.append([cell.ljust(width) for cell in (header, "-" * width, *cells)])
        # Output to a file is one table.
        terminal = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
        first, *others = columns
        parts = [[first]]
        for column in others:
            # Each column has a separator of three characters.
            width = 1 + sum(len(item[0]) + 3 for item in (*parts[-1], column))
            if len(parts[-1]) > 1 and width > terminal:
                parts.append([first])
            parts[-1].append(column)
        paragraphs = [f"{self.title}:"] if self.title else []
        for part in parts:
            rows = zip(*part, strict=True)
            paragraphs.append("\n".join(f"| {' | '.join(cells)} |" for cells in rows))
        return "\n\n".join(paragraphs)


def write_csv(path: Path, rows: Iterable[Iterable[object]], line_end: str = "\n") -> None:
    """Write rows, of which the first is the header, to a CSV file."""
    text = io.StringIO()
    # A cell is quoted if it has a character of the line end. No cell has the null character.
    csv.writer(text, lineterminator="\r\n\0").writerows(rows)
    atomic_write(path, text.getvalue().replace("\r\n\0", line_end))


def as_text(value: object) -> str:
    """Convert a cell of a table to text.

    Integers get thousands separators, such as "1,000". Floats that round to less than 1000 get
    three significant digits. None becomes an empty text.
    """
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def join_words(items: Sequence[str], conjunction: str) -> str:
    """Join items to a list in words, such as "a, b and c"."""
    *others, last = items
    return f"{', '.join(others)} {conjunction} {last}" if others else last


def fraction(hits: int, n: int) -> Proportion:
    """Compute hits / n with its 95% Wilson score interval (Wilson 1927)."""
    if n == 0:
        return Proportion()
    low, high = map(float, wilson(hits / n, n, NORMAL_QUANTILE))
    # Rounding must not move an end that is exactly 0 or 1.
    ends = {"low": low if hits else 0.0, "high": high if hits < n else 1.0}
    return Proportion(hits / n, **ends, over=IMAGES, hits=hits, n=n)


def wilson(value: float | np.ndarray, n: int, quantile: float | np.ndarray) -> np.ndarray:
    """Compute the ends of Wilson's interval of a fraction of n units, with a quantile."""
    shift = quantile**2 / n
    center = (value + shift / 2) / (1 + shift)
    half_width = (value * (1 - value) * shift + shift**2 / 4) ** 0.5 / (1 + shift)
    return np.clip([center - half_width, center + half_width], 0, 1)


def format_fraction(proportion: Proportion) -> str:
    """Format a fraction of images with its interval. An example is "8 of 40 [10%, 35%]"."""
    if proportion.n == 0:
        return "-"
    return f"{proportion.hits} of {proportion.n} [{proportion.low:.0%}, {proportion.high:.0%}]"


def format_interval(estimate: Estimate | None, sign: str = "", form: str = ".3f") -> str:
    """Format the value of a metric with its interval.

    `sign` "+" writes a plus before positive numbers.
    """
    if estimate is None or estimate.value is None:
        return "-"
    value = f"{estimate.value:{sign}{form}}"
    if estimate.low is None or estimate.high is None:
        return value
    return f"{value} [{estimate.low:{sign}{form}}, {estimate.high:{sign}{form}}]"


def table_of(
    title: str, header: Sequence[str], rows: Sequence[Sequence[Any]], form: Any = format_interval
) -> Table:
    """Make a table with metrics in cells, which the function `form` formats.

    The title ends with what their intervals are over.
    """
    shown = [cell for row in rows for cell in row if isinstance(cell, Estimate)]
    # A metric that is unknown is None.
    texts = [[cell if isinstance(cell, str | int) else form(cell) for cell in row] for row in rows]
    return Table(title + describe_intervals(shown), header, texts)


def describe_intervals(estimates: Iterable[Estimate | None]) -> str:
    """Say what the intervals of metrics are over. Empty if no metric has an interval."""
    over = {item.over for item in estimates if item is not None and item.low is not None}
    # A set has no order, and the more general statement comes first.
    units = sorted(over - {""}, key=lambda words: (THESE_OBJECTS in words, words))
    ranges = [words for words in units if words.startswith(RANGE)]
    intervals = [f"over {words}" for words in units if words not in ranges]
    shown = ["95% intervals " + ", or ".join(intervals)] if intervals else []
    return ", or ".join([*shown, *ranges])
