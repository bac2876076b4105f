"""The slow, readable shading beside `renderer.surface.shading`: plain torch operations, which autograd differentiates.

Computed in the dtype of its inputs, with the harmonics by the Legendre recurrences of the paper's appendix B.1. The
fast paths are compared with it and timed against it.
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor


def irradiance(normals: Tensor, light: Tensor) -> Tensor:
    """Σ A_l U_lm Y_lm(n), (N, 3), at unit normals (N, 3) under light ((degree + 1)², 3)."""
    matrix, rows, factors = reaching_harmonics(normals, math.isqrt(len(light)) - 1)
    return matrix @ (factors * light[rows])


def reaching_harmonics(normals: Tensor, degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """(Y_lm at unit normals (N, 3), (N, K); their indices (K,); A_l of each, (K, 1)) where A_l is not zero."""
    factors = {index: clamped_cosine(math.isqrt(index)) for index in range((degree + 1) ** 2)}
    reaching = {index: harmonic for index, harmonic in harmonics(normals, degree) if factors[index]}
    rows = torch.tensor(list(reaching), device=normals.device)
    column = normals.new_tensor([factors[index] for index in reaching])[:, None]
    return torch.stack(list(reaching.values()), dim=1), rows, column


def harmonics(unit_normals: Tensor, degree: int) -> Iterator[tuple[int, Tensor]]:
    """(index, Y_lm) of all harmonics to a degree, (N,) each, at unit normals (N, 3)."""
    x, y, z = unit_normals.unbind(1)
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)  # sin^m θ times cos mφ and sin mφ
    for m in range(degree + 1):
        # P_l^m over sin^m θ, from l = m upwards.
        before, legendre = torch.zeros_like(z), torch.full_like(z, float(math.prod(range(1, 2 * m, 2))))
        for l in range(m, degree + 1):
            ratio = math.factorial(l - m) / math.factorial(l + m)
            norm = math.sqrt((2 if m else 1) * (2 * l + 1) / (4 * math.pi) * ratio)
            yield l * l + l + m, norm * legendre * cosine
            if m:
                yield l * l + l - m, norm * legendre * sine
            before, legendre = legendre, ((2 * l + 1) * z * legendre - (l + m) * before) / (l + 1 - m)
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine


def clamped_cosine(l: int) -> float:
    """A_l = 2π ∫₀¹ t P_l(t) dt of band l (Ramamoorthi and Hanrahan 2001): zero for odd bands from 3 on."""
    if l % 2:
        return 2 * math.pi / 3 if l == 1 else 0.0
    sign = (-1) ** (l // 2 + 1)
    return sign * 2 * math.pi * math.comb(l, l // 2) / ((l + 2) * (l - 1) * 2**l)


def face_normals(corners: Tensor) -> Tensor:
    """(F, 3) unit normals from corners (F, 3 corners, 3), outward for counter-clockwise faces; NaN without area."""
    first, second, third = corners.unbind(1)
    doubled_areas = torch.linalg.cross(second - first, third - first)
    return doubled_areas / doubled_areas.norm(dim=-1, keepdim=True)
