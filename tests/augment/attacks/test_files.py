"""The files of an attack hold its numbers, its figure, and its light and shape to the bit."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import augment
from augment.attacks import adversary
from augment.attacks.files import LINES, SIDE, figure
from augment.attacks.result import AttackResult, warnings
from renderer.io.images import GAP, LINE_HEIGHT, MARGIN, TITLE_HEIGHT
from renderer.light.environment import read_map, to_map
from renderer.light.files import load_light
from renderer.light.skylight import coefficients as sky_coefficients
from renderer.mitsuba_scene import mitsuba_map

CLASSES = ("orange", "lime", "sky", "night")


def test_the_lines_of_an_attack_on_the_sky_tell_its_sun(attacked, tmp_path):
    result = attacked("skylight", {}, target="lime", max_steps=3, margin=100.0)
    augment.save(result, tmp_path)
    (line, *_) = [json.loads(line) for line in (tmp_path / LINES).read_text().splitlines()]
    # The scene multiplies the sky by a factor.
    sky = sky_coefficients(**line["sky"]).numpy()
    shown = json.loads((tmp_path / "example_000" / "light.json").read_text())["coefficients"]
    scale = np.linalg.norm(shown) / np.linalg.norm(sky)
    assert np.abs(scale * sky - shown).max() < 1e-5


@pytest.mark.parametrize("margin", [0.5, 100.0])
def test_the_lines_of_an_attack_have_its_numbers_and_checks(attacked, by_color, tmp_path, margin):
    scene = {"backgrounds": [0.4, 0.6]}
    result = attacked("lighting", scene, target="lime", max_steps=4, margin=margin)
    checks = augment.check(result)
    augment.save(result, tmp_path, checks)
    *lines, last_line = [json.loads(line) for line in (tmp_path / LINES).read_text().splitlines()]
    assert last_line == json.loads(json.dumps({"checks": checks, "warnings": warnings(checks)}))
    assert [line["example"] for line in lines] == [0, 1]
    for example, line in enumerate(lines):
        assert line["label"] == ["orange"]
        for name in ("success", "success_before", "steps", "cost", "cost_before"):
            assert line[name] == getattr(result.minimum, name)[example].item()
        change = result.minimum.values[example] - result.problem.start[example]
        assert line["largest_change"] == {"lighting": change.abs().max().item()}
        assert line["largest_change"]["lighting"] > 0
        for suffix, logits in (("_before", result.logits_before), ("", result.logits)):
            probabilities = logits[example].softmax(0)
            assert line[f"predicted{suffix}"] == [CLASSES[probabilities.argmax()]]
            assert line[f"confidence{suffix}"] == [pytest.approx(probabilities.max().item())]
        assert line["clean_correct"] is (line["predicted_before"] == ["orange"])
        # A success with margin leads all other classes by the margin.
        lead = result.logits[example, 1] - result.logits[example, [0, 2, 3]].max()
        assert line["success_with_margin"] is bool(lead >= margin)
        assert result.success_with_margin[example].item() is bool(lead >= margin)
        assert set(line["versions"]) == {"float", "8 bits", "JPEG 90", "reload"}
        assert line["versions"]["reload"]["largest_difference"] < 1e-5
        images = result.images_in_views[example]
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


def test_an_attack_in_bfloat16_is_drawn_and_saved_exactly(attacked, tmp_path):
    light = load_light("grace").bfloat16()
    result = attacked("lighting+pixels", {"light": light}, force=True, max_steps=1)
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


@pytest.fixture(scope="module", params=["st_peters", "grace"])
def saved_light(request, attacked, tmp_path_factory) -> tuple[str, Path, torch.Tensor, dict]:
    """Attack St. Peter's, which is positive all round, and Grace, which is not, in a small ball."""
    steps = {"lighting": augment.StepSettings(radius=0.001)}
    scene = {"light": request.param, "exposure": 2.0}
    result = attacked(steps, scene, force=True, max_steps=2)
    folder = tmp_path_factory.mktemp(request.param)
    (line,) = augment.save(result, folder)
    light = result.minimum.values[0].unflatten(0, (49, 3))
    return request.param, folder / "example_000", light, line


def test_the_light_is_read_back_to_the_bit(saved_light):
    name, folder, light, _ = saved_light
    assert torch.equal(load_light(str(folder / "light.json")), light)
    assert torch.equal(load_light(str(folder / "light_before.json")), 2 * load_light(name))


def test_negative_light_is_told_clipped_for_mitsuba_and_not_written_as_a_map(saved_light):
    name, folder, light, line = saved_light
    is_negative = name == "grace"
    assert bool(to_map(light, adversary.MAP_HEIGHT).min() < 0) == is_negative
    assert (line["negative_light"] > 1e-6) == is_negative
    expected = mitsuba_map(light, adversary.MAP_HEIGHT).float().clamp(min=0)
    assert torch.equal(read_map(folder / "mitsuba" / "light.exr"), expected)
    if is_negative:
        assert not list(folder.glob("light.hdr")) + list(folder.glob("light.exr"))
        return
    exact = read_map(folder / "light.exr")
    error = (read_map(folder / "light.hdr") - exact).abs()
    # A channel has 8 bits of the texel's largest channel.
    assert (error <= exact.amax(2, keepdim=True) / 128).all()


SHARED = {"views": 2, "shared": True}


@pytest.fixture(scope="module")
def result(attacked) -> AttackResult:
    return attacked("geometry", SHARED, force=True, max_steps=1)


def sheet_of(result: AttackResult) -> np.ndarray:
    return np.asarray(figure(result, 0))


def shown(sheet: np.ndarray, view: int, column: int, size: int, lines: int) -> torch.Tensor:
    scale = math.ceil(SIDE / size)
    top = MARGIN + TITLE_HEIGHT + view * (scale * size + 2 + lines * LINE_HEIGHT + GAP)
    left = MARGIN + column * (scale * size + GAP)
    tile = sheet[top : top + scale * size, left : left + scale * size]
    pixels = tile[::scale, ::scale]
    assert np.array_equal(pixels.repeat(scale, axis=0).repeat(scale, axis=1), tile)
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1)


@pytest.mark.parametrize("size", [32, 200])
def test_each_view_has_a_row_and_each_side_a_column_in_which_pixels_stay_as_they_are(result, size):
    draws = torch.Generator().manual_seed(0)
    before, after = torch.randint(0, 250, (2, 1, 2, 3, size, size), generator=draws).float() / 255
    sheet = sheet_of(replace(result, images_in_views_before=before, images_in_views=after))
    for column, images in enumerate((before[0], after[0])):
        for view, image in enumerate(images):
            # The captions of the differences have two lines.
            assert torch.equal(shown(sheet, view, column, size, 2).float() / 255, image)


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
    for view in range(2):
        assert torch.equal(shown(sheet, view, 2, 4, 2).float(), expected[view])
