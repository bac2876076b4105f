"""The sky's coefficients against the published formula, integrated by scipy and by fit_skylight.py."""

import itertools
import math
import re
from pathlib import Path

import fit_skylight
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.integrate import cubature
from scipy.spatial.transform import Rotation

from renderer.errors import InputError
from renderer.light.harmonics import basis, rotate
from renderer.light.skylight import coefficients

ROOT = Path(__file__).parents[3]
FIT = ROOT / "renderer" / "light" / "skylight_fit.safetensors"
by_quadrature = fit_skylight.coefficients_by_quadrature
EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
HORIZON = math.pi / 2
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
RGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])  # IEC 61966-2-1
SKIES = [(0.0, 0.0, 2.0), (0.9, -2.0, 3.0), (1.5, 100.0, 4.0), (HORIZON, 0.7, 10.0)]


def published_sky(directions: np.ndarray, sun_zenith: float, sun_azimuth: float, t: float) -> np.ndarray:
    """XYZ (N, 3) in kcd/m² as the formulas of Preetham et al., appendix A.2, are printed, in angles."""
    zenith, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    cosine = np.sin(zenith) * np.sin(sun_zenith) * np.cos(azimuth - sun_azimuth) + np.cos(zenith) * np.cos(sun_zenith)
    gamma = np.arccos(np.clip(cosine, -1, 1))

    def distribution(a, b, c, d, e):
        def perez(theta, angle):
            return (1 + a * np.exp(b / np.cos(theta))) * (1 + c * np.exp(d * angle) + e * np.cos(angle) ** 2)

        return perez(zenith, gamma) / perez(0, sun_zenith)

    def chromaticity(squared, linear, constant):
        return sum(t**power * np.polyval(row, sun_zenith) for power, row in enumerate((constant, linear, squared)))

    chi = (4 / 9 - t / 120) * (np.pi - 2 * sun_zenith)
    luminance = ((4.0453 * t - 4.9710) * np.tan(chi) - 0.2155 * t + 2.4192) * distribution(
        0.1787 * t - 1.4630, -0.3554 * t + 0.4275, -0.0227 * t + 5.3251, 0.1206 * t - 2.5771, -0.0670 * t + 0.3703
    )
    x = chromaticity(
        [0.00166, -0.00375, 0.00209, 0], [-0.02903, 0.06377, -0.03202, 0.00394], [0.11693, -0.21196, 0.06052, 0.25886]
    ) * distribution(
        -0.0193 * t - 0.2592, -0.0665 * t + 0.0008, -0.0004 * t + 0.2125, -0.0641 * t - 0.8989, -0.0033 * t + 0.0452
    )
    y = chromaticity(
        [0.00275, -0.00610, 0.00317, 0], [-0.04214, 0.08970, -0.04153, 0.00516], [0.15346, -0.26756, 0.06670, 0.26688]
    ) * distribution(
        -0.0167 * t - 0.2608, -0.0950 * t + 0.0092, -0.0079 * t + 0.2102, -0.0441 * t - 1.6537, -0.0109 * t + 0.0529
    )
    return np.stack([x / y * luminance, luminance, (1 - x - y) / y * luminance], axis=1)


def polar(zenith, azimuth) -> np.ndarray:
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)


def parameters(*values: float) -> tuple[torch.Tensor, ...]:
    return tuple(torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in values)


def relative_error(approximate: torch.Tensor, exact: np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(approximate) - exact) / np.linalg.norm(exact))


def projection(light: torch.Tensor) -> torch.Tensor:
    """Of unit length, so that bounds on the coefficients' norm hold for it."""
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=light.shape))
    return (weights * light).sum() / weights.norm()


@pytest.mark.parametrize("sky", SKIES)
def test_quadrature_agrees_with_adaptive_cubature_of_the_published_formula(sky):
    zenith, azimuth, turbidity = sky

    def integrand(angles: np.ndarray) -> np.ndarray:
        directions = polar(angles[:, 0], angles[:, 1])
        sky_radiance = published_sky(directions, zenith, azimuth, turbidity) @ np.linalg.inv(RGB_TO_XYZ).T
        harmonics = basis(torch.from_numpy(directions), 6).numpy() * np.sin(angles[:, :1])
        return (harmonics[:, :, None] * sky_radiance[:, None, :]).reshape(len(angles), -1)

    middle = [(zenith, azimuth)] if 0 < zenith < HORIZON else []  # the cusp
    limits = [0, azimuth - math.pi], [HORIZON, azimuth + math.pi]
    result = cubature(integrand, *limits, rule="gk21", rtol=1e-6, atol=1e-6, points=middle)
    assert relative_error(by_quadrature(*sky), result.estimate.reshape(49, 3)) < 2e-8


