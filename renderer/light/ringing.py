"""Ringing of lights that are cut off at a degree, and windows that prevent it.

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

A highlight is the light that a rough surface reflects specularly toward the
camera (see `renderer.microfacets`). In light with few spherical harmonics, it is
blurred or rings, too. The amplitude of degree l is the factor by which a specular
lobe multiplies the coefficients of degree l of a light (as the kernel of a
convolution), divided by the factor of degree 0.
"""

import math
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from numpy.polynomial import legendre
from torch import Tensor

from renderer.light.environment import FEWEST_ROWS, to_map
from renderer.light.harmonics import bands, cache_tensors, lambertian_factors
from renderer.microfacets import SCHLICK, reflectance
from renderer.settings import MAX_DEGREE, MIN_ROUGHNESS

# Largest number of rounds of `best_window`. Each round finds the angles at which the
# lobe is negative, and constrains the lobe there. Eight rounds are usual.
_MAX_ROUNDS = 100
# `best_window` stops if the lobe that it makes non-negative is nowhere below minus this
# fraction of its largest value.
_MAX_DEPTH = 1e-9
# `required_degree` leaves out the degrees of a light whose amplitude in a highlight
# is at most this fraction of the amplitude of degree 0.
AMPLITUDE = 0.1
# Highlights at grazing angles are narrower than highlights along the normal.
# `window_without_ringing` therefore also tests a highlight whose width α = roughness² is
# multiplied by this factor.
NARROWER = 0.7
# When `highlight_window` minimizes errors, an error of the irradiance has this many times
# the weight of an error of a highlight.
IRRADIANCE_WEIGHT = 10.0
# Smallest amplitude that `_amplitudes` returns. Other functions divide by amplitudes, so
# these must not be 0.
MIN_AMPLITUDE = 1e-4


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
    irradiance_by_band = irradiance_weights(degree)[np.arange(degree + 1) ** 2].numpy()
    return best_window(np.ones(degree + 1), irradiance_by_band)


def best_window(
    spectrum: Float[np.ndarray, " degrees"], weight: Float[np.ndarray, " degrees"]
) -> Tensor:
    """Compute the factors that make a lobe non-negative and change the lobe least.

    A lobe is a function of the angle θ from an axis, Σ_l (2l + 1) s_l P_l(cos θ),
    with the Legendre polynomials P_l. A window multiplies s_l by a factor w_l.
    The best window minimizes Σ_l (2l + 1) weight_l² (w_l - 1)² under the condition that the
    windowed lobe Σ_l (2l + 1) s_l w_l P_l(cos θ) is negative at no angle. All s_l must be
    positive. They are 1 for a point source. The result has one factor for each coefficient of a
    light, and the first is 1.
    """
    degree = len(weight) - 1
    odd_numbers = 2 * np.arange(degree + 1) + 1
    # The squared coefficients of a point source in band l add up to (2l + 1) / 4π. The constant
    # factor 4π does not matter.
    root_weight = np.sqrt(odd_numbers) * weight
    # Cosines of the angles at which the windowed lobe must not be negative.
    cosines = np.cos(np.linspace(0, math.pi, 2 * degree + 1))
    for _ in range(_MAX_ROUNDS):
        # Values of (2l + 1) s_l P_l, with one row for each angle and one column for each l.
        terms = legendre.legvander(cosines, degree) * odd_numbers * spectrum
        # The sum over a row is the value of the lobe at this angle if all factors are 1. The change
        # of the factors must add at least the negative of this value. The error is the squared
        # length of the vector with the entries root_weight_l (w_l - 1), so the shortest one is
        # searched.
        values = terms.sum(1)
        scale = np.abs(values).max()
        direction, rest, _ = least_distance(terms[:, 1:] / root_weight[1:], -values / scale)
        factors = np.concatenate([[1.0], 1 + direction / rest * scale / root_weight[1:]])
        # Legendre coefficients of the windowed lobe.
        series = odd_numbers * spectrum * factors
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


def least_distance(
    matrix: Float[np.ndarray, "M n"], lower_bounds: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " n"], float, Float[np.ndarray, " M"]]:
    """Find the shortest vector y with `matrix` y ≥ `lower_bounds`, a least distance program.

    Algorithm LDP of Lawson and Hanson (1974, chapter 23) stacks matrixᵀ and the row
    `lower_bounds` to a matrix E, and minimizes |E μ − (0, ..., 0, 1)| over all multipliers μ ≥ 0.
    Then y is matrixᵀ μ divided by the number 1 − `lower_bounds` · μ, which is 0 if no y satisfies
    the inequalities. The bounds should not be much larger than 1. The results are matrixᵀ μ, the
    number and μ.
    """
    # Only imported when it is needed, because it takes 0.2 s.
    from scipy.optimize import nnls

    stacked = np.vstack([matrix.T, lower_bounds])
    target = np.zeros(len(stacked))
    target[-1] = 1
    multipliers, _ = nnls(stacked, target)
    reached = stacked @ multipliers
    return reached[:-1], 1 - reached[-1], multipliers


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
    return (factors.clamp(min=smallest / 2) / factors[0])[: (degree + 1) ** 2]


