"""Write labeled renders as files: folders of classes, COCO, YOLO, or tar files of WebDataset.

Several processes write one data set without coordination: each render, or each tar file, is
written once, and is finished when its last file is there. What describes all renders, such as the
annotations of COCO, is written by each process that finds all of them finished.
"""

import io
import itertools
import json
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import yaml
from jaxtyping import Bool
from torch import Tensor

from augment.dataset import LabeledRender
from renderer.io.files import atomic_write, remove_unfinished, replacing
from renderer.io.images import encode_image
from train import console

# Folder with a JSON file for each render, and with its maps.
DETAILS = "details"
# Class folder of a render whose first object has no class or is hidden.
NO_CLASS = "no_class"
# Renders in a tar file of WebDataset.
PER_TAR = 1000


@dataclass(frozen=True)
class DataSet:
    """A data set on disk, of `count` renders.

    Attributes:
        image: Path of the image of a render, with its {part}, {number} and first {label}.
        folder: Its folder.
        classes: Names of the classes.
        splits: Number of renders in each part, such as "train", in the order of their indices.
        shards: Indices of the renders that each process writes.
        maps: Which of "mask", "depth" and "normals" are written.
    """

    image: ClassVar[str]
    folder: Path
    classes: Sequence[str]
    splits: Mapping[str, int]
    shards: Sequence[range]
    maps: Sequence[str]

    @property
    def count(self) -> int:
        """Number of renders."""
        return sum(self.splits.values())

    def split(self, index: int) -> str:
        """Return the part to which the render with an index belongs."""
        ends = itertools.accumulate(self.splits.values())
        return next(part for part, end in zip(self.splits, ends, strict=True) if index < end)

    def last_file(self, index: int) -> Path:
        """Return the file that is written last for a render, or for several together."""
        return self.folder / DETAILS / f"{index:06d}.json"

    def write(self, renders: Iterable[LabeledRender]) -> None:
        """Write renders with consecutive indices."""
        for render in renders:
            for name, content in self.files(render).items():
                path = self.folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                atomic_write(path, content)

    def files(self, render: LabeledRender) -> dict[str, bytes | str]:
        """Return the content of the files of a render by their paths. The last one is its JSON."""
        part = self.split(render.index)
        number = f"{render.index:06d}"
        # The path of the image, by the template of the format.
        image = self.image.format(part=part, number=number, label=first_label(render))
        facts = render.boxes.tolist(), render.visible.tolist(), render.masks.numpy()
        objects = []
        for label, box, visible, mask in zip(render.labels, *facts, strict=True):
            # The mask is stored as run lengths, as in COCO.
            item = {"class": str(label), "box": box, "visible": visible}
            objects.append(item | {"area": int(mask.sum()), "counts": run_lengths(mask)})
        details = {
            "image": image,
            "split": part,
            "index": render.index,
            "size": list(render.image.shape[1:]),
            "mesh": render.mesh,
            "objects": objects,
            "camera": render.camera,
            "light": render.light.tolist(),
        }
        if render.depth is not None:
            details["depth_scale"] = _depth_scale(render.depth)
        maps = {f"{DETAILS}/{number}_{name}.png": png(_map(render, name)) for name in self.maps}
        return {image: png(render.image), **maps, f"{DETAILS}/{number}.json": json.dumps(details)}

    def is_finished(self) -> bool:
        """Return whether all renders are there."""
        return all(self.last_file(index).exists() for index in range(self.count))

    def finish(self) -> None:
        """Write the files that describe all renders, which are all finished."""


class ImageFolder(DataSet):
    """A folder for each part and class, as `torchvision.datasets.ImageFolder` reads it."""

    image = "{part}/{label}/{number}.png"

    def finish(self) -> None:
        """Make the folders of all classes in each part, so that all parts number them alike."""
        hidden = NO_CLASS if any(self.folder.glob(f"*/{NO_CLASS}")) else ""
        for part, label in itertools.product(self.splits, filter(None, [*self.classes, hidden])):
            (self.folder / part / label).mkdir(parents=True, exist_ok=True)
            if not any((self.folder / part / label).iterdir()):
                note = "give torchvision's ImageFolder allow_empty=True, or render more images"
                console.warning("%s has no render of %s: %s", part, label, note)


class Coco(DataSet):
    """Images, and annotations with boxes and masks in the JSON format of COCO."""

    image = "{part}/{number}.png"

    def finish(self) -> None:
        """Write annotations/instances_PART.json for each part."""
        numbered = enumerate(self.classes, 1)
        categories = [{"id": key, "name": name, "supercategory": name} for key, name in numbered]
        numbers = itertools.count(1)
        for part in self.splits:
            images, annotations = [], []
            for index in (one for one in range(self.count) if self.split(one) == part):
                render = json.loads(self.last_file(index).read_text())
                # Ids of COCO count from 1.
                image_id, name = index + 1, Path(render["image"]).name
                height, width = render["size"]
                images.append({"id": image_id, "file_name": name, "height": height, "width": width})
                # Trainers refuse the empty box of an object that covers half of no pixel.
                for item in (one for one in render["objects"] if one["area"]):
                    left, top, right, bottom = item["box"]
                    annotation = {
                        "id": next(numbers),
                        "image_id": image_id,
                        "category_id": self.classes.index(item["class"]) + 1,
                        "bbox": [left, top, right - left, bottom - top],
                        "area": item["area"],
                        "segmentation": {"size": [height, width], "counts": item["counts"]},
                        "iscrowd": 0,
                    }
                    annotations.append(annotation)
            # Some versions of pycocotools demand "info" in evaluations.
            content = {"info": {}, "licenses": [], "images": images, "annotations": annotations}
            content["categories"] = categories
            path = self.folder / "annotations" / f"instances_{part}.json"
            path.parent.mkdir(exist_ok=True)
            atomic_write(path, json.dumps(content))


