"""Data sets of images: CIFAR-100, an .npz file, class folders, or a folder without labels."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from augment.classifiers.adapter import class_index
from augment.progress import progress
from augment.random_streams import generator
from renderer.errors import InputError, single_line
from train import console
from train.data.images import RESIDENT, ImageFiles
from train.data.photographs import (
    Photograph,
    find_photographs,
    find_unlabeled,
    folder_names,
    load_photographs,
    unsupported_files,
)
from train.system.hashing import content_hash

# Names of folders that divide a data set. They are not names of classes.
PARTS = ("train", "training", "val", "valid", "validation", "dev", "test", "testing")
# Largest number of unlabeled images that are held out from training. This many images
# measure the agreement of two networks to a percent.
HELD_OUT = 1000


@dataclass(frozen=True)
class Split:
    """Images and their labels.

    Attributes:
        images: The images, uint8 RGB, shape (N, 3, H, W), or the files that hold them.
        labels: The class numbers, int64, shape (N,).
    """

    images: Tensor | ImageFiles
    labels: Tensor

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def content_hash(self) -> str:
        """Hash the images and labels with SHA-256. Of files, hash names and sizes instead."""
        images = self.images
        content = images.facts() if isinstance(images, ImageFiles) else images
        return content_hash([content, self.labels])

    def to(self, device: torch.device) -> "Split":
        """Return a copy on a device. Files stay where they are."""
        images = self.images
        if not isinstance(images, ImageFiles):
            images = images.to(device)
        return Split(images, self.labels.to(device))

    def squares(self, rows: Iterable[Tensor]) -> Iterator[Tensor]:
        """Give the images of batches of rows, uint8, shape (B, 3, H, W) each."""
        if isinstance(self.images, ImageFiles):
            return self.images.squares(rows)
        images = self.images
        return (images[batch] for batch in rows)

    def sample(self, count: int) -> Tensor:
        """Return at most `count` evenly spaced images of the split, shape (count, 3, H, W)."""
        rows = torch.linspace(0, len(self) - 1, min(count, len(self))).long()
        return next(iter(self.squares([rows])))

    def __getitem__(self, rows: Tensor | slice) -> "Split":
        return Split(self.images[rows], self.labels[rows])


@dataclass(frozen=True)
class DataSet:
    """Images for training and for one test.

    Attributes:
        classes: The names of the classes, in label order.
        train: The images to learn from.
        test: The images to score on.
        labeled: Whether the labels are known. Otherwise all labels are 0 at first. A run
            replaces them with the predictions of its initial network.
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


def relabeled(data: DataSet, classes: Sequence[str], subject: str) -> DataSet:
    """Return a copy of a data set whose labels are indices into other classes.

    Args:
        data: Data set. Each of its classes is one of `classes`.
        classes: Names of the classes of a network.
        subject: Name of the data set, with which the error begins.

    Returns:
        Data set with the same images and with `classes`.

    Raises:
        InputError: If a class of the data set is not in `classes`.
    """
    indices = [class_index(classes, name, subject) for name in data.classes]
    new_label_of_label = torch.tensor(indices)
    train = Split(data.train.images, new_label_of_label[data.train.labels])
    test = Split(data.test.images, new_label_of_label[data.test.labels])
    return replace(data, classes=tuple(classes), train=train, test=test)


def held_out_rows(split: Split, fraction: float, seed: int, argument: str = "fraction") -> Tensor:
    """Choose a fraction of the images of every class at random.

    A larger fraction chooses the same images and more.

    Args:
        split: Images and labels.
        fraction: Fraction between 0 and 1. For each class, it is rounded to
            whole images.
        seed: Seed of the choice.
        argument: Name of the argument that holds the fraction, for the error.

    Returns:
        Mask of the chosen images, bool, shape (N,).

    Raises:
        InputError: If the fraction is out of range, or if it chooses none or
            all of the images of a class.
    """
    if not 0 < fraction < 1:
        raise InputError(f"{argument}={fraction} must lie between 0 and 1", argument)
    is_held_out = torch.zeros(len(split), dtype=torch.bool)
    draws = generator(seed, "validation")
    for label in split.labels.unique():
        members = torch.nonzero(split.labels == label).squeeze(1)
        count = round(fraction * len(members))
        if not 0 < count < len(members):
            raise InputError(
                f"{argument}={fraction} of class {int(label)}, {len(members)} images, "
                "is all or nothing",
                argument,
            )
        order = torch.randperm(len(members), generator=draws)
        is_held_out[members[order[:count]]] = True
    return is_held_out


