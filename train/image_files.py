"""Images that stay on disk: read whenever they are shown, by processes of their own, in random crops for training."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from renderer.errors import InputError
from renderer.io.images import central_square, read_rgb
from train import console

RESIDENT = 64  # pixels per side up to which images are kept in memory
LEAST = 0.35  # of an image's area in a random crop: of photographs of one thing, less often shows none of it
DECODED = 2  # times the final size, to which a large JPEG is decoded at least
Key = tuple[int, int | None]  # a row, and the seed of its crop


@dataclass(frozen=True)
class ImageFiles:
    """The images of a folder by their paths, as center squares or crops of size × size; `workers` processes read.

    skip: show another image of the same folder in place of one that cannot be read. Otherwise InputError.
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
        """As of a tensor of the images."""
        return len(self), 3, self.size, self.size

    def __getitem__(self, rows: Tensor | slice) -> "ImageFiles":
        """Those of some rows, by their numbers or a mask."""
        chosen = torch.arange(len(self))[rows].tolist()
        return replace(self, paths=tuple(self.paths[row] for row in chosen))

    def facts(self) -> list[tuple[str, int]]:
        """Each path with its file's size in bytes, in place of the pixels in a hash."""
        return [(str(path), (self.folder / path).stat().st_size) for path in self.paths]

    def squares(self, rows: Iterable[Tensor]) -> Iterator[Tensor]:
        """The center squares of batches of rows, uint8 (B, 3, size, size)."""
        return self._read([(row, None) for row in batch.tolist()] for batch in rows)

    def crops(self, rows: Iterable[Tensor], seeds: Iterable[Tensor]) -> Iterator[Tensor]:
        """Random crops of batches of rows, half of them flipped, uint8 (B, 3, size, size); a seed for each image."""
        return self._read(list(zip(*map(Tensor.tolist, pair), strict=True)) for pair in zip(rows, seeds, strict=True))

    def _read(self, batches: Iterable[list[Key]]) -> Iterator[Tensor]:
        broken: dict[PurePosixPath, str] = {}
        options: dict[str, Any] = {"num_workers": self.workers, "collate_fn": _collate}
        for images, faults in DataLoader(_Reader(self), batch_sampler=list(batches), **options):
            broken |= faults
            if broken and not self.skip:
                path, fault = next(iter(broken.items()))
                advice = "replace it, or set evaluate.skip_unreadable=true"
                raise InputError(f"{self.folder / path} cannot be read ({fault}): {advice}")
            yield images
        if broken:
            console.warning("%d images cannot be read, others were shown: %s", len(broken), next(iter(broken)))


class _Reader(Dataset[tuple[Tensor, dict[PurePosixPath, str]]]):
    def __init__(self, files: ImageFiles):
        from torchvision.transforms import v2  # takes a second, as wherever torchvision is imported where it is used

        self._files = files
        crop = v2.RandomResizedCrop(files.size, scale=(LEAST, 1.0), interpolation=v2.InterpolationMode.BICUBIC)
        self._crop = v2.Compose([crop, v2.RandomHorizontalFlip()])

    def __getitem__(self, key: Key) -> tuple[Tensor, dict[PurePosixPath, str]]:
        """An image (3, size, size) uint8, and the files that could not be read."""
        row, seed = key
        paths, broken = self._files.paths, dict[PurePosixPath, str]()
        others = (paths[(row + ahead) % len(paths)] for ahead in range(len(paths)))
        for path in (path for path in others if path.parent == paths[row].parent):
            try:
                image = read_rgb(self._files.folder / path, DECODED * self._files.size)
            except Exception as error:  # Pillow's decoders raise almost anything at a broken file
                broken[path] = str(error)
                if self._files.skip:
                    continue
                break
            return torch.from_numpy(np.array(self._shown(image, seed))).permute(2, 0, 1), broken
        return torch.zeros(3, self._files.size, self._files.size, dtype=torch.uint8), broken

    def _shown(self, image: Image.Image, seed: int | None) -> Image.Image:
        if seed is None:
            return central_square(image, self._files.size)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)  # not a GPU's, too
            return self._crop(image)


def _collate(items: Sequence[tuple[Tensor, dict[PurePosixPath, str]]]) -> tuple[Tensor, dict[PurePosixPath, str]]:
    faults = {path: fault for _, broken in items for path, fault in broken.items()}
    return torch.stack([image for image, _ in items]) if items else torch.empty(0), faults
