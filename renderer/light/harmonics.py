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
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import InputError, require_finite, require_range
from renderer.settings import MAX_DEGREE
from renderer.validation import as_tensor, require_whole
from renderer.vectors import unit

if TYPE_CHECKING:
    from jaxtyping import Float, Float64, Int

# `quadrature` of degree D has about D² / 2 directions.
MAX_QUADRATURE = 10**4
# The largest height and the largest width of an environment map, in texels.
MAX_TEXELS = 10**6
# `rotate` accepts a matrix R if no entry of R Rᵀ - I is larger. A matrix whose
# entries were rounded to four digits passes.
ORTHONORMAL = 1e-3
# Diffuse shading ignores the bands above this degree. They change the
# irradiance under a parallel beam by at most 0.015 of the beam's irradiance.
DIFFUSE_DEGREE = 20
Constant = TypeVar("Constant")
X_AXIS, Y_AXIS, Z_AXIS = range(3)


def per_degree(function: Callable[..., Constant]) -> Callable[..., Constant]:
    """Cache the results of a function of a degree and other hashable arguments.

    The function runs outside of torch's inference mode, because a tensor that
    is made in inference mode cannot be used in training later.
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
    degree = _degree_of_rows(light)
    if degree is None or light.shape[1] != 3:
        shape = tuple(light.shape)
        raise InputError(f"light has shape {shape}: give ((degree + 1)², 3) coefficients")
    return degree


def _degree_of_rows(coefficients: Tensor) -> int | None:
    """Return the degree of coefficients ((degree + 1)², channels), or None for another shape."""
    if coefficients.ndim != 2 or len(coefficients) == 0:
        return None
    degree = math.isqrt(len(coefficients)) - 1
    return degree if len(coefficients) == (degree + 1) ** 2 else None


def basis(
    directions: Float[Tensor, "*batch 3"], degree: int
) -> Float[Tensor, "*batch coefficients"]:
    """Evaluate the real spherical harmonics of all bands up to a degree.

    The values are computed in float64 and can be differentiated once by the
    directions. The Legendre recurrences are those of the paper's appendix B.1,
    except that the factor sin^m θ moves from P_l^m to Re and Im of (x + iy)^m.

    Args:
        directions: Finite vectors of any length, shape (..., 3). Only their
            direction counts. A zero vector has none: its values are finite and
            their gradient is zero.
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
    if not directions.ndim or directions.shape[-1] != 3:
        raise InputError(f"directions has shape {tuple(directions.shape)}: give (..., 3)")
    require_finite(directions=directions)
    components = unit(directions.double().movedim(-1, 0))
    rows = select_rows(components, range((degree + 1) ** 2))
    return torch.stack(rows, dim=-1).to(directions.dtype)


def require_degree(degree: int) -> None:
    """Check that a degree of lights is a whole number from 0 to `MAX_DEGREE`.

    Raises:
        InputError: If the degree is not.
    """
    require_whole("degree", degree)
    require_range("degree", degree, 0, MAX_DEGREE)


def select_rows(directions: Tensor, indices: Iterable[int]) -> list[Tensor]:
    """Evaluate single harmonics, without checks, for inner loops.

    Args:
        directions: Unit vectors, components first, shape (3, ...).
        indices: Indices l² + l + m of the harmonics.

    Returns:
        The values of each of the harmonics, shape (...), in the order of the
        indices without repetitions.
    """
    x, y, z = directions
    wanted = dict.fromkeys(indices)
    rows = {}
    degree = math.isqrt(max(wanted, default=0))
    # Re and Im of (x + iy)^m, times √2 if m > 0.
    cosine = torch.ones_like(z)
    sine = torch.zeros_like(z)
    for m in range(degree + 1):
        of_bands = zip(range(m, degree + 1), _legendre(z, m, degree), strict=True)
        for l, legendre in of_bands:
            middle = l * l + l
            if middle + m in wanted:
                rows[middle + m] = cosine * legendre
            if m and middle - m in wanted:
                rows[middle - m] = sine * legendre
        if m == degree:
            break
        if m == 0:
            cosine = cosine * math.sqrt(2)
        next_cosine = torch.addcmul(x * cosine, y, sine, value=-1)
        sine = torch.addcmul(x * sine, y, cosine)
        cosine = next_cosine
    return [rows[index] for index in wanted]


