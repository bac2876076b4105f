"""Each benchmark runs at a tiny size and writes the rows that it promises."""

import csv
import json
import math
import time
from pathlib import Path

import pytest
import torch
from scipy.stats import ttest_1samp

from benchmarks import (
    common,
    gpu,
    gradient_free,
    lights,
    relit_photographs,
    renderer,
    scene,
    steps,
    whole_steps,
)
from renderer.operators import shadows as precomputed
from renderer.visibility import choose

PNG_SIGNATURE = b"\x89PNG"


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_time_against_error_of_the_renderer(tmp_path, monkeypatch):
    monkeypatch.setattr(common, "MIN_TIMED_SECONDS", 0.0)
    monkeypatch.setattr(renderer, "DEGREES", (2, 6))
    monkeypatch.setattr(renderer, "SAMPLES_PER_SIDE", (1, 8))
    monkeypatch.setattr(whole_steps, "MANY_VIEWS_SIZE", 8)
    monkeypatch.setattr(whole_steps, "MANY_VIEWS_COUNT", 9)
    arguments = ["--sizes", "8", "--subdivisions", "1", "--rounds", "1"]
    arguments += ["--rasterizer", "numpy", "--step-sizes", "8", "--coarse", "1"]
    renderer.main(["--out", str(tmp_path), *arguments])

    rows = read(tmp_path / "renderer_pareto.csv")
    assert all(float(row["time_ms"]) > 0 for row in rows)
    whole_steps_rows = [row for row in rows if row["ratio"]]
    savings = [row for row in rows if row["panel"].startswith("skipped")]
    # Two meshes have, for each of two numbers of samples, four steps and two
    # preparations, and four steps of many views.
    assert len(whole_steps_rows) == 2 * (2 * (4 + 2) + 4)
    assert len(savings) == 15
    for row in rows:
        if row not in whole_steps_rows + savings:
            assert math.isfinite(float(row["image_error"]))
            is_photograph = row["panel"].startswith("random light")
            assert is_photograph or math.isfinite(float(row["gradient_error"]))
    assert (tmp_path / "renderer_pareto.png").read_bytes().startswith(PNG_SIGNATURE)

    # One panel that is measured again leaves all other rows as they are.
    renderer.main(["--out", str(tmp_path), *arguments, "--panels", "rasterizing"])
    again = read(tmp_path / "renderer_pareto.csv")
    others = [row for row in rows if row["panel"] != "rasterizing, 8²"]
    assert again[: len(others)] == others
    assert {row["panel"] for row in again[len(others) :]} == {"rasterizing, 8²"}
    assert len(again) == len(rows)


def test_the_benchmarks_reference_is_what_more_samples_converge_to():
    view = scene.View(scene.ellipsoid(2), 8, choose("numpy"))
    # Even random samples would reduce the error to a quarter, with four times as many of
    # them per side.
    converged = scene.Converged(view)
    exact = converged.result(converged.by_light)
    light = scene.coefficients(6).float()
    gradient_errors = []
    for samples in (2, 8, 32):
        step = steps.LightStep(view, view.operator(samples), light)
        gradient_errors.append(step().errors(exact)["gradient_error"])
    coarse, middle, fine = gradient_errors
    assert middle < coarse / 4
    assert fine < middle / 4


@pytest.mark.parametrize(("samples", "count"), [(1, 5), (scene.SAMPLES, 4)])
def test_all_ways_to_the_gradient_by_the_light_agree_at_equal_samples(samples, count):
    view = scene.View(scene.ellipsoid(2), 16, choose("numpy"))
    contenders = renderer.light_gradients(view)
    results = [contender.step() for contender in contenders if contender.samples == samples]
    first, *others = results
    assert len(results) == count
    for one in others:
        assert torch.equal(one.pixels, first.pixels)
        # Sums over all pixels are rounded to float32.
        whole_steps.require_close([one.radiance, one.gradient], [first.radiance, first.gradient])


