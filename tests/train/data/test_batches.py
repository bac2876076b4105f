import pytest
import torch
import torch.nn.functional as F
from scipy.stats import binomtest, chisquare

from train.data import batches
from train.data.batches import PADDING, Round, TrainingImages, crop_and_flip, rounds_of_epoch, training_batches
from train.data.sets import Split


def noise(*shape: int) -> torch.Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


def epoch_round(images: int, epoch: int) -> Round:
    return Round(epoch, epoch, torch.arange(images))


def numbered(images: torch.Tensor) -> TrainingImages:
    """All images of a split, without renders; each image's row is its label."""
    split = Split(images, torch.arange(len(images)))
    return TrainingImages(split, split.labels, split[:0])


@pytest.mark.parametrize("shape", [(5, 5), (6, 11)])
@pytest.mark.parametrize("flipped", [False, True])
def test_crops_are_those_of_a_reflect_padded_image_for_every_shift(shape, flipped):
    height, width = shape
    images = noise(3, 3, height, width)
    steps = range(-PADDING, PADDING + 1)
    shifts = torch.tensor([(down, right) for down in steps for right in steps]).T
    chosen = torch.arange(shifts.shape[1]) % len(images)
    cropped = crop_and_flip(images, chosen, shifts, torch.full((len(chosen),), flipped))
    padded = F.pad(images.double(), (PADDING,) * 4, mode="reflect").to(torch.uint8)
    for image, row, (down, right) in zip(cropped, chosen, shifts.T, strict=True):
        top, left = PADDING + down, PADDING + right
        expected = padded[row, :, top : top + height, left : left + width]
        assert torch.equal(image, expected.flip(2) if flipped else expected)


@pytest.mark.parametrize("size, most, count", [(11, PADDING, 6000), (65, PADDING, 1200), (129, 8, 1500)])
def test_shifts_and_flips_are_all_drawn_about_equally_often(size, most, count):
    middle, places = size // 2, torch.arange(size, dtype=torch.uint8)
    pixels = torch.stack([*torch.meshgrid(places, places, indexing="ij"), torch.zeros(size, size, dtype=torch.uint8)])
    shown = training_batches(numbered(pixels.expand(count, -1, -1, -1)), 300, 0, epoch_round(count, 0))
    around = torch.cat([images[:, :2, middle, middle - 1 : middle + 2] for images, *_ in shown]).long()
    flipped = around[:, 1, 0] > around[:, 1, 2]
    assert binomtest(int(flipped.sum()), count).pvalue > 1e-4
    rows, columns = around[..., 1].T - middle + most
    counts = (rows * (2 * most + 1) + columns).bincount()
    assert len(counts) == (2 * most + 1) ** 2 and chisquare(counts).pvalue > 1e-4


def test_alternating_flips_show_each_image_mirrored_in_every_other_epoch():
    ramp = torch.arange(11, dtype=torch.uint8).expand(40, 3, 11, 11)

    def mirrored(epoch: int) -> torch.Tensor:
        """By image."""
        ((images, labels, _),) = training_batches(numbered(ramp), 40, 0, epoch_round(40, epoch), "alternating")
        flipped = images[:, 0, 5, 4] > images[:, 0, 5, 6]
        return flipped[labels.argsort()]

    first, second, third = (mirrored(epoch) for epoch in range(3))
    assert torch.equal(first, ~second) and torch.equal(first, third)
    assert 0 < first.sum() < 40


def test_each_epoch_shows_every_image_once_with_its_own_label_and_fills_the_last_batch_with_the_first():
    plain = numbered(torch.arange(100, dtype=torch.uint8).view(-1, 1, 1, 1).expand(-1, 3, 8, 8))
    epoch = list(training_batches(plain, 7, 0, epoch_round(100, 0)))
    assert [len(labels) for _, labels, _ in epoch] == [7] * 15
    order = torch.cat([labels for _, labels, _ in epoch]).tolist()
    assert sorted(order[:100]) == list(range(100)) and order[100:] == order[:5]
    for images, labels, _ in epoch:
        assert images.dtype == torch.uint8 and images.shape == (len(labels), 3, 8, 8)
        assert torch.equal(images, labels.to(torch.uint8).view(-1, 1, 1, 1).expand_as(images))
    ((_, labels, _),) = training_batches(
        numbered(plain.split.images[:3]), 7, 0, epoch_round(3, 0)
    )  # a batch has every image several times
    assert len(labels) == 7 and labels[:3].tolist() == labels[3:6].tolist() and labels[6] == labels[0]


@pytest.mark.parametrize("flips", ["random", "alternating"])
@pytest.mark.parametrize("images_at_once", [1, 20])
def test_an_epoch_goes_on_from_any_batch_as_if_one_split_held_its_rows_and_renders(monkeypatch, flips, images_at_once):
    split, rows = Split(noise(90, 3, 8, 8), torch.arange(90)), torch.arange(0, 90, 2)
    renders = Split(255 - noise(5, 3, 8, 8), torch.arange(-5, 0))
    mixed = numbered(torch.cat([split.images[rows], renders.images]))
    whole = list(training_batches(mixed, 8, 0, epoch_round(50, 1), flips))
    monkeypatch.setattr(batches, "CHUNK_BYTES", images_at_once * 3 * 8 * 8)
    for first in range(len(whole) + 1):
        rest = list(training_batches(TrainingImages(split, rows, renders), 8, 0, epoch_round(50, 1), flips, first))
        assert len(rest) == len(whole) - first
        for (images, labels, rendered), (expected, numbers, _) in zip(rest, whole[first:], strict=True):
            assert torch.equal(images, expected) and torch.equal(rendered, numbers >= 45)
            assert torch.equal(labels, torch.cat([rows, renders.labels])[numbers])


def test_rounds_divide_the_epochs_images_and_each_has_all_renders():
    rounds = rounds_of_epoch(100, 7, seed=0, epoch=4, images_per_epoch=50, every=20)
    assert [(part.number, part.epoch) for part in rounds] == [(12, 4), (13, 4), (14, 4)]
    rows = [part.rows.tolist() for part in rounds]
    assert [len(part) for part in rows] == [27, 27, 17]
    assert all(part == sorted(part) and part[-7:] == list(range(100, 107)) for part in rows)
    images = [row for part in rows for row in part[:-7]]
    assert len(set(images)) == 50 and max(images) < 100
    (first,), (second,) = (rounds_of_epoch(100, 0, 0, epoch, 50, None) for epoch in (0, 1))
    assert first.rows.tolist() != second.rows.tolist()
    for images_per_epoch in (5000, None):
        (everything,) = rounds_of_epoch(98, 2, 0, 3, images_per_epoch, None)
        assert (everything.number, everything.epoch, everything.rows.tolist()) == (3, 3, list(range(100)))
