"""Find the images of a folder with their classes and sources, and reduce them in size."""

import csv
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import NoReturn

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from augment.classifier import Label
from augment.network import say_once
from augment.progress import progress
from augment.tasks.classification import class_index, nearest
from renderer.errors import InputError, composed, explained, require_memory
from renderer.io.images import SUFFIXES, is_hidden, read_center
from renderer.settings import Size, height_and_width
from train.data.photo import DESCRIPTION, TABLE, Photograph, split_sources
from train.settings import OTHER_PREFIX, label_names

# Suffixes of photographs that are not read.
UNREAD = {".heic", ".heif", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw"} - {*SUFFIXES}
# Largest number of classes that are positive because they have a sub-folder. The scores of each
# class take as much time and memory as all photographs.
MAX_LABELS = 50
# What `Photograph` has after its path and label.
Row = tuple[str | None, tuple[str, ...], str | None]


def require_outside(out: Path, folder: Path) -> None:
    """Check that the folder for results does not lie inside the folder of photographs.

    Otherwise the pictures among the results would later be scored as
    photographs.
    """
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"out={out} lies inside {folder}, the photographs: choose another")


def find_photographs(folder: Path, classes: Sequence[str], label: Label) -> list[Photograph]:
    """Find the images of a folder, and the class of each image.

    The folder has one of two layouts:

    - A subfolder for each class. All images in subfolders with other names are
      negatives. A warning lists these subfolders, except if their names begin
      with "other_".
    - Images only. All of them belong to the class `label`.

    Subfolders and symbolic links are searched to any depth. Hidden files are
    skipped, and so are files that are no images (see `unsupported_files`).

    The folder may have a table photos.csv with these columns:

    - path: path of an image;
    - source_tag: name of the collection that the image comes from;
    - hard_negatives: names of other sources, separated by ";". A positive image
      is ranked against their negatives, too;
    - mesh: name of the photographed object.
    """
    labels = label_names(label)
    classes = [*map(composed, classes)]
    for name in labels:
        class_index(classes, name, "label")
    paths, files = _image_files(folder)
    has_class_folders = _has_class_folders(folder, paths, classes, labels)
    if len(labels) > 1 and not has_class_folders:
        raise InputError(f"{folder} has several labels, but no folders of classes: make some")
    table = folder / TABLE
    # Source, hard negatives and mesh of each path in photos.csv.
    rows = _read_table(table)
    missing = sorted(rows.keys() - set(map(_composed_path, files)))
    if missing:
        counts = f"{len(missing)} of {len(rows)} rows"
        fault = f"{table} names a missing file in {counts}, such as {missing[0]}"
        if len(missing) == len(rows):
            raise InputError(f"{fault}: give paths in the folder, such as {paths[0]}")
        say_once(fault)
    photographs = []
    for path in paths:
        # The class is the first folder in the path.
        name = composed(path.parts[0]) if has_class_folders else labels[0]
        row = rows.get(_composed_path(path), (None, (), None))
        photographs.append(Photograph(path, name, *row))
    hard_negatives = {name for item in photographs for name in item.hard_negatives}
    unknown = hard_negatives - {item.source for item in photographs}
    if unknown:
        fault = f"{table} names {min(unknown)!r} in the column hard_negatives"
        raise InputError(f"{fault}, but no image has this source: correct it")
    return photographs


def choose_labels(
    folder: Path, classes: Sequence[str], label: str | int | Sequence[str | int] | None
) -> list[str]:
    """Choose the positive classes, on whose photographs recall is measured.

    None chooses all classes of the network that have a sub-folder with images.
    """
    if label is not None:
        return [classes[class_index(classes, name, "label")] for name in label_names(label)]
    shown = {composed(path.parts[0]) for path in _image_files(folder)[0]}
    labels = sorted(name for name in classes if composed(name) in shown)
    if not labels:
        fault = f"photos={folder} has no sub-folder of images named by a class"
        raise InputError(f"{fault}, such as {classes[0]}: rename them, or give classes or label")
    if len(labels) > MAX_LABELS:
        fault = f"photos={folder} has {len(labels)} classes, more than {MAX_LABELS}"
        raise InputError(f"{fault}: choose the positive classes with label", "label")
    return labels


