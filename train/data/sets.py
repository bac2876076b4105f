"""Data sets of images: CIFAR-100, an .npz file, class folders, or a folder without labels.

Images of more than 64 pixels per side stay on disk. Worker processes read such an image each time
that training shows it.
"""

import hashlib
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int, Shaped, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from augment.progress import progress
from augment.random_streams import generator, seeded
from augment.tasks.classification import class_index
from renderer.errors import InputError, describe, explained
from renderer.io.images import crop_center, read_rgb
from train import console
from train.data import photographs

# Folders with these names hold splits of a data set. All other folders hold the
# images of a class.
SPLIT_NAMES = ("train", "training", "val", "valid", "validation", "dev", "test", "testing")
# Largest number of unlabeled images that are held out from training. 1000 images are
# enough to measure to about 1% on which fraction of the images two networks agree.
HELD_OUT = 1000
# Data sets with at most 64 pixels per side are kept in memory. Larger ones stay
# on disk.
MAX_SIZE_IN_MEMORY = 64
# Smallest fraction of the area of an image that a random crop shows. A smaller
# crop of a photograph of one object often misses the object.
MIN_CROP_AREA = 0.35
# A large JPEG file is decoded at a fraction of its size, which is fast. The decoded
# image has at least twice the size of the image that is shown.
DECODED_SCALE = 2
# Seconds in which worker processes read on after SIGTERM.
GRACE = 5

# Index of an image in `ImageFiles.paths`, and seed of its random crop. If the seed
# is None, the central square of the image is read instead of a crop.
Key = tuple[int, int | None]
# Error messages of the files that cannot be read, by the path of the file.
ReadErrors = dict[PurePosixPath, str]


def content_hash(state: Any) -> str:
    """Compute a SHA-256 hash of nested values, such as the content of a checkpoint.

    It depends on all keys, values, types and shapes.
    """
    digest = hashlib.sha256()
    _update(digest, state)
    return digest.hexdigest()


def _update(digest: Any, value: Any) -> None:
    """Add a value, with all values inside it, to a hash."""
    match value:
        case Tensor():
            on_cpu = value.detach().cpu().contiguous()
            digest.update(f"{on_cpu.dtype}{tuple(on_cpu.shape)}".encode())
            # The bytes of the tensor, without a copy. A contiguous tensor of one value may have a
            # stride of 0, with which it could not be viewed as bytes.
            flat = on_cpu.as_strided((on_cpu.numel(),), (1,))
            digest.update(flat.view(torch.uint8).numpy().data)
        case Mapping():
            for key, item in value.items():
                digest.update(f"{key!r}:".encode())
                _update(digest, item)
        case list() | tuple():
            digest.update(f"[{len(value)}]".encode())
            for item in value:
                _update(digest, item)
        case _:
            digest.update(f"{value!r};".encode())


