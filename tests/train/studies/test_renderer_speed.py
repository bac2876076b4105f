import copy
import csv
import itertools
import math
import re
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from renderer import reference
from renderer.errors import InputError
from renderer.visibility import choose
from train.studies.renderer_speed import measure, results, scenes, steps, study, vertices
from train.studies.renderer_speed.reference import Converged
from train.studies.renderer_speed.results import Row

EPS32, EPS64 = torch.finfo(torch.float32).eps, torch.finfo(torch.float64).eps
CPU = torch.device("cpu")


def row(name: str, time_ms: float, error: float, default: bool = False) -> Row:
    return Row("panel", name, time_ms, image_error=error / 2, gradient_error=error, default=default)


def view(vertices: int = 160, size: int = 8) -> scenes.View:
    return scenes.View(scenes.ellipsoid(vertices), size, choose("software"), CPU)


@pytest.fixture(scope="module")
def converged() -> Converged:
    return Converged(view())


# ---------------------------------------------------------------------------- fronts

TABLE = [
    row("fast", 1, 0.5),
    row("slower and no better", 2, 0.5),
    row("middle", 3, 0.2),
    row("worse than middle in both", 4, 0.3),
    row("accurate", 9, 0.1),
    row("as accurate, slower", 10, 0.1),
]


def test_the_front_holds_what_nothing_else_beats():
    assert [each.setting for each in results.pareto_front(TABLE[::-1])] == ["fast", "middle", "accurate"]


def test_equal_settings_share_the_front():
    assert len(results.pareto_front([row("one", 1, 0.1), row("the other", 1, 0.1)])) == 2


def test_the_error_is_the_larger_one_to_three_digits():
    assert row("any", 1, 0.123449).error == 0.123
    assert Row("panel", "image only", 1, image_error=0.25).error == 0.25


@pytest.mark.parametrize(
    ("default", "says"),
    [
        (row("in the gap", 2, 0.4, True), "yes"),
        (row("tied", 3.1, 0.2, True), "within the noise: middle takes 0.97 of its time at 1.00 of its error"),
        (row("beaten", 4, 0.4, True), "**no**: middle takes 0.75 of its time at 0.50 of its error"),
    ],
    ids=["on", "tied", "beaten"],
)
def test_the_verdict_names_what_dominates_the_default(default, says):
    assert results.verdict(default, [*TABLE, default]) == says


# ---------------------------------------------------------------------------- clocks


def test_candidates_take_turns_in_every_round(monkeypatch):
    monkeypatch.setattr(measure, "BURST", 0.0)
    order = []
    measure.Clock(CPU, 3).medians({name: lambda name=name: order.append(name) for name in "ab"})
    assert "".join(order[-12:]) == "aabb" * 3  # each turn: one call to warm up, one that is timed


def test_peak_memory_is_what_is_alive_at_once():
    def call() -> torch.Tensor:
        first = torch.zeros(250_000)
        second = first + 1
        del first
        return second * 2

    assert measure.peak_bytes(call, CPU) == pytest.approx(2_000_000, abs=1000)  # blocks are rounded up to 64 bytes


# ---------------------------------------------------------------------------- scenes and reference


@pytest.mark.parametrize("pieces", [1, 2, 5, 8])
def test_the_ellipsoid_is_closed_at_every_fineness(pieces):
    mesh = scenes.ellipsoid(10 * pieces**2 + 2)
    assert (len(mesh.vertices), len(mesh.faces)) == (10 * pieces**2 + 2, 20 * pieces**2)
    assert mesh.closed
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices / scenes.AXES, axis=1), 1, rtol=4 * EPS64)


