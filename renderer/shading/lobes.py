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

# A degree of the light is neglected if a highlight reflects it with at most this fraction
# of the amplitude with which it reflects degree 0.
MIN_AMPLITUDE = 1e-3

# `lobe_functions` uses one common table of this degree for all lights up to this degree.
COMMON_DEGREE = 6
# `_table` computes the lobe functions at this number of values of the roughness, and
# interpolates them with the same number of Chebyshev polynomials in the roughness.
ROUGHNESS_POLYNOMIALS = 12
# A lobe function of a perfect mirror needs 2 degree + 1 Chebyshev polynomials in the
# cosine. `_fit` uses this many more.
EXTRA_POLYNOMIALS = 3
# Number of cosines for which `_fit` integrates the lobes at once. It limits the memory.
COSINES_AT_ONCE = 16
# Numbers of polar angles and azimuths of the half vectors in `_half_vectors`.
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
        # The choice of view axes does not change the reflected light. The axes are
        # therefore computed without gradients.
        mean_toward = unit(toward.detach().mean(0))
        axis = ViewAxis.along(mean_toward)
        normals_in_view = axis.to_view(normals)
        # If all samples share one direction to the camera, sample axes and view axes are
        # the same. A tilt is then only needed for the gradient of the direction.
        if len(toward) == 1 and not toward.requires_grad:
            return ViewFrame(normals=torch.stack(normals_in_view), tilt=None, axis=axis)
        toward_in_view = axis.to_view(toward)
        tilt = Tilt.along(toward_in_view)
        normals_in_sample = tilt.to_sample(normals_in_view)
        return ViewFrame(normals=torch.stack(normals_in_sample), tilt=tilt, axis=axis)

    @property
    def cosine(self) -> Tensor:
        """Cosine of the angle between normal and view direction, at least 0, shape (S,)."""
        # The direction to the camera is the z-axis of the sample axes.
        return self.normals[2].clamp(0, 1)

    def harmonics(self, lobes: Tensor) -> Tensor:
        """Compute the spherical-harmonic coefficients of the lobe at each sample.

        The lobe is the specular reflectance as a function of the direction to the
        light. The z-axis of the view axes is the mean direction to the camera. If
        all samples have the same direction to the camera (`tilt` is None), the
        result is in view axes. Otherwise, it is in the view axes in the order y, z,
        x. The coefficients in world axes are
        `frame.to_world(frame.harmonics(lobes))`.

        Args:
            lobes: Values of the M lobe functions at the S samples, from
                `lobe_functions`, shape (M, S).

        Returns:
            Coefficients of the K = (degree + 1)² harmonics, shape (K, S).
        """
        degree = _degree_of_lobes(lobes)
        coefficients = self._harmonics_in_sample_axes(lobes, degree)
        if self.tilt is None:
            return coefficients
        # The tilt R_x(a) R_y(b) rotates about the y-axis and then about the x-axis. But
        # harmonics are only easy to rotate about the z-axis. Let C be the cyclic
        # permutation of the axes: x to y, y to z, z to x. Then C R_y(b) = R_z(b) C and
        # C² R_x(a) = R_z(a) C², so R_z(a) C R_z(b) C = C² R_x(a) R_y(b). The loop computes
        # the left side, which is the tilt and then two permutations.
        permutation = _axis_permutation(degree)
        for angle in (self.tilt.about_y, self.tilt.about_x):
            coefficients = _rotate_harmonics(_multiply_bands(permutation, coefficients), angle)
        return coefficients

    def _harmonics_in_sample_axes(self, lobes: Tensor, degree: int) -> Tensor:
        """Compute the SH coefficients of the lobe of each of S samples in its own sample axes.

        The lobe is the specular reflectance as a function of the direction to the
        light. In sample axes, the camera is in the direction of the z-axis. Let θ be
        the polar angle and φ the azimuth of the normal. The coefficient of the
        harmonic of degree l and order m ≥ 0 is c_lm sin^m θ cos mφ, with the lobe
        function c_lm. For order -m < 0, it is c_lm sin^m θ sin mφ.

        Args:
            lobes: Values of the lobe functions c_lm at the samples, shape (M, S).
            degree: Degree of the lobe functions.

        Returns:
            Coefficients of the K = (degree + 1)² harmonics, shape (K, S).
        """
        function_of_harmonic, order = _functions_and_orders(degree)
        function_of_harmonic = function_of_harmonic.to(lobes.device)
        order = order.to(lobes.device)
        normal_x, normal_y, _ = self.normals
        # With x = sin θ cos φ and y = sin θ sin φ, the factors sin^m θ cos mφ and
        # sin^m θ sin mφ are the real and the imaginary part of (x + iy)^m.
        factors = _complex_powers(normal_x, normal_y, degree).index_select(0, degree + order)
        return lobes.index_select(0, function_of_harmonic) * factors

    def to_world(self, coefficients: Tensor) -> Tensor:
        """Rotate SH coefficients from the intermediate axes of `harmonics` to world axes.

        The intermediate axes are the view axes if `tilt` is None. Otherwise, they are
        the view axes in the order y, z, x.

        Args:
            coefficients: SH coefficients, one function on the sphere per column,
                shape (K, P) with K = (degree + 1)².

        Returns:
            SH coefficients of the same functions in world axes, shape (K, P).
        """
        permutation = _axis_permutation(math.isqrt(len(coefficients)) - 1)
        axis = self.axis.for_columns(coefficients)
        # With a tilt, the function `harmonics` has permuted the axes cyclically two times. A
        # third permutation restores the order x, y, z.
        if self.tilt is not None:
            coefficients = _multiply_bands(permutation, coefficients)
        # The rotation to world axes is R_z(azimuth) R_y(polar). With the permutation C of
        # the axes, R_y(polar) is Cᵀ R_z(polar) C.
        permuted = _rotate_harmonics(_multiply_bands(permutation, coefficients), axis.polar)
        return _rotate_harmonics(_multiply_bands(permutation.T, permuted), axis.azimuth)

    def from_world(self, coefficients: Tensor) -> Tensor:
        """Rotate SH coefficients from world axes to the intermediate axes of `harmonics`.

        This is the inverse of `to_world`. The intermediate axes are the view axes if
        `tilt` is None. Otherwise, they are the view axes in the order y, z, x.

        Args:
            coefficients: SH coefficients in world axes, one function on the sphere
                per column, shape (K, P) with K = (degree + 1)².

        Returns:
            SH coefficients of the same functions in the intermediate axes,
            shape (K, P).
        """
        permutation = _axis_permutation(math.isqrt(len(coefficients)) - 1)
        axis = self.axis.for_columns(coefficients)
        without_azimuth = _rotate_harmonics(coefficients, axis.azimuth.reversed())
        permuted = _multiply_bands(permutation, without_azimuth)
        without_polar = _rotate_harmonics(permuted, axis.polar.reversed())
        in_view = _multiply_bands(permutation.T, without_polar)
        # With a tilt, the intermediate axes are the view axes after two cyclic
        # permutations. Two are the inverse of one, which is the transposed matrix.
        return in_view if self.tilt is None else _multiply_bands(permutation.T, in_view)


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
        # x / sin(polar) would divide by 0 at the poles, but atan2 returns 0.
        azimuth = torch.atan2(y, x)
        return ViewAxis(polar, Angle(sine=azimuth.sin(), cosine=azimuth.cos()))

    def for_columns(self, coefficients: Tensor) -> ViewAxis:
        """Convert both angles to the shape (1,) and to the dtype and device of coefficients.

        Args:
            coefficients: SH coefficients that `_rotate_harmonics` will rotate by the
                angles, shape (K, S).
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

    The z-axis points from the sample to the camera in sample axes, and in the
    mean direction to the camera in view axes. The rotation R_x(a) R_y(b) first
    rotates about the y-axis by the angle b, then about the x-axis by the angle a.

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
        """Compute the rotations that take the z-axis (0, 0, 1) to given directions.

        A rotation by the angle b about the y-axis and then by the angle a about the
        x-axis takes (0, 0, 1) to (sin b, -sin a cos b, cos a cos b). The angle b is
        chosen so that cos b ≥ 0.

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
        # From sample axes to view axes, vectors rotate about y and then about x. The inverse
        # rotates back about x first.
        rotated_about_x = _rotate_about_x(vectors, self.about_x.reversed())
        return _rotate_about_y(rotated_about_x, self.about_y.reversed())