def folder_names(folder: Path) -> list[str]:
    """Return the sorted names of the subfolders, in the form of `composed`, without hidden ones."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give a folder of photographs")
    folders = {composed(entry.name) for entry in folder.iterdir() if entry.is_dir()}
    return sorted(name for name in folders if not is_hidden(name))


def find_unlabeled(folder: Path) -> list[Photograph]:
    """Find all images of a folder and its subfolders, without their classes.

    Photographs of types that are not read are named in a warning.
    """
    paths, all_paths = _image_files(folder)
    unread = [path for path in all_paths if path.suffix.lower() in UNREAD]
    if unread:
        fault = f"{len(unread)} photographs of {folder} are left out, such as {unread[0]}"
        say_once(f"{fault}: save them as JPEG or PNG")
    return [Photograph(path, label="", source=None) for path in paths]


def _image_files(folder: Path) -> tuple[list[PurePosixPath], list[PurePosixPath]]:
    """List the image files, and all files, of a folder and its subfolders.

    Hidden files are left out. Return the sorted images, and all files, relative to the folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give a folder of photographs")
    all_paths = list(visible_files(folder))
    image_paths = sorted(path for path in all_paths if _is_image(folder, path))
    if not image_paths:
        raise InputError(f"{folder} holds no photographs: add some ({', '.join(SUFFIXES)})")
    return image_paths, all_paths


def unsupported_files(folder: Path) -> list[PurePosixPath]:
    """Find the files of a folder that are no images of a supported type.

    Files that the library itself reads or writes there, photos.csv and
    lab.json, are left out.
    """
    others = {*visible_files(folder)} - {PurePosixPath(TABLE), PurePosixPath(DESCRIPTION)}
    return sorted(path for path in others if not _is_image(folder, path))


def _composed_path(path: PurePosixPath) -> PurePosixPath:
    """Return a path whose names compare equal to those of the same path in photos.csv."""
    return PurePosixPath(composed(str(path)))


def _is_image(folder: Path, path: PurePosixPath) -> bool:
    """Return whether a file has the name of an image, and is no named pipe, socket or device."""
    # A link to a missing file is an image that cannot be read.
    has_suffix = path.suffix.lower() in SUFFIXES
    return has_suffix and (os.path.isfile(folder / path) or not os.path.exists(folder / path))


def visible_files(folder: Path) -> Iterator[PurePosixPath]:
    """Yield the paths of all files that are not hidden, relative to the folder.

    Symbolic links are followed. A link to a folder on the way to the link is
    not, because the search would not end.
    """

    def raise_error(error: OSError) -> NoReturn:
        raise error

    # Real paths of each folder and of those on the way to it.
    ways: dict[Path, tuple[Path, ...]] = {Path(folder): (Path(folder).resolve(),)}
    for parent, subfolders, files in os.walk(folder, onerror=raise_error, followlinks=True):
        way = ways.pop(Path(parent))
        real = {name: Path(parent, name).resolve() for name in subfolders if not is_hidden(name)}
        # This changes the list of `os.walk`, which then visits only these subfolders.
        subfolders[:] = [
            name for name in real if not any(path.is_relative_to(real[name]) for path in way)
        ]
        ways |= {Path(parent, name): (*way, real[name]) for name in subfolders}
        relative_parent = PurePosixPath(Path(parent).relative_to(folder).as_posix())
        yield from (relative_parent / name for name in files if not is_hidden(name))


def _has_class_folders(
    folder: Path, paths: Sequence[PurePosixPath], classes: Sequence[str], labels: Sequence[str]
) -> bool:
    """Return whether a folder has a subfolder for each class, and check their names.

    Only a folder without subfolders has none; wrong names raise InputError.
    """
    names = folder_names(folder)
    known = [name for name in names if name in classes or name.startswith(OTHER_PREFIX)]
    no_classes = [name for name in names if name not in known]
    lowered = [label.lower() for label in labels]
    for name in no_classes:
        # A name that resembles a positive class must not count as a negative by mistake.
        is_misspelled = any(label in name.lower() for label in lowered)
        if not known or is_misspelled or get_close_matches(name.lower(), lowered):
            fault = f"{folder / name} is not a class, such as {nearest(name, classes)}"
            raise InputError(f"{fault}: rename it, hard negatives to {OTHER_PREFIX}{name}")
    if no_classes:
        count = f"{len(no_classes)} of {len(names)} folders in {folder}"
        say_once(f"{count} are no classes and count as negatives: {', '.join(no_classes)}")
    outside = [path for path in paths if len(path.parts) == 1]
    if names and outside:
        raise InputError(f"{folder / outside[0]} lies beside the class folders: move it into one")
    return bool(names)


