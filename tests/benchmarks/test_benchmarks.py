"""Each benchmark runs at a tiny size and writes the rows that it promises."""

import csv
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import common, gpu, lights, renderer, scene, training
from renderer.transport import precomputed
from renderer.visibility.rasterizers import choose


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_time_against_error_of_the_renderer(tmp_path, monkeypatch):
    monkeypatch.setattr(common, "MIN_TIMED_SECONDS", 0.0)
    for name, value in {"DEGREES": (2, 6), "PER_SIDE": (1, 8), "MANY_VIEWS": (8, 9)}.items():
        monkeypatch.setattr(renderer, name, value)
    tiny = ["--sizes", "8", "--subdivisions", "1", "--rounds", "1", "--rasterizer", "numpy"]
    renderer.main(["--out", str(tmp_path), *tiny, "--step-sizes", "8", "--coarse", "1"])
    rows = read(tmp_path / "renderer_pareto.csv")
    assert all(float(row["time_ms"]) > 0 for row in rows)
    steps = [row for row in rows if row["ratio"]]
    assert len(steps) == 2 * (2 * (4 + 2) + 4)  # meshes × (samples × (steps + builds) + many views)
    assert all(0 < float(row["ratio_low"]) <= float(row["ratio"]) <= float(row["ratio_high"]) for row in steps)
    rows = [row for row in rows if row not in steps]
    measured = [row for row in rows if not row["panel"].startswith("skipped")]
    assert all(math.isfinite(float(row[name])) for row in measured for name in ("image_error", "gradient_error"))
    assert len(rows) - len(measured) == 13 and all(float(row["saved"]) > 0 for row in rows if row not in measured)
    panels = {row["panel"] for row in measured}
    assert len(panels) == 4
    for panel in panels:
        assert any(row["front"] == "True" for row in measured if row["panel"] == panel)
        assert sum(row["default"] == "True" for row in measured if row["panel"] == panel) == 1
    assert (tmp_path / "renderer_pareto.png").read_bytes().startswith(b"\x89PNG")


def test_the_benchmarks_reference_is_what_more_samples_converge_to():
    """By Monte Carlo's rate at least: a factor of 4 in samples per side, 4 in the error."""
    view = scene.View(scene.ellipsoid(2), 8, choose("numpy"))
    exact, light = scene.Converged(view), scene.coefficients(6).float()
    steps = [renderer.light_step(view, view.operator(samples), light) for samples in (2, 8, 32)]
    coarse, middle, fine = (exact.errors(step, exact.by_light)["gradient_error"] for step in steps)
    assert middle < coarse / 4 and fine < middle / 4


def test_the_benchmarks_plain_autograd_is_the_analytic_gradient():
    view, light = scene.View(scene.ellipsoid(2), 8, choose("numpy")), scene.coefficients(6)
    analytic, plain = (renderer.vertex_step(view, 3, light, shade)()[2] for shade in renderer.SHADINGS.values())
    torch.testing.assert_close(plain, analytic, rtol=0, atol=1e3 * 2.2e-16 * float(analytic.abs().max()))


def test_all_ways_to_the_gradient_by_the_light_agree_at_equal_samples():
    """Whatever plain autograd keeps from step to step; to float32's rounding of sums over all pixels."""
    contenders = list(renderer.light_gradients(scene.View(scene.ellipsoid(2), 16, choose("numpy"))))
    for samples in (1, scene.SAMPLES):
        (pixels, *first), *others = [step() for _, count, _, step, _ in contenders if count == samples]
        assert len(others) == 3 + (samples == 1)
        for others_pixels, *values in others:
            assert torch.equal(others_pixels, pixels)
            for value, expected in zip(values, first, strict=True):
                torch.testing.assert_close(value, expected, rtol=0, atol=2e-5 * float(expected.abs().max()))


def test_cost_and_accuracy_of_lights(tmp_path, monkeypatch):
    cases = {name: lights.LOCAL_LIGHTS[name] for name in ("harmonics", "3 lamps")}
    few = {"VIEWS": 1, "RAYS": 2**10, "PATCHES": 64, "RAYS_OF_PATCH": 64, "LOCAL_LIGHTS": cases}
    for name, value in few.items():
        monkeypatch.setattr(lights, name, value)
    monkeypatch.setattr(precomputed, "PATCHES", 64)
    path = tmp_path / "lights.csv"
    lights.main(["--csv", str(path), "--sizes", "12", "--vertices", "0", "--rounds", "1"])
    rows = read(path)
    assert [row["light"] for row in rows] == [*lights.LIGHT_PATHS, *cases]
    assert all(float(row[name]) > 0 for row in rows for name in ("step_ms", "build_s", "megabytes"))
    assert all(0 < float(row[name]) < 0.4 for row in rows for name in ("image_error", "gradient_error"))


@pytest.mark.slow
def test_training_is_timed_beside_a_plain_loop(tmp_path):
    """With attacks that take all their steps."""
    rng, data = np.random.default_rng(0), tmp_path / "data.npz"
    arrays = {"classes": np.array(["orange", "other"])}
    for part in ("train", "test"):
        arrays[f"{part}_images"] = rng.integers(0, 256, (200, 3, 32, 32), dtype=np.uint8)
        arrays[f"{part}_labels"] = np.arange(200) % 2
    np.savez(data, **arrays)
    tiny = ["--images", "32", "--rounds", "1", "--depth", "10", "--width", "1", "--workers", "0"]
    overrides = ["renderer.rasterizer=numpy", "renderer.samples=1", "augment.examples=10", "train.threads=1"]
    out = ["--data", str(data), "--csv", str(tmp_path / "speed.csv")]
    first, median = training.main(["speed", *tiny, *out, "--overrides", *overrides, "augment.attack.max_steps=2"])
    assert first | {"round": "median"} == median and first["attack_steps"] == 2
    for loop in ("float32", "bfloat16", "data"):
        ratio = first["train_images_per_second"] / first[f"{loop}_images_per_second"]
        assert first[f"{loop}_ratio"] == pytest.approx(ratio) and ratio > 0
    assert 0 < first["attack_fraction_of_epoch"] < 1
    assert len(read(tmp_path / "speed.csv")) == 2


def test_the_cost_of_renders_is_measured_over_their_number_and_meshes(tmp_path, monkeypatch):
    """Here in a thread, since a process would take seconds to import torch."""
    monkeypatch.setattr(training, "ProcessPoolExecutor", lambda workers, context: ThreadPoolExecutor(workers))
    path = tmp_path / "renders.csv"
    rows = training.main(["renders", "--numbers", "10", "--meshes", "1", "2", "--csv", str(path)])
    loads = [(row["renders"], row["meshes"], row["views"]) for row in rows]
    assert loads == [(10, 1, 2), (20, 2, 4)]
    assert all(row["attack_seconds"] > 0 and row["ms_per_render_and_pass"] > 0 for row in rows)
    assert len(read(path)) == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_the_gpus_questions_are_refused_without_one(capsys):
    with pytest.raises(SystemExit, match="2"):
        gpu.main([])
    assert capsys.readouterr().err.count("error: torch finds no GPU here") == 1
