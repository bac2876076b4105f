"""Second implementation of the formulas of the renderer, for tests of its accuracy.

It is slow, with explicit sums, without torch, and with numbers wider than float64. Arrays hold long
doubles (`extended`: 64 bits of mantissa on x86) or 256-bit numbers of mpmath (`exact`), real or
complex. Derivatives are complex steps, Im f(x + ih) / h, which lose no digits (Squire and Trapp
1998). Vectors are columns: N vectors have the shape (3, N).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import comb, factorial, perm
from typing import Any

import mpmath
import numpy as np
from numpy import cross
from numpy.typing import ArrayLike

MP = mpmath.mp.clone()
MP.prec = 256
# Length of a complex step. Its square is too small to change any number here.
STEP = "1e-60"
# Unit vectors, each of shape (3, 1).
AXES = np.eye(3, dtype=int)[:, :, None]
# Digits that a long double needs at most.
LONG_DOUBLE_DIGITS = 25


def extended(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, dtype=np.longdouble)


exact = np.frompyfunc(MP.mpf, 1, 1)
_exact_sqrt = np.frompyfunc(MP.sqrt, 1, 1)
_exact_imaginary_part = np.frompyfunc(lambda number: number.imag, 1, 1)


def is_exact(values: np.ndarray) -> bool:
    return values.dtype == object


@dataclass(frozen=True)
class View:
    """S samples of the P covered pixels of an image, and the G faces that they show.

    Edges have the shape (3, G) and lead from the first corner of a face. `side` is 1 if it is
    seen counter-clockwise, or -1. `pixel` and `face` are the indices of each sample's pixel and
    face among the `pixels` and faces here. `pixels` are row-major indices in the image.
    """

    first: np.ndarray
    second: np.ndarray
    side: np.ndarray
    albedo: np.ndarray
    corners: np.ndarray
    pixel: np.ndarray
    face: np.ndarray
    pixels: np.ndarray
    samples: int


def view(ids, samples, placed, vertices, faces, albedo, towards, lift) -> View:
    """Create a view from the face at each sample (R, R); the camera sees `placed` vertices."""
    size = len(ids) // samples
    row, column = np.nonzero(ids >= 0)
    pixel_in_image = row // samples * size + column // samples
    # The samples of a pixel follow each other.
    order = np.argsort(pixel_in_image, kind="stable")
    pixels, pixel = np.unique(pixel_in_image[order], return_inverse=True)
    seen, face = np.unique(ids[row, column][order], return_inverse=True)

    corners = faces[seen]
    placed_normals = cross(*_edges(lift(placed), corners), axis=0)
    cosines = (placed_normals * lift(towards)[:, None]).sum(axis=0)
    first, second = _edges(lift(vertices), corners)
    side = np.where(cosines < 0, -1, 1)
    return View(first, second, side, albedo[seen], corners, pixel, face, pixels, samples**2)


def image(view: View, light: np.ndarray) -> np.ndarray:
    """Compute the radiance (P, 3) of the covered pixels under a light ((degree + 1)², 3)."""
    radiance = irradiance(normals_of(view), light) * view.albedo
    return added(len(view.pixels), view.pixel, radiance[view.face]) / view.samples


def light_gradient(view: View, upstream: np.ndarray, degree: int) -> np.ndarray:
    """Compute the gradient of Σ upstream × image by the light, with factors (P, 3)."""
    weight = _face_weight(view, upstream)
    gradient = np.zeros(((degree + 1) ** 2, 3), dtype=weight.dtype)
    for index, value in reflected(normals_of(view), degree).items():
        gradient[index] = (value[:, None] * weight).sum(axis=0)
    return gradient


def vertex_gradient(view, upstream, light, vertex_count) -> np.ndarray:
    """Compute the gradient (V, 3) of Σ upstream × image by the shaded vertices."""
    weight = _face_weight(view, upstream)
    by_first = []
    by_second = []
    for axis in AXES:
        edges = [(stepped(view.first, axis), view.second), (view.first, stepped(view.second, axis))]
        for slopes, moved in zip((by_first, by_second), edges, strict=True):
            slopes.append(derivative(_weighted_irradiance(view, weight, light, *moved)))
    # Shape (G, 3). The first corner moves both edges backward.
    second_corner = np.stack(by_first, axis=1)
    third_corner = np.stack(by_second, axis=1)
    first_corner = -second_corner - third_corner
    by_corner = np.stack([first_corner, second_corner, third_corner], axis=1)
    squared_area = (cross(view.first, view.second, axis=0) ** 2).sum(axis=0)
    by_corner = by_corner * (squared_area != 0)[:, None, None]
    return added(vertex_count, view.corners.ravel(), by_corner.reshape(-1, 3))


def _weighted_irradiance(view, weight, light, first, second) -> np.ndarray:
    normals = unit(cross(first, second, axis=0)) * view.side
    return (irradiance(normals, light) * weight).sum(axis=1)


def _face_weight(view: View, upstream: np.ndarray) -> np.ndarray:
    by_face = added(len(view.corners), view.face, upstream[view.pixel])
    return by_face / view.samples * view.albedo


def normals_of(view: View) -> np.ndarray:
    return unit(cross(view.first, view.second, axis=0)) * view.side


def _edges(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first, second, third = vertices[faces].transpose(1, 2, 0)
    return second - first, third - first


def irradiance(normals: np.ndarray, light: np.ndarray) -> np.ndarray:
    degree = round(len(light) ** 0.5) - 1
    terms = reflected(normals, degree)
    return sum(value[:, None] * light[index] for index, value in terms.items())


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Compute the harmonics (N, (degree + 1)²) of directions (3, N) of any length."""
    values = harmonics(unit(directions), range(degree + 1))
    return np.stack([values[index] for index in range(len(values))], axis=1)


