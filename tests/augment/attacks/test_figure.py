from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw, ImageFont

from augment.attacks.figure import SIDE, Panel, prediction_caption, save_figure
from renderer.io.tiles import CAPTION_SIZE, FAINT, GAP, INK, LINE_HEIGHT, MARGIN, TITLE_HEIGHT

PAPER = 255


def random_images(views: int, size: int, seed: int) -> torch.Tensor:
    """Values of eight bits, and no pixel as white as the paper."""
    draws = torch.Generator().manual_seed(seed)
    return torch.randint(0, 250, (views, 3, size, size), generator=draws).float() / 255


def panel(views: int = 2, size: int = 32, seed: int = 0, caption: tuple[str, ...] = ("orange",), **more) -> Panel:
    return Panel(random_images(views, size, seed), [caption] * views, **more)


def draw(path: Path, *panels: Panel) -> np.ndarray:
    save_figure(*panels, path)
    with Image.open(path) as sheet:
        return np.asarray(sheet)


def place(sheet: np.ndarray, image: torch.Tensor) -> list[tuple[int, int]]:
    """(row, column) of everywhere that an image (3, H, W), enlarged to at least SIDE, stands on the sheet."""
    pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
    scale = -(-SIDE // pixels.shape[1])
    pixels = pixels.repeat(scale, axis=0).repeat(scale, axis=1)
    height, width = pixels.shape[:2]
    starts = np.argwhere((sheet[: 1 - height or None, : 1 - width or None] == pixels[0, 0]).all(axis=2))
    return [(y, x) for y, x in starts.tolist() if np.array_equal(sheet[y : y + height, x : x + width], pixels)]


@pytest.mark.parametrize(("views", "size"), [(1, 32), (3, 32), (2, 200), (2, 224)])
def test_each_view_has_a_row_and_each_side_a_column_in_which_pixels_stay_as_they_are(tmp_path, views, size):
    before, after = panel(views, size, 0), panel(views, size, 1)
    sheet = draw(tmp_path / "report.png", before, after)
    side = -(-SIDE // size) * size
    row_height = side + 2 + 2 * LINE_HEIGHT + GAP  # the captions of the differences have two lines
    for column, shown in enumerate((before, after)):
        for view, image in enumerate(shown.images):
            top, left = MARGIN + TITLE_HEIGHT + view * row_height, MARGIN + column * (side + GAP)
            assert place(sheet, image) == [(top, left)]


def test_the_difference_is_gray_where_there_is_none_and_reaches_white_or_black(tmp_path):
    """One view changes by +0.2 in red at one pixel, the other by -0.1: a fifth of the range is the whole of it."""
    before = torch.full((2, 3, 4, 4), 0.5)
    after = before.clone()
    after[0, 0, 1, 2] += 0.2
    after[1, :, 3, 0] -= 0.1
    after[:, 1, 0, 0] += 0.05
    sheet = draw(tmp_path / "report.png", *(Panel(images, [()] * 2) for images in (before, after)))
    expected = torch.full((2, 3, 4, 4), 128.0)
    expected[0, 0, 1, 2] = 255
    expected[1, :, 3, 0] = 64
    expected[:, 1, 0, 0] = 159
    places = [place(sheet, image / 255) for image in expected]
    assert [len(found) for found in places] == [1, 1]
    assert places[0][0][1] == places[1][0][1] == MARGIN + 2 * (SIDE + GAP)


def test_without_a_difference_all_of_it_is_gray(tmp_path):
    shown = panel(1)
    sheet = draw(tmp_path / "report.png", shown, shown)
    assert len(place(sheet, torch.full((3, 32, 32), 128 / 255))) == 1


def test_the_light_of_either_side_is_shown_where_it_is_given(tmp_path):
    spheres = [random_images(2, 48, seed) for seed in (2, 3)]
    both = draw(tmp_path / "both.png", panel(seed=0, spheres=spheres[0]), panel(seed=1, spheres=spheres[1]))
    column = SIDE + GAP
    for number, sphere in enumerate(spheres, start=3):
        for image in sphere:
            [(_, left)] = place(both, image)
            assert left == MARGIN + number * column
    one = draw(tmp_path / "one.png", panel(seed=0), panel(seed=1, spheres=spheres[1]))
    none = draw(tmp_path / "none.png", panel(seed=0), panel(seed=1))
    assert both.shape[1] - one.shape[1] == one.shape[1] - none.shape[1] == column


def written(text: str, color: str) -> np.ndarray:
    """The text as Pillow draws it on a sheet of its own, cropped to its ink."""
    sheet = Image.new("RGB", (900, 40), "white")
    ImageDraw.Draw(sheet).text((10, 10), text, color, ImageFont.load_default(CAPTION_SIZE))
    pixels = np.asarray(sheet)
    rows, columns = np.nonzero((pixels != PAPER).any(axis=2))
    return pixels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def contains(sheet: np.ndarray, part: np.ndarray) -> bool:
    windows = np.lib.stride_tricks.sliding_window_view(sheet, part.shape)[..., 0, :, :, :]
    return bool((windows == part).all(axis=(-3, -2, -1)).any())


def test_captions_stand_below_their_images_uncut_however_long(tmp_path):
    long = "97.0% a jumpy quagga, grazing beside a long paddock's edge"
    sheet = draw(tmp_path / "report.png", panel(1, caption=("orange", "by jug")), panel(1, seed=1, caption=(long,)))
    below = sheet[MARGIN + TITLE_HEIGHT + SIDE :]
    for text, color in (("orange", INK), ("by jug", FAINT), (long, INK)):
        assert contains(below, written(text, color))
    edges = [sheet[:MARGIN], sheet[-MARGIN:], sheet[:, :MARGIN], sheet[:, -MARGIN:]]
    assert all((edge == PAPER).all() for edge in edges)


def test_the_largest_differences_are_told_in_numbers(tmp_path):
    before = torch.full((1, 3, 4, 4), 0.5)
    sheet = draw(tmp_path / "report.png", *(Panel(shown, [()]) for shown in (before, before + 0.125)))
    assert contains(sheet[-3 * MARGIN :], written("largest 0.125", INK))
    assert contains(sheet[-3 * MARGIN :], written("shown 8 times", FAINT))


@pytest.mark.parametrize(
    ("probabilities", "label", "caption"),
    [
        ((0.1, 0.85, 0.05), "pear", ("85.0% pear",)),
        ((0.123, 0.0004, 0.8766), "pear", ("87.7% plum", "0.0% pear")),
        ((0.5, 0.2, 0.3), "plum", ("50.0% fig", "30.0% plum")),
        ((0.2, 0.1, 0.3, 0.4), "pear", ("40.0% fig", "10.0% pear")),  # ImageNet has two classes called crane
    ],
)
def test_an_answer_is_told_with_its_confidence_and_the_true_classs_where_it_is_wrong(probabilities, label, caption):
    assert prediction_caption(torch.tensor(probabilities), ["fig", "pear", "plum", "fig"], label) == caption


def test_views_without_a_caption_of_their_own_are_refused(tmp_path):
    with pytest.raises(ValueError):
        save_figure(Panel(random_images(2, 8, 0), [()]), panel(2, 8), tmp_path / "report.png")
    assert not list(tmp_path.iterdir())
