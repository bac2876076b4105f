"""The light that rough surfaces reflect, as a sum over spherical harmonics.

The reflectance f of `renderer.microfacets` depends on the normal n, the
direction l to the light, the direction v to the camera, and the roughness r. It
has three Fresnel terms.

Environment lighting has the radiance L(l), with spherical-harmonic coefficients
U_lm of degree l and order m. The camera sees the reflected radiance
∫ L f (n·l) dl. The function f (n·l) of the direction l is called the lobe. It
is symmetric about the plane of n and v. In axes whose z-axis is v (called sample
axes), the normal has a polar angle θ and an azimuth φ. The reflected radiance is

    Σ_l Σ_m≥0 c_lm s_m (U_lm cos mφ + U_l,-m sin mφ),

with s_0 = 1, s_m = sin θ for odd m, and s_m = sin² θ for even m ≥ 2. The
functions c_lm(cos θ, r) are called lobe functions. There is one for each Fresnel
term, degree l and order m = 0, ..., l. They are smooth, and no larger than the
lobe needs: c_lm sin^m θ would be smooth, too, but float32 cannot hold its sums
of huge terms. `_table` computes the lobe functions once by quadrature and stores
them as polynomials in cos θ and log r. The lobe of a sample then costs one small
matrix product (`lobe_functions`) and one multiplication per harmonic. In a
perspective view, every sample has its own direction v. `ViewFrame` rotates the
lobes to axes that all samples share.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from renderer.light.harmonics import cache_tensors, evaluate_harmonics, rotate, rows_and_orders
from renderer.microfacets import DIELECTRIC, distribution, fresnel, masking_denominator
from renderer.settings import MIN_ROUGHNESS
from renderer.vectors import Angle, Components, rotate_about_x, rotate_about_y, rotate_about_z, unit

# `lobe_functions` uses one common table of this degree for all lights up to this degree.
COMMON_DEGREE = 6
# Number of Chebyshev polynomials in the roughness, by which `_table` interpolates.
ROUGHNESS_POLYNOMIALS = 16
# `_table` uses twice the degree and this many Chebyshev polynomials in the cosine.
EXTRA_POLYNOMIALS = 8
# Number of cosines for which `_table` integrates the lobes at once. It limits the memory.
COSINES_AT_ONCE = 8
# Numbers of polar angles (in each of two parts) and of azimuths in `lobe_integrals`.
POLAR_NODE_COUNT = 96
AZIMUTH_NODE_COUNT = 64
# Scale of the substitution of the azimuth in `lobe_integrals`.
AZIMUTH_SCALE = 0.4
# Smaller sines of the angle between normal and camera count as this one.
SMALLEST_SINE = 1e-15


class ViewFrame(NamedTuple):
    """Surface normals in axes that face the camera, and the rotations back to world axes.

    A view of S samples has three sets of axes:

    - world axes;
    - view axes, common to all samples, whose z-axis is the mean direction to
      the camera;
    - sample axes, whose z-axis is the direction from the sample to the camera.
      `lobe_functions` describes lobes in these axes.

    The rotation R_z(azimuth) R_y(polar) takes view axes to world axes. The rotation
    R_x(a) R_y(b) takes sample axes to view axes. SH coefficients have the shape (K, S)
    with K = (degree + 1)²; lobes have the shape (M, S) of `lobe_functions`.

    Attributes:
        normals: Unit normals in sample axes, shape (3, S).
        tilt: sin b, cos b, sin a and cos a, shape (4, S), or (4, 1) for all samples. None
            if sample axes and view axes are the same.
        polar: Angle of the z-axis of the view from that of the world, shape ().
        azimuth: Angle of this axis about the z-axis of the world, shape ().
    """

    normals: Tensor
    tilt: Tensor | None
    polar: Angle
    azimuth: Angle

    @staticmethod
    def from_directions(normals: Tensor, toward: Tensor) -> ViewFrame:
        """Create the frame of a view from unit vectors in world axes.

        The normals have the shape (S, 3), and the vectors to the camera (S, 3), or
        (1, 3) if all samples share one. The result is differentiable in both.
        """
        # The choice of view axes does not change the reflected light. The axes are
        # therefore computed without gradients.
        x, y, z = unit(toward.detach().mean(0))
        polar = Angle(sine=torch.hypot(x, y), cosine=z)
        # x / sin(polar) would divide by 0 at the poles, but atan2 returns 0.
        turn = torch.atan2(y, x)
        azimuth = Angle(sine=turn.sin(), cosine=turn.cos())

        def to_view(vectors: Tensor) -> Components:
            """Rotate vectors, shape (S, 3), from world axes to view axes."""
            x, y, z = vectors.T
            return rotate_about_y(rotate_about_z((x, y, z), azimuth.reversed()), polar.reversed())

        normals_in_view = to_view(normals)
        # If all samples share one direction to the camera, sample axes and view axes are
        # the same. A tilt is then only needed for the gradient of the direction.
        if len(toward) == 1 and not toward.requires_grad:
            return ViewFrame(torch.stack(normals_in_view), None, polar, azimuth)
        # The tilt takes (0, 0, 1) to (sin b, -sin a cos b, cos a cos b), with cos b ≥ 0.
        x, y, z = to_view(toward)
        cosine = (1 - x**2).sqrt()
        tilt = torch.stack([x, cosine, -y / cosine, z / cosine])
        about_y, about_x = Angle(tilt[0], tilt[1]), Angle(tilt[2], tilt[3])
        without_x = rotate_about_x(normals_in_view, about_x.reversed())
        in_sample = rotate_about_y(without_x, about_y.reversed())
        return ViewFrame(torch.stack(in_sample), tilt, polar, azimuth)

    @property
    def cosine(self) -> Tensor:
        """Cosine of the angle between normal and view direction, at least 0, shape (S,)."""
        # The direction to the camera is the z-axis of the sample axes.
        return self.normals[2].clamp(0, 1)

    def harmonics(self, lobes: Tensor) -> Tensor:
        """Compute the spherical-harmonic coefficients of the lobe at each sample.

        If `tilt` is None, the result is in view axes. Otherwise, it is in the view
        axes in the order y, z, x. The coefficients in world axes are
        `frame.to_world(frame.harmonics(lobes))`.
        """
        # There are M = (degree + 1) (degree + 2) / 2 lobe functions.
        degree = (math.isqrt(8 * len(lobes) + 1) - 3) // 2
        # In sample axes, the coefficients of the orders m ≥ 0 are c_lm s_m cos mφ, and those of
        # the orders -m < 0 are c_lm s_m sin mφ (see the module).
        indices = rows_and_orders(degree)
        functions, orders = (ids.to(lobes.device, non_blocking=True) for ids in indices)
        # The normal is (sin θ cos φ, sin θ sin φ, cos θ). The smallest sine avoids a division
        # by 0 at θ = 0, where its powers make the factors 0 or 1, and gradients finite.
        x, y, _ = self.normals
        sine = (x**2 + y**2).clamp(min=SMALLEST_SINE**2).sqrt()
        sine_powers = torch.stack([torch.ones_like(sine), sine, sine**2])
        exponents = _sine_exponents(torch.arange(-degree, degree + 1, device=x.device).abs())
        factors = _complex_powers(x / sine, y / sine, degree) * sine_powers[exponents]
        coefficients = lobes.index_select(0, functions) * factors.index_select(0, degree + orders)
        if self.tilt is None:
            return coefficients
        # The tilt R_x(a) R_y(b) rotates about the y-axis and then about the x-axis. But
        # harmonics are only easy to rotate about the z-axis. Let C be the cyclic
        # permutation of the axes: x to y, y to z, z to x. Then C R_y(b) = R_z(b) C and
        # C² R_x(a) = R_z(a) C², so R_z(a) C R_z(b) C = C² R_x(a) R_y(b). The loop computes
        # the left side, which is the tilt and then two permutations.
        permutation = _axis_permutation(degree)
        sine_b, cosine_b, sine_a, cosine_a = self.tilt
        for angle in (Angle(sine_b, cosine_b), Angle(sine_a, cosine_a)):
            coefficients = _rotate_harmonics(_multiply_bands(permutation, coefficients), angle)
        return coefficients

    def to_world(self, coefficients: Tensor) -> Tensor:
        """Rotate SH coefficients from the intermediate axes of `harmonics` to world axes.

        The coefficients have the shape (K, P), one function on the sphere per column.
        """
        permutation = _axis_permutation(math.isqrt(len(coefficients)) - 1)
        polar, azimuth = (a.for_columns(coefficients) for a in (self.polar, self.azimuth))
        # With a tilt, the function `harmonics` has permuted the axes cyclically two times. A
        # third permutation restores the order x, y, z.
        if self.tilt is not None:
            coefficients = _multiply_bands(permutation, coefficients)
        # The rotation to world axes is R_z(azimuth) R_y(polar). With the permutation C of
        # the axes, R_y(polar) is Cᵀ R_z(polar) C.
        permuted = _rotate_harmonics(_multiply_bands(permutation, coefficients), polar)
        return _rotate_harmonics(_multiply_bands(permutation.T, permuted), azimuth)

    def from_world(self, coefficients: Tensor) -> Tensor:
        """Rotate SH coefficients from world axes to the intermediate axes, inverting `to_world`."""
        permutation = _axis_permutation(math.isqrt(len(coefficients)) - 1)
        polar, azimuth = (a.for_columns(coefficients) for a in (self.polar, self.azimuth))
        without_azimuth = _rotate_harmonics(coefficients, azimuth.reversed())
        permuted = _multiply_bands(permutation, without_azimuth)
        without_polar = _rotate_harmonics(permuted, polar.reversed())
        in_view = _multiply_bands(permutation.T, without_polar)
        # With a tilt, the intermediate axes are the view axes after two cyclic
        # permutations. Two are the inverse of one, which is the transposed matrix.
        return in_view if self.tilt is None else _multiply_bands(permutation.T, in_view)


def _sine_exponents(orders: Tensor) -> Tensor:
    """Return the exponent of sin θ in s_m (see the module): 0, 1, 2, 1, 2, 1, ..."""
    return torch.where(orders == 0, 0, 2 - orders % 2)


def _complex_powers(x: Tensor, y: Tensor, degree: int) -> Tensor:
    """Compute cos mφ and sin mφ from x = cos φ and y = sin φ, as parts of (x + iy)^m.

    There are 2 degree + 1 rows: sin |m|φ for m < 0, and then cos mφ for m ≥ 0.
    """
    rows = [torch.ones_like(x)]
    real, imaginary = x, y
    for _ in range(degree):
        rows = [imaginary, *rows, real]
        real, imaginary = real * x - imaginary * y, real * y + imaginary * x
    return torch.stack(rows)


def _rotate_harmonics(coefficients: Tensor, angle: Angle) -> Tensor:
    """Rotate SH coefficients u about z by a, x to y: u'_m = cos(ma) u_m - sin(ma) u_-m."""
    degree = math.isqrt(len(coefficients)) - 1
    order = rows_and_orders(degree)[1].to(coefficients.device, non_blocking=True)
    # Rows for m from -degree to degree: sin(|m| a) if m < 0, and cos(ma) if m ≥ 0.
    sines_and_cosines = _complex_powers(angle.cosine, angle.sine, degree)
    sines = sines_and_cosines[:degree]
    # Rows with sin(ma) for the orders m from -degree to degree, with the angle a.
    signed_sines = torch.cat([-sines, 0 * sines_and_cosines[:1], sines.flip(0)])
    # The harmonic of order -m is 2 m rows before the harmonic of order m in its band.
    opposite_harmonic = torch.arange(len(order), device=coefficients.device) - 2 * order
    cosine_terms = coefficients * sines_and_cosines.index_select(0, degree + order.abs())
    opposite_coefficients = coefficients.index_select(0, opposite_harmonic)
    sine_terms = opposite_coefficients * signed_sines.index_select(0, degree + order)
    return cosine_terms - sine_terms


