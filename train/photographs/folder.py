"""Find the images of a folder with their classes and sources, and reduce them to the classifier's size."""

import csv
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod
from pathlib import Path, PurePosixPath
from typing import NoReturn

import numpy as np
import torch

from augment.classifiers.adapter import class_index, nearest
from augment.utils import progress, require_memory
from renderer.errors import InputError, in_one_line, require_file
from renderer.io.images import read_square
from train import console

SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
MACS = "__MACOSX"  # macOS puts this folder into archives
FOREIGN = "other_"  # starts the name of a folder whose class the model lacks
TABLE = "photos.csv"
DESCRIPTION = "lab.json"  # of a folder that scripts/lab.py made
SEPARATOR = ";"  # between the sources in a cell of hard_negatives
SKIP = ", or set skip_unreadable=true (evaluate.skip_unreadable=true in training) to skip them"


@dataclass(frozen=True)
class Photograph:
    """An image: its path relative to the folder, its class (or `other_*`) and, if known, its source.

    hard_negatives: the sources of other things that it is ranked against, besides its own.
    """

    path: PurePosixPath
    label: str
    source: str | None
    hard_negatives: tuple[str, ...] = ()


def require_outside(out: Path, folder: Path) -> None:
    """InputError if outputs would lie among the photographs, where the contact sheet would be scored, too."""
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"out={out} lies inside the photographs' folder: choose another")


# ------------------------------------------------------------------------------------- finding


def find_photographs(folder: Path, classes: Sequence[str], label: str) -> list[Photograph]:
    """The images of a folder, sorted by path, each with its class.

    The folder holds either a sub-folder per class, named as in `classes` (or `other_NAME` for a class that the model
    lacks), or images only, which are then all of class `label`. Sub-folders are searched to any depth, through symbolic
    links, too; hidden files and other kinds of file (`left_out`) are skipped. `photos.csv` in the folder is optional.
    Its columns `path` and `source_tag` give sources; its column `hard_negatives` names further sources, separated by
    `;`, whose images of other things an image is ranked against.

    InputError: the folder is missing, unreadable, empty or mixes both layouts; a sub-folder or `label` is not a class;
    `photos.csv` lacks its columns, names no file of the folder, has two different rows for one file, or names a source
    of hard negatives that does not exist.
    """
    class_index(classes, label, "label")
    if not folder.is_dir():
        fault = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {fault}: name a folder of photographs")
    files = list(_files(folder))
    paths = sorted(path for path in files if _is_image(folder, path))
    if not paths:
        others = f" among its {len(files)} files" if files else ""
        raise InputError(f"{folder} holds no photographs{others}: put some there ({', '.join(SUFFIXES)})")
    has_class_folders = _check_layout(folder, paths, classes)
    rows = _read_table(folder / TABLE)
    if unknown := sorted(rows.keys() - set(files)):
        fault = (
            f"{folder / TABLE} has {len(unknown)} of {len(rows)} rows for no file of the folder, such as {unknown[0]}"
        )
        if len(unknown) == len(rows):
            raise InputError(f"{fault}; give paths such as {paths[0]}")
        console.warning(fault)
    photographs = [
        Photograph(path, path.parts[0] if has_class_folders else label, *rows.get(path, (None, ()))) for path in paths
    ]
    sources = {photograph.source for photograph in photographs if photograph.source is not None}
    for photograph in photographs:
        if missing := set(photograph.hard_negatives) - sources:
            raise InputError(
                f"{folder / TABLE} gives {photograph.path} hard_negatives of source {min(missing)!r}, which has no "
                f"image: name one of {', '.join(sorted(sources))}"
            )
    return photographs


def left_out(folder: Path) -> list[PurePosixPath]:
    """The files of a folder that are of no kind that is read; sorted."""
    return sorted(
        path for path in _files(folder) if not _is_image(folder, path) and str(path) not in (TABLE, DESCRIPTION)
    )


def is_hidden(name: str) -> bool:
    """Whether a file or folder belongs to the system rather than to the user."""
    return name.startswith(".") or name == MACS


def _files(folder: Path) -> Iterator[PurePosixPath]:
    """Paths of files in the folder that are not hidden; links are followed, except to a folder that they lie in."""

    def refuse(error: OSError) -> NoReturn:
        raise InputError(f"{error.filename} cannot be read: {error.strerror}") from error

    for root, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        inside = Path(os.path.realpath(root))
        folders[:] = [
            name
            for name in folders
            if not is_hidden(name) and not inside.is_relative_to(os.path.realpath(os.path.join(root, name)))
        ]
        parent = PurePosixPath(Path(root).relative_to(folder).as_posix())
        yield from (parent / name for name in files if not is_hidden(name))


