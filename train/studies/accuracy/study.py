"""Every condition measured and every refusal tried, once."""

from dataclasses import dataclass

import torch

from renderer.errors import InputError, require_range
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.studies.accuracy import conditions
from train.studies.accuracy.page import Table, failures, page, with_table
from train.studies.accuracy.refusals import refusals
from train.studies.page import write


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
    """Write the page; everything that was not finite or not refused, in words."""
    out = writable_file(settings.out, "out")
    torch.set_num_threads(1)
    tables = measure(settings)
    if settings.only:
        write(out, with_table(out.read_text("utf-8"), tables[0]))
        return failures(tables, [])
    refused = list(refusals())
    write(out, page(tables, refused, command_line()))
    print(f"{sum(len(table.rows) for table in tables)} conditions and {len(refused)} refusals")
    return failures(tables, refused)


def measure(settings: AccuracySettings) -> list[Table]:
    """Every table, or the one that the settings name. InputError where there is none of that title."""
    rows = {
        "Spherical harmonics": conditions.harmonics(settings.degree),
        "Meshes": conditions.meshes(settings.subdivisions),
        "Thin faces": conditions.thin_faces(settings.slivers),
        "Lights": conditions.lights(settings.degree),
        "Number types": conditions.number_types(),
        "Images and cameras": conditions.images(settings.size),
        "Radiance to image": conditions.development(),
        "Shadows": conditions.shadows(),
        "Bounces": conditions.bounces(),
    }
    if settings.only not in (None, *rows):
        raise InputError(f"only={settings.only}: choose one of {', '.join(rows)}")
    return [Table(title, list(found)) for title, found in rows.items() if settings.only in (None, title)]
