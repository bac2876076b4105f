"""Find the images of a folder, tell their classes, and reduce them to the classifier's size."""

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
from renderer.errors import InputError, require_file
from renderer.io.images import read_square
from train.run_folder.logs import console

SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
MACS = "__MACOSX"  # what macOS puts into archives, for itself
FOREIGN = "other_"  # starts the name of a folder whose class the model lacks
TABLE = "photos.csv"
DESCRIPTION = "lab.json"  # of a folder that scripts/lab.py made
SEPARATOR = ";"  # between the sources in a cell of its look_alikes
SKIP = ", or set skip_unreadable=true (evaluate.skip_unreadable=true in training) to skip them"


@dataclass(frozen=True)
class Photograph:
    """An image: its path relative to the folder, its class (or `other_*`) and, where known, its source.

    look_alikes: the sources of the other things that it is ranked against, besides its own.
    """

    path: PurePosixPath
    label: str
    source: str | None
    look_alikes: tuple[str, ...] = ()


def require_outside(out: Path, folder: Path) -> None:
    """InputError where what is written of photographs would lie among them: the contact sheet would be scored, too."""
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"out={out} lies inside the photographs' folder: choose another")


def find_photographs(folder: Path, classes: Sequence[str], label: str) -> list[Photograph]:
    """The images of a folder, sorted by path, each with its class.

    The folder either holds one sub-folder per class, named exactly as in `classes` (or `other_NAME` for a
    class the model lacks), or holds images only, which are then all of class `label`. Sub-folders are
    searched to any depth, also where they are symbolic links; hidden files are passed over, and so are other kinds of
    file, which `left_out` tells. `photos.csv` in the folder, if there, gives sources by its columns `path` and
    `source_tag`, and by `look_alikes`, if it has that, the other sources, separated by `;`, whose images of other
    things an image is ranked against.

    Raises InputError for a folder that is missing, unreadable, empty or mixes both layouts, for a sub-folder or `label`
    that is no class, for a `photos.csv` without those columns, that names no file of the folder, or one twice with
    other words, and for look-alikes of a source that is nowhere.
    """
    class_index(classes, label, "label")
    paths = _image_paths(folder)
    has_class_folders = _check_layout(folder, paths, classes)
    rows = _read_table(folder / TABLE)
    if nowhere := sorted(rows.keys() - set(_files(folder))):
        said = (
            f"{folder / TABLE} has {len(nowhere)} of {len(rows)} rows for no file of the folder: {nowhere[0]}, for one"
        )
        if len(nowhere) == len(rows):
            raise InputError(f"{said}; give paths such as {paths[0]}")
        console.warning(said)
    photographs = [
        Photograph(path, path.parts[0] if has_class_folders else label, *rows.get(path, (None, ()))) for path in paths
    ]
    _check_look_alikes(folder / TABLE, photographs)
    return photographs


def left_out(folder: Path) -> list[PurePosixPath]:
    """The files of a folder, as `find_photographs` searches it, that are of no kind that is read; sorted."""
    return sorted(
        path for path in _files(folder) if not _is_image(folder, path) and str(path) not in (TABLE, DESCRIPTION)
    )


def _image_paths(folder: Path) -> list[PurePosixPath]:
    if not folder.is_dir():
        fault = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {fault}: name a folder of photographs")
    files = list(_files(folder))
    paths = sorted(path for path in files if _is_image(folder, path))
    if not paths:
        others = f" among its {len(files)} files" if files else ""
        raise InputError(f"{folder} holds no photographs{others}: put some there ({', '.join(SUFFIXES)})")
    return paths


def _files(folder: Path) -> Iterator[PurePosixPath]:
    """What is not hidden, by its path in the folder; links are followed, but for those to a folder they lie in."""

    def refuse(error: OSError) -> NoReturn:
        raise InputError(f"{error.filename} cannot be read: {error.strerror}") from error

    for root, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        inside = os.path.realpath(root)
        folders[:] = [
            name
            for name in folders
            if not is_hidden(name) and not Path(inside).is_relative_to(os.path.realpath(os.path.join(root, name)))
        ]
        at = PurePosixPath(Path(root).relative_to(folder).as_posix())
        yield from (at / name for name in files if not is_hidden(name))


