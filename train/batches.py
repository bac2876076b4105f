"""The input pipeline: uint8 pictures that live on the device, cropped and flipped there for many batches at once."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from augment import processes
from augment.seeding import generator

PADDING = 4
CHUNK_BYTES = 2**28  # holds a whole epoch of CIFAR-100; larger data sets are cropped in several chunks
FLIPS = ("random", "alternating")


@dataclass(frozen=True)
class Round:
    """What is trained on between two regenerations of the renders: an epoch, or a part of one.

    number: counts a run's rounds from 0. epoch: the one it is of. rows: (N,) int64, ascending, which images it shows.
    """

    number: int
    epoch: int
    rows: Tensor


def to_unit(images: Tensor) -> Tensor:
    """uint8 pictures to float32 RGB in [0, 1]."""
    return images.float() / 255


def batch_count(pictures: int, batch_size: int) -> int:
    """Batches in a round."""
    return math.ceil(pictures / batch_size)


def training_batches(
    images: Tensor, labels: Tensor, batch_size: int, seed: int, now: Round, flips: str = "random", first: int = 0
) -> Iterator[tuple[Tensor, Tensor]]:
    """One shuffled round of (images (B, 3, H, W) uint8, labels (B,)): this process's share of every batch.

    Reflect-pads by 4 and crops, then flips half of the pictures: "random" ones, or "alternating", each picture in every
    other epoch. All batches have one shape, as the device's graphs need; the last one is filled up with the round's
    first pictures. All draws are made on the CPU and moved over once, so that they are the same on every device and for
    any number of processes. first: the batch to begin with.
    """
    order = _order(now.rows, batch_size, generator(seed, now.number, "batches"))
    shifts = torch.randint(-PADDING, PADDING + 1, (2, *order.shape), generator=generator(seed, now.number, "shifts"))
    flipped = _flipped(order, len(images), seed, now, flips)
    share = batch_size // processes.count()
    mine = slice(processes.index() * share, (processes.index() + 1) * share)
    order, shifts, flipped = (draws[..., first:, mine].to(images.device) for draws in (order, shifts, flipped))
    batches_at_once = max(1, CHUNK_BYTES // (share * images[0].numel()))
    for begin in range(0, len(order), batches_at_once):
        rows = slice(begin, begin + batches_at_once)
        chosen = order[rows].flatten()
        cropped = crop_and_flip(images, chosen, shifts[:, rows].flatten(1), flipped[rows].flatten())
        yield from zip(cropped.split(share), labels[chosen].split(share), strict=True)


def _order(rows: Tensor, batch_size: int, draws: torch.Generator) -> Tensor:
    """Rows in random order, (batches, batch_size), beginning again where they run out."""
    order = rows[torch.randperm(len(rows), generator=draws)]
    places = torch.arange(batch_count(len(rows), batch_size) * batch_size) % len(rows)
    return order[places].view(-1, batch_size)


def _flipped(order: Tensor, pictures: int, seed: int, now: Round, flips: str) -> Tensor:
    if flips == "random":
        return torch.randint(0, 2, order.shape, generator=generator(seed, now.number, "flips"), dtype=torch.bool)
    in_even_epochs = torch.randint(0, 2, (pictures,), generator=generator(seed, "flips"), dtype=torch.bool)
    return in_even_epochs[order] ^ bool(now.epoch % 2)


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
