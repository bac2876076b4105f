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

Shapes use these letters: a view has S covered samples in P pixels, which show G
of the F faces of a mesh with V vertices. K is the number of SH coefficients of
the light, (degree + 1)².
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import require_bounded
from renderer.geometry.normals import SPARSE_VERTEX_RATIO, area_vectors, vertex_normals
from renderer.light import harmonics
from renderer.shading.gloss import SampleGloss, at_samples, toward_camera
from renderer.shading.lobes import along, coat_bands
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Number of normals that are shaded at once. The values of so many normals stay in
# the cache of the processor.
BLOCK = 2**14
# Number of color channels.
COLORS = 3


def radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "V 3"] | None = None,
) -> Float[Tensor, "3 P"]:
    """Compute the linear radiance of the P covered pixels of a matte surface.

    The result is differentiable with respect to the vertices, the light and the
    albedo.

    Args:
        fragments: The S covered samples of the view.
        vertices: Vertex positions in world axes, shape (V, 3).
        light: SH coefficients of any degree, shape (K, 3).
        albedo: Linear albedo at the samples (see `renderer.surface.albedo`),
            shape (S, 3).
        normals: Vertex normals for smooth shading, from `normals_in_sight`,
            shape (V, 3). None for flat shading with the normals of the faces.

    Returns:
        Radiance times the coverage of the pixel, in the dtype of `vertices`,
        shape (3, P).

    Raises:
        InputError: If an argument holds NaN.
    """
    # `area_vectors` checks the vertices, and `irradiance` checks the light.
    require_bounded(albedo=albedo)
    # Float16 would lose too much precision.
    wide = torch.promote_types(vertices.dtype, torch.float32)
    albedo = albedo.to(wide)
    # Either shade the seen faces, or shade the normals at the samples.
    if normals is None:
        # Samples of the same face and pixel are joined to runs. The weights are
        # the albedo of the runs, divided by the number of samples in a pixel.
        pixel, seen_face, weights = fragments.merge(albedo)
        face_normals = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shade = irradiance(face_normals, light, wide).index_select(1, seen_face)
    else:
        pixel = fragments.sample_to_pixel
        weights = albedo / fragments.samples**2
        shade = irradiance(smooth_normals(fragments, normals.to(wide)).T, light, wide)
    # Reflected radiance of each run or sample in three channels, shape (3, runs or S).
    reflected = shade * weights.T
    # With one sample per pixel, each sample is a pixel, and no sum is needed.
    if fragments.samples > 1:
        zeros = reflected.new_zeros(COLORS, len(fragments.pixels))
        reflected = zeros.index_add(1, pixel, reflected)
    return reflected.to(vertices.dtype)


