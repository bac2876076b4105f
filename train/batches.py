"""Batches of training images, data and renders, in the rounds of an epoch: shuffled, cropped and flipped."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor

from augment import utils
from augment.utils import generator
from train.data import Split
from train.image_files import ImageFiles

PADDING = 4  # pixels by which an image is shifted at most; above 64 pixels per side, a sixteenth of them
CHUNK_BYTES = 2**24  # of the batches that are cropped at once
FLIPS = ("random", "alternating")
Batches = Sequence[Tensor]


class TrainingImages(NamedTuple):
    """What a round draws from: the rows (N,) of a split, of which no copy is made, and behind them the renders."""

    split: Split
    rows: Tensor
    renders: Split


class Round(NamedTuple):
    """The training between two regenerations of the renders: an epoch, or a part of one."""

    number: int  # of the run's rounds, from 0
    epoch: int  # from 0
    rows: Tensor  # (N,) int64, ascending, the training images that it shows


def rounds_of_epoch(
    images: int, renders: int, seed: int, epoch: int, images_per_epoch: int | None, every: int | None
) -> list[Round]:
    """The epoch's images, drawn anew each epoch where they are not all, in rounds of `every`, each with all renders.

    images, renders: how many there are; renders come last. None: all images, and one round.
    """
    drawn = torch.randperm(images, generator=generator(seed, epoch, "rounds"))[:images_per_epoch]
    last = torch.arange(images, images + renders)
    rows = [torch.cat([part.sort().values, last]) for part in drawn.split(every or len(drawn))]
    return [Round(epoch * len(rows) + index, epoch, part) for index, part in enumerate(rows)]


def training_batches(
    images: TrainingImages, batch_size: int, seed: int, now: Round, flips: str = "random", first: int = 0
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """This process's shard of a round's batches: images (B, 3, H, W) uint8, labels (B,), and which are renders (B,).

    Shuffles, shifts by up to `PADDING`, mirrored at the border, then flips half: "random" ones, or "alternating", each
    image in every other epoch. All batches have one shape; the last one is filled up with the round's first images. All
    draws are made on the CPU, the same for every device and number of processes. first: the batch to begin with.
    """
    (split, data, renders), rows = images, now.rows
    order = rows[torch.randperm(len(rows), generator=generator(seed, now.number, "batches"))]
    order = order[torch.arange(math.ceil(len(rows) / batch_size) * batch_size) % len(rows)].view(-1, batch_size)
    most = max(PADDING, split.images.shape[-1] // 16)
    shifts = torch.randint(-most, most + 1, (2, *order.shape), generator=generator(seed, now.number, "shifts"))
    if flips == "random":
        flipped = torch.randint(0, 2, order.shape, generator=generator(seed, now.number, "flips"), dtype=torch.bool)
    else:
        drawn = torch.randint(0, 2, (len(data) + len(renders),), generator=generator(seed, "flips"), dtype=torch.bool)
        flipped = drawn[order] ^ bool(now.epoch % 2)
    shard = batch_size // utils.world_size()
    columns = slice(utils.rank() * shard, (utils.rank() + 1) * shard)
    if isinstance(split.images, ImageFiles):
        seeds = torch.randint(2**62, order.shape, generator=generator(seed, now.number, "crops"))
        chosen = (draws[..., first:, columns].unbind(-2) for draws in (order, shifts, flipped, seeds))
        yield from _batches_from_files(images, split.images, *chosen)
        return
    order, shifts, flipped = (draws[..., first:, columns].flatten(-2) for draws in (order, shifts, flipped))
    at_once = shard * max(1, CHUNK_BYTES // (shard * split.images[0].numel()))
    rendered, device = order >= len(data), split.images.device
    places = [part.nonzero().squeeze(1).to(device) for part in rendered.split(at_once)]
    draws = [data[order.clamp(max=len(data) - 1)], order - len(data), shifts, flipped, rendered]
    draws = [part.to(device) for part in draws]
    for begin, place in zip(range(0, len(order), at_once), places, strict=False):
        row, number, shift, flip, is_render = (part[..., begin : begin + at_once] for part in draws)
        cropped, labels = crop_and_flip(split.images, row, shift, flip), split.labels[row]
        if len(place):
            number = number[place]
            cropped[place] = crop_and_flip(cast(Tensor, renders.images), number, shift[:, place], flip[place])
            labels[place] = renders.labels[number]
        yield from zip(*(part.split(shard) for part in (cropped, labels, is_render)), strict=True)


def _batches_from_files(
    images: TrainingImages, files: ImageFiles, orders: Batches, shifts: Batches, flips: Batches, seeds: Batches
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """`training_batches` of files in random crops, with renders that are shifted and flipped."""
    (split, data, renders), device = images, images.split.labels.device
    rendered = [order >= len(data) for order in orders]
    rows = [data[order[~is_render]] for order, is_render in zip(orders, rendered, strict=True)]
    crops = files.crops(rows, [part[~is_render] for part, is_render in zip(seeds, rendered, strict=True)])
    for row, crop, order, shift, flip, is_render in zip(rows, crops, orders, shifts, flips, rendered, strict=True):
        pixels = torch.empty(len(order), *files.shape[1:], dtype=torch.uint8, device=device)
        labels = torch.empty(len(order), dtype=torch.int64, device=device)
        pixels[~is_render], labels[~is_render] = crop.to(device), split.labels[row.to(device)]
        if is_render.any():
            number = (order[is_render] - len(data)).to(device)
            shift, flip = shift[:, is_render].to(device), flip[is_render].to(device)
            pixels[is_render], labels[is_render] = (
                crop_and_flip(cast(Tensor, renders.images), number, shift, flip),
                renders.labels[number],
            )
        yield pixels, labels, is_render.to(device)


def crop_and_flip(images: Tensor, chosen: Tensor, shifts: Tensor, flips: Tensor) -> Tensor:
    """The chosen images (B,) shifted by (2, B) rows and columns, mirrored at the border, and flipped where (B,)."""
    height, width = images.shape[2:]
    rows = _reflect(torch.arange(height, device=images.device) + shifts[0, :, None], height)
    columns = torch.arange(width, device=images.device).expand(len(chosen), -1)
    columns = torch.where(flips[:, None], columns.flip(1), columns)
    columns = _reflect(columns + shifts[1, :, None], width)
    channels = torch.arange(3, device=images.device)[:, None, None]
    return images[chosen[:, None, None, None], channels, rows[:, None, :, None], columns[:, None, None, :]]


def _reflect(index: Tensor, size: int) -> Tensor:
    """Indices outside 0..size-1 mirrored at the border pixel, as torch's "reflect" padding does."""
    return (size - 1) - ((size - 1) - index.abs()).abs()