@dataclass(frozen=True)
class ImageFiles:
    """Image files of a data set, which are read as central squares or random crops.

    `train.data.sets.Split` has them instead of a tensor of images.

    Attributes:
        folder: Folder of the data set.
        paths: Paths of the images, relative to the folder.
        size: Pixels per side of the squares and crops.
        workers: Number of processes that read images.
        skip: Whether an image that cannot be read is replaced by another image
            of the same subfolder. If False, such an image raises an
            InputError.
    """

    folder: Path
    paths: tuple[PurePosixPath, ...]
    size: int
    workers: int
    skip: bool

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape that a tensor of the images would have: (images, 3, size, size)."""
        return len(self), 3, self.size, self.size

    def __getitem__(self, rows: Tensor | slice) -> "ImageFiles":
        """Select images by a slice, an index array or a boolean mask."""
        indices = torch.arange(len(self))[rows].tolist()
        return replace(self, paths=tuple(self.paths[index] for index in indices))

    def to(self, device: torch.device) -> "ImageFiles":
        """Return the files themselves, which are read on the CPU."""
        return self

    def squares(self, rows: Iterable[Tensor]) -> Iterator[Tensor]:
        """Read the central squares of images, batch by batch.

        Each batch has B indices into `paths`, and gives uint8 images of shape (B, 3, size, size).
        """
        return self._read([(row, None) for row in batch.tolist()] for batch in rows)

    def crops(self, batches: Iterable[tuple[Tensor, Tensor]]) -> Iterator[Tensor]:
        """Read random crops of images by indices and seeds."""
        return self._read([*zip(row.tolist(), seed.tolist(), strict=True)] for row, seed in batches)

    def _read(self, batches: Iterable[list[Key]]) -> Iterator[Tensor]:
        """Read batches of images in worker processes.

        The key of an image is its index in `paths` and the seed of its crop, or None for its
        square.
        """
        errors: ReadErrors = {}
        options: dict[str, Any] = {"num_workers": self.workers, "collate_fn": _collate}
        # Otherwise, each loader draws from the global generator, also when a run is resumed.
        options["generator"] = torch.Generator()
        if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
            options["worker_init_fn"] = _outlive_signal
        loader: DataLoader = DataLoader(_Reader(self), batch_sampler=list(batches), **options)
        for images, errors_in_batch in loader:
            errors |= errors_in_batch
            # Unless errors are skipped, the first one stops the run.
            for path, error in () if self.skip else errors.items():
                advice = "replace the file, or set skip_unreadable=True"
                raise InputError(f"{self.folder / path} cannot be read ({error}): {advice}")
            yield images
        if errors:
            first = next(iter(errors))
            console.warning("%d images cannot be read, others were shown: %s", len(errors), first)


def _outlive_signal(worker: int) -> None:
    """Read on for GRACE seconds after SIGTERM, which a job sends to all its processes at once.

    The main process ends its step in this time. Workers may not ignore the signal, because a
    process that ends sends it to them, and waits for them.
    """

    def exit_later(*_: object) -> None:
        timer = threading.Timer(GRACE, os._exit, (0,))
        timer.daemon = True
        timer.start()

    signal.signal(signal.SIGTERM, exit_later)


class _Reader(Dataset[tuple[Tensor, ReadErrors]]):
    """PyTorch data set that reads image files in the worker processes of a DataLoader.

    Args:
        files: Image files to read.
    """

    def __init__(self, files: ImageFiles):
        # This import is here because torchvision takes a second to import.
        from torchvision.transforms import v2

        self._files = files
        bicubic = v2.InterpolationMode.BICUBIC
        self._crop = v2.RandomResizedCrop(files.size, (MIN_CROP_AREA, 1.0), interpolation=bicubic)

    def __getitem__(self, key: Key) -> tuple[Tensor, ReadErrors]:
        """Read an image, or another image of its subfolder if it cannot be read.

        The next one in the list of paths comes first, and the image is black if none can be read.
        The list has only images for training, or only those for validation.
        The dictionary has the error of each unreadable file.
        """
        index, seed = key
        paths, size = self._files.paths, self._files.size
        errors: ReadErrors = {}
        # The files after this one, and then those before it. Only those in its subfolder are tried.
        for place in range(index, index + len(paths)):
            path = paths[place % len(paths)]
            if path.parent != paths[index].parent:
                continue
            try:
                image = read_rgb(self._files.folder / path, DECODED_SCALE * size)
            # Pillow raises errors of almost any type for a damaged file.
            except Exception as error:
                errors[path] = str(error)
                if self._files.skip:
                    continue
                break
            if seed is None:
                image = crop_center(image, size)
            else:
                with seeded(seed):
                    image = self._crop(image)
            return torch.from_numpy(np.array(image)).permute(2, 0, 1), errors
        return torch.zeros(3, size, size, dtype=torch.uint8), errors


def _collate(items: Sequence[tuple[Tensor, ReadErrors]]) -> tuple[Tensor, ReadErrors]:
    """Stack the images of a batch, and join their error messages."""
    errors = {path: error for _, of_image in items for path, error in of_image.items()}
    images = [image for image, _ in items]
    # An array without images broadcasts to any size.
    return torch.stack(images) if images else torch.empty(0, 3, 1, 1, dtype=torch.uint8), errors


@dataclass(frozen=True)
class Split:
    """Images and their labels, such as the training split of a data set.

    Attributes:
        images: Images, uint8 RGB, shape (N, 3, H, W). If they stay on disk,
            their files.
        labels: Index of the class of each image, int64, shape (N,). For renders with
            objects, maps of them, shape (N, 1, H, W).
        rows: Places of the N images in `images`, if it has others, too. None for all.
    """

    images: Tensor | ImageFiles
    labels: Shaped[Tensor, "N ..."]
    rows: Int[Tensor, " N"] | None = None

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 hash of the images and labels.

        For images on disk, the names and sizes of the files are hashed instead
        of the pixels.
        """
        content: Any = self.images
        if isinstance(content, ImageFiles):
            folder = content.folder
            content = [(str(path), (folder / path).stat().st_size) for path in content.paths]
        return content_hash([content, self.labels])

    def to(self, device: torch.device) -> "Split":
        """Copy the labels, and the images if they are in memory, to a device."""
        return Split(self.images.to(device), self.labels.to(device))

    def squares(self, rows: Iterable[Tensor]) -> Iterator[Tensor]:
        """Yield images of the split, batch by batch.

        Images on disk are reduced to their central squares.
        """
        images = self.images
        if isinstance(images, ImageFiles):
            return images.squares(rows)
        return (images[self.places(batch)] for batch in rows)

    def places(self, rows: Tensor) -> Tensor:
        """Return the places in `images` of images of the split."""
        return rows if self.rows is None else self.rows[rows]

    def part(self, is_chosen: Bool[Tensor, " N"]) -> "Split":
        """Return some of the images. Those in memory are not copied."""
        if isinstance(self.images, ImageFiles):
            return self[is_chosen]
        rows = is_chosen.nonzero()[:, 0].to(self.labels.device)
        return Split(self.images, self.labels[rows], rows)

    def sample(self, count: int) -> UInt8[Tensor, "_ 3 H W"]:
        """Return images whose indices are evenly spread from the first to the last image.

        A smaller split returns all of its images.
        """
        indices = torch.linspace(0, len(self) - 1, min(count, len(self))).long()
        return next(iter(self.squares([indices])))

    def __getitem__(self, rows: Tensor | slice) -> "Split":
        return Split(self.images[rows], self.labels[rows])


