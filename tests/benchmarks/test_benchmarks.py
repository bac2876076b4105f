"""Each benchmark runs at a tiny size and writes the rows that it promises."""

import csv
import math
from pathlib import Path

import pytest
import torch
import trimesh

from benchmarks import common, lights, renderer, scene, training
from renderer.errors import InputError
from renderer.io.mitsuba import DIFFERENTIABLE, mitsuba
from renderer.mesh import Mesh
from renderer.rasterizer import choose
from renderer.transport import precomputed, rays


def test_calls_take_turns_in_every_round(monkeypatch):
    monkeypatch.setattr(common, "BURST", 0.0)
    order = []
    found = common.medians({name: lambda name=name: order.append(name) for name in "ab"}, rounds=3)
    assert list(found) == ["a", "b"] and all(value >= 0 for value in found.values())
    assert "".join(order[-18:]) == "aaabbb" * 3  # each turn: two calls to warm up, one that is timed


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_time_against_error_of_the_renderer(tmp_path, monkeypatch):
    monkeypatch.setenv("LP_NUM_THREADS", "0")
    for name, value in {"VIEWS": 1, "DEGREES": (2, 6), "PER_SIDE": (1, 8)}.items():
        monkeypatch.setattr(renderer, name, value)
    monkeypatch.setattr(renderer, "rasterizers", lambda: (choose("numpy"),))
    renderer.main(["--out", str(tmp_path), "--sizes", "8", "--subdivisions", "1", "--rounds", "1"])
    rows = read(tmp_path / "renderer_pareto.csv")
    measured = [row for row in rows if not row["panel"].startswith("skipped")]
    assert all(float(row["time_ms"]) > 0 for row in rows)
    assert all(math.isfinite(float(row[name])) for row in measured for name in ("image_error", "gradient_error"))
    panels = {row["panel"] for row in measured}
    assert len(panels) == 4 and len(rows) - len(measured) == 12
    for panel in panels:
        assert any(row["front"] == "True" for row in measured if row["panel"] == panel)
        assert sum(row["default"] == "True" for row in measured if row["panel"] == panel) == 1
    assert (tmp_path / "renderer_pareto.png").read_bytes().startswith(b"\x89PNG")


def test_the_benchmarks_reference_is_what_more_samples_converge_to():
    """By Monte Carlo's rate at least: a factor of 4 in samples per side, 4 in the error."""
    view = scene.View(scene.ellipsoid(2), 8, choose("numpy"))
    exact, light = scene.Converged(view), scene.coefficients(6).float()
    errors = [exact.of_operator(view.operator(samples), light)["gradient_error"] for samples in (2, 8, 32)]
    assert errors[1] < errors[0] / 4 and errors[2] < errors[1] / 4


def test_the_benchmarks_plain_autograd_is_the_analytic_gradient():
    view, light = scene.View(scene.ellipsoid(2), 8, choose("numpy")), scene.coefficients(6)
    first, *others = (renderer.vertex_step(view, 3, light, shade)() for shade in renderer.SHADINGS.values())
    for other in others:
        torch.testing.assert_close(other, first, rtol=0, atol=1e3 * 2.2e-16 * float(first.abs().max()))


def test_cost_and_accuracy_of_lights(tmp_path, monkeypatch):
    bases = {name: lights.BASES[name] for name in ("harmonics", "3 lamps")}
    for name, value in {"BASES": bases, "VIEWS": 1, "REFERENCE": 8, "CONVERGED": (2**10, 64, 64)}.items():
        monkeypatch.setattr(lights, name, value)
    monkeypatch.setattr(precomputed, "PATCHES", 64)
    path = tmp_path / "lights.csv"
    lights.main(["--csv", str(path), "--sizes", "12", "--vertices", "0", "--rounds", "1"])
    rows = read(path)
    assert [row["light"] for row in rows] == [*lights.LIGHT_PATHS, *bases]
    assert all(float(row[name]) > 0 for row in rows for name in ("step_ms", "build_s", "megabytes"))
    assert all(0 < float(row[name]) < 0.4 for row in rows for name in ("image_error", "gradient_error"))


