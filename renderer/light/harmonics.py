"""Real spherical harmonics as polynomials in (x, y, z), and diffuse shading with them.

The harmonic Y_lm of band l (0 to the degree) and order m (-l to l) has the
index l² + l + m. A light of degree D therefore has (D + 1)² coefficients per
channel. Harmonics have no Condon-Shortley sign: Y₁ = √(3/4π) (y, z, x).

The polynomial form has no polar angles, so it is exact at the poles. The
derivatives of the paper's form (appendix B.1) are not finite there.

Example:
    >>> import torch
    >>> import norm_balls as nb
    >>> up = torch.tensor([0.0, 0.0, 1.0])
    >>> values = nb.harmonics.basis(up, degree=1)  # Y₀₀, then Y₁ in the order y, z, x
    >>> [round(value, 4) for value in values.tolist()]
    [0.2821, 0.0, 0.4886, 0.0]
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64, Int
from torch import Tensor

from renderer.errors import InputError, as_tensor, require_finite, require_shape, require_whole
from renderer.settings import MAX_DEGREE
from renderer.vectors import unit

# Largest degree that `quadrature` accepts. A rule of degree D has about D² / 2
# directions.
MAX_QUADRATURE = 10**4
# Largest height and largest width in texels that `equirectangular` accepts.
MAX_TEXELS = 10**6
# `rotate` accepts a matrix R if no entry of R Rᵀ - I is larger than this. A rotation
# matrix whose entries are rounded to four digits fulfills this.
ORTHONORMALITY_TOLERANCE = 1e-3
# Diffuse shading ignores harmonics above this degree. They change the irradiance
# under a parallel beam of light by at most 0.015 times the irradiance of the beam.
DIFFUSE_DEGREE = 20
# Type of the result of a function that `cache_tensors` decorates.
Constant = TypeVar("Constant")
# Indices of the coordinates x, y and z in the first dimension of `gradient_matrices`.
X_AXIS, Y_AXIS, Z_AXIS = range(3)


def cache_tensors(function: Callable[..., Constant]) -> Callable[..., Constant]:
    """Decorate a function of hashable arguments that returns tensors, so that results are cached.

    The function runs outside of torch's inference mode. A cached tensor that was
    created in inference mode could not be used in training later.
    """
    return cache(torch.inference_mode(False)(function))


def degree_of(light: Float[Tensor, "coefficients 3"]) -> int:
    """Return the degree of a light.

    Args:
        light: SH coefficients, shape ((degree + 1)², 3).

    Returns:
        The degree. For example, 49 coefficients have degree 6.

    Raises:
        InputError: If no degree has this number of coefficients.
    """
    light = as_tensor("light", light)
    require_shape("light", light, "(degree + 1)²", 3)
    return _degree_of_rows("light", light)


def _degree_of_rows(name: str, coefficients: Tensor) -> int:
    """Find the degree of a light from the number of its SH coefficients, which are rows."""
    count = len(coefficients) if coefficients.ndim == 2 else 0
    degree = math.isqrt(count) - 1
    if not count or count != (degree + 1) ** 2:
        given = f"{name} has shape {tuple(coefficients.shape)}"
        raise InputError(f"{given}: give SH coefficients ((degree + 1)², channels)", name)
    return degree


def basis(
    directions: Float[Tensor, "*batch 3"], degree: int
) -> Float[Tensor, "*batch coefficients"]:
    """Evaluate the real spherical harmonics of all bands up to a degree.

    The values are computed in float64 and can be differentiated once with
    respect to the directions. The recurrences are those of Liu et al. 2019,
    appendix B.1. In contrast to the appendix, the factor sin^m θ is part of the
    powers (x + iy)^m and not of the Legendre functions P_l^m.

    Args:
        directions: Finite vectors of any length, shape (..., 3). Only their
            direction counts. At a zero vector, the values are finite and the
            gradient is zero.
        degree: Highest band, from 0 to `MAX_DEGREE`.

    Returns:
        Harmonics in the order of their indices, shape (..., (degree + 1)²), in
        the dtype of the directions.

    Raises:
        InputError: If the shape is wrong, a direction holds NaN or infinity, or
            the degree is out of range.
    """
    require_degree(degree)
    directions = as_tensor("directions", directions)
    require_shape("directions", directions, "...", 3)
    require_finite(directions=directions)
    components = unit(directions.double().movedim(-1, 0))
    values = evaluate_harmonics(components, range((degree + 1) ** 2))
    return torch.stack(values, dim=-1).to(directions.dtype)


def require_degree(degree: int) -> None:
    """Check that the degree of a light is a whole number from 0 to `MAX_DEGREE`."""
    require_whole("degree", degree, 0, MAX_DEGREE)


def evaluate_harmonics(directions: Tensor, indices: Iterable[int]) -> list[Tensor]:
    """Evaluate the spherical harmonics with given indices, without checks of the arguments.

    Args:
        directions: Unit vectors, with the three components along the first axis,
            shape (3, ...).
        indices: Indices l² + l + m of the harmonics of band l and order m.

    Returns:
        For each index, the values of its harmonic in all directions, shape (...).
        An index that is given twice has one entry, at its first place.
    """
    x, y, z = directions
    # A dictionary keeps the order of the indices and removes repeated indices.
    unique_indices = dict.fromkeys(indices)
    values_by_index = {}
    degree = math.isqrt(max(unique_indices, default=0))
    # Real and imaginary part of (x + iy)^m, times √2 if m > 0.
    real_power = torch.ones_like(z)
    imaginary_power = torch.zeros_like(z)
    for m in range(degree + 1):
        for l, legendre in enumerate(_legendre(z, m, degree), start=m):
            # Index of the harmonic of order 0 in band l.
            order_zero = l * l + l
            if order_zero + m in unique_indices:
                values_by_index[order_zero + m] = real_power * legendre
            if m and order_zero - m in unique_indices:
                values_by_index[order_zero - m] = imaginary_power * legendre
        if m == degree:
            break
        if m == 0:
            real_power = real_power * math.sqrt(2)
        # Multiply the power by x + iy.
        next_real_power = torch.addcmul(x * real_power, y, imaginary_power, value=-1)
        imaginary_power = torch.addcmul(x * imaginary_power, y, real_power)
        real_power = next_real_power
    return [values_by_index[index] for index in unique_indices]


def _legendre(z: Tensor, m: int, degree: int) -> Iterator[Tensor | float]:
    """Evaluate the orthonormal associated Legendre functions P_l^m / sin^m θ of one order m.

    The functions are polynomials in z = cos θ. They are yielded for l = m to degree. The first is
    constant and yielded as a number, because multiplying by a number is faster.
    """
    ratios = [(2 * k + 1) / (2 * k) for k in range(1, m + 1)]
    constant = math.sqrt(math.prod(ratios) / (4 * math.pi))
    yield constant
    # The functions of bands l - 2 (before_previous) and l - 1 (previous) give the
    # function of band l.
    before_previous = z.new_full((), constant)
    previous = z * math.sqrt(2 * m + 3) * constant
    for l in range(m + 1, degree + 1):
        if l > m + 1:
            a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
            b = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            # P_l = a (z P_(l-1) - b P_(l-2)).
            current = torch.addcmul(before_previous * (-a * b), z, previous, value=a)
            before_previous = previous
            previous = current
        yield previous


@cache_tensors
def gradient_matrices(degree: int) -> Float64[Tensor, "3 K K"]:
    """Compute the matrices of the derivatives of harmonics with respect to x, y and z.

    Let r be the length of (x, y, z). For a harmonic Y_k of band l, r^l Y_k is a
    polynomial. Its derivative with respect to x, y or z is a sum over harmonics
    Y_j of band l - 1. With the coordinates (x_0, x_1, x_2) = (x, y, z), this is
    ∂(r^l Y_k)/∂x_d = Σ_j M[d, j, k] r^(l-1) Y_j.
    The result is M, float64.
    """
    size = (degree + 1) ** 2
    matrices = torch.zeros(3, size, size, dtype=torch.float64)
    for l in range(1, degree + 1):
        for m in range(l + 1):
            _set_gradients(matrices, l, m)
    return matrices


def _set_gradients(matrices: Float[Tensor, "3 K K"], l: int, m: int) -> None:
    """Set the derivatives of the harmonics Y_lm and Y_l,-m in the matrices, in place.

    A column of a matrix belongs to a harmonic of band l. Its rows hold the coefficients of the
    harmonics of band l - 1 in its derivative. The derivative of Y_lm with respect to z is a
    harmonic of the same order in band l - 1. The derivatives with respect to x and y are sums of
    harmonics of the orders m - 1 and m + 1 in band l - 1 (ladder operators). The three matrices are
    the derivatives with respect to x, y and z. l is at least 1, and m at least 0.
    """
    norm = (2 * l + 1) / (2 * l - 1)
    # Factors of the harmonics of the orders m - 1 (down) and m + 1 (up) in band l - 1.
    down = math.sqrt(norm * (l + m) * (l + m - 1)) / 2 * (math.sqrt(2) if m == 1 else 1)
    up = math.sqrt(norm * (l - m) * (l - m - 1)) / 2 * (math.sqrt(2) if m == 0 else 1)
    # Row of the harmonic of order 0 in band l - 1. The row of order m is `row` + m.
    row = (l - 1) * l
    # Columns of the orders m and -m in band l, which contain cos mφ and sin mφ.
    cosine_column = l * l + l + m
    sine_column = l * l + l - m
    if m < l:
        z_factor = math.sqrt(norm * (l * l - m * m))
        matrices[Z_AXIS, row + m, cosine_column] = z_factor
        matrices[Z_AXIS, row - m, sine_column] = z_factor
    if m + 1 < l:
        matrices[X_AXIS, row + m + 1, cosine_column] = -up
        matrices[Y_AXIS, row - m - 1, cosine_column] = -up
    if m + 1 < l and m > 0:
        matrices[X_AXIS, row - m - 1, sine_column] = -up
        matrices[Y_AXIS, row + m + 1, sine_column] = up
    if m > 0:
        matrices[X_AXIS, row + m - 1, cosine_column] = down
        matrices[Y_AXIS, row + m - 1, sine_column] = down
    if m > 1:
        matrices[X_AXIS, row - m + 1, sine_column] = down
        matrices[Y_AXIS, row - m + 1, cosine_column] = -down


@cache_tensors
def homogeneous_gradients(degree: int) -> Float64[Tensor, "3 K K"]:
    """Compute the matrices of the derivatives of the homogeneous polynomials r^degree Y_k.

    Let r be the length of (x, y, z), and Y_k a harmonic of a band l with the
    same parity as `degree`. Then r^degree Y_k is a homogeneous polynomial. With
    (x_0, x_1, x_2) = (x, y, z), its derivatives are
    ∂(r^degree Y_k)/∂x_d = Σ_j M[d, j, k] r^(degree - 1) Y_j.

    The matrices follow from the product rule for r^(degree - l) (r^l Y_k). The
    gradient of the second factor is known from `gradient_matrices`. The gradient
    of the first factor is (degree - l) r^(degree - l - 2) (x, y, z). The products
    x_d Y_k in it are sums of harmonics of the bands l - 1 and l + 1.
    The result is M, float64. Columns of bands of the other parity have no meaning.
    """
    gradients = gradient_matrices(degree)
    band_of_column = bands(degree)
    # The sum over band l - 1 in x_d Y_k is ∂(r^l Y_k)/∂x_d / (2l + 1) on the unit sphere.
    to_lower_band = gradients / (2 * band_of_column + 1)
    # Multiplying by x_d is symmetric, so the sum over band l + 1 has the transposed matrix.
    times_coordinate = to_lower_band + to_lower_band.mT
    return gradients + (degree - band_of_column) * times_coordinate


@cache_tensors
def monomial_coefficients(degree: int) -> Float64[Tensor, "monomials K"]:
    """Compute the matrix that expresses harmonics by monomials x^a y^b z^c, a + b + c = degree.

    Let r be the length of (x, y, z). For a harmonic Y_k of a band with the same
    parity as `degree`, r^degree Y_k = Σ_j M[j, k] monomial_j. The monomials are
    sorted from x^degree to z^degree, by falling power of x and then by falling
    power of y.
    The result is M, float64. Columns of bands of the other parity have no meaning.
    """
    if degree == 0:
        return torch.full((1, 1), 1 / math.sqrt(4 * math.pi), dtype=torch.float64)
    # A polynomial follows from its derivatives. The coefficient of x^a y^b z^c is the
    # coefficient of x^(a-1) y^b z^c in the derivative with respect to x, divided by a. If
    # a = 0, the derivative with respect to y is used, and if a = b = 0, to z.
    # Derivatives with respect to x, y and z as sums of harmonics of bands below `degree`.
    # Axes: direction of the derivative, harmonic in the sum, harmonic Y_k.
    in_harmonics = homogeneous_gradients(degree)[:, : degree**2]
    # The same derivatives as sums of monomials of degree `degree` - 1: one row for each
    # monomial, one column for each harmonic Y_k.
    along_x, along_y, along_z = monomial_coefficients(degree - 1) @ in_harmonics
    # Power of x, or of y if a = 0, or of z if a = b = 0.
    powers = [a or b or degree for a in range(degree, -1, -1) for b in range(degree - a, -1, -1)]
    # First come all monomials with x. Those with y but without x come from the last
    # `degree` rows of `along_y`, which are without x. The last monomial is z^degree.
    derivatives = torch.cat([along_x, along_y[-degree:], along_z[-1:]])
    return derivatives / torch.tensor(powers)[:, None]


def monomials(vectors: Float[Tensor, "3 N"], degree: int) -> Float[Tensor, "monomials N"]:
    """Evaluate all monomials x^a y^b z^c with a + b + c = degree.

    There is one row for each monomial. They are sorted from x^degree to z^degree, by
    falling power of x and then by falling power of y.
    """
    x, y, z = vectors
    values = torch.ones_like(vectors[:1])
    for power in range(1, degree + 1):
        # Each monomial of degree `power` is a monomial of degree `power` - 1 times x, y or z.
        lower_values = values
        lower_count = len(lower_values)
        values = vectors.new_empty(lower_count + power + 1, vectors.shape[1])
        torch.mul(lower_values, x, out=values[:lower_count])
        # The last `power` monomials of degree `power` - 1 have no factor x.
        without_x = lower_values[lower_count - power :]
        torch.mul(without_x, y, out=values[lower_count:-1])
        torch.mul(lower_values[-1], z, out=values[-1])
    return values


def bands(degree: int) -> Int[Tensor, " coefficients"]:
    """Return the band l of each SH coefficient up to a degree: 0, 1, 1, 1, 2, ...

    Args:
        degree: Highest band.

    Returns:
        Band of each coefficient, int64, shape ((degree + 1)²,).
    """
    # Band l has 2 l + 1 harmonics, so l is repeated 2 l + 1 times.
    return torch.arange(degree + 1).repeat_interleave(2 * torch.arange(degree + 1) + 1)


@cache_tensors
def rows_and_orders(degree: int) -> tuple[Tensor, Tensor]:
    """Find the row l (l + 1) / 2 + |m| in a list of the orders m ≥ 0, and m, of each harmonic."""
    l = bands(degree)
    m = torch.arange(len(l)) - l * (l + 1)
    return l * (l + 1) // 2 + m.abs(), m


def lambertian_factors(degree: int) -> Float64[Tensor, " coefficients"]:
    """Compute the factor A_l of each SH coefficient of a light in the irradiance.

    A light with coefficients U_lm has the irradiance Σ A_l U_lm Y_lm(n) on a
    surface with the normal n. The factors A_0, A_1, ... = π, 2π/3, π/4, 0, -π/24,
    0, π/64, ... are the coefficients of the clamped cosine (Ramamoorthi and
    Hanrahan 2001, equation 8).

    Args:
        degree: Highest band.

    Returns:
        Factor of each coefficient, float64, shape ((degree + 1)²,). Factors of
        bands above `DIFFUSE_DEGREE` are set to 0.
    """
    factors = [math.pi, 2 * math.pi / 3, *[0.0] * (degree - 1)]
    for l in range(2, min(degree, DIFFUSE_DEGREE) + 1, 2):
        # A_l = 2π (-1)^(l/2 - 1) / ((l + 2) (l - 1)) · l! / (2^l (l/2)!²) for even l.
        sign = (-1) ** (l // 2 - 1)
        binomial = math.comb(l, l // 2) / 2.0**l
        factors[l] = 2 * math.pi * sign / ((l + 2) * (l - 1)) * binomial
    return torch.tensor(factors, dtype=torch.float64)[bands(degree)]


def nonzero_coefficients(degree: int) -> Int[Tensor, " K"]:
    """Return the indices of the SH coefficients that change the irradiance of a diffuse surface.

    At degree 6, these are 31 of the 49 coefficients.

    Args:
        degree: Degree of the light.

    Returns:
        Ascending indices, int64, shape (K,).
    """
    return torch.nonzero(lambertian_factors(degree)).squeeze(1)


def diffuse_basis(directions: Float[Tensor, "3 N"], degree: int) -> tuple[list[int], Tensor]:
    """Compute the ascending indices of the M harmonics that count, and their irradiance (M, N)."""
    nonzero = nonzero_coefficients(degree).tolist()
    factors = lambertian_factors(degree).to(directions)[nonzero, None]
    return nonzero, torch.stack(evaluate_harmonics(directions, nonzero)) * factors


def irradiance_error(
    lights: Float[Tensor, "*batch K channels"], given: Float[Tensor, "*batch J channels"]
) -> Tensor:
    """Compute the relative error of the irradiance of lights that approximate other lights.

    The error is the root mean square difference of the irradiance over all
    normals and channels, divided by the root mean square irradiance of the given
    lights.

    Args:
        lights: SH coefficients of the approximate lights,
            shape (..., (degree + 1)², C) with C channels.
        given: SH coefficients of the given lights, with the same number of
            channels. Their degree may differ.

    Returns:
        Relative errors, float64, shape (...). The error is 0 if both lights are
        dark.
    """
    size = max(lights.shape[-2], given.shape[-2])
    factors = lambertian_factors(math.isqrt(size) - 1)[:, None].to(given.device)
    approximate, exact = (
        F.pad(light.double(), (0, 0, 0, size - light.shape[-2])) * factors
        for light in (lights, given)
    )
    # Harmonics are orthonormal, so the norm of the coefficients is proportional to the
    # root mean square of the irradiance over all normals.
    error = (approximate - exact).square().sum((-2, -1)).sqrt()
    return torch.where(error > 0, error / exact.square().sum((-2, -1)).sqrt(), error)


def quadrature(degree: int) -> tuple[Float64[Tensor, "N 3"], Float64[Tensor, " N"]]:
    """Compute a quadrature rule on the sphere that is exact for polynomials up to a degree.

    The rule is Gauss-Legendre quadrature in z, with equal steps in azimuth.

    Args:
        degree: Highest degree that is integrated exactly, from 0 to
            `MAX_QUADRATURE`.

    Returns:
        A tuple of
        - N = (degree // 2 + 1) (degree + 1) unit vectors, float64, shape (N, 3);
        - their weights, which add up to 4π, float64, shape (N,).

    Raises:
        InputError: If the degree is out of range.
    """
    require_whole("degree", degree, 0, MAX_QUADRATURE)
    z, z_weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuth = 2 * np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    radius = np.sqrt(1 - z**2)[:, None]
    # Coordinate x of each direction: one row per value of z, one column per azimuth.
    x = radius * np.cos(azimuth)
    y = radius * np.sin(azimuth)
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)
    # Each direction has the weight of its z, times the step in azimuth.
    weights = np.repeat(z_weights * 2 * np.pi / len(azimuth), len(azimuth))
    return torch.from_numpy(directions.reshape(-1, 3)), torch.from_numpy(weights)


def equirectangular(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Compute the directions and the solid angles of the texels of an environment map.

    Row 0 faces up (+z). The middle column faces +x, and azimuth grows to the
    left, as seen from inside the sphere.

    Args:
        height: Number of rows, from 1 to `MAX_TEXELS`.
        width: Number of columns, from 1 to `MAX_TEXELS`.

    Returns:
        A tuple of
        - unit vectors from the origin to the texels, float64,
          shape (height, width, 3);
        - solid angles in steradians, float64, shape (height, width).

    Raises:
        InputError: If the height or the width is out of range.
    """
    for name, count in (("height", height), ("width", width)):
        require_whole(name, count, 1, MAX_TEXELS)
    # z at the upper and lower edges of the rows, shape (height + 1,).
    row_edges = torch.cos(math.pi * torch.arange(height + 1, dtype=torch.float64) / height)
    # Mean of z over the solid angle of each row.
    z = (row_edges[:-1] + row_edges[1:]) / 2
    azimuth = math.pi - 2 * math.pi * (torch.arange(width, dtype=torch.float64) + 0.5) / width
    radius = (1 - z**2).sqrt()[:, None]
    x = radius * azimuth.cos()
    y = radius * azimuth.sin()
    directions = torch.stack([x, y, z[:, None].expand(height, width)], dim=-1)
    solid_angles = (row_edges[:-1] - row_edges[1:]) * (2 * math.pi / width)
    return directions, solid_angles[:, None].expand(height, width)


def project(
    radiance: Callable[[Tensor], Tensor] | Float[Tensor, "height width channels"],
    degree: int,
    quadrature_degree: int = 128,
) -> Float64[Tensor, "coefficients channels"]:
    """Compute the SH coefficients of a light from its radiance.

    Args:
        radiance: Environment map in the layout of `equirectangular`,
            shape (height, width, channels). Or a function that takes float64
            unit directions, shape (N, 3), and returns the radiance from these
            directions, shape (N, channels). A function is integrated with
            `quadrature`.
        degree: Degree of the result, from 0 to `MAX_DEGREE`.
        quadrature_degree: Degree of the quadrature for a function. The result
            is exact if the function is a polynomial of at most the degree
            `quadrature_degree - degree`.

    Returns:
        SH coefficients, float64, shape ((degree + 1)², channels).

    Raises:
        InputError: If a degree is out of range, a map does not have three
            dimensions, or the radiance holds NaN or infinity.
    """
    require_degree(degree)
    if not callable(radiance):
        radiance = as_tensor("radiance", radiance)
        require_shape("radiance", radiance, "height", "width", "channels")
        require_finite(radiance=radiance)
        # A map may have 10⁸ texels, so the midpoint rule sums row by row to save memory.
        rows = zip(*equirectangular(*radiance.shape[:2]), radiance, strict=True)
        return sum(
            basis(directions, degree).T @ (weights[:, None] * texels.to(directions))
            for directions, weights, texels in rows
        )
    directions, weights = quadrature(quadrature_degree)
    values = as_tensor("radiance", radiance(directions)).to(torch.float64)
    require_finite(radiance=values)
    return basis(directions, degree).T @ (weights[:, None] * values)


def rotate(coefficients: Tensor, rotation: Float[Tensor, "3 3"]) -> Tensor:
    """Rotate a light about the origin.

    If u(ω) is the radiance of the light from the direction ω, the radiance of the
    rotated light is u(Rᵀ ω). The result is exact up to rounding, because the
    radiance is a polynomial.

    Args:
        coefficients: SH coefficients of the light,
            shape ((degree + 1)², channels).
        rotation: Orthonormal matrix R, shape (3, 3).

    Returns:
        SH coefficients of the rotated light, in the same shape and dtype.

    Raises:
        InputError: If an argument holds NaN, if no degree has this number of
            coefficients, or if the matrix is not orthonormal.
    """
    coefficients = as_tensor("coefficients", coefficients)
    rotation = as_tensor("rotation", rotation)
    require_finite(coefficients=coefficients, rotation=rotation)
    degree = _degree_of_rows("coefficients", coefficients)
    if rotation.shape != (3, 3) or not torch.allclose(
        rotation @ rotation.mT, torch.eye(3).to(rotation), rtol=0, atol=ORTHONORMALITY_TOLERANCE
    ):
        raise InputError("rotation is not orthonormal: give an orthonormal matrix of shape (3, 3)")

    def rotated_radiance(directions: Tensor) -> Tensor:
        """Compute the radiance of the rotated light from directions, shape (..., 3)."""
        # Each row is a direction ω. Multiplying the row by R from the right gives Rᵀ ω.
        return basis(directions @ rotation.to(directions), degree) @ coefficients.to(directions)

    return project(rotated_radiance, degree, quadrature_degree=2 * degree).to(coefficients)
