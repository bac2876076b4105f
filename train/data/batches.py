"""The training batches of an epoch.

An epoch has one or more rounds. Renders are made anew for each round. A round
shows some images of the data set and all of its renders, in random order. Each
image is shifted by some pixels, and some images are flipped.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from augment import distributed
from augment.random_streams import generator
from train.data.images import ImageFiles
from train.data.sets import Split

# A training image of up to 64 pixels per side is shifted by at most 4 pixels.
# A larger image is shifted by at most a sixteenth of its side.
SMALL_IMAGE_SHIFT = 4
# `_batches_in_memory` shifts and flips batches of about this many bytes in one call.
CHUNK_BYTES = 2**24

# Images, uint8, shape (B, 3, H, W); their labels, shape (B,); and whether each
# image is a render, bool, shape (B,).
Batch = tuple[Tensor, Tensor, Tensor]


class TrainingImages(NamedTuple):
    """Images of a data set and renders, from which training batches are made.

    They are numbered together: the N training images of the data set have the
    numbers 0 to N - 1, and the renders have the numbers from N on.

    Attributes:
        split: Images of the data set. It may also have images that are held
            out for validation.
        rows: Indices into `split` of the N images that are trained on, shape
            (N,).
        renders: Renders with their labels.
    """

    split: Split
    rows: Int[Tensor, " N"]
    renders: Split


class Round(NamedTuple):
    """Part of an epoch that is trained on the same renders.

    Attributes:
        number: Number of rounds of the training run before this round.
        epoch: Number of epochs before the epoch of this round.
        rows: Numbers of the images of the round in ascending order, int64,
            shape (M,). The N images of the data set have the numbers 0 to
            N - 1. The renders have the numbers from N on.
    """

    number: int
    epoch: int
    rows: Int[Tensor, " M"]


@dataclass(frozen=True)
class Draws:
    """Random draws for the images of a round. They are the same on every device.

    A round has N batches of B images.

    Attributes:
        order: Number of the image at each place of each batch, as
            `TrainingImages` numbers the images, shape (N, B).
        shifts: Pixels by which each image is shifted, shape (2, N, B). The first
            entry is the vertical shift, the second the horizontal shift.
        flips: Whether each image is flipped left to right, bool, shape (N, B).
        seeds: Seed of the random crop of each image, shape (N, B). None if the
            data set is in memory, because its images are not cropped.
    """

    order: Int[Tensor, "N B"]
    shifts: Int[Tensor, "2 N B"]
    flips: Bool[Tensor, "N B"]
    seeds: Int[Tensor, "N B"] | None = None

    def of_columns(self, first: int, columns: slice) -> "Draws":
        """Select some batches of a round, and some images of each of them.

        All batches from `first` on are selected.
        """
        return Draws(
            order=self.order[first:, columns],
            shifts=self.shifts[:, first:, columns],
            flips=self.flips[first:, columns],
            seeds=None if self.seeds is None else self.seeds[first:, columns],
        )


def rounds_of_epoch(
    image_count: int,
    render_count: int,
    seed: int,
    epoch: int,
    images_per_epoch: int | None,
    images_per_round: int | None,
) -> list[Round]:
    """Divide the training images of an epoch into rounds. Each round shows all renders.

    A limit of None shows all images in the epoch, or in a single round.
    """
    draws = generator(seed, epoch, "rounds")
    shown_images = torch.randperm(image_count, generator=draws)[:images_per_epoch]
    render_numbers = torch.arange(image_count, image_count + render_count)
    parts = shown_images.split(images_per_round or len(shown_images))
    rounds = []
    for index, part in enumerate(parts):
        rows = torch.cat([part.sort().values, render_numbers])
        rounds.append(Round(epoch * len(parts) + index, epoch, rows))
    return rounds


def training_batches(
    images: TrainingImages,
    batch_size: int,
    seed: int,
    this_round: Round,
    flips: str = "random",
    first: int = 0,
) -> Iterator[Batch]:
    """Yield this process's images of each batch of a round.

    Each of P processes gets `batch_size` / P images of each batch. All batches
    have the same size: the last batch is filled up with the first images of the
    round. All random draws are made on the CPU, so they are the same for every
    device and every number of processes. Yield images, labels, and whether each image is a render.
    """
    draws = _draw(images, batch_size, seed, this_round, flips)
    own_size = batch_size // distributed.world_size()
    begin = distributed.rank() * own_size
    own_draws = draws.of_columns(first, slice(begin, begin + own_size))
    if isinstance(images.split.images, ImageFiles):
        return _batches_from_files(images, images.split.images, own_draws)
    return _batches_in_memory(images, own_size, own_draws)


def _draw(
    images: TrainingImages, batch_size: int, seed: int, this_round: Round, flips: str
) -> Draws:
    """Draw the order, shift, flip and crop of each image of a round at random."""
    shown_count = len(this_round.rows)
    permutation = torch.randperm(
        shown_count, generator=generator(seed, this_round.number, "batches")
    )
    batch_count = math.ceil(shown_count / batch_size)
    # The last batch is filled up with the first images of the permutation: `%` starts
    # again at 0.
    places = torch.arange(batch_count * batch_size) % shown_count
    order = this_round.rows[permutation][places].view(batch_count, batch_size)

    side = images.split.images.shape[-1]
    max_shift = max(SMALL_IMAGE_SHIFT, side // 16)
    draws = generator(seed, this_round.number, "shifts")
    shifts = torch.randint(-max_shift, max_shift + 1, (2, *order.shape), generator=draws)
    if flips == "random":
        draws = generator(seed, this_round.number, "flips")
        is_flipped = torch.randint(0, 2, order.shape, generator=draws, dtype=torch.bool)
    else:
        is_flipped = _alternating_flips(images, seed, this_round.epoch)[order]
    crop_seeds = None
    if isinstance(images.split.images, ImageFiles):
        draws = generator(seed, this_round.number, "crops")
        crop_seeds = torch.randint(2**62, order.shape, generator=draws)
    return Draws(order, shifts, is_flipped, crop_seeds)


def _alternating_flips(images: TrainingImages, seed: int, epoch: int) -> Bool[Tensor, " _"]:
    """Return whether each image is flipped in an epoch, if flips alternate.

    A random half of the images is flipped in even epochs. The other images are
    flipped in odd epochs. The renders follow the images of the data set.
    """
    count = len(images.rows) + len(images.renders)
    draws = generator(seed, "flips")
    is_flipped_in_even_epochs = torch.randint(0, 2, (count,), generator=draws, dtype=torch.bool)
    return is_flipped_in_even_epochs ^ bool(epoch % 2)


def _batches_in_memory(images: TrainingImages, batch_size: int, draws: Draws) -> Iterator[Batch]:
    """Yield the batches of a round (part of an epoch) from a data set in memory."""
    split, rows, renders = images
    pixels = cast(Tensor, split.images)
    device = pixels.device
    batch_bytes = batch_size * pixels[0].numel()
    chunk_size = batch_size * max(1, CHUNK_BYTES // batch_bytes)

    order = draws.order.flatten()
    is_render_on_cpu = order >= len(rows)
    chunks = [slice(begin, begin + chunk_size) for begin in range(0, len(order), chunk_size)]
    # The CPU finds the renders of all chunks before the first batch. On a GPU,
    # `nonzero` would wait for all earlier work.
    renders_in_chunk = [is_render_on_cpu[chunk].nonzero().squeeze(1).to(device) for chunk in chunks]
    # `clamp` gives each render some valid row of the data set. The image at this
    # row is replaced by the render below.
    row_of_image = rows[order.clamp(max=len(rows) - 1)].to(device)
    render_of_image = (order - len(rows)).to(device)
    shifts = draws.shifts.flatten(1).to(device)
    flips = draws.flips.flatten().to(device)
    is_render = is_render_on_cpu.to(device)

    for chunk, render_places in zip(chunks, renders_in_chunk, strict=True):
        shown_rows = row_of_image[chunk]
        shown = crop_and_flip(pixels, shown_rows, shifts[:, chunk], flips[chunk])
        labels = split.labels[shown_rows]
        if len(render_places):
            shown_renders = render_of_image[chunk][render_places]
            shown[render_places] = crop_and_flip(
                cast(Tensor, renders.images),
                shown_renders,
                shifts[:, chunk][:, render_places],
                flips[chunk][render_places],
            )
            labels[render_places] = renders.labels[shown_renders]
        image_batches = shown.split(batch_size)
        label_batches = labels.split(batch_size)
        is_render_batches = is_render[chunk].split(batch_size)
        yield from zip(image_batches, label_batches, is_render_batches, strict=True)


def _batches_from_files(images: TrainingImages, files: ImageFiles, draws: Draws) -> Iterator[Batch]:
    """Yield the batches of a round (part of an epoch) from a data set on disk."""
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
        shown = torch.empty(len(order), *files.shape[1:], dtype=torch.uint8, device=device)
        labels = torch.empty(len(order), dtype=torch.int64, device=device)
        shown[~is_render] = crops.to(device)
        labels[~is_render] = split.labels[rows_of_batch[index].to(device)]
        if is_render.any():
            shown_renders = (order[is_render] - len(rows)).to(device)
            shown[is_render] = crop_and_flip(
                cast(Tensor, renders.images),
                shown_renders,
                draws.shifts[:, index, is_render].to(device),
                draws.flips[index, is_render].to(device),
            )
            labels[is_render] = renders.labels[shown_renders]
        yield shown, labels, is_render.to(device)


def crop_and_flip(
    images: UInt8[Tensor, "N 3 H W"],
    chosen: Int[Tensor, " B"],
    shifts: Int[Tensor, "2 B"],
    flips: Bool[Tensor, " B"],
) -> UInt8[Tensor, "B 3 H W"]:
    """Select images, shift each by whole pixels, and flip some of them left to right.

    A shift uncovers pixels at a border of the image. They are filled by
    reflection at this border. `shifts` are vertical and horizontal, in pixels; positive ones move
    an image up and to the left.
    """
    height, width = images.shape[2:]
    device = images.device
    # Row i of result b is copied from row `source_rows[b, i]` of its image, and column j
    # from column `source_columns[b, j]`. The arrays have the shapes (B, H) and (B, W).
    source_rows = torch.arange(height, device=device) + shifts[0, :, None]
    source_rows = _reflect(source_rows, height)
    source_columns = torch.arange(width, device=device).expand(len(chosen), -1)
    source_columns = torch.where(flips[:, None], source_columns.flip(1), source_columns)
    source_columns = _reflect(source_columns + shifts[1, :, None], width)
    channels = torch.arange(3, device=device)
    # The four index arrays broadcast to the shape (B, 3, H, W) of the result.
    return images[
        chosen[:, None, None, None],
        channels[:, None, None],
        source_rows[:, None, :, None],
        source_columns[:, None, None, :],
    ]


def _reflect(index: Tensor, size: int) -> Tensor:
    """Reflect pixel indices outside an image at its border, as `torch.nn.ReflectionPad2d` does.

    The index -1 becomes 1, and the index `size` becomes `size` - 2.
    """
    last = size - 1
    return last - (last - index.abs()).abs()