def _is_image(folder: Path, path: PurePosixPath) -> bool:
    """A broken link is an image that cannot be read; a pipe is none, since reading it would block."""
    return path.suffix.lower() in SUFFIXES and ((folder / path).is_file() or not (folder / path).exists())


def _check_layout(folder: Path, paths: Sequence[PurePosixPath], classes: Sequence[str]) -> bool:
    """Whether the folder is made of class folders; InputError if a name among them is not a class."""
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not is_hidden(entry.name))
    for name in names:
        if name not in classes and not name.startswith(FOREIGN):
            raise InputError(
                f"{folder / name} is not named after a class of the model (such as "
                f"{nearest(name, classes)}): rename it, to {FOREIGN}{name} if the model lacks its class"
            )
    loose = [path for path in paths if len(path.parts) == 1]
    if names and loose:
        raise InputError(f"{folder / loose[0]} lies beside class folders: move it into the folder of its class")
    return bool(names)


def _read_table(table: Path) -> dict[PurePosixPath, tuple[str | None, tuple[str, ...]]]:
    """Source and hard negatives by path; empty without a table."""
    if not os.path.lexists(table):
        return {}
    advice = "make it UTF-8 with the columns path and source_tag, separated by commas"
    require_file(table, advice)
    rows: dict[PurePosixPath, tuple[str | None, tuple[str, ...]]] = {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restval="", strict=True)
            lines = list(reader)
        if not {"path", "source_tag"} <= set(reader.fieldnames or ()):
            raise ValueError("a column is missing")
    except (ValueError, csv.Error, OSError) as error:
        raise InputError(f"{table} cannot be used ({in_one_line(error)}): {advice}") from error
    for line in lines:
        path = PurePosixPath(line["path"].replace("\\", "/"))
        row = line["source_tag"] or None, split_sources(line.get("hard_negatives", ""))
        if rows.setdefault(path, row) != row:
            raise InputError(f"{table} has two different rows for {path}: keep one")
    return rows


def split_sources(cell: str) -> tuple[str, ...]:
    """The sources in a cell of `hard_negatives`."""
    return tuple(name.strip() for name in cell.split(SEPARATOR) if name.strip())


# ------------------------------------------------------------------------------------- loading


def load_photographs(
    folder: Path, photographs: Sequence[Photograph], size: int = 32, skip_unreadable: bool = False, advice: str = SKIP
) -> tuple[list[Photograph], torch.Tensor, list[str]]:
    """Read photographs as the classifier sees them.

    Returns the photographs that could be read, their images as (N, 3, size, size) uint8 sRGB, and the paths of the
    others. Each image is turned as its EXIF orientation says, converted to RGB (alpha over white, 16 bits to 8),
    cropped to its central square and reduced with Pillow's Lanczos filter, which widens with the reduction: detail too
    fine for `size` averages out instead of aliasing, and the rest stays as sharp as possible, which counts at 32
    pixels.

    InputError: broken or oversized images unless `skip_unreadable`; no image can be read; memory is too small.
    advice: how to skip them, in the words of the caller.
    """
    shape = len(photographs), 3, size, size
    require_memory(f"{len(photographs)} photographs of {size} pixels per side", prod(shape), torch.device("cpu"))
    images = torch.empty(shape, dtype=torch.uint8)
    readable: list[Photograph] = []
    errors: dict[Photograph, Exception] = {}
    pool = ThreadPoolExecutor()  # Pillow releases the interpreter while it decodes and resizes
    try:
        results = pool.map(lambda photograph: _try_read(folder / photograph.path, size), photographs)
        for photograph, result in zip(progress(photographs, "photographs"), results, strict=True):
            if isinstance(result, Exception):
                errors[photograph] = result
            else:
                images[len(readable)] = torch.from_numpy(result).permute(2, 0, 1)
                readable.append(photograph)
    finally:
        pool.shutdown(cancel_futures=True)  # so that Ctrl-C does not wait for the rest
    if errors and not (readable and skip_unreadable):
        first, reason = next(iter(errors.items()))
        raise InputError(
            f"{len(errors)} of {len(photographs)} photographs cannot be read, the first being "
            f"{folder / first.path} ({reason}): replace them{advice if readable else ''}"
        )
    return readable, images[: len(readable)], [str(photograph.path) for photograph in errors]


def _try_read(path: Path, size: int) -> np.ndarray | Exception:
    try:
        return np.array(read_square(path, size))  # a copy, since Pillow's memory is read-only
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        return error
