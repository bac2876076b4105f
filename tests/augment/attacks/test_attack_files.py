"""The files of an attack: its numbers, its figure, and light, shape and normals as they are read back."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

import augment
from augment.attacks.adversary import MAP_HEIGHT
from augment.attacks.attack import AttackResult
from augment.attacks.attack_files import LINES, SIDE, _captions, figure
from augment.attacks.checks import warnings
from renderer.io.meshes import load_mesh
from renderer.io.tiles import GAP, LINE_HEIGHT, MARGIN, TITLE_HEIGHT
from renderer.light.environment import read_map, to_map
from renderer.light.presets import load_light
from renderer.mitsuba_scene import mitsuba_map

CLASSES = ("orange", "lime", "sky", "night")

# ------------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize("margin", [0.0, 0.5, 100.0])
def test_each_example_has_a_line_and_a_last_one_holds_the_checks(
    attacked, by_color, tmp_path, margin
):
    result = attacked(
        "lighting", {"backgrounds": [0.4, 0.6]}, target="lime", max_steps=4, margin=margin
    )
    checks = augment.check(result)
    augment.save(result, tmp_path, checks)
    *lines, last = [json.loads(line) for line in (tmp_path / LINES).read_text().splitlines()]
    assert last == json.loads(json.dumps({"checks": checks, "warnings": warnings(checks)}))
    for example, line in enumerate(lines):
        assert line["example"] == example and line["label"] == ["orange"]
        for name in ("success", "success_before", "steps", "cost", "cost_before"):
            assert line[name] == getattr(result.descent, name)[example].item()
        for suffix, logits in (("_before", result.logits_before), ("", result.logits)):
            probabilities = logits[example].softmax(1)
            assert line[f"predicted{suffix}"] == [CLASSES[probabilities.argmax()]]
            assert line[f"confidence{suffix}"] == [pytest.approx(probabilities.max().item())]
        lead = result.logits[example, 0, 1] - result.logits[example, 0, [0, 2, 3]].max()
        assert (
            line["success_with_margin"]
            is bool(lead >= margin)
            is result.success_with_margin[example].item()
        )
        assert line["clean_correct"] is (line["predicted_before"] == ["orange"])
        change = (result.descent.values[example] - result.problem.start[example]).abs().max().item()
        assert line["largest_change"] == {"lighting": change} and change > 0
        assert set(line["versions"]) == {"float", "8 bits", "JPEG 90", "reload"}
        rounded = (result.images[example] * 255).round() / 255
        predicted = CLASSES[by_color(rounded)[0].argmax()]
        differences = (rounded - result.images[example]).abs()
        assert line["versions"]["8 bits"] == {
            "success": predicted == "lime",
            "success_without_noise": predicted == "lime",
            "predicted": [predicted],
            "confidence": [pytest.approx(by_color(rounded).softmax(1).max().item(), abs=1e-5)],
            "largest_difference": pytest.approx(differences.max().item(), abs=1e-7),
            "mean_difference": pytest.approx(differences.mean().item(), abs=1e-7),
        }
        assert line["versions"]["reload"]["largest_difference"] < 1e-5


# ------------------------------------------------------------------------------------- light and shape


@pytest.mark.parametrize(("light", "positive"), [("st_peters", True), ("grace", False)])
def test_the_light_is_read_back_to_the_bit_and_as_a_map_only_where_it_is_positive(
    attacked, tmp_path, light, positive
):
    """`st_peters` is positive all round and stays so within a small ball; `grace` is negative in places."""
    steps = {"lighting": augment.StepSettings(radius=0.001)}
    result = attacked(steps, {"light": light, "exposure": 2.0}, force=True, max_steps=2)
    (line,) = augment.save(result, tmp_path)
    folder, values = tmp_path / "example_000", result.descent.values[0].unflatten(0, (49, 3))
    assert torch.equal(load_light(str(folder / "light.json")), values)
    assert torch.equal(load_light(str(folder / "light_before.json")), 2 * load_light(light))
    assert (
        (line["negative_light"] < 1e-6)
        == positive
        == (to_map(values, MAP_HEIGHT).min() >= 0).item()
    )
    assert (folder / "light.hdr").is_file() == (folder / "light.exr").is_file() == positive
    in_mitsuba = mitsuba_map(values, MAP_HEIGHT).float().clamp(min=0)
    torch.testing.assert_close(
        read_map(folder / "mitsuba" / "light.exr"), in_mitsuba, rtol=0, atol=0
    )
    if positive:
        rgbe, exact = (read_map(folder / f"light.{suffix}") for suffix in ("hdr", "exr"))
        # A channel has 8 bits of the texel's largest.
        assert ((rgbe - exact).abs() <= exact.amax(2, keepdim=True) / 128).all()


def test_the_shape_is_read_back_where_the_attack_left_it(attacked, tmp_path):
    result = attacked("geometry", max_steps=2)
    augment.save(result, tmp_path)
    mesh, moved = result.problem.scene.mesh(0), result.conditions.vertices[0].double().numpy()
    found = load_mesh(tmp_path / "example_000" / "mesh.glb")
    np.testing.assert_array_equal(found.vertices[found.faces], moved[mesh.faces])


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_the_meshs_file_has_the_normals_that_the_renderer_shades_with(attacked, tmp_path, normals):
    augment.save(attacked("geometry", {"normals": normals}, force=True, max_steps=1), tmp_path)
    (part,) = trimesh.load(tmp_path / "example_000" / "mesh.glb", process=False).geometry.values()
    turns = np.linalg.norm(part.vertex_normals[part.faces] - part.face_normals[:, None], axis=2)
    assert (turns.max() < 1e-4) == (normals == "flat")


# ------------------------------------------------------------------------------------- figure


@pytest.fixture(scope="module")
def result(attacked) -> AttackResult:
    """Two views, which share one light that is not attacked."""
    return attacked("geometry", {"views": 2, "shared": True}, force=True, max_steps=1)


def drawn(result: AttackResult) -> np.ndarray:
    return np.asarray(figure(result, 0))


def random_images(size: int, seed: int) -> torch.Tensor:
    """Values of eight bits, and no pixel as white as the paper."""
    draws = torch.Generator().manual_seed(seed)
    return torch.randint(0, 250, (1, 2, 3, size, size), generator=draws).float() / 255


def found(sheet: np.ndarray, image: torch.Tensor) -> list[tuple[int, int]]:
    """(row, column) of everywhere that an image (3, H, W), enlarged to at least SIDE, stands on the sheet."""
    pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
    scale = -(-SIDE // pixels.shape[1])
    return positions(sheet, pixels.repeat(scale, axis=0).repeat(scale, axis=1))


def positions(sheet: np.ndarray, part: np.ndarray) -> list[tuple[int, int]]:
    """(row, column) of everywhere that a part (H, W, 3) stands on the sheet. Few windows have its diagonal."""
    height, width, _ = part.shape
    corners = sheet[: len(sheet) - height + 1, : sheet.shape[1] - width + 1]
    rows, columns = np.nonzero((corners == part[0, 0]).all(axis=2))
    for at in range(1, min(height, width)):
        same = (sheet[rows + at, columns + at] == part[at, at]).all(axis=1)
        rows, columns = rows[same], columns[same]
    candidates = zip(rows.tolist(), columns.tolist(), strict=True)
    return [
        (y, x) for y, x in candidates if np.array_equal(sheet[y : y + height, x : x + width], part)
    ]


@pytest.mark.parametrize("size", [32, 200])
def test_each_view_has_a_row_and_each_side_a_column_in_which_pixels_stay_as_they_are(result, size):
    before, after = random_images(size, 0), random_images(size, 1)
    sheet, side = (
        drawn(replace(result, images_before=before, images=after)),
        -(-SIDE // size) * size,
    )
    row_height = side + 2 + 2 * LINE_HEIGHT + GAP  # the captions of the differences have two lines
    for column, images in enumerate((before[0], after[0])):
        for view, image in enumerate(images):
            assert found(sheet, image) == [
                (MARGIN + TITLE_HEIGHT + view * row_height, MARGIN + column * (side + GAP))
            ]


def test_the_difference_is_gray_where_there_is_none_and_reaches_white_or_black(result):
    """One view changes by +0.2 in red at one pixel, the other by -0.1: a fifth of the range is the whole of it."""
    before = torch.full((1, 2, 3, 4, 4), 0.5)
    after, expected = before.clone(), torch.full((2, 3, 4, 4), 128.0)
    after[0, 0, 0, 1, 2] += 0.2
    after[0, 1, :, 3, 0] -= 0.1
    after[0, :, 1, 0, 0] += 0.05
    expected[0, 0, 1, 2], expected[1, :, 3, 0], expected[:, 1, 0, 0] = 255, 64, 159
    sheet = drawn(replace(result, images_before=before, images=after))
    assert [column for image in expected for _, column in found(sheet, image / 255)] == [
        MARGIN + 2 * (SIDE + GAP)
    ] * 2


def test_captions_are_the_predicted_class_and_the_right_one_where_it_is_another(result):
    logits = torch.tensor([[[0.123, 0.0004, 0.8766, 1e-6], [0.85, 0.1, 0.05, 1e-6]]]).log()
    assert _captions(result, logits, 0) == [("87.7% sky", "12.3% orange"), ("85.0% orange",)]


def test_the_light_is_shown_where_the_attack_has_changed_it(attacked, result):
    """All of it, a pattern included."""
    column = SIDE + GAP
    sheets = [
        drawn(result),
        drawn(attacked("projector", {"views": 2, "shared": True}, force=True, max_steps=1)),
    ]
    assert sheets[1].shape[1] - sheets[0].shape[1] == 2 * column
    spheres = [sheets[1][:, MARGIN + number * column :][:, :SIDE] for number in (3, 4)]
    assert (spheres[0][100:200] != spheres[1][100:200]).any()
