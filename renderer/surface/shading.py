"""Shading of the surface samples of a view, differentiable in vertices, light and albedo.

The radiance of a pixel is the mean (box filter) over its s² samples i, with
albedo ρ_i and unit normal n_i:

    L = 1/s² Σ_i ρ_i E(n_i),    E(n) = Σ_lm A_l U_lm Y_lm(n),

with the harmonics Y_lm, the coefficients U_lm of the light, and the factors
A_l = π, 2π/3, π/4, 0, −π/24, 0, π/64, ... E is the irradiance of a diffuse
surface (Ramamoorthi and Hanrahan 2001; the paper's appendix B.2).

On the sphere, the bands of even degree from 2 on are together one homogeneous
polynomial p of degree d. By Euler's theorem, its value follows from its gradient:
p(n) = n · ∇p(n) / d. One product of monomials with the coefficients of the
gradient therefore gives both E and ∇E. The component of ∇E that is tangent to the
sphere, (∇E − n (n · ∇E)) / |normal|, is the derivative with respect to the normal
(the paper's appendix D).

Visibility and texture coordinates are fixed (the paper's Section 3 and appendix
B.3). The derivative with respect to the vertices contains how normals turn, but
not how silhouette edges move. For derivatives with respect to the light alone,
`renderer.operators.apply` is faster.

Shapes use these letters: a view has S covered samples in P pixels, which show G
of the F faces of a mesh with V vertices. K is the number of SH coefficients of
the light, (degree + 1)².
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from renderer.errors import require_bounded
from renderer.light import harmonics
from renderer.mesh import Mesh
from renderer.modes import once_differentiable
from renderer.normals import area_vectors, vertex_normals
from renderer.surface.albedo import of_seen_faces
from renderer.surface.gloss import SampleGloss, at_samples, toward_camera
from renderer.surface.lobes import coat_irradiance_factors, roughness_polynomials
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import BLOCK_ON_CPU, Fragments, block_size, split_samples

# With gloss, a sample takes so many times the memory.
GLOSSY_FACTOR = 16
# Number of color channels.
COLORS = 3


def radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "*views coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "G 3 3"] | None = None,
) -> Float[Tensor, "3 P"]:
    """Compute the linear radiance of the P covered pixels of a matte surface.

    The result is differentiable with respect to the vertices, the light and the
    albedo. The radiance is multiplied by the covered fraction of each pixel. `normals`
    come from `normals_in_sight`, or are None for flat shading. All views have the same light,
    or each has one of its own.
    """
    # Only the albedo is checked here. `area_vectors` checks the vertices, and `irradiance`
    # checks the light.
    require_bounded(albedo=albedo)
    # Float16 would lose too much precision.
    wide = torch.promote_types(vertices.dtype, torch.float32)
    albedo, light = albedo.to(wide), light.to(wide)
    if normals is None:
        # All samples of a face in a pixel have the same irradiance. They are merged: the
        # weight of a pair of face and pixel is their mean albedo times their share of the
        # samples of the pixel.
        weights = fragments.merge(albedo)
        pixel = fragments.groups.group_to_pixel
        face_normals = area_vectors(vertices, fragments.corners) * fragments.facing.T
        view = fragments.view_of_face if light.ndim > 2 else None
        incoming = irradiance(face_normals, light, view)
        incoming = incoming.index_select(1, fragments.groups.group_to_seen_face)
    else:
        pixel = fragments.sample_to_pixel
        weights = albedo / fragments.samples**2
        shading_normals = smooth_normals(fragments, normals.to(wide))
        view = fragments.view_of_sample if light.ndim > 2 else None
        incoming = irradiance(shading_normals.T, light, view)
    reflected = incoming * weights.T
    # Each column of `reflected` is a pixel already if a pixel has one sample.
    if fragments.samples > 1:
        zeros = reflected.new_zeros(COLORS, len(fragments.pixels))
        reflected = zeros.index_add(1, pixel, reflected)
    return reflected.to(vertices.dtype)


def glossy_radiance(
    fragments: Fragments,
    vertices: Float[Tensor, "V 3"],
    light: Float[Tensor, "coefficients 3"],
    albedo: Float[Tensor, "S 3"],
    normals: Float[Tensor, "G 3 3"] | None,
    gloss: SampleGloss,
) -> Float[Tensor, "3 P"]:
    """Compute the linear radiance of the P covered pixels of a glossy surface.

    The result is differentiable with respect to the vertices, the light, the
    albedo and the gloss.
    """
    wide = torch.promote_types(vertices.dtype, torch.float32)
    # The functions `unit` and `area_vectors` have the three components along the first
    # axis, but `shading_normals` has them along the second axis.
    if normals is None:
        face_normals = area_vectors(vertices, fragments.corners) * fragments.facing.T
        shading_normals = unit(face_normals).T[fragments.sample_to_seen_face].to(wide)
    else:
        shading_normals = unit(smooth_normals(fragments, normals.to(wide)).T).T
    to_camera = toward_camera(fragments, vertices.to(wide))
    albedo = albedo.to(wide)
    light = light.to(wide)
    gloss = gloss.to(shading_normals)
    # Albedo of the diffuse layer below the transparent coat, as the camera sees it.
    diffuse_albedo = albedo * gloss.diffuse_factor((shading_normals * to_camera).sum(1))[:, None]
    specular_blocks = []
    size = max(BLOCK_ON_CPU, block_size(light.device) // GLOSSY_FACTOR)
    for first in range(0, len(shading_normals), size):
        block = slice(first, first + size)
        normals_here, gloss_here = shading_normals[block], gloss.at(block)
        # One row for each SH coefficient, one column for each sample. The reflection of metals
        # (colored) is multiplied by the albedo. All other specular reflection (white) has the
        # color of the light.
        colored, white, frame = gloss_here.specular_transfer(
            normals_here, at_samples(to_camera, block), harmonics.degree_of(light)
        )
        light_in_frame = frame.from_world(light).T
        reflected = light_in_frame @ white
        if colored is not None:
            reflected = reflected + albedo[block].T * (light_in_frame @ colored)
        coat_irradiance = _coat_irradiance(normals_here.T, light, gloss_here)
        # `radiance` below lets all light reach the diffuse layer. Subtract the diffuse
        # reflection of the light that the coat reflects and that does not reach it.
        specular_blocks.append(reflected - diffuse_albedo[block].T * coat_irradiance)
    # The empty first tensor gives the result the shape (3, 0) if there are no samples.
    specular = torch.cat([light.new_zeros(COLORS, 0), *specular_blocks], dim=1)
    specular = specular / fragments.samples**2
    diffuse = radiance(fragments, vertices, light, diffuse_albedo, normals)
    zeros = specular.new_zeros(COLORS, len(fragments.pixels))
    return diffuse + zeros.index_add(1, fragments.sample_to_pixel, specular).to(diffuse)


def _coat_irradiance(
    normals: Float[Tensor, "3 S"], light: Float[Tensor, "K 3"], gloss: SampleGloss
) -> Float[Tensor, "3 S"]:
    """Compute the irradiance that the coat reflects and does not pass to the diffuse layer."""
    degree = min(harmonics.degree_of(light), harmonics.DIFFUSE_DEGREE)
    # Coefficients of higher degrees are ignored, because they hardly change the irradiance.
    light = light[: (degree + 1) ** 2]
    # The coat multiplies each coefficient of the light by a factor, which is a sum over R
    # polynomials of the roughness. One row for each coefficient, one column for each
    # polynomial.
    factor_coefficients = coat_irradiance_factors(degree)[harmonics.bands(degree)]
    factor_coefficients = factor_coefficients.to(light, non_blocking=True)
    # One row for each polynomial, one column for each sample (or one for all samples).
    polynomials = roughness_polynomials(gloss.roughness)
    if len(gloss.roughness) == 1:
        reflected_light = (factor_coefficients @ polynomials) * light
        return gloss.specular_factor * _HarmonicSum.apply(normals, reflected_light)
    # Light times the factors of one polynomial: one row for each SH coefficient, one column
    # for each pair of polynomial and color.
    lights = (factor_coefficients[..., None] * light[:, None]).flatten(1)
    # Irradiance with the axes: polynomial, color, sample.
    irradiances = _HarmonicSum.apply(normals, lights).unflatten(0, (-1, COLORS))
    return gloss.specular_factor * (irradiances * polynomials[:, None]).sum(0)


class _HarmonicSum(torch.autograd.Function):
    """Sum Σ_k c_k Y_k(n) of spherical harmonics, for C channels at N unit normals.

    On the sphere, the harmonics of all even degrees together are one homogeneous
    polynomial, and so are those of all odd degrees. If p is a homogeneous
    polynomial of degree d, its value follows from its gradient:
    p(n) = n · ∇p(n) / d. The gradient is also needed for the derivative with
    respect to the normal, so only the gradient is evaluated.
    """

    @staticmethod
    def forward(
        ctx: Any, normals: Float[Tensor, "3 N"], coefficients: Float[Tensor, "K C"]
    ) -> Float[Tensor, "C N"]:
        """Compute the sum Σ_k c_k Y_k(n) for each channel and each normal n."""
        degree = math.isqrt(len(coefficients)) - 1
        # The harmonic of degree 0 has the constant value 1 / √(4π).
        value = (coefficients[0] / math.sqrt(4 * math.pi))[:, None]
        gradient = normals.new_zeros(3, coefficients.shape[1], 1)
        # The harmonics with the parity of `degree` are one homogeneous polynomial of this
        # degree. All others are one polynomial of degree `degree` - 1.
        for power in range(max(degree - 1, 1), degree + 1):
            # Gradient of each harmonic, with the axes: direction of the derivative,
            # monomial, harmonic.
            harmonic_gradients = _gradients(power)[..., : len(coefficients)]
            harmonic_gradients = harmonic_gradients.to(coefficients, non_blocking=True)
            # Gradient of the sum, with the axes: direction of the derivative, monomial,
            # channel.
            in_monomials = harmonic_gradients @ coefficients[: harmonic_gradients.shape[2]]
            # Gradient at the normals, with the axes: direction, channel, normal.
            polynomial_gradient = in_monomials.mT @ harmonics.monomials(normals, power - 1)
            value = value + (polynomial_gradient * normals[:, None]).sum(0) / power
            gradient = gradient + polynomial_gradient
        ctx.save_for_backward(normals, gradient)
        ctx.degree = degree
        return value.expand(-1, normals.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "C N"]) -> tuple[Tensor | None, Tensor | None]:
        """Compute the gradients with respect to the normals and the coefficients."""
        normals, gradient = ctx.saved_tensors
        normal_gradient = (gradient * upstream).sum(1) if ctx.needs_input_grad[0] else None
        coefficient_gradient = None
        if ctx.needs_input_grad[1]:
            # One tensor for each of the K harmonics, with its values at the normals.
            values = harmonics.evaluate_harmonics(normals, range((ctx.degree + 1) ** 2))
            coefficient_gradient = torch.stack(values) @ upstream.T
        return normal_gradient, coefficient_gradient


def irradiance(
    normals: Float[Tensor, "3 N"],
    light: Float[Tensor, "*views coefficients 3"],
    view: Int[Tensor, " N"] | None = None,
) -> Float[Tensor, "3 N"]:
    """Compute the irradiance of environment light on surfaces with N normals.

    The result is differentiable with respect to the normals and the light. The
    irradiance is the function R in appendix B.2 of Liu et al. 2019. Appendix D has
    its derivative. Both are evaluated as polynomials of the normal. The normals have any
    length. Coefficients of odd degrees from 3 on change nothing, and their gradient is
    exactly 0. If each view has its own light, `view` is the view of each normal, ascending.
    """
    require_bounded(light=light)
    # `degree_of` raises InputError if K is not (degree + 1)².
    harmonics.degree_of(light[0] if view is not None else light)
    if view is None:
        return _Irradiance.apply(normals, light)
    of_views = normals.split(view.bincount(minlength=len(light)).tolist(), dim=1)
    return torch.cat([_Irradiance.apply(*each) for each in zip(of_views, light, strict=True)], 1)


class _Irradiance(torch.autograd.Function):
    """Irradiance of environment light, differentiable in the normals and the light.

    The forward pass first computes the gradient of the irradiance with respect to
    the normal, and from it the irradiance. The backward pass uses the gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, normals: Float[Tensor, "3 N"], light: Float[Tensor, "K 3"]
    ) -> Float[Tensor, "3 N"]:
        """Compute the irradiance at N normals."""
        directions, lengths = unit_vectors(normals)
        directions = directions.to(light.dtype)
        value, gradient = _evaluate_polynomial(light, directions)
        is_zero = lengths == 0
        if is_zero.is_cuda or len(is_zero.nonzero()):  # The second test would wait for a GPU.
            # The polynomial is the irradiance only for unit normals.
            per_unit = _irradiance_at_zero(math.isqrt(len(light)) - 1).to(light, non_blocking=True)
            value = torch.where(is_zero, light.T @ per_unit, value)
        ctx.save_for_backward(directions, lengths, gradient if ctx.needs_input_grad[0] else None)
        ctx.light_shape = light.shape
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "3 N"]) -> tuple[Tensor | None, Tensor | None]:
        """Compute the gradients with respect to the normals and the light."""
        # The gradient of the irradiance has the axes: direction, color, normal.
        directions, lengths, color_gradients = ctx.saved_tensors
        normal_gradient = None
        light_gradient = None
        if ctx.needs_input_grad[0]:
            # Add up red, green and blue. The additions are in place to save memory.
            gradient = color_gradients[:, 0] * upstream[0]
            gradient.addcmul_(color_gradients[:, 1], upstream[1])
            gradient.addcmul_(color_gradients[:, 2], upstream[2])
            # The length of a normal does not change the irradiance, so the component of
            # the gradient along the normal is removed.
            tangential = gradient - directions * (directions * gradient).sum(0)
            # A normal of length 0 gets the gradient 0.
            normal_gradient = tangential / lengths.masked_fill(lengths == 0, torch.inf)
        if ctx.needs_input_grad[1]:
            degree = math.isqrt(ctx.light_shape[0]) - 1
            light_gradient = directions.new_zeros(ctx.light_shape)
            for block_directions, block_upstream in split_samples(directions, upstream):
                nonzero, irradiance_per_unit = harmonics.diffuse_basis(block_directions, degree)
                light_gradient[nonzero] += irradiance_per_unit @ block_upstream.T
        return normal_gradient, light_gradient


