"""Write labeled renders as files: folders of classes, COCO, YOLO, or tar files of WebDataset.

Several processes write one data set without coordination: each render, or each tar file, is
written once, and is finished when its last file is there. What describes all renders, such as the
annotations of COCO, is written by each process that finds all of them finished.
"""

import io
import json
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, groupby, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Bool
from torch import Tensor

from augment.dataset import LabeledRender
from renderer.io.files import atomic_write, replacing
from renderer.io.images import encode_image

# Folder with a JSON file for each render, and with its maps.
DETAILS = "details"
# Class folder of a render whose first object has no class or is hidden.
NO_CLASS = "no_class"
# Renders in a tar file of WebDataset.
PER_TAR = 1000
# Largest value of an image of 16 bits.
MAX_DEPTH = 2**16 - 1


@dataclass(frozen=True)
class DataSet:
    """A data set on disk, of `count` renders.

    Attributes:
        folder: Its folder.
        classes: Names of the classes.
        splits: Number of renders in each part, such as "train", in the order of their indices.
        shards: Indices of the renders that each process writes.
        maps: Which of "mask", "depth" and "normals" are written.
    """

    folder: Path
    classes: Sequence[str]
    splits: Mapping[str, int]
    shards: Sequence[range]
    maps: Sequence[str]

    @property
    def count(self) -> int:
        """Return the number of renders."""
        return sum(self.splits.values())

    def split(self, index: int) -> str:
        """Return the part to which the render with an index belongs."""
        for name, count in self.splits.items():
            if index < count:
                return name
            index -= count
        raise IndexError(index)

    def stem(self, index: int) -> str:
        """Return the name of the files of a render, without suffix."""
        return f"{index:06d}"

    def last_file(self, index: int) -> Path:
        """Return the file that is written last for a render, or for several together."""
        return self.folder / DETAILS / f"{self.stem(index)}.json"

    def write(self, renders: Iterable[LabeledRender]) -> None:
        """Write renders with consecutive indices."""
        for path, group in groupby(renders, lambda render: self.last_file(render.index)):
            self._write_group(path, group)

    def _write_group(self, path: Path, renders: Iterable[LabeledRender]) -> None:
        """Write the renders that share their last file."""
        for render in renders:
            for name, content in self.files(render).items():
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                atomic_write(self.folder / name, content)

    def image_path(self, render: LabeledRender) -> str:
        """Return the path of the image of a render in the folder."""
        raise NotImplementedError

    def files(self, render: LabeledRender) -> dict[str, bytes | str]:
        """Return the content of the files of a render by their paths. The last one is its JSON."""
        stem = f"{DETAILS}/{self.stem(render.index)}"
        maps = {f"{stem}_{name}.png": png(_map(render, name)) for name in self.maps}
        image = self.image_path(render)
        details = {"image": image, "split": self.split(render.index), **describe(render)}
        return {image: png(render.image), **maps, f"{stem}.json": json.dumps(details)}

    def is_finished(self) -> bool:
        """Return whether all renders are there."""
        return all(self.last_file(index).exists() for index in range(self.count))

    def finish(self) -> None:
        """Write the files that describe all renders, which are all finished."""


class ImageFolder(DataSet):
    """A folder for each part and class, as `torchvision.datasets.ImageFolder` reads it."""

    def image_path(self, render: LabeledRender) -> str:
        """Return the path of the image: PART/CLASS/NUMBER.png."""
        return f"{self.split(render.index)}/{class_folder(render)}/{self.stem(render.index)}.png"


class Coco(DataSet):
    """Images, and annotations with boxes and masks in the JSON format of COCO."""

    def image_path(self, render: LabeledRender) -> str:
        """Return the path of the image: PART/NUMBER.png."""
        return f"{self.split(render.index)}/{self.stem(render.index)}.png"

    def finish(self) -> None:
        """Write annotations/instances_PART.json for each part."""
        names = {name: index for index, name in enumerate(self.classes, 1)}
        categories = [{"id": index, "name": name} for name, index in names.items()]
        parts: dict[str, dict[str, list[Any]]] = {}
        for part in self.splits:
            parts[part] = {"images": [], "annotations": [], "categories": categories}
        number = 0
        for index in range(self.count):
            text = (self.folder / DETAILS / f"{self.stem(index)}.json").read_text()
            details = json.loads(text)
            annotations = parts[details["split"]]
            height, width = details["size"]
            name = Path(details["image"]).name
            annotations["images"].append(
                {"id": index + 1, "file_name": name, "height": height, "width": width}
            )
            for item in details["objects"]:
                number += 1
                left, top, right, bottom = item["box"]
                annotations["annotations"].append(
                    {
                        "id": number,
                        "image_id": index + 1,
                        "category_id": names[item["class"]],
                        "bbox": [left, top, right - left, bottom - top],
                        "area": item["area"],
                        "segmentation": {"size": [height, width], "counts": item["counts"]},
                        "iscrowd": 0,
                    }
                )
        for name, content in parts.items():
            path = self.folder / "annotations" / f"instances_{name}.json"
            path.parent.mkdir(exist_ok=True)
            atomic_write(path, json.dumps(content))


