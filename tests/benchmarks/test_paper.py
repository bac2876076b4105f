import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from augment import Classifier, Scene, attack
from augment.attacks.problem import build_problem
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from benchmarks.paper import (
    common,
    light_change,
    norm_balls,
    rendering_quality,
    run_time,
    table,
    transfer,
)
from renderer import orbit_cameras
from renderer.mesh import Mesh

RECORDS = Path(__file__).parents[2] / "docs" / "paper"
PNG_SIGNATURE = b"\x89PNG"
# Pixels per side of the images.
SIZE = 12
BALL = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
SUBJECT = SceneObject("orange", Mesh.plain(BALL.vertices, BALL.faces, (0.5, 0.4, 0.3)), name="ball")


def classify_by_brightness(gray=0.2, name="source", rows=slice(4, 8)) -> Classifier:
    """Make a classifier that predicts an orange if a square of an image is brighter than `gray`."""

    def logits(images: Tensor) -> Tensor:
        brightness = images[:, :, rows, rows].mean((1, 2, 3))
        evidence = 20 * (brightness - gray)
        return torch.stack([evidence, -evidence], dim=1)

    return Classifier(logits, SIZE, ("orange", "coal"), name)


def make_scene(view_count: int) -> Scene:
    views = [common.View(camera, 0.5) for camera in orbit_cameras(view_count, 3.0)]
    return common.make_scene(SUBJECT, SIZE, views)


@pytest.fixture
def small(monkeypatch, tmp_path) -> list[str]:
    """Return the arguments of a script that renders a small mesh and attacks a small network.

    The records are in the file records.jsonl.
    """
    BALL.export(tmp_path / "ball.ply")
    monkeypatch.setattr(common, "VERTICES", 0)
    monkeypatch.setattr(torch, "set_num_threads", lambda threads: None)
    monkeypatch.setattr(
        common, "load_network", lambda name, weights: classify_by_brightness(0.1, name)
    )
    return ["--out", str(tmp_path / "records.jsonl"), "--meshes", str(tmp_path / "ball.ply")]


SHORT = ["--examples", "2", "--steps", "2"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "arguments", "row_count", "column_count"),
    [
        (norm_balls, [*SHORT, "--spaces", "lighting", "geometry"], 11, 6),
        (transfer, ["networks", *SHORT, "--targets", "another"], 4, 6),
        (transfer, ["views", *SHORT, "--sets", "2"], 4, 5),
        (run_time, SHORT, 1, 3),
        (rendering_quality, ["--renders", "20"], 2, 5),
    ],
    ids=["norm_balls", "networks", "views", "run_time", "rendering_quality"],
)
def test_a_script_appends_records_whose_table_has_all_rows(
    small, tmp_path, capsys, script, arguments, row_count, column_count
):
    script.main([*arguments, *small])
    table.main([str(tmp_path / "records.jsonl")])
    header, line, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == row_count
    assert {row.count(" | ") for row in (header, line, *rows)} == {column_count - 1}


def test_the_change_of_light_is_a_mean_over_the_renders_that_are_attacked(tmp_path):
    # Renders that are misclassified before the attack count as successes, with 0 change and steps.
    names = ("attack_success_before", "attack_success", "light_change", "steps")
    values = [(1.0, 1.0, 0.0, 0.0), (0.25, 1.0, 0.3, 6.0), (0.0, 0.5, 0.4, 9.0)]
    lines = [{"test/accuracy": 0.5}]
    for epoch, row in enumerate(values, 1):
        logged = {f"augment/{name}": value for name, value in zip(names, row, strict=True)}
        lines.insert(-1, {"epoch": epoch} | logged)
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "metrics.jsonl").write_text(text)

    light_change.main([str(tmp_path), "--out", str(tmp_path / "figure.png")])

    assert (tmp_path / "figure.png").read_bytes().startswith(PNG_SIGNATURE)
    header, *rows = (tmp_path / "figure.csv").read_text().splitlines()
    assert header == "epoch,clean_correct,light_change,steps,success"
    assert rows == ["2,0.75,0.4,8,1", "3,1,0.4,9,0.5"]