def basis_gradient(directions: np.ndarray, degree: int) -> np.ndarray:
    """Compute the derivatives (N, (degree + 1)², 3) of `basis` by the directions."""
    # The step is relative to the length of a direction, which may be denormal.
    scale = abs(directions).max(axis=0)
    slopes = []
    for axis in AXES:
        moved = stepped(directions, axis * scale)
        slopes.append(derivative(basis(moved, degree)))
    divisor = np.where(scale == 0, 1, scale)
    return np.stack(slopes, axis=-1) / divisor[:, None, None]


def harmonics(directions: np.ndarray, bands: Sequence[int]) -> dict[int, np.ndarray]:
    """Compute √(…) dᵐP_l/dzᵐ times Re or Im of (x + iy)ᵐ for unit vectors (3, N), by l² + l + m."""
    x, y, z = directions
    one = 1 + 0 * z
    powers_of_z = [one]
    # Re and Im of (x + iy)ᵐ.
    cosines = [one]
    sines = [0 * z]
    for _ in range(max(bands)):
        powers_of_z.append(powers_of_z[-1] * z)
        cosine = x * cosines[-1] - y * sines[-1]
        sine = x * sines[-1] + y * cosines[-1]
        cosines.append(cosine)
        sines.append(sine)
    values = {}
    for l in bands:
        center = l * l + l
        for m in range(l + 1):
            terms = _normalized_legendre(l, m)
            legendre = sum(as_in(directions, factor) * powers_of_z[n] for n, factor in terms)
            # If m is 0, the second line replaces the value of the first.
            values[center - m] = legendre * sines[m]
            values[center + m] = legendre * cosines[m]
    return values


def reflected(normals: np.ndarray, degree: int) -> dict[int, np.ndarray]:
    """Compute A_l Y_lm(n) by the index l² + l + m, for the bands whose factor A_l is not zero."""
    live_bands = [l for l in range(degree + 1) if lambertian(l)]
    values = {}
    for index, value in harmonics(normals, live_bands).items():
        l = int(index**0.5)
        factor = 2 * MP.pi * _number(lambertian(l))
        values[index] = value * as_in(normals, factor)
    return values