def channel_statistics(images: Tensor) -> tuple[list[float], list[float]]:
    """Compute the mean and the standard deviation of each channel.

    They are exact, since they come from histograms of the 256 values.

    Args:
        images: The images, uint8, shape (N, 3, H, W).

    Returns:
        The means and the standard deviations of red, green and blue, in units of [0, 1]. A
        standard deviation is at least .001.
    """
    values = torch.arange(256, dtype=torch.float64) / 255
    means = []
    deviations = []
    for channel in range(3):
        counts = torch.bincount(images[:, channel].flatten(), minlength=256).double()
        total = counts.sum()
        mean = float(counts @ values / total)
        deviation = float((counts @ (values - mean) ** 2 / total).sqrt())
        means.append(mean)
        deviations.append(max(deviation, 1e-3))
    return means, deviations


def load_cifar100(path: str) -> DataSet:
    """Load torchvision's CIFAR-100. It is downloaded if it is missing, and its checksums count.

    Args:
        path: The folder that holds it, or will hold it.

    Returns:
        The data set.

    Raises:
        InputError: If it is not there and cannot be downloaded.
    """
    from torchvision.datasets import CIFAR100  # torchvision takes a second to import

    try:
        train = CIFAR100(path, train=True, download=True)
        test = CIFAR100(path, train=False, download=True)
    except (OSError, RuntimeError) as error:
        raise InputError(
            f"path={path}: CIFAR-100 is not there and cannot be downloaded ({error})",
            "path",
        ) from error
    splits = []
    for part in (train, test):
        images = torch.from_numpy(part.data).permute(0, 3, 1, 2).contiguous()
        splits.append(Split(images, torch.tensor(part.targets)))
    return DataSet(tuple(train.classes), splits[0], splits[1])


def load_npz(path: str) -> DataSet:
    """Load a data set from an .npz file.

    The file holds train_images and test_images (N, 3, S, S) uint8, train_labels and test_labels
    (N,), and classes (C,), the names.

    Args:
        path: The file.

    Returns:
        The data set.

    Raises:
        InputError: If it is not such a file, or it would need pickle, which runs code.
    """
    if not Path(path).is_file():
        raise InputError(f"path={path} does not exist: give the path of an .npz file", "path")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return _read_npz(archive)
    # zipfile, zlib and NumPy raise many kinds of errors for a damaged or foreign file.
    except Exception as error:
        raise InputError(
            f"path={path} is not an .npz file of labeled images: {single_line(error)}",
            "path",
        ) from error


def _read_npz(archive: np.lib.npyio.NpzFile) -> DataSet:
    """Read a data set from the arrays of an .npz file.

    Args:
        archive: File with the arrays that `load_npz` describes.

    Raises:
        ValueError: If an array has another type or shape.
    """
    classes = archive["classes"]
    splits = []
    for part in progress(("train", "test"), "reading the data"):
        images = archive[f"{part}_images"]
        labels = archive[f"{part}_labels"]
        splits.append(_npz_split(images, labels, classes.size))
    names = classes.tolist()
    if classes.ndim != 1 or classes.dtype.kind != "U" or len(set(names)) != len(classes):
        raise ValueError("classes must be distinct strings, one per class")
    if splits[0].images.shape[1:] != splits[1].images.shape[1:]:
        raise ValueError("train_images and test_images differ in size")
    return DataSet(tuple(names), splits[0], splits[1])


def _npz_split(images: np.ndarray, labels: np.ndarray, classes: int) -> Split:
    """Convert the arrays of images and labels to a split.

    Args:
        images: Images, which must be uint8 of shape (N, 3, S, S).
        labels: Labels, which must be whole numbers of shape (N,).
        classes: Number of classes.

    Raises:
        ValueError: If a shape, a type or a label is wrong.
    """
    is_square = images.ndim == 4 and images.shape[1] == 3 and images.shape[2] == images.shape[3]
    if not is_square or images.dtype != np.uint8:
        given = f"images are {images.dtype} of shape {images.shape}"
        raise ValueError(f"{given}; they must be uint8 (N, 3, S, S)")
    if labels.shape != images.shape[:1] or labels.dtype.kind not in "iu":
        given = f"labels are {labels.dtype} of shape {labels.shape}"
        raise ValueError(f"{given}; they must be integers ({len(images)},)")
    if not len(labels) or labels.min() < 0 or labels.max() >= classes:
        raise ValueError(f"labels must be 0 to {classes - 1}, one at least")
    return Split(torch.from_numpy(images), torch.from_numpy(labels.astype(np.int64)))