@dataclass(frozen=True)
class DataSet:
    """Data set with a training split and a test split.

    Attributes:
        classes: Names of the classes. A label is an index into them.
        train: Images for training.
        test: Images for testing.
        labeled: Whether the classes of the images are known. If False, all
            labels are 0. Training replaces them by the predictions of the
            network that it starts from.
        rendered: Whether the images are renders of generated solids.
    """

    classes: tuple[str, ...]
    train: Split
    test: Split
    labeled: bool = True
    rendered: bool = False

    @property
    def size(self) -> int:
        """Pixels per side of the images."""
        return self.train.images.shape[-1]


def relabeled(data: DataSet, classes: Sequence[str], subject: str) -> DataSet:
    """Replace the labels of a data set by the class indices of a network."""
    # The new label of each old label.
    new_labels = torch.tensor([class_index(classes, name, subject) for name in data.classes])
    splits = [Split(split.images, new_labels[split.labels]) for split in (data.train, data.test)]
    return replace(data, classes=tuple(classes), train=splits[0], test=splits[1])


def held_out_rows(split: Split, fraction: float, argument: str = "fraction") -> Bool[Tensor, " N"]:
    """Draw a fraction of the images of every class at random, to hold them out.

    A larger fraction holds out the same images and additional ones.
    """
    is_held_out = torch.zeros(len(split), dtype=torch.bool)
    draws = generator(0, "validation")
    labels = split.labels.unique()
    for label in labels:
        indices_of_class = torch.nonzero(split.labels == label).squeeze(1)
        class_size = len(indices_of_class)
        if class_size == 1:
            where = f" of class {int(label)}" if len(labels) > 1 else ""
            fault = f"{argument}={fraction} cannot split the one image{where}"
            raise InputError(f"{fault}: add images{where}", argument)
        # At least one image of each class is in either part.
        count = min(max(round(fraction * class_size), 1), class_size - 1)
        # A larger fraction takes more of the same random order.
        order = torch.randperm(class_size, generator=draws)
        is_held_out[indices_of_class[order[:count]]] = True
    return is_held_out