def _read_table(table: Path) -> dict[PurePosixPath, Row]:
    """Read photos.csv (source and object of each photograph), empty if it is missing."""
    rows: dict[PurePosixPath, Row] = {}
    if not os.path.lexists(table):
        return rows
    advice = "write UTF-8 text with the columns path and source_tag, separated by commas"
    with explained(f"{table} cannot be read", advice):
        # Opening a named pipe would wait forever.
        if not table.is_file():
            raise OSError("it is not a regular file")
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(map(composed, file), restval="", strict=True)
            reader.fieldnames = [name.strip().lower() for name in reader.fieldnames or ()]
            named = [*filter(None, reader.fieldnames)]
            if len({*named}) < len(named):
                raise ValueError("two columns have the same name")
            for cells in reader:
                if None in cells:
                    raise ValueError(f"the row of {cells['path']} has more cells than columns")
                line = {key: cell.strip() for key, cell in cells.items()}
                if not any(line.values()):  # Spreadsheets write empty rows as commas.
                    continue
                path = PurePosixPath(line["path"].replace("\\", "/"))
                hard_negatives = split_sources(line.get("hard_negatives", ""))
                row = (line["source_tag"] or None, hard_negatives, line.get("mesh") or None)
                if rows.setdefault(path, row) != row:
                    raise ValueError(f"two different rows for {path}")
    return rows


def load_photographs(
    folder: Path, photographs: Sequence[Photograph], size: Size, skip_unreadable: bool | None
) -> tuple[list[Photograph], Tensor, list[str]]:
    """Read photographs at the size of the input of a network.

    Each image is rotated as its EXIF orientation says, and converted to sRGB as its
    color profile says. Transparent pixels are blended with white, and 16-bit
    channels are converted to 8 bits. The largest central part of the shape of `size`
    is reduced with Pillow's Lanczos filter. The filter is wider for a larger
    reduction, which prevents aliasing. Return the photographs that could be read,
    their uint8 sRGB images, and the paths of the others. `skip_unreadable` is None if the caller
    has no such setting.
    """
    height, width = height_and_width(size)
    count = len(photographs)
    what = f"{count} photographs of {height} × {width} pixels"
    require_memory(what, 3 * count * height * width, torch.device("cpu"))
    images = torch.empty(count, 3, height, width, dtype=torch.uint8)
    paths = [folder / photograph.path for photograph in photographs]
    # Threads read in parallel, because Pillow releases Python's global lock while
    # it decodes and resizes.
    pool = ThreadPoolExecutor()
    try:
        errors = [*progress(pool.map(_read_image, images, paths), "photographs", count)]
    finally:
        # If Ctrl-C is pressed, images that no thread has begun to read are not read.
        pool.shutdown(cancel_futures=True)
    readable = [index for index, error in enumerate(errors) if error is None]
    unreadable = [index for index, error in enumerate(errors) if error]
    if unreadable and not (readable and skip_unreadable):
        first = unreadable[0]
        fault = f"{len(unreadable)} of {count} photographs cannot be read"
        can_skip = readable and skip_unreadable is not None
        advice = ", or set skip_unreadable=True to skip them" if can_skip else ""
        example = f"the first being {paths[first]} ({errors[first]})"
        raise InputError(f"{fault}, {example}: replace them{advice}")
    # Images that are all readable are not copied.
    shown = images[readable] if unreadable else images
    missing = [str(photographs[index].path) for index in unreadable]
    return [photographs[index] for index in readable], shown, missing


def _read_image(image: UInt8[Tensor, "3 height width"], path: Path) -> Exception | None:
    """Read the center of a photograph into a tensor."""
    try:
        # `np.array` copies the pixels, because the memory of Pillow is read-only.
        pixels = np.array(read_center(path, image.shape[-2:]))
    # Pillow raises errors of almost any type for a damaged file.
    except Exception as error:
        return error
    image.copy_(torch.from_numpy(pixels).permute(2, 0, 1))
    return None
