"""Shading of the surface samples of a view, differentiable in vertices, light and albedo.

The radiance of a pixel is the mean (box filter) over its s² samples i, with
albedo ρ_i and unit normal n_i:

    L = 1/s² Σ_i ρ_i E(n_i),    E(n) = Σ_lm A_l U_lm Y_lm(n),

with the harmonics Y_lm, the coefficients U_lm of the light, and the factors
A_l = π, 2π/3, π/4, 0, −π/24, 0, π/64, ... E is the irradiance of a diffuse
surface (Ramamoorthi and Hanrahan 2001; the paper's appendix B.2).

On the sphere, the bands of even degree from 2 on are together one homogeneous
polynomial p of degree d. By Euler's theorem, its value follows from its gradient
(called slope here): p(n) = n · ∇p(n) / d. One product of monomials with the
coefficients of the slope therefore gives both E and ∇E. The part of the slope
that is tangent to the sphere, (∇E − n (n · ∇E)) / |normal|, is the derivative by
the normal (the paper's appendix D).

Visibility and texture coordinates are fixed (the paper's Section 3 and appendix
B.3). The derivative by the vertices contains how normals turn, but not how
silhouette edges move. For derivatives by the light alone,
`renderer.transport.operators` is faster.

Shapes use these letters: a view has S samples in P pixels of a mesh with V
vertices and F faces. K is the number of coefficients, (degree + 1)².
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import require_bounded
from renderer.geometry.normals import FEW, area_vectors, vertex_normals
from renderer.light import harmonics
from renderer.shading.gloss import SampleGloss, at_samples, toward_camera
from renderer.shading.lobes import along, coat_bands
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Normals that are shaded at a time, so that their values stay in the CPU cache.
BLOCK = 2**14
COLORS = 3


def radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "V 3"] | None = None,
) -> Float[Tensor, "3 P"]:
    """Compute the linear radiance of the covered pixels of a matte surface.

    The result is differentiable in the vertices, the light and the albedo.

    Args:
        fragments: Samples of the view.
        vertices: Positions, shape (V, 3).
        light: SH coefficients of any degree, shape (K, 3).
        albedo: Linear albedo at the samples (`renderer.surface.albedo`), shape (S, 3).
        normals: Normals of the vertices (`normals_in_sight`), shape (V, 3), for
            smooth shading. None for flat shading with the normals of the faces.

    Returns:
        Radiance, weighted with coverage, shape (3, P), in the dtype of the
        vertices.

    Raises:
        InputError: If an argument holds NaN.
    """
    # The vertices and the light are checked where they are used.
    require_bounded(albedo=albedo)
    wide = torch.promote_types(vertices.dtype, torch.float32)
    albedo = albedo.to(wide)
    if normals is None:
        pixel, face, weights = fragments.merge(albedo)
        planes = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shade = irradiance(planes, light, wide).index_select(1, face)
    else:
        pixel = fragments.pixel
        weights = albedo / fragments.samples**2
        shade = irradiance(smooth_normals(fragments, normals.to(wide)).T, light, wide)
    seen = shade * weights.T
    # Samples are pixels if there is one per pixel. Then there is nothing to sum.
    if fragments.samples > 1:
        zeros = seen.new_zeros(COLORS, len(fragments.pixels))
        seen = zeros.index_add(1, pixel, seen)
    return seen.to(vertices.dtype)


def glossy_radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "V 3"] | None,
    gloss: SampleGloss,
) -> Float[Tensor, "3 P"]:
    """Compute the linear radiance of the covered pixels of a glossy surface.

    The result is differentiable in the vertices, the light, the albedo and the
    gloss.

    Args:
        fragments: Samples of the view.
        vertices: Positions, shape (V, 3).
        light: SH coefficients of any degree, shape (K, 3).
        albedo: Linear albedo at the samples, shape (S, 3).
        normals: Normals of the vertices, as for `radiance`.
        gloss: Gloss at the samples (`renderer.shading.gloss`).

    Returns:
        Radiance, weighted with coverage, shape (3, P), in the dtype of the
        vertices.

    Raises:
        InputError: If an argument holds NaN.
    """
    wide = torch.promote_types(vertices.dtype, torch.float32)
    if normals is None:
        planes = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shaded_normals = unit(planes).T[fragments.face].to(wide)
    else:
        shaded_normals = unit(smooth_normals(fragments, normals.to(wide)).T).T
    to_camera = toward_camera(fragments, vertices.to(wide))
    albedo = albedo.to(wide)
    light = light.to(wide)
    gloss = gloss.to(shaded_normals)
    # The albedo of the diffuse surface below the coat.
    albedo_below = albedo * gloss.diffuse(shaded_normals, to_camera)[:, None]
    blocks = []
    for first in range(0, len(shaded_normals), BLOCK):
        some = slice(first, first + BLOCK)
        reflected = _reflected_by_lobes(
            shaded_normals[some], at_samples(to_camera, some), light, albedo[some], gloss.at(some)
        )
        lost = _coat_irradiance(shaded_normals[some].T, light, gloss.at(some))
        blocks.append(reflected - albedo_below[some].T * lost)
    shine = torch.cat([light.new_zeros(COLORS, 0), *blocks], dim=1) / fragments.samples**2
    diffuse = radiance(fragments, vertices, light, albedo_below, normals)
    zeros = shine.new_zeros(COLORS, len(fragments.pixels))
    return diffuse + zeros.index_add(1, fragments.pixel, shine).to(diffuse)


def _reflected_by_lobes(
    normals: Tensor, to_camera: Tensor, light: Tensor, albedo: Tensor, gloss: SampleGloss
) -> Tensor:
    """Return the radiance (3, S) that the specular lobes reflect at samples.

    The unit normals have the shape (S, 3), the unit vectors to the camera (S, 3)
    or (1, 3), and the albedo (S, 3).
    """
    colored, white, frame = gloss.transfer(normals, to_camera, harmonics.degree_of(light))
    light_in_view = frame.from_world(light).T
    reflected = light_in_view @ white
    if colored is not None:
        reflected = reflected + albedo.T * (light_in_view @ colored)
    return reflected


def _coat_irradiance(normals: Tensor, light: Tensor, gloss: SampleGloss) -> Tensor:
    """Return the irradiance (3, S) that the coat reflects at samples with unit normals (3, S)."""
    degree = min(harmonics.degree_of(light), harmonics.DIFFUSE_DEGREE)
    light = light[: (degree + 1) ** 2]
    # The reflected factor of each coefficient at the nodes of a table over
    # roughness, shape (K, nodes).
    reflected = coat_bands(degree).to(light)[harmonics.bands(degree)]
    # The weight of each node, shape (nodes, S), or (nodes, 1) if all samples have
    # the same roughness.
    of_roughness = along(gloss.roughness)
    if len(gloss.roughness) == 1:
        return gloss.specular_factor * _Series.apply(normals, (reflected @ of_roughness) * light)
    # One light for each node, shape (K, nodes × 3).
    lights = (reflected[..., None] * light[:, None]).flatten(1)
    # The irradiance under each of them, shape (nodes, 3, S).
    by_node = _Series.apply(normals, lights).unflatten(0, (-1, COLORS))
    return gloss.specular_factor * (by_node * of_roughness[:, None]).sum(0)


class _Series(torch.autograd.Function):
    """The sums Σ_k c_k Y_k(n) of C channels at N unit normals.

    The normals have the shape (3, N), the coefficients (K, C) and the result
    (C, N). On the sphere, the bands of even degree are together one homogeneous
    polynomial, and so are the bands of odd degree. The value of a polynomial
    follows from its slope (see the top of this module).
    """

    @staticmethod
    def forward(ctx: Any, normals: Tensor, coefficients: Tensor) -> Tensor:
        degree = math.isqrt(len(coefficients)) - 1
        # Band 0 is constant.
        value = (coefficients[0] / math.sqrt(4 * math.pi))[:, None]
        slope = normals.new_zeros(3, coefficients.shape[1], 1)
        # The degrees of the two polynomials are the degree and the one below.
        for power in range(max(degree - 1, 1), degree + 1):
            # Shape (3 axes, monomials, K).
            slope_matrices = _slopes(power).to(coefficients)[..., : len(coefficients)]
            by_axis = slope_matrices @ coefficients[: slope_matrices.shape[2]]
            # Shape (3 axes, C, N).
            part = by_axis.mT @ harmonics.monomials(normals, power - 1)
            value = value + (part * normals[:, None]).sum(0) / power
            slope = slope + part
        ctx.save_for_backward(normals, slope)
        ctx.degree = degree
        return value.expand(-1, normals.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        normals, slope = ctx.saved_tensors
        by_normal = None
        by_coefficient = None
        if ctx.needs_input_grad[0]:
            by_normal = (slope * upstream).sum(1)
        if ctx.needs_input_grad[1]:
            rows = harmonics.select_rows(normals, range((ctx.degree + 1) ** 2))
            by_coefficient = torch.stack(rows) @ upstream.T
        return by_normal, by_coefficient


def irradiance(
    normals: Float[Tensor, "3 N"], light: Float[Tensor, "coefficients 3"], dtype: torch.dtype
) -> Float[Tensor, "3 N"]:
    """Compute the irradiance on surfaces, differentiable in the normals and in the light.

    Source: the paper's equation for R in appendix B.2, and its derivative by the
    normal in appendix D. Here, both are polynomials.

    Args:
        normals: Finite normals of any length, shape (3, N). They become unit
            vectors in their own dtype.
        light: SH coefficients, shape (K, 3).
        dtype: Type in which everything else is computed, float32 or float64.

    Returns:
        Irradiance, shape (3 colors, N). The gradient by bands that cannot reach
        a diffuse surface is exactly zero.

    Raises:
        InputError: If the light holds NaN or has another shape.
    """
    require_bounded(light=light)
    harmonics.degree_of(light)
    return _Irradiance.apply(normals, light.to(dtype))


class _Irradiance(torch.autograd.Function):
    """`irradiance`, which computes value and slope together.

    It keeps the slope for the backward pass, three numbers for each channel.
    """

    @staticmethod
    def forward(ctx: Any, normals: Tensor, light: Tensor) -> Tensor:
        directions, lengths = unit_vectors(normals)
        directions = directions.to(light.dtype)
        polynomial = _IrradiancePolynomial(light)
        evaluated = [polynomial.evaluate(block) for block in directions.split(BLOCK, dim=1)]
        value, slope = (torch.cat(parts, dim=-1) for parts in zip(*evaluated, strict=True))
        del evaluated
        absent = torch.nonzero(lengths == 0).squeeze(1)
        if len(absent):
            # The homogeneous polynomials differ from `basis` at the zero vector.
            degree = math.isqrt(len(light)) - 1
            nonzero, rows = _nonzero_harmonics(directions[:, absent], degree)
            value[:, absent] = light[nonzero].T @ rows
        ctx.save_for_backward(directions, lengths, slope if ctx.needs_input_grad[0] else None)
        ctx.light_shape = light.shape
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        directions, lengths, slope = ctx.saved_tensors
        by_normal = None
        by_light = None
        if ctx.needs_input_grad[0]:
            solid = slope[:, 0] * upstream[0]
            solid.addcmul_(slope[:, 1], upstream[1]).addcmul_(slope[:, 2], upstream[2])
            tangential = solid - directions * (directions * solid).sum(0)
            by_normal = tangential / lengths.masked_fill(lengths == 0, torch.inf)
        if ctx.needs_input_grad[1]:
            degree = math.isqrt(ctx.light_shape[0]) - 1
            by_light = directions.new_zeros(ctx.light_shape)
            blocks = zip(directions.split(BLOCK, dim=1), upstream.split(BLOCK, dim=1), strict=True)
            for block, upstream_of_block in blocks:
                nonzero, rows = _nonzero_harmonics(block, degree)
                by_light[nonzero] += rows @ upstream_of_block.T
        return by_normal, by_light


class _IrradiancePolynomial:
    """The irradiance under one light as a polynomial of the unit normal.

    The slope of the bands from 2 on has J monomials, of degree d - 1. The
    attributes are the coefficients of the polynomial:

    Attributes:
        degree: The degree d.
        even: Slope of the even bands in monomials, shape (3 axes × 3 colors, J).
        linear: Slope of band 1, which is constant, shape (3 axes × 3 colors, 1).
        constant: Irradiance of band 0, shape (3 colors, 1).
    """

    def __init__(self, light: Tensor):
        light_degree = math.isqrt(len(light)) - 1
        per_light = _slopes_per_light(light_degree, light.dtype, light.device)
        by_axis = per_light @ light[: per_light.shape[2]]
        slopes = by_axis.mT.flatten(0, 1)
        self.degree = _even(light_degree)
        self.even = slopes[:, :-1]
        self.linear = slopes[:, -1:]
        self.constant = light[:1].T * math.sqrt(math.pi / 4)

    def evaluate(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the value and the slope at unit vectors (3, N).

        The value has the shape (3 colors, N) and the slope (3 axes, 3 colors, N).
        Only the tangential part of the slope has a meaning.
        """
        # The monomials have no name, so that their memory is released at once.
        slope = torch.addmm(
            self.linear, self.even, harmonics.monomials(directions, self.degree - 1)
        ).unflatten(0, (3, COLORS))
        # The value is constant + n · linear + p(n). The loop below adds
        # n · slope / d = p(n) + n · linear / d, so 1 - 1/d of the linear term is left.
        linear = self.linear.view(3, COLORS).T
        value = torch.addmm(self.constant, linear, directions, alpha=1 - 1 / self.degree)
        for by_axis, component in zip(slope, directions, strict=True):
            value.addcmul_(by_axis, component, value=1 / self.degree)
        return value, slope