@cache
def lambertian(l: int) -> Fraction:
    """Compute A_l / 2π = ∫₀¹ P_l(z) z dz, the part of a band that the clamped cosine keeps."""
    terms = _legendre(l, 0)
    return sum((factor / (power + 2) for power, factor in terms), Fraction())


@cache
def _normalized_legendre(l: int, m: int) -> list[tuple[int, Any]]:
    """Return the powers of z and 256-bit factors of dᵐP_l/dzᵐ, normalized for a harmonic."""
    sides = 2 if m else 1
    quotient = MP.mpf(factorial(l - m)) / factorial(l + m)
    norm = MP.sqrt((2 * l + 1) * sides * quotient / (4 * MP.pi))
    return [(power, norm * _number(factor)) for power, factor in _legendre(l, m)]


def _legendre(l: int, m: int) -> list[tuple[int, Fraction]]:
    """Return powers and factors of dᵐP_l/dzᵐ. 2ˡ P_l = Σ (-1)ᵏ C(l, k) C(2l - 2k, l) z^(l - 2k)."""
    terms = []
    for k in range(l // 2 + 1):
        power = l - 2 * k
        if power < m:
            continue
        factor = (-1) ** k * comb(l, k) * comb(2 * l - 2 * k, l)
        terms.append((power - m, Fraction(factor * perm(power, m), 2**l)))
    return terms


def shadow(view, points, corners, directions, degree) -> np.ndarray:
    """Compute the radiance (P, (degree + 1)², 3) that shadows take from each pixel.

    The rays and their origins (S, 3) are those of the renderer. Which rays are blocked,
    and all sums, are computed here. The directions (D, 3) share the sphere equally.
    """
    sky = basis(directions.T, degree)
    normals = normals_of(view).T[view.face]
    solid_angle = as_in(points, 4 * MP.pi) / len(directions)
    lost = []
    for point, normal in zip(points, normals, strict=True):
        cosine = (directions @ normal).clip(0)
        blocked_cosine = cosine * is_blocked(point, directions, corners)
        lost.append(blocked_cosine @ sky * solid_angle)
    albedo = view.albedo[view.face]
    by_sample = np.stack(lost)[:, :, None] * albedo[:, None]
    return added(len(view.pixels), view.pixel, by_sample) / view.samples


def is_blocked(point: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Find which rays (D, 3) from a point meet a face: they pass all edges on the face's side."""
    a = corners[:, 0] - point
    b = corners[:, 1] - point
    c = corners[:, 2] - point
    # Shape (3 edges, D, F).
    passed = np.stack([directions @ np.cross(*edge).T for edge in ((a, b), (b, c), (c, a))])
    volume = (a * np.cross(b, c)).sum(axis=1)
    is_met = (passed * np.sign(volume) > 0).all(axis=0)
    return is_met.any(axis=1)


def stepped(values: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Move values by an imaginary step, so that `derivative` finds the slope along the step."""
    if is_exact(values):
        return values + along * MP.mpc(0, STEP)
    return values + along * (np.clongdouble(1j) * np.longdouble(STEP))


def derivative(values: np.ndarray) -> np.ndarray:
    """Return the derivatives of real functions from their values after an imaginary step."""
    if is_exact(values):
        return _exact_imaginary_part(values) / MP.mpf(STEP)
    return values.imag / np.longdouble(STEP)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (3, N) to unit length. Zero vectors stay zero."""
    square = (vectors * vectors).sum(axis=0)
    length = _exact_sqrt(square) if is_exact(vectors) else np.sqrt(square)
    return vectors / np.where(length == 0, 1, length)


def added(count: int, index: np.ndarray, rows: np.ndarray) -> np.ndarray:
    total = np.zeros((count, *rows.shape[1:]), dtype=rows.dtype)
    np.add.at(total, index, rows)
    return total


def as_in(like: np.ndarray, number: Any) -> Any:
    """Convert a 256-bit number to the type of an array's entries."""
    if is_exact(like):
        return number
    return np.longdouble(MP.nstr(number, LONG_DOUBLE_DIGITS))


def _number(fraction: Fraction) -> Any:
    return MP.mpf(fraction.numerator) / fraction.denominator
