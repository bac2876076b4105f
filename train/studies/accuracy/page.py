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
from train.studies.page import joined

INTRODUCTION = """# Accuracy

How far the renderer is off, condition by condition. The reference
([train/studies/accuracy/](../train/studies/accuracy/)) evaluates the same formulas slowly, by explicit sums and without
torch, in long doubles ({bits} bits of mantissa here) or, where those would not do (harmonics, thin faces, lights of
high degree), in 256 bits. It takes each input as the renderer gets it, after its rounding to the number type, and which
face a sample sees as the rasteriser says, which has tests of its own.

- *Error*: the largest difference anywhere in an image or gradient, over the largest magnitude in it; in brackets, in
  units of ε, the spacing at 1 of the number type computed in (float64 2.2e-16, float32 1.2e-07, float16 9.8e-04,
  bfloat16 7.8e-03).
- *image*, *light gradient*: through an operator (`renderer.transfer`) in float32, unless the row names a type.
- *image by geometry*, *vertex gradient*: `renderer.shading` in float64, unless the row names a type. With vertex
  normals, the gradient's product with one random direction.
- Gradients are of Σ upstream × image with random upstream gradients of either sign in [-1, 1]; those of the
  harmonics are each over its own largest component.

Unless the row says otherwise: images of 16² pixels and 4 samples, a light of degree 6 with random coefficients in all
49 places, a colour per face; under "Lights" the geometry is float32, and under "Shadows" and "Bounces"
(`renderer.transport`) a pixel has one sample, whose 512 rays the reference casts, too, and bounces are between some 64
patches, which look in 64 directions each, in images of 8². Made by

```bash
{command}
```

with torch {torch}, NumPy {numpy}, mpmath {mpmath} on {machine}, one thread. It needs the `test` extra, and fails where
a number that the renderer returns is not finite or where bad input is not refused.
"""


@dataclass(frozen=True)
class Table:
    title: str
    rows: Sequence[Row]


def page(tables: Sequence[Table], refusals: Sequence[Refusal], command: str) -> str:
    """Markdown."""
    introduction = INTRODUCTION.format(
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
