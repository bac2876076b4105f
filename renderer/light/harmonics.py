"""Real spherical harmonics as polynomials in (x, y, z), and their use for diffuse shading.

Index l² + l + m, m = -l..l. No Condon-Shortley sign: Y₁ = √(3/4π) (y, z, x). The polynomial form has no polar
angles, so it stays exact at the poles, where the paper's (appendix B.1) derivatives are not finite.

>>> up, degree = torch.tensor([0.0, 0.0, 1.0]), 1
>>> [round(value, 4) for value in basis(up, degree).tolist()]  # Y₀₀, then y, z, x
[0.2821, 0.0, 0.4886, 0.0]
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import InputError, require_finite, require_range
from renderer.settings import MAX_DEGREE
from renderer.validation import as_tensor, require_whole
from renderer.vectors import unit

if TYPE_CHECKING:
    from jaxtyping import Float, Float64, Int

MAX_QUADRATURE = 10**4  # degree of a quadrature, whose directions are as many as its square
MAX_TEXELS = 10**6  # texels on a side of an environment map
ORTHONORMAL = 1e-3  # largest error of a product of rotation and its inverse, also of one that is written by hand
DIFFUSE_DEGREE = 20  # of what reaches diffuse surfaces; the bands above are worth 0.015 of a beam's irradiance at most
Constant = TypeVar("Constant")


def per_degree(function: Callable[..., Constant]) -> Callable[..., Constant]:
    """Computed once per degree (and dtype and device), and usable in training even if first asked for in inference
    mode."""
    return cache(torch.inference_mode(False)(function))


def degree_of(light: Float[Tensor, "coefficients 3"]) -> int:
    """The degree of a light's coefficients. InputError: no degree has that many."""
    light = as_tensor("light", light)
    degree = math.isqrt(len(light)) - 1 if light.ndim == 2 else -1
    if degree < 0 or light.shape != ((degree + 1) ** 2, 3):
        raise InputError(f"light has shape {tuple(light.shape)}: give ((degree + 1)², 3) coefficients")
    return degree


def basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch coefficients"]:
    """Real spherical harmonics of directions; differentiable once. (degree + 1)² values each, in the same dtype.

    directions: finite and of any length, since only the direction counts; a zero vector, which has none, gives finite
    values and a gradient of zero. Computed in float64. InputError: NaN, a degree out of range.
    Source: the Legendre recurrences of the paper's appendix B.1 with sin^m θ taken out of P_l^m and put into
    Re and Im of (x + iy)^m.
    """
    require_degree(degree)
    directions = as_tensor("directions", directions)
    if not directions.ndim or directions.shape[-1] != 3:
        raise InputError(f"directions has shape {tuple(directions.shape)}: give (..., 3)")
    require_finite(directions=directions)
    rows = select_rows(unit(directions.double().movedim(-1, 0)), range((degree + 1) ** 2))
    return torch.stack(rows, dim=-1).to(directions.dtype)


def require_degree(degree: int) -> None:
    """InputError unless it is a whole number in the range of degrees."""
    require_whole("degree", degree)
    require_range("degree", degree, 0, MAX_DEGREE)


def select_rows(directions: Tensor, indices: Iterable[int]) -> list[Tensor]:
    """The harmonics with these indices, (...) each, of unit vectors (3, ...): `basis` for inner loops, unchecked."""
    x, y, z = directions
    indices, rows = dict.fromkeys(indices), {}
    degree = math.isqrt(max(indices, default=0))
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)  # Re and Im of (x + iy)^m, times √2 where m > 0
    for m in range(degree + 1):
        for l, legendre in zip(range(m, degree + 1), _legendre(z, m, degree), strict=True):
            if l * l + l + m in indices:
                rows[l * l + l + m] = cosine * legendre
            if m and l * l + l - m in indices:
                rows[l * l + l - m] = sine * legendre
        if m == degree:
            break
        if m == 0:
            cosine = cosine * math.sqrt(2)
        cosine, sine = (torch.addcmul(x * cosine, y, sine, value=-1), torch.addcmul(x * sine, y, cosine))
    return [rows[index] for index in indices]