def _multiply_bands(rotation: Tensor, coefficients: Tensor) -> Tensor:
    """Rotate SH coefficients by a matrix, which has only one block per degree on its diagonal."""
    slices = [slice(l * l, (l + 1) * (l + 1)) for l in range(math.isqrt(len(coefficients)))]
    rotation = rotation.to(coefficients, non_blocking=True)
    return torch.cat([rotation[b, b] @ coefficients[b] for b in slices])


@cache_tensors
def _axis_permutation(degree: int) -> Tensor:
    """Compute how SH coefficients change if the axes are permuted: x to y, y to z, z to x."""
    identity = torch.eye((degree + 1) ** 2, dtype=torch.float64)
    return rotate(identity, torch.eye(3, dtype=torch.float64).roll(1, 0))


def lobe_functions(
    cosine: Float[Tensor, " S"], roughness: Float[Tensor, " _"], degree: int, terms: Sequence[int]
) -> Float[Tensor, "T M S"]:
    """Evaluate the lobe functions π c_lm (see the module) at the S samples.

    The result is differentiable with respect to both tensors. The roughness is in
    [MIN_ROUGHNESS, 1]. The M functions with 0 ≤ m ≤ l are in ascending order of l and then
    of m. The cosine is n·v = cos θ, between the normal and the direction to the camera.
    """
    function_count = (degree + 1) * (degree + 2) // 2
    table = _table_like(max(degree, COMMON_DEGREE), cosine.dtype, cosine.device)
    # Axes: Fresnel term, lobe function, polynomial in the roughness, one in the cosine.
    coefficients = torch.stack([table[term, :function_count] for term in terms])
    in_cosine = _cosine_polynomials(cosine, coefficients.shape[-1])
    in_roughness = roughness_polynomials(roughness)
    if len(roughness) == 1:
        return torch.einsum("tmrc,r->tmc", coefficients, in_roughness[:, 0]) @ in_cosine
    # Axes: polynomial in the roughness, polynomial in the cosine, sample.
    return coefficients.flatten(2) @ (in_roughness[:, None] * in_cosine).flatten(0, 1)


