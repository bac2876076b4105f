"""A second implementation of the renderer's formulas: slow, explicit sums, no torch, numbers wider than float64.

Arrays hold long doubles (`extended`: 64 bits of mantissa on x86) or mpmath's 256-bit numbers (`exact`), real or
complex; every function takes either. Derivatives are complex steps, Im f(x + ih) / h, which lose no digits (Squire and
Trapp 1998).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import comb, factorial, perm
from typing import Any

import mpmath
import numpy as np
from numpy.typing import ArrayLike

MP = mpmath.mp.clone()
MP.prec = 256
STEP = "1e-60"  # its square is lost beside any number here
AXES = np.eye(3, dtype=int)[:, :, None]


def extended(values: ArrayLike) -> np.ndarray:
    """As long doubles."""
    return np.asarray(values, dtype=np.longdouble)


exact = np.frompyfunc(MP.mpf, 1, 1)  # as 256-bit numbers, in an array of objects
_sqrt, _imag = np.frompyfunc(MP.sqrt, 1, 1), np.frompyfunc(lambda number: number.imag, 1, 1)


@dataclass(frozen=True)
class View:
    """S samples of P pixels that see G faces: the edges (3, G) from a face's first corner to the others, the side ±1
    (G,) that is seen, the albedo (G, 3), and where each sample is. Edges are `extended` or `exact`."""

    first: np.ndarray
    second: np.ndarray
    side: np.ndarray
    albedo: np.ndarray
    corners: np.ndarray  # (G, 3) vertices
    pixel: np.ndarray  # (S,) indices into the covered pixels
    face: np.ndarray  # (S,) indices into the faces seen
    pixels: np.ndarray  # (P,) row-major
    samples: int  # per pixel


def view(
    ids: np.ndarray,
    samples: int,
    placed: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    albedo: np.ndarray,
    towards: np.ndarray,
    lift: Callable[[np.ndarray], np.ndarray],
) -> View:
    """Read a view off the ids (R, R) of an image with samples² samples per pixel.

    placed: vertices (V, 3) as the camera sees them. vertices: as they are shaded. towards: (3,) the camera's direction.
    """
    row, column = np.nonzero(ids >= 0)
    place = row // samples * (len(ids) // samples) + column // samples
    order = np.argsort(place, kind="stable")  # the samples of a pixel together
    seen, face = np.unique(ids[row, column][order], return_inverse=True)
    pixels, pixel = np.unique(place[order], return_inverse=True)
    corners = faces[seen]
    facing = (cross(*_edges(lift(placed), corners)) * lift(towards)[:, None]).sum(axis=0)
    side = np.where(facing < 0, -1, 1)
    return View(
        *_edges(lift(vertices), corners),
        side,
        albedo[seen],
        corners,
        pixel,
        face,
        pixels,
        samples**2,
    )


def image(view: View, light: np.ndarray) -> np.ndarray:
    """(P, 3) radiance under a light ((degree + 1)², 3)."""
    radiance = irradiance(normals_of(view), light) * view.albedo
    return added(len(view.pixels), view.pixel, radiance[view.face]) / view.samples


def light_gradient(view: View, upstream: np.ndarray, degree: int) -> np.ndarray:
    """((degree + 1)², 3) of Σ upstream (P, 3) × image."""
    weight = _face_weight(view, upstream)
    gradient = np.zeros(((degree + 1) ** 2, 3), dtype=weight.dtype)
    for index, value in reflected(normals_of(view), degree).items():
        gradient[index] = (value[:, None] * weight).sum(axis=0)
    return gradient


def vertex_gradient(
    view: View, upstream: np.ndarray, light: np.ndarray, vertices: int
) -> np.ndarray:
    """(V, 3) of Σ upstream (P, 3) × image. Zero for a face without area."""
    weight = _face_weight(view, upstream)

    def loss(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return (irradiance(unit(cross(first, second)) * view.side, light) * weight).sum(axis=1)

    area = (cross(view.first, view.second) ** 2).sum(axis=0)
    by_first = np.stack(
        [derivative(loss(stepped(view.first, axis), view.second)) for axis in AXES], axis=1
    )
    by_second = np.stack(
        [derivative(loss(view.first, stepped(view.second, axis))) for axis in AXES], axis=1
    )
    by_corner = (
        np.stack([-by_first - by_second, by_first, by_second], axis=1) * (area != 0)[:, None, None]
    )
    return added(vertices, view.corners.ravel(), by_corner.reshape(-1, 3))


def irradiance(normals: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(N, 3) on surfaces with unit normals (3, N)."""
    degree = round(len(light) ** 0.5) - 1
    return sum(value[:, None] * light[index] for index, value in reflected(normals, degree).items())


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """(N, (degree + 1)²) harmonics of directions (3, N) of any length."""
    values = harmonics(unit(directions), range(degree + 1))
    return np.stack([values[index] for index in range(len(values))], axis=1)


def basis_gradient(directions: np.ndarray, degree: int) -> np.ndarray:
    """(N, (degree + 1)², 3) derivatives of `basis`."""
    scale = abs(directions).max(
        axis=0
    )  # the step is relative to the length, which may be a denormal's
    slopes = [derivative(basis(stepped(directions, axis * scale), degree)) for axis in AXES]
    return np.stack(slopes, axis=-1) / np.where(scale == 0, 1, scale)[:, None, None]