def _legendre(z: Tensor, m: int, degree: int) -> Iterator[Tensor | float]:
    """Yield the orthonormal associated Legendre functions over sin^m θ, for l = m..degree, as polynomials in z.

    The first is a constant. It is yielded as a number, which is faster than a tensor of equal entries.
    """
    constant = math.sqrt(math.prod((2 * k + 1) / (2 * k) for k in range(1, m + 1)) / (4 * math.pi))
    yield constant
    before = z.new_tensor(constant)
    value = z * math.sqrt(2 * m + 3) * constant
    for l in range(m + 1, degree + 1):
        if l > m + 1:
            a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
            b = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            before, value = value, torch.addcmul(before * (-a * b), z, value, value=a)
        yield value


@per_degree
def gradient_matrices(degree: int) -> Tensor:
    """(3, (degree + 1)², (degree + 1)²) float64: ∂(r^l Y_k)/∂x_d = Σ_j r^(l-1) Y_j [d, j, k], for k in band l.
    Source: the ladder operators of solid harmonics, in real form and without the Condon-Shortley sign."""
    matrices = torch.zeros(3, (degree + 1) ** 2, (degree + 1) ** 2, dtype=torch.float64)
    for l in range(1, degree + 1):
        below, norm = (l - 1) * l, (2 * l + 1) / (2 * l - 1)  # `below`: the index of m = 0 in band l - 1
        for m in range(l + 1):
            down = math.sqrt(norm * (l + m) * (l + m - 1)) / 2 * (math.sqrt(2) if m == 1 else 1)
            up = math.sqrt(norm * (l - m) * (l - m - 1)) / 2 * (math.sqrt(2) if m == 0 else 1)
            cosine, sine = l * l + l + m, l * l + l - m
            if m < l:
                matrices[2, below + m, cosine] = matrices[2, below - m, sine] = math.sqrt(norm * (l * l - m * m))
            if m + 1 < l:
                matrices[0, below + m + 1, cosine] = matrices[1, below - m - 1, cosine] = -up
            if m + 1 < l and m > 0:
                matrices[0, below - m - 1, sine], matrices[1, below + m + 1, sine] = -up, up
            if m > 0:
                matrices[0, below + m - 1, cosine] = matrices[1, below + m - 1, sine] = down
            if m > 1:
                matrices[0, below - m + 1, sine], matrices[1, below - m + 1, cosine] = down, -down
    return matrices


@per_degree
def homogeneous_gradients(degree: int) -> Tensor:
    """(3, (degree + 1)², (degree + 1)²) float64: ∂(r^degree Y_k)/∂x_d = Σ_j r^(degree - 1) Y_j [d, j, k], for k in the
    bands of the degree's parity, which r^degree makes homogeneous polynomials.

    The gradient's product with x is `degree` times such a polynomial (Euler), so that one sum over j gives both.
    Source: of x_d Y_k, the part in band l - 1 is ∂(r^l Y_k)/∂x_d / (2l + 1), and by symmetry the one in band l + 1 is
    the transposed.
    """
    solid, l = gradient_matrices(degree), bands(degree)
    down = solid / (2 * l + 1)
    return solid + (degree - l) * (down + down.mT)


@per_degree
def monomial_coefficients(degree: int) -> Tensor:
    """(J, (degree + 1)²) float64: r^degree Y_k = Σ_j [j, k] × `monomials` j, for k in the bands of the degree's parity.
    Each by derivatives: that of x^a y^b z^c is ∂^degree / (∂x^a ∂y^b ∂z^c) / (a! b! c!)."""
    if degree == 0:
        return torch.full((1, 1), 1 / math.sqrt(4 * math.pi), dtype=torch.float64)
    below = monomial_coefficients(degree - 1)
    along_x, along_y, along_z = below @ homogeneous_gradients(degree)[:, : below.shape[1]]
    powers = torch.tensor([a or b or degree for a in range(degree, -1, -1) for b in range(degree - a, -1, -1)])
    return torch.cat([along_x, along_y[-degree:], along_z[-1:]]) / powers[:, None]  # in the order of `monomials`


