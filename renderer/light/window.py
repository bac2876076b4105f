"""Windows: factors for the SH coefficients of a light that prevent negative radiance.

A light that is cut off at a degree rings: its radiance oscillates around bright
places and becomes negative. A window multiplies the coefficients of band l (the
harmonics of degree l) by a factor w_l. This convolves the light with a kernel

    k(cos θ) = Σ_l (2l + 1) / 4π w_l P_l(cos θ),

with the Legendre polynomials P_l and the angle θ between two directions. If the
kernel is non-negative, a non-negative light stays non-negative. With w_0 = 1,
the light keeps its mean.

`nonnegative_window` computes the non-negative kernel that gives a point source
the smallest error of irradiance, Σ_l (2l + 1) A_l² (1 - w_l)². The factors A_l
of `harmonics.lambertian_factors` are zero for odd l from 3 on. The program uses
half of the smallest positive factor instead of zero, which raises the error by
less than 10⁻⁵ of the error.

This is a convex quadratic program with one constraint for each angle θ. The
exchange method (Hettich and Kortanek 1993, "Semi-infinite programming", section
7) solves the program for some angles, adds the angles at which the kernel is
negative, and repeats.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from numpy.polynomial import legendre
from torch import Tensor

from renderer.light.harmonics import bands, cache_tensors, lambertian_factors

# Largest number of rounds of `best_window`. Each round finds the angles at which the
# lobe is negative, and constrains the lobe there. Eight rounds are usual.
_MAX_ROUNDS = 100
# `best_window` stops if the lobe that it makes non-negative is nowhere below minus this
# fraction of its largest value.
_MAX_DEPTH = 1e-9


@cache_tensors
def nonnegative_window(degree: int) -> Tensor:
    """Compute factors for SH coefficients that keep lights non-negative.

    A physical light becomes negative in some directions if its SH coefficients
    are cut off at a degree. Multiplied by these factors (a window), the cut light
    is non-negative. Of all such windows, this one changes the irradiance of a
    point source least. The root mean square error is 0.17, 0.073 and 0.039 of the
    root mean square irradiance at degrees 6, 12 and 19. The degree is at most 20. The factors in
    [0, 1] are equal within a band, and the first is 1.
    """
    # The first harmonic of band l has the index l².
    first_of_band = np.arange(degree + 1) ** 2
    irradiance_by_band = irradiance_weights(degree)[first_of_band].numpy()
    # The squared coefficients of a point source in band l add up to (2l + 1) / 4π. The
    # weights therefore contain √(2l + 1). The constant factor 4π does not matter.
    weights = np.sqrt(2 * np.arange(degree + 1) + 1) * irradiance_by_band
    return best_window(np.ones(degree + 1), weights)


def best_window(
    spectrum: Float[np.ndarray, " degrees"], weight: Float[np.ndarray, " degrees"]
) -> Tensor:
    """Compute the factors that make a lobe non-negative and change the lobe least.

    A lobe is a function of the angle θ from an axis, Σ_l (2l + 1) s_l P_l(cos θ),
    with the Legendre polynomials P_l. A window multiplies s_l by a factor w_l.
    The best window minimizes Σ_l weight_l² (w_l - 1)² under the condition that the
    windowed lobe Σ_l (2l + 1) s_l w_l P_l(cos θ) is negative at no angle. All s_l must be
    positive. They are 1 for a point source. The result has one factor for each coefficient of a
    light, and the first is 1.
    """
    degree = len(weight) - 1
    if degree == 0:
        return torch.ones(1, dtype=torch.float64)
    # Cosines of the angles at which the windowed lobe must not be negative.
    cosines = np.cos(np.linspace(0, math.pi, 2 * degree + 1))
    for _ in range(_MAX_ROUNDS):
        factors = _best_factors(cosines, weight, spectrum)
        # Legendre coefficients of the windowed lobe.
        series = (2 * np.arange(degree + 1) + 1) * spectrum * factors
        # The minima of the lobe are at roots of its derivative, or at an end.
        stationary = legendre.legroots(legendre.legder(series))
        candidates = np.concatenate([stationary.real.clip(-1, 1), [-1.0, 1.0]])
        lobe_values = legendre.legval(candidates, series)
        negative_cosines = candidates[lobe_values < -_MAX_DEPTH * lobe_values.max()]
        if not len(negative_cosines):
            break
        cosines = np.concatenate([cosines, negative_cosines])
    # The lobe may still be slightly negative. Reducing all factors but the first one moves
    # the lobe toward a constant, which lifts its minimum to 0.
    factors[1:] /= max(1 - lobe_values.min(), 1)
    return torch.from_numpy(factors)[bands(degree)]


@cache_tensors
def irradiance_weights(degree: int) -> Tensor:
    """Compute how strongly each SH coefficient changes the irradiance of a diffuse surface.

    The weight of a coefficient of degree l is |A_l| / A_0. A_l is the factor of
    the coefficient in the irradiance (`lambertian_factors`). If A_l is zero, the
    weight is half of the smallest positive weight up to degree + 1, so that all
    weights are positive.
    """
    # Also compute the factor of degree + 1, because it may be the smallest positive factor.
    factors = lambertian_factors(degree + 1).abs()
    smallest = factors[factors > 0].min()
    weights = factors.clamp(min=smallest / 2) / factors[0]
    return weights[: (degree + 1) ** 2]


def _best_factors(
    cosines: Float[np.ndarray, " N"],
    weight: Float[np.ndarray, " degrees"],
    spectrum: Float[np.ndarray, " degrees"],
) -> Float[np.ndarray, " degrees"]:
    """Compute the factors that make a lobe non-negative at N angles and change it least.

    The lobe is Σ_l (2l + 1) s_l w_l P_l(cos θ) with the factors w_l. Its error is
    Σ_l weight_l² (w_l - 1)². It is the squared length of the vector with the
    entries weight_l (w_l - 1), so the shortest vector is searched. The first factor is 1.
    """
    degree = len(weight) - 1
    # Only imported when it is needed, because it also imports scipy.linalg, which takes
    # 0.1 s.
    from renderer.light.program import shortest

    # Values of (2l + 1) s_l P_l, with one row for each angle and one column for each l.
    terms = legendre.legvander(cosines, degree) * (2 * np.arange(degree + 1) + 1) * spectrum
    # The sum over a row is the value of the lobe at this angle if all factors are 1. The
    # change of the factors must add at least the negative of this value.
    weighted_change = shortest(terms[:, 1:] / weight[1:], -terms.sum(1))
    return np.concatenate([[1.0], 1 + weighted_change / weight[1:]])