def coat_albedo(cosine: Tensor, roughness: Tensor) -> Tensor:
    """Compute E(μ), the fraction of a light beam that a dielectric coat reflects.

    The coat is a transparent layer with a rough surface. It reflects a beam at
    the angle of incidence arccos μ into all directions. E(μ) is also the radiance
    that a camera at this angle sees if light of radiance 1 comes from all
    directions, because the reflectance does not change if the directions of light
    and camera are exchanged. The result is differentiable.
    """
    coefficients = _coat_coefficients().to(cosine, non_blocking=True)
    in_cosine = _cosine_polynomials(cosine.flatten(), coefficients.shape[1])
    cosine_coefficients = coefficients.T @ roughness_polynomials(roughness.flatten())
    return (cosine_coefficients * in_cosine).sum(0).view_as(cosine)


@cache_tensors
def coat_irradiance_factors(degree: int) -> Tensor:
    """Compute the factors of SH coefficients in the irradiance that a dielectric coat reflects.

    A coat with the specular factor 1 reflects the fraction E(μ) of light that
    arrives at the cosine μ (see `coat_albedo`). The irradiance that it reflects is
    Σ_lm B_l U_lm Y_lm(n), with the SH coefficients U_lm of the light, the
    harmonics Y_lm and the normal n. The factor of degree l is
    B_l = 2π ∫ E(μ) μ P_l(μ) dμ over 0 ≤ μ ≤ 1, with Legendre polynomials P_l.
    B_l depends on the roughness and is given as a sum of polynomials.
    """
    cosine, weights = _gauss_legendre(degree + 64)
    coefficients = _coat_coefficients()
    # The integrand E(μ) μ: one row for each polynomial of the roughness, one column for
    # each cosine μ.
    reflected = coefficients @ _cosine_polynomials(cosine, coefficients.shape[1]) * cosine
    # Legendre polynomials: one row for each cosine, one column for each degree.
    legendre = torch.from_numpy(np.polynomial.legendre.legvander(cosine.numpy(), degree))
    return 2 * math.pi * (legendre.T * weights) @ reflected.T