@harmonics.cache_tensors
def _irradiance_at_zero(degree: int) -> Float[Tensor, "K 1"]:
    """Evaluate the irradiance of each harmonic at a normal of length 0."""
    zero = torch.zeros(3, 1, dtype=torch.float64)
    nonzero, per_unit = harmonics.diffuse_basis(zero, degree)
    return zero.new_zeros((degree + 1) ** 2, 1).index_copy(0, torch.tensor(nonzero), per_unit)


def _evaluate_polynomial(
    light: Float[Tensor, "K 3"], directions: Float[Tensor, "3 N"]
) -> tuple[Tensor, Tensor]:
    """Compute the irradiance (3 colors, N), and its gradient (3 components, 3 colors, N).

    The irradiance is the polynomial c + a · n + p(n) of `_gradient_of_light` at N unit normals n.
    Only the tangential component of its gradient is the derivative.
    """
    light_degree = math.isqrt(len(light)) - 1
    degree = _even_degree(light_degree)
    matrices = _gradient_of_light(light_degree, light.dtype, light.device)
    # Axes of the product: direction of the derivative, coefficient (those of ∇p first, then the
    # one of a), color. Then one row for each direction and color.
    coefficients = (matrices @ light[: matrices.shape[2]]).mT.flatten(0, 1)
    even, linear_gradient = coefficients[:, :-1], coefficients[:, -1:]
    linear = linear_gradient.view(3, COLORS).T
    # For degree 0, the irradiance is π U_0 Y_0 with the coefficient U_0 of the light and the
    # harmonic Y_0 = 1 / √(4π).
    constant = light[:1].T * math.sqrt(math.pi / 4)
    values, gradients = [], []
    for (block,) in split_samples(directions):
        # A tensor of monomials with a name would stay in memory.
        gradient = torch.addmm(linear_gradient, even, harmonics.monomials(block, degree - 1))
        gradient = gradient.unflatten(0, (3, COLORS))
        # Because p(n) = n · ∇p(n) / d, the irradiance is the sum of two terms: first
        # c + (1 - 1/d) a · n, and then n · (a + ∇p(n)) / d, which the loop adds.
        value = torch.addmm(constant, linear, block, alpha=1 - 1 / degree)
        for gradient_component, normal_component in zip(gradient, block, strict=True):
            value.addcmul_(gradient_component, normal_component, value=1 / degree)
        values.append(value)
        gradients.append(gradient)
    return torch.cat(values, dim=-1), torch.cat(gradients, dim=-1)


