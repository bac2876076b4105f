import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import eval_legendre, sph_harm_y

from train.studies.accuracy import reference
from train.studies.accuracy.conditions import Row
from train.studies.accuracy.measure import Error, Setup, light
from train.studies.accuracy.reference import exact, extended
from train.studies.accuracy.shapes import sphere
from train.studies.accuracy.study import AccuracySettings, failures, measure, page

ROOT = Path(__file__).parents[3]
REDUCED = {"degree": 6, "subdivisions": 2, "size": 64, "slivers": 1}
DIRECTIONS = np.random.default_rng(0).normal(size=(3, 20))
BOTH = pytest.mark.parametrize("lift", [extended, exact], ids=["extended", "exact"])


@pytest.fixture(scope="module")
def tables():
    return measure(AccuracySettings("", None, **REDUCED))


def rows_by_title(text: str) -> dict[str, int]:
    """The number of rows of each table of a page."""
    return {section.splitlines()[0]: len(re.findall(r"^\| ", section, re.M)) - 2 for section in text.split("\n## ")[1:]}


# ---------------------------------------------------------------------------------------- the table


def test_a_reduced_run_has_a_row_for_each_row_of_the_committed_page(tables):
    text = page(tables)
    committed = rows_by_title((ROOT / "docs" / "accuracy.md").read_text())
    assert rows_by_title(text) == committed
    assert sum(committed.values()) > 40


def test_nothing_is_nan(tables):
    assert failures(tables) == []
    measured, *_ = page(tables).partition("## What is refused")
    assert not re.search(r"\bnan\b|\binf\b|\*\*not finite", measured, re.I)


def test_every_error_is_rounding(tables):
    """A few ε each, more where many terms cancel: thousands of pixels, 49 harmonics."""
    errors = {
        (row.condition, name): error.units
        for rows in tables.values()
        for row in rows
        for name, error in row.errors.items()
    }
    assert {key: units for key, units in errors.items() if not units < 64} == {}


def test_what_is_not_finite_fails_the_script():
    tables = {"Lights": [Row("dark", {"image": Error(math.inf, 1e-7), "gradient": Error(0.5, 1e-7)}, "")]}
    assert failures(tables) == ["dark: image is not finite"]
    assert "| dark | **not finite** | 5,000,000 |  |" in page(tables)


@pytest.mark.slow
def test_the_command_writes_the_page(tmp_path):
    settings = [f"{name}={value}" for name, value in REDUCED.items()]
    command = [sys.executable, str(ROOT / "scripts" / "check_accuracy.py"), f"out={tmp_path}/page.md", *settings]
    done = subprocess.run(command, cwd=ROOT, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    committed = (ROOT / "docs" / "accuracy.md").read_text()
    assert rows_by_title((tmp_path / "page.md").read_text()) == rows_by_title(committed)


# ---------------------------------------------------------------------------------------- the reference


@BOTH
def test_the_references_harmonics_are_scipys_without_the_condon_shortley_sign(lift):
    x, y, z = DIRECTIONS
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    values = reference.basis(lift(DIRECTIONS), 6).astype(float)
    for l in range(7):
        for m in range(-l, l + 1):
            complex_value = sph_harm_y(l, abs(m), polar, azimuth)
            part = complex_value.real if m >= 0 else complex_value.imag
            expected = part * (1 if m == 0 else math.sqrt(2) * (-1) ** m)
            np.testing.assert_allclose(values[:, l * l + l + m], expected, rtol=0, atol=1e-14)  # scipy's own rounding


def test_the_references_clamped_cosine_is_its_integral():
    for l in range(21):
        expected, _ = quad(lambda z, l=l: eval_legendre(l, z) * z, 0, 1)
        assert float(reference.lambertian(l)) == pytest.approx(expected, abs=1e-14)


@BOTH
def test_the_references_basis_gradient_is_its_difference_quotient(lift):
    """Off by the third derivative × step² / 6, some 1e-9, and by the rounding of 1 over the step, 1e-13."""
    directions, step = lift(DIRECTIONS), lift(1e-6)
    gradient = reference.basis_gradient(directions, 6)
    for axis in range(3):
        ahead, behind = (reference.basis(directions + sign * step * reference.AXES[axis], 6) for sign in (1, -1))
        assert abs(gradient[..., axis] - (ahead - behind) / (2 * step)).max() < 1e-8


@BOTH
def test_the_references_gradients_are_those_of_its_image(lift):
    """By the light, in which the image is linear; by the vertices, against a difference quotient (float64 vertices,
    so off by 1e-16 over the step)."""
    rng, mesh = np.random.default_rng(1), sphere(1)
    setup = Setup(mesh, light(), lift=lift)
    view, coefficients = setup.view(), lift(light().numpy())
    upstream, move = lift(rng.normal(size=(len(view.pixels), 3))), rng.normal(size=mesh.vertices.shape)
    by_light = reference.light_gradient(view, upstream, 6)
    loss = (upstream * reference.image(view, coefficients)).sum()
    assert abs((by_light * coefficients).sum() - loss) < 1e-14 * abs(loss)

    ahead, behind = (replace(setup, vertices=mesh.vertices + step * move).view() for step in (1e-6, -1e-6))
    change = reference.image(ahead, coefficients) - reference.image(behind, coefficients)
    gradient = reference.vertex_gradient(view, upstream, coefficients, len(mesh.vertices))
    assert float((gradient * move).sum()) == pytest.approx(float((upstream * change).sum()) / 2e-6, rel=1e-8)