class Yolo(DataSet):
    """Images and text files with boxes, as Ultralytics reads them, and data.yaml."""

    image = "images/{part}/{number}.png"

    def files(self, render: LabeledRender) -> dict[str, bytes | str]:
        """Add the text file: class, center, width and height as fractions of the image."""
        height, width = render.image.shape[1:]
        text = ""
        for label, box in zip(render.labels, render.boxes.tolist(), strict=True):
            left, top, right, bottom = box
            # An object that covers half of no pixel has an empty box.
            if left == right:
                continue
            x, y = (left + right) / 2 / width, (top + bottom) / 2 / height
            numbers = (x, y, (right - left) / width, (bottom - top) / height)
            words = [f"{number:.6f}" for number in numbers]
            text += " ".join([str(self.classes.index(str(label))), *words]) + "\n"
        name = f"labels/{self.split(render.index)}/{render.index:06d}.txt"
        return {name: text, **super().files(render)}

    def finish(self) -> None:
        """Write data.yaml. Ultralytics demands train and val: the first part stands for both."""
        first, *_ = self.splits
        parts = {"train": first, "val": first} | {part: part for part in self.splits}
        paths = {key: f"images/{part}" for key, part in parts.items()}
        content = {**paths, "nc": len(self.classes), "names": dict(enumerate(self.classes))}
        atomic_write(self.folder / "data.yaml", yaml.safe_dump(content, sort_keys=False))


class WebDataset(DataSet):
    """Tar files of at most PER_TAR renders: image, class, JSON and maps under one key."""

    image = "{number}.png"

    def last_file(self, index: int) -> Path:
        """Return the tar file, named by its part and the index of its first render."""
        # A tar file begins with a part, with the renders of a process, or after a full file.
        ends = [0, *itertools.accumulate(self.splits.values())]
        starts = [*ends, *(shard.start for shard in self.shards), index // PER_TAR * PER_TAR]
        first = max(start for start in starts if start <= index)
        return self.folder / f"{self.split(index)}-{first:06d}.tar"

    def write(self, renders: Iterable[LabeledRender]) -> None:
        """Write renders with consecutive indices. A tar file appears when it is complete."""
        for path, group in itertools.groupby(renders, lambda one: self.last_file(one.index)):
            with replacing(path) as temporary, tarfile.open(temporary, "w") as tar:
                for render in group:
                    self._add(render, tar)

    def finish(self) -> None:
        """Remove what processes that were killed left of tar files."""
        remove_unfinished(self.folder)

    def _add(self, render: LabeledRender, tar: tarfile.TarFile) -> None:
        """Add the files of a render to a tar file. The key of a sample ends at the first point."""
        key = f"{render.index:06d}"
        label = first_label(render)
        number = self.classes.index(label) if label in self.classes else -1
        for name, content in (self.files(render) | {f"{key}.cls": str(number)}).items():
            data = content.encode() if isinstance(content, str) else content
            info = tarfile.TarInfo(name.removeprefix(f"{DETAILS}/").replace(f"{key}_", f"{key}."))
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))


FORMATS = {"imagefolder": ImageFolder, "coco": Coco, "yolo": Yolo, "webdataset": WebDataset}


def first_label(render: LabeledRender) -> str:
    """Return the class of the first visible object of a render."""
    return str(render.labels[0]) if render.labels else NO_CLASS


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """Return the uncompressed run lengths of COCO: of 0, then 1, ... down the columns."""
    flat = np.concatenate([[False], mask.T.ravel(), [False]])
    counts = np.diff(np.flatnonzero(flat[1:] != flat[:-1]), prepend=0, append=mask.size).tolist()
    return counts if counts[-1] else counts[:-1]


def _depth_scale(depth: Tensor) -> float:
    """Return the depth, in world units, of one step of a depth image."""
    return float(depth.max()) / (2**16 - 1)


def _map(render: LabeledRender, name: str) -> np.ndarray:
    """Return a map of a render as an array of 8 or 16 bits.

    A mask has 1 for the first visible object, 2 for the second, and so on. Normals in [-1, 1]
    are mapped to [0, 255].
    """
    if name == "mask":
        numbers = np.arange(1, len(render.masks) + 1, dtype=np.uint8)[:, None, None]
        shape = render.image.shape[1:]
        # Masks of visible parts do not overlap, so the maximum is the number of the object, or 0.
        return (render.masks.numpy() * numbers).max(0, initial=0).reshape(shape).astype(np.uint8)
    assert render.depth is not None and render.normals is not None
    if name == "depth":
        scale = _depth_scale(render.depth) or 1.0
        return np.rint(render.depth.numpy() / scale).astype(np.uint16)
    return np.rint((render.normals.permute(1, 2, 0).numpy() + 1) / 2 * 255).astype(np.uint8)


def png(pixels: Tensor | np.ndarray) -> bytes:
    """Encode an image as a PNG file. Strong compression would take most of the time."""
    return encode_image(pixels, "PNG", compress_level=1)
