"""photographs.csv: a model's answers, a row per photograph, written and read."""

import csv
import math
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path, PurePosixPath

from renderer.errors import InputError
from train.photographs.answers import Answer
from train.photographs.cells import as_cell, as_written
from train.photographs.folder import SEPARATOR, Photograph, split_sources

ANSWERS = "photographs.csv"


def write_answers(path: Path, answers: Sequence[Answer], label: str) -> None:
    """Write the answers about the class `label`; what is None is left empty."""
    header = ["path", "label", "source", "look_alikes", "prediction", "probability", "true_probability", "true_rank"]
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(as_cell, [*header, f"{label}_probability", f"{label}_rank", f"{label}_log_odds"]))
        for answer in answers:
            (*photograph, look_alikes), *said = astuple(answer)
            writer.writerow(map(as_cell, [*photograph, SEPARATOR.join(look_alikes), *said]))


def read_answers(path: Path, label: str) -> list[Answer]:
    """What `write_answers` wrote; log-odds are None where an older version wrote it.

    InputError for a file that is no such table, or tells of another class.
    """
    try:
        if not path.is_file():  # a pipe would be waited for
            raise ValueError("there is no such file")
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = ([as_written(cell) for cell in row] for row in csv.reader(file))
            return [_read_row(dict(zip(header, row, strict=True)), label) for row in rows if row]
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{path} cannot be used: score the photographs again, with label={label}") from error


def _read_row(row: dict[str, str], label: str) -> Answer:
    path, source, rivals = PurePosixPath(row["path"]), row["source"] or None, row.get("look_alikes", "")
    return Answer(
        Photograph(path, row["label"], source, split_sources(rivals)),
        prediction=row["prediction"],
        probability=_number(row["probability"]),
        true_probability=_number(row["true_probability"]) if row["true_probability"] else None,
        true_rank=int(row["true_rank"]) if row["true_rank"] else None,
        asked_probability=_number(row[f"{label}_probability"]),
        asked_rank=int(row[f"{label}_rank"]),
        asked_log_odds=_number(row[f"{label}_log_odds"]) if row.get(f"{label}_log_odds") else None,
    )


def _number(cell: str) -> float:
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError(f"{cell} is no finite number")
    return value