class Angle(NamedTuple):
    """Rotation angle, given by its sine and its cosine.

    Attributes:
        sine: Sine, shape (), or (S,) for one angle per sample.
        cosine: Cosine, same shape.
    """

    sine: Tensor
    cosine: Tensor

    def reversed(self) -> Angle:
        """Return the negative angle, for the inverse rotation."""
        return Angle(sine=-self.sine, cosine=self.cosine)

    def for_columns(self, coefficients: Tensor) -> Angle:
        """Convert an angle of shape () to shape (1,), and to another dtype and device.

        Args:
            coefficients: Tensor from which the dtype and the device are taken.
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
    """Find the degree of lobe functions from their number M = (degree + 1) (degree + 2) / 2.

    Args:
        lobes: Values of the lobe functions at S samples, shape (M, S).
    """
    return (math.isqrt(8 * len(lobes) + 1) - 3) // 2


@cache_tensors
def _functions_and_orders(degree: int) -> tuple[Tensor, Tensor]:
    """Find the order and the index of the lobe function of each harmonic.

    The harmonic of degree l and order m has the index l² + l + m. The lobe
    function c_l|m| has the index l (l + 1) / 2 + |m|.

    Args:
        degree: Largest degree l of the K = (degree + 1)² harmonics.

    Returns:
        A tuple of

        - the index of the lobe function c_l|m| of each harmonic, shape (K,);
        - the order m of each harmonic, from -l to l, shape (K,).
    """
    l = bands(degree)
    m = torch.arange(len(l)) - l * (l + 1)
    function_of_harmonic = l * (l + 1) // 2 + m.abs()
    return function_of_harmonic, m


def _complex_powers(x: Tensor, y: Tensor, degree: int) -> Tensor:
    """Compute the real and imaginary parts of the powers of x + iy.

    With x = s cos φ and y = s sin φ, the real part of (x + iy)^m is s^m cos mφ,
    and the imaginary part is s^m sin mφ.

    Args:
        x: Real part, shape (...).
        y: Imaginary part, shape (...).
        degree: Largest exponent.

    Returns:
        One row for each m from -degree to degree, shape (2 degree + 1, ...). The
        row is Im (x + iy)^|m| if m < 0, and Re (x + iy)^m if m ≥ 0.
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
    """Rotate functions on the sphere about the z-axis, from x toward y.

    A rotation by the angle a mixes only the SH coefficients u_m and u_-m of the
    orders m and -m in a band: u'_m = cos(ma) u_m - sin(ma) u_-m.

    Args:
        coefficients: SH coefficients, one function per column, shape (K, S).
        angle: Angle a for each column, shape (S,), or (1,) if all columns share
            one angle.

    Returns:
        Coefficients of the rotated functions, shape (K, S).
    """
    degree = math.isqrt(len(coefficients)) - 1
    _, order = _functions_and_orders(degree)
    order = order.to(coefficients.device)
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
    """Rotate functions on the sphere by multiplying their SH coefficients by a matrix.

    A rotation does not mix coefficients of different degrees. The matrix is zero
    outside one block per degree on its diagonal, so only the blocks are
    multiplied.

    Args:
        rotation: Matrix that rotates SH coefficients, shape (K, K).
        coefficients: SH coefficients, one function per column, shape (K, S).

    Returns:
        SH coefficients of the rotated functions, shape (K, S).
    """
    products: list[Tensor] = []
    for l in range(math.isqrt(len(coefficients))):
        # Indices of the harmonics of degree l.
        band = slice(l * l, (l + 1) * (l + 1))
        products.append(rotation[band, band].to(coefficients) @ coefficients[band])
    return torch.cat(products)


