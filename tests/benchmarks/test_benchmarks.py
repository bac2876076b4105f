"""Each benchmark runs at a tiny size and writes the rows that it promises."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from benchmarks import common, lights, renderer, scene, training
from renderer.errors import InputError
from renderer.io.mitsuba import DIFFERENTIABLE, mitsuba
from renderer.mesh import Mesh
from renderer.rasterizer import choose
from renderer.transport import local as sparse
from renderer.transport import radiosity, rays


def test_calls_take_turns_in_every_round(monkeypatch):
    monkeypatch.setattr(common, "BURST", 0.0)
    order = []
    found = common.medians({name: lambda name=name: order.append(name) for name in "ab"}, rounds=3)
    assert list(found) == ["a", "b"] and all(value >= 0 for value in found.values())
    assert "".join(order[-18:]) == "aaabbb" * 3  # each turn: two calls to warm up, one that is timed


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def finite(rows: list[dict[str, str]], *columns: str) -> bool:
    return all(math.isfinite(float(row[column])) for row in rows for column in columns)


def test_time_against_error_of_the_renderer(tmp_path, monkeypatch):
    monkeypatch.setenv("LP_NUM_THREADS", "0")
    monkeypatch.setattr(renderer, "VIEWS", 1)
    monkeypatch.setattr(renderer, "rasterizers", lambda: (choose("numpy"),))
    options = "--sizes 8 --vertices 42 --degrees 2 6 --samples 1 8 --rounds 1"
    renderer.main(["--out", str(tmp_path), *options.split()])
    rows = read(tmp_path / "renderer_pareto.csv")
    measured = [row for row in rows if not row["panel"].startswith("skipped")]
    assert finite(rows, "time_ms", "size", "samples") and finite(measured, "image_error", "gradient_error")
    panels = {row["panel"] for row in measured}
    assert len(panels) == 4 and len(rows) - len(measured) >= 12
    for panel in panels:
        assert any(row["front"] == "True" for row in measured if row["panel"] == panel)
        assert sum(row["default"] == "True" for row in measured if row["panel"] == panel) == 1
    assert (tmp_path / "renderer_pareto.png").read_bytes().startswith(b"\x89PNG")


def test_the_benchmarks_reference_is_what_more_samples_converge_to():
    """By Monte Carlo's rate at least: a factor of 4 in samples per side, 4 in the error."""
    view = scene.View(scene.ellipsoid(160), 8, choose("numpy"))
    exact, light = scene.Converged(view), scene.coefficients(6).float()
    errors = [exact.of_operator(view.operator(samples), light)["gradient_error"] for samples in (2, 8, 32)]
    assert errors[1] < errors[0] / 4 and errors[2] < errors[1] / 4


def test_the_benchmarks_plain_autograd_is_the_analytic_gradient():
    view, light = scene.View(scene.ellipsoid(160), 8, choose("numpy")), scene.coefficients(6)
    first, *others = (renderer.vertex_step(view, 3, light, shade)() for shade in renderer.SHADINGS.values())
    for other in others:
        torch.testing.assert_close(other, first, rtol=0, atol=1e3 * 2.2e-16 * float(first.abs().max()))


@pytest.mark.parametrize("pieces", [1, 2, 5, 8])
def test_the_benchmarks_ellipsoid_is_closed_at_every_fineness(pieces):
    mesh = scene.ellipsoid(10 * pieces**2 + 2)
    assert (len(mesh.vertices), len(mesh.faces)) == (10 * pieces**2 + 2, 20 * pieces**2)
    assert mesh.closed
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices / (1.0, 0.9, 0.8), axis=1), 1, rtol=1e-15)


def test_cost_and_accuracy_of_lights(tmp_path, monkeypatch):
    bases = {name: lights.BASES[name] for name in ("harmonics", "3 lamps", "projector of 32²")}
    for name, value in {"BASES": bases, "RAYS": (64, 512), "VIEWS": 1, "STEPS_AWAY": (0, 20), "REFERENCE": 16}.items():
        monkeypatch.setattr(lights, name, value)
    monkeypatch.setattr(lights, "CONVERGED", (2**11, 2**6, 2**6))
    monkeypatch.setattr(lights, "SAMPLES", (8,))
    monkeypatch.setattr(radiosity, "PATCHES", 64)
    monkeypatch.setattr(sparse, "SMALL", 0)
    path = tmp_path / "lights.jsonl"
    lights.main(["--out", str(path), *["--sizes", "12", "16", "--vertices", "0", "--rounds", "1"]])
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    tables = {
        name: [row for row in rows if row["table"] == name] for name in dict.fromkeys(row["table"] for row in rows)
    }
    assert list(tables) == ["cost", "local lights", "lamp step", "stale", "rays"]
    assert all(math.isfinite(value) for row in rows for value in row.values() if isinstance(value, float))

    shapes = {(row["mesh"], row["light_paths"]): (row["channels"], row["coefficients"]) for row in tables["cost"]}
    assert shapes["one gray", "direct"] == (1, 31) and shapes["one gray", "bounces:3"] == (1, 49)
    assert shapes["one color", "shadows"] == (1, 49) and shapes["one color", "bounces:3"] == (3, 49)
    for row in tables["local lights"]:
        assert row.get("image_error_8x8", 0) <= row.get("image_error_2x2", 0)
    projector = {row["dense"]: row["megabytes"] for row in tables["local lights"] if row["light"] == "projector of 32²"}
    assert projector[False] < projector[True] / 4
    unmoved, moved = tables["stale"]
    assert unmoved["image_error"] == unmoved["gradient_error"] == 0 < moved["image_error"] < 0.1
    finest = [row for row in tables["rays"] if row["samples"] == 64 and row["light_paths"] == "shadows"]
    assert finest[1]["image_error"] < finest[0]["image_error"]


def test_another_number_of_rays_and_dense_operators_are_undone():
    before = rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS, sparse.SPARSE
    with pytest.raises(InputError), lights.quadrature(32, 16, 8), lights.dense():
        assert (rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS, sparse.SPARSE) == (32, 16, 8, 0)
        raise InputError("anything")
    assert before == (rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS, sparse.SPARSE)


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
