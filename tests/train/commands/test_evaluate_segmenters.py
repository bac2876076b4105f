import json
from contextlib import nullcontext
from itertools import product

import numpy as np
import pytest
import torch
from PIL import Image

import norm_balls as nb
from renderer.errors import InputError

CLASSES = ["background", "dark", "bright"]
SIZE = 24
# Height and width of the photographs.
SHAPES = ((24, 48), (48, 24), (24, 24))


def _by_brightness(images):
    """Return logits of three classes, by thirds of the brightness."""
    mean = images.mean(1)
    return torch.stack([-(9 * (mean - level).abs()) for level in (0.0, 0.5, 1.0)], dim=1)


@pytest.fixture
def folder(tmp_path):
    """Write photographs in three grays, in blocks of 8 pixels, with masks that are partly wrong."""
    rng = np.random.default_rng(0)
    for number, (height, width) in enumerate(SHAPES):
        levels, mask = rng.integers(0, 3, (2, height // 8, width // 8)).repeat(8, 1).repeat(8, 2)
        mask = np.where(rng.random(mask.shape) < 0.7, levels, mask).astype(np.uint8)
        mask[:4] = 255
        for name, pixels in (("images", 127 * levels), ("masks", mask)):
            path = tmp_path / "photographs" / name / "part" / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels.astype(np.uint8)).save(path)
    return tmp_path / "photographs"


def _read(path):
    with Image.open(path) as image:
        return np.array(image)


def test_the_iou_of_each_class_is_that_of_the_pixels_with_a_class(folder, tmp_path):
    # Only the last photograph has the size of the network. The others are reduced.
    for kind, number in product(("images", "masks"), (0, 1)):
        (folder / kind / "part" / f"{number}.png").unlink()
    out = tmp_path / "out"
    scores = nb.evaluate(_by_brightness, folder, classes=CLASSES, size=SIZE, out=out)
    truth, guess = _read(folder / "masks/part/2.png"), _read(folder / "images/part/2.png") // 127
    for index, name in enumerate(CLASSES):
        true, found = truth[truth != 255] == index, guess[truth != 255] == index
        assert scores.by_class[name] == pytest.approx((true & found).sum() / (true | found).sum())
    summary = json.loads((out / "summary.json").read_text())
    assert summary["miou"]["value"] == pytest.approx(np.mean([*scores.by_class.values()]))
    assert (out / "contact_sheet.png").is_file()


@pytest.mark.parametrize("fit", ["letterbox", "stretch"])
def test_borders_are_not_scored_and_masks_follow_the_photographs(folder, fit):
    for path in (folder / "images").rglob("*.png"):
        # The photographs are their own masks.
        mask = folder / "masks" / path.relative_to(folder / "images")
        Image.fromarray(_read(path) // 127).save(mask)
    scores = nb.evaluate(_by_brightness, folder, classes=CLASSES, size=96, fit=fit)
    assert scores.photograph_count == 3
    # Only pixels at edges differ, where the photographs are enlarged smoothly.
    assert scores.miou.value > 0.9
    assert scores.miou.low < scores.miou.value < scores.miou.high


def test_masks_may_have_another_form_of_unicode(folder):
    (folder / "images/part/0.png").rename(folder / "images/part/a\u0308.png")
    (folder / "masks/part/0.png").rename(folder / "masks/part/\u00e4.png")
    scores = nb.evaluate(_by_brightness, folder, classes=CLASSES, size=SIZE)
    assert (scores.photograph_count, scores.missing) == (3, [])


def test_palettes_and_folders_of_voc_are_read_and_photographs_without_a_mask_are_named(folder):
    (folder / "images").rename(folder / "JPEGImages")
    (folder / "masks").rename(folder / "SegmentationClass")
    expected = nb.evaluate(_by_brightness, folder, classes=CLASSES, size=SIZE).by_class
    for path in (folder / "SegmentationClass").rglob("*.png"):
        mask = Image.fromarray(_read(path))
        mask.putpalette([*range(256)] * 3)
        mask.save(path)
    Image.new("RGB", (24, 24)).save(folder / "JPEGImages/extra.png")
    scores = nb.evaluate(_by_brightness, folder, classes=CLASSES, size=SIZE)
    assert scores.by_class == expected
    assert scores.missing == ["extra.png"]


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (Image.new("L", (24, 24), 3), "the value 3: use 0 to 2"),
        (Image.new("RGB", (24, 24)), r"shape \(24, 24, 3\)"),
        (Image.new("L", (24, 48)), r"shape \(48, 24\)"),
    ],
)
def test_a_mask_of_other_classes_or_of_another_size_is_refused(folder, mask, message):
    mask.save(folder / "masks/part/2.png")
    with pytest.raises(InputError, match=message):
        nb.evaluate(_by_brightness, folder, classes=CLASSES, size=SIZE)


@pytest.mark.parametrize(
    ("level", "outcome"), [(0, pytest.raises(InputError, match="255")), (1, nullcontext())]
)
def test_masks_of_255_beside_background_alone_mark_no_object_and_are_refused(
    folder, level, outcome
):
    """A network that finds background alone would have the IoU 1."""
    for path in (folder / "masks").rglob("*.png"):
        Image.fromarray(np.where(_read(path) == 2, 255, level).astype(np.uint8)).save(path)
    with outcome:
        assert nb.evaluate(_by_brightness, folder, classes=CLASSES, size=SIZE).by_class


def test_a_folder_without_masks_is_refused(folder):
    with pytest.raises(InputError, match="lacks images/ or masks/"):
        nb.evaluate(_by_brightness, folder / "images", classes=CLASSES, size=SIZE)
