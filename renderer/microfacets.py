"""Glossy reflection by microfacets: GGX (Walter et al. 2007), Smith's masking and Schlick's Fresnel term.

With the half vector h between the directions to the light l and to the camera v, and α = roughness²,

    f = F D G / (4 (n·l)(n·v)),    D = α² / (π ((n·h)² (α² - 1) + 1)²),    F = F0 + (F90 - F0) (1 - v·h)⁵,

and G is the product of 2 (n·x) / ((n·x) + √(α² + (1 - α²) (n·x)²)) over x = l and v, as in glTF 2.0 and Mitsuba. F is
linear in F0 and F90, and so is all reflected light (the split sum of Karis 2013).

Of environment light a surface reflects ∫ L f (n·l) dl, linear in the light's coefficients U. The lobe f (n·l) is
approximated band by band, by zonal harmonics about four axes in the plane of n and v, near the mirrored direction r:

    ∫ L f (n·l) dl = Σ_j Σ_l z_jl(n·v, α) Σ_m U_lm Y_lm(x_j),    x_j = (r + s_j n) / |r + s_j n|,    r = 2 (n·v) n - v.

A single axis (Ramamoorthi and Hanrahan 2002) gives a round lobe; seen obliquely, lobes are long and end at the horizon:
then it is off by a quarter and more, and four axes by 2 % (degree 6, 4 % at roughness 1). The weights z are least
squares by quadrature at Chebyshev's nodes, found once, and polynomials between them: so derivatives are exact.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from renderer.light.harmonics import MAX_DEGREE, per_degree, unit

LEAST = 0.2  # roughness: of smoother lobes, degree 20 holds less than KEPT
KEPT = 0.7  # of a lobe's power, the integral of its square
AXES = (-1.0, 0.5, 2.0, 4.0)  # s_j over α / (1 + 4 α), by which lobes are about as long as wide
NODES = (16, 12)  # in the cosine and the roughness
STRETCH = 0.15  # of cosines: below it, where lobes change fastest, are half of the nodes
RIDGE = 1e-4  # of the least squares: head-on the axes are one
QUADRATURE = (32, 24)  # half vectors: by their distribution, and by azimuth on one side of the plane


def reflectance(normals: Tensor, toward: Tensor, directions: Tensor, roughness: Tensor) -> tuple[Tensor, Tensor]:
    """π f (...) for F0 = 1, F90 = 0 and for F0 = 0, F90 = 1: radiance per irradiance, as diffuse surfaces have albedo.

    normals, toward, directions: (..., 3) unit, the latter two to the camera and to the light. roughness: (...).
    Differentiable. Where a normal faces away from the camera, n·v counts as 0.
    """
    half = unit((toward + directions).movedim(-1, 0)).movedim(0, -1)
    squared, cosine = roughness**4, (half * normals).sum(-1)
    fresnel = (1 - (half * toward).sum(-1)).clamp(min=0) ** 5
    value = squared / (cosine**2 * (squared - 1) + 1) ** 2
    for direction in (toward, directions):
        along = (direction * normals).sum(-1).clamp(min=0)
        value = value / (along + (squared + (1 - squared) * along**2).sqrt())
    return value * (1 - fresnel), value * fresnel


def axes(normals: Tensor, toward: Tensor, roughness: Tensor) -> list[Tensor]:
    """x_j (3, S) of unit vectors (S, 3). roughness: (S,) or (1,)."""
    mirrored = 2 * (toward * normals).sum(1, keepdim=True) * normals - toward
    alpha = roughness[:, None] ** 2
    return [unit((mirrored + axis * alpha / (1 + 4 * alpha) * normals).T) for axis in AXES]


def lobe_weights(cosine: Tensor, roughness: Tensor, degree: int) -> Tensor:
    """π z (2, J, degree + 1, S): for F0 = 1, F90 = 0 and for F0 = 0, F90 = 1; differentiable.

    cosine: n·v (S,), taken for 0 below. roughness: (S,) or (1,), at least LEAST.
    """
    table = _table(degree).to(cosine)
    cosine = cosine.clamp(0, 1)
    across = _chebyshev(2 * (1 + STRETCH) * cosine / (cosine + STRETCH) - 1, NODES[0])
    along = _chebyshev((2 * roughness - 1 - LEAST) / (1 - LEAST), NODES[1])
    if len(along) == 1:
        weights = across @ (along @ table.flatten(1).unflatten(0, NODES[::-1]).flatten(1)).view(NODES[0], -1)
    else:
        weights = (along[:, :, None] * across[:, None]).flatten(1) @ table.flatten(1)
    return weights.T.unflatten(0, table.shape[1:])


def degree_for(roughness: float) -> int:
    """The least degree that holds KEPT of a lobe's power, seen head-on; at most 20, which roughness LEAST needs."""
    cosine, weight = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(2**9))
    cosine, weight = (cosine + 1) / 2, weight / 2
    up = torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    light = torch.stack([(1 - cosine**2).sqrt(), 0 * cosine, cosine], 1)
    lobe = reflectance(up, up, light, torch.tensor(max(roughness, LEAST)))[0] * cosine
    bands = (_legendre_polynomials(cosine, MAX_DEGREE) @ (weight * lobe)).square()
    held = ((torch.arange(MAX_DEGREE + 1) + 0.5) * bands).cumsum(0) / (weight * lobe**2).sum()
    return min(int((held < KEPT).sum()), MAX_DEGREE)


