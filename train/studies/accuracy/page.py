"""docs/accuracy.md: an introduction and the tables."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import mpmath
import numpy as np
import torch

from train.report.tables import markdown
from train.studies.accuracy.conditions import Row
from train.studies.accuracy.measure import Error
from train.studies.accuracy.refusals import Refusal
from train.studies.page import filled, joined


@dataclass(frozen=True)
class Table:
    title: str
    rows: Sequence[Row]


def page(tables: Sequence[Table], refusals: Sequence[Refusal], command: str) -> str:
    """Markdown."""
    introduction = filled(
        __file__,
        bits=np.finfo(np.longdouble).nmant + 1,
        command=command,
        torch=torch.__version__,
        numpy=np.__version__,
        mpmath=mpmath.__version__,
        machine=platform.machine(),
    )
    refused = [[refusal.condition, refusal.error or "**nothing**"] for refusal in refusals]
    sections = [block for table in tables for block in (f"## {table.title}", _errors(table.rows))]
    return joined([introduction, *sections, "## What is refused", markdown(["input", "error"], refused)])


def with_table(page: str, table: Table) -> str:
    """The page with a table in place of the one of that title, or of none: then before what is refused."""
    before, _, rest = page.partition(f"## {table.title}\n")
    _, heading, after = rest.partition("\n## ") if rest else before.partition("\n## What is refused")
    before = before if rest else before.partition(heading)[0]
    return joined([before.strip(), f"## {table.title}", _errors(table.rows), (heading + after).strip()])


def failures(tables: Sequence[Table], refusals: Sequence[Refusal]) -> list[str]:
    """The rows where something was not finite or not refused, in words."""
    return [
        f"{row.condition}: {quantity} is not finite"
        for table in tables
        for row in table.rows
        for quantity, error in row.errors.items()
        if not isfinite(error.relative)
    ] + [f"{refusal.condition}: no error" for refusal in refusals if refusal.error is None]


def _errors(rows: Sequence[Row]) -> str:
    quantities = list(dict.fromkeys(quantity for row in rows for quantity in row.errors))
    cells = [[row.condition, *(_cell(row.errors.get(name)) for name in quantities), row.behaviour] for row in rows]
    return markdown(["condition", *quantities, "what the code does"], cells)


def _cell(error: Error | None) -> str:
    if error is None:
        return "-"
    if not isfinite(error.relative):
        return "**not finite**"
    units = f"{error.units:.2g}" if error.units < 1000 else f"{error.units:.0e}"
    return f"{error.relative:.1e} ({units} ε)" if error.relative else "0"
