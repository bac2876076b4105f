"""Find the pictures of a folder, tell their classes, and reduce them to the classifier's size."""

import csv
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from renderer.errors import InputError
from renderer.image_files import read_square
from train.classes import class_index, nearest_class

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
FOREIGN = "other_"  # starts the name of a folder whose class the model lacks
TABLE = "photos.csv"


@dataclass(frozen=True)
class Photograph:
    """A picture: its path relative to the folder, its class (or `other_*`) and, where known, its source."""

    path: PurePosixPath
    label: str
    source: str | None


def find_photographs(folder: Path, classes: Sequence[str], label: str) -> list[Photograph]:
    """The pictures of a folder, sorted by path, each with its class.

    The folder either holds one sub-folder per class, named exactly as in `classes` (or `other_NAME` for a
    class the model lacks), or holds pictures only, which are then all of class `label`. Sub-folders are
    searched to any depth; hidden files are passed over. `photos.csv` in the folder, if there, gives sources
    by its columns `path` and `source_tag`.

    Raises InputError for a folder that is missing, empty or mixes both layouts, for a sub-folder or `label`
    that is no class, and for a `photos.csv` without those columns.
    """
    class_index(classes, label, "label")
    paths = _picture_paths(folder)
    has_class_folders = _check_layout(folder, paths, classes)
    sources = _read_sources(folder / TABLE)
    return [Photograph(path, path.parts[0] if has_class_folders else label, sources.get(path)) for path in paths]


def _picture_paths(folder: Path) -> list[PurePosixPath]:
    if not folder.is_dir():
        fault = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {fault}: name a folder of photographs")
    below = ((file, PurePosixPath(file.relative_to(folder).as_posix())) for file in folder.rglob("*"))
    paths = [path for file, path in below if _is_picture(path) and file.is_file()]
    if not paths:
        raise InputError(f"{folder} holds no photographs: put some there ({', '.join(SUFFIXES)})")
    return sorted(paths)


def _is_picture(path: PurePosixPath) -> bool:
    return path.suffix.lower() in SUFFIXES and not any(map(_is_hidden, path.parts))


def _is_hidden(name: str) -> bool:
    return name.startswith(".")


def _check_layout(folder: Path, paths: Sequence[PurePosixPath], classes: Sequence[str]) -> bool:
    """Whether the folder is made of class folders; InputError if a name among them is wrong."""
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not _is_hidden(entry.name))
    for name in names:
        if name not in classes and not name.startswith(FOREIGN):
            raise InputError(
                f"{folder / name} is not named after a class of the model (the nearest is "
                f"'{nearest_class(classes, name)}'): rename it, to {FOREIGN}{name} if the model lacks its class"
            )
    loose = [path for path in paths if len(path.parts) == 1]
    if names and loose:
        raise InputError(f"{folder / loose[0]} lies beside class folders: move it into the folder of its class")
    return bool(names)


def _read_sources(table: Path) -> dict[PurePosixPath, str]:
    if not table.is_file():
        return {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = csv.reader(file)
        path, tag = header.index("path"), header.index("source_tag")
    except (ValueError, csv.Error) as error:  # no header, a column missing, not UTF-8, or not a table
        raise InputError(f"{table} cannot be used: make it UTF-8 with the columns path and source_tag") from error
    return {PurePosixPath(row[path]): row[tag] for row in rows if len(row) > max(path, tag) and row[tag]}


def load_photographs(
    folder: Path, photographs: Sequence[Photograph], size: int = 32, skip_unreadable: bool = False
) -> tuple[list[Photograph], torch.Tensor, list[str]]:
    """Read photographs as the classifier sees them.

    Returns the photographs that could be read, their pictures as (N, 3, size, size) uint8 sRGB, and the paths
    of those that could not. Each picture is turned as its EXIF orientation says, brought to RGB (alpha over
    white, 16 bits to 8), cropped to its central square and reduced with Pillow's Lanczos filter, which widens
    with the reduction: detail too fine for `size` averages out rather than turning into false patterns, and
    of what fits the most is kept, which counts at 32 pixels.

    Raises InputError at broken or oversized pictures unless `skip_unreadable`, and if no picture can be read.
    """
    with ThreadPoolExecutor() as pool:  # Pillow releases the interpreter while it decodes and resizes
        read = pool.map(lambda photograph: _try_read(folder / photograph.path, size), photographs)
        results = dict(zip(photographs, read, strict=True))
    errors = {photograph: result for photograph, result in results.items() if isinstance(result, Exception)}
    kept = [photograph for photograph in photographs if photograph not in errors]
    if errors and not (kept and skip_unreadable):
        first, reason = next(iter(errors.items()))
        advice = (
            ", or set skip_unreadable=true (evaluate.skip_unreadable=true in training) to skip them" if kept else ""
        )
        raise InputError(
            f"{len(errors)} of {len(photographs)} photographs cannot be read, the first being "
            f"{folder / first.path} ({reason}): replace them{advice}"
        )
    pixels = torch.from_numpy(np.stack([results[photograph] for photograph in kept]))
    return kept, pixels.permute(0, 3, 1, 2).contiguous(), [str(photograph.path) for photograph in errors]


def _try_read(path: Path, size: int) -> np.ndarray | Exception:
    try:
        return read_square(path, size)
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        return error