def _legendre(z: Tensor, m: int, degree: int) -> Iterator[Tensor | float]:
    """Yield the orthonormal associated Legendre functions P_l^m / sin^m θ for l = m to degree.

    They are polynomials in z. The first one is a constant, which is yielded as
    a number because that is faster than a tensor of equal entries.
    """
    ratios = [(2 * k + 1) / (2 * k) for k in range(1, m + 1)]
    constant = math.sqrt(math.prod(ratios) / (4 * math.pi))
    yield constant
    previous = z.new_tensor(constant)
    value = z * math.sqrt(2 * m + 3) * constant
    for l in range(m + 1, degree + 1):
        if l > m + 1:
            a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
            b = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            following = torch.addcmul(previous * (-a * b), z, value, value=a)
            previous = value
            value = following
        yield value


@per_degree
def gradient_matrices(degree: int) -> Tensor:
    """Compute the matrices that differentiate harmonics by x, y and z.

    Here r is the length of (x, y, z), and r^l Y_k is a polynomial for an index
    k in band l. Its derivative by the coordinate d is a sum over the indices j
    of band l - 1: ∂(r^l Y_k)/∂x_d = Σ_j M[d, j, k] r^(l-1) Y_j. These are the
    ladder operators of solid harmonics in real form.

    Args:
        degree: Highest band.

    Returns:
        The matrices M, shape (3, (degree + 1)², (degree + 1)²), float64.
    """
    size = (degree + 1) ** 2
    matrices = torch.zeros(3, size, size, dtype=torch.float64)
    for l in range(1, degree + 1):
        for m in range(l + 1):
            _set_gradients(matrices, l, m)
    return matrices


def _set_gradients(matrices: Tensor, l: int, m: int) -> None:
    """Set the columns of Y_lm and Y_l,-m, for m ≥ 0, of `gradient_matrices`."""
    norm = (2 * l + 1) / (2 * l - 1)
    down = math.sqrt(norm * (l + m) * (l + m - 1)) / 2 * (math.sqrt(2) if m == 1 else 1)
    up = math.sqrt(norm * (l - m) * (l - m - 1)) / 2 * (math.sqrt(2) if m == 0 else 1)
    # The row of m = 0 in band l - 1, and the columns of m and -m in band l.
    below = (l - 1) * l
    cosine = l * l + l + m
    sine = l * l + l - m
    if m < l:
        along_z = math.sqrt(norm * (l * l - m * m))
        matrices[Z_AXIS, below + m, cosine] = along_z
        matrices[Z_AXIS, below - m, sine] = along_z
    if m + 1 < l:
        matrices[X_AXIS, below + m + 1, cosine] = -up
        matrices[Y_AXIS, below - m - 1, cosine] = -up
    if m + 1 < l and m > 0:
        matrices[X_AXIS, below - m - 1, sine] = -up
        matrices[Y_AXIS, below + m + 1, sine] = up
    if m > 0:
        matrices[X_AXIS, below + m - 1, cosine] = down
        matrices[Y_AXIS, below + m - 1, sine] = down
    if m > 1:
        matrices[X_AXIS, below - m + 1, sine] = down
        matrices[Y_AXIS, below - m + 1, cosine] = -down


