"""Find the images of a folder with their classes and sources, and reduce them to the classifier's size."""

import csv
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from math import prod
from pathlib import Path, PurePosixPath
from typing import NoReturn

import numpy as np
import torch

from augment.classifiers.adapter import Label, class_index, label_names, nearest
from augment.utils import progress, require_memory
from renderer.errors import InputError, in_one_line
from renderer.io.images import read_square
from train import console

SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
MACS = "__MACOSX"  # macOS puts this folder into archives
FOREIGN = "other_"  # starts the name of a folder whose class the model lacks
TABLE = "photos.csv"
DESCRIPTION = "lab.json"  # of a folder that pnb-lab made
SEPARATOR = ";"  # between the sources in a cell of hard_negatives
SKIP = ", or set skip_unreadable=true (evaluate.skip_unreadable=true in training) to skip them"


@dataclass(frozen=True)
class Photograph:
    """An image: its path relative to the folder, its class (or `other_*`) and, if known, its source and its object.

    hard_negatives: the sources of other things that it is ranked against, besides its own. mesh: the object's name.
    """

    path: PurePosixPath
    label: str
    source: str | None
    hard_negatives: tuple[str, ...] = ()
    mesh: str | None = field(default=None, repr=False)


def require_outside(out: Path, folder: Path) -> None:
    """InputError if outputs would lie among the photographs, where the contact sheet would be scored, too."""
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"out={out} lies inside the photographs' folder: choose another")


def find_photographs(folder: Path, classes: Sequence[str], label: Label) -> list[Photograph]:
    """The images of a folder, sorted by path, each with its class.

    The folder holds either a sub-folder per class, named as in `classes`, or images only, which are then all of class
    `label`, if that is one. A sub-folder of no class shows other things, with a warning unless it is named `other_*`.
    Sub-folders are searched to any depth, through symbolic links, too; hidden files and other kinds (`left_out`) are
    skipped. A `photos.csv` gives sources in its columns `path` and `source_tag`; its column `hard_negatives` names
    further sources, separated by `;`, and `mesh` the object, over which intervals are taken, too.

    InputError: the folder is missing, unreadable, empty or mixes both layouts; `label` is not a class; a sub-folder is
    none, but has a name like `label`; no sub-folder is a class; `photos.csv` lacks its columns, contradicts itself, or
    names no file of the folder or a source without images.
    """
    only, *others = label_names(label)
    for name in (only, *others):
        class_index(classes, name, "label")
    paths, files = _image_files(folder)
    nested = _has_class_folders(folder, paths, classes, label_names(label))
    if others and not nested:
        raise InputError(f"{folder} has no class folders, and label names several classes: put its images into some")
    rows = _read_table(folder / TABLE)
    if unknown := sorted(rows.keys() - set(files)):
        fault = f"{folder / TABLE} has {len(unknown)} of {len(rows)} rows for no file of the folder, like {unknown[0]}"
        if len(unknown) == len(rows):
            raise InputError(f"{fault}; give paths such as {paths[0]}")
        _warn_once(fault)
    photographs = [
        Photograph(path, path.parts[0] if nested else only, *rows.get(path, (None, (), None))) for path in paths
    ]
    sources = {item.source for item in photographs}
    if missing := {name for item in photographs for name in item.hard_negatives} - sources:
        raise InputError(f"{folder / TABLE} names hard_negatives of source {min(missing)!r}, which has no image")
    return photographs


def find_unlabeled(folder: Path) -> list[Photograph]:
    """All images of a folder and its sub-folders, sorted by path, of no class. InputError: no folder, or none in it."""
    return [Photograph(path, "", None) for path in _image_files(folder)[0]]


