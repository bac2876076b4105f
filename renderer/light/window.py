"""The window that truncates a light at a degree without ringing.

A window multiplies the coefficients of band l by w_l. This is the convolution
of the light with a kernel, where P_l are the Legendre polynomials and θ is the
angle between two directions:

    k(cos θ) = Σ_l (2l + 1) / 4π w_l P_l(cos θ).

If the kernel is non-negative, a non-negative light stays so. With w_0 = 1, the
light keeps its mean.

Of these kernels, `nonnegative_window` computes the one that gives a point
source the smallest irradiance error, Σ_l (2l + 1) A_l² (1 - w_l)². The factors
A_l of `harmonics.lambertian_factors` are zero in the odd bands from the third
on. Half of the smallest positive factor takes their place, which raises the
error by less than 10⁻⁵ of it.

This is a convex quadratic program with a constraint for each angle. The
exchange method (Hettich and Kortanek 1993, "Semi-infinite programming", section
7) solves it for some angles, adds those at which the kernel is negative, and
repeats.
"""

import math

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor

from renderer.light.harmonics import bands, lambertian_factors, per_degree

# Exchange steps. Eight are usual.
_MAX_ROUNDS = 100
# The kernel may be below zero by this fraction of its largest value.
_MAX_DEPTH = 1e-9


@per_degree
def nonnegative_window(degree: int) -> Tensor:
    """Compute the non-negative window with the smallest irradiance error of a point source.

    The rms error is 0.17, 0.073 and 0.039 of the rms irradiance of the source
    at degrees 6, 12 and 19.

    Args:
        degree: Degree of the light, from 0 to 20.

    Returns:
        Factors in [0, 1] of each coefficient, shape ((degree + 1)²,), float64.
        They are equal within a band, and 1 for the first coefficient.
    """
    first_of_band = np.arange(degree + 1) ** 2
    weights = irradiance_weights(degree)[first_of_band].numpy()
    # A point source has the energy 2l + 1 in band l.
    weights = np.sqrt(2 * np.arange(degree + 1) + 1) * weights
    return best_window(np.ones(degree + 1), weights)


def best_window(spectrum: np.ndarray, weight: np.ndarray) -> Tensor:
    """Compute the window that changes a lobe least and makes it non-negative.

    A lobe is a function of the angle θ from its axis, Σ (2l + 1) s_l P_l(cos θ).
    The window minimizes Σ weight_l² (w_l - 1)² such that
    Σ (2l + 1) s_l w_l P_l is non-negative.

    Args:
        spectrum: Positive factors s_l of the lobe in each band, shape
            (degree + 1,). Ones are the lobe of a point source.
        weight: Weight of w_l - 1 in each band, shape (degree + 1,).

    Returns:
        Factors w_l of each coefficient, shape ((degree + 1)²,), float64. They
        are equal within a band, and 1 for the first coefficient.
    """
    degree = len(weight) - 1
    if degree == 0:
        return torch.ones(1, dtype=torch.float64)
    cosines = np.cos(np.linspace(0, math.pi, 2 * degree + 1))
    for _ in range(_MAX_ROUNDS):
        factors = _best_factors(cosines, weight, spectrum)
        series = (2 * np.arange(degree + 1) + 1) * spectrum * factors
        # The series has its minimum at a root of its derivative or at an end.
        stationary = legendre.legroots(legendre.legder(series))
        candidates = np.concatenate([stationary.real.clip(-1, 1), [-1.0, 1.0]])
        values = legendre.legval(candidates, series)
        negative = candidates[values < -_MAX_DEPTH * values.max()]
        if not len(negative):
            break
        cosines = np.concatenate([cosines, negative])
    # Mixing with the constant kernel 1 lifts what is left below zero.
    factors[1:] /= max(1 - values.min(), 1)
    return torch.from_numpy(factors)[bands(degree)]


@per_degree
def irradiance_weights(degree: int) -> Tensor:
    """Compute the weight of each coefficient in the irradiance, relative to the first one.

    The weights are |A_l| / A_0, with the factors A_l of `lambertian_factors`.
    Where A_l is zero, half of the smallest positive factor up to the next
    degree takes its place.

    Args:
        degree: Degree of the light.

    Returns:
        Positive weights, shape ((degree + 1)²,), float64.
    """
    factors = lambertian_factors(degree + 1).abs()
    smallest = factors[factors > 0].min()
    weights = factors.clamp(min=smallest / 2) / factors[0]
    return weights[: (degree + 1) ** 2]


def _best_factors(cosines: np.ndarray, weight: np.ndarray, spectrum: np.ndarray) -> np.ndarray:
    """Return the factors w_l (degree + 1,) of the best window for N angles.

    The windowed lobe is non-negative at the cosines (N,) of these angles. The
    program is solved for the vector weight (w - 1) without the first band, whose
    length is the error.
    """
    degree = len(weight) - 1
    # The import of scipy.linalg takes a tenth of a second, and few programs need it.
    from renderer.light.program import shortest

    kernel = legendre.legvander(cosines, degree) * (2 * np.arange(degree + 1) + 1) * spectrum
    change = shortest(kernel[:, 1:] / weight[1:], -kernel.sum(1))
    return np.concatenate([[1.0], 1 + change / weight[1:]])
