"""The sky against the published formula, integrated by SciPy and by fit_skylight.py."""

import itertools
import math
from functools import partial
from pathlib import Path
from typing import Any

import fit_skylight
import numpy as np
import pytest
import torch
from oracles import relative_error
from safetensors.torch import load_file
from scipy.integrate import cubature
from scipy.spatial.transform import Rotation

from renderer.light import skylight
from renderer.light.harmonics import basis, rotate

ROOT = Path(__file__).parents[3]
FIT = ROOT / "renderer" / "light" / "skylight_fit.safetensors"
EPS = torch.finfo(torch.float64).eps
HORIZON = math.pi / 2
# Zenith angle of the sun and its azimuth in radians, and the turbidity.
SKIES = [(0.9, -2.0, 3.0), (HORIZON, 0.7, 10.0)]
by_quadrature = fit_skylight.coefficients_by_quadrature


def coefficients(zenith: Any, azimuth: Any, turbidity: Any) -> torch.Tensor:
    """Return the coefficients of a sky whose angles are in radians, as in the paper."""
    degrees = 180 / math.pi
    return skylight.coefficients(degrees * zenith, degrees * azimuth, turbidity)


def weighted_sky(angles: np.ndarray, sky: tuple[float, float, float]) -> np.ndarray:
    """Return radiance of the published sky times harmonics (N, 49 · 3) by angles (N, 2)."""
    zenith, azimuth = angles.T
    horizontal = np.sin(zenith) * [np.cos(azimuth), np.sin(azimuth)]
    directions = np.stack([*horizontal, np.cos(zenith)], axis=1)
    sun_zenith, sun_azimuth, turbidity = sky
    sideways = np.sin(zenith) * np.sin(sun_zenith) * np.cos(azimuth - sun_azimuth)
    to_sun = np.arccos(np.clip(sideways + np.cos(zenith) * np.cos(sun_zenith), -1, 1))
    rgb = fit_skylight.radiance(np.cos(zenith), to_sun, sun_zenith, turbidity)
    harmonics = basis(torch.from_numpy(directions), 6).numpy()
    solid_angle = np.sin(angles[:, :1])
    products = (harmonics * solid_angle)[:, :, None] * rgb[:, None, :]
    return products.reshape(len(angles), -1)


@pytest.mark.parametrize("sky", SKIES)
def test_quadrature_agrees_with_adaptive_cubature_of_the_published_formula(sky):
    zenith, azimuth, _ = sky
    # The radiance has a cusp at the sun.
    points = [(zenith, azimuth)] if 0 < zenith < HORIZON else []
    ends = [0, azimuth - math.pi], [HORIZON, azimuth + math.pi]
    options = {"rule": "gk21", "rtol": 1e-6, "atol": 1e-6, "points": points}
    result = cubature(partial(weighted_sky, sky=sky), *ends, **options)
    assert relative_error(by_quadrature(*sky), result.estimate.reshape(49, 3)) < 2e-8


def test_errors_of_the_fit_are_as_documented():
    assert fit_skylight.fit_error(load_file(FIT)["fit"], 10, np.random.default_rng(1)) < 7e-5
    for corner in itertools.product([0.0, HORIZON], [1.0], [2.0, 10.0]):
        assert relative_error(coefficients(*corner), by_quadrature(*corner)) < 4e-4


@pytest.mark.parametrize("sky", [(0.3, 0.0, 2.5), (1.1, 4.0, 7.0), (1.5, 2.0, 9.5)])
def test_the_fit_has_the_derivatives_of_the_quadrature(sky):
    """Central differences with a step of 1e-4 are off by 1e-6."""
    parameters = tuple(torch.tensor(sky, dtype=torch.float64))
    derivatives = torch.autograd.functional.jacobian(coefficients, parameters)
    largest_errors = [1e-3, 1e-3, 5e-3]
    step = 1e-4
    for parameter, largest_error in enumerate(largest_errors):
        offset = step * np.eye(3)[parameter]
        above = by_quadrature(*(np.array(sky) + offset), nodes=24)
        below = by_quadrature(*(np.array(sky) - offset), nodes=24)
        expected = (above - below) / (2 * step)
        assert relative_error(derivatives[parameter], expected) < largest_error


def test_a_new_fit_is_the_committed_one():
    """The first Chebyshev coefficients hardly depend on the degree. Their norm is 140."""
    committed = load_file(FIT)["fit"]
    fit = fit_skylight.fit_polynomials(6, 4, nodes=16)
    torch.testing.assert_close(committed[:7, :5].double(), fit, rtol=0, atol=1e-2)


@pytest.mark.parametrize("azimuth", [0.5, -2.0, 9.0])
def test_the_azimuth_rotates_the_light_counterclockwise(azimuth):
    """The paper prints the opposite sign. The norm of the light is about 60."""
    matrix = Rotation.from_euler("z", azimuth).as_matrix()
    expected = rotate(coefficients(0.8, 0.0, 3.0), torch.from_numpy(matrix))
    found = coefficients(0.8, azimuth, 3.0)
    torch.testing.assert_close(found, expected, rtol=0, atol=100 * 60 * EPS)


def test_autocast_changes_no_bit_of_a_sky():
    expected = skylight.coefficients(50.0, 20.0, 3.0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(skylight.coefficients(50.0, 20.0, 3.0), expected)