def monomials(vectors: Tensor, degree: int) -> Tensor:
    """((degree + 1)(degree + 2) / 2, N): x^a y^b z^c with a + b + c = degree, from x^degree to z^degree, of (3, N)."""
    x, y, z = vectors
    products = torch.ones_like(vectors[:1])
    for power in range(1, degree + 1):
        before, count = products, len(products)
        products = vectors.new_empty(count + power + 1, vectors.shape[1])
        torch.mul(before, x, out=products[:count])
        torch.mul(before[count - power :], y, out=products[count:-1])  # those without x
        torch.mul(before[-1], z, out=products[-1])
    return products


@per_degree
def bands(degree: int) -> Int[Tensor, " coefficients"]:
    """The band l of each coefficient."""
    return torch.arange(degree + 1).repeat_interleave(2 * torch.arange(degree + 1) + 1)


@per_degree
def lambertian_factors(degree: int) -> Float64[Tensor, " coefficients"]:
    """What a diffuse surface keeps of each coefficient: irradiance = Σ A_l U_lm Y_lm(n).

    A_l = π, 2π/3, π/4, 0, -π/24, 0, π/64, ...: the clamped cosine (Ramamoorthi and Hanrahan 2001, equation 8). Those
    beyond `DIFFUSE_DEGREE` are taken for zero.
    """
    factors = [math.pi, 2 * math.pi / 3, *[0.0] * (degree - 1)]
    for l in range(2, min(degree, DIFFUSE_DEGREE) + 1):
        even = 2 * math.pi * (-1) ** (l // 2 - 1) / ((l + 2) * (l - 1)) * (math.comb(l, l // 2) / 2.0**l)
        factors[l] = 0.0 if l % 2 else even
    return torch.tensor(factors, dtype=torch.float64)[bands(degree)]


@per_degree
def nonzero_coefficients(degree: int) -> Int[Tensor, " K"]:
    """Indices of the coefficients that can reach a diffuse surface: 31 of the 49 at degree 6."""
    return torch.nonzero(lambertian_factors(degree)).squeeze(1)


def irradiance_error(lights: Float[Tensor, "*batch K channels"], given: Float[Tensor, "*batch J channels"]) -> Tensor:
    """Compute by how much irradiance differs: rms over normals and channels, relative to the rms irradiance given.

    Args:
        lights: Coefficients of lights, shape (..., (degree + 1)², C).
        given: What they stand for, of as many channels; its degree may be another.

    Returns:
        Errors of shape (...), float64; 0 where both are dark.
    """
    size = max(lights.shape[-2], given.shape[-2])
    factors = lambertian_factors(math.isqrt(size) - 1)[:, None].to(given.device)
    after, before = (F.pad(light.double(), (0, 0, 0, size - light.shape[-2])) * factors for light in (lights, given))
    error, norm = (light.square().sum((-2, -1)).sqrt() for light in (after - before, before))
    return torch.where(error > 0, error / norm, error)


def quadrature(degree: int) -> tuple[Float64[Tensor, "N 3"], Float64[Tensor, " N"]]:
    """Directions and weights that integrate polynomials of this degree exactly over the sphere.

    Gauss-Legendre in z and equal steps in azimuth; the weights sum to 4π.
    """
    require_whole("degree", degree)
    require_range("degree", degree, 0, MAX_QUADRATURE)
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuth = 2 * np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    radius = np.sqrt(1 - z**2)[:, None]
    grid = [radius * np.cos(azimuth), radius * np.sin(azimuth), np.broadcast_to(z[:, None], (len(z), len(azimuth)))]
    weights = np.repeat(weight * 2 * np.pi / len(azimuth), len(azimuth))
    return torch.from_numpy(np.stack(grid, -1).reshape(-1, 3)), torch.from_numpy(weights)


def equirectangular(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Directions (height, width, 3) and solid angles (height, width) of an environment map's texels, float64.

    Row 0 is up (+z); the middle column faces +x and azimuth grows to the left, as seen from inside.
    """
    for name, count in (("height", height), ("width", width)):
        require_whole(name, count)
        require_range(name, count, 1, MAX_TEXELS)
    edges = torch.cos(math.pi * torch.arange(height + 1, dtype=torch.float64) / height)
    z = (edges[:-1] + edges[1:]) / 2  # the mean of z over a row's solid angle
    azimuth = math.pi - 2 * math.pi * (torch.arange(width, dtype=torch.float64) + 0.5) / width
    radius = (1 - z**2).sqrt()[:, None]
    directions = [radius * azimuth.cos(), radius * azimuth.sin(), z[:, None].expand(height, width)]
    solid_angles = (edges[:-1] - edges[1:]) * (2 * math.pi / width)
    return torch.stack(directions, dim=-1), solid_angles[:, None].expand(height, width)


def project(
    radiance: Callable[[Tensor], Tensor] | Float[Tensor, "height width channels"],
    degree: int,
    quadrature_degree: int = 128,
) -> Float64[Tensor, "coefficients channels"]:
    """Coefficients of light on the sphere.

    radiance: a function of directions (N, 3) float64 → (N, channels), integrated by `quadrature`, exactly where it is a
    polynomial of degree `quadrature_degree - degree`; or an environment map laid out by `equirectangular`.
    """
    require_degree(degree)
    if not callable(radiance):
        radiance = as_tensor("radiance", radiance)
        if radiance.ndim != 3:
            raise InputError(f"radiance has shape {tuple(radiance.shape)}: give a map (height, width, channels)")
        require_finite(radiance=radiance)
        grid = zip(*equirectangular(*radiance.shape[:2]), radiance, strict=True)  # by rows: maps may have 10⁸ texels
        return sum(basis(row, degree).T @ (weights[:, None] * texels.to(row)) for row, weights, texels in grid)
    directions, weights = quadrature(quadrature_degree)
    values = as_tensor("radiance", radiance(directions)).to(torch.float64)
    require_finite(radiance=values)
    return basis(directions, degree).T @ (weights[:, None] * values)


def rotate(coefficients: Tensor, rotation: Float[Tensor, "3 3"]) -> Tensor:
    """Coefficients ((degree + 1)², channels) of the light turned by a rotation: u'(ω) = u(Rᵀω).

    rotation: orthonormal. Exact: the integrand is a polynomial. InputError: NaN, a number of coefficients that no
    degree has, a matrix that does not rotate.
    """
    coefficients, rotation = as_tensor("coefficients", coefficients), as_tensor("rotation", rotation)
    require_finite(coefficients=coefficients, rotation=rotation)
    degree = math.isqrt(len(coefficients)) - 1 if coefficients.ndim == 2 else -1
    if degree < 0 or len(coefficients) != (degree + 1) ** 2:
        raise InputError(f"coefficients has shape {tuple(coefficients.shape)}: give ((degree + 1)², channels)")
    turned_back = rotation @ rotation.mT if rotation.shape == (3, 3) else rotation.new_zeros(3, 3)
    if not torch.allclose(turned_back, torch.eye(3).to(rotation), rtol=0, atol=ORTHONORMAL):
        raise InputError("rotation is no rotation: give an orthonormal matrix (3, 3)")

    def turned(directions: Tensor) -> Tensor:
        return basis(directions @ rotation.to(directions), degree) @ coefficients.to(directions)

    return project(turned, degree, quadrature_degree=2 * degree).to(coefficients)
