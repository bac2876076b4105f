import math

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from scipy import optimize

from renderer.light.harmonics import basis, quadrature
from renderer.light.window import nonnegative_window

# By the closed form of the clamped cosine, of a point source's rms irradiance, 1 / √6 (its irradiance is cos θ).
ERRORS = {1: 0.59, 2: 0.412, 4: 0.249, 6: 0.168, 8: 0.1214, 12: 0.0733, 19: 0.0394, 20: 0.0366}


def factors_of(degree: int) -> np.ndarray:
    """(degree + 1,) of each band."""
    return nonnegative_window(degree)[torch.arange(degree + 1) ** 2].numpy()


def kernel(factors: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """The kernel's values, 4π times as large."""
    return legendre.legval(cosines, (2 * np.arange(len(factors)) + 1) * factors)


def irradiance_error(factors: np.ndarray) -> float:
    """That of a point source at the pole, relative and rms over normals, by quadrature of the kernel's radiance."""
    directions, weights = quadrature(400)
    radiance = torch.from_numpy(kernel(factors, directions[:, 2].numpy())) / (4 * math.pi)
    node, weight = legendre.leggauss(32)
    node, weight = np.append(node - 1, node + 1) / 2, np.append(weight, weight) / 2  # the cosine has a kink at 0
    normals = torch.from_numpy(np.stack([np.sqrt(1 - node**2), 0 * node, node], axis=1))
    irradiance = (normals @ directions.T).clamp(min=0) @ (weights * radiance)
    error = irradiance - normals[:, 2].clamp(min=0)
    return float((error.square() @ torch.from_numpy(weight) / 2 * 6).sqrt())


@pytest.mark.parametrize("degree", range(21))
def test_the_window_is_nowhere_negative_and_keeps_the_mean(degree):
    factors = factors_of(degree)
    values = kernel(factors, np.cos(np.linspace(0, math.pi, 20_001)))
    assert factors[0] == 1 and values.min() >= -1e-12 * values.max()
    assert len(nonnegative_window(degree)) == (degree + 1) ** 2
    assert ((factors >= 0) & (factors <= 1)).all()


@pytest.mark.parametrize("degree", ERRORS)
def test_the_irradiance_of_a_point_source_has_the_error_that_is_documented(degree):
    assert irradiance_error(factors_of(degree)) == pytest.approx(ERRORS[degree], rel=5e-3)


@pytest.mark.parametrize("degree", [3, 6, 12])
def test_scipy_finds_no_better_window_that_is_nowhere_negative(degree):
    """By sequential quadratic programming over squares of a polynomial, which are the kernels nowhere negative but for
    a factor 1 ± z; the objective is the quadrature's, so that nothing of the window's own program is used."""
    node, weight = legendre.leggauss(64)
    half = degree // 2
    odd = degree % 2

    def factors(values: np.ndarray) -> np.ndarray:
        squared = legendre.legval(node, values) ** 2 * (1 + node * odd)
        bands = legendre.legvander(node, degree).T @ (weight * squared) / 2
        return bands / bands[0]

    z, weights = legendre.leggauss(400)
    clamped = legendre.legvander(z, degree).T @ (weights * z.clip(min=0)) / 2  # of the cosine, in each band

    def objective(values: np.ndarray) -> float:
        return 1e3 * float(((2 * np.arange(degree + 1) + 1) * clamped**2 * (1 - factors(values)) ** 2).sum())

    found = min(
        (
            optimize.minimize(objective, start, method="SLSQP", options={"ftol": 1e-12, "maxiter": 500}).x
            for start in np.random.default_rng(0).uniform(0.2, 1, (4, half + 1)) + np.eye(half + 1)[0]
        ),
        key=objective,
    )
    assert irradiance_error(factors_of(degree)) <= 1.001 * irradiance_error(factors(found))


@pytest.mark.parametrize("degree", [6, 19])
def test_windowed_coefficients_of_point_sources_stay_nowhere_negative(degree):
    draws = torch.Generator().manual_seed(degree)
    sources = torch.nn.functional.normalize(torch.randn(30, 3, generator=draws, dtype=torch.float64), dim=1)
    powers = torch.rand(30, generator=draws, dtype=torch.float64) ** 4
    light = nonnegative_window(degree) * (powers @ basis(sources, degree))
    radiance = basis(quadrature(100)[0], degree) @ light
    assert radiance.min() >= -1e-12 * radiance.max()
