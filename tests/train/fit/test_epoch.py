import pytest
import torch
import torch.nn.functional as F

from renderer.image import to_bytes, to_unit
from train.fit import epoch as epochs
from train.fit.epoch import PADDING, Round, crop_and_flip, training_batches


def noise(*shape: int) -> torch.Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


def whole_epoch(images: torch.Tensor, epoch: int) -> Round:
    return Round(epoch, epoch, torch.arange(len(images)))


def epoch_of(count: int, seed: int = 0, epoch: int = 0, batch_size: int = 7) -> list[tuple[torch.Tensor, ...]]:
    """Batches of plain images, each of its own value, which is its label too."""
    rows = torch.arange(count)
    images = rows.view(-1, 1, 1, 1).expand(-1, 3, 8, 8).to(torch.uint8)
    return list(training_batches(images, rows, batch_size, seed, whole_epoch(images, epoch)))


@pytest.mark.parametrize("shape", [(8, 8), (5, 5), (6, 11)])
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


def test_each_epoch_shows_every_image_once_with_its_own_label_and_fills_the_last_batch_with_the_first():
    shown = epoch_of(100)
    assert [len(labels) for _, labels, _ in shown] == [7] * 15
    order = torch.cat([labels for _, labels, _ in shown]).tolist()
    assert sorted(order[:100]) == list(range(100)) and order[100:] == order[:5]
    for images, labels, _ in shown:
        assert images.dtype == torch.uint8 and images.shape == (len(labels), 3, 8, 8)
        assert torch.equal(images, labels.to(torch.uint8).view(-1, 1, 1, 1).expand_as(images))


def test_batches_tell_which_of_their_images_are_renders():
    rows = torch.arange(30)
    shown = training_batches(noise(30, 3, 8, 8), rows, 7, 0, Round(0, 0, rows[5:], renders=4))
    assert all(torch.equal(rendered, labels >= 26) for _, labels, rendered in shown)


def test_fewer_images_than_a_batch_fill_it_several_times():
    ((_, labels, _),) = epoch_of(3)
    assert len(labels) == 7 and labels[:3].tolist() == labels[3:6].tolist() and labels[6] == labels[0]


@pytest.mark.parametrize("flips", ["random", "alternating"])
@pytest.mark.parametrize("images_at_once", [1, 20, 10**6])
def test_an_epoch_goes_on_from_any_batch_as_if_it_had_never_stopped(monkeypatch, flips, images_at_once):
    images, labels = noise(50, 3, 8, 8), torch.arange(50)
    whole = list(training_batches(images, labels, 8, 0, whole_epoch(images, 1), flips))
    monkeypatch.setattr(epochs, "CHUNK_BYTES", images_at_once * 3 * 8 * 8)
    for first in range(len(whole) + 1):
        rest = list(training_batches(images, labels, 8, 0, whole_epoch(images, 1), flips, first))
        assert len(rest) == len(whole) - first
        for found, expected in zip(rest, whole[first:], strict=True):
            assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_alternating_flips_show_each_image_mirrored_in_every_other_epoch():
    ramp = torch.arange(11, dtype=torch.uint8).expand(40, 3, 11, 11)

    def mirrored(epoch: int) -> torch.Tensor:
        """By image."""
        now = whole_epoch(ramp, epoch)
        ((images, labels, _),) = training_batches(ramp, torch.arange(40), 40, 0, now, "alternating")
        flipped = images[:, 0, 5, 4] > images[:, 0, 5, 6]
        return flipped[labels.argsort()]

    first, second, third = (mirrored(epoch) for epoch in range(3))
    assert torch.equal(first, ~second) and torch.equal(first, third)
    assert 0 < first.sum() < 40


def test_batches_are_a_function_of_seed_and_epoch_alone():
    images, labels = noise(50, 3, 8, 8), torch.arange(50)
    drawn = {}
    for seed, epoch in [(0, 0), (0, 1), (1, 0)]:
        torch.manual_seed(len(drawn))
        first, again = (
            torch.cat([x for x, *_ in training_batches(images, labels, 16, seed, whole_epoch(images, epoch))])
            for _ in range(2)
        )
        assert torch.equal(first, again)
        drawn[seed, epoch] = first
    assert not torch.equal(drawn[0, 0], drawn[0, 1]) and not torch.equal(drawn[0, 0], drawn[1, 0])


def test_shifts_and_flips_are_all_drawn_about_equally_often():
    count, size, middle = 6000, 11, 5
    place = torch.arange(size * size).view(1, 1, size, size).expand(count, 3, -1, -1).to(torch.uint8)
    (images, *_), *_ = training_batches(place, torch.zeros(count), count, 0, whole_epoch(place, 0))
    seen = images[:, 0, middle].long()
    flipped = seen[:, middle - 1] > seen[:, middle + 1]
    assert abs(flipped.double().mean() - 0.5) < 4 * 0.5 / count**0.5  # four standard deviations
    counts = seen[:, middle].bincount(minlength=size * size).view(size, size)[1:-1, 1:-1]
    assert counts.sum() == count
    chi_square = ((counts - count / 81) ** 2 / (count / 81)).sum()
    assert chi_square < 80 + 4 * (2 * 80) ** 0.5  # four standard deviations at 80 degrees of freedom


def test_bytes_survive_the_way_to_unit_and_back():
    values = torch.arange(256, dtype=torch.uint8)
    assert torch.equal(to_bytes(to_unit(values)), values)
    assert to_unit(values)[[0, 255]].tolist() == [0, 1]
