"""The non-negative window: its constraints, its error, and a search for a better one."""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from scipy import optimize

from renderer.light.harmonics import basis, quadrature
from renderer.light.ringing import (
    NARROWER,
    highlight_window,
    nonnegative_window,
    window_without_ringing,
)

# Error of the irradiance of a point source by degree, from the closed form of the clamped cosine.
ERRORS = {1: 0.59, 2: 0.412, 6: 0.168, 12: 0.0733, 19: 0.0394, 20: 0.0366}


def test_light_whose_narrower_highlights_do_not_ring_keeps_its_coefficients():
    """A point of light under the window for the narrower highlight has no dark rings."""
    degree = 12
    roughness = 0.4
    direction = torch.tensor([[0.3, -0.5, 0.8]], dtype=torch.float64)
    window = highlight_window(degree, roughness, NARROWER)
    point = basis(direction, degree)[0] * window
    point[0] *= 1 + 1e-6
    assert (window_without_ringing(point[:, None], roughness) == 1).all()
    ringing = basis(direction, degree)[0]
    assert (window_without_ringing(ringing[:, None], roughness) != 1).any()


def band_factors(degree: int) -> np.ndarray:
    first_of_band = torch.arange(degree + 1) ** 2
    return nonnegative_window(degree)[first_of_band].numpy()


def kernel(factors: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    return legendre.legval(cosines, (2 * np.arange(len(factors)) + 1) * factors)


def irradiance_error(factors: np.ndarray) -> float:
    """Measure the rms error of the irradiance of a windowed point source, relative to 1 / √6."""
    directions, weights = quadrature(400)
    radiance = torch.from_numpy(kernel(factors, directions[:, 2].numpy())) / (4 * math.pi)
    # The clamped cosine has a kink at 0, so each half has its own nodes.
    node, weight = legendre.leggauss(32)
    cosine = np.append(node - 1, node + 1) / 2
    weight = np.append(weight, weight) / 2
    normals = torch.from_numpy(np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], axis=1))
    irradiance = (normals @ directions.T).clamp(min=0) @ (weights * radiance)
    error = irradiance - normals[:, 2].clamp(min=0)
    mean_square = error.square() @ torch.from_numpy(weight) / 2
    return float((6 * mean_square).sqrt())


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 20])
def test_the_kernel_is_nowhere_negative_and_keeps_the_mean(degree):
    factors = band_factors(degree)
    values = kernel(factors, np.cos(np.linspace(0, math.pi, 20_001)))
    assert values.min() >= -1e-12 * values.max()
    assert factors[0] == 1
    assert ((factors >= 0) & (factors <= 1)).all()
    assert len(nonnegative_window(degree)) == (degree + 1) ** 2


@pytest.mark.parametrize("degree", ERRORS)
def test_the_irradiance_of_a_point_source_has_the_documented_error(degree):
    assert irradiance_error(band_factors(degree)) == pytest.approx(ERRORS[degree], rel=5e-3)


def searched_factors(degree: int) -> np.ndarray:
    """Search for the best window by SciPy, four times.

    A kernel that is nowhere negative is the square of a polynomial, times 1 + z if the degree is
    odd. The search is over the Legendre coefficients of this polynomial.
    """
    node, node_weight = legendre.leggauss(64)
    cosine, weight = legendre.leggauss(400)
    clamped_cosine = legendre.legvander(cosine, degree).T @ (weight * cosine.clip(min=0)) / 2
    energies = 2 * np.arange(degree + 1) + 1

    def factors(values: np.ndarray) -> np.ndarray:
        squared = legendre.legval(node, values) ** 2 * (1 + node * (degree % 2))
        bands = legendre.legvander(node, degree).T @ (node_weight * squared) / 2
        return bands / bands[0]

    def squared_error(values: np.ndarray) -> float:
        return 1e3 * float((energies * (clamped_cosine * (1 - factors(values))) ** 2).sum())

    count = degree // 2 + 1
    starts = np.random.default_rng(0).uniform(0.2, 1, (4, count)) + np.eye(count)[0]
    options = {"ftol": 1e-12, "maxiter": 500}
    results = [
        optimize.minimize(squared_error, start, method="SLSQP", options=options) for start in starts
    ]
    return factors(min(results, key=lambda result: result.fun).x)


@pytest.mark.parametrize("degree", [3, 6])
def test_scipy_finds_no_better_window_that_is_nowhere_negative(degree):
    best_error = irradiance_error(searched_factors(degree))
    assert irradiance_error(band_factors(degree)) <= 1.001 * best_error