@harmonics.per_degree
def _slopes_per_light(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the matrices (3 axes, J + 1, K) from a light to the slopes of its irradiance.

    The first J rows are those of the even bands in monomials, and the last row is
    that of band 1. K counts the first coefficients of the light, up to the degree
    of `_even`.
    """
    even = _even(degree)
    linear = F.pad(_slopes(1), (0, (even + 1) ** 2 - 4))
    slopes = torch.cat([_slopes(even), linear], dim=1)
    irradiance_slopes = slopes * harmonics.lambertian_factors(even)
    return irradiance_slopes[..., : (degree + 1) ** 2].to(device, dtype)


def _even(degree: int) -> int:
    """Return the degree of the homogeneous polynomial of a light's even bands from 2 on."""
    return max(min(degree, harmonics.DIFFUSE_DEGREE) - degree % 2, 2)


@harmonics.per_degree
def _slopes(degree: int) -> Tensor:
    """Return the slope of r^degree Y_k in monomials, shape (3 axes, monomials, (degree + 1)²).

    The polynomial r^degree Y_k, with the length r of the normal, belongs to the
    harmonic of index k (see `harmonics.homogeneous_gradients`). Columns of band 0
    and of bands of the other parity are zero.
    """
    band = harmonics.bands(degree)
    gradients = harmonics.homogeneous_gradients(degree)[:, : degree**2]
    slopes = harmonics.monomial_coefficients(degree - 1) @ gradients
    return slopes * ((band > 0) & (band % 2 == degree % 2))


def _nonzero_harmonics(directions: Tensor, degree: int) -> tuple[list[int], Tensor]:
    """Return the indices of the coefficients that reach a surface, and their irradiance.

    The irradiance per unit of each of these K coefficients, at unit or zero
    vectors (3, N), has the shape (K, N).
    """
    nonzero = harmonics.nonzero_coefficients(degree).tolist()
    factors = harmonics.lambertian_factors(degree).to(directions)[nonzero, None]
    return nonzero, torch.stack(harmonics.select_rows(directions, nonzero)) * factors


def normals_in_sight(
    fragments: Fragments, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Compute `vertex_normals` of the vertices of seen faces.

    Args:
        fragments: Samples of the view.
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3).

    Returns:
        Unit normals, shape (V, 3), float32 or wider. Those of the other vertices
        are zero or wrong, but touch no sample.
    """
    is_seen = torch.zeros(len(vertices), dtype=torch.bool, device=faces.device)
    is_seen[fragments.corners.T.flatten()] = True
    first, second, third = is_seen.index_select(0, faces.flatten()).view(-1, 3).T
    faces_around = faces[first | second | third]
    vertices = vertices.to(torch.promote_types(vertices.dtype, torch.float32))
    if len(vertices) < FEW * faces_around.numel():
        return vertex_normals(vertices, faces_around)
    used, faces_of_used = faces_around.unique(return_inverse=True)
    normals = vertex_normals(vertices.index_select(0, used), faces_of_used)
    return torch.zeros_like(vertices, requires_grad=False).index_copy(0, used, normals)


def smooth_normals(fragments: Fragments, normals: Float[Tensor, "V 3"]) -> Float[Tensor, "S 3"]:
    """Interpolate vertex normals to the samples, on the side that the camera sees.

    Args:
        fragments: Samples of the view.
        normals: Normals of the vertices, shape (V, 3).

    Returns:
        Normals that are not of unit length, shape (S, 3).
    """
    corners = fragments.corners.T.flatten()
    # Shape (3 components, 3 corners, seen faces).
    at_corners = normals.T.index_select(1, corners).unflatten(1, (3, -1))
    toward_camera_side = at_corners * fragments.facing.T.to(normals)
    return fragments.interpolate(toward_camera_side.permute(2, 1, 0))