@cache_tensors
def _axis_permutation(degree: int) -> Tensor:
    """Compute how SH coefficients change if the axes are permuted: x to y, y to z, z to x.

    Args:
        degree: Largest degree of the K = (degree + 1)² harmonics.

    Returns:
        Orthogonal matrix by which the coefficients are multiplied, float64,
        shape (K, K).
    """
    identity = torch.eye((degree + 1) ** 2, dtype=torch.float64)
    permutation = torch.eye(3, dtype=torch.float64).roll(1, 0)
    return rotate(identity, permutation)


def lobe_functions(cosine: Tensor, roughness: Tensor, degree: int, terms: Sequence[int]) -> Tensor:
    """Evaluate the lobe functions π c_lm, which describe the specular reflection of samples.

    The lobe of a sample is π times its specular reflectance times n·l, as a
    function of the direction l to the light. The normal is n, and v is the
    direction to the camera. In axes in which v is the z-axis and n lies in the
    plane of x and z, the lobe has the SH coefficients π c_lm sin^m θ, with the
    angle θ between n and v. The result is differentiable with respect to both
    tensors.

    Args:
        cosine: Cosine n·v = cos θ in [0, 1] at the S samples, shape (S,).
        roughness: Roughness r in [MIN_ROUGHNESS, 1], shape (S,), or (1,) if all
            samples share one roughness.
        degree: Largest degree l of the spherical harmonics.
        terms: T Fresnel terms of the reflectance among SCHLICK, EDGE and
            DIELECTRIC.

    Returns:
        Values of the M = (degree + 1) (degree + 2) / 2 functions with
        0 ≤ m ≤ l, in ascending order of l and then of m, shape (T, M, S).
    """
    term_indices = list(terms)
    has_one_roughness = len(roughness) == 1
    # If no gradient is needed, it is faster to compute a table for this one roughness than
    # the table for all values of the roughness.
    if degree > COMMON_DEGREE and has_one_roughness and not roughness.requires_grad:
        table_at_roughness = _table_at(degree, float(roughness)).to(cosine)
        # Axes: Fresnel term, lobe function, polynomial in the cosine.
        cosine_coefficients = table_at_roughness[term_indices]
        return cosine_coefficients @ _cosine_polynomials(cosine, cosine_coefficients.shape[-1])
    function_count = (degree + 1) * (degree + 2) // 2
    table = _table(max(degree, COMMON_DEGREE)).to(cosine)
    # Axes: Fresnel term, lobe function, polynomial in the roughness, polynomial in the
    # cosine.
    coefficients = table[term_indices, :function_count]
    # Values of polynomials: one row for each polynomial, one column for each sample.
    in_cosine = _cosine_polynomials(cosine, coefficients.shape[-1])
    in_roughness = roughness_polynomials(roughness)
    if has_one_roughness:
        # Sum over the polynomials in the roughness (index r).
        cosine_coefficients = torch.einsum("tmrc,r->tmc", coefficients, in_roughness[:, 0])
        return cosine_coefficients @ in_cosine
    # Axes: polynomial in the roughness, polynomial in the cosine, sample.
    products = in_roughness[:, None] * in_cosine
    return coefficients.flatten(2) @ products.flatten(0, 1)