def harmonics(directions: np.ndarray, bands: Sequence[int]) -> dict[int, np.ndarray]:
    """{l² + l + m: (N,)} at unit vectors (3, N): √(…) dᵐP_l/dzᵐ × Re or Im of (x + iy)ᵐ, no Condon-Shortley sign."""
    x, y, z = directions
    powers, cosine, sine = [1 + 0 * z], [1 + 0 * z], [0 * z]
    for _ in range(max(bands)):
        powers.append(powers[-1] * z)
        cosine, sine = (
            [*cosine, x * cosine[-1] - y * sine[-1]],
            [*sine, x * sine[-1] + y * cosine[-1]],
        )
    values = {}
    for l in bands:
        for m in range(l + 1):
            legendre = sum(
                as_in(directions, factor) * powers[power] for power, factor in _legendre(l, m)
            )
            values[l * l + l - m], values[l * l + l + m] = legendre * sine[m], legendre * cosine[m]
    return values


def lambertian(l: int) -> Fraction:
    """What the clamped cosine keeps of band l, over 2π: ∫₀¹ P_l(z) z dz."""
    return sum(
        (factor / (power + 2) for power, factor in _derivative_of_legendre(l, 0)), Fraction()
    )


def stepped(values: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Moved by an imaginary step: a function's value there has its `derivative` along the step."""
    return values + along * (
        MP.mpc(0, STEP) if values.dtype == object else np.clongdouble(1j) * np.longdouble(STEP)
    )


def derivative(values: np.ndarray) -> np.ndarray:
    return (
        _imag(values) / MP.mpf(STEP)
        if values.dtype == object
        else values.imag / np.longdouble(STEP)
    )


def reflected(normals: np.ndarray, degree: int) -> dict[int, np.ndarray]:
    """{l² + l + m: A_l Y_lm(n)}, without the bands whose A_l is zero."""
    live = [l for l in range(degree + 1) if lambertian(l)]
    factors = {l: as_in(normals, 2 * MP.pi * _number(lambertian(l))) for l in live}
    return {
        index: value * factors[int(index**0.5)] for index, value in harmonics(normals, live).items()
    }


def _face_weight(view: View, upstream: np.ndarray) -> np.ndarray:
    """(G, 3) what Σ upstream × image gives for each unit of a face's irradiance."""
    return added(len(view.corners), view.face, upstream[view.pixel]) / view.samples * view.albedo


def normals_of(view: View) -> np.ndarray:
    """(3, G) unit normals, on the side that is seen."""
    return unit(cross(view.first, view.second)) * view.side


def _edges(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first, second, third = vertices[faces].transpose(1, 2, 0)
    return second - first, third - first


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.stack(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


def unit(vectors: np.ndarray) -> np.ndarray:
    """(3, N), zero where they are."""
    square = (vectors * vectors).sum(axis=0)
    length = _sqrt(square) if vectors.dtype == object else np.sqrt(square)
    return vectors / np.where(length == 0, 1, length)


def added(count: int, index: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(count, ...) sums of rows by index."""
    total = np.zeros((count, *rows.shape[1:]), dtype=rows.dtype)
    np.add.at(total, index, rows)
    return total


@cache
def _legendre(l: int, m: int) -> list[tuple[int, Any]]:
    """Normalized dᵐP_l/dzᵐ as (power, 256-bit factor)."""
    norm = MP.sqrt(
        (2 * l + 1) * (2 if m else 1) * MP.mpf(factorial(l - m)) / factorial(l + m) / (4 * MP.pi)
    )
    return [(power, norm * _number(factor)) for power, factor in _derivative_of_legendre(l, m)]


def _derivative_of_legendre(l: int, m: int) -> list[tuple[int, Fraction]]:
    """dᵐP_l/dzᵐ as (power, factor), from 2ˡ P_l = Σ (-1)ᵏ C(l, k) C(2l - 2k, l) z^(l - 2k)."""
    terms = [
        (l - 2 * k, (-1) ** k * comb(l, k) * comb(2 * l - 2 * k, l)) for k in range(l // 2 + 1)
    ]
    return [
        (power - m, Fraction(factor * perm(power, m), 2**l))
        for power, factor in terms
        if power >= m
    ]


def _number(fraction: Fraction) -> Any:
    return MP.mpf(fraction.numerator) / fraction.denominator


def as_in(like: np.ndarray, number: Any) -> Any:
    """A 256-bit number as the entries of an array are."""
    return number if like.dtype == object else np.longdouble(MP.nstr(number, 25))


# ---------------------------------------------------------------------------- shadows


def shadow(
    view: View, points: np.ndarray, corners: np.ndarray, directions: np.ndarray, degree: int
) -> np.ndarray:
    """(P, (degree + 1)², 3) radiance that shadows take from each pixel, per unit of each coefficient.

    Faces of corners (F, 3 corners, 3) block rays from the samples' origins (S, 3) in directions (D, 3), which share the
    sphere equally. Rays and origins are the renderer's; which are blocked and all sums are computed here.
    """
    sky, normals = basis(directions.T, degree), normals_of(view).T[view.face]
    solid_angle = as_in(points, 4 * MP.pi) / len(directions)
    lost = []
    for point, normal in zip(points, normals, strict=True):
        cosine = (directions @ normal).clip(0) * blocked(point, directions, corners)
        lost.append(cosine @ sky * solid_angle)
    by_sample = np.stack(lost)[:, :, None] * view.albedo[view.face][:, None]
    return added(len(view.pixels), view.pixel, by_sample) / view.samples


def blocked(point: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(D,) whether rays from a point (3,) meet a face: they pass all of its edges on the side that it lies on."""
    a, b, c = (corners[:, corner] - point for corner in range(3))
    passed = np.stack(
        [directions @ np.cross(first, second).T for first, second in ((a, b), (b, c), (c, a))]
    )
    volume = (a * np.cross(b, c)).sum(axis=1)
    return (passed * np.sign(volume) > 0).all(axis=0).any(axis=1)