def coat_mean(roughness: Tensor) -> Tensor:
    """Compute the fraction of uniform environment light that a dielectric coat reflects.

    The fraction is E_avg = 2 ∫ E(μ) μ dμ over 0 ≤ μ ≤ 1, with the reflected
    fraction E(μ) of a single beam (`coat_albedo`). The result is differentiable.
    """
    factors = coat_irradiance_factors(0).to(roughness, non_blocking=True)
    return (factors @ roughness_polynomials(roughness))[0] / math.pi


def _coat_coefficients() -> Tensor:
    """Return the Chebyshev coefficients of E in roughness and cosine (see `coat_albedo`)."""
    # The reflected fraction E(μ) is the integral of the lobe (reflectance times the cosine
    # n·l) over all directions l of light. This is √(4π) times the SH coefficient of degree 0
    # of the lobe. The table contains π times this coefficient.
    return _table(COMMON_DEGREE)[DIELECTRIC, 0] * (math.sqrt(4 * math.pi) / math.pi)


def roughness_polynomials(roughness: Tensor) -> Tensor:
    """Evaluate Chebyshev polynomials in the roughness, differentiably.

    Their argument 1 - 2 log r / log MIN_ROUGHNESS is in [-1, 1]. Functions of the roughness in
    this module are sums of these polynomials.
    """
    argument = 1 - 2 * roughness.log() / math.log(MIN_ROUGHNESS)
    return _chebyshev(argument, ROUGHNESS_POLYNOMIALS) / roughness**2


