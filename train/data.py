"""Images as uint8 arrays, labeled (CIFAR-100, an .npz file, a folder of class folders) or not (any folder)."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from augment.classifiers.adapter import class_index
from augment.utils import generator, progress
from renderer.errors import InputError, in_one_line
from train import console
from train.checkpoint import content_hash
from train.image_files import RESIDENT, ImageFiles
from train.photographs.folder import Photograph, find_photographs, find_unlabeled, is_hidden, left_out, load_photographs

PARTS = ("train", "training", "val", "valid", "validation", "dev", "test", "testing")  # not names of classes
HELD_OUT = 1000  # unlabeled images at most: agreement to a percent, from folders of any length


@dataclass(frozen=True)
class Split:
    """images: (N, 3, H, W) uint8 RGB, or files that give them. labels: (N,) int64."""

    images: Tensor | ImageFiles
    labels: Tensor

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def content_hash(self) -> str:
        """Of images and labels; of files, by names and sizes."""
        return content_hash([self.images.facts() if isinstance(self.images, ImageFiles) else self.images, self.labels])

    def to(self, device: torch.device) -> "Split":
        """Files stay where they are."""
        return Split(
            self.images if isinstance(self.images, ImageFiles) else self.images.to(device), self.labels.to(device)
        )

    def squares(self, rows: Iterable[Tensor]) -> Iterator[Tensor]:
        """The images (B, 3, H, W) uint8 of batches of rows."""
        images = self.images
        return images.squares(rows) if isinstance(images, ImageFiles) else (images[batch] for batch in rows)

    def sample(self, count: int) -> Tensor:
        """Images from all over the split, so many at most."""
        return next(iter(self.squares([torch.linspace(0, len(self) - 1, min(count, len(self))).long()])))

    def __getitem__(self, rows: Tensor | slice) -> "Split":
        return Split(self.images[rows], self.labels[rows])


@dataclass(frozen=True)
class DataSet:
    """Images for training and for one test.

    Attributes:
        classes: The names of the classes, in label order.
        train: The images to learn from.
        test: The images to score on.
        labeled: Whether the labels are known. Otherwise all of them are 0, and the answers of
            the network that a run begins with take their place.
        rendered: Whether the images are renders of solids.
    """

    classes: tuple[str, ...]
    train: Split
    test: Split
    labeled: bool = True
    rendered: bool = False

    @property
    def size(self) -> int:
        """Pixels per side."""
        return self.train.images.shape[-1]


def relabeled(data: DataSet, classes: Sequence[str], key: str) -> DataSet:
    """The data with labels that count these classes. InputError naming the key where one of its own is not among
    them."""
    labels = torch.tensor([class_index(classes, name, key) for name in data.classes])
    train = Split(data.train.images, labels[data.train.labels])
    test = Split(data.test.images, labels[data.test.labels])
    return replace(data, classes=tuple(classes), train=train, test=test)


def held_out_rows(split: Split, fraction: float, seed: int, key: str = "data.validation") -> Tensor:
    """(N,) bool, true of the fraction of every class's images, rounded. InputError names the key."""
    if not 0 < fraction < 1:
        raise InputError(f"{key}={fraction} must lie between 0 and 1")
    held_out, draws = torch.zeros(len(split), dtype=torch.bool), generator(seed, "validation")
    for label in split.labels.unique():
        members = torch.nonzero(split.labels == label).squeeze(1)
        count = round(fraction * len(members))
        if not 0 < count < len(members):
            raise InputError(f"{key}={fraction} of class {int(label)}, {len(members)} images, is all or nothing")
        held_out[members[torch.randperm(len(members), generator=draws)[:count]]] = True
    return held_out


def channel_statistics(images: Tensor) -> tuple[list[float], list[float]]:
    """Mean and standard deviation of each channel in [0, 1], exact: from histograms of the 256 values."""
    values = torch.arange(256, dtype=torch.float64) / 255
    means, deviations = [], []
    for channel in range(3):
        counts = torch.bincount(images[:, channel].flatten(), minlength=256).double()
        means.append(float(counts @ values / counts.sum()))
        deviations.append(float((counts @ (values - means[-1]) ** 2 / counts.sum()).sqrt()))
    return means, [max(deviation, 1e-3) for deviation in deviations]


def load_cifar100(path: str) -> DataSet:
    """torchvision's CIFAR-100 in folder `path`, downloaded where there is a network, checksums verified."""
    from torchvision.datasets import CIFAR100

    try:
        train, test = (CIFAR100(path, train=part, download=True) for part in (True, False))
    except (OSError, RuntimeError) as error:
        raise InputError(f"data.path={path}: CIFAR-100 is not there and cannot be downloaded ({error})") from error
    splits = [
        Split(torch.from_numpy(part.data).permute(0, 3, 1, 2).contiguous(), torch.tensor(part.targets))
        for part in (train, test)
    ]
    return DataSet(tuple(train.classes), splits[0], splits[1])