def channel_statistics(images: UInt8[Tensor, "N 3 H W"]) -> tuple[list[float], list[float]]:
    """Compute the mean and the standard deviation of the pixels of each color channel.

    They are computed in float64 from a histogram of the 256 pixel values. This
    makes rounding errors negligible. Pixels are scaled to [0, 1], and a deviation is at least
    0.001.
    """
    values = torch.arange(256, dtype=torch.float64) / 255
    # Number of pixels of each channel with each of the 256 values.
    counts = [torch.bincount(channel.flatten(), minlength=256) for channel in images.unbind(1)]
    histograms = torch.stack(counts).double()
    fractions = histograms / histograms.sum(1, keepdim=True)
    means = fractions @ values
    variances = (fractions * (values - means[:, None]) ** 2).sum(1)
    return means.tolist(), variances.sqrt().clamp(min=1e-3).tolist()


def load_cifar100(path: str) -> DataSet:
    """Load CIFAR-100 with torchvision.

    If the folder lacks the data set, or if its checksum is wrong, it is
    downloaded to the folder.
    """
    # This import is here because torchvision takes a second to import.
    from torchvision.datasets import CIFAR100

    fault = f"path={path} does not contain CIFAR-100, and the download failed"
    with explained(fault, "give a copy, or connect to the internet", "path"):
        both = [CIFAR100(path, train=is_train, download=True) for is_train in (True, False)]
    images = [torch.from_numpy(cifar.data).permute(0, 3, 1, 2).contiguous() for cifar in both]
    train, test = map(Split, images, [torch.tensor(cifar.targets) for cifar in both])
    return DataSet(tuple(both[0].classes), train, test)


def load_npz(path: str) -> DataSet:
    """Load a data set from a NumPy .npz file.

    The file has these arrays:

    - train_images and test_images: uint8 RGB, shape (N, 3, S, S);
    - train_labels and test_labels: index of the class of each image, shape (N,);
    - classes: names of the C classes, shape (C,).

    Pickled arrays raise InputError, because they could run code.
    """
    if not Path(path).is_file():
        raise InputError(f"path={path} does not exist: give the path of an .npz file", "path")
    arrays = "train_images, train_labels, test_images, test_labels and classes"
    fault = f"path={path} is not an .npz file of labeled images"
    with explained(fault, f"give the arrays {arrays}", "path"):
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            classes = archive["classes"]
            if classes.ndim != 1 or classes.dtype.kind != "U" or len({*classes}) != len(classes):
                raise ValueError("classes must be distinct strings, one per class")
            train, test = [
                _npz_split(archive[f"{name}_images"], archive[f"{name}_labels"], len(classes))
                for name in progress(("train", "test"), "reading the data")
            ]
        if train.images.shape[1:] != test.images.shape[1:]:
            raise ValueError("train_images and test_images differ in size")
        return DataSet(tuple(classes.tolist()), train, test)