def coat_albedo(cosine: Tensor, roughness: Tensor) -> Tensor:
    """Compute E(μ), the fraction of a light beam that a dielectric coat reflects.

    The coat is a transparent layer with a rough surface. It reflects a beam at
    the angle of incidence arccos μ into all directions. E(μ) is also the radiance
    that a camera at this angle sees if light of radiance 1 comes from all
    directions, because the reflectance does not change if the directions of light
    and camera are exchanged. The result is differentiable.

    Args:
        cosine: Cosine μ between the normal and the direction, in [0, 1], any
            shape.
        roughness: Roughness in [MIN_ROUGHNESS, 1], same shape or (1,).

    Returns:
        E(μ) in [0, 1], same shape as `cosine`.
    """
    coefficients = _coat_coefficients().to(cosine)
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

    Args:
        degree: Largest degree l of the spherical harmonics.

    Returns:
        Coefficients of the factors B_l in the polynomials of
        `roughness_polynomials`, float64, shape (degree + 1, polynomials).
    """
    nodes, weights = np.polynomial.legendre.leggauss(degree + 64)
    # The nodes of the quadrature in [-1, 1] are mapped to cosines in [0, 1].
    cosine = (torch.from_numpy(nodes) + 1) / 2
    coefficients = _coat_coefficients()
    # The integrand E(μ) μ: one row for each polynomial of the roughness, one column for
    # each cosine μ.
    reflected = coefficients @ _cosine_polynomials(cosine, coefficients.shape[1]) * cosine
    # Legendre polynomials: one row for each cosine, one column for each degree.
    legendre = torch.from_numpy(np.polynomial.legendre.legvander(cosine.numpy(), degree))
    return math.pi * (legendre.T * torch.from_numpy(weights)) @ reflected.T


def coat_mean(roughness: Tensor) -> Tensor:
    """Compute the fraction of uniform environment light that a dielectric coat reflects.

    The fraction is E_avg = 2 ∫ E(μ) μ dμ over 0 ≤ μ ≤ 1, with the reflected
    fraction E(μ) of a single beam (`coat_albedo`). The result is differentiable.

    Args:
        roughness: Roughness in [MIN_ROUGHNESS, 1], shape (S,).

    Returns:
        E_avg in [0, 1], shape (S,).
    """
    reflected_irradiance = (
        coat_irradiance_factors(0).to(roughness) @ roughness_polynomials(roughness)
    )[0]
    return reflected_irradiance / math.pi


def _coat_coefficients() -> Tensor:
    """Return the Chebyshev coefficients of the reflected fraction E(μ) of a dielectric coat.

    E(μ) is a sum of products of a Chebyshev polynomial in the roughness and one
    in the cosine μ (see `coat_albedo`).

    Returns:
        Factors of the products, float64. Each row belongs to a polynomial in the
        roughness, and each column to a polynomial in the cosine.
    """
    # The reflected fraction E(μ) is the integral of the lobe (reflectance times the cosine
    # n·l) over all directions l of light. This is √(4π) times the SH coefficient of degree 0
    # of the lobe. The table contains π times this coefficient.
    return _table(COMMON_DEGREE)[DIELECTRIC, 0] * (math.sqrt(4 * math.pi) / math.pi)


# Chebyshev polynomials have arguments in [-1, 1]. The following four functions map
# cosines and values of the roughness to such arguments, and back.


def _cosine_to_argument(cosine: Tensor) -> Tensor:
    """Map cosines in [0, 1] to arguments of Chebyshev polynomials in [-1, 1].

    Small cosines are spread over a wider range, because lobes change quickly at
    grazing angles.

    Args:
        cosine: Cosines, any shape.

    Returns:
        Arguments, same shape.
    """
    return 4 * cosine / (cosine + 1) - 1


def _argument_to_cosine(argument: Tensor) -> Tensor:
    """Map arguments in [-1, 1] to cosines in [0, 1], as the inverse of `_cosine_to_argument`."""
    return (argument + 1) / (3 - argument)


def _roughness_to_argument(roughness: Tensor) -> Tensor:
    """Map values of the roughness from [MIN_ROUGHNESS, 1] to arguments in [-1, 1]."""
    return (2 * roughness - 1 - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS)


def _argument_to_roughness(argument: Tensor) -> Tensor:
    """Map arguments in [-1, 1] to values of the roughness in [MIN_ROUGHNESS, 1]."""
    return (argument * (1 - MIN_ROUGHNESS) + 1 + MIN_ROUGHNESS) / 2


def roughness_polynomials(roughness: Tensor) -> Tensor:
    """Evaluate Chebyshev polynomials in the roughness.

    Functions of the roughness in this module are sums of these polynomials. The
    result is differentiable with respect to the roughness.

    Args:
        roughness: Roughness in [MIN_ROUGHNESS, 1], shape (S,).

    Returns:
        Values of the polynomials, shape (ROUGHNESS_POLYNOMIALS, S).
    """
    return _chebyshev(_roughness_to_argument(roughness), ROUGHNESS_POLYNOMIALS)


def _cosine_polynomials(cosine: Tensor, count: int) -> Tensor:
    """Evaluate Chebyshev polynomials in the cosine.

    Functions of the cosine in this module are sums of these polynomials.

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
    """Compute the zeros of the Chebyshev polynomial of degree `count`, shape (count,)."""
    steps = torch.arange(count, dtype=torch.float64) + 0.5
    angles = math.pi * steps / count
    return angles.cos()


