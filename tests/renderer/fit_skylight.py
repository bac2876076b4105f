"""Fit polynomials to the coefficients of the sky.

The script writes the fit that `renderer.light.skylight` reads, and prints its largest error:

    python tests/renderer/fit_skylight.py [FILE]
"""

import math
import sys

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebpts1, chebvander2d
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from scipy.special import roots_sh_legendre

from renderer.light.harmonics import basis
from renderer.light.skylight import coefficients
from renderer.settings import TURBIDITY

# Preetham et al., appendix A.2: the parameters A to E of Perez's formula for the luminance Y, x and
# y, by turbidity T and 1.
PEREZ = [
    [[0.1787, -0.3554, -0.0227, 0.1206, -0.0670], [-1.4630, 0.4275, 5.3251, -2.5771, 0.3703]],
    [[-0.0193, -0.0665, -0.0004, -0.0641, -0.0033], [-0.2592, 0.0008, 0.2125, -0.8989, 0.0452]],
    [[-0.0167, -0.0950, -0.0079, -0.0441, -0.0109], [-0.2608, 0.0092, 0.2102, -1.6537, 0.0529]],
]
# Chromaticities x and y overhead: rows T², T and 1 of the turbidity, and columns θ³, θ², θ and 1 of
# the sun's zenith angle.
ZENITH_X = [
    [0.00166, -0.00375, 0.00209, 0],
    [-0.02903, 0.06377, -0.03202, 0.00394],
    [0.11693, -0.21196, 0.06052, 0.25886],
]
ZENITH_Y = [
    [0.00275, -0.00610, 0.00317, 0],
    [-0.04214, 0.08970, -0.04153, 0.00516],
    [0.15346, -0.26756, 0.06670, 0.26688],
]
# Matrix of IEC 61966-2-1.
RGB_TO_XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
# Degrees in the zenith angle, which is the paper's, and in the inverse of turbidity.
DEGREES = (13, 11)
# Indices of the 28 fitted coefficients, which are those with m >= 0.
UPRIGHT = [l * l + l + m for l in range(7) for m in range(l + 1)]
# The limit keeps 1 / cosine finite at the horizon, where the exponential vanishes.
MIN_COSINE = 1e-3


def main(out: str = "renderer/light/skylight_fit.safetensors") -> None:
    fit = fit_polynomials(*DEGREES).float()
    save_file({"fit": fit}, out)
    error = fit_error(fit, 50, np.random.default_rng(0))
    print(f"{out}: off by up to {error:.1e} of the coefficients' norm on 50 random skies")


def fit_polynomials(zenith_degree: int, turbidity_degree: int, nodes: int = 32) -> torch.Tensor:
    """Fit Chebyshev coefficients (zeniths, turbidities, 28, 3) of skies with the sun at azimuth 0.

    Coefficients with m < 0 vanish by symmetry. The model has a pole at a turbidity of 1.65, so that
    polynomials in the turbidity are off by up to 4%, and polynomials in its inverse by 0.15%.
    """
    zenith_points = chebpts1(2 * (zenith_degree + 1))
    turbidity_points = chebpts1(2 * (turbidity_degree + 1))
    x, y = (grid.ravel() for grid in np.meshgrid(zenith_points, turbidity_points))
    # `renderer.light.skylight.coefficients` maps zenith and turbidity to x and y
    # by the inverse of these formulas.
    zeniths = math.pi / 4 * (x + 1)
    turbidities = 5 / (y + 1.5)
    suns = zip(zeniths, turbidities, strict=True)
    skies = np.stack([coefficients_by_quadrature(z, 0.0, t, nodes)[UPRIGHT] for z, t in suns])
    polynomials = chebvander2d(x, y, (zenith_degree, turbidity_degree))
    [fit, *_] = np.linalg.lstsq(polynomials, skies.reshape(len(skies), -1))
    shape = (zenith_degree + 1, turbidity_degree + 1, len(UPRIGHT), 3)
    return torch.from_numpy(fit).view(shape)