@pytest.mark.parametrize(("fraction_of_radius", "success"), [(0.9, True), (1.1, False)])
def test_a_pixel_attack_lowers_means_by_its_radius_unlike_random_draws(fraction_of_radius, success):
    radius = 0.02
    scene = make_scene(1)
    image = common.render_all(scene)
    # The sign step lowers each value by the radius, because none is clamped.
    assert radius < image.min()
    assert image.max() < 1 - radius
    gray = float(image.mean()) - fraction_of_radius * radius
    classifier = classify_by_brightness(gray, rows=slice(None))
    attacked = attack(classifier, scene, settings=norm_balls.make_settings("pixels", radius, 3))
    results = norm_balls.search_ball(attacked, "pixels", radius, generator(0, "test"))
    assert results["adversarial"].item() == success
    # The mean of 432 draws has a standard deviation of radius / √(3 · 432), a
    # 36th of the radius.
    assert not results["search"].item()


def test_light_without_its_negative_radiance_is_the_same_where_there_is_none():
    sky = torch.zeros(49, 3)
    sky[0] = 1.0
    clipped = norm_balls.without_negative_radiance(sky)
    # The tolerance is that of a quadrature in float32.
    torch.testing.assert_close(clipped, sky, rtol=0, atol=1e-5)
    assert norm_balls.without_negative_radiance(-sky).abs().max() == 0


@pytest.mark.parametrize("kind", common.STEPS)
def test_views_that_share_a_light_or_shape_have_the_sum_of_their_gradients(kind):
    problem = build_problem(common.attack_settings(kind), make_scene(3))
    shared_problem = transfer.SharedProblem(problem)
    shared_values = shared_problem.start.clone().requires_grad_()
    values = problem.start.clone().requires_grad_()
    views = shared_problem.render(shared_values, torch.tensor([0]))
    images = problem.render(values, problem.all_examples)
    assert torch.equal(views[0], images[:, 0])
    views.square().sum().backward()
    images.square().sum().backward()
    largest = float(values.grad.abs().amax())
    assert largest > 0
    # The gradients of three views are summed in another order in float32.
    torch.testing.assert_close(
        shared_values.grad[0], values.grad.sum(0), rtol=1e-5, atol=1e-5 * largest
    )


def test_the_bootstrap_resamples_cameras_and_not_renders():
    # All five renders of a camera are correct, or none is. The 200 cameras then
    # have 200 outcomes, with a standard error of √(0.25 / 200).
    confidences = np.full((200, 5), 0.9)
    confidences[::2] = math.nan
    row = rendering_quality.summarize(confidences, seed=0)
    value, low, high = row["clean-correct"]
    assert value == 0.5
    standard_error = math.sqrt(0.25 / 200)
    # The quantile of 1000 resamples at 2.5% is within about a tenth of the half
    # width.
    assert (high - low) / 2 == pytest.approx(1.96 * standard_error, rel=0.15)


# The cells are those of docs/results.md.
@pytest.mark.parametrize(
    ("name", "cells"),
    [
        ("norm_balls", ["89 % [81, 94] of 100", "97 % [92, 99] of 100"]),
        ("physical_light", ["32 % [20, 48] of 40"]),
        ("transfer", ["15 % [9, 24] of 91", "62 % [48, 75] of 48"]),
        ("unseen_views", ["27 % [21, 35] of 2 × 10"]),
        ("survival", ["72 % [49, 88] of 18"]),
        ("rendering_quality", ["0.924 [0.918, 0.931]"]),
        ("run_time", ["5 steps, 0.33 s; 90 % within 0.83 s", "88 % [74, 95] of 40"]),
    ],
)
def test_the_recorded_runs_print_the_published_numbers(capsys, name, cells):
    table.main([str(RECORDS / f"{name}.jsonl")])
    printed = capsys.readouterr().out
    missing = [cell for cell in cells if f"| {cell} " not in printed]
    assert missing == []
