"""The paper's benchmarks, at a tiny size."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from augment import Classifier, attack
from augment.attacks.problem import build_problem
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from benchmarks.paper import common, light_change, norm_balls, rendering_quality, run_time, survival, table, transfer
from renderer import orbit_cameras
from renderer.geometry.mesh import Mesh

RECORDS = Path(__file__).parents[2] / "docs" / "paper"
SIZE = 12
BALL = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
SUBJECT = SceneObject("orange", Mesh.plain(BALL.vertices, BALL.faces, (0.5, 0.4, 0.3)), name="ball")


def by_brightness(gray: float = 0.2, name: str = "source", area: slice = slice(4, 8)) -> Classifier:
    """Predicts an orange where the middle of an image, or another area, is brighter than a gray."""

    def logits(images):
        bright = 20 * (images[:, :, area, area].mean((1, 2, 3)) - gray)
        return torch.stack([bright, -bright], dim=1)

    return Classifier(logits, SIZE, ("orange", "coal"), name)


def a_scene(count: int = 3):
    return common.scene_of(SUBJECT, SIZE, [(camera, 0.5) for camera in orbit_cameras(count, 3.0)])


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A small mesh and network in place of those that are named, and the file of a run's records."""
    BALL.export(tmp_path / "ball.ply")
    monkeypatch.setattr(common, "VERTICES", 0)
    monkeypatch.setattr(torch, "set_num_threads", lambda threads: None)
    for module in (common, transfer):
        monkeypatch.setattr(module, "load_network", lambda name, weights=None: by_brightness(0.1, name))
    return ["--out", str(tmp_path / "records.jsonl"), "--meshes", str(tmp_path / "ball.ply")]


SHORT = ["--examples", "2", "--steps", "2"]


@pytest.mark.parametrize(
    ("script", "arguments", "rows", "columns"),
    [
        (norm_balls, [*SHORT, "--spaces", "lighting", "geometry"], 11, 6),
        (transfer, ["networks", *SHORT, "--targets", "another"], 4, 6),
        (transfer, ["views", *SHORT, "--sets", "2"], 4, 5),
        (run_time, SHORT, 1, 3),
        (rendering_quality, ["--renders", "20"], 2, 5),
    ],
    ids=["norm_balls", "networks", "views", "run_time", "rendering_quality"],
)
def test_a_script_appends_records_whose_table_has_all_rows(small, tmp_path, capsys, script, arguments, rows, columns):
    script.main([*arguments, *small])
    figure = tmp_path / "figure.png"
    drawn = ["--figure", str(figure)] if script is norm_balls else []
    table.main([str(tmp_path / "records.jsonl"), *drawn])
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == rows + 2 and {line.count(" | ") for line in lines} == {columns - 1}
    assert not drawn or figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow  # two processes that import everything
def test_adversaries_are_found_and_rendered_again_by_the_attack_script(tmp_path, capsys):
    out = tmp_path / "records.jsonl"
    small = ["--attacks", "lighting", "--examples", "1", "--classifier", "run:pretrained/none"]
    short = ["attack.max_steps=1", "scene.search=0", "renderer.shadows=false"]
    short += ["attack.verify=reload"]  # without Mitsuba
    meshes = ["solid:orange:0", "{mesh: 'solid:orange:0', label: lamp}"]  # which is not predicted to be a lamp
    survival.main(["--out", str(out), *small, "--meshes", *meshes, "--overrides", *short])
    orange, lamp = common.last_run(out)[1]
    assert set(orange["versions"]) == {"float", "8 bits", "JPEG 90", "reload"} and "refusal" not in orange
    assert orange["versions"]["reload"]["largest_difference"] <= 1 / 255
    assert lamp["refusal"].startswith("error: ") and "versions" not in lamp
    table.main([str(out)])
    assert capsys.readouterr().out.splitlines()[2].split()[:4] == ["|", "lighting", "|", "1"]


def test_the_change_of_light_is_drawn_over_the_epochs_that_have_attacks(tmp_path):
    first, last = ({"epoch": n, **{f"augment/{name}": n / 2 for name in light_change.MEASURES}} for n in (1, 2))
    lines = "".join(json.dumps(line) + "\n" for line in (first, last, {"test/accuracy": 0.5}))
    (tmp_path / "metrics.jsonl").write_text(lines)
    light_change.main([str(tmp_path), "--out", str(tmp_path / "figure.png")])
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "figure.csv").read_text().splitlines()[1:] == ["1,0.5,0.5,0.5", "2,1.0,1.0,1.0"]