def glossy_radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "V 3"] | None,
    gloss: SampleGloss,
) -> Float[Tensor, "3 P"]:
    """Compute the linear radiance of the P covered pixels of a glossy surface.

    The result is differentiable with respect to the vertices, the light, the
    albedo and the gloss.

    Args:
        fragments: The S covered samples of the view.
        vertices: Vertex positions in world axes, shape (V, 3).
        light: SH coefficients of any degree, shape (K, 3).
        albedo: Linear albedo at the samples, shape (S, 3).
        normals: Vertex normals for smooth shading, shape (V, 3), or None for
            flat shading (see `radiance`).
        gloss: Gloss at the samples (see `renderer.shading.gloss`).

    Returns:
        Radiance times the coverage of the pixel, in the dtype of `vertices`,
        shape (3, P).

    Raises:
        InputError: If an argument holds NaN.
    """
    wide = torch.promote_types(vertices.dtype, torch.float32)
    # Unit normals at the samples, shape (S, 3). `unit` and `area_vectors` have the
    # three components along the first axis.
    if normals is None:
        face_normals = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shading_normals = unit(face_normals).T[fragments.sample_to_seen_face].to(wide)
    else:
        shading_normals = unit(smooth_normals(fragments, normals.to(wide)).T).T
    to_camera = toward_camera(fragments, vertices.to(wide))
    albedo = albedo.to(wide)
    light = light.to(wide)
    gloss = gloss.to(shading_normals)
    # Albedo of the diffuse surface below the coat, as the camera sees it.
    diffuse_albedo = albedo * gloss.diffuse(shading_normals, to_camera)[:, None]
    # `radiance` lets all light reach the diffuse surface. The light that the coat
    # reflects does not reach it, so its diffuse reflection is subtracted.
    specular_blocks = []
    for first in range(0, len(shading_normals), BLOCK):
        block = slice(first, first + BLOCK)
        reflected = _lobe_radiance(
            shading_normals[block],
            at_samples(to_camera, block),
            light,
            albedo[block],
            gloss.at(block),
        )
        coat_irradiance = _coat_irradiance(shading_normals[block].T, light, gloss.at(block))
        specular_blocks.append(reflected - diffuse_albedo[block].T * coat_irradiance)
    # The empty first part keeps the shape (3, 0) if there are no samples.
    specular = torch.cat([light.new_zeros(COLORS, 0), *specular_blocks], dim=1)
    specular = specular / fragments.samples**2
    diffuse = radiance(fragments, vertices, light, diffuse_albedo, normals)
    zeros = specular.new_zeros(COLORS, len(fragments.pixels))
    return diffuse + zeros.index_add(1, fragments.sample_to_pixel, specular).to(diffuse)


def _lobe_radiance(
    normals: Tensor, to_camera: Tensor, light: Tensor, albedo: Tensor, gloss: SampleGloss
) -> Tensor:
    """Compute the radiance of specular reflection at S samples under environment light.

    Args:
        normals: Unit normals, shape (S, 3).
        to_camera: Unit vectors to the camera, shape (S, 3), or (1, 3) if all
            samples share one vector.
        light: SH coefficients, shape (K, 3).
        albedo: Linear albedo, shape (S, 3).
        gloss: Gloss at the samples.

    Returns:
        Radiance, shape (3, S).
    """
    # Radiance per unit of each coefficient of the light, in the axes of `frame`,
    # shape (K, S). Metals multiply the `colored` part by the albedo. The `white`
    # part has the color of the light.
    colored, white, frame = gloss.transfer(normals, to_camera, harmonics.degree_of(light))
    light_in_frame = frame.from_world(light).T
    reflected = light_in_frame @ white
    if colored is not None:
        reflected = reflected + albedo.T * (light_in_frame @ colored)
    return reflected


def _coat_irradiance(normals: Tensor, light: Tensor, gloss: SampleGloss) -> Tensor:
    """Compute the irradiance that the dielectric coat reflects at S samples.

    This is the part of the irradiance that does not reach the diffuse surface
    below the coat.

    Args:
        normals: Unit normals, shape (3, S).
        light: SH coefficients of environment light, shape (K, 3).
        gloss: Gloss at the samples.

    Returns:
        Irradiance, shape (3, S).
    """
    degree = min(harmonics.degree_of(light), harmonics.DIFFUSE_DEGREE)
    # Only these first coefficients reach a diffuse surface. There are K of them.
    light = light[: (degree + 1) ** 2]
    # The factor by which the coat reflects a coefficient is a sum over R
    # polynomials of the roughness. Coefficients of this sum, shape (K, R).
    factor_coefficients = coat_bands(degree).to(light)[harmonics.bands(degree)]
    # Values of the polynomials, shape (R, S), or (R, 1) if all samples have the
    # same roughness.
    polynomials = along(gloss.roughness)
    if len(gloss.roughness) == 1:
        # Coefficients of the reflected light, shape (K, 3).
        reflected_light = (factor_coefficients @ polynomials) * light
        return gloss.specular_factor * _HarmonicSum.apply(normals, reflected_light)
    # One reflected light for each polynomial, shape (K, R · 3).
    lights = (factor_coefficients[..., None] * light[:, None]).flatten(1)
    # Irradiance under each of these lights, shape (R, 3, S).
    irradiances = _HarmonicSum.apply(normals, lights).unflatten(0, (-1, COLORS))
    return gloss.specular_factor * (irradiances * polynomials[:, None]).sum(0)


