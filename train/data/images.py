"""Images that stay on disk. Worker processes read an image each time that training shows it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from renderer.errors import InputError
from renderer.io.images import crop_center, read_rgb
from train import console

# Data sets with at most 64 pixels per side are kept in memory. Larger ones stay
# on disk.
MAX_SIZE_IN_MEMORY = 64
# Smallest fraction of the area of an image that a random crop shows. A smaller
# crop of a photograph of one object often misses the object.
MIN_CROP_AREA = 0.35
# A large JPEG file is decoded at a fraction of its size, which is fast. The decoded
# image has at least twice the size of the image that is shown.
DECODED_SCALE = 2

# Index of an image in `ImageFiles.paths`, and seed of its random crop. If the seed
# is None, the central square of the image is read instead of a crop.
Key = tuple[int, int | None]
# Error messages of the files that cannot be read, by the path of the file.
ReadErrors = dict[PurePosixPath, str]


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
        """Read random crops of images by indices and seeds. A random half of them is flipped."""
        return self._read([*zip(row.tolist(), seed.tolist(), strict=True)] for row, seed in batches)

    def _read(self, batches: Iterable[list[Key]]) -> Iterator[Tensor]:
        """Read batches of images in worker processes.

        The key of an image is its index in `paths` and the seed of its crop, or None for its
        square.
        """
        errors: ReadErrors = {}
        options: dict[str, Any] = {"num_workers": self.workers, "collate_fn": _collate}
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


class _Reader(Dataset[tuple[Tensor, ReadErrors]]):
    """PyTorch data set that reads image files in the worker processes of a DataLoader.

    Args:
        files: Image files to read.
    """

    def __init__(self, files: ImageFiles):
        # This import is here because torchvision takes a second to import.
        from torchvision.transforms import v2

        self._files = files
        area = (MIN_CROP_AREA, 1.0)
        bicubic = v2.InterpolationMode.BICUBIC
        crop = v2.RandomResizedCrop(files.size, area, interpolation=bicubic)
        self._crop = v2.Compose([crop, v2.RandomHorizontalFlip()])

    def __getitem__(self, key: Key) -> tuple[Tensor, ReadErrors]:
        """Read an image, or another image of its subfolder if it cannot be read.

        The next one in the list of paths comes first, and the image is black if none can be read.
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
                with torch.random.fork_rng(devices=[]):
                    # `torch.manual_seed` would also seed the generators of GPUs.
                    torch.default_generator.manual_seed(seed)
                    image = self._crop(image)
            return torch.from_numpy(np.array(image)).permute(2, 0, 1), errors
        return torch.zeros(3, size, size, dtype=torch.uint8), errors


def _collate(items: Sequence[tuple[Tensor, ReadErrors]]) -> tuple[Tensor, ReadErrors]:
    """Stack the images of a batch, and join their error messages."""
    errors = {path: error for _, of_image in items for path, error in of_image.items()}
    images = [image for image, _ in items]
    # An array without images broadcasts to any size.
    nothing = torch.empty(0, 3, 1, 1, dtype=torch.uint8)
    return torch.stack(images) if images else nothing, errors