def _chebyshev(x: Tensor, count: int) -> Tensor:
    """(S, count): the polynomials T_0, T_1, ... at x (S,)."""
    rows = [torch.ones_like(x), x]
    for _ in range(count - 2):
        rows.append(2 * x * rows[-1] - rows[-2])
    return torch.stack(rows, dim=1)


@per_degree
def _table(degree: int) -> Tensor:
    """(nodes, 2, J, degree + 1) float64: coefficients of π z in products of Chebyshev polynomials of the roughness and,
    the faster index, the cosine."""
    count = [torch.arange(number, dtype=torch.float64) + 0.5 for number in NODES]
    x, y = (torch.cos(math.pi * index / len(index)) for index in count)
    cosines, roughness = STRETCH * (x + 1) / (1 + 2 * STRETCH - x), (y * (1 - LEAST) + 1 + LEAST) / 2
    fits = torch.stack([_fit(cosines, value, degree) for value in roughness])
    inverses = (torch.linalg.inv(_chebyshev(at, len(at))) for at in (y, x))
    return torch.einsum("kr,im,rm...->ki...", *inverses, fits).flatten(0, 1)


def _fit(cosines: Tensor, roughness: Tensor, degree: int) -> Tensor:
    """(N, 2, J, degree + 1) the least-squares weights π z of lobes at N cosines: n is z, v in the plane of x and z."""
    node, weight = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(QUADRATURE[0]))
    fraction, squared = (node[:, None] + 1) / 2, roughness**4  # of ∫ D (n·h) dh, which is 1
    azimuth = math.pi * (torch.arange(QUADRATURE[1], dtype=torch.float64) + 0.5) / QUADRATURE[1]
    z = ((1 - fraction) / (1 + (squared - 1) * fraction)).sqrt().expand(-1, len(azimuth))
    radius = (1 - z**2).sqrt()
    half = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], -1).flatten(0, 1)
    normal = half.new_tensor([[0.0, 0, 1]])
    toward = torch.stack([-((1 - cosines**2).sqrt()), 0 * cosines, cosines], dim=1)
    facing = toward @ half.T
    light = 2 * facing[..., None] * half - toward[:, None]
    density = squared / (half[:, 2] ** 2 * (squared - 1) + 1) ** 2 / math.pi * half[:, 2]
    measure = weight.repeat_interleave(len(azimuth)) / 2 / len(azimuth) / density * 4 * facing.clamp(min=0)  # of light
    lobe = torch.stack(reflectance(normal, toward[:, None], light, roughness)) * light[..., 2].clamp(min=0) * measure
    about = torch.stack(axes(normal, toward, roughness[None])).permute(2, 0, 1)
    received = _legendre_polynomials(about @ light.mT, degree) @ lobe.permute(1, 2, 0)
    gram = _legendre_polynomials(about @ about.mT, degree) + RIDGE * torch.eye(len(AXES)).to(about)
    return torch.linalg.solve(gram, received).permute(1, 3, 2, 0)


def _legendre_polynomials(x: Tensor, degree: int) -> Tensor:
    """(degree + 1, ...): P_l at x (...)."""
    rows = [torch.ones_like(x), x]
    for l in range(2, degree + 1):
        rows.append(((2 * l - 1) * x * rows[-1] - (l - 1) * rows[-2]) / l)
    return torch.stack(rows[: degree + 1])
