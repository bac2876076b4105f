"""Images that stay on disk. Worker processes read them whenever they are shown."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from renderer.errors import InputError
from renderer.io.images import central_square, read_rgb
from train import console

# Images of at most this many pixels per side are kept in memory instead.
RESIDENT = 64
# The smallest part of an image's area that a random crop shows. A smaller part of a photograph of
# one thing often shows none of it.
MINIMUM_AREA = 0.35
# A large JPEG is decoded to at least this many times the final size.
DECODED = 2

# Index of an image in `ImageFiles.paths`, and seed of its random crop. Without a
# seed, the central square is read.
Key = tuple[int, int | None]
# The reason why a file cannot be read, by path.
Faults = dict[PurePosixPath, str]


@dataclass(frozen=True)
class ImageFiles:
    """The images of a folder, as central squares or random crops.

    It stands in for a tensor of images in `train.data.sets.Split`.

    Attributes:
        folder: The folder.
        paths: The paths of the images in it.
        size: The pixels per side of a square or crop.
        workers: The number of processes that read.
        skip: Whether another image of the same folder is shown in place of one that cannot be
            read. Otherwise that is an InputError.
    """

    folder: Path
    paths: tuple[PurePosixPath, ...]
    size: int
    workers: int
    skip: bool

    device = torch.device("cpu")

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """The shape that a tensor of the images would have."""
        return len(self), 3, self.size, self.size

    def __getitem__(self, rows: Tensor | slice) -> "ImageFiles":
        """Return the files of some rows, by their numbers or a mask."""
        chosen = torch.arange(len(self))[rows].tolist()
        return replace(self, paths=tuple(self.paths[row] for row in chosen))

    def facts(self) -> list[tuple[str, int]]:
        """Return each path with its size in bytes, which a hash takes in place of the pixels."""
        return [(str(path), (self.folder / path).stat().st_size) for path in self.paths]

    def squares(self, rows: Iterable[Tensor]) -> Iterator[Tensor]:
        """Give the central squares of batches of rows.

        Args:
            rows: The rows of each batch, shape (B,).

        Returns:
            The images of each batch, uint8, shape (B, 3, size, size).
        """
        return self._read([(row, None) for row in batch.tolist()] for batch in rows)

    def crops(self, rows: Iterable[Tensor], seeds: Iterable[Tensor]) -> Iterator[Tensor]:
        """Give random crops of batches of rows. Half of them are flipped.

        Args:
            rows: The rows of each batch, shape (B,).
            seeds: A seed for each image of each batch, shape (B,).

        Returns:
            The images of each batch, uint8, shape (B, 3, size, size).
        """
        return self._read(
            list(zip(batch.tolist(), batch_seeds.tolist(), strict=True))
            for batch, batch_seeds in zip(rows, seeds, strict=True)
        )

    def _read(self, batches: Iterable[list[Key]]) -> Iterator[Tensor]:
        """Yield the images of batches.

        Args:
            batches: Keys of the images of each batch.

        Yields:
            Images of each batch, uint8, shape (B, 3, size, size).

        Raises:
            InputError: If an image cannot be read, unless `self.skip` is set.
        """
        broken: Faults = {}
        loader: DataLoader = DataLoader(
            _Reader(self),
            batch_sampler=list(batches),
            num_workers=self.workers,
            collate_fn=_collate,
        )
        for images, faults in loader:
            broken |= faults
            if broken and not self.skip:
                path, fault = next(iter(broken.items()))
                raise InputError(
                    f"{self.folder / path} cannot be read ({fault}): "
                    "replace it, or set skip_unreadable=True",
                )
            yield images
        if broken:
            first = next(iter(broken))
            console.warning("%d images cannot be read, others were shown: %s", len(broken), first)


class _Reader(Dataset[tuple[Tensor, Faults]]):
    """Reads one image at a time, in a process of its own.

    Args:
        files: The files.
    """

    def __init__(self, files: ImageFiles):
        from torchvision.transforms import v2  # torchvision takes a second to import

        self._files = files
        crop = v2.RandomResizedCrop(
            files.size,
            scale=(MINIMUM_AREA, 1.0),
            interpolation=v2.InterpolationMode.BICUBIC,
        )
        self._crop = v2.Compose([crop, v2.RandomHorizontalFlip()])

    def __getitem__(self, key: Key) -> tuple[Tensor, Faults]:
        """Read an image.

        Args:
            key: Index of the image, and seed of its random crop or None.

        Returns:
            The image, uint8, shape (3, size, size), and the reason by path for
            each file that could not be read. If no file could be read, the
            image is black.
        """
        row, seed = key
        broken: Faults = {}
        for path in self._candidates(row):
            try:
                image = read_rgb(self._files.folder / path, DECODED * self._files.size)
            except Exception as error:  # Pillow's decoders raise almost anything
                broken[path] = str(error)
                if self._files.skip:
                    continue
                break
            pixels = np.array(self._shown(image, seed))
            return torch.from_numpy(pixels).permute(2, 0, 1), broken
        size = self._files.size
        return torch.zeros(3, size, size, dtype=torch.uint8), broken

    def _candidates(self, row: int) -> Iterator[PurePosixPath]:
        """Yield the path of an image, and then the other paths of the same folder.

        Args:
            row: Index of the image.
        """
        paths = self._files.paths
        for ahead in range(len(paths)):
            path = paths[(row + ahead) % len(paths)]
            if path.parent == paths[row].parent:
                yield path

    def _shown(self, image: Image.Image, seed: int | None) -> Image.Image:
        """Return the central square of an image, or the random crop of a seed."""
        if seed is None:
            return central_square(image, self._files.size)
        with torch.random.fork_rng(devices=[]):
            # torch.manual_seed would seed the generators of GPUs, too.
            torch.default_generator.manual_seed(seed)
            return self._crop(image)


def _collate(items: Sequence[tuple[Tensor, Faults]]) -> tuple[Tensor, Faults]:
    """Stack the images of a batch.

    Args:
        items: For each image, a tensor (3, size, size) and the reasons by path
            for files that could not be read.

    Returns:
        Images of shape (B, 3, size, size), and the reasons of all images by path.
    """
    faults: Faults = {}
    for _, broken in items:
        faults |= broken
    if not items:
        return torch.empty(0), faults
    return torch.stack([image for image, _ in items]), faults