class Yolo(DataSet):
    """Images and text files with boxes, as Ultralytics reads them, and data.yaml."""

    def image_path(self, render: LabeledRender) -> str:
        """Return the path of the image: images/PART/NUMBER.png."""
        return f"images/{self.split(render.index)}/{self.stem(render.index)}.png"

    def files(self, render: LabeledRender) -> dict[str, bytes | str]:
        """Add the text file: class, center, width and height as fractions of the image."""
        height, width = render.image.shape[1:]
        lines = []
        for label, (left, top, right, bottom) in zip(
            render.labels, render.boxes.tolist(), strict=True
        ):
            box = (
                (left + right) / 2 / width,
                (top + bottom) / 2 / height,
                (right - left) / width,
                (bottom - top) / height,
            )
            index = self.classes.index(str(label))
            lines.append(" ".join([str(index), *(f"{value:.6f}" for value in box)]) + "\n")
        part = self.split(render.index)
        return {
            f"labels/{part}/{self.stem(render.index)}.txt": "".join(lines),
            **super().files(render),
        }

    def finish(self) -> None:
        """Write data.yaml. Ultralytics demands train and val: the first part stands for both."""
        first, *_ = self.splits
        parts = {"train": first, "val": first} | {part: part for part in self.splits}
        paths = {key: f"images/{part}" for key, part in parts.items()}
        content = {**paths, "names": dict(enumerate(self.classes))}
        atomic_write(self.folder / "data.yaml", yaml.safe_dump(content, sort_keys=False))


class WebDataset(DataSet):
    """Tar files of at most PER_TAR renders: image, class, JSON and maps under one key."""

    def last_file(self, index: int) -> Path:
        """Return the tar file, named by its part and the index of its first render."""
        part = self.split(index)
        ends = accumulate(self.splits.values(), initial=0)
        *_, start = takewhile(lambda end: end <= index, ends)
        [shard] = (shard.start for shard in self.shards if index in shard)
        first = max(start, shard, index // PER_TAR * PER_TAR)
        return self.folder / f"{part}-{self.stem(first)}.tar"

    def image_path(self, render: LabeledRender) -> str:
        """Return the name of the image in its tar file."""
        return f"{self.stem(render.index)}.png"

    def _write_group(self, path: Path, renders: Iterable[LabeledRender]) -> None:
        """Write the tar file, which appears when it is complete."""
        with replacing(path) as temporary, tarfile.open(temporary, "w") as tar:
            for render in renders:
                stem = self.stem(render.index)
                label = class_folder(render)
                number = self.classes.index(label) if label in self.classes else -1
                entries = self.files(render) | {f"{stem}.cls": str(number)}
                for name, content in entries.items():
                    data = content.encode() if isinstance(content, str) else content
                    # The key of a sample ends at the first point.
                    name = name.removeprefix(f"{DETAILS}/").replace(f"{stem}_", f"{stem}.")
                    info = tarfile.TarInfo(name)
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))


FORMATS: dict[str, type[DataSet]] = {
    "imagefolder": ImageFolder,
    "coco": Coco,
    "yolo": Yolo,
    "webdataset": WebDataset,
}


def class_folder(render: LabeledRender) -> str:
    """Return the class of the first visible object of a render as the name of a folder."""
    return str(render.labels[0]) if render.labels else NO_CLASS


def describe(render: LabeledRender) -> dict[str, Any]:
    """Describe a render for its JSON file."""
    objects = [
        {
            "class": str(label),
            "box": box,
            "visible": visible,
            "area": int(mask.sum()),
            "counts": run_lengths(mask.numpy()),
        }
        for label, box, visible, mask in zip(
            render.labels, render.boxes.tolist(), render.visible.tolist(), render.masks, strict=True
        )
    ]
    return {
        "index": render.index,
        "size": list(render.image.shape[1:]),
        "mesh": render.mesh,
        "objects": objects,
        "camera": render.camera,
        "light": render.light.tolist(),
        "depth_scale": _depth_scale(render),
    }


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """Return the uncompressed run lengths of COCO: of 0, then 1, ... down the columns."""
    flat = np.concatenate([[False], mask.T.ravel(), [False]])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    ends = np.concatenate([[0], changes, [mask.size]])
    counts = np.diff(ends).tolist()
    return counts if counts[-1] else counts[:-1]


def _depth_scale(render: LabeledRender) -> float:
    """Return the depth, in world units, of one step of the depth image."""
    return float(render.depth.max()) / MAX_DEPTH


def _map(render: LabeledRender, name: str) -> np.ndarray:
    """Return a map of a render as an array of 8 or 16 bits.

    A mask has 1 for the first visible object, 2 for the second, and so on. Normals in [-1, 1]
    are mapped to [0, 255].
    """
    if name == "mask":
        numbers = np.arange(1, len(render.masks) + 1, dtype=np.uint8)[:, None, None]
        shape = render.depth.shape
        return (render.masks.numpy() * numbers).max(0, initial=0).reshape(shape).astype(np.uint8)
    if name == "depth":
        scale = _depth_scale(render) or 1.0
        return np.rint(render.depth.numpy() / scale).astype(np.uint16)
    normals = render.normals.permute(1, 2, 0).numpy()
    return np.rint((normals + 1) / 2 * 255).astype(np.uint8)


def png(pixels: Tensor | np.ndarray) -> bytes:
    """Encode an image as a PNG file. Strong compression would take most of the time."""
    return encode_image(pixels, "PNG", compress_level=1)
