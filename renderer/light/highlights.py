"""The degree of environment light that highlights need, and errors of highlights at lower degrees.

A highlight is the light that a rough surface reflects specularly toward the
camera (see `renderer.surface.microfacets`). In light with few spherical
harmonics, a highlight is blurred, or it rings: there are dark rings or negative
radiance around it.

The amplitude of degree l is the factor by which a specular lobe multiplies the
coefficients of degree l of a light (as the kernel of a convolution), divided by
the factor of degree 0.
"""

import math
from functools import cache

import numpy as np
import torch
from torch import Tensor

from renderer.light.environment import FEWEST_ROWS, to_map
from renderer.light.harmonics import bands, lambertian_factors
from renderer.light.window import best_window
from renderer.settings import MAX_DEGREE, MIN_ROUGHNESS
from renderer.surface.microfacets import SCHLICK, reflectance

# Default of `required_degree`: a light does not need the degrees whose amplitude in a
# highlight is at most this fraction of the amplitude of degree 0.
AMPLITUDE = 0.1
# Factor for the width α = roughness² of a highlight. `window_without_ringing` also tests
# a highlight that is narrower by this factor, because highlights at grazing angles are
# narrower than those along the normal.
NARROWER = 0.7
# `highlight_window` weighs an error of the irradiance this many times as much as an error
# of a highlight.
IRRADIANCE = 10.0
# Smallest amplitude that `_spectrum` returns. Windows are computed by dividing by
# amplitudes, so these must not be 0.
SMALLEST = 1e-4


@cache
def required_degree(roughness: float, amplitude: float = AMPLITUDE) -> int:
    """Find the smallest spherical-harmonic degree that shows the highlights of a material.

    The highlight is the lobe of a metal for a camera that looks along the
    normal. No higher degree has more than the given amplitude in it.

    Args:
        roughness: Roughness in [0, 1]. Values below MIN_ROUGHNESS count as MIN_ROUGHNESS.
        amplitude: Largest amplitude of the degrees that are left out, as a
            fraction of the amplitude of degree 0.

    Returns:
        Degree, at most MAX_DEGREE.
    """
    amplitudes = _spectrum(max(roughness, MIN_ROUGHNESS), MAX_DEGREE)
    # The amplitudes fall with the degree. The number of degrees from 1 on that exceed the
    # limit is therefore the last such degree.
    return int(np.count_nonzero(amplitudes[1:] > amplitude))


def window_without_ringing(coefficients: Tensor, roughness: float) -> Tensor:
    """Find factors for the coefficients of a map, under which its highlights do not ring.

    An environment map with few spherical harmonics oscillates around its
    bright places. Highlights then have dark rings or negative radiance. This
    function tries no window, then the window for the highlight of the surface,
    and then the window for a highlight that is narrower by the factor NARROWER.
    It returns the first one under which the narrower highlight is negative
    nowhere.

    Args:
        coefficients: Spherical-harmonic coefficients of the map,
            shape (K, C) with K = (degree + 1)² and C channels.
        roughness: Roughness of the smoothest surface, in [0, 1]. Values below
            MIN_ROUGHNESS count as MIN_ROUGHNESS.

    Returns:
        Factor of each coefficient, float64, shape (K,). The first is 1.
    """
    degree = math.isqrt(len(coefficients)) - 1
    # The width of a lobe is α = roughness².
    narrow_roughness = max(roughness, MIN_ROUGHNESS) * math.sqrt(NARROWER)
    narrow_amplitudes = torch.from_numpy(_spectrum(narrow_roughness, degree))
    narrow_lobe = narrow_amplitudes[bands(degree)]
    window = torch.ones(len(coefficients), dtype=torch.float64)
    rows = max(FEWEST_ROWS, 2 * degree)
    for width in (1.0, NARROWER):
        highlights = to_map(coefficients * (window * narrow_lobe)[:, None], rows)
        if (highlights >= 0).all():
            break
        window = highlight_window(degree, roughness, width)
    return window


@cache
def highlight_window(degree: int, roughness: float, width: float) -> Tensor:
    """Find the best factors for coefficients, under which a highlight is negative nowhere.

    The window minimizes the errors of highlights and of irradiance (see
    `best_window`). An error of irradiance weighs IRRADIANCE times as much.

    Args:
        degree: Degree of the lighting.
        roughness: Roughness of the smoothest surface, in [0, 1]. Values below
            MIN_ROUGHNESS count as MIN_ROUGHNESS.
        width: Width α of the highlight, as a fraction of the width for this
            roughness.

    Returns:
        Factor of each coefficient, float64, shape ((degree + 1)²,). The first
        is 1.
    """
    highlight = _spectrum(max(roughness, MIN_ROUGHNESS) * math.sqrt(width), degree)
    # The first harmonic of degree l has the index l².
    first_of_degree = torch.arange(degree + 1) ** 2
    irradiance = lambertian_factors(degree)[first_of_degree].numpy() / math.pi
    weight = np.hypot(highlight, IRRADIANCE * irradiance)
    harmonics_per_degree = 2 * np.arange(degree + 1) + 1
    return best_window(highlight, np.sqrt(harmonics_per_degree) * weight)


@cache
def highlight_error(degree: int, roughness: float) -> float:
    """Compute the error of the highlight of a point light under `highlight_window`.

    The highlight is the lobe of a metal for a camera that looks along the
    normal. The window is the one for a narrower highlight (see NARROWER).

    Args:
        degree: Degree of the lighting.
        roughness: Roughness of the surface, in [0, 1]. Values below MIN_ROUGHNESS count
            as MIN_ROUGHNESS.

    Returns:
        Root mean square error over all directions, as a fraction of the root
        mean square of the highlight.
    """
    amplitudes = _spectrum(max(roughness, MIN_ROUGHNESS), 4 * MAX_DEGREE)
    window = highlight_window(degree, roughness, NARROWER)
    first_of_degree = np.arange(degree + 1) ** 2
    kept = np.zeros_like(amplitudes)
    kept[: degree + 1] = window[first_of_degree].numpy()
    power = (2 * np.arange(len(amplitudes)) + 1) * amplitudes**2
    lost_power = float(power @ (1 - kept) ** 2 / power.sum())
    return math.sqrt(lost_power)


def _spectrum(roughness: float, degree: int) -> np.ndarray:
    """Compute the amplitude of each degree l in a highlight, relative to degree 0.

    The highlight is the lobe with the term SCHLICK for a camera that looks
    along the normal. It is symmetric about the normal, so its coefficient of
    degree l is an integral with the Legendre polynomial P_l.

    Args:
        roughness: Roughness of the surface.
        degree: Largest degree l.

    Returns:
        Amplitudes, at least SMALLEST, float64, shape (degree + 1,).
    """
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    node_count = 2**9 + 4 * degree
    # Gauss-Legendre nodes in [-1, 1]. The lobe is 0 below the surface, so that the cosine
    # of the angle to the normal only covers [0, 1].
    nodes, weights = np.polynomial.legendre.leggauss(node_count)
    cosine = torch.from_numpy((nodes + 1) / 2)
    sine = (1 - cosine**2).sqrt()
    light = torch.stack([sine, 0 * cosine, cosine], 1)
    roughness_tensor = torch.tensor(roughness, dtype=torch.float64)
    lobe = reflectance(normal, normal, light, roughness_tensor)[SCHLICK] * cosine
    # P_l at each node, shape (nodes, degree + 1).
    legendre = np.polynomial.legendre.legvander(cosine.numpy(), degree)
    amplitudes = (weights * lobe.numpy()) @ legendre
    return np.maximum(amplitudes / amplitudes[0], SMALLEST)
