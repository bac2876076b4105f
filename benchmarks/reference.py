"""Readable reference of the shading in `renderer.surface.shading`.

It uses plain torch operations, which autograd differentiates, in the dtype of
its inputs. The spherical harmonics follow the Legendre recurrences of the
paper's appendix B.1. Benchmarks compare the fast shading of the library with
this reference and time it against this reference.

The harmonic of degree l and order m (-l ≤ m ≤ l) has the index l² + l + m.
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor


def irradiance(normals: Tensor, light: Tensor) -> Tensor:
    """Compute the irradiance at diffuse surfaces: Σ A_l U_lm Y_lm(n) over l and m.

    A_l is the convolution with the clamped cosine (see `clamped_cosine`), U_lm
    a coefficient of the light, and Y_lm a real spherical harmonic.

    Args:
        normals: Unit normals n, shape (N, 3).
        light: Coefficients U_lm of the light, shape ((degree + 1)², 3).

    Returns:
        Irradiance at each normal, shape (N, 3).
    """
    degree = math.isqrt(len(light)) - 1
    values, indices, factors = reaching_harmonics(normals, degree)
    return values @ (factors * light[indices])


def reaching_harmonics(normals: Tensor, degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """Evaluate the harmonics that reach a diffuse surface, which have A_l ≠ 0.

    Args:
        normals: Unit normals, shape (N, 3).
        degree: Largest degree l.

    Returns:
        Values Y_lm of the K harmonics at the normals, shape (N, K); the indices
        of these harmonics, shape (K,); and their factors A_l, shape (K, 1).
    """
    values = []
    indices = []
    factors = []
    for index, harmonic in harmonics(normals, degree):
        factor = clamped_cosine(math.isqrt(index))
        if factor != 0:
            values.append(harmonic)
            indices.append(index)
            factors.append(factor)
    index_tensor = torch.tensor(indices, device=normals.device)
    factor_column = normals.new_tensor(factors)[:, None]
    return torch.stack(values, dim=1), index_tensor, factor_column


def harmonics(unit_normals: Tensor, degree: int) -> Iterator[tuple[int, Tensor]]:
    """Evaluate all spherical harmonics up to a degree.

    Args:
        unit_normals: Unit normals, shape (N, 3).
        degree: Largest degree l.

    Yields:
        Index of a harmonic, and its values at the normals, shape (N,).
    """
    x, y, z = unit_normals.unbind(1)
    # A normal with the polar angle θ and the azimuth φ has sin^m θ · cos mφ
    # here, and sin^m θ · sin mφ in the next line.
    cosine = torch.ones_like(z)
    sine = torch.zeros_like(z)
    for m in range(degree + 1):
        # Associated Legendre polynomials P_l^m divided by sin^m θ, from l = m
        # upwards. The previous one belongs to l - 1.
        previous_legendre = torch.zeros_like(z)
        odd_factorial = math.prod(range(1, 2 * m, 2))
        legendre = torch.full_like(z, float(odd_factorial))
        for l in range(m, degree + 1):
            norm = normalization(l, m)
            yield l * l + l + m, norm * legendre * cosine
            if m:
                yield l * l + l - m, norm * legendre * sine
            ascending = (2 * l + 1) * z * legendre - (l + m) * previous_legendre
            previous_legendre = legendre
            legendre = ascending / (l + 1 - m)
        next_cosine = x * cosine - y * sine
        sine = x * sine + y * cosine
        cosine = next_cosine


def normalization(l: int, m: int) -> float:
    """Return the factor that gives the harmonics of degree l and order ±m the norm 1.

    Args:
        l: Degree, at least 0.
        m: Order, from 0 to l.
    """
    ratio = math.factorial(l - m) / math.factorial(l + m)
    return math.sqrt((2 if m else 1) * (2 * l + 1) / (4 * math.pi) * ratio)


def clamped_cosine(l: int) -> float:
    """Compute the factor A_l = 2π ∫₀¹ t P_l(t) dt of the harmonics of degree l.

    P_l is the Legendre polynomial of degree l. The factors are from Ramamoorthi
    and Hanrahan (2001). They are 0 for odd degrees from 3 on.

    Args:
        l: Degree of the harmonics, at least 0.

    Returns:
        The factor A_l.
    """
    if l == 1:
        return 2 * math.pi / 3
    if l % 2:
        return 0.0
    sign = (-1) ** (l // 2 + 1)
    return sign * 2 * math.pi * math.comb(l, l // 2) / ((l + 2) * (l - 1) * 2**l)


def face_normals(corners: Tensor) -> Tensor:
    """Compute the unit normals of triangles.

    Args:
        corners: The three corners of each face, shape (F, 3, 3). The last axis
            has the coordinates.

    Returns:
        Unit normals, shape (F, 3). They point outward if the corners are
        counter-clockwise seen from outside. Triangles without area get NaN.
    """
    first, second, third = corners.unbind(1)
    doubled_areas = torch.linalg.cross(second - first, third - first)
    return doubled_areas / doubled_areas.norm(dim=-1, keepdim=True)