def test_another_number_of_rays_is_undone():
    before = rays.DIRECTIONS, precomputed.PATCHES, precomputed.PATCH_DIRECTIONS
    with pytest.raises(InputError), lights.quadrature(32, 16, 8):
        assert (rays.DIRECTIONS, precomputed.PATCHES, precomputed.PATCH_DIRECTIONS) == (32, 16, 8)
        raise InputError("anything")
    assert before == (rays.DIRECTIONS, precomputed.PATCHES, precomputed.PATCH_DIRECTIONS)


def test_mitsubas_image_is_in_the_place_of_ours(monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(lights, "SEEDS", 2)
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh.plain(ball.vertices, ball.faces, (0.9, 0.5, 0.2))
    theirs, noise = lights.mitsuba_image(mesh, 12, "direct")
    canvas, inside, built = torch.zeros(3, 144), theirs[3] > 0.999, lights.operator(mesh, 12)
    canvas[:, built.pixels] = built.radiance(lights.load_light("st_peters"))
    assert inside.sum() > 20 and noise[:3, inside].mean() > 0
    assert (canvas - theirs[:3])[:, inside].abs().max() < 0.05 * theirs[:3].max()


@pytest.mark.slow
@pytest.mark.parametrize("paths", [*lights.LIGHT_PATHS][1:])
@pytest.mark.parametrize("mesh", ["convex: a ball", "open: half a ball", "rugged: a dented ball"])
def test_images_and_gradients_by_the_light_go_to_mitsubas_noise(mesh, paths):
    """Which is itself known from eight renders to a fifth or so; a convex mesh has nothing to converge."""
    pytest.importorskip("mitsuba")
    try:
        with mitsuba(DIFFERENTIABLE):
            pass
    except InputError as error:
        pytest.skip(str(error))
    row = lights.differences(lights.hard_meshes()[mesh], 32, paths)
    for of in ("image", "gradient"):
        error, converged, direct = (row[f"{of}_error{end}"] for end in ("", "_converged", "_direct"))
        assert 0 < row[f"{of}_noise"] < 0.006 and converged < 1.3 * row[f"{of}_noise"]
        assert error < 1.3 * row[f"{of}_noise"] if mesh.startswith("convex") else converged < error < 0.02 < direct


@pytest.mark.slow
def test_training_is_timed_beside_a_plain_loop(tmp_path):
    """With attacks that take all their steps."""
    tiny = ["--images", "32", "--rounds", "1", "--depth", "10", "--width", "1", "--workers", "0"]
    overrides = ["renderer.rasterizer=numpy", "renderer.samples=1", "augment.examples=10", "train.threads=1"]
    first, middle = training.main(
        ["speed", *tiny, "--csv", str(tmp_path / "speed.csv"), "--overrides", *overrides, "augment.attack.max_steps=2"]
    )
    assert first | {"round": "median"} == middle and first["attack_steps"] == 2
    assert first["speedup"] == pytest.approx(first["train_images_per_second"] / first["plain_loop_images_per_second"])
    assert 0 < first["attack_fraction_of_epoch"] < 1
    assert len((tmp_path / "speed.csv").read_text().splitlines()) == 3


def test_the_cost_of_renders_is_measured_over_their_number_size_and_meshes(tmp_path):
    csv = tmp_path / "renders.csv"
    rows = training.main(["renders", "--numbers", "10", "--sizes", "16", "--meshes", "1", "2", "--csv", str(csv)])
    assert [(row["renders"], row["size"], row["meshes"], row["views"]) for row in rows] == [
        (10, 16, 1, 2),
        (20, 16, 2, 4),
    ]
    assert all(row["attack_seconds"] > 0 and row["memory_mb"] > 0 for row in rows)
    assert len(csv.read_text().splitlines()) == 3
