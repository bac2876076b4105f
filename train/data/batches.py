"""The training batches of an epoch.

An epoch has one or more rounds. Renders are made anew for each round. A round
shows some images of the data set and all of its renders, in random order. Each
image is shifted by some pixels, and some images are flipped.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from augment import distributed
from augment.random_streams import generator
from augment.scene.truth import NO_OBJECT
from train.data.sets import ImageFiles, Split

# A training image of up to 64 pixels per side is shifted by at most 4 pixels.
# A larger image is shifted by at most a sixteenth of its side.
SMALL_IMAGE_SHIFT = 4

# Images, uint8, shape (B, 3, H, W); their labels, shape (B,), or maps of the objects
# in renders, shape (B, 1, H, W); and whether each image is a render, bool, shape (B,).
Batch = tuple[Tensor, Tensor, Tensor]


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


def round_size(image_count: int, images_per_epoch: int | None, per_round: int | None) -> int:
    """Return the largest number of images of the data set in a round, see `rounds_of_epoch`."""
    shown = min(image_count, images_per_epoch or image_count)
    return math.ceil(shown / math.ceil(shown / (per_round or shown)))


def rounds_of_epoch(
    image_count: int, render_count: int, seed: int, epoch: int, *limits: int | None
) -> list[Round]:
    """Divide the training images of an epoch into rounds. Each round shows all renders.

    `limits` are the largest numbers of images of the data set in the epoch and in a round. A limit
    of None shows all images in the epoch, or in a single round.
    """
    draws = generator(seed, epoch, "rounds")
    shown_images = torch.randperm(image_count, generator=draws)[: limits[0]]
    # Renders are numbered after the images of the data set.
    render_numbers = torch.arange(image_count, image_count + render_count)
    size = round_size(image_count, *limits)
    # The sizes of the parts differ by at most one.
    parts = shown_images.tensor_split(math.ceil(len(shown_images) / size))
    # Numbers of the images and renders of a round are in ascending order.
    return [
        Round(epoch * len(parts) + index, epoch, torch.cat([part.sort().values, render_numbers]))
        for index, part in enumerate(parts)
    ]


def training_batches(
    split: Split,
    renders: Split,
    batch_size: int,
    seed: int,
    this_round: Round,
    flips: str = "random",
    first: int = 0,
) -> Iterator[Batch]:
    """Yield this process's images of each batch of a round, from the batch `first` on.

    `split` has the images of the data set that are trained on, and `renders` the renders.
    Each of P processes gets `batch_size` / P images of each batch. All batches
    have the same size: the last batch is filled up with the first images of the
    round. All random draws are made on the CPU, so they are the same for every
    device and every number of processes. Yield images, labels, and whether each image is a render.
    """
    own_size = batch_size // distributed.world_size()
    begin = distributed.rank() * own_size
    # The batches from `first` on, and in each the places of this process.
    own = (..., slice(first, None), slice(begin, begin + own_size))
    drawn = _draw(split, renders, batch_size, seed, this_round, flips)
    order, shifts, is_flipped, seeds = (draws[own] for draws in drawn)
    is_render = order >= len(split)
    # `clamp` gives each render some valid row of the data set. It is replaced by the render below.
    row_of_image = order.clamp(max=len(split) - 1)
    crops: Iterator[Tensor] = iter(())
    if isinstance(split.images, ImageFiles):
        draws_of_batches = zip(row_of_image, seeds, ~is_render, strict=True)
        crops = split.images.crops((row[mask], seed[mask]) for row, seed, mask in draws_of_batches)
    # All draws are copied before the first batch, since a GPU finishes earlier work before a copy.
    device = split.labels.device
    draws = (row_of_image, order - len(split), shifts.transpose(0, 1), is_flipped, is_render)
    on_device = [one.to(device) for one in draws]
    # Places of the renders in each batch. On a GPU, `nonzero` would wait for earlier work, too.
    all_places = [mask.nonzero().squeeze(1).to(device) for mask in is_render]
    for index, (row, render, shift, flip, mask) in enumerate(zip(*on_device, strict=True)):
        if isinstance(split.images, ImageFiles):
            shown = torch.empty(own_size, *split.images.shape[1:], dtype=torch.uint8)
            shown[~is_render[index]] = next(crops)
            shown = shown.to(device)
            shown = torch.where(flip[:, None, None, None], shown.flip(3), shown)
        else:
            shown = crop_and_flip(split.images, split.places(row), shift, flip)
        labels = split.labels[row]
        places = all_places[index]
        if len(places):
            render = render[places]
            pixels = cast(Tensor, renders.images)
            shown[places] = crop_and_flip(pixels, render, shift[:, places], flip[places])
            shown_labels = renders.labels[render]
            if shown_labels.ndim > 1:
                # Maps of the objects move with the images. A photograph has none.
                maps = renders.labels
                shown_labels = crop_and_flip(maps, render, shift[:, places], flip[places])
                labels = torch.full_like(shown, NO_OBJECT, dtype=maps.dtype)[:, :1]
            labels[places] = shown_labels
        yield shown, labels, mask


def _draw(
    split: Split, renders: Split, batch_size: int, seed: int, this_round: Round, flips: str
) -> tuple[Int[Tensor, "N B"], Int[Tensor, "2 N B"], Bool[Tensor, "N B"], Int[Tensor, "N B"]]:
    """Draw the N batches of B images of a round at random.

    Return the number of the image at each place of each batch, its shifts as `crop_and_flip` takes
    them, whether it is flipped, and the seed of its random crop, which only images on disk need.
    """
    shown_count = len(this_round.rows)
    draws = generator(seed, this_round.number, "batches")
    permutation = torch.randperm(shown_count, generator=draws)
    batch_count = math.ceil(shown_count / batch_size)
    # The last batch is filled up with the first images of the permutation: `%` starts
    # again at 0.
    places = torch.arange(batch_count * batch_size) % shown_count
    order = this_round.rows[permutation][places].view(batch_count, batch_size)

    max_shift = max(SMALL_IMAGE_SHIFT, split.images.shape[-1] // 16)
    draws = generator(seed, this_round.number, "shifts")
    shifts = torch.randint(-max_shift, max_shift + 1, (2, *order.shape), generator=draws)
    if flips == "random":
        draws = generator(seed, this_round.number, "flips")
        is_flipped = torch.randint(0, 2, order.shape, generator=draws, dtype=torch.bool)
    else:
        # A random half of the images is flipped in even epochs, and the others in odd epochs.
        count = len(split) + len(renders)
        draws = generator(seed, "flips")
        is_flipped_if_even = torch.randint(0, 2, (count,), generator=draws, dtype=torch.bool)
        is_flipped = (is_flipped_if_even ^ bool(this_round.epoch % 2))[order]
    draws = generator(seed, this_round.number, "crops")
    return order, shifts, is_flipped, torch.randint(2**62, order.shape, generator=draws)


def crop_and_flip(
    images: Shaped[Tensor, "N C H W"],
    chosen: Int[Tensor, " B"],
    shifts: Int[Tensor, "2 B"],
    flips: Bool[Tensor, " B"],
) -> Shaped[Tensor, "B C H W"]:
    """Select images, shift each by whole pixels, and flip some of them left to right.

    A shift uncovers pixels at a border of the image. They are filled by
    reflection at this border. `shifts` are vertical and horizontal, in pixels; positive ones move
    an image up and to the left.
    """
    height, width = images.shape[2:]
    device = images.device
    # Row i of result b is copied from row `source_rows[b, i]` of its image, and column j
    # from column `source_columns[b, j]`. The arrays have the shapes (B, H) and (B, W).
    source_rows = _reflect(torch.arange(height, device=device) + shifts[0, :, None], height)
    source_columns = torch.arange(width, device=device).expand(len(chosen), -1)
    source_columns = torch.where(flips[:, None], source_columns.flip(1), source_columns)
    source_columns = _reflect(source_columns + shifts[1, :, None], width)
    # The four index arrays broadcast to the shape (B, C, H, W) of the result.
    return images[
        chosen[:, None, None, None],
        torch.arange(images.shape[1], device=device)[:, None, None],
        source_rows[:, None, :, None],
        source_columns[:, None, None, :],
    ]


def _reflect(index: Tensor, size: int) -> Tensor:
    """Reflect pixel indices outside an image at its border, as `torch.nn.ReflectionPad2d` does.

    The index -1 becomes 1, and the index `size` becomes `size` - 2.
    """
    last = size - 1
    return last - (last - index.abs()).abs()
