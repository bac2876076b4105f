"""The files of an attack hold its numbers, its figure, and its light and shape to the bit."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import augment
from augment.attacks.adversary import MAP_HEIGHT
from augment.attacks.files import LINES, SIDE, figure
from augment.attacks.result import AttackResult, warnings
from renderer.io.images import GAP, LINE_HEIGHT, MARGIN, TITLE_HEIGHT
from renderer.light.environment import read_map, to_map
from renderer.light.files import load_light
from renderer.mitsuba_scene import mitsuba_map

CLASSES = ("orange", "lime", "sky", "night")

# --------------------------------------------------------------- numbers


@dataclass
class Saved:
    """A saved attack on two examples, with the target lime."""

    result: AttackResult
    checks: dict
    margin: float
    lines: list[dict]
    """One for each example."""
    last_line: dict


@pytest.fixture(scope="module", params=[0.5, 100.0])
def saved(request, attacked, tmp_path_factory) -> Saved:
    """Save an attack with a margin."""
    scene = {"backgrounds": [0.4, 0.6]}
    options = {"target": "lime", "max_steps": 4, "margin": request.param}
    result = attacked("lighting", scene, **options)
    checks = augment.check(result)
    folder = tmp_path_factory.mktemp("saved")
    augment.save(result, folder, checks)
    *lines, last_line = [json.loads(line) for line in (folder / LINES).read_text().splitlines()]
    assert len(lines) == 2
    return Saved(result, checks, request.param, lines, last_line)


def test_the_last_line_holds_the_checks(saved):
    expected = {"checks": saved.checks, "warnings": warnings(saved.checks)}
    assert saved.last_line == json.loads(json.dumps(expected))


def test_each_example_has_a_line_with_the_numbers_of_its_descent(saved):
    result = saved.result
    for example, line in enumerate(saved.lines):
        assert line["example"] == example
        assert line["label"] == ["orange"]
        for name in ("success", "success_before", "steps", "cost", "cost_before"):
            assert line[name] == getattr(result.minimum, name)[example].item()
        change = result.minimum.values[example] - result.problem.start[example]
        assert line["largest_change"] == {"lighting": change.abs().max().item()}
        assert line["largest_change"]["lighting"] > 0


@pytest.mark.parametrize("parameter", ["lighting", "pixels"])
def test_an_attack_in_bfloat16_is_drawn_and_saved_exactly(attacked, tmp_path, parameter):
    light = load_light("grace").bfloat16()
    result = attacked(parameter, {"light": light}, force=True, max_steps=1)
    assert result.images.dtype == torch.bfloat16
    result.plot()
    augment.save(result, tmp_path)
    saved = np.load(tmp_path / "example_000" / "after.npy")
    assert np.array_equal(saved, result.images_in_views[0].double().numpy())
    augment.reload(tmp_path / "example_000")


def test_no_version_of_an_example_that_was_wrong_before_is_a_success(by_color, tmp_path):
    scene = augment.build_scene([("solid:orange", "sky")], 8)
    settings = augment.AttackSettings(lighting=augment.StepSettings(), max_steps=1)
    result = augment.attack(by_color, scene, settings=settings, force=True)
    [line] = augment.save(result, tmp_path)
    assert line["success_before"]
    for counted in (line, *line["versions"].values()):
        assert counted["predicted"] == ["orange"]
        assert not counted["success"]
        assert not counted["success_without_noise"]


def test_each_line_has_the_predictions_before_and_after(saved):
    for suffix, logits in (("_before", saved.result.logits_before), ("", saved.result.logits)):
        for line, probabilities in zip(saved.lines, logits.softmax(1), strict=True):
            assert line[f"predicted{suffix}"] == [CLASSES[probabilities.argmax()]]
            assert line[f"confidence{suffix}"] == [pytest.approx(probabilities.max().item())]
    for line in saved.lines:
        assert line["clean_correct"] is (line["predicted_before"] == ["orange"])


def test_a_success_with_margin_leads_all_other_classes_by_the_margin(saved):
    for example, line in enumerate(saved.lines):
        logits = saved.result.logits[example]
        lead = logits[1] - logits[[0, 2, 3]].max()
        expected = bool(lead >= saved.margin)
        assert line["success_with_margin"] is expected
        assert saved.result.success_with_margin[example].item() is expected


def test_each_line_tells_how_the_image_of_8_bits_is_classified(saved, by_color):
    for images, line in zip(saved.result.images_in_views, saved.lines, strict=True):
        rounded = (images * 255).round() / 255
        probabilities = by_color(rounded).softmax(1)[0]
        predicted = CLASSES[probabilities.argmax()]
        differences = (rounded - images).abs()
        assert line["versions"]["8 bits"] == {
            "success": predicted == "lime",
            "success_without_noise": predicted == "lime",
            "predicted": [predicted],
            "confidence": [pytest.approx(probabilities.max().item(), abs=1e-5)],
            "largest_difference": pytest.approx(differences.max().item(), abs=1e-7),
            "mean_difference": pytest.approx(differences.mean().item(), abs=1e-7),
        }


def test_each_line_has_the_usual_versions_of_the_image(saved):
    for line in saved.lines:
        assert set(line["versions"]) == {"float", "8 bits", "JPEG 90", "reload"}
        assert line["versions"]["reload"]["largest_difference"] < 1e-5


# --------------------------------------------------------------- light and shape


@dataclass
class SavedLight:
    """The folder of an attack on light, its final coefficients (49, 3), and its line."""

    folder: Path
    light: torch.Tensor
    line: dict
    name: str


@pytest.fixture(scope="module")
def save_light_of(attacked, tmp_path_factory):
    """Return a function that attacks a named light within a small ball."""

    def save(name: str) -> SavedLight:
        steps = {"lighting": augment.StepSettings(radius=0.001)}
        scene = {"light": name, "exposure": 2.0}
        result = attacked(steps, scene, force=True, max_steps=2)
        folder = tmp_path_factory.mktemp(name)
        (line,) = augment.save(result, folder)
        light = result.minimum.values[0].unflatten(0, (49, 3))
        return SavedLight(folder / "example_000", light, line, name)

    return save


@pytest.fixture(scope="module")
def positive_light(save_light_of) -> SavedLight:
    """Return an attack on a light that is positive all round."""
    return save_light_of("st_peters")


@pytest.fixture(scope="module")
def negative_light(save_light_of) -> SavedLight:
    """Return an attack on a light that is negative in places."""
    return save_light_of("grace")


@pytest.mark.parametrize("kind", ["positive_light", "negative_light"])
def test_the_light_is_read_back_to_the_bit(request, kind):
    saved = request.getfixturevalue(kind)
    assert torch.equal(load_light(str(saved.folder / "light.json")), saved.light)
    before = load_light(str(saved.folder / "light_before.json"))
    assert torch.equal(before, 2 * load_light(saved.name))


@pytest.mark.parametrize("kind", ["positive_light", "negative_light"])
def test_the_light_of_mitsubas_scene_is_clipped_at_zero(request, kind):
    saved = request.getfixturevalue(kind)
    expected = mitsuba_map(saved.light, MAP_HEIGHT).float().clamp(min=0)
    assert torch.equal(read_map(saved.folder / "mitsuba" / "light.exr"), expected)


def test_positive_light_is_written_as_maps(positive_light):
    assert to_map(positive_light.light, MAP_HEIGHT).min() >= 0
    assert positive_light.line["negative_light"] < 1e-6
    rgbe = read_map(positive_light.folder / "light.hdr")
    exact = read_map(positive_light.folder / "light.exr")
    # A channel has 8 bits of the texel's largest channel.
    assert ((rgbe - exact).abs() <= exact.amax(2, keepdim=True) / 128).all()


def test_negative_light_is_told_and_not_written_as_a_map(negative_light):
    assert to_map(negative_light.light, MAP_HEIGHT).min() < 0
    assert negative_light.line["negative_light"] > 1e-6
    for suffix in ("hdr", "exr"):
        assert not (negative_light.folder / f"light.{suffix}").exists()


# --------------------------------------------------------------- figure

SHARED = {"views": 2, "shared": True}
COLUMN_WIDTH = SIDE + GAP


@pytest.fixture(scope="module")
def result(attacked) -> AttackResult:
    """Return an attack on the shape in two views, which share one light."""
    return attacked("geometry", SHARED, force=True, max_steps=1)


def sheet_of(result: AttackResult) -> np.ndarray:
    """Draw the figure (H, W, 3) of the only example."""
    return np.asarray(figure(result, 0))


def random_images(size: int, seed: int) -> torch.Tensor:
    """Return images of 8 bits, in which no pixel is as white as the paper."""
    draws = torch.Generator().manual_seed(seed)
    return torch.randint(0, 250, (1, 2, 3, size, size), generator=draws).float() / 255


def places_of(sheet: np.ndarray, image: torch.Tensor) -> list[tuple[int, int]]:
    """Return the (row, column) of every place of the sheet that shows an image (3, H, W).

    Images that are smaller than SIDE are enlarged by a whole number.
    """
    pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
    scale = math.ceil(SIDE / pixels.shape[1])
    part = pixels.repeat(scale, axis=0).repeat(scale, axis=1)
    height, width, _ = part.shape
    last_row = len(sheet) - height
    last_column = sheet.shape[1] - width
    is_corner = (sheet[: last_row + 1, : last_column + 1] == part[0, 0]).all(axis=2)
    rows, columns = np.nonzero(is_corner)
    # The diagonal leaves few candidates.
    for step in range(1, min(height, width)):
        is_same = (sheet[rows + step, columns + step] == part[step, step]).all(axis=1)
        rows = rows[is_same]
        columns = columns[is_same]
    places = []
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        window = sheet[row : row + height, column : column + width]
        if np.array_equal(window, part):
            places.append((row, column))
    return places


@pytest.mark.parametrize("size", [32, 200])
def test_each_view_has_a_row_and_each_side_a_column_in_which_pixels_stay_as_they_are(result, size):
    before = random_images(size, 0)
    after = random_images(size, 1)
    sheet = sheet_of(replace(result, images_in_views_before=before, images_in_views=after))
    side = math.ceil(SIDE / size) * size
    # The captions of the differences have two lines.
    row_height = side + 2 + 2 * LINE_HEIGHT + GAP
    for column, images in enumerate((before[0], after[0])):
        for view, image in enumerate(images):
            top = MARGIN + TITLE_HEIGHT + view * row_height
            left = MARGIN + column * (side + GAP)
            assert places_of(sheet, image) == [(top, left)]


def test_the_difference_is_gray_where_there_is_none_and_reaches_white_or_black(result):
    """The largest change of all views, 0.2, is shown as half of the range."""
    before = torch.full((1, 2, 3, 4, 4), 0.5)
    after = before.clone()
    after[0, 0, 0, 1, 2] += 0.2
    after[0, 1, :, 3, 0] -= 0.1
    after[0, :, 1, 0, 0] += 0.05
    expected = torch.full((2, 3, 4, 4), 128.0)
    expected[0, 0, 1, 2] = 255
    expected[1, :, 3, 0] = 64
    expected[:, 1, 0, 0] = 159
    sheet = sheet_of(replace(result, images_in_views_before=before, images_in_views=after))
    for image in expected / 255:
        [(_, column)] = places_of(sheet, image)
        assert column == MARGIN + 2 * COLUMN_WIDTH


def test_the_light_is_shown_if_the_attack_has_changed_it(attacked, result):
    """The pattern of a projector is a part of the light."""
    without_light = sheet_of(result)
    with_light = sheet_of(attacked("projector", SHARED, force=True, max_steps=1))
    assert with_light.shape[1] - without_light.shape[1] == 2 * COLUMN_WIDTH
    lefts = [MARGIN + column * COLUMN_WIDTH for column in (3, 4)]
    before, after = (with_light[100:200, left : left + SIDE] for left in lefts)
    assert (before != after).any()
