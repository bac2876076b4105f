"""Diffuse shading of a view's fragments, differentiable in the vertices, the light and the albedo.

The radiance of a pixel is the box filter over its s² samples i, of albedo ρ and unit normal n:

    L = 1/s² Σ_i ρ_i E(n_i),    E(n) = Σ_lm A_l U_lm Y_lm(n),    A_l = π, 2π/3, π/4, 0, −π/24, 0, π/64, ...

E is the irradiance of a diffuse surface (Ramamoorthi and Hanrahan 2001; the paper's appendix B.2). Bands of even degree
from 2 on are one homogeneous polynomial p of degree d on the sphere, whose value follows from its slope by Euler's
theorem, p(n) = n · ∇p(n) / d. So one product of monomials with the slope's coefficients gives both E and ∂E/∂n, of
which the part tangent to the sphere, (∇E − n (n · ∇E)) / |normal|, is the derivative by the normal (appendix D).

Visibility and texture coordinates are fixed (Section 3 and appendix B.3): the derivative by the vertices contains
how normals turn and not how outlines move. For the light alone, `renderer.transport.operators` is faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import require_bounded
from renderer.geometry.normals import FEW, area_vectors, vertex_normals
from renderer.light import harmonics
from renderer.surface.gloss import SampleGloss, at_samples, toward_camera
from renderer.surface.microfacets import along, coat_bands
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments

if TYPE_CHECKING:
    from jaxtyping import Float, Int

BLOCK = 2**14  # normals at a time


def radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "V 3"] | None = None,
) -> Float[Tensor, "3 P"]:
    """Linear radiance of the P covered pixels, weighted with coverage, in the dtype of `vertices`.

    light: of any degree. albedo: linear, at the S samples (`renderer.surface.albedo`). normals: of the vertices, to shade with
    them interpolated (`normals_in_sight`); None: a normal per face. InputError: NaN in any of them.
    """
    require_bounded(albedo=albedo)  # the normals and the irradiance check the rest
    wide = torch.promote_types(vertices.dtype, torch.float32)
    albedo = albedo.to(wide)
    if normals is None:
        pixel, face, weights = fragments.merge(albedo)
        planes = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shade = irradiance(planes, light, wide).index_select(1, face)
    else:
        pixel, weights = fragments.pixel, albedo / fragments.samples**2
        shade = irradiance(smooth_normals(fragments, normals.to(wide)).T, light, wide)
    seen = shade * weights.T
    if fragments.samples > 1:  # a sample is a pixel otherwise
        seen = seen.new_zeros(3, len(fragments.pixels)).index_add(1, pixel, seen)
    return seen.to(vertices.dtype)


def glossy_radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "V 3"] | None,
    gloss: SampleGloss,
) -> Float[Tensor, "3 P"]:
    """`radiance` of a surface with gloss at the samples (`renderer.surface.gloss`); differentiable in that, too."""
    wide = torch.promote_types(vertices.dtype, torch.float32)
    if normals is None:
        planes = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shaded = unit(planes).T[fragments.face].to(wide)
    else:
        shaded = unit(smooth_normals(fragments, normals.to(wide)).T).T
    toward = toward_camera(fragments, vertices.to(wide))
    albedo, light, gloss = albedo.to(wide), light.to(wide), gloss.to(shaded)
    below = albedo * gloss.diffuse(shaded, toward)[:, None]
    blocks = []
    for first in range(0, len(shaded), BLOCK):
        some = slice(first, first + BLOCK)
        seen = shaded[some], at_samples(toward, some)
        colored, white, frame = gloss.at(some).transfer(*seen, harmonics.degree_of(light))
        in_view = frame.from_world(light).T
        shine = in_view @ white
        if colored is not None:
            shine = shine + albedo[some].T * (in_view @ colored)
        lost = _coat_irradiance(shaded[some].T, light, gloss.at(some))
        blocks.append(shine - below[some].T * lost)
    shine = torch.cat([light.new_zeros(3, 0), *blocks], dim=1) / fragments.samples**2
    diffuse = radiance(fragments, vertices, light, below, normals)
    return diffuse + shine.new_zeros(3, len(fragments.pixels)).index_add(1, fragments.pixel, shine).to(diffuse)


def _coat_irradiance(normals: Tensor, light: Tensor, gloss: SampleGloss) -> Tensor:
    """Compute the irradiance (3, S) that the coat reflects at samples with unit normals (3, S)."""
    degree = min(harmonics.degree_of(light), harmonics.DIFFUSE_DEGREE)
    light = light[: (degree + 1) ** 2]
    reflected = coat_bands(degree).to(light)[harmonics.bands(degree)]  # (K, nodes)
    of_roughness = along(gloss.roughness)  # (nodes, S) or (nodes, 1)
    if len(gloss.roughness) == 1:
        return gloss.strength * _Series.apply(normals, (reflected @ of_roughness) * light)
    lights = (reflected[..., None] * light[:, None]).flatten(1)  # (K, nodes × 3)
    by_node = _Series.apply(normals, lights).unflatten(0, (-1, 3))  # (nodes, 3, S)
    return gloss.strength * (by_node * of_roughness[:, None]).sum(0)


class _Series(torch.autograd.Function):
    """Σ c_k Y_k(n) of coefficients (K, C) at unit normals (3, N), shape (C, N), by the polynomials of `_Irradiance` for
    both parities."""

    @staticmethod
    def forward(ctx: Any, normals: Tensor, coefficients: Tensor) -> Tensor:
        degree = math.isqrt(len(coefficients)) - 1
        value = (coefficients[0] / math.sqrt(4 * math.pi))[:, None]
        slope = normals.new_zeros(3, coefficients.shape[1], 1)
        for power in range(max(degree - 1, 1), degree + 1):
            slopes = _slopes(power).to(coefficients)[..., : len(coefficients)]  # (3, J, K)
            by_axis = slopes @ coefficients[: slopes.shape[2]]
            part = by_axis.mT @ harmonics.monomials(normals, power - 1)  # (3, C, N)
            value = value + (part * normals[:, None]).sum(0) / power
            slope = slope + part
        ctx.save_for_backward(normals, slope)
        ctx.degree = degree
        return value.expand(-1, normals.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        normals, slope = ctx.saved_tensors
        by_normal = by_coefficient = None
        if ctx.needs_input_grad[0]:
            by_normal = (slope * upstream).sum(1)
        if ctx.needs_input_grad[1]:
            rows = harmonics.select_rows(normals, range((ctx.degree + 1) ** 2))
            by_coefficient = torch.stack(rows) @ upstream.T
        return by_normal, by_coefficient


def irradiance(
    normals: Float[Tensor, "3 N"], light: Float[Tensor, "coefficients 3"], dtype: torch.dtype
) -> Float[Tensor, "3 N"]:
    """Irradiance on surfaces with finite normals of any length under a light of (degree + 1)² coefficients.

    Differentiable in both. Normals become unit vectors in their own dtype, the rest is computed in `dtype`, not half
    precision. The gradient by bands that cannot reach a diffuse surface is exactly zero.
    InputError: NaN in the light, or a light of another shape.
    Source: the paper's equation for R in appendix B.2; its derivative by n in appendix D, here a polynomial too.
    """
    require_bounded(light=light)
    harmonics.degree_of(light)
    return _Irradiance.apply(normals, light.to(dtype))


class _Irradiance(torch.autograd.Function):
    """Finds value and slope together, and keeps the slope for the backward pass: three numbers a channel."""

    @staticmethod
    def forward(ctx: Any, normals: Tensor, light: Tensor) -> Tensor:
        unit, length = unit_vectors(normals)
        unit = unit.to(light.dtype)
        blocks = zip(*map(_polynomial(light), unit.split(BLOCK, dim=1)), strict=True)
        value, slope = (torch.cat(parts, dim=-1) for parts in blocks)
        absent = torch.nonzero(length == 0).squeeze(1)
        if len(absent):  # the homogeneous polynomials are not those of `basis` at 0
            nonzero, rows = _nonzero_harmonics(unit[:, absent], math.isqrt(len(light)) - 1)
            value[:, absent] = light[nonzero].T @ rows
        ctx.save_for_backward(unit, length, slope if ctx.needs_input_grad[0] else None)
        ctx.light = light.shape
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        unit, length, slope = ctx.saved_tensors
        by_normal = by_light = None
        if ctx.needs_input_grad[0]:
            solid = slope[:, 0] * upstream[0]
            solid.addcmul_(slope[:, 1], upstream[1]).addcmul_(slope[:, 2], upstream[2])
            tangential = solid - unit * (unit * solid).sum(0)
            by_normal = tangential / length.masked_fill(length == 0, torch.inf)
        if ctx.needs_input_grad[1]:
            by_light = unit.new_zeros(ctx.light)
            for block, above in zip(unit.split(BLOCK, dim=1), upstream.split(BLOCK, dim=1), strict=True):
                nonzero, rows = _nonzero_harmonics(block, math.isqrt(ctx.light[0]) - 1)
                by_light[nonzero] += rows @ above.T
        return by_normal, by_light


def _polynomial(light: Tensor) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """One light's irradiance: unit vectors (3, N) → value (3, N) and slope (3 axes, 3, N), whose tangential part
    counts."""
    degree = _even(math.isqrt(len(light)) - 1)
    per_light = _slopes_per_light(math.isqrt(len(light)) - 1, light.dtype, light.device)
    slopes = (per_light @ light[: per_light.shape[2]]).mT.flatten(0, 1)  # (3 axes × 3 channels, J + 1)
    even, linear, constant = slopes[:, :-1], slopes[:, -1:], light[:1].T * math.sqrt(math.pi / 4)

    def evaluate(unit: Tensor) -> tuple[Tensor, Tensor]:
        slope = torch.addmm(linear, even, harmonics.monomials(unit, degree - 1)).unflatten(0, (3, 3))
        value = torch.addmm(constant, linear.view(3, 3).T, unit, alpha=1 - 1 / degree)
        for by_axis, component in zip(slope, unit, strict=True):
            value.addcmul_(by_axis, component, value=1 / degree)
        return value, slope

    return evaluate


@harmonics.per_degree
def _slopes_per_light(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(3, J + 1, K): what one of each of a light's first K coefficients adds to the slopes in `_polynomial`: by each
    axis, those of its even bands in monomials, and that of band 1."""
    even = _even(degree)
    slopes = torch.cat([_slopes(even), F.pad(_slopes(1), (0, (even + 1) ** 2 - 4))], dim=1)
    return (slopes * harmonics.lambertian_factors(even))[..., : (degree + 1) ** 2].to(device, dtype)


