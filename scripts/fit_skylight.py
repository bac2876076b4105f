"""Fit the sky's coefficients with polynomials and print the largest error: python scripts/fit_skylight.py

The model is that of `renderer.light.skylight`, and its coefficients are integrals by Gauss-Legendre quadrature.
"""

import math
import sys
from dataclasses import dataclass

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebpts1, chebvander2d
from numpy.polynomial.legendre import leggauss
from safetensors.torch import save

from renderer.errors import InputError
from renderer.light.harmonics import basis
from renderer.light.skylight import TURBIDITY, ZENITH, coefficients
from train.errors import writable_file

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


@dataclass
class Settings:
    out: str = "renderer/light/skylight_fit.safetensors"  # the file that the renderer reads


@cli.command()
def main(settings: Settings) -> None:
    out = writable_file(settings.out, "out")
    if out.suffix != ".safetensors":  # or a mistaken name would cost another file
        raise InputError(f"out={out}: name a .safetensors file")
    fit = fit_polynomials(*DEGREES).float()
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(save({"fit": fit}))
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
    """(49, 3) coefficients of the sky by quadrature over the upper hemisphere.

    48 nodes leave an error of up to 2e-8 of the coefficients' norm (in the clearest air with the sun overhead; mostly
    1e-9) and 24 of up to 1e-5.
    """
    directions, solid_angles = quadrature_around_sun(zenith, azimuth, nodes)
    sky = radiance(directions, zenith, azimuth, turbidity)
    return basis(torch.from_numpy(directions), 6).numpy().T @ (solid_angles[:, None] * sky)


def radiance(directions: np.ndarray, zenith: float, azimuth: float, turbidity: float) -> np.ndarray:
    """Sky radiance (N, 3), linear RGB in kcd/m², from unit directions (N, 3) above the horizon.

    Saturated skies leave the gamut and are not clamped: around a clear sunset blue falls to -2.6 % of the largest.
    """
    sun = polar(zenith, azimuth)
    apart, together = (np.linalg.norm(directions + sign * sun, axis=1) for sign in (-1, 1))
    angle = 2 * np.arctan2(apart, together)  # accurate near the sun, too, unlike the arccosine
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * zenith)
    luminance = (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192
    overhead = [luminance, *(np.polyval([np.polyval(row, zenith) for row in rows], turbidity) for rows in CHROMATICITY)]
    scale = np.array(overhead) / perez(np.ones(1), np.full(1, zenith), turbidity)[:, 0]
    # 1/cos overflows at the horizon; from a cosine of 1e-3 on, its exponential is below 1e-57.
    luminance, x, y = scale[:, None] * perez(directions[:, 2].clip(1e-3), angle, turbidity)
    return (np.stack([x, y, 1 - x - y], axis=1) * (luminance / y)[:, None]) @ np.linalg.inv(RGB_TO_XYZ).T


def perez(cosine: np.ndarray, angle: np.ndarray, turbidity: float) -> np.ndarray:
    """Perez's distribution of Y, x, y (3, N), up to a factor, from the cosine of the zenith angle and the angle to the
    sun, each (N,)."""
    a, b, c, d, e = (PEREZ @ [turbidity, 1]).T[:, :, None]
    return (1 + a * np.exp(b / cosine)) * (1 + c * np.exp(d * angle) + e * np.cos(angle) ** 2)


def polar(zenith: float, azimuth: float) -> np.ndarray:
    """The unit vector (3,) at a polar angle off +z and an azimuth off +x."""
    return np.array([math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth), math.cos(zenith)])


def quadrature_around_sun(zenith: float, azimuth: float, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (4 nodes², 3) above the horizon and their solid angles (4 nodes²,).

    In polar coordinates around the sun, so that the cusp there is an end of the integration: whole circles until they
    touch the horizon, and from there arcs above it, at angles π/2 - zenith cos t, in which their length is smooth.
    """
    zenith = max(zenith, 1e-8)  # overhead there are no arcs, and the ratio of the tangents is 0/0
    (u, weights), (v, along) = (((1 + node) / 2, weight / 2) for node, weight in map(leggauss, (nodes, 2 * nodes)))
    t, lowest = math.pi * u, math.pi / 2 - zenith
    angles = np.concatenate([lowest * u, math.pi / 2 - zenith * np.cos(t)])
    steps = np.concatenate([lowest * weights, zenith * np.sin(t) * math.pi * weights])
    half_arcs = np.concatenate([np.full(nodes, math.pi), np.arccos(-np.tan(zenith * np.cos(t)) / math.tan(zenith))])
    bearings = half_arcs[:, None] * (2 * v - 1)  # 0 is up
    solid_angles = (np.sin(angles) * steps * 2 * half_arcs)[:, None] * along
    sun, up = polar(zenith, azimuth), polar(zenith - math.pi / 2, azimuth)
    around = np.cos(bearings)[..., None] * up + np.sin(bearings)[..., None] * np.cross(sun, up)
    directions = np.cos(angles)[:, None, None] * sun + np.sin(angles)[:, None, None] * around
    return directions.reshape(-1, 3), solid_angles.ravel()


if __name__ == "__main__":
    main()