@cache_tensors
def _table(degree: int) -> Tensor:
    """Approximate the lobe functions (see `lobe_functions`) by products of polynomials.

    Each function π c_lm(cos θ, r) is approximated by Σ_k Σ_p a_kp T_k(y) T_p(x)
    with Chebyshev polynomials T. The argument y stands for the roughness r (see
    `_roughness_to_argument`), and x for the cosine n·v = cos θ (see
    `_cosine_to_argument`). There are R = ROUGHNESS_POLYNOMIALS polynomials in the
    roughness, and P = 2 degree + 1 + EXTRA_POLYNOMIALS in the cosine.

    Args:
        degree: Largest degree l of the spherical harmonics.

    Returns:
        Coefficients a_kp, float64, for each of the three Fresnel terms and of
        the M = (degree + 1) (degree + 2) / 2 pairs (l, m) with 0 ≤ m ≤ l,
        shape (3, M, R, P).
    """
    roughness_arguments = _chebyshev_nodes(ROUGHNESS_POLYNOMIALS)
    roughnesses = _argument_to_roughness(roughness_arguments)
    # Axes: roughness r, Fresnel term t, lobe function m, polynomial in the cosine c.
    fits = torch.stack([_fit(degree, float(roughness)) for roughness in roughnesses])
    # This matrix maps the values of a function at all values of the roughness to the
    # coefficients k of the polynomials that pass through these values.
    interpolation = torch.linalg.inv(_chebyshev(roughness_arguments, ROUGHNESS_POLYNOMIALS).T)
    return torch.einsum("kr,rtmc->tmkc", interpolation, fits).contiguous()


