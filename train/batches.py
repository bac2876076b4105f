"""The input pipeline: uint8 pictures that live on the device, cropped and flipped a batch at a time by indexing."""

from collections.abc import Iterator

import torch
from torch import Tensor

from augment.seeding import generator

PADDING = 4


def to_unit(images: Tensor) -> Tensor:
    """uint8 pictures to float32 RGB in [0, 1]."""
    return images.float() / 255


def to_bytes(images: Tensor) -> Tensor:
    """Float RGB in [0, 1] to uint8, rounded."""
    return (images * 255).round().to(torch.uint8)


def training_batches(images: Tensor, labels: Tensor, batch_size: int, seed: int, epoch: int) -> Iterator:
    """One shuffled epoch of (images (B, 3, H, W) float32 in [0, 1], labels (B,)); the last batch may be short.

    Reflect-pads by 4 and crops, then flips half of the pictures. All draws are made once, on the CPU, so that they
    are the same on every device, and moved over once.
    """
    count, draws = len(images), generator(seed, epoch, "batches")
    order = torch.randperm(count, generator=draws).to(images.device)
    shifts = torch.randint(-PADDING, PADDING + 1, (2, count), generator=draws).to(images.device)
    flips = torch.randint(0, 2, (count,), generator=draws, dtype=torch.bool).to(images.device)
    for start in range(0, count, batch_size):
        rows = slice(start, start + batch_size)
        yield to_unit(crop_and_flip(images, order[rows], shifts[:, rows], flips[rows])), labels[order[rows]]


def crop_and_flip(images: Tensor, chosen: Tensor, shifts: Tensor, flips: Tensor) -> Tensor:
    """The chosen pictures (B,) shifted by (2, B) rows and columns, mirrored at the border, and flipped where (B,)."""
    height, width = images.shape[2:]
    rows = _reflect(torch.arange(height, device=images.device) + shifts[0, :, None], height)
    columns = torch.arange(width, device=images.device).expand(len(chosen), -1)
    columns = torch.where(flips[:, None], columns.flip(1), columns)
    columns = _reflect(columns + shifts[1, :, None], width)
    channels = torch.arange(3, device=images.device)
    return images[
        chosen[:, None, None, None], channels[:, None, None], rows[:, None, :, None], columns[:, None, None, :]
    ]


def _reflect(index: Tensor, size: int) -> Tensor:
    """Indices outside 0..size-1 mirrored at the border pixel, as torch's "reflect" padding does."""
    return (size - 1) - ((size - 1) - index.abs()).abs()