@pytest.mark.slow
def test_cost_and_accuracy_of_lights(tmp_path, monkeypatch):
    cases = {name: lights.LOCAL_LIGHTS[name] for name in ("harmonics", "3 lamps")}
    monkeypatch.setattr(lights, "LOCAL_LIGHTS", cases)
    monkeypatch.setattr(lights, "VIEWS", 1)
    monkeypatch.setattr(lights, "CONVERGED_RAYS", 2**10)
    monkeypatch.setattr(lights, "CONVERGED_PATCHES", 64)
    monkeypatch.setattr(lights, "CONVERGED_RAYS_PER_PATCH", 64)
    monkeypatch.setattr(precomputed, "PATCHES", 64)
    path = tmp_path / "lights.csv"
    lights.main(["--csv", str(path), "--sizes", "12", "--vertices", "0", "--rounds", "1"])

    rows = read(path)
    costs = [row for row in rows if row["table"] != "samples"]
    assert [row["light"] for row in costs] == [*lights.LIGHT_PATHS, *cases]
    assert len(rows) == len(costs) + 2 * len(lights.SAMPLES)
    for row in costs:
        assert all(float(row[name]) > 0 for name in ("step_ms", "build_s", "megabytes"))
        assert all(0 < float(row[name]) < 0.4 for name in ("image_error", "gradient_error"))


@pytest.mark.slow
def test_optimizers_are_compared_at_equal_forward_passes(capsys, monkeypatch):
    pytest.importorskip("cma")
    monkeypatch.setattr(gradient_free, "FRUIT", ("orange",))
    arguments = ["--network", "none", "--views", "1", "--seeds", "1", "--budgets", "2", "20"]
    gradient_free.main(arguments)
    header, _, *rows = capsys.readouterr().out.splitlines()
    assert header == "|optimizer|2 passes|20 passes|"
    assert [row.split("|")[1] for row in rows] == ["gradient", "random search", "CMA-ES"]


def test_the_intervals_of_relit_photographs_are_those_of_scipy():
    draws = torch.Generator().manual_seed(1)
    column, first = torch.randint(0, 2, (2, 60), generator=draws).double()
    text = relit_photographs.cell(column[None], first[None], None)
    low, high = (float(end) for end in text.partition("[")[2].rstrip("]").split(","))
    difference = (column - first).numpy()
    expected = ttest_1samp(difference, 0).confidence_interval()
    assert text.startswith(f"{column.mean():.3f}, {difference.mean():+.3f}")
    assert low == pytest.approx(expected.low, abs=0.03)
    assert high == pytest.approx(expected.high, abs=0.03)


def test_the_intervals_of_relit_photographs_contain_the_variation_between_seeds():
    means = 0.5 + torch.linspace(0, 0.1, 12, dtype=torch.float64) ** 2
    first = torch.linspace(0.499, 0.501, 20, dtype=torch.float64)[None]
    found = relit_photographs.interval(means[:, None] + first - 0.5, first)
    expected = ttest_1samp(means.numpy() - 0.5, 0).confidence_interval()
    assert found.low == pytest.approx(expected.low, abs=1e-3)
    assert found.high == pytest.approx(expected.high, abs=1e-3)


def test_calls_take_turns_as_often_as_asked(monkeypatch):
    monkeypatch.setattr(common, "MIN_TIMED_SECONDS", 0.0)
    times = common.times_in_turn({"one": lambda: sum(range(1000)), "two": lambda: None}, 7)
    assert [*map(len, times.values())] == [7, 7]


def test_questions_about_a_gpu_are_answered_over_several_runs(tmp_path, monkeypatch):
    def fails(device):
        yield {"question": "fails", "value": 1}
        raise RuntimeError("out of memory")

    monkeypatch.setattr(gpu, "QUESTIONS", {"fails": fails, "works": lambda device: [{"value": 2}]})
    out = tmp_path / "new" / "gpu.jsonl"
    words = ["--here", "--device", "cpu", "--out", str(out), "--questions"]
    gpu.main([*words, "fails", "works", "--minutes", "-1"])
    gpu.main([*words, "fails"])
    gpu.main([*words, "fails", "works"])
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["left"] for row in rows if "left" in row] == ["fails", "works"]
    [works] = [row for row in rows if "answered" in row]
    assert works["answered"] == "works"
    # Python with torch takes more than 100 MB.
    assert works["peak_bytes"] > 1e8
    # A question that failed is asked again.
    assert [row["value"] for row in rows if "value" in row] == [1, 1, 2]
    assert [row["error"] for row in rows if "error" in row] == ["RuntimeError: out of memory"] * 2


def test_a_question_about_a_gpu_is_stopped_after_its_minutes(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "STOP_SECONDS", 0.1)
    out = tmp_path / "gpu.jsonl"
    start = time.monotonic()
    gpu.main(["--device", "cpu", "--out", str(out), "--questions", "paper", "--minutes", "0.01"])
    assert time.monotonic() - start < 30
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["question"] for row in rows if "error" in row] == ["paper"]
    assert not any("answered" in row for row in rows)