def _is_image(folder: Path, path: PurePosixPath) -> bool:
    """Also of a link to nothing, which is an image that cannot be read; but not of a pipe, whose end never comes."""
    return path.suffix.lower() in SUFFIXES and ((folder / path).is_file() or not (folder / path).exists())


def is_hidden(name: str) -> bool:
    """Whether a file or folder is none of the user's."""
    return name.startswith(".") or name == MACS


def _check_layout(folder: Path, paths: Sequence[PurePosixPath], classes: Sequence[str]) -> bool:
    """Whether the folder is made of class folders; InputError if a name among them is wrong."""
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
    """Source and look-alikes by path; nothing without a table."""
    if not os.path.lexists(table):
        return {}
    advice = "make it UTF-8 with the columns path and source_tag, separated by commas"
    require_file(table, advice)
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            header, *lines = csv.reader(file, strict=True)
        path, tag = header.index("path"), header.index("source_tag")
    except (ValueError, csv.Error, OSError) as error:  # no header, a column missing, not UTF-8, or not a table
        raise InputError(f"{table} cannot be used: {advice}") from error
    table_rows = [dict(zip(header, line, strict=False)) for line in lines if len(line) > max(path, tag)]
    rows: dict[PurePosixPath, tuple[str | None, tuple[str, ...]]] = {}
    for row in table_rows:
        place = PurePosixPath(row["path"].replace("\\", "/"))
        told = row["source_tag"] or None, split_sources(row.get("look_alikes", ""))
        if rows.setdefault(place, told) != told:
            raise InputError(f"{table} has two rows for {place}, which differ: keep one")
    return rows


def split_sources(text: str) -> tuple[str, ...]:
    """The sources that a cell of `look_alikes` names."""
    return tuple(name.strip() for name in text.split(SEPARATOR) if name.strip())


def _check_look_alikes(table: Path, photographs: Sequence[Photograph]) -> None:
    sources = {photograph.source for photograph in photographs if photograph.source is not None}
    for photograph in photographs:
        if unknown := set(photograph.look_alikes) - sources:
            raise InputError(
                f"{table} pairs {photograph.path} with look_alikes of source {min(unknown)!r}, of which there is no "
                f"image: name one of {', '.join(sorted(sources))}"
            )


def load_photographs(
    folder: Path, photographs: Sequence[Photograph], size: int = 32, skip_unreadable: bool = False, advice: str = SKIP
) -> tuple[list[Photograph], torch.Tensor, list[str]]:
    """Read photographs as the classifier sees them.

    Returns the photographs that could be read, their images as (N, 3, size, size) uint8 sRGB, and the paths
    of those that could not. Each image is turned as its EXIF orientation says, brought to RGB (alpha over
    white, 16 bits to 8), cropped to its central square and reduced with Pillow's Lanczos filter, which widens
    with the reduction: detail too fine for `size` averages out rather than turning into false patterns, and
    of what fits the most is kept, which counts at 32 pixels.

    Raises InputError at broken or oversized images unless `skip_unreadable`, if no image can be read, and where the
    images do not fit into the memory.
    advice: how they could be skipped, in the words of whoever calls.
    """
    shape = len(photographs), 3, size, size
    require_memory(f"{len(photographs)} photographs of {size} pixels per side", prod(shape), torch.device("cpu"))
    images = torch.empty(shape, dtype=torch.uint8)
    kept: list[Photograph] = []
    errors: dict[Photograph, Exception] = {}
    pool = ThreadPoolExecutor()  # Pillow releases the interpreter while it decodes and resizes
    try:
        read = pool.map(lambda photograph: _try_read(folder / photograph.path, size), photographs)
        for photograph, result in zip(progress(photographs, "photographs"), read, strict=True):
            if isinstance(result, Exception):
                errors[photograph] = result
            else:
                images[len(kept)] = torch.from_numpy(result).permute(2, 0, 1)
                kept.append(photograph)
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C does not wait for the others
    if errors and not (kept and skip_unreadable):
        first, reason = next(iter(errors.items()))
        raise InputError(
            f"{len(errors)} of {len(photographs)} photographs cannot be read, the first being "
            f"{folder / first.path} ({reason}): replace them{advice if kept else ''}"
        )
    return kept, images[: len(kept)], [str(photograph.path) for photograph in errors]


def _try_read(path: Path, size: int) -> np.ndarray | Exception:
    try:
        return np.array(read_square(path, size))  # torch takes no memory of Pillow's
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        return error