@harmonics.cache_tensors
def _gradient_of_light(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Compute the matrices that map SH coefficients of a light to the gradient of irradiance.

    The irradiance is a polynomial c + a · n + p(n) of the normal n. The constant c comes from the
    harmonic of degree 0, the vector a from those of degree 1, and the homogeneous polynomial p from
    those of even degree from 2 on. The gradient is therefore a + ∇p(n). The shape is (3 components,
    monomials + 1, coefficients). The last row gives a, and the others ∇p.
    """
    even_degree = _even_degree(degree)
    # Gradients of the 4 harmonics up to degree 1, and zeros for all other harmonics.
    linear_gradients = F.pad(_gradients(1), (0, (even_degree + 1) ** 2 - 4))
    # Axes: component of the gradient, monomial (the constant 1 last), harmonic.
    gradients = torch.cat([_gradients(even_degree), linear_gradients], dim=1)
    irradiance_gradients = gradients * harmonics.lambertian_factors(even_degree)
    return irradiance_gradients[..., : (degree + 1) ** 2].to(device, dtype)


def _even_degree(degree: int) -> int:
    """Return the highest even degree that counts, at least 2 (see `harmonics.DIFFUSE_DEGREE`)."""
    highest = min(degree, harmonics.DIFFUSE_DEGREE)
    return max(highest - highest % 2, 2)


@harmonics.cache_tensors
def _gradients(degree: int) -> Tensor:
    """Compute the gradients of spherical harmonics that are extended to homogeneous polynomials.

    The harmonic Y_k of degree l, with l of the same parity as `degree`, equals the homogeneous
    polynomial |n|^degree Y_k(n / |n|) on the unit sphere (see `harmonics.homogeneous_gradients`).
    Its gradient is a sum of monomials of degree `degree` - 1. The shape is (3 components,
    monomials, (degree + 1)²). Columns are zero for l = 0 and the other parity.
    """
    band = harmonics.bands(degree)
    # Each gradient as a sum of harmonics below `degree`. Axes: component of the gradient,
    # harmonic in the sum, harmonic Y_k.
    in_harmonics = harmonics.homogeneous_gradients(degree)[:, : degree**2]
    # The same gradients as sums of monomials.
    in_monomials = harmonics.monomial_coefficients(degree - 1) @ in_harmonics
    return in_monomials * ((band > 0) & (band % 2 == degree % 2))


def normals_in_sight(
    mesh: Mesh, fragments: Fragments, moved: Float[Tensor, "V 3"] | None
) -> Float[Tensor, "G 3 3"]:
    """Compute the normals at the corners of the G faces that a view shows.

    `moved` are other positions of the vertices, with a gradient, or None for those of the mesh.
    """
    if moved is None:
        # The mesh caches these normals, so all its views share them.
        return of_seen_faces(mesh.corner_normals, fragments)
    faces, normal_ids = (
        torch.from_numpy(ids).to(moved.device, non_blocking=True)
        for ids in (mesh.faces, mesh.normal_ids)
    )
    # All first corners of the seen faces, then all second and third corners.
    seen_ids = normal_ids.index_select(0, fragments.faces).T.flatten()
    count = int(mesh.normal_ids.max()) + 1
    is_seen = torch.zeros(count, dtype=torch.bool, device=faces.device)
    is_seen[seen_ids] = True
    # A normal is an average over all faces that share it, so these are all needed.
    is_needed = is_seen.index_select(0, normal_ids.flatten()).view(-1, 3).any(1)
    # A GPU would be waited for, and computes all of them as fast.
    needed = slice(None) if moved.is_cuda else is_needed.nonzero().squeeze(1)
    vertices = moved.to(torch.promote_types(moved.dtype, torch.float32))
    normals = vertex_normals(vertices, faces[needed], normal_ids[needed], count)
    return normals.T.index_select(1, seen_ids).unflatten(1, (3, -1)).permute(2, 1, 0)


def smooth_normals(fragments: Fragments, normals: Float[Tensor, "G 3 3"]) -> Float[Tensor, "S 3"]:
    """Interpolate the normals at corners to the samples of a view.

    The normals of faces that are seen from behind are reversed, so that they
    point to the side of the camera. The interpolated normals are not of unit length.
    """
    return fragments.interpolate(normals * fragments.facing[:, :, None].to(normals))
