"""Find the images of a folder with their classes and sources, and reduce them in size."""

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
from torch import Tensor

from augment.classifiers.adapter import Label, class_index, nearest
from augment.memory import require_memory
from augment.progress import progress
from renderer.errors import InputError, single_line
from renderer.io.images import read_square
from train import console
from train.settings import label_names

SUFFIXES = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jfif",
    ".png",
    ".webp",
    ".bmp",
    ".tif",
    ".tiff",
    ".gif",
)
# macOS puts this folder into archives.
MACS = "__MACOSX"
# The name of a folder begins with this if the network lacks its class.
OTHER_PREFIX = "other_"
# The table of sources and objects in a folder.
TABLE = "photos.csv"
# The file in a folder that pnb-lab made.
DESCRIPTION = "lab.json"
# Separator of the sources in a cell of the column hard_negatives of photos.csv.
SEPARATOR = ";"
SKIP = ", or set skip_unreadable=True to skip them"


@dataclass(frozen=True)
class Photograph:
    """An image of a folder.

    Attributes:
        path: The path in the folder.
        label: The class, or a name that begins with "other_".
        source: Where the image comes from, if that is known.
        hard_negatives: The sources of negatives that the image is ranked against, in addition to
            its own source.
        mesh: The name of the object, if that is known.
    """

    path: PurePosixPath
    label: str
    source: str | None
    hard_negatives: tuple[str, ...] = ()
    mesh: str | None = field(default=None, repr=False)


@dataclass(frozen=True)
class _Row:
    """A row of photos.csv."""

    source: str | None = None
    hard_negatives: tuple[str, ...] = ()
    mesh: str | None = None


def require_outside(out: Path, folder: Path) -> None:
    """Check that a folder for results does not lie inside a folder of photographs.

    Otherwise the contact sheet would be scored as a photograph.

    Args:
        out: Folder for results.
        folder: Folder of photographs.

    Raises:
        InputError: If `out` lies inside `folder`.
    """
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"out={out} lies inside the photographs' folder: choose another")


def find_photographs(folder: Path, classes: Sequence[str], label: Label) -> list[Photograph]:
    """Find the images of a folder, each with its class.

    The folder has one of two layouts:

    - A sub-folder for each class. Sub-folders of other names hold negatives, and
      a warning names them unless their names begin with "other_".
    - Images only. All of them belong to the class `label`.

    Sub-folders and symbolic links are searched to any depth. Hidden files and
    files of other types (see `unsupported_files`) are skipped.

    A file photos.csv may have these columns:

    - path and source_tag: path of an image, and its source;
    - hard_negatives: other sources, separated by ";", whose negatives the image
      is ranked against;
    - mesh: name of the object.

    Args:
        folder: The folder.
        classes: Names of the classes of the network.
        label: Positive class, or a list of several.

    Returns:
        The images, sorted by path.

    Raises:
        InputError: If the folder is missing, unreadable or empty, or mixes both
            layouts; if `label` is not a class; if the name of a sub-folder is
            not a class but resembles `label`; if no sub-folder is named after a
            class; or if photos.csv lacks a column, contradicts itself, or names
            only missing files or a source without images.
    """
    labels = label_names(label)
    for name in labels:
        class_index(classes, name, "label")
    paths, files = _image_files(folder)
    has_class_folders = _has_class_folders(folder, paths, classes, labels)
    if len(labels) > 1 and not has_class_folders:
        raise InputError(
            f"{folder} has no class folders, and label names several classes: "
            "put its images into some",
        )
    rows = _read_table(folder / TABLE)
    _require_files_of_rows(folder / TABLE, rows, files, paths[0])

    photographs = []
    for path in paths:
        row = rows.get(path, _Row())
        name = path.parts[0] if has_class_folders else labels[0]
        photographs.append(Photograph(path, name, row.source, row.hard_negatives, row.mesh))
    known = {item.source for item in photographs}
    named = {name for item in photographs for name in item.hard_negatives}
    if named - known:
        source = min(named - known)
        raise InputError(
            f"{folder / TABLE} names hard_negatives of source {source!r}, which has no image",
        )
    return photographs


def _require_files_of_rows(
    table: Path,
    rows: dict[PurePosixPath, _Row],
    files: Sequence[PurePosixPath],
    example: PurePosixPath,
) -> None:
    """Warn of rows of photos.csv whose file does not exist.

    Args:
        table: Path of photos.csv.
        rows: Rows of the table by the path of the image.
        files: Paths of all files in the folder.
        example: Path of an image, for the error.

    Raises:
        InputError: If no row has a file that exists.
    """
    unknown = sorted(rows.keys() - set(files))
    if not unknown:
        return
    counts = f"{len(unknown)} of {len(rows)} rows"
    problem = f"{table} has {counts} for no file of the folder, like {unknown[0]}"
    if len(unknown) == len(rows):
        raise InputError(f"{problem}; give paths such as {example}")
    _warn_once(problem)