class _HarmonicSum(torch.autograd.Function):
    """Sum Σ_k c_k Y_k(n) of spherical harmonics, for C channels at N unit normals.

    On the sphere, the harmonics of all even degrees together are one homogeneous
    polynomial, and so are those of all odd degrees. If p is a homogeneous
    polynomial of degree d, its value follows from its gradient (called slope):
    p(n) = n · ∇p(n) / d. The slope is also needed for the derivative by the
    normal, so only the slope is evaluated.
    """

    @staticmethod
    def forward(ctx: Any, normals: Tensor, coefficients: Tensor) -> Tensor:
        """Compute the sums.

        Args:
            ctx: Context of autograd.
            normals: Unit normals, shape (3, N).
            coefficients: Coefficients c_k of the K harmonics, shape (K, C).

        Returns:
            Sums, shape (C, N).
        """
        degree = math.isqrt(len(coefficients)) - 1
        # Band 0 (degree 0) is constant: Y_0 = 1 / √(4π). Shape (C, 1).
        value = (coefficients[0] / math.sqrt(4 * math.pi))[:, None]
        slope = normals.new_zeros(3, coefficients.shape[1], 1)
        # One polynomial has the degree of the light, and the other one degree less.
        for power in range(max(degree - 1, 1), degree + 1):
            # Gradients of the harmonics in monomials, shape (3 axes, monomials, K).
            harmonic_slopes = _slopes(power).to(coefficients)[..., : len(coefficients)]
            # Gradient of the sum in monomials, for the C channels, shape (3 axes, monomials, C).
            slope_coefficients = harmonic_slopes @ coefficients[: harmonic_slopes.shape[2]]
            # Gradient of the sum at the N normals, shape (3 axes, C, N).
            polynomial_slope = slope_coefficients.mT @ harmonics.monomials(normals, power - 1)
            value = value + (polynomial_slope * normals[:, None]).sum(0) / power
            slope = slope + polynomial_slope
        ctx.save_for_backward(normals, slope)
        ctx.degree = degree
        return value.expand(-1, normals.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Compute the gradients by the normals and by the coefficients.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the sums, shape (C, N).

        Returns:
            Gradient by the normals, shape (3, N), and gradient by the
            coefficients, shape (K, C). None if a gradient is not needed.
        """
        normals, slope = ctx.saved_tensors
        normal_gradient = None
        coefficient_gradient = None
        if ctx.needs_input_grad[0]:
            normal_gradient = (slope * upstream).sum(1)
        if ctx.needs_input_grad[1]:
            # Values of the K harmonics at the normals, shape (N,) each.
            rows = harmonics.evaluate_harmonics(normals, range((ctx.degree + 1) ** 2))
            coefficient_gradient = torch.stack(rows) @ upstream.T
        return normal_gradient, coefficient_gradient


def irradiance(
    normals: Float[Tensor, "3 N"], light: Float[Tensor, "coefficients 3"], dtype: torch.dtype
) -> Float[Tensor, "3 N"]:
    """Compute the irradiance of environment light on surfaces with N normals.

    The result is differentiable with respect to the normals and the light. The
    source is the paper's equation for R in appendix B.2, and its derivative by
    the normal in appendix D. Both are evaluated as polynomials of the normal.

    Args:
        normals: Finite normals of any length, shape (3, N). They are divided by
            their lengths in their own dtype.
        light: SH coefficients, shape (K, 3).
        dtype: Data type of all other computations, float32 or float64.

    Returns:
        Irradiance in three color channels, shape (3, N). Its gradient by the
        coefficients that do not reach a diffuse surface is exactly zero.

    Raises:
        InputError: If the light holds NaN, or if its shape is not
            ((degree + 1)², 3).
    """
    require_bounded(light=light)
    # `degree_of` raises InputError if K is not (degree + 1)².
    harmonics.degree_of(light)
    return _Irradiance.apply(normals, light.to(dtype))


class _Irradiance(torch.autograd.Function):
    """Irradiance of environment light, with its derivatives, see `irradiance`.

    The forward pass computes the irradiance from its gradient by the normal,
    called slope. It stores the slope for the backward pass.
    """

    @staticmethod
    def forward(ctx: Any, normals: Tensor, light: Tensor) -> Tensor:
        """Compute the irradiance at N normals.

        Args:
            ctx: Context of autograd.
            normals: Normals of any length, shape (3, N).
            light: SH coefficients, shape (K, 3).

        Returns:
            Irradiance in three color channels, shape (3, N).
        """
        directions, lengths = unit_vectors(normals)
        directions = directions.to(light.dtype)
        polynomial = _IrradiancePolynomial(light)
        # Pairs of the value, shape (3 colors, BLOCK), and the slope, shape
        # (3 axes, 3 colors, BLOCK).
        pairs = [polynomial.evaluate(block) for block in directions.split(BLOCK, dim=1)]
        value, slope = (torch.cat(blocks, dim=-1) for blocks in zip(*pairs, strict=True))
        # Deleting the list releases the memory of the blocks.
        del pairs
        zero_normals = torch.nonzero(lengths == 0).squeeze(1)
        if len(zero_normals):
            # The polynomial equals the harmonics only at unit vectors. At a zero
            # vector, the harmonics themselves are evaluated.
            degree = math.isqrt(len(light)) - 1
            nonzero, irradiance_per_unit = _diffuse_basis(directions[:, zero_normals], degree)
            value[:, zero_normals] = light[nonzero].T @ irradiance_per_unit
        ctx.save_for_backward(directions, lengths, slope if ctx.needs_input_grad[0] else None)
        ctx.light_shape = light.shape
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Compute the gradients by the normals and by the light.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the irradiance, shape (3, N).

        Returns:
            Gradient by the normals, shape (3, N), and gradient by the SH
            coefficients, shape (K, 3). None if a gradient is not needed.
        """
        directions, lengths, slope = ctx.saved_tensors
        normal_gradient = None
        light_gradient = None
        if ctx.needs_input_grad[0]:
            # Sum over the colors, in place to save memory, shape (3 axes, N).
            gradient = slope[:, 0] * upstream[0]
            gradient.addcmul_(slope[:, 1], upstream[1]).addcmul_(slope[:, 2], upstream[2])
            # Only turning a normal changes the irradiance, so the part along the
            # normal is removed. A zero normal has the gradient 0.
            tangential = gradient - directions * (directions * gradient).sum(0)
            normal_gradient = tangential / lengths.masked_fill(lengths == 0, torch.inf)
        if ctx.needs_input_grad[1]:
            degree = math.isqrt(ctx.light_shape[0]) - 1
            light_gradient = directions.new_zeros(ctx.light_shape)
            blocks = zip(directions.split(BLOCK, dim=1), upstream.split(BLOCK, dim=1), strict=True)
            for block_directions, block_upstream in blocks:
                nonzero, irradiance_per_unit = _diffuse_basis(block_directions, degree)
                light_gradient[nonzero] += irradiance_per_unit @ block_upstream.T
        return normal_gradient, light_gradient


class _IrradiancePolynomial:
    """Irradiance under one light, as a polynomial of the unit normal n.

    A band is the set of harmonics of one degree. On the unit sphere, the bands of
    even degree from 2 on together are one homogeneous polynomial p(n) of degree
    d. Band 0 is a constant c, and band 1 a linear function a · n. Other bands do
    not reach a diffuse surface. The irradiance is c + a · n + p(n). The gradient
    ∇p is a sum over the J monomials of degree d - 1.

    Attributes:
        degree: Degree d.
        even_slope: Coefficients of ∇p in the monomials, for 3 axes and 3 colors,
            shape (9, J).
        linear_slope: Vector a for 3 axes and 3 colors, shape (9, 1).
        constant: Constant c for 3 colors, shape (3, 1).
    """

    def __init__(self, light: Tensor):
        """Compute the coefficients of the polynomial.

        Args:
            light: SH coefficients, shape (K, 3).
        """
        light_degree = math.isqrt(len(light)) - 1
        # Slopes per unit of each coefficient that reaches a diffuse surface. The J entries of
        # ∇p come first, and then the one entry of a, shape (3 axes, J + 1, coefficients).
        slopes_per_light = _slopes_per_light(light_degree, light.dtype, light.device)
        # Slopes of this light, shape (3 axes, J + 1, 3 colors). They are reordered to the
        # shape (3 axes · 3 colors, J + 1).
        slopes_by_axis = slopes_per_light @ light[: slopes_per_light.shape[2]]
        slopes = slopes_by_axis.mT.flatten(0, 1)
        self.degree = _even_degree(light_degree)
        self.even_slope = slopes[:, :-1]
        self.linear_slope = slopes[:, -1:]
        # Irradiance from band 0: the factor π of a Lambertian surface, times the coefficient
        # U_0, times the harmonic Y_0 = 1 / √(4π).
        self.constant = light[:1].T * math.sqrt(math.pi / 4)

    def evaluate(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the irradiance and its slope at N unit normals.

        Args:
            directions: Unit normals n, shape (3, N).

        Returns:
            A tuple of
            - the irradiance, shape (3 colors, N);
            - the slope a + ∇p(n), shape (3 axes, 3 colors, N). Its part
              tangential to the sphere is the derivative of the irradiance. Its
              part along n has no meaning.
        """
        # A tensor of monomials with a name would stay in memory until the function
        # returns.
        slope = torch.addmm(
            self.linear_slope, self.even_slope, harmonics.monomials(directions, self.degree - 1)
        ).unflatten(0, (3, COLORS))
        # The irradiance is c + a · n + p(n) with p(n) = n · ∇p(n) / d. The loop adds
        # n · slope / d = p(n) + a · n / d. The first line adds the rest,
        # c + (1 - 1/d) a · n.
        linear = self.linear_slope.view(3, COLORS).T
        value = torch.addmm(self.constant, linear, directions, alpha=1 - 1 / self.degree)
        for slope_along_axis, normal_component in zip(slope, directions, strict=True):
            value.addcmul_(slope_along_axis, normal_component, value=1 / self.degree)
        return value, slope


@harmonics.cache_tensors
def _slopes_per_light(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Compute the matrices that map the SH coefficients of a light to `_IrradiancePolynomial`.

    Args:
        degree: Degree of the light.
        dtype: Data type of the result.
        device: Device of the result.

    Returns:
        Matrix for each of the 3 axes, shape (3, J + 1, K'). The first J rows map
        to the coefficients of ∇p in monomials, and the last row maps to the
        vector a of band 1. K' counts the coefficients of the light up to the
        degree of p.
    """
    even_degree = _even_degree(degree)
    # `_slopes(1)` has a column for each of the 4 harmonics up to degree 1.
    linear_slopes = F.pad(_slopes(1), (0, (even_degree + 1) ** 2 - 4))
    slopes = torch.cat([_slopes(even_degree), linear_slopes], dim=1)
    irradiance_slopes = slopes * harmonics.lambertian_factors(even_degree)
    return irradiance_slopes[..., : (degree + 1) ** 2].to(device, dtype)


def _even_degree(degree: int) -> int:
    """Return the degree of the polynomial that the even bands of a light are together.

    Band 0 does not count, so the result is at least 2. Bands above
    `harmonics.DIFFUSE_DEGREE` do not reach a diffuse surface.

    Args:
        degree: Degree of the light.

    Returns:
        Even degree.
    """
    return max(min(degree, harmonics.DIFFUSE_DEGREE) - degree % 2, 2)


@harmonics.cache_tensors
def _slopes(degree: int) -> Tensor:
    """Compute the gradients of spherical harmonics that are extended to homogeneous polynomials.

    The harmonic Y_k of degree l, with l of the same parity as `degree`, equals the
    homogeneous polynomial |n|^degree Y_k(n / |n|) on the unit sphere (see
    `harmonics.homogeneous_gradients`). Its gradient is a sum of monomials of
    degree `degree` - 1.

    Args:
        degree: Degree of the polynomials.

    Returns:
        Coefficients of the gradients, shape (3 axes, monomials, (degree + 1)²),
        with one column for each harmonic. Columns are zero for degree 0 and for
        degrees l of the other parity.
    """
    band = harmonics.bands(degree)
    gradients = harmonics.homogeneous_gradients(degree)[:, : degree**2]
    slopes = harmonics.monomial_coefficients(degree - 1) @ gradients
    has_same_parity = band % 2 == degree % 2
    return slopes * ((band > 0) & has_same_parity)


def _diffuse_basis(directions: Tensor, degree: int) -> tuple[list[int], Tensor]:
    """Compute the irradiance per unit of each SH coefficient that reaches a diffuse surface.

    Args:
        directions: Unit or zero normals, shape (3, N).
        degree: Degree of the light.

    Returns:
        A tuple of
        - the ascending indices of the M coefficients that reach a diffuse
          surface;
        - the irradiance per unit of each of these coefficients, shape (M, N).
    """
    nonzero = harmonics.nonzero_coefficients(degree).tolist()
    factors = harmonics.lambertian_factors(degree).to(directions)[nonzero, None]
    return nonzero, torch.stack(harmonics.evaluate_harmonics(directions, nonzero)) * factors


def normals_in_sight(
    fragments: Fragments, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Compute the normals of the vertices of all faces that a view shows.

    Args:
        fragments: Covered samples of the view, which show the seen faces.
        vertices: Vertex positions in world axes, shape (V, 3).
        faces: Vertex indices of the faces, shape (F, 3).

    Returns:
        Unit normals, float32 or float64, shape (V, 3). Vertices of faces that
        are not seen have a zero or wrong normal, which no sample uses.
    """
    is_seen_vertex = torch.zeros(len(vertices), dtype=torch.bool, device=faces.device)
    is_seen_vertex[fragments.corners.T.flatten()] = True
    # A vertex normal is an average over all faces around the vertex, so faces with
    # at least one seen vertex are needed.
    has_seen_corner = is_seen_vertex.index_select(0, faces.flatten()).view(-1, 3)
    first, second, third = has_seen_corner.T
    needed_faces = faces[first | second | third]
    vertices = vertices.to(torch.promote_types(vertices.dtype, torch.float32))
    if len(vertices) < SPARSE_VERTEX_RATIO * needed_faces.numel():
        return vertex_normals(vertices, needed_faces)
    # If the needed faces have few of the vertices, compute normals of these only.
    used_vertices, renumbered_faces = needed_faces.unique(return_inverse=True)
    normals = vertex_normals(vertices.index_select(0, used_vertices), renumbered_faces)
    zeros = torch.zeros_like(vertices, requires_grad=False)
    return zeros.index_copy(0, used_vertices, normals)


def smooth_normals(fragments: Fragments, normals: Float[Tensor, "V 3"]) -> Float[Tensor, "S 3"]:
    """Interpolate vertex normals at the samples of a view.

    The normals of faces that are seen from behind are reversed, so that they
    point to the side of the camera.

    Args:
        fragments: The S covered samples of the view.
        normals: Vertex normals, shape (V, 3).

    Returns:
        Interpolated normals, which are not of unit length, shape (S, 3).
    """
    corner_vertices = fragments.corners.T.flatten()
    # Vertex normals at the corners of the seen faces, shape (3 components, 3 corners, G).
    corner_normals = normals.T.index_select(1, corner_vertices).unflatten(1, (3, -1))
    facing_normals = corner_normals * fragments.facing.T.to(normals)
    # `interpolate` takes the shape (G, 3 corners, 3 components).
    return fragments.interpolate(facing_normals.permute(2, 1, 0))
