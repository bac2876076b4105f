"""Fit the sky's coefficients with polynomials and print the largest error: python tests/renderer/fit_skylight.py

The model is that of `renderer.light.skylight`, and its coefficients are integrals by Gauss-Legendre quadrature.
"""

import math
import sys

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebpts1, chebvander2d
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from scipy.special import roots_legendre

from renderer.light.harmonics import basis
from renderer.light.skylight import ZENITH, coefficients
from renderer.settings import TURBIDITY

# Preetham et al., appendix A.2: A to E of Perez's formula for Y, x and y, as slope and offset in turbidity.
PEREZ = np.array(
    [
        [(0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)],
        [(-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)],
        [(-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)],
    ]
)
# x and y overhead: a row for each of T², T, 1 and a column for each of θ³, θ², θ, 1.
CHROMATICITY = [
    [[0.00166, -0.00375, 0.00209, 0], [-0.02903, 0.06377, -0.03202, 0.00394], [0.11693, -0.21196, 0.06052, 0.25886]],
    [[0.00275, -0.00610, 0.00317, 0], [-0.04214, 0.08970, -0.04153, 0.00516], [0.15346, -0.26756, 0.06670, 0.26688]],
]
RGB_TO_XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]  # IEC 61966-2-1
DEGREES = (13, 11)  # in the zenith, the paper's, and in 1/turbidity: with the paper's 7 the error is 25 times larger
UPRIGHT = [l * l + l + m for l in range(7) for m in range(l + 1)]  # the 28 coefficients that are fitted


def main(out: str = "renderer/light/skylight_fit.safetensors") -> None:
    """out: the file that the renderer reads, unless another is named as the script's argument."""
    fit = fit_polynomials(*DEGREES).float()
    save_file({"fit": fit}, out)
    error = fit_error(fit, 50, np.random.default_rng(0))
    print(f"{out}: off by up to {error:.1e} of the coefficients' norm on 50 random skies")


def fit_polynomials(zenith_degree: int, turbidity_degree: int, nodes: int = 32) -> torch.Tensor:
    """What `coefficients` evaluates: (zenith_degree + 1, turbidity_degree + 1, 28, 3) float64.

    Chebyshev coefficients, in the zenith and in 1/turbidity, of the sky's coefficients with m = 0..l where the sun is
    at azimuth 0; those with m < 0 vanish by symmetry. Least squares over quadratures of so many nodes at twice as many
    Chebyshev points. The model has a pole at a turbidity of 1.65: polynomials in turbidity itself, of the paper's
    degrees 13 and 7, are off by up to 4 %, those in its inverse by 0.15 %. Monomials would lose float32's digits.
    """
    degrees = zenith_degree, turbidity_degree
    x, y = (grid.ravel() for grid in np.meshgrid(*(chebpts1(2 * (degree + 1)) for degree in degrees)))
    suns = zip(math.pi / 4 * (x + 1), 5 / (y + 1.5), strict=True)  # as `coefficients` maps them to x and y
    skies = np.stack([coefficients_by_quadrature(zenith, 0.0, turbidity, nodes)[UPRIGHT] for zenith, turbidity in suns])
    fit = np.linalg.lstsq(chebvander2d(x, y, degrees), skies.reshape(len(skies), -1))[0]
    return torch.from_numpy(fit).view(zenith_degree + 1, turbidity_degree + 1, len(UPRIGHT), 3)


def fit_error(fit: torch.Tensor, skies: int, rng: np.random.Generator) -> float:
    """The largest error of a fit on random skies, relative to the L2 norm of a sky's coefficients by quadrature."""
    suns = rng.uniform([ZENITH[0], 0, TURBIDITY[0]], [ZENITH[1], 2 * math.pi, TURBIDITY[1]], (skies, 3))
    exact = np.stack([coefficients_by_quadrature(*sun) for sun in suns])
    zenith, azimuth, turbidity = torch.from_numpy(suns.T)
    errors = coefficients(zenith, azimuth, turbidity, fit).numpy() - exact
    return float((np.linalg.norm(errors, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))).max())


def coefficients_by_quadrature(zenith: float, azimuth: float, turbidity: float, nodes: int = 48) -> np.ndarray:
    """(49, 3) coefficients of the sky by quadrature over 4 nodes² directions of the upper hemisphere.

    48 nodes leave an error of up to 2e-8 of the coefficients' norm (in the clearest air with the sun overhead; mostly
    1e-9) and 24 of up to 1e-5. In polar coordinates around the sun, so that the cusp there is an end of the
    integration: whole circles until they touch the horizon, and from there arcs above it, at angles
    π/2 - zenith cos t, in which their length is smooth.
    """
    tilt = max(zenith, 1e-8)  # overhead there are no arcs, and the ratio of the tangents is 0/0
    (u, weights), (v, along) = (((1 + x) / 2, weight / 2) for x, weight in map(roots_legendre, (nodes, 2 * nodes)))
    t, lowest = math.pi * u, math.pi / 2 - tilt
    angles = np.concatenate([lowest * u, math.pi / 2 - tilt * np.cos(t)])[:, None]
    steps = np.concatenate([lowest * weights, tilt * np.sin(t) * math.pi * weights])[:, None]
    arcs = np.concatenate([np.full(nodes, math.pi), np.arccos(-np.tan(tilt * np.cos(t)) / math.tan(tilt))])[:, None]
    solid_angles = np.sin(angles) * steps * 2 * arcs * along
    angles, bearings = np.broadcast_arrays(angles, arcs * (2 * v - 1))  # a bearing of 0 is up
    x, y = -np.sin(angles) * np.cos(bearings), np.sin(angles) * np.sin(bearings)
    around_sun = np.stack([x, y, np.cos(angles)], axis=-1).reshape(-1, 3)
    directions = Rotation.from_euler("yz", [tilt, azimuth]).apply(around_sun)
    sky = radiance(directions[:, 2], angles.ravel(), zenith, turbidity)
    return basis(torch.from_numpy(directions), 6).numpy().T @ (solid_angles.reshape(-1, 1) * sky)


def radiance(cosine: np.ndarray, angle: np.ndarray, zenith: float, turbidity: float) -> np.ndarray:
    """Sky radiance (N, 3), linear RGB in kcd/m², from (N,) cosines of the zenith angle and angles to the sun.

    Saturated skies leave the gamut and are not clamped: around a clear sunset blue falls to -2.6 % of the largest.
    """
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * zenith)
    luminance = (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192
    overhead = [luminance, *(np.polyval([np.polyval(row, zenith) for row in rows], turbidity) for rows in CHROMATICITY)]
    # 1/cos overflows at the horizon; from a cosine of 1e-3 on, its exponential is below 1e-57.
    cosine, angle = np.append(cosine.clip(1e-3), 1), np.append(angle, zenith)  # the last direction is overhead
    a, b, c, d, e = (PEREZ @ [turbidity, 1]).T[:, :, None]
    perez = (1 + a * np.exp(b / cosine)) * (1 + c * np.exp(d * angle) + e * np.cos(angle) ** 2)
    luminance, x, y = np.array(overhead)[:, None] * perez[:, :-1] / perez[:, -1:]
    return (np.stack([x, y, 1 - x - y], axis=1) * (luminance / y)[:, None]) @ np.linalg.inv(RGB_TO_XYZ).T


if __name__ == "__main__":
    main(*sys.argv[1:])