def load_folder(
    path: str,
    size: int,
    test_fraction: float,
    skip_unreadable: bool = False,
    workers: int = 0,
) -> DataSet:
    """Load class folders of images, or folders `train` and `test` of class folders.

    The central square of each image is reduced. Images of more than `RESIDENT` pixels per side
    stay on disk, and are read in random crops.

    Args:
        path: The folder.
        size: The pixels per side.
        test_fraction: The fraction of every class that is the test split, if there is no folder
            `test`.
        skip_unreadable: Whether broken images are skipped.
        workers: The number of processes that read images from disk.

    Returns:
        The data set.

    Raises:
        InputError: If the folder holds no such folders, or an image is broken.
    """
    root = Path(path)
    if not root.is_dir():
        raise InputError(
            f"path={path} is not a folder: give a folder with one folder of images per class",
            "path",
        )
    parts = [name for name in folder_names(root) if name.lower() in PARTS]
    if parts not in ([], ["test", "train"]):
        raise InputError(
            f"path={path} holds {', '.join(parts)}: divide it into train and test, or not at all",
            "path",
        )
    train_root = root / "train" if parts else root
    classes = tuple(folder_names(train_root))
    if len(classes) < 2:
        raise InputError(
            f"path={path} holds {len(classes)} class folders: it needs two or more",
            "path",
        )
    unread = unsupported_files(root)
    if unread:
        shown = ", ".join(map(str, unread[:3]))
        console.warning("%d files in %s are not images: %s", len(unread), root, shown)

    train = _folder_split(train_root, classes, size, skip_unreadable, workers)
    empty = set(range(len(classes))).difference(train.labels.tolist())
    if empty:
        name = classes[min(empty)]
        raise InputError(f"{train_root / name} holds no image: put some there or remove the folder")
    if parts:
        test = _folder_split(root / "test", classes, size, skip_unreadable, workers)
        return DataSet(classes, train, test)
    is_test = held_out_rows(train, test_fraction, seed=0, argument="test_fraction")
    return DataSet(classes, train[~is_test], train[is_test])


def load_unlabeled(
    path: str,
    size: int,
    test_fraction: float,
    skip_unreadable: bool,
    workers: int,
) -> DataSet:
    """Load all images of a folder and its sub-folders. Their classes are not known.

    Args:
        path: The folder.
        size: The pixels per side.
        test_fraction: The fraction that is the test split, of at most `HELD_OUT` images.
        skip_unreadable: Whether broken images are skipped.
        workers: The number of processes that read images from disk.

    Returns:
        The data set, without classes. Every label is 0.

    Raises:
        InputError: If the folder holds no image, or an image is broken.
    """
    found = find_unlabeled(Path(path))
    _, images = _read(Path(path), found, size, skip_unreadable, workers)
    split = Split(images, torch.zeros(len(images), dtype=torch.int64))
    fraction = min(test_fraction, HELD_OUT / len(split))
    is_test = held_out_rows(split, fraction, seed=0, argument="test_fraction")
    return DataSet((), split[~is_test], split[is_test], labeled=False)


def _folder_split(
    root: Path,
    classes: tuple[str, ...],
    size: int,
    skip_unreadable: bool,
    workers: int,
) -> Split:
    """Read the images of class folders.

    Args:
        root: Folder with a sub-folder for each class.
        classes: Names of the classes. A label is an index into them.
        size: Pixels per side of the images.
        skip_unreadable: Whether broken images are skipped.
        workers: Number of processes that read images from disk.
    """
    found = find_photographs(root, classes, classes[0])
    found, images = _read(root, found, size, skip_unreadable, workers)
    labels = [class_index(classes, item.label, str(root)) for item in found]
    return Split(images, torch.tensor(labels))


def _read(
    root: Path, found: list[Photograph], size: int, skip_unreadable: bool, workers: int
) -> tuple[list[Photograph], Tensor | ImageFiles]:
    """Read photographs, or prepare to read them later if they are large.

    Args:
        root: Folder of the photographs.
        found: Photographs in the folder.
        size: Pixels per side of the images.
        skip_unreadable: Whether broken images are skipped.
        workers: Number of processes that read images from disk.

    Returns:
        Photographs and their images. Images of more than RESIDENT pixels per
        side stay on disk, and whether they can be read is not known yet. Other
        images are uint8 of shape (N, 3, size, size), and photographs that
        cannot be read are left out.
    """
    if size > RESIDENT:
        paths = tuple(item.path for item in found)
        return found, ImageFiles(root, paths, size, workers, skip_unreadable)
    readable, images, broken = load_photographs(root, found, size, skip_unreadable)
    if broken:
        counts = f"{len(broken)} of {len(found)} images cannot be read and are skipped"
        console.warning("%s: %s", counts, broken[0])
    return readable, images