def test_errors_of_quadrature_and_fit_are_as_documented():
    for sky in SKIES:
        exact = by_quadrature(*sky, nodes=96)
        assert relative_error(by_quadrature(*sky, nodes=24), exact) < 1e-5
        assert relative_error(by_quadrature(*sky, nodes=48), exact) < 2e-8
    assert fit_skylight.fit_error(load_file(FIT)["fit"], 10, np.random.default_rng(1)) < 7e-5
    for corner in itertools.product([0.0, HORIZON], [1.0], [2.0, 10.0]):
        assert relative_error(coefficients(*corner), by_quadrature(*corner)) < 4e-4


@pytest.mark.parametrize("sky", [(0.3, 0.0, 2.5), (0.7, 1.0, 3.5), (1.1, 4.0, 7.0), (1.5, 2.0, 9.5)])
def test_the_fit_has_the_derivatives_of_the_quadrature(sky):
    """Central differences of which, with a step of 1e-4, are off by 1e-6."""
    fitted = torch.autograd.functional.jacobian(coefficients, parameters(*sky))
    for parameter, bound in enumerate([1e-3, 1e-3, 5e-3]):
        below, above = (by_quadrature(*(np.array(sky) + h * np.eye(3)[parameter]), nodes=24) for h in (-1e-4, 1e-4))
        assert relative_error(fitted[parameter], (above - below) / 2e-4) < bound


def test_a_new_fit_is_the_committed_one():
    """The first Chebyshev coefficients do not depend on the degree: what aliases at these points is beyond 11."""
    committed, fit = load_file(FIT)["fit"], fit_skylight.fit_polynomials(6, 4, nodes=16)
    # Quadratures of 16 nodes are off by up to 1e-4 of the norm, 140.
    torch.testing.assert_close(committed[:7, :5].double(), fit, rtol=0, atol=1e-2)


@pytest.mark.parametrize("azimuth", [0.5, -2.0, 9.0])
def test_the_azimuth_rotates_the_light(azimuth):
    """By +φ: the paper prints -φ. 100 roundings of a norm of about 60."""
    rotation = torch.from_numpy(Rotation.from_euler("z", azimuth).as_matrix())
    light = coefficients(0.8, azimuth, 3.0)
    torch.testing.assert_close(light, rotate(coefficients(0.8, 0.0, 3.0), rotation), rtol=0, atol=6000 * EPS)
    sun_and_opposite = torch.from_numpy(np.stack([polar(0.8, azimuth), polar(0.8, azimuth + math.pi)]))
    brightness = basis(sun_and_opposite, 6) @ light @ LUMINANCE
    assert brightness[0] > 1.5 * brightness[1]


@pytest.mark.parametrize("sky", [(1e-4, 0.0, 2.5), (0.7, 0.0, 3.0), (1.2, 4.0, 6.0), (HORIZON - 1e-4, 0.0, 4.0)])
def test_gradients_are_those_of_finite_differences(sky):
    assert torch.autograd.gradcheck(lambda *p: projection(coefficients(*p)), parameters(*sky), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("sky", "message"),
    [
        ((0.5, 0.0, 1.99), "turbidity=1.99 is outside the sky model's domain: give 2 to 10"),
        ((-0.01, 0.0, 3.0), "zenith=-0.01 is outside the sky model's domain: give 0 to π/2, with the sun above"),
        ((math.nan, 0.0, 3.0), "zenith=nan is"),
        ((0.5, math.nan, 3.0), "azimuth holds NaN"),
    ],
)
def test_a_sky_outside_the_domain_is_refused_by_name(sky, message):
    for values in (sky, parameters(*sky)):
        with pytest.raises(InputError, match=re.escape(message)):
            coefficients(*values)
