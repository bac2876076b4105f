from pathlib import PurePosixPath

import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.stats import binomtest, chisquare

from augment.scene.truth import NO_OBJECT, boxes_of
from train.data import batches
from train.data.sets import ImageFiles, Split
from train.training.detection import object_maps, target_of


def noise(*shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)


def epoch_round(image_count: int, epoch: int) -> batches.Round:
    return batches.Round(epoch, epoch, torch.arange(image_count))


def numbered(images: torch.Tensor) -> tuple[Split, Split]:
    """Make training images without renders, each labeled with its row."""
    split = Split(images, torch.arange(len(images)))
    return split, split[:0]


@pytest.mark.parametrize("shape", [(5, 5), (6, 11)])
@pytest.mark.parametrize("is_flipped", [False, True])
def test_crops_are_those_of_a_reflect_padded_image_for_every_shift(shape, is_flipped):
    height, width = shape
    images = noise(3, 3, height, width)
    steps = torch.arange(-batches.SMALL_IMAGE_SHIFT, batches.SMALL_IMAGE_SHIFT + 1)
    shifts = torch.cartesian_prod(steps, steps)
    rows = torch.arange(len(shifts)) % len(images)
    flips = torch.full((len(rows),), is_flipped)

    cropped = batches.crop_and_flip(images, rows, shifts.T, flips)

    padded = F.pad(images.double(), (batches.SMALL_IMAGE_SHIFT,) * 4, mode="reflect").to(
        torch.uint8
    )
    for image, row, (down, right) in zip(cropped, rows, shifts, strict=True):
        top = batches.SMALL_IMAGE_SHIFT + down
        left = batches.SMALL_IMAGE_SHIFT + right
        expected = padded[row, :, top : top + height, left : left + width]
        if is_flipped:
            expected = expected.flip(2)
        assert torch.equal(image, expected)


@pytest.mark.parametrize(
    ("size", "largest_shift", "count"),
    [(11, batches.SMALL_IMAGE_SHIFT, 6000), (65, batches.SMALL_IMAGE_SHIFT, 1200), (129, 8, 1500)],
)
def test_shifts_and_flips_are_all_drawn_about_equally_often(size, largest_shift, count):
    # The first two channels of a pixel are its row and its column.
    places = torch.arange(size, dtype=torch.uint8)
    pixel_rows, pixel_columns = torch.meshgrid(places, places, indexing="ij")
    image = torch.stack([pixel_rows, pixel_columns, torch.zeros_like(pixel_rows)])
    data = numbered(image.expand(count, -1, -1, -1))

    middle = size // 2
    centers = []
    for images, *_ in batches.training_batches(*data, 300, 0, epoch_round(count, 0)):
        centers.append(images[:, :2, middle, middle - 1 : middle + 2].long())
    center = torch.cat(centers)  # (count, 2, 3): the middle pixel and its two neighbors

    is_flipped = center[:, 1, 0] > center[:, 1, 2]
    assert binomtest(int(is_flipped.sum()), count).pvalue > 1e-4
    down, right = center[..., 1].T - middle + largest_shift
    shift_count = 2 * largest_shift + 1
    occurrences = (down * shift_count + right).bincount()
    assert len(occurrences) == shift_count**2
    assert chisquare(occurrences).pvalue > 1e-4


def mirrored_rows(images: torch.Tensor | ImageFiles, now: batches.Round) -> torch.Tensor:
    """Return for each of 40 images, which grow brighter to the right, whether it is mirrored."""
    split = Split(images, torch.arange(40))
    no_renders = Split(images[:0], split.labels[:0])
    shown = batches.training_batches(split, no_renders, 40, 0, now, "alternating")
    ((images, labels, _),) = shown
    is_flipped = images[:, 0, 5, 4] > images[:, 0, 5, 6]
    return is_flipped[labels.argsort()]


@pytest.mark.parametrize("is_on_disk", [False, True])
def test_alternating_flips_show_each_image_mirrored_in_every_other_epoch(is_on_disk, tmp_path):
    images = torch.arange(0, 220, 20, dtype=torch.uint8).expand(40, 3, 11, 11)
    if is_on_disk:
        Image.fromarray(images[0].permute(1, 2, 0).numpy()).save(tmp_path / "a.png")
        images = ImageFiles(tmp_path, (PurePosixPath("a.png"),) * 40, 11, workers=0, skip=False)
    first = mirrored_rows(images, epoch_round(40, 0))
    assert 0 < first.sum() < 40
    assert torch.equal(mirrored_rows(images, epoch_round(40, 1)), ~first)
    assert torch.equal(mirrored_rows(images, epoch_round(40, 2)), first)


def test_an_epoch_shows_every_image_once_and_fills_the_last_batch_with_the_first_images():
    images = numbered(noise(100, 3, 8, 8))
    shown = batches.training_batches(*images, 7, 0, epoch_round(100, 0))
    labels = [labels for _, labels, _ in shown]
    assert [len(batch) for batch in labels] == [7] * 15
    order = torch.cat(labels).tolist()
    assert sorted(order[:100]) == list(range(100))
    assert order[100:] == order[:5]


