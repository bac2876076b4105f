"""The light that rough surfaces reflect, as a sum over spherical harmonics.

The reflectance f of `renderer.surface.microfacets` depends on the normal n, the
direction l to the light, the direction v to the camera, and the roughness r. It
has three Fresnel terms.

Environment lighting has the radiance L(l), with spherical-harmonic coefficients
U_lm of degree l and order m. The camera sees the reflected radiance
∫ L f (n·l) dl. The function f (n·l) of the direction l is called the lobe. It
is symmetric about the plane of n and v. In axes whose z-axis is v, the normal
has a polar angle θ and an azimuth φ. The reflected radiance then is

    Σ_l Σ_m≥0 c_lm(cos θ, r) sin^m θ (U_lm cos mφ + U_l,-m sin mφ).

The functions c_lm(cos θ, r) are called lobe functions. There is one for each
Fresnel term, degree l and order m = 0, ..., l. They are smooth. `_table`
computes them once by quadrature and stores them as polynomials in cos θ and r.
The lobe of a sample then costs one small matrix product (`lobe_functions`) and
one multiplication per harmonic. In a perspective view, every sample has its own
direction v. `ViewFrame` rotates the lobes to axes that all samples share.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from renderer.light.harmonics import bands, cache_tensors, evaluate_harmonics, rotate
from renderer.light.highlights import required_degree
from renderer.settings import MIN_ROUGHNESS
from renderer.surface.microfacets import DIELECTRIC, reflectance
from renderer.vectors import unit

# `_fit` sets the lobe functions of a degree to 0 if the amplitude of this degree in a
# highlight is at most this fraction of the amplitude of degree 0.
NEGLIGIBLE = 1e-3

# For lights up to this degree, `lobe_functions` uses one common table of this degree.
USUAL = 6
# `_table` computes the lobe functions at this number of values of the roughness, and
# interpolates them with the same number of Chebyshev polynomials in the roughness.
NODES = 12
# `_fit` uses this many more Chebyshev polynomials in the cosine than a perfect mirror would
# need, which are 2 degree + 1.
MARGIN = 3
# `_fit` integrates the lobes for this many cosines at once. It limits the memory.
COSINES_AT_ONCE = 16
# `_lobe_integrals` sums over half vectors with this many polar angles and azimuths. The
# azimuths cover one side of the plane that contains the normal and the camera direction.
POLAR_NODE_COUNT = 32
AZIMUTH_COUNT = 24

# Type for the x, y and z components of S vectors, shape (S,) each.
Components = tuple[Tensor, Tensor, Tensor]


class ViewFrame(NamedTuple):
    """Surface normals in axes that face the camera, and the rotations back to world axes.

    A view of S samples has three sets of axes:

    - world axes;
    - view axes, common to all samples, whose z-axis is the mean direction to
      the camera;
    - sample axes, whose z-axis is the direction from the sample to the camera.
      `lobe_functions` describes lobes in these axes.

    Attributes:
        normals: Unit normals of the samples in sample axes, shape (3, S).
        tilt: Rotations from sample axes to view axes. None if both are the same
            at all samples.
        axis: Direction of the z-axis of the view in world axes.
    """

    normals: Tensor
    tilt: Tilt | None
    axis: ViewAxis

    @staticmethod
    def from_directions(normals: Tensor, toward: Tensor) -> ViewFrame:
        """Create the frame of a view.

        The result is differentiable with respect to both arguments.

        Args:
            normals: Unit surface normals of the S samples in world axes,
                shape (S, 3).
            toward: Unit vectors to the camera in world axes, shape (S, 3), or
                (1, 3) if all samples share one direction.

        Returns:
            Normals in sample axes, and the rotations from there to world axes.
        """
        # The choice of view axes does not change the reflected light, so it
        # needs no gradient.
        mean_toward = unit(toward.detach().mean(0))
        axis = ViewAxis.along(mean_toward)
        normals_in_view = axis.to_view(normals)
        # A direction that all samples share is the z-axis of the view itself.
        # If it is differentiated, its gradient must go through a tilt, because
        # `axis` is constant.
        if len(toward) == 1 and not toward.requires_grad:
            return ViewFrame(normals=torch.stack(normals_in_view), tilt=None, axis=axis)
        toward_in_view = axis.to_view(toward)
        tilt = Tilt.along(toward_in_view)
        normals_in_sample = tilt.to_sample(normals_in_view)
        return ViewFrame(normals=torch.stack(normals_in_sample), tilt=tilt, axis=axis)

    @property
    def cosine(self) -> Tensor:
        """Cosine n·v at the samples, shape (S,). Negative values count as 0."""
        # The direction v is the z-axis of the sample axes.
        return self.normals[2].clamp(0, 1)

    def harmonics(self, lobes: Tensor) -> Tensor:
        """Compute the spherical-harmonic coefficients of the lobe at each sample.

        The coefficients are in intermediate axes: the view axes or, with a
        tilt, the view axes in the order y, z, x. The coefficients in world axes
        are `frame.to_world(frame.harmonics(lobes))`.

        Args:
            lobes: Values of the M lobe functions of one Fresnel term at the S
                samples, from `lobe_functions`, shape (M, S).

        Returns:
            Coefficients of the K = (degree + 1)² harmonics, shape (K, S).
        """
        degree = _degree_of_lobes(lobes)
        coefficients = self._harmonics_in_sample_axes(lobes, degree)
        if self.tilt is None:
            return coefficients
        # The tilt is R_x(a) R_y(b), with a rotation R_x about the x-axis and so
        # on. Harmonics are easy to rotate about z, but not about x and y. The
        # cyclic exchange C of the axes (x to y, y to z, z to x) turns one
        # rotation into another: C R_y(b) = R_z(b) C and C² R_x(a) = R_z(a) C².
        # Therefore R_z(a) C R_z(b) C = C² R_x(a) R_y(b). This is the tilt,
        # followed by two exchanges.
        exchange = _exchange(degree)
        for angle in (self.tilt.about_y, self.tilt.about_x):
            coefficients = _rotate_harmonics(_multiply_bands(exchange, coefficients), angle)
        return coefficients

    def _harmonics_in_sample_axes(self, lobes: Tensor, degree: int) -> Tensor:
        """Compute the SH coefficients of the lobe of each of S samples in the sample's own axes.

        The polar angle θ and the azimuth φ of the normal give the coefficients
        c_lm sin^m θ cos mφ for the harmonics of order m ≥ 0, and
        c_lm sin^m θ sin mφ for the harmonics of order -m < 0.

        Args:
            lobes: Values of the lobe functions c_lm at the samples, shape (M, S).
            degree: Degree of the lobe functions.

        Returns:
            Coefficients of the K = (degree + 1)² harmonics, shape (K, S).
        """
        function_of_harmonic, order = _functions_and_orders(degree)
        function_of_harmonic = function_of_harmonic.to(lobes.device)
        order = order.to(lobes.device)
        # The normal is (sin θ cos φ, sin θ sin φ, cos θ), so the factors are
        # the real and imaginary parts of (x + iy)^m.
        normal_x, normal_y, _ = self.normals
        factors = _complex_powers(normal_x, normal_y, degree).index_select(0, degree + order)
        return lobes.index_select(0, function_of_harmonic) * factors

    def to_world(self, coefficients: Tensor) -> Tensor:
        """Rotate coefficients from the axes of `harmonics` to world axes.

        Args:
            coefficients: Coefficients of one function per column, shape (K, P)
                with K = (degree + 1)².

        Returns:
            Coefficients of the same functions in world axes, shape (K, P).
        """
        exchange = _exchange(math.isqrt(len(coefficients)) - 1)
        axis = self.axis.for_columns(coefficients)
        # If there is a tilt, `harmonics` exchanges the axes twice. A third
        # exchange restores them.
        if self.tilt is not None:
            coefficients = _multiply_bands(exchange, coefficients)
        # The rotation is R_z(azimuth) R_y(polar). Its second factor is
        # R_y(polar) = Cᵀ R_z(polar) C, with the exchange C as in `harmonics`.
        exchanged = _rotate_harmonics(_multiply_bands(exchange, coefficients), axis.polar)
        return _rotate_harmonics(_multiply_bands(exchange.T, exchanged), axis.azimuth)

    def from_world(self, coefficients: Tensor) -> Tensor:
        """Rotate coefficients from world axes to the axes of `harmonics`.

        This is the inverse of `to_world`.

        Args:
            coefficients: Coefficients of one function per column in world axes,
                shape (K, P) with K = (degree + 1)².

        Returns:
            Coefficients of the same functions in the axes of `harmonics`,
            shape (K, P).
        """
        exchange = _exchange(math.isqrt(len(coefficients)) - 1)
        axis = self.axis.for_columns(coefficients)
        without_azimuth = _rotate_harmonics(coefficients, axis.azimuth.reversed())
        exchanged = _multiply_bands(exchange, without_azimuth)
        without_polar = _rotate_harmonics(exchanged, axis.polar.reversed())
        in_view = _multiply_bands(exchange.T, without_polar)
        # `harmonics` exchanges the axes twice. Two cyclic exchanges of three axes are the
        # inverse of one exchange, which is the transposed matrix.
        return in_view if self.tilt is None else _multiply_bands(exchange.T, in_view)


class ViewAxis(NamedTuple):
    """Spherical coordinates of the z-axis of a view in world axes.

    The rotation R_z(azimuth) R_y(polar) takes view axes to world axes. It first
    rotates about the y-axis and then about the z-axis.

    Attributes:
        polar: Angle from the z-axis of the world. Its tensors have shape ().
        azimuth: Angle about the z-axis of the world, from x toward y. Its
            tensors have shape ().
    """

    polar: Angle
    azimuth: Angle

    @staticmethod
    def along(direction: Tensor) -> ViewAxis:
        """Compute the spherical coordinates of a direction.

        Args:
            direction: Unit vector in world axes, shape (3,).

        Returns:
            Polar angle and azimuth of the direction.
        """
        x, y, z = direction
        polar = Angle(sine=torch.hypot(x, y), cosine=z)
        # At the poles, x / sin(polar) would divide by 0, but atan2 returns 0.
        azimuth = torch.atan2(y, x)
        return ViewAxis(polar, Angle(sine=azimuth.sin(), cosine=azimuth.cos()))

    def for_columns(self, coefficients: Tensor) -> ViewAxis:
        """Convert both angles to the shape, dtype and device that `_rotate_harmonics` needs.

        Args:
            coefficients: Coefficients that will be rotated, shape (K, S).
        """
        return ViewAxis(
            polar=self.polar.for_columns(coefficients),
            azimuth=self.azimuth.for_columns(coefficients),
        )

    def to_view(self, vectors: Tensor) -> Components:
        """Rotate vectors from world axes to view axes.

        Args:
            vectors: S vectors in world axes, shape (S, 3).

        Returns:
            Components x, y and z in view axes, shape (S,) each.
        """
        x, y, z = vectors.T
        without_azimuth = _rotate_about_z((x, y, z), self.azimuth.reversed())
        return _rotate_about_y(without_azimuth, self.polar.reversed())


class Tilt(NamedTuple):
    """Rotation from sample axes to view axes, one for each sample.

    It is R_x(a) R_y(b): first about the y-axis by the angle b, then about the
    x-axis by the angle a.

    Attributes:
        values: Rows sin b, cos b, sin a and cos a, shape (4, S), or (4, 1) if
            all samples share one rotation.
    """

    values: Tensor

    @property
    def about_y(self) -> Angle:
        """Angle b about the y-axis, from z toward x. This rotation comes first."""
        return Angle(sine=self.values[0], cosine=self.values[1])

    @property
    def about_x(self) -> Angle:
        """Angle a about the x-axis, from y toward z. This rotation comes second."""
        return Angle(sine=self.values[2], cosine=self.values[3])

    @staticmethod
    def along(directions: Components) -> Tilt:
        """Compute the rotations that rotate the z-axis (0, 0, 1) to given directions.

        R_x(a) R_y(b) rotates (0, 0, 1) to (sin b, -sin a cos b, cos a cos b). The
        angle b is chosen so that cos b ≥ 0.

        Args:
            directions: Components of S unit vectors in view axes, shape (S,)
                each.

        Returns:
            One rotation for each direction.
        """
        x, y, z = directions
        sine_b = x
        cosine_b = (1 - x**2).sqrt()
        sine_a = -y / cosine_b
        cosine_a = z / cosine_b
        return Tilt(torch.stack([sine_b, cosine_b, sine_a, cosine_a]))

    def to_sample(self, vectors: Components) -> Components:
        """Rotate one vector per sample from view axes to sample axes.

        Args:
            vectors: Components of S vectors in view axes, shape (S,) each.

        Returns:
            Components in sample axes, shape (S,) each.
        """
        without_x = _rotate_about_x(vectors, self.about_x.reversed())
        return _rotate_about_y(without_x, self.about_y.reversed())


class Angle(NamedTuple):
    """Sine and cosine of a rotation angle. Rotations need nothing else of the angle.

    Attributes:
        sine: Sine, shape (), or (S,) for one angle per sample.
        cosine: Cosine, same shape.
    """

    sine: Tensor
    cosine: Tensor

    def reversed(self) -> Angle:
        """Return the angle of the inverse rotation."""
        return Angle(sine=-self.sine, cosine=self.cosine)

    def for_columns(self, coefficients: Tensor) -> Angle:
        """Convert an angle of shape () to shape (1,), with another dtype and device.

        Args:
            coefficients: Tensor with the dtype and the device.
        """
        return Angle(
            sine=self.sine[None].to(coefficients), cosine=self.cosine[None].to(coefficients)
        )


def _rotate_about_x(vectors: Components, angle: Angle) -> Components:
    """Rotate vectors about the x-axis, from y toward z.

    Args:
        vectors: Components x, y and z of S vectors, shape (S,) each.
        angle: Sine and cosine of the angle of rotation.

    Returns:
        Components of the rotated vectors, shape (S,) each.
    """
    x, y, z = vectors
    rotated_y, rotated_z = _rotate_in_plane(y, z, angle)
    return x, rotated_y, rotated_z


def _rotate_about_y(vectors: Components, angle: Angle) -> Components:
    """Rotate vectors about the y-axis, from z toward x.

    Args:
        vectors: Components x, y and z of S vectors, shape (S,) each.
        angle: Sine and cosine of the angle of rotation.

    Returns:
        Components of the rotated vectors, shape (S,) each.
    """
    x, y, z = vectors
    rotated_z, rotated_x = _rotate_in_plane(z, x, angle)
    return rotated_x, y, rotated_z


def _rotate_about_z(vectors: Components, angle: Angle) -> Components:
    """Rotate vectors about the z-axis, from x toward y.

    Args:
        vectors: Components x, y and z of S vectors, shape (S,) each.
        angle: Sine and cosine of the angle of rotation.

    Returns:
        Components of the rotated vectors, shape (S,) each.
    """
    x, y, z = vectors
    rotated_x, rotated_y = _rotate_in_plane(x, y, angle)
    return rotated_x, rotated_y, z


def _rotate_in_plane(first: Tensor, second: Tensor, angle: Angle) -> tuple[Tensor, Tensor]:
    """Rotate vectors in the plane of two axes, from the first axis toward the second.

    Args:
        first: Components along the first axis, shape (S,).
        second: Components along the second axis, shape (S,).
        angle: Rotation angle.

    Returns:
        Rotated components along the first and the second axis, shape (S,) each.
    """
    rotated_first = first * angle.cosine - second * angle.sine
    rotated_second = first * angle.sine + second * angle.cosine
    return rotated_first, rotated_second


def _degree_of_lobes(lobes: Tensor) -> int:
    """Find the degree of M = (degree + 1) (degree + 2) / 2 lobe functions.

    Args:
        lobes: Values of the lobe functions at S samples, shape (M, S).
    """
    return (math.isqrt(8 * len(lobes) + 1) - 3) // 2


@cache_tensors
def _functions_and_orders(degree: int) -> tuple[Tensor, Tensor]:
    """Find the lobe function and the order of each of the K = (degree + 1)² harmonics.

    The harmonic of degree l and order m has the index l² + l + m. The lobe
    function c_l|m| has the index l (l + 1) / 2 + |m|.

    Returns:
        A tuple of

        - the index of the lobe function of each harmonic, shape (K,);
        - the order m of each harmonic, from -l to l, shape (K,).
    """
    l = bands(degree)
    m = torch.arange(len(l)) - l * (l + 1)
    function_of_harmonic = l * (l + 1) // 2 + m.abs()
    return function_of_harmonic, m


def _complex_powers(x: Tensor, y: Tensor, degree: int) -> Tensor:
    """Compute the powers of x + iy, split into real and imaginary parts.

    For x = s cos φ and y = s sin φ, they are s^m cos mφ and s^m sin mφ.

    Args:
        x: Real part, shape (...).
        y: Imaginary part, shape (...).
        degree: Largest exponent.

    Returns:
        In row degree + m, for m from -degree to degree: Im (x + iy)^|m| for
        m < 0 and Re (x + iy)^m for m ≥ 0, shape (2 degree + 1, ...).
    """
    real_parts: list[Tensor] = []
    imaginary_parts: list[Tensor] = []
    real = x
    imaginary = y
    for _ in range(degree):
        real_parts.append(real)
        imaginary_parts.append(imaginary)
        next_real = real * x - imaginary * y
        next_imaginary = real * y + imaginary * x
        real = next_real
        imaginary = next_imaginary
    return torch.stack([*reversed(imaginary_parts), torch.ones_like(x), *real_parts])


def _rotate_harmonics(coefficients: Tensor, angle: Angle) -> Tensor:
    """Rotate functions, given by their harmonics, about the z-axis, from x toward y.

    A rotation by the angle a mixes only the coefficients u of orders m and -m:
    u'_m = cos(ma) u_m - sin(ma) u_-m.

    Args:
        coefficients: Coefficients of one function per column, shape (K, S).
        angle: Angle a for each column, shape (S,), or (1,) if all columns share
            one angle.

    Returns:
        Coefficients of the rotated functions, shape (K, S).
    """
    degree = math.isqrt(len(coefficients)) - 1
    _, order = _functions_and_orders(degree)
    order = order.to(coefficients.device)
    # Row degree + m holds cos(ma) for m ≥ 0 and sin(|m| a) for m < 0.
    powers = _complex_powers(angle.cosine, angle.sine, degree)
    sines = powers[:degree]
    # Row degree + m holds sin(ma), which is odd in m.
    signed_sines = torch.cat([-sines, 0 * powers[:1], sines.flip(0)])
    # In a band, the harmonic of order -m is 2 m rows before the harmonic of order m.
    opposite_harmonic = torch.arange(len(order), device=coefficients.device) - 2 * order
    kept = coefficients * powers.index_select(0, degree + order.abs())
    mixed_in = coefficients.index_select(0, opposite_harmonic)
    mixed_in = mixed_in * signed_sines.index_select(0, degree + order)
    return kept - mixed_in


def _multiply_bands(rotation: Tensor, coefficients: Tensor) -> Tensor:
    """Multiply a rotation matrix of harmonics by coefficients, one degree l at a time.

    A rotation does not mix coefficients of different degrees, so the matrix is
    zero outside the blocks on its diagonal.

    Args:
        rotation: Rotation matrix, shape (K, K).
        coefficients: Coefficients of one function per column, shape (K, S).

    Returns:
        Coefficients of the rotated functions, shape (K, S).
    """
    products: list[Tensor] = []
    for l in range(math.isqrt(len(coefficients))):
        # Indices of the harmonics of degree l.
        band = slice(l * l, (l + 1) * (l + 1))
        products.append(rotation[band, band].to(coefficients) @ coefficients[band])
    return torch.cat(products)


@cache_tensors
def _exchange(degree: int) -> Tensor:
    """Compute the matrix of harmonics that exchanges the axes: x to y, y to z and z to x.

    Returns:
        Orthogonal matrix, float64, shape (K, K) with K = (degree + 1)².
    """
    identity = torch.eye((degree + 1) ** 2, dtype=torch.float64)
    exchange_of_axes = torch.eye(3, dtype=torch.float64).roll(1, 0)
    return rotate(identity, exchange_of_axes)


def lobe_functions(cosine: Tensor, roughness: Tensor, degree: int, terms: Sequence[int]) -> Tensor:
    """Evaluate the lobe functions π c_lm, defined at the top of this module.

    The result is differentiable with respect to both tensors.

    Args:
        cosine: Cosine n·v = cos θ in [0, 1] at the S samples, shape (S,).
        roughness: Roughness r in [MIN_ROUGHNESS, 1], shape (S,), or (1,) if all
            samples share one roughness.
        degree: Largest degree l of the spherical harmonics.
        terms: T Fresnel terms among SCHLICK, EDGE and DIELECTRIC.

    Returns:
        Values of the M = (degree + 1) (degree + 2) / 2 functions with
        0 ≤ m ≤ l, in ascending order of l and then of m, shape (T, M, S).
    """
    term_indices = list(terms)
    has_one_roughness = len(roughness) == 1
    # If no gradient is needed, a table for this one roughness takes less time
    # than the table for all values of the roughness.
    if degree > USUAL and has_one_roughness and not roughness.requires_grad:
        table_at_roughness = _table_at(degree, float(roughness)).to(cosine)
        # Shape (T, M, P), with P Chebyshev polynomials in the cosine.
        cosine_coefficients = table_at_roughness[term_indices]
        return cosine_coefficients @ _cosine_polynomials(cosine, cosine_coefficients.shape[-1])
    function_count = (degree + 1) * (degree + 2) // 2
    table = _table(max(degree, USUAL)).to(cosine)
    # Coefficients of the products of NODES polynomials in the roughness and P polynomials in
    # the cosine, for T terms and M functions, shape (T, M, NODES, P).
    coefficients = table[term_indices, :function_count]
    # Values of the polynomials in the cosine, shape (P, S), and of those in the roughness,
    # shape (NODES, S), or (NODES, 1) for one roughness.
    in_cosine = _cosine_polynomials(cosine, coefficients.shape[-1])
    in_roughness = along(roughness)
    if has_one_roughness:
        # The sum over the polynomials in the roughness leaves polynomials in the cosine,
        # shape (T, M, P).
        cosine_coefficients = torch.einsum("tmrc,r->tmc", coefficients, in_roughness[:, 0])
        return cosine_coefficients @ in_cosine
    # Products of a polynomial in the roughness and one in the cosine, shape (NODES, P, S).
    products = in_roughness[:, None] * in_cosine
    # The shapes (T, M, NODES · P) and (NODES · P, S) give (T, M, S).
    return coefficients.flatten(2) @ products.flatten(0, 1)


def coat_albedo(cosine: Tensor, roughness: Tensor) -> Tensor:
    """Compute E(μ), the fraction of a light beam that a dielectric coat reflects.

    A beam at the angle of incidence arccos μ is reflected into all directions.
    The reflectance is the same for exchanged directions, so E(μ) is also the
    radiance that a camera at this angle sees in the coat under uniform
    environment lighting of radiance 1. The result is differentiable with
    respect to both arguments.

    Args:
        cosine: Cosine μ between the normal and the direction, in [0, 1], any
            shape.
        roughness: Roughness in [MIN_ROUGHNESS, 1], same shape or (1,).

    Returns:
        E(μ) in [0, 1], same shape as `cosine`.
    """
    coefficients = _coat_coefficients().to(cosine)
    in_cosine = _cosine_polynomials(cosine.flatten(), coefficients.shape[1])
    cosine_coefficients = coefficients.T @ along(roughness.flatten())
    return (cosine_coefficients * in_cosine).sum(0).view_as(cosine)


@cache_tensors
def coat_bands(degree: int) -> Tensor:
    """Compute the factors by which a dielectric coat reflects each degree of the lighting.

    A coat of specular_factor 1 reflects the fraction E(μ) of the light at the cosine μ
    (see `coat_albedo`). The irradiance that it reflects in total is
    Σ_lm B_l U_lm Y_lm(n) with the coefficients U_lm of the lighting, the
    harmonics Y_lm and the normal n. The factor of degree l is
    B_l = 2π ∫ E(μ) μ P_l(μ) dμ over 0 ≤ μ ≤ 1, with Legendre polynomials P_l.
    If E(μ) were 1, these would be the factors π, 2π/3, π/4, ... of a Lambertian
    surface.

    Args:
        degree: Largest degree l of the spherical harmonics.

    Returns:
        Coefficients of B_l in the NODES polynomials of `along`, float64,
        shape (degree + 1, NODES).
    """
    nodes, weights = np.polynomial.legendre.leggauss(degree + 64)
    # The nodes of the quadrature lie in [-1, 1], and N cosines in [0, 1].
    cosine = (torch.from_numpy(nodes) + 1) / 2
    coefficients = _coat_coefficients()
    # E(μ) μ in the polynomials of the roughness, at the N cosines μ, shape (NODES, N).
    reflected = coefficients @ _cosine_polynomials(cosine, coefficients.shape[1]) * cosine
    # Legendre polynomials P_l at the N cosines, shape (N, degree + 1).
    legendre = torch.from_numpy(np.polynomial.legendre.legvander(cosine.numpy(), degree))
    return math.pi * (legendre.T * torch.from_numpy(weights)) @ reflected.T


def coat_mean(roughness: Tensor) -> Tensor:
    """Compute the fraction of uniform environment lighting that a dielectric coat reflects.

    It is E_avg = 2 ∫ E(μ) μ dμ over 0 ≤ μ ≤ 1 (see `coat_albedo`). The result
    is differentiable.

    Args:
        roughness: Roughness in [MIN_ROUGHNESS, 1], shape (S,).

    Returns:
        E_avg in [0, 1], shape (S,).
    """
    reflected_irradiance = (coat_bands(0).to(roughness) @ along(roughness))[0]
    return reflected_irradiance / math.pi


def _coat_coefficients() -> Tensor:
    """Return the coefficients of the function E(μ) of `coat_albedo` in Chebyshev polynomials.

    E(μ) is the integral of the lobe over all directions of light, which is √(4π)
    times the SH coefficient of degree 0.

    Returns:
        Coefficients of products of a polynomial in the roughness (axis 0) and a
        polynomial in the cosine (axis 1), as in `_table`, float64,
        shape (NODES, P).
    """
    return _table(USUAL)[DIELECTRIC, 0] * (math.sqrt(4 * math.pi) / math.pi)


# Chebyshev polynomials have arguments in [-1, 1]. The following four functions map
# cosines and values of the roughness to such arguments, and back.


def _cosine_to_argument(cosine: Tensor) -> Tensor:
    """Map cosines from [0, 1] to arguments in [-1, 1], with finer steps at small cosines.

    Lobes change quickly at grazing angles, where the cosine is small.

    Args:
        cosine: Cosines, any shape.

    Returns:
        Arguments, same shape.
    """
    return 4 * cosine / (cosine + 1) - 1


def _argument_to_cosine(argument: Tensor) -> Tensor:
    """Map arguments in [-1, 1] to cosines in [0, 1]: the inverse of `_cosine_to_argument`."""
    return (argument + 1) / (3 - argument)


def _roughness_to_argument(roughness: Tensor) -> Tensor:
    """Map values of the roughness from [MIN_ROUGHNESS, 1] to arguments in [-1, 1]."""
    return (2 * roughness - 1 - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS)


def _argument_to_roughness(argument: Tensor) -> Tensor:
    """Map arguments in [-1, 1] to values of the roughness in [MIN_ROUGHNESS, 1]."""
    return (argument * (1 - MIN_ROUGHNESS) + 1 + MIN_ROUGHNESS) / 2


def along(roughness: Tensor) -> Tensor:
    """Evaluate the Chebyshev polynomials in which tables express functions of the roughness.

    The result is differentiable with respect to the roughness.

    Args:
        roughness: Roughness in [MIN_ROUGHNESS, 1], shape (S,).

    Returns:
        Values of the polynomials, shape (NODES, S).
    """
    return _chebyshev(_roughness_to_argument(roughness), NODES)


def _cosine_polynomials(cosine: Tensor, count: int) -> Tensor:
    """Evaluate the Chebyshev polynomials in which `_table` expresses functions of the cosine.

    Args:
        cosine: Cosine n·v in [0, 1] at S samples, shape (S,).
        count: Number of polynomials.

    Returns:
        Values of the polynomials, shape (count, S).
    """
    return _chebyshev(_cosine_to_argument(cosine), count)


def _chebyshev(argument: Tensor, count: int) -> Tensor:
    """Evaluate the Chebyshev polynomials T_0, T_1, ..., T_(count - 1).

    Args:
        argument: Arguments x in [-1, 1], shape (S,).
        count: Number of polynomials, at least 2.

    Returns:
        Values of the polynomials, shape (count, S).
    """
    # The recurrence is T_(k + 1) = 2 x T_k - T_(k - 1).
    values = [torch.ones_like(argument), argument]
    for _ in range(count - 2):
        values.append(2 * argument * values[-1] - values[-2])
    return torch.stack(values)


def _chebyshev_nodes(count: int) -> Tensor:
    """Compute the zeros of the Chebyshev polynomial T_count, float64, shape (count,)."""
    steps = torch.arange(count, dtype=torch.float64) + 0.5
    angles = math.pi * steps / count
    return angles.cos()


@cache_tensors
def _table(degree: int) -> Tensor:
    """Fit the lobe functions π c_lm(cos θ, r) by products of Chebyshev polynomials.

    Each function is approximated by Σ_k Σ_p a_kp T_k(y) T_p(x) with Chebyshev
    polynomials T. The argument y stands for the roughness r (see
    `_roughness_to_argument`), and x for the cosine n·v = cos θ (see
    `_cosine_to_argument`). There are NODES polynomials in the roughness, and
    P = 2 degree + 1 + MARGIN in the cosine.

    Args:
        degree: Largest degree l of the spherical harmonics.

    Returns:
        Coefficients a_kp, float64, for each of the three Fresnel terms and of
        the M = (degree + 1) (degree + 2) / 2 pairs (l, m) with 0 ≤ m ≤ l,
        shape (3, M, NODES, P).
    """
    roughness_arguments = _chebyshev_nodes(NODES)
    roughnesses = _argument_to_roughness(roughness_arguments)
    # One fit for each of NODES values of the roughness, shape (NODES, 3, M, P).
    fits = torch.stack([_fit(degree, float(roughness)) for roughness in roughnesses])
    # There are as many polynomials in the roughness as values of the roughness,
    # so the polynomials pass through all values. This matrix maps values to
    # coefficients, shape (NODES, NODES).
    interpolation = torch.linalg.inv(_chebyshev(roughness_arguments, NODES).T)
    return torch.einsum("kr,rtmc->tmkc", interpolation, fits).contiguous()


@lru_cache(maxsize=8)
@torch.inference_mode(False)
def _table_at(degree: int, roughness: float) -> Tensor:
    """Return the result of `_fit` from a cache with the latest eight results.

    Args:
        degree: Largest degree of the spherical harmonics.
        roughness: Roughness in [MIN_ROUGHNESS, 1].
    """
    return _fit(degree, roughness)


def _fit(degree: int, roughness: float) -> Tensor:
    """Fit the lobe functions π c_lm(cos θ, r) at one roughness by Chebyshev polynomials.

    There are P = 2 degree + 1 + MARGIN polynomials in the cosine. When a mirror
    turns by θ, the reflected light turns by 2 θ. A harmonic of degree l of this
    light therefore has degree 2 l as a function of θ.

    Args:
        degree: Largest degree l of the spherical harmonics.
        roughness: Roughness r in [MIN_ROUGHNESS, 1].

    Returns:
        Coefficients, float64, for each of the three Fresnel terms and of the
        M = (degree + 1) (degree + 2) / 2 pairs (l, m) with 0 ≤ m ≤ l,
        shape (3, M, P). They are zero for degrees above USUAL that have no
        noticeable amplitude at this roughness (see NEGLIGIBLE).
    """
    polynomial_count = 2 * degree + 1 + MARGIN
    noticeable_degree = max(required_degree(roughness, NEGLIGIBLE), USUAL)
    fitted_degree = min(degree, noticeable_degree)
    # The least squares below use 1.5 times as many cosines as polynomials. The
    # number of cosines is N.
    cosine_arguments = _chebyshev_nodes(3 * polynomial_count // 2)
    cosines = _argument_to_cosine(cosine_arguments)
    roughness_tensor = torch.tensor(roughness, dtype=torch.float64)
    integrals_of_parts = []
    for some_cosines in cosines.split(COSINES_AT_ONCE):
        integrals_of_parts.append(_lobe_integrals(some_cosines, roughness_tensor, fitted_degree))
    # Shape (M', N, 3), with the M' pairs (l, m) up to the fitted degree.
    integrals = torch.cat(integrals_of_parts, dim=2).permute(1, 2, 0)
    # The integrals contain the factor sin^m θ, so the polynomials are
    # multiplied by it too. A division by it would be a quotient of small
    # numbers near θ = 0.
    orders = torch.tensor([m for l in range(fitted_degree + 1) for m in range(l + 1)])
    # sin^m θ for each pair (l, m) and each cosine, shape (M', N, 1).
    sine_powers = (1 - cosines[:, None] ** 2) ** (orders[:, None, None] / 2)
    # The functions whose weights the least squares find: each of the P polynomials
    # times sin^m θ, for each of the M' pairs (l, m) and each of the N cosines, shape
    # (M', N, P).
    fitted_functions = sine_powers * _chebyshev(cosine_arguments, polynomial_count).T
    fit = torch.linalg.lstsq(fitted_functions, integrals, rcond=1e-9, driver="gelsd")
    # Coefficients up to the fitted degree, shape (3, M', P). Zeros up to `degree` follow at
    # the end of the function, so that the result has the shape (3, M, P).
    coefficients = fit.solution.permute(2, 0, 1)
    function_count = (degree + 1) * (degree + 2) // 2
    missing_count = function_count - len(orders)
    return torch.nn.functional.pad(coefficients, (0, 0, 0, missing_count))


def _lobe_integrals(cosines: Tensor, roughness: Tensor, degree: int) -> Tensor:
    """Integrate π times the lobe times each spherical harmonic over the directions of light.

    In the axes of a sample, with the normal in the plane of x and z, the
    integral with the harmonic of degree l and order m is π c_lm sin^m θ. The
    quadrature runs over Q half vectors for each camera direction.

    Args:
        cosines: Cosine n·v in (0, 1) of N camera directions, float64,
            shape (N,).
        roughness: Roughness, shape ().
        degree: Largest degree l of the spherical harmonics.

    Returns:
        Integrals for the three Fresnel terms and the
        M = (degree + 1) (degree + 2) / 2 pairs (l, m) with 0 ≤ m ≤ l, in
        ascending order of l and then of m, shape (3, M, N).
    """
    half, solid_angles = _half_vectors(cosines, roughness)
    # Axes of the surface: the normal is the z-axis, and the camera lies in the
    # plane of x and z.
    normal = half.new_tensor([[0.0, 0.0, 1.0]])
    sines = (1 - cosines**2).sqrt()
    zeros = 0 * sines
    toward = torch.stack([-sines, zeros, cosines], dim=1)
    # Cosine v·h, shape (N, Q).
    half_cosine = (toward[:, None] * half).sum(-1)
    # The camera direction is mirrored at each half vector, shape (N, Q, 3).
    light = 2 * half_cosine[..., None] * half - toward[:, None]
    light_cosine = light[..., 2].clamp(min=0)
    # The solid angle of the reflected light is dl = 4 (v·h) dh (Walter et al.
    # 2007, equation 14). Both tensors have shape (3, N, Q).
    reflected = reflectance(normal, toward[:, None], light, roughness)
    weighted_lobe = reflected * light_cosine * solid_angles * 4 * half_cosine

    # Sample axes: the camera is the z-axis, and the normal lies in the plane of
    # x and z.
    x_axis = torch.stack([cosines, zeros, sines], dim=1)
    light_x = (light * x_axis[:, None]).sum(2)
    light_y = light[..., 1]
    light_z = (light * toward[:, None]).sum(2)
    harmonic_indices = [l * (l + 1) + m for l in range(degree + 1) for m in range(l + 1)]
    light_in_sample = torch.stack([light_x, light_y, light_z])
    # The M harmonics at the Q directions of light of each camera direction, shape (M, N, Q).
    harmonics = torch.stack(evaluate_harmonics(light_in_sample, harmonic_indices))
    # Sum over the Q directions of light, shape (3, M, N).
    return torch.einsum("tnq,mnq->tmn", weighted_lobe, harmonics)


def _half_vectors(cosines: Tensor, roughness: Tensor) -> tuple[Tensor, Tensor]:
    """Place half vectors around a normal along z, most of them where the lobe is high.

    The half vectors have azimuths φ and polar angles θ_h. The substitution
    tan θ_h = α tan ψ spreads the lobe evenly over ψ. Nodes are equally spaced
    in φ and are those of Gauss-Legendre quadrature in ψ. Half vectors at
    large polar angles are left out, because the light that they mirror to the
    camera would come from below the horizon. The lobe is symmetric about the
    plane of n and v, so azimuths on one side of this plane are enough.

    Args:
        cosines: Cosine n·v in (0, 1) of N camera directions, float64,
            shape (N,).
        roughness: Roughness, shape ().

    Returns:
        A tuple of

        - Q unit half vectors for each camera direction, float64,
          shape (N, Q, 3);
        - their solid angles dh on both sides of the plane, float64,
          shape (N, Q).
    """
    nodes, weights = np.polynomial.legendre.leggauss(POLAR_NODE_COUNT)
    node = torch.from_numpy(nodes)[:, None]
    weight = torch.from_numpy(weights)[:, None]
    steps = torch.arange(AZIMUTH_COUNT, dtype=torch.float64) + 0.5
    azimuth = math.pi * steps / AZIMUTH_COUNT
    alpha = roughness**2
    sines = (1 - cosines**2).sqrt()
    # The camera leans away from the half vectors by this angle, in the plane of
    # the normal and the azimuth φ. The mirrored light leans from the normal by
    # this angle plus twice the polar angle. Shape (N, azimuths).
    camera_lean = torch.atan2(sines[:, None] * azimuth.cos(), cosines[:, None])
    largest_polar = (math.pi / 2 - camera_lean) / 2
    # The value of ψ at the largest polar angle, shape (N, 1, azimuths).
    largest_psi = (largest_polar.tan() / alpha).atan()[:, None]
    # The nodes in [-1, 1] are moved to [0, largest ψ], shape (N, nodes, azimuths).
    psi = largest_psi * (node + 1) / 2
    polar = (alpha * psi.tan()).atan()
    x = polar.sin() * azimuth.cos()
    y = polar.sin() * azimuth.sin()
    half = torch.stack([x, y, polar.cos()], -1).flatten(1, 2)
    # The solid angle is sin θ_h dθ_h dφ, with the derivative dθ_h / dψ.
    polar_per_psi = alpha * (polar.cos() / psi.cos()) ** 2
    per_azimuth = (largest_psi * weight / 2 * polar_per_psi * polar.sin()).flatten(1)
    return half, per_azimuth * (2 * math.pi / AZIMUTH_COUNT)