def _cosine_polynomials(cosine: Tensor, count: int) -> Tensor:
    """Evaluate Chebyshev polynomials in the cosine, of which functions of the cosine are sums.

    Their argument 4 c / (c + 1) - 1 is in [-1, 1]. It spreads small cosines over a wider range,
    because lobes change quickly at grazing angles.
    """
    return _chebyshev(4 * cosine / (cosine + 1) - 1, count)


def _chebyshev(argument: Tensor, count: int) -> Tensor:
    """Evaluate the Chebyshev polynomials T_0, T_1, ..., T_(count - 1)."""
    # The recurrence is T_(k + 1) = 2 x T_k - T_(k - 1).
    values = [torch.ones_like(argument), argument]
    for _ in range(count - 2):
        values.append(2 * argument * values[-1] - values[-2])
    return torch.stack(values)


def _nodes_and_interpolation(count: int) -> tuple[Tensor, Tensor]:
    """Return the zeros of T_count, and the matrix from values there to coefficients."""
    nodes = (math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count).cos()
    return nodes, torch.linalg.inv(_chebyshev(nodes, count).T)


@cache_tensors
def _table_like(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return `_table` in a dtype and on a device, from a cache because it is large."""
    return _table(degree).to(device, dtype)


@cache_tensors
def _table(degree: int) -> Float[Tensor, "3 M ROUGHNESS_POLYNOMIALS _"]:
    """Interpolate the lobe functions by Chebyshev polynomials T in the roughness and the cosine.

    A lobe function is Σ_k Σ_p a_kp T_k(y) T_p(x). The argument y stands for the roughness (see
    `roughness_polynomials`), and x for the cosine (see `_cosine_polynomials`). When a mirror turns
    by θ, the reflected light turns by 2 θ. A harmonic of degree l of this light therefore needs
    polynomials up to degree 2 l in cos θ. The axes are the Fresnel term, the pair (l, m), k and p.
    """
    nodes, interpolation = _nodes_and_interpolation(2 * degree + EXTRA_POLYNOMIALS)
    roughness_nodes, roughness_interpolation = _nodes_and_interpolation(ROUGHNESS_POLYNOMIALS)
    # The inverses of the arguments of `_cosine_polynomials` and `roughness_polynomials`.
    cosines = (nodes + 1) / (3 - nodes)
    roughnesses = MIN_ROUGHNESS ** ((1 - roughness_nodes) / 2)
    # Axes: Fresnel term, pair (l, m), roughness, cosine.
    cosine_blocks = cosines.split(COSINES_AT_ONCE)
    blocks = [lobe_integrals(block, roughnesses, degree) for block in cosine_blocks]
    orders = torch.tensor([m for l in range(degree + 1) for m in range(l + 1)])
    sine_factors = (1 - cosines**2).sqrt() ** _sine_exponents(orders)[:, None, None]
    values = torch.cat(blocks, dim=-1) / sine_factors
    return torch.einsum(
        "tmrc,kr,pc->tmkp", values, roughness_interpolation * roughnesses**2, interpolation
    ).contiguous()


def lobe_integrals(
    cosine: Float[Tensor, " N"], roughness: Float[Tensor, " R"], degree: int
) -> Float[Tensor, "3 M R N"]:
    """Integrate π times a specular lobe times each spherical harmonic over the sphere.

    In sample axes, a half vector with the polar angle β and the azimuth φ reflects
    the camera to light with the polar angle 2 β and the same azimuth. The Fresnel
    terms and the Legendre functions therefore depend on β only. Each integral is
    a sum over β of these functions times an integral over φ of the rest of the
    lobe times cos mφ. The azimuths end where the light is on the horizon. The
    substitution tan φ/2 = AZIMUTH_SCALE tan ψ draws their nodes to φ = 0, where
    the lobe is high. The integrals are π c_lm s_m (see the module).
    """
    polar_nodes, polar_weights = _gauss_legendre(POLAR_NODE_COUNT)
    azimuth_nodes, azimuth_weights = _gauss_legendre(AZIMUTH_NODE_COUNT)
    angle = cosine.acos()[:, None]
    # Up to the polar angle `lowest`, the light is above the horizon at all azimuths. From
    # `lowest` + `angle` on, it is below the horizon at all azimuths. Axes: cosine n·v, node.
    lowest = (math.pi / 2 - angle) / 2
    polar = torch.cat([lowest * polar_nodes, lowest + angle * polar_nodes], dim=1)
    polar_weights = torch.cat([lowest * polar_weights, angle * polar_weights], dim=1)
    # Cosine of the azimuth at which the light is on the horizon.
    last_cosine = -1 / (angle.tan() * (2 * polar).tan())
    last_psi = ((last_cosine.clamp(-1, 1).acos() / 2).tan() / AZIMUTH_SCALE).atan()[..., None]
    # Axes: cosine n·v, polar angle, azimuth.
    psi = last_psi * azimuth_nodes
    azimuth = 2 * (AZIMUTH_SCALE * psi.tan()).atan()
    azimuth_per_psi = 2 * AZIMUTH_SCALE / (psi.cos() ** 2 + (AZIMUTH_SCALE * psi.sin()) ** 2)
    azimuth_weights = azimuth_per_psi * last_psi * azimuth_weights

    def normal_cosine(polar: Tensor) -> Tensor:
        """Return the cosines between the normal and directions at the azimuths."""
        along = angle.cos() * polar.cos()
        across = angle.sin() * polar.sin()
        return along[..., None] + across[..., None] * azimuth.cos()

    # Axes: roughness, cosine n·v, polar angle, azimuth.
    alpha_squared = roughness[:, None, None, None] ** 4
    light_cosine = normal_cosine(2 * polar).clamp(min=0)
    lobe = distribution(normal_cosine(polar), alpha_squared) * light_cosine
    for direction_cosine in (light_cosine, cosine[:, None, None]):
        lobe = lobe / masking_denominator(direction_cosine, alpha_squared)
    # Rows cos mφ for all orders m from 0 on.
    turns = _complex_powers(azimuth.cos(), azimuth.sin(), degree)[degree:]
    # Integrals over the azimuth, with the axes: order, roughness, cosine n·v, polar angle.
    by_order = torch.einsum("rnqa,mnqa->mrnq", lobe, turns * azimuth_weights)
    # The solid angle of the light is 2 sin 2β dβ dφ, for both signs of φ.
    light = torch.stack([(2 * polar).sin(), torch.zeros_like(polar), (2 * polar).cos()])
    fresnel_weights = 4 * light[0] * polar_weights * fresnel(polar.cos())
    indices = [l * (l + 1) + m for l in range(degree + 1) for m in range(l + 1)]
    harmonics = torch.stack(evaluate_harmonics(light, indices))
    integrals = polar.new_empty(len(fresnel_weights), len(indices), len(roughness), len(cosine))
    for m, azimuth_integrals in enumerate(by_order):
        # The lobe functions of order m have the degrees l = m, m + 1, ..., degree.
        rows = [l * (l + 1) // 2 + m for l in range(m, degree + 1)]
        integrals[:, rows] = torch.einsum(
            "tnq,lnq,rnq->tlrn", fresnel_weights, harmonics[rows], azimuth_integrals
        )
    return integrals


def _gauss_legendre(count: int) -> tuple[Tensor, Tensor]:
    """Return nodes and weights of Gauss-Legendre quadrature in [0, 1], float64."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return torch.from_numpy(nodes + 1) / 2, torch.from_numpy(weights) / 2