def fit_error(fit: torch.Tensor, skies: int, rng: np.random.Generator) -> float:
    """Return the largest error of a fit on random skies, relative to the sky's L2 norm."""
    lowest = [0, 0, TURBIDITY[0]]
    highest = [math.pi / 2, 2 * math.pi, TURBIDITY[1]]
    suns = rng.uniform(lowest, highest, (skies, 3))
    exact = np.stack([coefficients_by_quadrature(*sun) for sun in suns])
    zenith, azimuth, turbidity = torch.from_numpy(suns.T)
    errors = coefficients(zenith.rad2deg(), azimuth.rad2deg(), turbidity, fit).numpy() - exact
    relative_errors = np.linalg.norm(errors, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    return float(relative_errors.max())


def coefficients_by_quadrature(zenith, azimuth, turbidity, nodes=48) -> np.ndarray:
    """Integrate the sky's radiance times harmonics over the upper hemisphere, shape (49, 3).

    The quadrature has 4 · nodes² directions in polar coordinates around the sun, whose cusp is an
    end of the integration. Circles around the sun are whole until they touch the horizon. From
    there on only arcs count, at angles of π/2 - zenith · cos t. Their length is smooth in t.
    """
    # A sun overhead has no arcs, and the ratio of the tangents would be 0/0.
    tilt = max(zenith, 1e-8)
    # Nodes and weights of Gauss-Legendre quadrature over [0, 1].
    u, u_weights = roots_sh_legendre(nodes)
    v, v_weights = roots_sh_legendre(2 * nodes)
    t = math.pi * u
    horizon_angle = math.pi / 2 - tilt
    arc_angles = math.pi / 2 - tilt * np.cos(t)
    angles = np.concatenate([horizon_angle * u, arc_angles])[:, None]
    arc_steps = tilt * np.sin(t) * math.pi * u_weights
    steps = np.concatenate([horizon_angle * u_weights, arc_steps])[:, None]
    half_arcs = np.arccos(-np.tan(tilt * np.cos(t)) / math.tan(tilt))
    half_widths = np.concatenate([np.full(nodes, math.pi), half_arcs])[:, None]
    solid_angles = np.sin(angles) * steps * 2 * half_widths * v_weights

    # A bearing of 0 is up.
    angles, bearings = np.broadcast_arrays(angles, half_widths * (2 * v - 1))
    x = -np.sin(angles) * np.cos(bearings)
    y = np.sin(angles) * np.sin(bearings)
    around_sun = np.stack([x, y, np.cos(angles)], axis=-1).reshape(-1, 3)
    directions = Rotation.from_euler("yz", [tilt, azimuth]).apply(around_sun)
    sky = radiance(directions[:, 2], angles.ravel(), zenith, turbidity)
    harmonics = basis(torch.from_numpy(directions), 6).numpy()
    return harmonics.T @ (solid_angles.reshape(-1, 1) * sky)


def radiance(cosine: np.ndarray, angle: np.ndarray, zenith: float, turbidity: float) -> np.ndarray:
    """Evaluate the sky's radiance (N, 3) in kcd/m² by cosines to the zenith, and angles to the sun.

    Saturated skies leave the gamut and are not clamped.
    """
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * zenith)
    luminance_overhead = (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192
    powers = zenith ** np.arange(3, -1, -1)
    chromaticities = np.array([turbidity**2, turbidity, 1]) @ [ZENITH_X, ZENITH_Y] @ powers
    overhead = np.append(luminance_overhead, chromaticities)
    # The last direction is straight up.
    cosine = np.append(cosine.clip(MIN_COSINE), 1)
    angle = np.append(angle, zenith)
    a, b, c, d, e = (np.array([turbidity, 1]) @ PEREZ).T[:, :, None]
    gradation = 1 + a * np.exp(b / cosine)
    indicatrix = 1 + c * np.exp(d * angle) + e * np.cos(angle) ** 2
    perez = gradation * indicatrix
    luminance, x, y = overhead[:, None] * perez[:, :-1] / perez[:, -1:]
    chromaticities = np.stack([x, y, 1 - x - y], axis=1)
    xyz = chromaticities * (luminance / y)[:, None]
    return xyz @ np.linalg.inv(RGB_TO_XYZ).T


if __name__ == "__main__":
    main(*sys.argv[1:])
