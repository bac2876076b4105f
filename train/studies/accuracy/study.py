"""docs/accuracy.md: every condition measured, once."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import mpmath
import numpy as np
import torch

from renderer.errors import require_choice, require_range
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.report.tables import markdown, shown
from train.studies.accuracy import conditions
from train.studies.accuracy.conditions import Row
from train.studies.accuracy.measure import Error
from train.studies.page import filled, joined, write, write_section

Tables = dict[str, Sequence[Row]]  # by title


@dataclass
class AccuracySettings:
    """conf/check_accuracy.yaml. only: the title of a table to measure, which leaves the rest of the page as it is.
    degree: the highest of the harmonics. The others: how much of each."""

    out: str
    only: str | None
    degree: int
    subdivisions: int
    size: int
    slivers: int

    def __post_init__(self) -> None:
        for name, least, most in [("degree", 1, 20), ("subdivisions", 0, 9), ("size", 1, 16384), ("slivers", 1, 10**4)]:
            require_range(name, getattr(self, name), least, most)


def run(settings: AccuracySettings) -> list[str]:
    """Write the page; everything that was not finite, in words."""
    out = writable_file(settings.out, "out")
    torch.set_num_threads(1)
    tables = measure(settings)
    if settings.only:
        write_section(out, _section(*next(iter(tables.items()))))
    else:
        write(out, page(tables))
    return failures(tables)


def measure(settings: AccuracySettings) -> Tables:
    """Every table, or the one that the settings name. InputError where there is none of that title."""
    rows = {
        "Spherical harmonics": conditions.harmonics(settings.degree),
        "Meshes": conditions.meshes(settings.subdivisions),
        "Thin faces": conditions.thin_faces(settings.slivers),
        "Lights": conditions.lights(settings.degree),
        "Number types": conditions.number_types(),
        "Images and cameras": conditions.images(settings.size),
        "Shadows and bounces": conditions.transports(),
    }
    if settings.only is not None:
        require_choice("only", settings.only, rows)
    return {title: list(found) for title, found in rows.items() if settings.only in (None, title)}


def page(tables: Tables) -> str:
    """Markdown."""
    text = filled(
        __file__,
        bits=np.finfo(np.longdouble).nmant + 1,
        command=command_line(),
        torch=torch.__version__,
        numpy=np.__version__,
        mpmath=mpmath.__version__,
        machine=platform.machine(),
        tables="\n\n".join(_section(*table) for table in tables.items()),
    )
    return joined([text])


def failures(tables: Tables) -> list[str]:
    """What was not finite, in words."""
    return [
        f"{row.condition}: {quantity} is not finite"
        for rows in tables.values()
        for row in rows
        for quantity, error in row.errors.items()
        if not isfinite(error.relative)
    ]


def _section(title: str, rows: Sequence[Row]) -> str:
    quantities = list(dict.fromkeys(quantity for row in rows for quantity in row.errors))
    cells = [[row.condition, *(_cell(row.errors.get(name)) for name in quantities), row.behaviour] for row in rows]
    return f"## {title}\n\n{markdown(['condition', *quantities, 'what the code does'], cells)}"


def _cell(error: Error | None) -> str:
    if error is None:
        return "-"
    return shown(error.units) if isfinite(error.relative) else "**not finite**"
