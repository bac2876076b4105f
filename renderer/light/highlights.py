"""The degree of environment light that highlights need, and errors of highlights at lower degrees.

A highlight is the light that a rough surface reflects specularly toward the
camera (see `renderer.microfacets`). In light with few spherical
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
from jaxtyping import Float
from torch import Tensor

from renderer.light.environment import FEWEST_ROWS, to_map
from renderer.light.harmonics import bands, lambertian_factors
from renderer.light.window import best_window
from renderer.microfacets import SCHLICK, reflectance
from renderer.settings import MAX_DEGREE, MIN_ROUGHNESS

# `required_degree` leaves out the degrees of a light whose amplitude in a highlight
# is at most this fraction of the amplitude of degree 0, by default.
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


@cache
def required_degree(roughness: float, amplitude: float = AMPLITUDE) -> int:
    """Find the degree of environment light that the highlights of a material need.

    The highlight is the specular lobe of a metal for a camera that looks along
    the surface normal. It multiplies the coefficients of degree l of the light by
    an amplitude. All degrees with a larger amplitude than `amplitude` are needed.
    `amplitude` is a fraction of the amplitude of degree 0, and the result is at most
    MAX_DEGREE.
    """
    amplitudes = _amplitudes(max(roughness, MIN_ROUGHNESS), MAX_DEGREE)
    # The amplitudes fall with the degree. If n degrees from 1 on exceed the limit, these
    # are the degrees 1 to n.
    return int(np.count_nonzero(amplitudes[1:] > amplitude))


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
    narrow_amplitudes = torch.from_numpy(_amplitudes(narrow_roughness, degree))
    narrow_lobe = narrow_amplitudes[bands(degree)]
    window = torch.ones(len(coefficients), dtype=torch.float64)
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
    first_of_degree = torch.arange(degree + 1) ** 2
    irradiance = lambertian_factors(degree)[first_of_degree].numpy() / math.pi
    weight = np.hypot(highlight, IRRADIANCE_WEIGHT * irradiance)
    harmonics_per_degree = 2 * np.arange(degree + 1) + 1
    return best_window(highlight, np.sqrt(harmonics_per_degree) * weight)


@cache
def highlight_error(degree: int, roughness: float) -> float:
    """Compute the error of a highlight if a point light is approximated by harmonics.

    The SH coefficients of the point light are cut off at a degree and multiplied
    by `highlight_window` for a highlight that is narrower by the factor NARROWER.
    The highlight is the specular lobe of a metal for a camera that looks along
    the surface normal. The error is the root mean square over all directions, as a fraction
    of that of the highlight.
    """
    amplitudes = _amplitudes(max(roughness, MIN_ROUGHNESS), 4 * MAX_DEGREE)
    window = highlight_window(degree, roughness, NARROWER)
    # The first harmonic of degree l has the index l².
    first_of_degree = np.arange(degree + 1) ** 2
    # Factor of each degree in the approximation. Degrees that are cut off have 0.
    factors = np.zeros_like(amplitudes)
    factors[: degree + 1] = window[first_of_degree].numpy()
    power = (2 * np.arange(len(amplitudes)) + 1) * amplitudes**2
    relative_squared_error = float(power @ (1 - factors) ** 2 / power.sum())
    return math.sqrt(relative_squared_error)


def _amplitudes(roughness: float, degree: int) -> Float[np.ndarray, " degrees"]:
    """Compute by which factor a highlight multiplies SH coefficients of each degree of a light.

    The highlight is the specular lobe of a metal for a camera that looks along
    the surface normal. The lobe is symmetric about the normal, so the factor of
    degree l is the integral of the lobe times the Legendre polynomial P_l. Factors are
    divided by that of degree 0, and at least MIN_AMPLITUDE.
    """
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    node_count = 2**9 + 4 * degree
    # Gauss-Legendre nodes in [-1, 1]. They are mapped to the cosines of angles to the
    # normal in [0, 1], because the lobe is 0 below the surface.
    nodes, weights = np.polynomial.legendre.leggauss(node_count)
    cosine = torch.from_numpy((nodes + 1) / 2)
    sine = (1 - cosine**2).sqrt()
    light = torch.stack([sine, 0 * cosine, cosine], 1)
    roughness_tensor = torch.tensor(roughness, dtype=torch.float64)
    lobe = reflectance(normal, normal, light, roughness_tensor)[SCHLICK] * cosine
    # Legendre polynomials P_0 to P_degree (columns) at each node (rows).
    legendre = np.polynomial.legendre.legvander(cosine.numpy(), degree)
    amplitudes = (weights * lobe.numpy()) @ legendre
    return np.maximum(amplitudes / amplitudes[0], MIN_AMPLITUDE)
