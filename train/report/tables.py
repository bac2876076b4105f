"""Markdown tables: the one place where they are written."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A table with a title, which may be empty; as text, aligned Markdown without the title."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]

    def __str__(self) -> str:
        return aligned(self.header, self.rows)


def markdown(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; cells as `shown` writes them."""
    return _joined([header, ["---"] * len(header), *rows])


def aligned(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table whose columns stand below each other on a console, too."""
    lines = [[shown(cell) for cell in line] for line in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    return _joined([cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines)


def shown(value: object) -> str:
    """A value for people to read: three significant digits, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _joined(lines: Iterable[Sequence[object]]) -> str:
    return "\n".join(f"| {' | '.join(map(shown, line))} |" for line in lines)