def class_folders(folder: Path, classes: Sequence[str]) -> list[str]:
    """List the classes that have a sub-folder.

    Args:
        folder: The folder.
        classes: The names of the network's classes.

    Returns:
        The names of the classes, sorted.

    Raises:
        InputError: If the folder is missing.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a folder of photographs")
    return [name for name in folder_names(folder) if name in classes]


def folder_names(folder: Path) -> list[str]:
    """Return the sorted names of the folders in a folder, without hidden ones."""
    folders = [entry.name for entry in folder.iterdir() if entry.is_dir()]
    return sorted(name for name in folders if not is_hidden(name))


def find_unlabeled(folder: Path) -> list[Photograph]:
    """Find all images of a folder and its sub-folders. They have no class.

    Args:
        folder: The folder.

    Returns:
        The images, sorted by path.

    Raises:
        InputError: If there is no such folder, or it holds no image.
    """
    paths, _ = _image_files(folder)
    return [Photograph(path, "", None) for path in paths]


def _image_files(folder: Path) -> tuple[list[PurePosixPath], list[PurePosixPath]]:
    """List the files of a folder and its sub-folders.

    Returns:
        Sorted paths of the images, and paths of all files, relative to the
        folder.

    Raises:
        InputError: If the folder does not exist or holds no image.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a folder of photographs")
    files = list(_files(folder))
    paths = sorted(path for path in files if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise InputError(
            f"{folder} holds no photographs: put some there ({', '.join(SUFFIXES)})",
        )
    return paths, files


def unsupported_files(folder: Path) -> list[PurePosixPath]:
    """Find the files of a folder whose type is not supported.

    Args:
        folder: The folder.

    Returns:
        Sorted paths, relative to the folder.
    """
    own = (PurePosixPath(TABLE), PurePosixPath(DESCRIPTION))
    others = [path for path in _files(folder) if path not in own]
    return sorted(path for path in others if path.suffix.lower() not in SUFFIXES)


@cache
def _warn_once(text: str) -> None:
    """Print a warning, but not again."""
    console.warning(text)


def is_hidden(name: str) -> bool:
    """Return whether a file or folder belongs to the system rather than to the user.

    Args:
        name: The name of the file or folder.

    Returns:
        Whether it is hidden.
    """
    return name.startswith(".") or name == MACS


def _files(folder: Path) -> Iterator[PurePosixPath]:
    """Yield the paths of all files that are not hidden, relative to the folder.

    Symbolic links are followed, except if they lead to a folder around them.
    """

    def refuse(error: OSError) -> NoReturn:
        raise error

    for root, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        real_root = Path(os.path.realpath(root))
        to_visit = []
        for name in folders:
            target = os.path.realpath(os.path.join(root, name))
            leads_back = real_root.is_relative_to(target)
            if not is_hidden(name) and not leads_back:
                to_visit.append(name)
        # os.walk visits the folders in this list next.
        folders[:] = to_visit
        parent = PurePosixPath(Path(root).relative_to(folder).as_posix())
        yield from (parent / name for name in files if not is_hidden(name))


def _has_class_folders(
    folder: Path,
    paths: Sequence[PurePosixPath],
    classes: Sequence[str],
    labels: Sequence[str],
) -> bool:
    """Return whether the images lie in class folders, and check the names of the folders.

    Args:
        folder: Folder of photographs.
        paths: Paths of its images, relative to the folder.
        classes: Names of the classes of the network.
        labels: Positive classes.

    Raises:
        InputError: If no folder is named after a class, if the name of a folder
            that is no class resembles a label, or if images lie beside the
            folders.
    """
    names = folder_names(folder)
    others = [name for name in names if name not in classes and not name.startswith(OTHER_PREFIX)]
    for name in others:
        # If `others` has all names, no folder is named after a class.
        if others == names or any(_is_like(name, label) for label in labels):
            suggestions = nearest(name, classes)
            raise InputError(
                f"{folder / name} "
                f"is not named after a class of the model (such as {suggestions}): "
                f"rename it, to {OTHER_PREFIX}{name} if it shows hard negatives",
            )
    if others:
        count = f"{len(others)} of {len(names)} folders in {folder}"
        shown = ", ".join(others)
        _warn_once(
            f"{count} are not named after a class of the model and count as negatives: {shown}"
        )
    loose = [path for path in paths if len(path.parts) == 1]
    if names and loose:
        raise InputError(
            f"{folder / loose[0]} lies beside class folders: move it into the folder of its class",
        )
    return bool(names)


def _is_like(name: str, label: str) -> bool:
    """Return whether the name of a folder contains a label, or is almost the same."""
    return label in name.lower() or bool(get_close_matches(name.lower(), [label]))


def _read_table(table: Path) -> dict[PurePosixPath, _Row]:
    """Read photos.csv.

    Args:
        table: Path of the file, which may be missing.

    Returns:
        Rows by the path of the image. Empty without a file.

    Raises:
        InputError: If the file is damaged or contradicts itself.
    """
    rows: dict[PurePosixPath, _Row] = {}
    if not os.path.lexists(table):
        return rows
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            for line in csv.DictReader(file, restval="", strict=True):
                path = PurePosixPath(line["path"].replace("\\", "/"))
                row = _Row(
                    line["source_tag"] or None,
                    split_sources(line.get("hard_negatives", "")),
                    line.get("mesh") or None,
                )
                if rows.setdefault(path, row) != row:
                    raise ValueError(f"two different rows for {path}")
    except (ValueError, LookupError, csv.Error, OSError) as error:
        columns = "the columns path and source_tag, separated by commas"
        raise InputError(
            f"{table} cannot be used ({single_line(error)}): "
            f"make it UTF-8 with {columns}, and a row per file",
        ) from error
    return rows


def split_sources(cell: str) -> tuple[str, ...]:
    """Split a cell of the column hard_negatives into the names of sources.

    Args:
        cell: The cell, such as "lab;shop".

    Returns:
        The names.
    """
    return tuple(name.strip() for name in cell.split(SEPARATOR) if name.strip())


def load_photographs(
    folder: Path,
    photographs: Sequence[Photograph],
    size: int = 32,
    skip_unreadable: bool = False,
    advice: str = SKIP,
) -> tuple[list[Photograph], Tensor, list[str]]:
    """Read photographs as a network sees them.

    Each image is turned as its EXIF orientation says and converted to RGB. Alpha is blended over
    white, and 16 bits become 8. The central square is reduced with Pillow's Lanczos filter, which
    widens with the reduction. Detail too fine for `size` then averages out instead of aliasing.

    Args:
        folder: The folder.
        photographs: The photographs to read.
        size: The pixels per side.
        skip_unreadable: Whether broken and oversized images are skipped.
        advice: How to skip them, in the words of the caller, which ends the error's sentence.

    Returns:
        The photographs that could be read, their images (N, 3, size, size) as uint8 sRGB, and the
        paths of the others.

    Raises:
        InputError: If an image is broken or oversized and is not to be skipped, no image can be
            read, or memory is too small.
    """
    shape = (len(photographs), 3, size, size)
    cpu = torch.device("cpu")
    require_memory(f"{len(photographs)} photographs of {size} pixels per side", prod(shape), cpu)
    images = torch.empty(shape, dtype=torch.uint8)
    errors = _read_into(images, folder, photographs)

    readable = []
    broken = []
    for row, (photograph, error) in enumerate(zip(photographs, errors, strict=True)):
        if error is None:
            readable.append(row)
        else:
            broken.append((photograph.path, error))
    if broken and not (readable and skip_unreadable):
        path, error = broken[0]
        raise InputError(
            f"{len(broken)} of {len(photographs)} photographs cannot be read, "
            f"the first being {folder / path} ({error}): "
            f"replace them{advice if readable else ''}",
        )
    if broken:
        images = images[readable]
    return [photographs[row] for row in readable], images, [str(path) for path, _ in broken]


def _read_into(
    images: Tensor,
    folder: Path,
    photographs: Sequence[Photograph],
) -> list[Exception | None]:
    """Read photographs into the rows of a tensor.

    Args:
        images: Tensor that is filled, uint8, shape (N, 3, size, size).
        folder: Folder of the photographs.
        photographs: The N photographs.

    Returns:
        For each photograph, the error that reading it raised, or None.
    """
    paths = [folder / photograph.path for photograph in photographs]
    # Pillow releases Python's lock while it decodes and resizes, so threads help.
    pool = ThreadPoolExecutor()
    try:
        errors = pool.map(_read_image, images, paths)
        return list(progress(errors, "photographs", len(paths)))
    finally:
        # Ctrl-C then ends the command without reading the remaining images.
        pool.shutdown(cancel_futures=True)


def _read_image(image: Tensor, path: Path) -> Exception | None:
    """Read the central square of a photograph into a tensor.

    Args:
        image: Tensor that is filled, uint8, shape (3, size, size).
        path: File of the photograph.

    Returns:
        The error that reading the file raised. None without an error.
    """
    try:
        # The memory of Pillow is read-only, and np.array copies it.
        pixels = np.array(read_square(path, image.shape[-1]))
    except Exception as error:
        # The decoders of Pillow raise errors of almost any type.
        return error
    image.copy_(torch.from_numpy(pixels).permute(2, 0, 1))
    return None
