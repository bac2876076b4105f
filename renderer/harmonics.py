"""Real spherical harmonics as polynomials in (x, y, z), and their use for diffuse shading.

Index l² + l + m, m = -l..l. No Condon-Shortley sign: Y₁ = √(3/4π) (y, z, x). The polynomial form has no polar
angles, so it stays exact at the poles, where the paper's (appendix B.1) derivatives are not finite.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

MAX_DEGREE = 20


def basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit vectors.

    directions: (..., 3) unit vectors, floating point. Returns (..., (degree + 1)²) in the same dtype.
    Source: the Legendre recurrences of the paper's appendix B.1 with sin^m θ taken out of P_l^m and put into
    Re and Im of (x + iy)^m.
    """
    _check_degree(degree)
    x, y, z = directions.unbind(-1)
    values = [torch.zeros_like(z)] * (degree + 1) ** 2
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)  # Re and Im of (x + iy)^m
    for m in range(degree + 1):
        for l, legendre in zip(range(m, degree + 1), _legendre(z, m, degree), strict=True):
            if m == 0:
                values[l * l + l] = legendre
            else:
                values[l * l + l + m] = math.sqrt(2) * legendre * cosine
                values[l * l + l - m] = math.sqrt(2) * legendre * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return torch.stack(values, dim=-1)


def _legendre(z: Tensor, m: int, degree: int) -> list[Tensor]:
    """Orthonormal associated Legendre functions over sin^m θ, for l = m..degree, as polynomials in z."""
    start = math.sqrt(math.prod((2 * k + 1) / (2 * k) for k in range(1, m + 1)) / (4 * math.pi))
    values = [torch.full_like(z, start)]
    for l in range(m + 1, degree + 1):
        a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
        value = a * z * values[-1]
        if l > m + 1:
            b = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            value = value - a * b * values[-2]
        values.append(value)
    return values


def lambertian_factors(degree: int) -> Tensor:
    """What a diffuse surface keeps of each band: irradiance = Σ A_l U_lm Y_lm(n). (degree + 1,) float64.

    A_l = π, 2π/3, π/4, 0, -π/24, 0, π/64, ...: the clamped cosine (Ramamoorthi and Hanrahan 2001, equation 8).
    """
    _check_degree(degree)
    factors = torch.zeros(degree + 1, dtype=torch.float64)
    factors[:2] = torch.tensor([math.pi, 2 * math.pi / 3], dtype=torch.float64)[: degree + 1]
    for l in range(2, degree + 1, 2):
        ratio = math.comb(l, l // 2) / 2.0**l
        factors[l] = 2 * math.pi * (-1) ** (l // 2 - 1) / ((l + 2) * (l - 1)) * ratio
    return factors


def live_coefficients(degree: int) -> Tensor:
    """Indices of the coefficients that can reach a diffuse surface: 31 of the 49 at degree 6."""
    bands = torch.arange(degree + 1).repeat_interleave(2 * torch.arange(degree + 1) + 1)
    return torch.nonzero(lambertian_factors(degree)[bands]).squeeze(1)


def irradiance_basis(normals: Tensor, degree: int) -> Tensor:
    """A_l Y_lm(n) of the live coefficients: irradiance at unit normals per unit coefficient.

    normals: (..., 3). Returns (..., K), K = len(live_coefficients(degree)).
    """
    live = live_coefficients(degree)
    bands = live.to(torch.float64).sqrt().floor().long()
    factors = lambertian_factors(degree)[bands].to(normals)
    return basis(normals, degree)[..., live.to(normals.device)] * factors


def quadrature(degree: int) -> tuple[Tensor, Tensor]:
    """Directions (N, 3) and weights (N,) that integrate polynomials of this degree exactly over the sphere.

    Gauss-Legendre in z and equal steps in azimuth, float64; the weights sum to 4π.
    """
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuth = 2 * np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    radius = np.sqrt(1 - z**2)[:, None]
    grid = [radius * np.cos(azimuth), radius * np.sin(azimuth), np.broadcast_to(z[:, None], (len(z), len(azimuth)))]
    weights = np.repeat(weight * 2 * np.pi / len(azimuth), len(azimuth))
    return torch.from_numpy(np.stack(grid, -1).reshape(-1, 3)), torch.from_numpy(weights)


def equirectangular(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Directions (H, W, 3) and solid angles (H, W) of an environment map's texels, float64.

    Row 0 is up (+z); the middle column faces +x and azimuth grows to the left, as seen from inside.
    """
    edges = torch.cos(math.pi * torch.arange(height + 1, dtype=torch.float64) / height)
    z = (edges[:-1] + edges[1:]) / 2  # the mean of z over a row's solid angle
    azimuth = math.pi - 2 * math.pi * (torch.arange(width, dtype=torch.float64) + 0.5) / width
    radius = (1 - z**2).sqrt()[:, None]
    directions = [radius * azimuth.cos(), radius * azimuth.sin(), z[:, None].expand(height, width)]
    solid_angles = (edges[:-1] - edges[1:]) * (2 * math.pi / width)
    return torch.stack(directions, dim=-1), solid_angles[:, None].expand(height, width)


def project(radiance: Callable[[Tensor], Tensor] | Tensor, degree: int, quadrature_degree: int = 128) -> Tensor:
    """Coefficients ((degree + 1)², C) float64 of light on the sphere.

    radiance: a function of directions (N, 3) float64 → (N, C), integrated by `quadrature`, exactly where it is a
    polynomial of degree `quadrature_degree - degree`; or an environment map (H, W, C) laid out by `equirectangular`.
    """
    if callable(radiance):
        directions, weights = quadrature(quadrature_degree)
        return basis(directions, degree).T @ (weights[:, None] * radiance(directions).to(torch.float64))
    grid = zip(*equirectangular(*radiance.shape[:2]), radiance, strict=True)  # by rows: maps may have 10⁸ texels
    return sum(basis(row, degree).T @ (weights[:, None] * texels.to(row)) for row, weights, texels in grid)


def rotate(coefficients: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients of the light turned by a rotation: u'(ω) = u(Rᵀω).

    coefficients: ((degree + 1)², C). rotation: (3, 3) orthonormal. Exact: the integrand is a polynomial.
    """
    degree = math.isqrt(len(coefficients)) - 1
    turned = project(
        lambda directions: basis(directions @ rotation.to(torch.float64), degree) @ coefficients.to(torch.float64),
        degree,
        quadrature_degree=2 * degree,
    )
    return turned.to(coefficients)


def _check_degree(degree: int) -> None:
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"harmonics of degree {degree}: degrees 0 to {MAX_DEGREE} are supported")
