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
from numpy.typing import ArrayLike
from safetensors.torch import load_file
from scipy.integrate import cubature
from scipy.spatial.transform import Rotation

from renderer.light import skylight
from renderer.light.harmonics import basis, rotate

ROOT = Path(__file__).parents[3]
FIT = ROOT / "renderer" / "light" / "skylight_fit.safetensors"
EPS = torch.finfo(torch.float64).eps
HORIZON = math.pi / 2
# Matrix of IEC 61966-2-1.
RGB_TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
# Zenith angle of the sun and its azimuth in radians, and the turbidity.
SKIES = [(0.9, -2.0, 3.0), (HORIZON, 0.7, 10.0)]
by_quadrature = fit_skylight.coefficients_by_quadrature


def coefficients(zenith: Any, azimuth: Any, turbidity: Any) -> torch.Tensor:
    """Return the coefficients of a sky whose angles are in radians, as in the paper."""
    degrees = 180 / math.pi
    return skylight.coefficients(degrees * zenith, degrees * azimuth, turbidity)


# Matrices of Preetham et al., appendix A.2: the five parameters of Perez's formula by turbidity T
# and 1 (rows), for the luminance Y and the chromaticities x and y.
PEREZ = [
    [[0.1787, -0.3554, -0.0227, 0.1206, -0.0670], [-1.4630, 0.4275, 5.3251, -2.5771, 0.3703]],
    [[-0.0193, -0.0665, -0.0004, -0.0641, -0.0033], [-0.2592, 0.0008, 0.2125, -0.8989, 0.0452]],
    [[-0.0167, -0.0950, -0.0079, -0.0441, -0.0109], [-0.2608, 0.0092, 0.2102, -1.6537, 0.0529]],
]
# Matrices of the chromaticities x and y overhead, by T², T and 1, and powers of the sun's angle.
OVERHEAD = [
    [
        [0.00166, -0.00375, 0.00209, 0],
        [-0.02903, 0.06377, -0.03202, 0.00394],
        [0.11693, -0.21196, 0.06052, 0.25886],
    ],
    [
        [0.00275, -0.00610, 0.00317, 0],
        [-0.04214, 0.08970, -0.04153, 0.00516],
        [0.15346, -0.26756, 0.06670, 0.26688],
    ],
]


def perez(theta: ArrayLike, gamma: ArrayLike, parameters: np.ndarray) -> np.ndarray:
    """Evaluate Perez's formula at an angle from the zenith and one from the sun."""
    a, b, c, d, e = parameters
    gradation = 1 + a * np.exp(b / np.cos(theta))
    indicatrix = 1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2
    return gradation * indicatrix


def published_sky(
    directions: np.ndarray, sun_zenith: float, sun_azimuth: float, t: float
) -> np.ndarray:
    """Evaluate the formulas of Preetham et al., appendix A.2, as printed: XYZ in kcd/m², (N, 3)."""
    theta = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    horizontal = np.sin(theta) * np.sin(sun_zenith) * np.cos(azimuth - sun_azimuth)
    vertical = np.cos(theta) * np.cos(sun_zenith)
    gamma = np.arccos(np.clip(horizontal + vertical, -1, 1))
    chi = (4 / 9 - t / 120) * (np.pi - 2 * sun_zenith)
    luminance_overhead = (4.0453 * t - 4.9710) * np.tan(chi) - 0.2155 * t + 2.4192
    powers = sun_zenith ** np.arange(3, -1, -1)
    chromaticities = np.array([t**2, t, 1]) @ OVERHEAD @ powers
    luminance, x, y = (
        overhead * perez(theta, gamma, parameters) / perez(0, sun_zenith, parameters)
        for overhead, parameters in zip(
            [luminance_overhead, *chromaticities], np.array([t, 1]) @ PEREZ, strict=True
        )
    )
    return np.stack([x / y * luminance, luminance, (1 - x - y) / y * luminance], axis=1)


def sky_parameters(*values: float) -> tuple[torch.Tensor, ...]:
    return tuple(torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in values)


def relative_error(approximate: torch.Tensor, exact: np.ndarray) -> float:
    error = np.asarray(approximate) - exact
    return float(np.linalg.norm(error) / np.linalg.norm(exact))


def weighted_sky(angles: np.ndarray, sky: tuple[float, float, float]) -> np.ndarray:
    """Return radiance of the published sky times harmonics (N, 49 · 3) by angles (N, 2)."""
    zenith, azimuth = angles.T
    horizontal = np.sin(zenith) * [np.cos(azimuth), np.sin(azimuth)]
    directions = np.stack([*horizontal, np.cos(zenith)], axis=1)
    rgb = published_sky(directions, *sky) @ np.linalg.inv(RGB_TO_XYZ).T
    harmonics = basis(torch.from_numpy(directions), 6).numpy()
    solid_angle = np.sin(angles[:, :1])
    products = (harmonics * solid_angle)[:, :, None] * rgb[:, None, :]
    return products.reshape(len(angles), -1)


@pytest.mark.parametrize("sky", SKIES)
def test_quadrature_agrees_with_adaptive_cubature_of_the_published_formula(sky):
    zenith, azimuth, _ = sky
    # The radiance has a cusp at the sun.
    is_sun_inside = 0 < zenith < HORIZON
    result = cubature(
        partial(weighted_sky, sky=sky),
        [0, azimuth - math.pi],
        [HORIZON, azimuth + math.pi],
        rule="gk21",
        rtol=1e-6,
        atol=1e-6,
        points=[(zenith, azimuth)] if is_sun_inside else [],
    )
    assert relative_error(by_quadrature(*sky), result.estimate.reshape(49, 3)) < 2e-8


def test_errors_of_the_fit_are_as_documented():
    fit = load_file(FIT)["fit"]
    assert fit_skylight.fit_error(fit, 10, np.random.default_rng(1)) < 7e-5
    for corner in itertools.product([0.0, HORIZON], [1.0], [2.0, 10.0]):
        assert relative_error(coefficients(*corner), by_quadrature(*corner)) < 4e-4


@pytest.mark.parametrize("sky", [(0.3, 0.0, 2.5), (1.1, 4.0, 7.0), (1.5, 2.0, 9.5)])
def test_the_fit_has_the_derivatives_of_the_quadrature(sky):
    """Central differences with a step of 1e-4 are off by 1e-6."""
    derivatives = torch.autograd.functional.jacobian(coefficients, sky_parameters(*sky))
    largest_errors = [1e-3, 1e-3, 5e-3]
    step = 1e-4
    for parameter, largest_error in enumerate(largest_errors):
        offset = step * np.eye(3)[parameter]
        above = by_quadrature(*(np.array(sky) + offset), nodes=24)
        below = by_quadrature(*(np.array(sky) - offset), nodes=24)
        expected = (above - below) / (2 * step)
        assert relative_error(derivatives[parameter], expected) < largest_error


def test_a_new_fit_is_the_committed_one():
    """The first Chebyshev coefficients hardly depend on the degree of the fit.

    At these points only terms beyond degree 11 alias. A quadrature of 16 nodes is
    off by up to 1e-4 of the norm, which is 140.
    """
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