@pytest.mark.parametrize("flips", ["random", "alternating"])
def test_an_epoch_continues_from_any_batch_as_if_one_split_held_its_part_and_renders(flips):
    split = Split(noise(90, 3, 8, 8), torch.arange(90))
    rows = torch.arange(0, 90, 2)
    renders = Split(255 - noise(5, 3, 8, 8), torch.arange(-5, 0))
    part = split.part(torch.arange(90) % 2 == 0)
    # Images in memory are not copied.
    assert part.images is split.images
    separate = part, renders
    mixed = numbered(torch.cat([split.images[rows], renders.images]))
    mixed_labels = torch.cat([rows, renders.labels])
    whole = list(batches.training_batches(*mixed, 8, 0, epoch_round(50, 1), flips))

    for first in range(len(whole) + 1):
        continued = batches.training_batches(*separate, 8, 0, epoch_round(50, 1), flips, first)
        for batch, expected in zip(continued, whole[first:], strict=True):
            images, labels, is_render = batch
            expected_images, mixed_rows, _ = expected
            assert torch.equal(images, expected_images)
            assert torch.equal(is_render, mixed_rows >= len(rows))
            assert torch.equal(labels, mixed_labels[mixed_rows])


class TestRounds:
    @pytest.mark.parametrize(("limit", "counts"), [(20, [17, 17, 16]), (49, [25, 25])])
    def test_divide_the_images_of_an_epoch_evenly_and_each_has_all_renders(self, limit, counts):
        rounds = batches.rounds_of_epoch(100, 7, 0, 4, 50, limit)
        assert batches.round_size(100, 50, limit) == max(counts)
        numbers = range(4 * len(counts), 5 * len(counts))
        assert [(part.number, part.epoch) for part in rounds] == [(n, 4) for n in numbers]
        images = []
        for part, image_count in zip(rounds, counts, strict=True):
            rows = part.rows.tolist()
            assert rows == sorted(rows)
            assert rows[image_count:] == list(range(100, 107))
            images += rows[:image_count]
        assert len(set(images)) == 50

    @pytest.mark.parametrize("images_per_epoch", [5000, None])
    def test_have_everything_if_an_epoch_is_not_shorter_than_the_data(self, images_per_epoch):
        (everything,) = batches.rounds_of_epoch(98, 2, 0, 3, images_per_epoch, None)
        assert (everything.number, everything.epoch) == (3, 3)
        assert everything.rows.tolist() == list(range(100))


def test_objects_in_renders_move_with_the_pixels_that_show_them():
    # Each object is a rectangle of its own brightness, so the pixels tell the truth.
    masks = torch.zeros(3, 2, 12, 16, dtype=torch.uint8)
    masks[0, 0, 4:9, 5:8] = masks[0, 1, 2:4, 9:15] = 1
    masks[1, 0, 5:9, 14:16] = 1  # Some shifts move this object out of the image.
    labels = [[7, 7], [300], []]
    targets = [
        {"labels": torch.tensor(label, dtype=torch.int64), "masks": shown[: len(label)]}
        for label, shown in zip(labels, masks, strict=True)
    ]
    light = torch.tensor([60, 90], dtype=torch.uint8)[:, None, None]
    renders = (masks * light).sum(1, dtype=torch.uint8)[:, None].repeat(1, 3, 1, 1)
    renders[:, 1] = torch.arange(3, dtype=torch.uint8)[:, None, None]  # Green is the index.
    photographs = Split(noise(4, 3, 12, 16), torch.zeros(4, dtype=torch.int64))
    images = photographs, Split(renders, object_maps(targets))
    counts = []
    for number in range(20):
        now = batches.Round(number, number, torch.arange(7))
        for batch, maps, is_render in batches.training_batches(*images, 7, 3, now):
            assert (maps[~is_render] == NO_OBJECT).all()
            for image, objects in zip(batch[is_render], maps[is_render], strict=True):
                red, index = image[0], int(image[1, 0, 0])
                shown = [value for value in (60, 90) if (red == value).any()]
                target = target_of(objects)
                expected = torch.stack([red == 0, *(red == value for value in shown)])[1:]
                assert torch.equal(target["masks"].bool(), expected)
                assert target["labels"].tolist() == labels[index][: len(shown)]
                assert torch.equal(target["boxes"], boxes_of(expected))
                counts.append((index, len(shown)))
    assert {(0, 2), (1, 0), (1, 1), (2, 0)} <= set(counts)


def test_a_batch_of_renders_alone_needs_no_file(tmp_path):
    Image.new("RGB", (12, 12), "red").save(tmp_path / "photograph.png")
    files = ImageFiles(tmp_path, (PurePosixPath("photograph.png"),), 12, workers=0, skip=False)
    photographs = Split(files, torch.zeros(1, dtype=torch.int64))
    renders = Split(noise(3, 3, 12, 12), torch.ones(3, dtype=torch.int64))
    made = [*batches.training_batches(photographs, renders, 2, 0, epoch_round(4, 0))]
    assert sorted(int(is_render.sum()) for _, _, is_render in made) == [1, 2]
    for shown, labels, is_render in made:
        assert labels.tolist() == is_render.int().tolist()
        is_red = (shown == torch.tensor([255, 0, 0])[:, None, None]).all(dim=(1, 2, 3))
        assert is_red.tolist() == (~is_render).tolist()
