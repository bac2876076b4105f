"""Read photographs with boxes (a COCO file, or a folder with text files of YOLO) or with masks.

A photograph is shown upright, as its EXIF orientation says, and brought to the size of a network.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple
from unicodedata import normalize

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int, UInt8
from PIL import ExifTags, Image

from augment.files import read_lines
from augment.settings import NO_CLASS_PIXEL
from renderer.errors import InputError, composed, explained
from renderer.io.images import SUFFIXES, gray_factor, is_hidden, open_image, read_rgb
from train import console
from train.data.photographs import find_unlabeled, visible_files

# Ways to bring a photograph to the size of a network.
LETTERBOX = "letterbox"
STRETCH = "stretch"
FITS = {LETTERBOX: "fitted into {} pixels with gray borders", STRETCH: "stretched to {} pixels"}
# Gray of the borders, as in Ultralytics.
BORDER = 114
# Forms of Unicode in which names of files are written.
FORMS: tuple[Literal["NFC", "NFD"], ...] = ("NFC", "NFD")
# The aspect ratio of a photograph may differ by this factor from that of its annotation.
MAX_RATIO = 1.02
# File of the settings of `pnb-render` in the folder of its renders.
DATA_SET = "data_set.json"
# Suffixes of the file that Ultralytics reads about a data set.
YAML = (".yaml", ".yml")
# Text files that list the names of classes, one on each line.
CLASS_FILES = ("classes.txt", "obj.names")
# Coordinates may leave the image by this fraction of a side.
ROUNDING = 1e-3
# Number of photographs that a network sees at a time.
BATCH = 16
# EXIF orientations in which the upright image is flipped left to right, and top to bottom. Before
# that, 5 to 8 exchange x and y.
FLIPPED = (2, 3, 6, 7), (3, 4, 7, 8)


@dataclass(frozen=True)
class Annotated:
    """A photograph and the boxes of its objects.

    Attributes:
        path: Path of the photograph.
        name: Name that the annotations give it, or its path relative to the folder.
        size: Width and height of the image in the unit of the boxes. None for those of the upright
            photograph in pixels.
        boxes: Left, top, right and bottom of each object.
        labels: Indices of classes.
        is_crowd: Whether a box has a crowd, on which detections do not count.
        is_stored: Whether the boxes are known to be those of the image as it is stored, before its
            EXIF orientation turns it.
    """

    path: Path
    name: str
    size: tuple[float, float] | None
    boxes: Float[np.ndarray, "M 4"]
    labels: Int[np.ndarray, " M"]
    is_crowd: Bool[np.ndarray, " M"]
    is_stored: bool = False


@dataclass(frozen=True)
class Annotations:
    """Photographs with boxes, and the names of the classes of the boxes.

    Attributes:
        file: File or folder of the annotations.
        photographs: The photographs whose files exist.
        classes: Names of the classes. All of their objects are marked in all photographs.
        missing: Names of the photographs whose files are missing.
    """

    file: Path
    photographs: Sequence[Annotated]
    classes: tuple[str, ...]
    missing: Sequence[str]


class Fitted(NamedTuple):
    """A photograph at the size of a network.

    Attributes:
        pixels: sRGB image.
        boxes: Boxes of the objects within the photograph, in its upright pixels.
        is_kept: Which boxes of the annotation these are. Others have no area.
        scale: Factors of x and y from upright pixels to those of the network.
        shift: Added to x and y after that.
        size: Width and height of the upright photograph in pixels.
    """

    pixels: UInt8[np.ndarray, "3 H W"]
    boxes: Float[np.ndarray, "K 4"]
    is_kept: Bool[np.ndarray, " M"]
    scale: Float[np.ndarray, "2"]
    shift: Float[np.ndarray, "2"]
    size: Float[np.ndarray, "2"]

    def to_photograph(self, boxes: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
        """Convert boxes in pixels of the network to those of the photograph, without borders."""
        corners = (boxes.reshape(-1, 2, 2) - self.shift) / self.scale
        return corners.clip(0, self.size).reshape(-1, 4)


def read_masks(folder: Path) -> tuple[list[Annotated], dict[str, Path], list[str]]:
    """Find the photographs of a folder, the mask of each by its name, and those without a mask.

    A mask is a PNG file with the path of its photograph, but in the folder `masks` or
    `SegmentationClass`.
    """
    # The first pair of folders that exist has the photographs and the masks.
    for names in (("images", "masks"), ("JPEGImages", "SegmentationClass")):
        images, masks = (folder / name for name in names)
        if images.is_dir() and masks.is_dir():
            break
    else:
        raise InputError(f"photos={folder} lacks images/ or masks/: move them there", "photos")
    shown = [str(item.path) for item in find_unlabeled(images)]
    wanted = {name: (masks / name).with_suffix(".png") for name in shown}
    paths = {name: path for name, path in wanted.items() if path.is_file()}
    missing = [name for name in shown if name not in paths]
    # Masks that no photograph names exactly may have names in another form of Unicode.
    unused = {*masks.rglob("*.png")} - {*paths.values()} if missing else ()
    by_form = {composed(str(path)): path for path in unused}
    found = {name: by_form.get(composed(str(wanted[name]))) for name in missing}
    paths |= {name: path for name, path in found.items() if path}
    missing = [name for name in missing if name not in paths]
    if not paths:
        first = Path(missing[0]).with_suffix(".png")
        raise InputError(f"{masks} has no mask {first}: add it", "photos")
    return [_annotated(images / name, name, None, []) for name in paths], paths, missing


def _annotated(
    path: Path, name: str, size: tuple[float, float] | None, rows: Sequence[Sequence[float]]
) -> Annotated:
    """Make an `Annotated` from rows with the label, the four sides of the box and `is_crowd`."""
    table = np.array(rows, float).reshape(-1, 6)
    return Annotated(path, name, size, table[:, 1:5], table[:, 0].astype(int), table[:, 5] > 0)


def fit_mask(
    path: Path, fitted: Fitted, class_count: int, seen: set[int]
) -> UInt8[np.ndarray, "H W"]:
    """Read the classes of the pixels of a photograph, and bring them to its size for the network.

    Pixels of borders are NO_CLASS_PIXEL. The values of the file are added to `seen`.
    """
    with explained(f"{path} cannot be read", "replace it"), open_image(path) as image:
        # Pillow forgets the format of the pixels when it reads them.
        factor = gray_factor(image)
        labels = np.array(image) // factor
    width, height = fitted.size
    if labels.shape != (height, width):
        advice = f"give a gray or palette image of {width:g} × {height:g} indices of classes"
        raise InputError(f"{path} has the shape {labels.shape}: {advice}")
    highest = int(labels[labels != NO_CLASS_PIXEL].max(initial=0))
    class_count = min(class_count, NO_CLASS_PIXEL)
    if highest >= class_count:
        advice = f"use 0 to {class_count - 1}, and {NO_CLASS_PIXEL} for pixels that do not count"
        raise InputError(f"{path} has the value {highest}: {advice}")
    seen.update(np.unique(labels).tolist())
    # Width and height of the photograph in the image of the network, without borders.
    shown = (fitted.scale * fitted.size).round().astype(int)
    reduced = Image.fromarray(labels.astype(np.uint8)).resize((*shown,), Image.Resampling.NEAREST)
    result = np.full(fitted.pixels.shape[1:], NO_CLASS_PIXEL, np.uint8)
    # The photograph begins at `shift`, after the border.
    left, top = fitted.shift.astype(int)
    result[top : top + shown[1], left : left + shown[0]] = np.array(reduced)
    return result


def read_annotations(photos: Path) -> Annotations:
    """Read the annotations of a COCO file, or of a folder that has one or is in the form of YOLO.

    A photograph without a label file has no objects. Missing photographs are listed in the result.
    """
    if photos.is_file():
        is_yaml = photos.suffix.lower() in YAML
        return _read_yolo(photos.parent, photos) if is_yaml else _read_coco(photos)
    if not photos.is_dir():
        raise InputError(f"photos={photos} does not exist: give a COCO file, or a folder", "photos")
    found = [*photos.glob("*.json"), *photos.glob("annotations/*.json")]
    # Label Studio writes its labels as text files, and notes.json beside them.
    others = (DATA_SET, "notes.json")
    files = sorted(file for file in found if file.name not in others and not is_hidden(file.name))
    if len(files) > 1:
        raise InputError(f"photos={photos} has {len(files)} JSON files: give one of them", "photos")
    return _read_coco(files[0]) if files else _read_yolo(photos)


def _read_coco(file: Path) -> Annotations:
    """Read a COCO file. Its images lie beside it or, from a folder annotations, beside that."""
    advice = "give images, categories, and annotations with image_id, category_id and bbox"
    with explained(f"{file} is no COCO file of detections", advice):
        content = json.loads(file.read_text(encoding="utf-8-sig"))
        # Name of each category by its id. Indices of `classes` are in the order of the ids.
        names = {item["id"]: str(item["name"]) for item in content["categories"]}
        classes = tuple(dict.fromkeys(names[key] for key in sorted(names)))
        images = {item["id"]: item for item in content["images"]}
        if len({*map(type, images)}) == 1:
            # Of equal scores, that of the lower image id comes first, as in pycocotools.
            images = dict(sorted(images.items()))
        for item in images.values():
            item["file_name"] = str(item["file_name"]).replace("\\", "/")
        names_of_images = [item["file_name"] for item in images.values()]
        unique = ("images", images), ("images", {*names_of_images}), ("categories", names)
        for key, found in unique:
            if len(found) < len(content[key]):
                raise ValueError(f"two of the {key} have the same id or file_name")
        # For each image id, the rows that `_annotated` takes: label, four sides and `is_crowd`.
        rows: dict[Any, list[Sequence[float]]] = defaultdict(list)
        for item in content["annotations"]:
            for key, known in (("image_id", images), ("category_id", names)):
                if item[key] not in known:
                    raise ValueError(f"an annotation has the unknown {key} {item[key]}")
            box = np.array(item["bbox"], float)
            if box.shape != (4,) or not (np.isfinite(box).all() and (box[2:] >= 0).all()):
                raise ValueError(f"an annotation has the bbox {item['bbox']}")
            label = classes.index(names[item["category_id"]])
            is_crowd = str(item.get("iscrowd") or 0).lower() not in {"0", "0.0", "false"}
            # COCO gives left, top, width and height. The result is left, top, right and bottom.
            rows[item["image_id"]].append((label, *box[:2], *(box[:2] + box[2:]), is_crowd))
        paths = _find_images(file, names_of_images)
        missing = [name for name in names_of_images if name not in paths]
        photographs = []
        for key, image in images.items():
            name = image["file_name"]
            size = (image["width"], image["height"]) if image.get("width") else None
            if name in paths:
                photographs.append(_annotated(paths[name], name, size, rows[key]))
    if {True} == {*map(_fits_stored_image, photographs)} - {None}:
        photographs = [replace(item, is_stored=True) for item in photographs]
    if not photographs:
        first = f", such as {missing[0]}" if missing else ""
        raise InputError(f"{file} names no image that exists{first}: move the images beside it")
    return Annotations(file, photographs, classes, missing)


def _fits_stored_image(photograph: Annotated) -> bool | None:
    """Whether boxes are those of an image as it is stored. None if its aspect ratio cannot tell."""
    # An image that cannot be read is reported when it is needed.
    with suppress(Exception), open_image(photograph.path) as image:
        # The method of PNG would decode the pixels.
        orientation = Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1)
        # Pillow tells the size of a TIFF file as it is after the turn.
        is_turned = image.format == "TIFF" and orientation > 4
        stored = np.array(image.size[::-1] if is_turned else image.size, float)
        if photograph.size and orientation > 4 and not _is_similar(stored, stored[::-1]):
            return _is_similar(np.array(photograph.size, float), stored)
    return None


def _find_images(file: Path, names: Sequence[str]) -> dict[str, Path]:
    """Find the images that a COCO file names, beside it or anywhere in its folder."""
    is_beside = file.parent.name != "annotations"
    folders = [file.parent] if is_beside else [file.parent.parent, file.parent]
    # An image beside the file replaces one in the folder above.
    paths = {name: of / name for of in folders for name in names if (of / name).is_file()}
    # Names that no file has exactly may have another form of Unicode: archives of a Mac change it.
    for form in (str, composed):
        if len(paths) < len(names):
            paths |= _search_images(file, folders[0], names, paths, form)
    return paths


def _search_images(
    file: Path,
    folder: Path,
    names: Sequence[str],
    paths: Mapping[str, Path],
    form: Callable[[str], str],
) -> dict[str, Path]:
    """Find images anywhere in a folder for the names without a path, compared in one form."""
    # Images that no name has found yet, by their names without folder.
    others: dict[str, list[Path]] = defaultdict(list)
    used = {*paths.values()}
    for path in visible_files(folder):
        if path.suffix.lower() in SUFFIXES and folder / path not in used:
            others[form(path.name)].append(folder / path)
    uses = Counter(form(PurePosixPath(name).name) for name in names)
    found = {}
    for name in [name for name in names if name not in paths]:
        parts = PurePosixPath(form(name)).parts
        # Images of this name, by the number of equal parts at the end of their paths.
        by_equal_parts: dict[int, list[Path]] = defaultdict(list)
        for image in others[parts[-1]]:
            pairs = zip(reversed(Path(form(str(image))).parts), reversed(parts), strict=False)
            equal_parts = [*takewhile(lambda pair: pair[0] == pair[1], pairs)]
            by_equal_parts[len(equal_parts)].append(image)
        most = max(by_equal_parts, default=0)
        # An image in another folder may be any of several that have its name.
        if most == 1 and uses[parts[-1]] > 1:
            continue
        images = by_equal_parts[most]
        if len(images) > 1:
            listed = " and ".join(map(str, images[:2]))
            raise InputError(f"{file} names the image {name}, which may be {listed}")
        if images:
            found[name] = images[0]
    return found


def _read_yolo(folder: Path, file: Path | None = None) -> Annotations:
    """Read a folder of images with label files: beside them, or below labels/ instead of images/.

    If a YAML file in the folder, or the given one, has the entry `val`, its images are read. A line
    of a label file has the index of a class, and the center and size of a box, or the corners of a
    polygon, as fractions of the sides of the image.
    """
    classes, named = _yolo_classes(folder, file)
    content = _yaml_mapping(named) if named.suffix.lower() in YAML else {}
    paths = _validation_images(named, content) if named.parent == folder else []
    missing = [str(path) for path in paths if not path.is_file()]
    if paths:
        console.info("%s: the images of its entry val are read", named)
        paths = [path for path in paths if path.is_file()]
    photographs = []
    # Label files that exist, and the number of their lines that repeat another.
    read: dict[Path, int] = {}
    for path in paths or [folder / item.path for item in find_unlabeled(folder)]:
        # A photograph can have a label file in several places. The first that exists counts.
        labels = next(filter(Path.is_file, _label_files(path)), None)
        rows = []
        if labels is not None:
            # Labels of poses have keypoints after the box.
            found = [*_yolo_rows(labels, len(classes), "kpt_shape" in content)]
            # A line that stands twice is one object, as for Ultralytics.
            rows = [*dict.fromkeys(found)]
            read[labels] = len(found) - len(rows)
        name = path.relative_to(folder) if path.is_relative_to(folder) else path
        # Coordinates are fractions, so the image has the width and height 1.
        photographs.append(_annotated(path, str(name), (1, 1), rows))
    if not read:
        first = _label_files(photographs[0].path.absolute())[0]
        fault = f"photos={folder} has neither a COCO file nor label files of YOLO"
        raise InputError(f"{fault}: add some, such as {first}", "photos")
    if repeated_count := sum(read.values()):
        console.warning("%s: %d lines that repeat another are left out", folder, repeated_count)
    # Text files that the YAML file names are lists of images.
    lists = str([content.get(key) for key in ("train", "val", "test")])
    unused = _labels_without_image(photographs, [*read])
    missing += [file for file in unused if Path(file).name not in lists]
    return Annotations(folder, photographs, classes, missing)


def _labels_without_image(photographs: Sequence[Annotated], labels: Sequence[Path]) -> list[str]:
    """Find the files beside given label files whose image is missing."""
    # The images of an entry val may share their folder with others, which are not missing.
    folders = {item.path.parent.absolute() for item in photographs if item.path.parent.is_dir()}
    images = [file for of in folders for file in of.iterdir() if file.suffix.lower() in SUFFIXES]
    known = {file for image in images for file in _label_files(image)}
    beside = {file.parent for file in labels}
    found = {file.absolute() for of in beside for file in of.glob("[!.]*.txt")}
    return [str(file) for file in sorted(found - known) if file.name not in CLASS_FILES]


def _label_files(path: Path) -> list[Path]:
    """Return the paths at which the label file of an image may be."""
    beside = path.with_suffix(".txt")
    files = [beside, path.parent / "labels" / beside.name]
    above, images, below = beside.absolute().as_posix().rpartition("/images/")
    if images:
        files.insert(0, Path(f"{above}/labels/{below}"))
    # Accents in names may have another form of Unicode, since archives of a Mac change them.
    forms = [file.with_name(normalize(form, file.name)) for file in files for form in FORMS]
    return [*files, *forms]


def _yaml_mapping(file: Path) -> dict[str, Any]:
    """Read the entries of a YAML file. Empty if it holds anything else."""
    content = yaml.safe_load(file.read_text(encoding="utf-8-sig"))
    return content if isinstance(content, dict) else {}


def _validation_images(file: Path, content: Mapping[str, Any]) -> list[Path]:
    """List the images of the entry `val` in the content of a YAML file, as Ultralytics does.

    The entry is a folder, a file with the path of an image on each line, or a list of these. Some
    paths of such a file may be missing. The result is empty without the entry.
    """
    given = content.get("val") or []
    if not isinstance(given, str | list):
        raise InputError(f"{file} has val: {given}: give folders or text files", "photos")
    found = []
    for place in [given] if isinstance(given, str) else given:
        # Exports of Roboflow name a folder beside data.yaml as if it lay above.
        names = str(place), str(place).removeprefix("../")
        bases = file.parent / str(content.get("path") or ""), file.parent
        path = next((of / name for of in bases for name in names if (of / name).exists()), None)
        if path is None:
            console.warning("%s: its entry val names %s, which does not exist", file, place)
        elif path.is_file():
            found += [path.parent / line for line in filter(None, read_lines(path))]
        else:
            found += [path / item.path for item in find_unlabeled(path)]
    if given and not any(map(Path.is_file, found)):
        raise InputError(f"{file} has no image of its entry val: {given}", "photos")
    return [*dict.fromkeys(found)]


def _yolo_classes(folder: Path, given: Path | None) -> tuple[tuple[str, ...], Path]:
    """Read the names of the classes, and return the file that has them.

    It is the given YAML file, or else data.yaml or classes.txt in the folder or above it.
    """
    # The folder itself, and the two above it.
    for parent in [folder, *list(folder.absolute().parents)[:2]]:
        files = [file for suffix in YAML for file in parent.glob(f"[!.]*{suffix}")]
        # data.yaml comes first.
        files.sort(key=lambda file: (file.stem != "data", file))
        for file in [given] if given else files:
            with explained(f"{file} cannot be read", "give names as a list, or index: name"):
                names = _yaml_mapping(file).get("names")
                # Names are a list, or a mapping from index to name.
                listed = enumerate(names) if isinstance(names, list) else dict(names or {}).items()
                known = {int(key): str(name) for key, name in listed}
            if known:  # Some indices may be missing.
                if len(files) > 1 and not given and file.stem != "data":
                    console.warning("%s: names of classes are read from it alone", file)
                return tuple(known.get(i, str(i)) for i in range(max(known) + 1)), file
        for name in (*CLASS_FILES, *(f"labels/{name}" for name in CLASS_FILES)):
            if (parent / name).is_file():
                return tuple(filter(None, read_lines(parent / name))), parent / name
    raise InputError(f"photos={folder} names no classes: add data.yaml or classes.txt", "photos")


def _yolo_rows(file: Path, class_count: int, has_keypoints: bool) -> Iterator[Sequence[float]]:
    """Yield the row of each line of a label file, as `_annotated` takes it."""
    for number, line in enumerate(read_lines(file), 1):
        if not line:
            continue
        with explained(f"line {number} of {file} is no box", "write class x y width height"):
            label, *values = map(float, line.split()[: 5 if has_keypoints else None])
            # Four numbers are a box, and at least three pairs are a polygon.
            if len(values) != 4 and (len(values) < 6 or len(values) % 2):
                raise ValueError(f"it has {1 + len(values)} numbers")
            if label not in range(class_count):
                raise ValueError(f"class {label:g} is none of {class_count} classes")
            if not all(-ROUNDING <= value <= 1 + ROUNDING for value in values):
                raise ValueError("coordinates must be fractions of the sides, from 0 to 1")
        if len(values) == 4:
            x, y, width, height = values
            box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        else:
            # The box around the polygon x1 y1 x2 y2 and so on.
            box = (min(values[::2]), min(values[1::2]), max(values[::2]), max(values[1::2]))
        yield (label, *box, False)


def fit(photograph: Annotated, size: tuple[int, int], how: str) -> Fitted:
    """Read a photograph, and bring it to a height and width as `FITS` says."""
    # Images are read at full size.
    image = read_rgb(photograph.path, 2**16)
    upright = np.array(image.size, float)
    # Boxes are cut off at the borders of the photograph. Empty ones are left out.
    boxes = _upright_boxes(photograph, upright).clip(0, np.tile(upright, 2))
    is_kept = np.all(boxes[:, 2:] > boxes[:, :2], axis=1)
    # Width and height of the image, and the factors of both sides.
    available = np.array(size[::-1])
    scale = available / upright
    # The smaller factor of both keeps the aspect ratio, and leaves borders at two sides.
    if how == LETTERBOX:
        scale = np.repeat(scale.min(), 2)
    shown = (upright * scale).round().clip(1).astype(int)
    shift = (available - shown) // 2
    canvas = Image.new("RGB", tuple(available.tolist()), (BORDER,) * 3)
    canvas.paste(image.resize((*shown,), Image.Resampling.LANCZOS), (*shift,))
    pixels = np.array(canvas).transpose(2, 0, 1)
    return Fitted(pixels, boxes[is_kept], is_kept, shown / upright, shift.astype(float), upright)


def _upright_boxes(photograph: Annotated, upright: Float[np.ndarray, "2"]) -> np.ndarray:
    """Return boxes in the pixels of the upright photograph.

    They are turned if only its stored form has the aspect ratio of the annotation, or if this holds
    for other photographs of the file.
    """
    if photograph.size is None:
        return photograph.boxes
    marked = np.array(photograph.size, float)
    # Two opposite corners (M, 2, 2) of each box, as fractions of the sides.
    corners = photograph.boxes.reshape(-1, 2, 2) / marked
    is_upright = photograph.size == (1, 1) or _is_similar(marked, upright)
    if photograph.is_stored or not is_upright:
        with open_image(photograph.path) as image:
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        if not is_upright and not (orientation > 4 and _is_similar(marked[::-1], upright)):
            fault = f"{photograph.path} has {upright[0]:g} × {upright[1]:g} pixels"
            raise InputError(f"{fault}, but its boxes are for {marked[0]:g} × {marked[1]:g}")
        corners = corners[..., ::-1] if orientation in range(5, 9) else corners
        corners = np.where([orientation in flipped for flipped in FLIPPED], 1 - corners, corners)
    # A turn exchanges corners, so the sides are the smaller and larger coordinates.
    corners = np.concatenate([corners.min(1), corners.max(1)], axis=-1)
    return corners * np.tile(upright, 2)


def _is_similar(one: Float[np.ndarray, "2"], other: Float[np.ndarray, "2"]) -> bool:
    """Return whether two images have about the same aspect ratio."""
    return bool(1 / MAX_RATIO <= one[0] * other[1] / (one[1] * other[0]) <= MAX_RATIO)


def fit_batches(
    photographs: Sequence[Annotated], size: tuple[int, int], how: str, skip_unreadable: bool = False
) -> Iterator[list[tuple[Annotated, Fitted]]]:
    """Yield photographs in batches. Unreadable ones are skipped, or raise InputError."""
    with ThreadPoolExecutor() as pool:
        for start in range(0, len(photographs), BATCH):
            batch = photographs[start : start + BATCH]
            futures = [pool.submit(fit, item, size, how) for item in batch]
            fitted = []
            for item, future in zip(batch, futures, strict=True):
                try:
                    fitted.append((item, future.result()))
                except InputError:
                    raise
                except Exception as error:  # Pillow raises errors of almost any type.
                    if not skip_unreadable:
                        fault = f"{item.path} cannot be read ({error})"
                        advice = "replace it, or set skip_unreadable=True"
                        raise InputError(f"{fault}: {advice}") from error
                    console.warning("%s is skipped, because it cannot be read", item.path)
            yield fitted