def _npz_split(images: np.ndarray, labels: np.ndarray, class_count: int) -> Split:
    """Check arrays of images and labels, and convert them to a `Split`."""
    is_square = images.ndim == 4 and images.shape[1] == 3 and images.shape[2] == images.shape[3]
    if not is_square or images.dtype != np.uint8:
        raise ValueError(f"images are {describe(images)}; they must be uint8 (N, 3, S, S)")
    if labels.shape != images.shape[:1] or labels.dtype.kind not in "iu":
        raise ValueError(f"labels are {describe(labels)}; they must be integers ({len(images)},)")
    if not len(labels) or labels.min() < 0 or labels.max() >= class_count:
        raise ValueError(f"labels must be 0 to {class_count - 1}, one at least")
    return Split(torch.from_numpy(images), torch.from_numpy(labels.astype(np.int64)))


def load_folder(
    path: str, size: int, test_fraction: float, skip_unreadable: bool = False, workers: int = 0
) -> DataSet:
    """Load a data set from a folder with a subfolder of images for each class.

    The folder may instead have two subfolders, `train` and `test`, each with a
    subfolder for each class.

    If `size` is at most `MAX_SIZE_IN_MEMORY`, the central squares of all images
    are read and reduced to this size. Otherwise the images stay on disk. `test_fraction` is not
    used if there is a subfolder `test`.
    """
    root = Path(path)
    split_names = [name for name in photographs.folder_names(root) if name.lower() in SPLIT_NAMES]
    if split_names not in ([], ["test", "train"]):
        fault = f"path={path} holds the folders {', '.join(split_names)}"
        raise InputError(f"{fault}: give train and test, or class folders only", "path")
    train_root = root / "train" if split_names else root
    classes = tuple(photographs.folder_names(train_root))
    if len(classes) < 2:
        raise InputError(f"path={path} has {len(classes)} class folders: give two or more", "path")
    other_files = photographs.unsupported_files(root)
    if other_files:
        console.warning("%d files are no images: %s", len(other_files), root / other_files[0])
    options = (classes, size, skip_unreadable, workers)
    train = _read(train_root, *options)
    # A class without an image could not be learned.
    for label in sorted(set(range(len(classes))).difference(train.labels.tolist())):
        raise InputError(f"{train_root / classes[label]} holds no image: add some, or remove it")
    if split_names:
        return DataSet(classes, train, _read(root / "test", *options))
    is_test = held_out_rows(train, test_fraction, "test_fraction")
    return DataSet(classes, train[~is_test], train[is_test])


def load_unlabeled(path: str, size: int, test_fraction: float, skip: bool, workers: int) -> DataSet:
    """Load all images of a folder and its subfolders as an unlabeled data set.

    It has no classes, every label is 0, and at most HELD_OUT images are test images.
    """
    split = _read(Path(path), (), size, skip, workers)
    is_test = held_out_rows(split, min(test_fraction, HELD_OUT / len(split)), "test_fraction")
    return DataSet((), split[~is_test], split[is_test], labeled=False)


def _read(root: Path, classes: Sequence[str], size: int, skip: bool, workers: int) -> Split:
    """Read the images of a folder into memory if `size` is small. Otherwise leave them on disk.

    Unreadable images are left out, but files on disk are not read yet. Without `classes`, every
    label is 0.
    """
    if classes:
        # Images alone would be of one class, and folders that are no classes would be negatives.
        names = photographs.folder_names(root)
        wrong = {*names}.difference(classes) if names else {"no class folder"}
        if wrong:
            advice = f"give folders named by the classes only, such as {classes[0]}"
            raise InputError(f"path: {root} holds {min(wrong)}: {advice}", "path")
        # The positive class does not matter here, so the first class stands for it.
        found = photographs.find_photographs(root, classes, classes[0])
    else:
        found = photographs.find_unlabeled(root)
    images: Tensor | ImageFiles
    if size > MAX_SIZE_IN_MEMORY:
        images = ImageFiles(root, tuple(item.path for item in found), size, workers, skip)
    else:
        found, images, broken = photographs.load_photographs(root, found, size, skip)
        if broken:
            console.warning("%d unreadable images are skipped: %s", len(broken), broken[0])
    labels = [class_index(classes, item.label, str(root)) if classes else 0 for item in found]
    return Split(images, torch.tensor(labels))