def _even(degree: int) -> int:
    """The degree of the homogeneous polynomial that holds the even bands from 2 on."""
    return max(min(degree, harmonics.DIFFUSE_DEGREE) - degree % 2, 2)


@harmonics.per_degree
def _slopes(degree: int) -> Tensor:
    """(3, J, (degree + 1)²): the slope by each axis of r^degree Y_k in monomials, for the bands of the degree's parity
    from 1 on."""
    l = harmonics.bands(degree)
    slopes = harmonics.monomial_coefficients(degree - 1) @ harmonics.homogeneous_gradients(degree)[:, : degree**2]
    return slopes * ((l > 0) & (l % 2 == degree % 2))


def _nonzero_harmonics(unit: Tensor, degree: int) -> tuple[list[int], Tensor]:
    """(the K coefficients that reach a surface, what one of each does at unit or zero vectors (3, N): (K, N))."""
    nonzero = harmonics.nonzero_coefficients(degree).tolist()
    factors = harmonics.lambertian_factors(degree).to(unit)[nonzero, None]
    return nonzero, torch.stack(harmonics.select_rows(unit, nonzero)) * factors


def normals_in_sight(
    fragments: Fragments, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """`vertex_normals`, in float32 or wider, of the vertices of faces in sight; the others touch no sample."""
    near = torch.zeros(len(vertices), dtype=torch.bool, device=faces.device)
    near[fragments.corners.T.flatten()] = True
    first, second, third = near.index_select(0, faces.flatten()).view(-1, 3).T
    around = faces[first | second | third]
    vertices = vertices.to(torch.promote_types(vertices.dtype, torch.float32))
    if len(vertices) < FEW * around.numel():
        return vertex_normals(vertices, around)
    own, around = around.unique(return_inverse=True)
    of_own = vertex_normals(vertices.index_select(0, own), around)
    return torch.zeros_like(vertices, requires_grad=False).index_copy(0, own, of_own)


def smooth_normals(fragments: Fragments, normals: Float[Tensor, "V 3"]) -> Float[Tensor, "S 3"]:
    """Vertex normals interpolated to the S samples, on the side that the camera sees; not of unit length."""
    at_corners = normals.T.index_select(1, fragments.corners.T.flatten()).unflatten(1, (3, -1))
    return fragments.interpolate((at_corners * fragments.facing.T.to(normals)).permute(2, 1, 0))