def load_npz(path: str) -> DataSet:
    """Arrays train_images and test_images (N, 3, S, S) uint8, train_labels and test_labels (N,), classes (C,) str.

    InputError naming the file where it is not such an archive, or would need pickle, which runs code.
    """
    if not Path(path).is_file():
        raise InputError(f"data.path={path} does not exist: give the path of an .npz file")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            classes = archive["classes"]
            parts = progress(("train", "test"), "reading the data")
            splits = [_npz_split(archive[f"{part}_images"], archive[f"{part}_labels"], classes.size) for part in parts]
        if classes.ndim != 1 or classes.dtype.kind != "U" or len(set(classes.tolist())) != len(classes):
            raise ValueError("classes must be distinct strings, one per class")
        if splits[0].images.shape[1:] != splits[1].images.shape[1:]:
            raise ValueError("train_images and test_images differ in size")
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds for a damaged or foreign file
        raise InputError(f"data.path={path} is not an .npz file of labeled images: {in_one_line(error)}") from error
    return DataSet(tuple(classes.tolist()), splits[0], splits[1])


def _npz_split(images: np.ndarray, labels: np.ndarray, classes: int) -> Split:
    if images.ndim != 4 or images.shape[1] != 3 or images.shape[2] != images.shape[3] or images.dtype != np.uint8:
        raise ValueError(f"images are {images.dtype} of shape {images.shape}; they must be uint8 (N, 3, S, S)")
    if labels.shape != images.shape[:1] or labels.dtype.kind not in "iu":
        raise ValueError(f"labels are {labels.dtype} of shape {labels.shape}; they must be integers ({len(images)},)")
    if not len(labels) or labels.min() < 0 or labels.max() >= classes:
        raise ValueError(f"labels must be 0 to {classes - 1}, one at least")
    return Split(torch.from_numpy(images), torch.from_numpy(labels.astype(np.int64)))


def load_folder(path: str, size: int, test_fraction: float, skip_unreadable: bool = False, workers: int = 0) -> DataSet:
    """Class folders of images, or `train` and `test` folders of them; center squares reduced to size × size.

    Without a `test` folder, that fraction of every class is held out as the test split. Images of more than `RESIDENT`
    pixels per side stay on disk, from where so many processes read them in random crops.
    """
    root = Path(path)
    if not root.is_dir():
        raise InputError(f"data.path={path} is not a folder: give a folder with one folder of images per class")
    parts = [name for name in _folders(root) if name.lower() in PARTS]
    if parts not in ([], ["test", "train"]):
        raise InputError(f"data.path={path} holds {', '.join(parts)}: divide it into train and test, or not at all")
    train_root = root / "train" if parts else root
    classes = tuple(_folders(train_root))
    if len(classes) < 2:
        raise InputError(f"data.path={path} holds {len(classes)} class folders: it needs two or more")
    if unread := left_out(root):
        console.warning("%d files in %s are not images: %s", len(unread), root, ", ".join(map(str, unread[:3])))
    options = size, skip_unreadable, workers
    train = _folder_split(train_root, classes, *options)
    if empty := set(range(len(classes))).difference(train.labels.tolist()):
        raise InputError(f"{train_root / classes[min(empty)]} holds no image: put some there or remove the folder")
    if parts:
        return DataSet(classes, train, _folder_split(root / "test", classes, *options))
    held_out = held_out_rows(train, test_fraction, seed=0, key="data.test_fraction")
    return DataSet(classes, train[~held_out], train[held_out])


def load_unlabeled(path: str, size: int, test_fraction: float, skip_unreadable: bool, workers: int) -> DataSet:
    """All images of a folder and its sub-folders, of no class yet: every label is 0. At most HELD_OUT are for tests."""
    _, images = _read(Path(path), find_unlabeled(Path(path)), size, skip_unreadable, workers)
    split = Split(images, torch.zeros(len(images), dtype=torch.int64))
    fraction = min(test_fraction, HELD_OUT / len(split))
    held_out = held_out_rows(split, fraction, seed=0, key="data.test_fraction")
    return DataSet((), split[~held_out], split[held_out], labeled=False)


def _folders(root: Path) -> list[str]:
    return sorted(entry.name for entry in root.iterdir() if entry.is_dir() and not is_hidden(entry.name))


def _folder_split(root: Path, classes: tuple[str, ...], size: int, skip_unreadable: bool, workers: int) -> Split:
    found, images = _read(root, find_photographs(root, classes, classes[0]), size, skip_unreadable, workers)
    return Split(images, torch.tensor([class_index(classes, item.label, f"data.path={root}") for item in found]))


def _read(
    root: Path, found: list[Photograph], size: int, skip_unreadable: bool, workers: int
) -> tuple[list[Photograph], Tensor | ImageFiles]:
    """Those that can be read, and their images, in memory or on disk."""
    if size > RESIDENT:
        return found, ImageFiles(root, tuple(item.path for item in found), size, workers, skip_unreadable)
    readable, images, broken = load_photographs(root, found, size, skip_unreadable)
    if broken:
        console.warning("%d of %d images cannot be read and are skipped: %s", len(broken), len(found), broken[0])
    return readable, images