@pytest.mark.parametrize(("excess", "success"), [(0.9, True), (1.1, False)])
def test_a_pixel_attack_lowers_a_mean_by_its_radius_and_random_draws_do_not(excess, success):
    """All values lie further than the radius from 0 and 1, so that the sign step takes it off each of them."""
    radius, scene = 0.02, a_scene(1)
    start = common.images_of(scene)
    assert radius < start.min() and start.max() < 1 - radius
    verge = by_brightness(float(start.mean()) - excess * radius, area=slice(None))
    attacked = attack(verge, scene, settings=norm_balls.settings_of("pixels", radius, 3))
    results = norm_balls.ball(attacked, "pixels", radius, generator(0, "test"))
    assert results["adversarial"].item() == success
    assert not results["search"].item()  # the mean of 432 draws is off by radius / √(3 · 432), a 30th of the radius


def test_light_without_its_negative_radiance_is_the_same_where_there_is_none():
    sky = torch.zeros(49, 3)
    sky[0] = 1.0
    torch.testing.assert_close(norm_balls.without_negative(sky), sky, rtol=0, atol=1e-5)  # of a quadrature in float32
    assert norm_balls.without_negative(-sky).abs().max() == 0


@pytest.mark.parametrize("kind", common.STEPS)
def test_views_that_share_a_light_or_shape_have_the_sum_of_their_gradients(kind):
    problem = build_problem(common.attack_settings(kind), a_scene())
    shared = transfer.as_one_example(problem)
    together, apart = shared.start.clone().requires_grad_(), problem.start.clone().requires_grad_()
    views, images = shared.render(together, torch.tensor([0])), problem.render(apart, problem.everything)
    assert torch.equal(views[0], images[:, 0])
    views.square().sum().backward()
    images.square().sum().backward()
    largest = float(apart.grad.abs().amax())
    assert largest > 0
    # Float32 sums of three views in another order.
    torch.testing.assert_close(together.grad[0], apart.grad.sum(0), rtol=1e-5, atol=1e-5 * largest)


def test_the_bootstrap_resamples_cameras_and_not_renders():
    """All renders of a camera agree, so 200 cameras carry 200 outcomes: a standard error of √(0.25 / 200) = 0.035."""
    views = np.array([[0.9 if index % 2 else math.nan] * 5 for index in range(200)])
    value, low, high = rendering_quality.summary(views, seed=0)["clean-correct"]
    assert value == 0.5
    # 1000 resamples give a quantile at 2.5 % within about a tenth of the half width.
    assert (high - low) / 2 == pytest.approx(1.96 * 0.0354, rel=0.15)


def test_only_what_deceives_the_attacked_network_and_was_clean_correct_counts():
    source = {"before": ["orange"] * 4, "first": ["coal", "coal", "coal", "orange"], "first_random": ["orange"] * 4}
    target = {
        "before": ["orange", "orange", "coal", "orange"],
        "first": ["coal", "orange", "coal", "coal"],
        "first_random": ["orange", "coal", "coal", "coal"],
    }
    rows = [{"label": "orange", "predictions": {"source": source, "target": target}}]
    assert [*table.transferred(rows, "target", "first")] == [True, False]
    assert [*table.transferred(rows, "target", "first_random")] == [False, True]
    assert [*table.transferred(rows, "source", "first")] == [True, True, True, False]
    assert [*table.transferred(rows, "source", "first_random")] == [False] * 4


@pytest.mark.parametrize(
    ("name", "cells"),
    [  # of docs/results.md
        ("norm_balls", ["89 % [81, 94] of 100", "97 % [92, 99] of 100"]),
        ("physical_light", ["32 % [20, 48] of 40"]),
        ("transfer", ["15 % [9, 24] of 91", "62 % [48, 75] of 48"]),
        ("unseen_views", ["27 % [21, 34] of 2 × 10"]),
        ("survival", ["72 % [49, 88] of 18"]),
        ("rendering_quality", ["0.924 [0.918, 0.931]"]),
        ("run_time", ["5 steps, 0.33 s; 90 % within 0.83 s", "88 % [74, 95] of 40"]),
    ],
)
def test_the_recorded_runs_print_the_published_numbers(capsys, name, cells):
    table.main([str(RECORDS / f"{name}.jsonl")])
    printed = capsys.readouterr().out
    assert [cell for cell in cells if f"| {cell} " not in printed] == []
