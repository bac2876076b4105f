"""The training batches of an epoch.

An epoch has one or more rounds. A round shows some of the data and all of its renders, shuffled,
shifted and flipped.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from torch import Tensor

from augment import distributed
from augment.random_streams import generator
from train.data.images import ImageFiles
from train.data.sets import Split

# Images of up to 64 pixels per side are shifted by up to this many pixels. Larger images are
# shifted by up to a sixteenth of their side.
PADDING = 4
# Bytes of the batches that `_batches_in_memory` shifts and flips at a time.
CHUNK_BYTES = 2**24

# Images (B, 3, H, W) uint8, labels (B,), and which of them are renders (B,).
Batch = tuple[Tensor, Tensor, Tensor]


class TrainingImages(NamedTuple):
    """Images from which the batches of a round are drawn.

    The N images of the data have the numbers 0 to N - 1. The renders have the
    numbers from N.

    Attributes:
        split: Data set, which also holds the images that validate.
        rows: Rows of the data set that are trained on, shape (N,).
        renders: Renders of the round.
    """

    split: Split
    rows: Tensor
    renders: Split


class Round(NamedTuple):
    """The training between two regenerations of the renders: an epoch, or a part of one.

    Attributes:
        number: Number of the round in the run, from 0.
        epoch: Number of its epoch, from 0.
        rows: Numbers of its images in `TrainingImages`, ascending, int64, shape
            (M,).
    """

    number: int
    epoch: int
    rows: Tensor


@dataclass(frozen=True)
class Draws:
    """Random draws for the images of a round. They are the same on every device.

    A round has N batches of B images.

    Attributes:
        order: Number of each image in `TrainingImages`, shape (N, B).
        shifts: Pixels by which each image is shifted, shape (2, N, B). The first
            dimension has rows and columns.
        flips: Whether each image is flipped, bool, shape (N, B).
        seeds: Seed of the random crop of each image, shape (N, B). None if the
            images are in memory.
    """

    order: Tensor
    shifts: Tensor
    flips: Tensor
    seeds: Tensor | None = None

    def of_columns(self, first: int, columns: slice) -> "Draws":
        """Return the draws of a part of each batch.

        Args:
            first: Number of the first batch that is kept.
            columns: Images of each batch that are kept.

        Returns:
            Draws of the kept images.
        """
        return Draws(
            order=self.order[first:, columns],
            shifts=self.shifts[:, first:, columns],
            flips=self.flips[first:, columns],
            seeds=None if self.seeds is None else self.seeds[first:, columns],
        )


def rounds_of_epoch(
    images: int,
    renders: int,
    seed: int,
    epoch: int,
    images_per_epoch: int | None,
    every: int | None,
) -> list[Round]:
    """Divide an epoch into rounds. Each round shows all renders.

    Args:
        images: The number of training images.
        renders: The number of renders.
        seed: The seed of the run.
        epoch: The epoch, from 0.
        images_per_epoch: The number of images that an epoch shows. They are drawn anew for each
            epoch. None shows all.
        every: The number of images that a round shows. None makes one round.

    Returns:
        The rounds.
    """
    draws = generator(seed, epoch, "rounds")
    drawn = torch.randperm(images, generator=draws)[:images_per_epoch]
    numbers_of_renders = torch.arange(images, images + renders)
    parts = drawn.split(every or len(drawn))
    rounds = []
    for index, part in enumerate(parts):
        rows = torch.cat([part.sort().values, numbers_of_renders])
        rounds.append(Round(epoch * len(parts) + index, epoch, rows))
    return rounds


def training_batches(
    images: TrainingImages,
    batch_size: int,
    seed: int,
    now: Round,
    flips: str = "random",
    first: int = 0,
) -> Iterator[Batch]:
    """Yield the part of each batch of a round that this process trains on.

    All batches have the same size. The last one is filled up with the first
    images of the round. All draws are made on the CPU. They are the same for
    every device and every number of processes.

    Args:
        images: The data and the renders.
        batch_size: The number of images of a batch, in all processes.
        seed: The seed of the run.
        now: The round.
        flips: "random" flips half of the images. "alternating" flips each image in every other
            epoch.
        first: The batch to begin with.

    Yields:
        The images, uint8, shape (B, 3, H, W), their labels (B,), and which are renders (B,).
    """
    draws = _draw(images, batch_size, seed, now, flips)
    share = batch_size // distributed.world_size()
    begin = distributed.rank() * share
    draws = draws.of_columns(first, slice(begin, begin + share))
    if isinstance(images.split.images, ImageFiles):
        return _batches_from_files(images, images.split.images, draws)
    return _batches_in_memory(images, share, draws)


def _draw(images: TrainingImages, batch_size: int, seed: int, now: Round, flips: str) -> Draws:
    """Draw the order, the shifts, the flips and the crops of the images of a round.

    Args:
        images: Data and renders.
        batch_size: Number of images of a batch, in all processes.
        seed: Seed of the run.
        now: The round.
        flips: "random" or "alternating", see `training_batches`.

    Returns:
        Draws for all batches of the round.
    """
    shown = len(now.rows)
    batches = math.ceil(shown / batch_size)
    shuffled = now.rows[torch.randperm(shown, generator=generator(seed, now.number, "batches"))]
    # The last batch is filled up with the first images of the round.
    filled_up = torch.arange(batches * batch_size) % shown
    order = shuffled[filled_up].view(-1, batch_size)

    most = max(PADDING, images.split.images.shape[-1] // 16)
    draws = generator(seed, now.number, "shifts")
    shifts = torch.randint(-most, most + 1, (2, *order.shape), generator=draws)
    if flips == "random":
        draws = generator(seed, now.number, "flips")
        is_flipped = torch.randint(0, 2, order.shape, generator=draws, dtype=torch.bool)
    else:
        count = len(images.rows) + len(images.renders)
        draws = generator(seed, "flips")
        # Whether each image is flipped in even epochs. In odd epochs, the other
        # images are flipped.
        by_image = torch.randint(0, 2, (count,), generator=draws, dtype=torch.bool)
        is_flipped = by_image[order] ^ bool(now.epoch % 2)
    seeds = None
    if isinstance(images.split.images, ImageFiles):
        seeds = torch.randint(2**62, order.shape, generator=generator(seed, now.number, "crops"))
    return Draws(order, shifts, is_flipped, seeds)


def _batches_in_memory(images: TrainingImages, share: int, draws: Draws) -> Iterator[Batch]:
    """Yield the batches of a round whose images are in memory.

    Args:
        images: Data and renders.
        share: Number of images of a batch in this process, B.
        draws: Draws for the images of this process.

    Yields:
        Images (B, 3, H, W) uint8, labels (B,), and which are renders (B,).
    """
    split, rows, renders = images
    pixels = cast(Tensor, split.images)
    device = pixels.device
    # Number of images that are shifted and flipped in one call. It is a multiple
    # of `share`, the number of images of this process in a batch, so that these
    # images fill whole batches.
    at_once = share * max(1, CHUNK_BYTES // (share * pixels[0].numel()))

    # The draws of all batches are copied to the device together, so that no batch
    # waits for a copy.
    order = draws.order.flatten()
    is_render_on_cpu = order >= len(rows)
    parts = [slice(begin, begin + at_once) for begin in range(0, len(order), at_once)]
    places_of_renders = [is_render_on_cpu[part].nonzero().squeeze(1).to(device) for part in parts]
    # The rows of renders are wrong here. Renders replace these images below.
    row_of_image = rows[order.clamp(max=len(rows) - 1)].to(device)
    render_of_image = (order - len(rows)).to(device)
    shifts = draws.shifts.flatten(1).to(device)
    flips = draws.flips.flatten().to(device)
    is_render = is_render_on_cpu.to(device)

    for part, places in zip(parts, places_of_renders, strict=True):
        chosen = row_of_image[part]
        shown = crop_and_flip(pixels, chosen, shifts[:, part], flips[part])
        labels = split.labels[chosen]
        if len(places):
            number = render_of_image[part][places]
            shown[places] = crop_and_flip(
                cast(Tensor, renders.images),
                number,
                shifts[:, part][:, places],
                flips[part][places],
            )
            labels[places] = renders.labels[number]
        batches = shown.split(share)
        labels_of_batches = labels.split(share)
        is_render_of_batches = is_render[part].split(share)
        yield from zip(batches, labels_of_batches, is_render_of_batches, strict=True)


def _batches_from_files(images: TrainingImages, files: ImageFiles, draws: Draws) -> Iterator[Batch]:
    """Yield the batches of a round whose images are read from files.

    The images are shown in random crops, which are flipped at random when they
    are read. Renders are shifted and flipped in this function.

    Args:
        images: Data and renders.
        files: Files of the data.
        draws: Draws for the images of this process, in batches of B images.

    Yields:
        Images (B, 3, H, W) uint8, labels (B,), and which are renders (B,).
    """
    split, rows, renders = images
    device = split.labels.device
    seeds = cast(Tensor, draws.seeds)
    is_render_in_batch = [order >= len(rows) for order in draws.order]
    rows_of_batch = []
    seeds_of_batch = []
    for order, is_render, seed in zip(draws.order, is_render_in_batch, seeds, strict=True):
        rows_of_batch.append(rows[order[~is_render]])
        seeds_of_batch.append(seed[~is_render])

    crops_of_batch = files.crops(rows_of_batch, seeds_of_batch)
    for index, crops in enumerate(crops_of_batch):
        order = draws.order[index]
        is_render = is_render_in_batch[index]
        pixels = torch.empty(len(order), *files.shape[1:], dtype=torch.uint8, device=device)
        labels = torch.empty(len(order), dtype=torch.int64, device=device)
        pixels[~is_render] = crops.to(device)
        labels[~is_render] = split.labels[rows_of_batch[index].to(device)]
        if is_render.any():
            number = (order[is_render] - len(rows)).to(device)
            pixels[is_render] = crop_and_flip(
                cast(Tensor, renders.images),
                number,
                draws.shifts[:, index, is_render].to(device),
                draws.flips[index, is_render].to(device),
            )
            labels[is_render] = renders.labels[number]
        yield pixels, labels, is_render.to(device)


def crop_and_flip(images: Tensor, chosen: Tensor, shifts: Tensor, flips: Tensor) -> Tensor:
    """Take some images, flip some of them left to right, and shift each.

    Pixels from outside an image are mirrored at its border.

    Args:
        images: Images, shape (N, 3, H, W).
        chosen: Indices of the images to take, shape (B,).
        shifts: Rows and columns by which each image is shifted, shape (2, B).
        flips: Whether each image is flipped left to right, bool, shape (B,).

    Returns:
        The images, shape (B, 3, H, W).
    """
    height, width = images.shape[2:]
    device = images.device
    # For each image, the rows (B, H) and the columns (B, W) that its pixels are
    # taken from.
    rows = _reflect(torch.arange(height, device=device) + shifts[0, :, None], height)
    columns = torch.arange(width, device=device).expand(len(chosen), -1)
    columns = torch.where(flips[:, None], columns.flip(1), columns)
    columns = _reflect(columns + shifts[1, :, None], width)
    channels = torch.arange(3, device=device)
    return images[
        chosen[:, None, None, None],
        channels[:, None, None],
        rows[:, None, :, None],
        columns[:, None, None, :],
    ]


def _reflect(index: Tensor, size: int) -> Tensor:
    """Mirror indices below 0 or above size - 1 at the border pixel.

    The index -1 becomes 1, and `size` becomes size - 2, as in the mode
    "reflect" of torch.
    """
    return (size - 1) - ((size - 1) - index.abs()).abs()