@lru_cache(maxsize=8)
@torch.inference_mode(False)
def _table_at(degree: int, roughness: float) -> Tensor:
    """Return the result of `_fit`, from a cache if it is one of the latest eight.

    Args:
        degree: Largest degree of the spherical harmonics.
        roughness: Roughness in [MIN_ROUGHNESS, 1].
    """
    return _fit(degree, roughness)


def _fit(degree: int, roughness: float) -> Tensor:
    """Approximate the lobe functions at one roughness by Chebyshev polynomials in cos θ.

    For the lobe functions π c_lm(cos θ, r), see `lobe_functions`. The number of
    polynomials is P = 2 degree + 1 + EXTRA_POLYNOMIALS. When a mirror turns by θ,
    the reflected light turns by 2 θ. A harmonic of degree l of this light
    therefore needs polynomials up to degree 2 l.

    Args:
        degree: Largest degree l of the spherical harmonics.
        roughness: Roughness r in [MIN_ROUGHNESS, 1].

    Returns:
        Coefficients of the polynomials, float64, for each of the three Fresnel
        terms and of the M = (degree + 1) (degree + 2) / 2 pairs (l, m) with
        0 ≤ m ≤ l, shape (3, M, P). They are zero for degrees above COMMON_DEGREE
        whose amplitude at this roughness is at most MIN_AMPLITUDE.
    """
    polynomial_count = 2 * degree + 1 + EXTRA_POLYNOMIALS
    noticeable_degree = max(required_degree(roughness, MIN_AMPLITUDE), COMMON_DEGREE)
    fitted_degree = min(degree, noticeable_degree)
    # A least-squares fit needs more values than polynomials: 1.5 times as many.
    cosine_arguments = _chebyshev_nodes(3 * polynomial_count // 2)
    cosines = _argument_to_cosine(cosine_arguments)
    roughness_tensor = torch.tensor(roughness, dtype=torch.float64)
    blocks = []
    for some_cosines in cosines.split(COSINES_AT_ONCE):
        blocks.append(_lobe_integrals(some_cosines, roughness_tensor, fitted_degree))
    # Values of π c_lm sin^m θ, with the axes: pair (l, m), cosine, Fresnel term.
    integrals = torch.cat(blocks, dim=2).permute(1, 2, 0)
    # Order m of each pair (l, m).
    orders = torch.tensor([m for l in range(fitted_degree + 1) for m in range(l + 1)])
    # Values of sin^m θ, with the axes: pair (l, m), cosine, and one of size 1.
    sine_powers = (1 - cosines[:, None] ** 2) ** (orders[:, None, None] / 2)
    # The integrals contain the factor sin^m θ. The polynomials are therefore multiplied by
    # it, because dividing the integrals by it is inaccurate near θ = 0. Axes: pair (l, m),
    # cosine, polynomial.
    fitted_functions = sine_powers * _chebyshev(cosine_arguments, polynomial_count).T
    fit = torch.linalg.lstsq(fitted_functions, integrals, rcond=1e-9, driver="gelsd")
    # Axes: Fresnel term, pair (l, m), polynomial.
    coefficients = fit.solution.permute(2, 0, 1)
    # Append zeros for the pairs (l, m) with degrees that were not fitted.
    function_count = (degree + 1) * (degree + 2) // 2
    missing_count = function_count - len(orders)
    return torch.nn.functional.pad(coefficients, (0, 0, 0, missing_count))


def _lobe_integrals(cosines: Tensor, roughness: Tensor, degree: int) -> Tensor:
    """Integrate π times a specular lobe times each spherical harmonic over the sphere.

    The lobe is the reflectance times the cosine n·l, as a function of the
    direction l to the light. In axes in which the camera direction v is the z-axis
    and the normal n lies in the plane of x and z, the integral is π c_lm sin^m θ
    (see `lobe_functions`). The integral is a sum over Q half vectors, which are
    the bisectors of l and v.

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
    # The vectors are first computed in surface axes: the normal is the z-axis, and the
    # camera lies in the plane of x and z.
    normal = half.new_tensor([[0.0, 0.0, 1.0]])
    sines = (1 - cosines**2).sqrt()
    zeros = 0 * sines
    toward = torch.stack([-sines, zeros, cosines], dim=1)
    # Cosines v·h: one row for each camera direction v, one column for each half vector h.
    half_cosine = (toward[:, None] * half).sum(-1)
    # Direction to the light: the camera direction, mirrored at the half vector.
    light = 2 * half_cosine[..., None] * half - toward[:, None]
    light_cosine = light[..., 2].clamp(min=0)
    # Axes: Fresnel term, camera direction, half vector.
    reflected = reflectance(normal, toward[:, None], light, roughness)
    # The solid angle of the light is dl = 4 (v·h) dh with the solid angle dh of the half
    # vector h (Walter et al. 2007, equation 14).
    weighted_lobe = reflected * light_cosine * solid_angles * 4 * half_cosine

    # Here the normal is the z-axis. The harmonics need the directions to the light in other
    # axes, whose z-axis is the direction to the camera. Both frames share the y-axis.
    x_axis = torch.stack([cosines, zeros, sines], dim=1)
    light_x = (light * x_axis[:, None]).sum(2)
    light_y = light[..., 1]
    light_z = (light * toward[:, None]).sum(2)
    harmonic_indices = [l * (l + 1) + m for l in range(degree + 1) for m in range(l + 1)]
    light_in_sample = torch.stack([light_x, light_y, light_z])
    # Axes: harmonic m, camera direction n, direction of light q.
    harmonics = torch.stack(evaluate_harmonics(light_in_sample, harmonic_indices))
    # Sum over the directions of light q, for each Fresnel term t.
    return torch.einsum("tnq,mnq->tmn", weighted_lobe, harmonics)


def _half_vectors(cosines: Tensor, roughness: Tensor) -> tuple[Tensor, Tensor]:
    """Choose half vectors for a sum over a specular lobe, most of them where the lobe is high.

    A half vector is the bisector of the directions to the light and to the camera
    (v). The normal n is the z-axis. The half vectors have azimuths φ and polar
    angles θ_h. The substitution tan θ_h = α tan ψ spreads the lobe evenly over ψ,
    with α = roughness². The azimuths are equally spaced, and the values of ψ are
    the nodes of Gauss-Legendre quadrature. Half vectors at large polar angles are
    left out, because their light would come from below the horizon. The lobe is
    symmetric about the plane of n and v, so azimuths on one side are enough.

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
    # Angle from the normal to the camera, projected to the plane at the azimuth φ and
    # measured away from the half vector. One row for each camera direction, one column for
    # each azimuth.
    camera_angle = torch.atan2(sines[:, None] * azimuth.cos(), cosines[:, None])
    # The light is at the angle `camera_angle` + 2 θ_h from the normal, which must be at
    # most π/2.
    largest_polar = (math.pi / 2 - camera_angle) / 2
    # The nodes are spaced in the variable ψ, for which tan θ_h = α tan ψ with the polar
    # angle θ_h. This is its largest value, with a new axis for the nodes.
    largest_psi = (largest_polar.tan() / alpha).atan()[:, None]
    # Map the nodes from [-1, 1] to [0, largest ψ]. Axes: camera direction, node, azimuth.
    psi = largest_psi * (node + 1) / 2
    polar = (alpha * psi.tan()).atan()
    x = polar.sin() * azimuth.cos()
    y = polar.sin() * azimuth.sin()
    half = torch.stack([x, y, polar.cos()], -1).flatten(1, 2)
    # Derivative dθ_h / dψ of the polar angle θ_h, given by tan θ_h = α tan ψ. With the
    # azimuth φ, the solid angle is sin θ_h (dθ_h / dψ) dψ dφ.
    polar_per_psi = alpha * (polar.cos() / psi.cos()) ** 2
    per_azimuth = (largest_psi * weight / 2 * polar_per_psi * polar.sin()).flatten(1)
    return half, per_azimuth * (2 * math.pi / AZIMUTH_COUNT)