@per_degree
def homogeneous_gradients(degree: int) -> Tensor:
    """Compute the matrices that differentiate homogeneous polynomials of a degree.

    For an index k in a band of the degree's parity, r^degree Y_k is a
    homogeneous polynomial, and ∂(r^degree Y_k)/∂x_d = Σ_j M[d, j, k]
    r^(degree - 1) Y_j. By Euler's theorem, the product of this gradient with
    (x, y, z) is `degree` times the polynomial, so one sum over j gives both the
    value and the gradient.

    Args:
        degree: Degree of the polynomials.

    Returns:
        The matrices M, shape (3, (degree + 1)², (degree + 1)²), float64.
        Columns of bands of the other parity have no meaning.
    """
    # The product x_d Y_k of a harmonic in band l has a part in band l - 1,
    # ∂(r^l Y_k)/∂x_d / (2l + 1). By symmetry, its part in band l + 1 has the
    # transposed matrix.
    solid = gradient_matrices(degree)
    band_of_column = bands(degree)
    down = solid / (2 * band_of_column + 1)
    return solid + (degree - band_of_column) * (down + down.mT)


@per_degree
def monomial_coefficients(degree: int) -> Tensor:
    """Express harmonics by monomials x^a y^b z^c with a + b + c = degree.

    For an index k in a band of the degree's parity, r^degree Y_k = Σ_j M[j, k]
    monomial_j, in the order of `monomials`.

    Args:
        degree: Degree of the monomials.

    Returns:
        The matrix M, shape ((degree + 1)(degree + 2) / 2, (degree + 1)²),
        float64. Columns of bands of the other parity have no meaning.
    """
    if degree == 0:
        return torch.full((1, 1), 1 / math.sqrt(4 * math.pi), dtype=torch.float64)
    # The coefficient of x^a y^b z^c is that of x^(a-1) y^b z^c in the
    # polynomial's derivative by x, divided by a; likewise by y where a = 0, and
    # by z where a = b = 0.
    below = monomial_coefficients(degree - 1)
    along_x, along_y, along_z = below @ homogeneous_gradients(degree)[:, : below.shape[1]]
    powers = torch.tensor(
        [a or b or degree for a in range(degree, -1, -1) for b in range(degree - a, -1, -1)]
    )
    derivatives = torch.cat([along_x, along_y[-degree:], along_z[-1:]])
    return derivatives / powers[:, None]


def monomials(vectors: Tensor, degree: int) -> Tensor:
    """Evaluate all monomials x^a y^b z^c with a + b + c = degree.

    Args:
        vectors: Vectors, components first, shape (3, N).
        degree: Degree of the monomials.

    Returns:
        The values, shape ((degree + 1)(degree + 2) / 2, N), from x^degree to
        z^degree: first by decreasing power of x, then of y.
    """
    x, y, z = vectors
    products = torch.ones_like(vectors[:1])
    for power in range(1, degree + 1):
        lower = products
        count = len(lower)
        products = vectors.new_empty(count + power + 1, vectors.shape[1])
        torch.mul(lower, x, out=products[:count])
        without_x = lower[count - power :]
        torch.mul(without_x, y, out=products[count:-1])
        torch.mul(lower[-1], z, out=products[-1])
    return products


@per_degree
def bands(degree: int) -> Int[Tensor, " coefficients"]:
    """Return the band l of each coefficient, shape ((degree + 1)²,): 0, 1, 1, 1, 2 and so on."""
    return torch.arange(degree + 1).repeat_interleave(2 * torch.arange(degree + 1) + 1)