@cache
def required_degree(roughness: float) -> int:
    """Find the degree of environment light that the highlights of a material need.

    The highlight is the specular lobe of a metal for a camera that looks along
    the surface normal. It multiplies the coefficients of degree l of the light by
    an amplitude. All degrees with a larger amplitude than AMPLITUDE are needed, which is a
    fraction of the amplitude of degree 0. The result is at most MAX_DEGREE.
    """
    amplitudes = _amplitudes(max(roughness, MIN_ROUGHNESS), MAX_DEGREE)
    # The amplitudes fall with the degree. If n degrees from 1 on exceed the limit, these
    # are the degrees 1 to n.
    return int(np.count_nonzero(amplitudes[1:] > AMPLITUDE))


def window_without_ringing(
    coefficients: Float[Tensor, "K C"], roughness: float
) -> Float[Tensor, " K"]:
    """Find factors for the SH coefficients of a map that keep dark rings out of highlights.

    The radiance of few spherical harmonics oscillates around bright places of the
    map. Highlights then get dark rings with negative radiance. A window is a
    factor for each coefficient that prevents this. The function tries no window,
    then the window for a highlight of the surface, and then the window for a
    highlight that is narrower by the factor NARROWER. It returns the first of
    these with which the narrower highlight is negative nowhere. The first factor is 1.
    """
    degree = math.isqrt(len(coefficients)) - 1
    # The square root, because the width of a highlight is α = roughness².
    narrow_roughness = max(roughness, MIN_ROUGHNESS) * math.sqrt(NARROWER)
    narrow_lobe = torch.from_numpy(_amplitudes(narrow_roughness, degree))[bands(degree)]
    window = torch.ones(len(coefficients), dtype=torch.float64)
    # Number of rows of the map on which the sign of the highlight is tested.
    rows = max(FEWEST_ROWS, 2 * degree)
    for width in (1.0, NARROWER):
        # Radiance of the narrower highlight for cameras in all directions.
        highlights = to_map(coefficients * (window * narrow_lobe)[:, None], rows)
        if (highlights >= 0).all():
            break
        window = highlight_window(degree, roughness, width)
    return window


@cache
def highlight_window(degree: int, roughness: float, width: float) -> Tensor:
    """Find factors for SH coefficients of light that keep a highlight non-negative.

    The factors (a window) change the highlight and the irradiance of a point
    light as little as possible. An error of the irradiance has IRRADIANCE_WEIGHT
    times the weight of an error of the highlight. `width` is a factor for the width
    α = roughness² of the highlight. The first factor is 1.
    """
    highlight = _amplitudes(max(roughness, MIN_ROUGHNESS) * math.sqrt(width), degree)
    # The first harmonic of degree l has the index l².
    irradiance = lambertian_factors(degree)[torch.arange(degree + 1) ** 2].numpy() / math.pi
    # The squared errors of the highlight and of the irradiance add up, so the squared weights do,
    # too.
    return best_window(highlight, np.hypot(highlight, IRRADIANCE_WEIGHT * irradiance))


def _amplitudes(roughness: float, degree: int) -> Float[np.ndarray, " degrees"]:
    """Compute by which factor a highlight multiplies SH coefficients of each degree of a light.

    The highlight is the specular lobe of a metal seen along the normal. The factor of degree l is
    the integral of the lobe times the Legendre polynomial P_l, relative to degree 0, and at least
    MIN_AMPLITUDE.
    """
    # The camera looks along the normal, so the result depends only on the angle of the light.
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    # Gauss-Legendre nodes in [-1, 1], more for higher degrees, whose polynomials oscillate faster.
    # They are mapped to the cosines of angles to the normal in [0, 1], because the lobe is 0 below
    # the surface.
    nodes, weights = legendre.leggauss(2**9 + 4 * degree)
    cosine = torch.from_numpy((nodes + 1) / 2)
    # Directions to the light, one for each node, in the plane y = 0.
    light = torch.stack([(1 - cosine**2).sqrt(), 0 * cosine, cosine], 1)
    roughness_tensor = torch.tensor(roughness, dtype=torch.float64)
    # SCHLICK is the term of the reflectance that is multiplied by the color of a metal. The cosine
    # converts the radiance of the light to irradiance.
    lobe = reflectance(normal, normal, light, roughness_tensor)[SCHLICK] * cosine
    # Legendre polynomials P_0 to P_degree (columns) at each node (rows).
    amplitudes = (weights * lobe.numpy()) @ legendre.legvander(cosine.numpy(), degree)
    return np.maximum(amplitudes / amplitudes[0], MIN_AMPLITUDE)