def _image_files(folder: Path) -> tuple[list[PurePosixPath], list[PurePosixPath]]:
    """The images of a folder, sorted, and all of its files; InputError: it is no folder, or holds no image."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a folder of photographs")
    files = list(_files(folder))
    if not (paths := sorted(path for path in files if path.suffix.lower() in SUFFIXES)):
        raise InputError(f"{folder} holds no photographs: put some there ({', '.join(SUFFIXES)})")
    return paths, files


def left_out(folder: Path) -> list[PurePosixPath]:
    """The files of a folder that are of no kind that is read; sorted."""
    known = PurePosixPath(TABLE), PurePosixPath(DESCRIPTION)
    return sorted(path for path in _files(folder) if path.suffix.lower() not in SUFFIXES and path not in known)


@cache
def _warn_once(text: str) -> None:
    console.warning(text)


def is_hidden(name: str) -> bool:
    """Whether a file or folder belongs to the system rather than to the user."""
    return name.startswith(".") or name == MACS


def _files(folder: Path) -> Iterator[PurePosixPath]:
    """Paths of files in the folder that are not hidden; links are followed, except to a folder that they lie in."""

    def refuse(error: OSError) -> NoReturn:
        raise error

    for root, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        inside = Path(os.path.realpath(root))
        targets = {name: os.path.realpath(os.path.join(root, name)) for name in folders if not is_hidden(name)}
        folders[:] = [name for name, target in targets.items() if not inside.is_relative_to(target)]
        parent = PurePosixPath(Path(root).relative_to(folder).as_posix())
        yield from (parent / name for name in files if not is_hidden(name))


def _has_class_folders(
    folder: Path, paths: Sequence[PurePosixPath], classes: Sequence[str], labels: Sequence[str]
) -> bool:
    """Whether images lie in class folders; InputError for folders of no class alone, or for one that may be meant for a
    label, or for images beside folders."""
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not is_hidden(entry.name))
    others = [name for name in names if name not in classes and not name.startswith(FOREIGN)]
    for name in others:
        likely = [label for label in labels if label in name.lower() or get_close_matches(name.lower(), [label])]
        if likely or others == names:
            fault = f"is not named after a class of the model (such as {nearest(name, classes)})"
            raise InputError(f"{folder / name} {fault}: rename it, to {FOREIGN}{name} if it shows other things")
    if others:
        count = f"{len(others)} of {len(names)} folders in {folder}"
        _warn_once(f"{count} are of no class of the model and count as other things: {', '.join(others)}")
    if names and (loose := [path for path in paths if len(path.parts) == 1]):
        raise InputError(f"{folder / loose[0]} lies beside class folders: move it into the folder of its class")
    return bool(names)


def _read_table(table: Path) -> dict[PurePosixPath, tuple[str | None, tuple[str, ...], str | None]]:
    """Source, hard negatives and mesh by path; empty without a table."""
    rows: dict[PurePosixPath, tuple[str | None, tuple[str, ...], str | None]] = {}
    if not os.path.lexists(table):
        return rows
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            for line in csv.DictReader(file, restval="", strict=True):
                path = PurePosixPath(line["path"].replace("\\", "/"))
                negatives = split_sources(line.get("hard_negatives", ""))
                row = line["source_tag"] or None, negatives, line.get("mesh") or None
                if rows.setdefault(path, row) != row:
                    raise ValueError(f"two different rows for {path}")
    except (ValueError, LookupError, csv.Error, OSError) as error:
        advice = "make it UTF-8 with the columns path and source_tag, separated by commas, and a row per file"
        raise InputError(f"{table} cannot be used ({in_one_line(error)}): {advice}") from error
    return rows


def split_sources(cell: str) -> tuple[str, ...]:
    """The sources in a cell of `hard_negatives`."""
    return tuple(name.strip() for name in cell.split(SEPARATOR) if name.strip())


def load_photographs(
    folder: Path, photographs: Sequence[Photograph], size: int = 32, skip_unreadable: bool = False, advice: str = SKIP
) -> tuple[list[Photograph], torch.Tensor, list[str]]:
    """Read photographs as the classifier sees them.

    Returns the photographs that could be read, their images as (N, 3, size, size) uint8 sRGB, and the paths of the
    others. Each image is turned as its EXIF orientation says, converted to RGB (alpha over white, 16 bits to 8),
    cropped to its central square and reduced with Pillow's Lanczos filter, which widens with the reduction: detail too
    fine for `size` averages out instead of aliasing.

    InputError: broken or oversized images unless `skip_unreadable`; no image can be read; memory is too small.
    advice: how to skip them, in the words of the caller.
    """
    shape = len(photographs), 3, size, size
    require_memory(f"{len(photographs)} photographs of {size} pixels per side", prod(shape), torch.device("cpu"))
    images = torch.empty(shape, dtype=torch.uint8)

    def read(row: int) -> Exception | None:
        try:
            pixels = np.array(read_square(folder / photographs[row].path, size))  # a copy: Pillow's memory is read-only
        except Exception as error:  # Pillow's decoders raise almost anything at a broken file
            return error
        images[row] = torch.from_numpy(pixels).permute(2, 0, 1)
        return None

    pool = ThreadPoolExecutor()  # Pillow releases the interpreter while it decodes and resizes
    try:
        results = pool.map(read, range(len(photographs)))
        errors = [error for _, error in zip(progress(photographs, "photographs"), results, strict=True)]
    finally:
        pool.shutdown(cancel_futures=True)  # so that Ctrl-C does not wait for the rest
    rows = [row for row, error in enumerate(errors) if error is None]
    broken = [(item.path, error) for item, error in zip(photographs, errors, strict=True) if error is not None]
    if broken and not (rows and skip_unreadable):
        first = f"{folder / broken[0][0]} ({broken[0][1]})"
        fault = f"{len(broken)} of {len(photographs)} photographs cannot be read, the first being {first}"
        raise InputError(f"{fault}: replace them{advice if rows else ''}")
    return [photographs[row] for row in rows], images[rows] if broken else images, [str(path) for path, _ in broken]