@per_degree
def lambertian_factors(degree: int) -> Float64[Tensor, " coefficients"]:
    """Return the factor A_l by which a diffuse surface keeps each coefficient of a light.

    A light with coefficients U_lm has the irradiance Σ A_l U_lm Y_lm(n) at the
    normal n. The factors A_0, A_1, ... = π, 2π/3, π/4, 0, -π/24, 0, π/64, ...
    are those of the clamped cosine (Ramamoorthi and Hanrahan 2001, equation 8).

    Args:
        degree: Highest band.

    Returns:
        Factors, shape ((degree + 1)²,), float64. Those of the bands above
        `DIFFUSE_DEGREE` are set to zero.
    """
    factors = [math.pi, 2 * math.pi / 3, *[0.0] * (degree - 1)]
    for l in range(2, min(degree, DIFFUSE_DEGREE) + 1, 2):
        sign = (-1) ** (l // 2 - 1)
        binomial = math.comb(l, l // 2) / 2.0**l
        factors[l] = 2 * math.pi * sign / ((l + 2) * (l - 1)) * binomial
    return torch.tensor(factors, dtype=torch.float64)[bands(degree)]


@per_degree
def nonzero_coefficients(degree: int) -> Int[Tensor, " K"]:
    """Return the indices of the coefficients that change the irradiance of a diffuse surface.

    Of the 49 coefficients of degree 6, these are 31.
    """
    return torch.nonzero(lambertian_factors(degree)).squeeze(1)


def irradiance_error(
    lights: Float[Tensor, "*batch K channels"], given: Float[Tensor, "*batch J channels"]
) -> Tensor:
    """Compute the relative error of the irradiance of approximate lights.

    The error is the rms difference of irradiance over all normals and channels,
    divided by the rms irradiance of the given lights.

    Args:
        lights: Coefficients of the approximate lights, shape
            (..., (degree + 1)², C).
        given: Coefficients of the lights that they approximate, with the same
            number of channels. The degree may be another one.

    Returns:
        Relative errors of shape (...), float64. The error is 0 if both lights
        are dark.
    """
    # Harmonics are orthonormal, so the mean square over all normals is in proportion
    # to the sum of the squared coefficients of the irradiance.
    size = max(lights.shape[-2], given.shape[-2])
    factors = lambertian_factors(math.isqrt(size) - 1)[:, None].to(given.device)
    approximate = _pad_bands(lights.double(), size) * factors
    exact = _pad_bands(given.double(), size) * factors
    error = _norm_over_coefficients(approximate - exact)
    norm = _norm_over_coefficients(exact)
    return torch.where(error > 0, error / norm, error)


def _pad_bands(lights: Tensor, size: int) -> Tensor:
    """Return lights (..., K, C) with zeros appended up to `size` coefficients."""
    return F.pad(lights, (0, 0, 0, size - lights.shape[-2]))


def _norm_over_coefficients(lights: Tensor) -> Tensor:
    """Return the L2 norms (...) of lights (..., K, C)."""
    return lights.square().sum((-2, -1)).sqrt()


def quadrature(degree: int) -> tuple[Float64[Tensor, "N 3"], Float64[Tensor, " N"]]:
    """Return a quadrature rule on the sphere that is exact for polynomials of a degree.

    The rule is Gauss-Legendre in z with equal steps in azimuth.

    Args:
        degree: Highest degree that is integrated exactly, from 0 to
            `MAX_QUADRATURE`.

    Returns:
        Unit directions, shape (N, 3), and weights that sum to 4π, shape (N,),
        both float64. N is (degree // 2 + 1)(degree + 1).

    Raises:
        InputError: If the degree is out of range.
    """
    require_whole("degree", degree)
    require_range("degree", degree, 0, MAX_QUADRATURE)
    z, weights_of_z = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuth = 2 * np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    radius = np.sqrt(1 - z**2)[:, None]
    x = radius * np.cos(azimuth)
    y = radius * np.sin(azimuth)
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)
    weights = np.repeat(weights_of_z * 2 * np.pi / len(azimuth), len(azimuth))
    return torch.from_numpy(directions.reshape(-1, 3)), torch.from_numpy(weights)


def equirectangular(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return the directions and solid angles of the texels of an environment map.

    Row 0 faces up (+z). The middle column faces +x, and azimuth grows to the
    left, as seen from inside the sphere.

    Args:
        height: Number of rows, from 1 to `MAX_TEXELS`.
        width: Number of columns, from 1 to `MAX_TEXELS`.

    Returns:
        Unit directions, shape (height, width, 3), and solid angles in
        steradians, shape (height, width), both float64.

    Raises:
        InputError: If the height or the width is out of range.
    """
    for name, count in (("height", height), ("width", width)):
        require_whole(name, count)
        require_range(name, count, 1, MAX_TEXELS)
    row_edges = torch.cos(math.pi * torch.arange(height + 1, dtype=torch.float64) / height)
    # This is the mean of z over the solid angle of a row.
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
    """Compute the SH coefficients of light that is given as radiance on the sphere.

    Args:
        radiance: An environment map in the layout of `equirectangular`, shape
            (height, width, channels). Or a function from unit directions
            (N, 3), float64, to radiance (N, channels), which is integrated by
            `quadrature`.
        degree: Degree of the result, from 0 to `MAX_DEGREE`.
        quadrature_degree: Degree of the quadrature for a function. The result
            is exact for polynomials of degree `quadrature_degree - degree`.

    Returns:
        Coefficients, shape ((degree + 1)², channels), float64.

    Raises:
        InputError: If a degree is out of range, a map does not have three
            dimensions, or the radiance holds NaN or infinity.
    """
    require_degree(degree)
    if not callable(radiance):
        return _project_map(as_tensor("radiance", radiance), degree)
    directions, weights = quadrature(quadrature_degree)
    values = as_tensor("radiance", radiance(directions)).to(torch.float64)
    require_finite(radiance=values)
    return basis(directions, degree).T @ (weights[:, None] * values)


def _project_map(radiance: Tensor, degree: int) -> Tensor:
    """Integrate an environment map, shape (height, width, channels), against the harmonics."""
    if radiance.ndim != 3:
        shape = tuple(radiance.shape)
        raise InputError(f"radiance has shape {shape}: give a map (height, width, channels)")
    require_finite(radiance=radiance)
    directions, solid_angles = equirectangular(*radiance.shape[:2])
    # A map may have 10⁸ texels, so the harmonics are evaluated row by row.
    rows = zip(directions, solid_angles, radiance, strict=True)
    return sum(
        basis(directions_of_row, degree).T @ (weights[:, None] * texels.to(directions_of_row))
        for directions_of_row, weights, texels in rows
    )


def rotate(coefficients: Tensor, rotation: Float[Tensor, "3 3"]) -> Tensor:
    """Rotate a light about the origin.

    The rotated light is u'(ω) = u(Rᵀω). The result is exact up to rounding,
    because the light is a polynomial.

    Args:
        coefficients: Coefficients of the light, shape ((degree + 1)², channels).
        rotation: Orthonormal matrix R, shape (3, 3).

    Returns:
        Coefficients of the rotated light, with the same shape and dtype.

    Raises:
        InputError: If an argument holds NaN, no degree has this number of
            coefficients, or the matrix is not orthonormal.
    """
    coefficients = as_tensor("coefficients", coefficients)
    rotation = as_tensor("rotation", rotation)
    require_finite(coefficients=coefficients, rotation=rotation)
    degree = _degree_of_rows(coefficients)
    if degree is None:
        shape = tuple(coefficients.shape)
        raise InputError(f"coefficients has shape {shape}: give ((degree + 1)², channels)")
    if not _is_orthonormal(rotation):
        raise InputError("rotation is no rotation: give an orthonormal matrix (3, 3)")

    def rotated_radiance(directions: Tensor) -> Tensor:
        turned_back = directions @ rotation.to(directions)
        return basis(turned_back, degree) @ coefficients.to(directions)

    return project(rotated_radiance, degree, quadrature_degree=2 * degree).to(coefficients)


def _is_orthonormal(matrix: Tensor) -> bool:
    """Return whether a matrix is (3, 3) and its product with its transpose is the identity."""
    if matrix.shape != (3, 3):
        return False
    identity = torch.eye(3).to(matrix)
    return torch.allclose(matrix @ matrix.mT, identity, rtol=0, atol=ORTHONORMAL)