def test_the_cut_light_approaches_the_whole_one():
    """On average over the sphere: the squared error is the power of the bands that are cut, Σ (2l + 1) A_l² / 4π."""
    directions = scenes.ellipsoid(10_000).vertices / scenes.AXES
    normals = torch.from_numpy(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    for degree in (2, 6, 12):
        error = reference.irradiance(normals, scenes.coefficients(degree)) - scenes.irradiance(normals)
        cut = sum((2 * l + 1) * reference.clamped_cosine(l) ** 2 for l in range(degree + 1, 400)) / (4 * math.pi) ** 2
        # Vertices crowd a little at the icosahedron's corners: 1.15 times between the sparsest and the densest.
        torch.testing.assert_close(error.square().mean(0), scenes.SUN**2 * cut, rtol=0.15, atol=0)


def test_gradients_of_the_reference_are_those_of_its_image(converged):
    """The image is linear in the light; by the vertices, central differences with coverage kept."""
    light, image_gradient = scenes.coefficients(6), converged.view.image_gradient

    def loss(mesh) -> float:
        moved = copy.copy(converged)
        moved.view = replace(converged.view, mesh=mesh)
        return float((moved.image(shade) * image_gradient).sum())

    def shade(normals: torch.Tensor) -> torch.Tensor:
        return reference.irradiance(normals, light)

    mesh = converged.view.mesh
    expected = (converged.light_gradient(6) * light).sum()
    assert loss(mesh) == pytest.approx(float(expected), rel=1e3 * EPS64)
    direction, step = np.random.default_rng(0).normal(size=mesh.vertices.shape), 1e-5
    ahead, behind = (loss(replace(mesh, vertices=mesh.vertices + sign * step * direction)) for sign in (1, -1))
    along = float((converged.vertex_gradient(shade) * torch.from_numpy(direction)).sum())
    # Truncation: step² times a third derivative of order (1 / edge)² ≈ 20.
    assert (ahead - behind) / (2 * step) == pytest.approx(along, rel=1e-7)


def test_more_samples_come_closer_to_the_reference(converged):
    """By Monte Carlo's rate at least: a factor of 4 in samples per side, 4 in the error."""
    light, errors = scenes.coefficients(6).float(), []
    for samples in (2, 8, 32):
        operator = converged.view.operator(samples)
        image = converged.view.canvas(operator.radiance(light), operator.pixels)
        exact = converged.image(lambda normals: reference.irradiance(normals, scenes.coefficients(6)))
        errors.append(measure.relative_error(image, exact))
    assert all(finer < coarser / 4 for coarser, finer in itertools.pairwise(errors))
    assert errors[-1] > converged.uncertainty(scenes.irradiance)


# ---------------------------------------------------------------------------- steps


def test_layouts_and_step_agree():
    scene = view()
    exact, light = scene.operator(4, dtype=torch.float64), scenes.coefficients(6)
    expected = steps.light_step(scene, exact, light)()
    for layout in steps.LAYOUTS:
        for dtype, eps in ((torch.float64, EPS64), (torch.float32, EPS32)):
            operator = steps.laid_out(exact, layout, dtype)
            found = steps.light_step(scene, operator, light.to(dtype))().double()
            # Sums of 31 products in one order or another, and then of a hundred pixels.
            assert measure.relative_error(found, expected) < 100 * eps


def test_plain_autograd_by_face_and_by_sample_is_the_analytic_gradient():
    scene, light = view(), scenes.coefficients(6)
    found = [
        steps.vertex_step(scene, 3, light, kept=kept, **shade)()
        for kept in (False, True)
        for shade in ({}, {"shade": steps.shade_by_face}, {"shade": reference.radiance})
    ]
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], rtol=0, atol=1e3 * EPS64 * float(found[0].abs().max()))


# ---------------------------------------------------------------------------- rasterising


@pytest.mark.parametrize(
    ("ratios", "unlike", "found", "passed"),
    [
        ({"small": 3.0, "large": 4.5}, 0, "3× (small) to 4.5× (large), no samples differ", True),
        ({"small": 4.45, "large": 2.97}, 0, "2.97× (large) to 4.45× (small), no samples differ", False),
        ({"small": 3.0, "large": 4.5}, 4, "3× (small) to 4.5× (large), 4 samples differ", False),
        ({}, 0, "not measured", None),
    ],
)
def test_the_compiled_rasteriser_is_held_to_its_slowest_case_and_to_every_sample(ratios, unlike, found, passed):
    target = vertices.compiled(ratios, unlike)
    assert (target.found, target.passed) == (found, passed)


# ---------------------------------------------------------------------------- the study


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_a_quick_run_writes_every_file(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "_backends", lambda: (choose("software"),))
    monkeypatch.setattr(sys, "argv", ["scripts/benchmark_renderer.py", "quick=true"])
    settings = study.RendererSpeedSettings(str(tmp_path), "cpu", False, True, None, study.SceneSettings([]))
    monkeypatch.setenv("LP_NUM_THREADS", "0")
    threads = torch.get_num_threads()
    try:
        study.run(settings)
    finally:
        torch.set_num_threads(threads)

    rows, points = (read(tmp_path / f"renderer_{name}.csv") for name in ("pareto", "scaling"))
    assert list(rows[0]) == [*(field.name for field in fields(Row)), "front"]
    assert all(float(each["time_ms"]) > 0 for each in rows)
    chosen = {each["panel"] for each in rows if each["default"] == "True"}
    builds = {f"building an operator{transport}, 8²" for transport in ("", " with shadows", " with bounces:3")}
    assert chosen == {"light step, 8²", "light step, 12²", "vertex step, 8²"} | builds
    for panel in chosen:
        assert any(each["front"] == "True" for each in rows if each["panel"] == panel)
    assert len(points) == 3 and all(float(point["memory_mb"]) > 0 for point in points)
    for figure in ("renderer_pareto.png", "renderer_scaling.png"):
        assert (tmp_path / figure).read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "performance_renderer.md").read_text()
    assert page.startswith("# Time against error\n\n`python scripts/benchmark_renderer.py quick=true` measures ")
    assert page in capsys.readouterr().out
    defaults = [
        line for line in page.splitlines() if re.search(r"\| (yes|within the noise: .*|\*\*no\*\*: .*) \|$", line)
    ]
    assert {line.split(" | ")[0].removeprefix("| ") for line in defaults} >= chosen
    assert "| not measured | — |" in page


@pytest.mark.parametrize(("only", "says"), [("shapes", "only=shapes: choose one"), ("vertices", "there is no ")])
def test_a_section_that_cannot_be_put_anywhere_is_refused_before_it_is_measured(tmp_path, only, says):
    with pytest.raises(InputError, match=says):
        study.run(study.RendererSpeedSettings(str(tmp_path), "cpu", False, True, only, study.SceneSettings([])))
