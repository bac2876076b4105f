"""Light that something could emit, in place of light that is negative somewhere.

Both functions solve quadratic programs with a constraint for every direction ω: Y(ω) · x ≥ 0.

`project_nonnegative` makes a given light physical. It keeps the mean, x₀ = v₀, and minimizes the error of irradiance,
Σ A_l² (x − v)². In bands that do not reach a diffuse surface, half of the smallest factor stands for A_l
(`window.irradiance_weights`), so that the nearest of lights of the same irradiance is taken. Convolving the light of a
map with a non-negative kernel also gives a light that satisfies the constraints, so that no such window has a smaller
error. (Without a fixed mean, nearest coefficients raise the whole sky to fill the dips beside a bright source.) The
program is solved at a grid's directions and in the dips that are found; dips that are left after a few solutions are
filled with the windowed light.

`nearest_nonnegative` returns an attack's step into the possible lights. Of coefficients v (K,), it solves

    min |x − v|² / 2,

optionally with low ≤ x ≤ high (a ball in the maximum norm). With the harmonics of finitely many directions as rows of
R, and multipliers μ ≥ 0, its Karush-Kuhn-Tucker conditions are

    x = v + Rᵀ μ,    R x ≥ 0,    μ · R x = 0,

which is least distance programming, solved exactly by non-negative least squares (Lawson and Hanson 1974, chapter 23).
A ball |x − c| ≤ r adds λ (x − c) on the left, λ ≥ 0 and λ (|x − c| − r) = 0: then x is the projection, without the
ball, of c + (v − c) / (1 + λ). As long as the active rows stay the same, x is affine in t = 1 / (1 + λ), so Newton
steps on t find |x − c| = r.

The exchange method (Hettich and Kortanek 1993, "Semi-infinite programming", section 7) begins without directions and
adds those in which the solution is negative, the bottoms of its dips, until it has none. Dips are found on a grid and
refined by Newton's method on the sphere.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.optimize import nnls
from torch import Tensor

from renderer.light.ball import Ball
from renderer.light.harmonics import bands, gradient_matrices, monomial_coefficients, per_degree
from renderer.light.program import shortest
from renderer.light.window import irradiance_weights, nonnegative_window
from renderer.vectors import tangent_axes

Array = NDArray[Any]

TOLERANCE = 1e-4  # of a light's largest radiance, that it may dip below zero
_DEPTH = TOLERANCE / 10  # of dips that are looked for: in a flat valley, a deeper one may lie between two found ones
_DIM = 1e-6  # of a light's norm: below it, a dip is the rounding of the input
_ROUNDS = 50  # seven are usual
_SOLUTIONS = 4  # of the program that keeps the mean
_ON_SPHERE = 1e-7  # of the radius
_STEPS = 10  # Newton steps on t; two are usual
_TINY = 1e-300
_SUBDIVISIONS = 4, 5  # of the grid: nodes are 0.07 radians apart, or half of that above degree _COARSE
_COARSE = 10
_CANDIDATES = 0.04, 1e-3  # of the largest radiance, above zero and above the neighbors: nodes that may be near a dip
_LOWEST = 0.04, 0.0  # the same with fewer nodes, which is enough where many dips are left at once
_LARGEST_STEP = 0.1  # in radians
_NEWTON_STEPS = 2  # down to the bottom of a dip


def project_nonnegative(lights: Tensor) -> Tensor:
    """The lights of nowhere negative radiance and of the same mean whose irradiance is the most alike.

    Args:
        lights: (..., (degree + 1)², C) coefficients, of which each channel is a light of its own.

    Returns:
        Coefficients of the same shape and type, computed in float64, without a graph. The radiance of each channel is
        nowhere below -`TOLERANCE` of its largest. The first coefficient is the given one, and zero where that is
        negative. Channels whose radiance is nowhere negative stay to the bit.
    """
    channels, of_light = np.unique(_by_channel(lights)[:, 0], axis=0, return_inverse=True)
    negative, _ = _dips(channels, _dim(channels), _DEPTH, _LOWEST)
    physical = lights.detach().mT.flatten(0, -2).clone()
    for channel in np.unique(negative):
        of_mean = torch.from_numpy(_with_mean_kept(channels[channel])).to(physical)
        physical[torch.from_numpy(of_light.reshape(-1) == channel)] = of_mean
    return physical.view(lights.mT.shape).mT


def _with_mean_kept(light: Array) -> Array:
    """The light (K,) of nowhere negative radiance whose mean is the same and whose irradiance is the most alike."""
    mean, dim = light[0], _dim(light[None])
    of_mean = np.concatenate([[max(mean, 0.0)], 0 * light[1:]])
    if mean <= dim:
        return of_mean
    degree = math.isqrt(len(light)) - 1
    weights, window = (of_degree(degree).numpy() for of_degree in (irradiance_weights, nonnegative_window))
    _, harmonics, _ = _grid(degree, _SUBDIVISIONS[0])
    rows, nearest = harmonics.T, light
    for number in range(_ROUNDS):
        _, bottoms = _dips(nearest[None], dim, _DEPTH, _LOWEST)
        if not len(bottoms):
            break
        if number < _SOLUTIONS:
            rows = np.concatenate([rows, bottoms])
            change = shortest(rows[:, 1:] / weights[1:], -rows @ light)
            nearest = np.concatenate([[mean], light[1:] + change / weights[1:]])
        else:
            windowed = _raised(_raised(window * light, of_mean, rows), of_mean, bottoms)
            nearest = _raised(nearest, windowed, bottoms)
    return nearest


def _raised(light: Array, bright: Array, rows: Array) -> Array:
    """The light (K,) that is mixed with as much of a brighter one as makes it not negative where rows (R, K) are."""
    radiance, added = rows @ light, rows @ (bright - light)
    negative = radiance < 0
    return light + (bright - light) * (-radiance[negative] / added[negative]).max(initial=0)


def nearest_nonnegative(lights: Tensor, within: Ball | None = None) -> Tensor:
    """The lights of nowhere negative radiance that are nearest in coefficients.

    Their mean is not kept: it may exceed that of `lights`, and often does where these have deep dips.

    Args:
        lights: (..., (degree + 1)², C) coefficients, of which each channel is a light of its own.
        within: for lights (A, (degree + 1)², C), a ball to lie in, whose centers are lights of nowhere negative
            radiance. One of norm "l2" holds a light's channels together.

    Returns:
        Coefficients of the same shape and type, computed in float64, without a graph. The radiance of each channel is
        nowhere below -`TOLERANCE` of its largest; channels that were in order stay to the bit.
    """
    programs = dipping = _programs(lights, within)
    for _ in range(_ROUNDS):
        nearest = np.concatenate([program.nearest for program in dipping])
        original = np.concatenate([program.original for program in dipping])
        owner, rows = _dips(nearest, _dim(original), _DEPTH)
        channels = len(nearest) // len(dipping)
        indices = np.unique(owner // channels)
        for index in indices:
            channel = range(index * channels, (index + 1) * channels)
            dipping[index].add([rows[owner == light] for light in channel])
        dipping = [dipping[index] for index in indices]
        if not dipping:
            break
    nearest = np.concatenate([program.nearest for program in programs])
    return torch.from_numpy(nearest).view(lights.mT.shape).to(lights).mT


def _programs(lights: Tensor, within: Ball | None) -> "list[_Program]":
    """One of each light, if a sphere holds its channels together, and else one of each channel."""
    original = _by_channel(lights)
    if within is None:
        return [_Program(light) for light in original]
    if within.norm == "linf":
        return [_Program(*light) for light in zip(original, *map(_by_channel, within.ends), strict=True)]
    shape = len(lights), lights.shape[2], lights.shape[1]
    of_lights = zip(original.reshape(shape), _by_channel(within.center).reshape(shape), strict=True)
    return [_Program(light, center=center, radius=within.radius) for light, center in of_lights]


def _dim(channels: Array) -> Array:
    """(R,) the largest radiance of channels (R, K) that counts as none."""
    return _DIM * np.linalg.norm(channels, axis=1)


def _by_channel(lights: Tensor) -> Array:
    """(channels, 1, K) of lights (..., K, C)."""
    return lights.detach().mT.flatten(0, -2)[:, None].cpu().double().numpy()


class _Program:
    """The lights (C, K) nearest to the original ones that are non-negative in the active directions, between bounds or
    together within an L2 distance of a center, of t = 1 / (1 + λ)."""

    def __init__(
        self,
        original: Array,
        low: Array | float = -np.inf,
        high: Array | float = np.inf,
        center: Array | float = 0.0,
        radius: float = np.inf,
    ):
        self.original, self._center, self._radius, self._offset = original, center, radius, original - center
        self._low, self._high = np.broadcast_to(low, original.shape), np.broadcast_to(high, original.shape)
        self._least = self._t = min(radius / max(float(np.linalg.norm(self._offset)), _TINY), 1.0)
        self.nearest = self._target().clip(low, high)
        self._active = [original[:0]] * len(original)  # R (M, K) of each light

    def _target(self) -> Array:
        return self.original if self._t == 1 else self._center + self._t * self._offset

    def add(self, rows: Sequence[Array]) -> None:
        """Solve it with further rows (M, K) of each light; rows whose multiplier is zero are dropped."""
        rows = [np.concatenate(pair) for pair in zip(self._active, rows, strict=True)]
        for _ in range(_STEPS):
            target = self._target()
            solved = map(_least_distance, target, rows, self._low, self._high)
            nearest, self._active = map(list, zip(*solved, strict=True))
            displacement = np.stack(nearest) - self._center
            distance = float(np.linalg.norm(displacement))
            left = self._radius - distance
            if abs(left) <= _ON_SPHERE * self._radius or (self._t == 1 and left > 0):
                break
            added = np.stack(nearest) - target
            motions, multipliers, changes = zip(*map(_motion, self._offset, added, self._active), strict=True)
            along = np.stack(motions)
            speed, slope = float((along * along).sum()), float((along * displacement).sum())
            root = math.sqrt(max(slope**2 + speed * left * (self._radius + distance), 0))
            step = min(max((root - slope) / max(speed, _TINY), self._least - self._t), 1 - self._t)
            self._t += step
            if np.all(np.concatenate(multipliers) + step * np.concatenate(changes) >= 0):  # the same rows stay active
                displacement = displacement + step * along
                break
        scale = min(1, self._radius / max(float(np.linalg.norm(displacement)), _TINY))
        self.nearest = self._center + displacement * scale


def _motion(offset: Array, added: Array, rows: Array) -> tuple[Array, Array, Array]:
    """(derivative of x by t (K,), multipliers (M,), their derivative by t) while the rows (M, K) stay active.
    offset: v − c. added: Rᵀ μ, of which the multipliers are found."""
    change, multipliers = np.linalg.lstsq(rows.T, np.stack([-offset, added], axis=1))[0].T
    return offset + rows.T @ change, multipliers, change


def _least_distance(original: Array, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """The x (K,) nearest to `original` with rows · x ≥ 0 and low ≤ x ≤ high, and the rows of positive multipliers.

    With G x ≥ h for all constraints together: nnls minimizes |E u − f| for E = [Gᵀ; hᵀ], f = (0, ..., 0, 1) and u ≥ 0,
    and its residual r gives x = −r_j / r_(K+1) (Lawson and Hanson's algorithm LDP), relative to `original`.
    """
    if not len(rows):
        return original, rows
    size, unit, bounded = len(original), np.linalg.norm(original), np.isfinite(low)
    axes = np.eye(size)[bounded]
    sides = np.concatenate([rows, axes, -axes])
    bounds = np.concatenate([-rows @ original, (low - original)[bounded], (original - high)[bounded]])
    dual = np.concatenate([sides.T, bounds[None] / unit])
    multipliers, _ = nnls(dual, np.eye(size + 1)[size])
    residual = dual @ multipliers
    residual[size] -= 1
    if residual[size] > -(_DEPTH**2):  # the bounds leave no room beyond rounding
        return original.clip(low, high), rows
    nearest = original - residual[:size] / residual[size] * unit
    return nearest.clip(low, high), rows[multipliers[: len(rows)] > 0]


def _dips(
    lights: Array, dim: Array, depth: float, candidates: tuple[float, float] = _CANDIDATES
) -> tuple[Array, Array]:
    """(the light (D,), of (R, K), and the harmonics (D, K) in the direction of the bottom) of each of D dips.
    depth: the least depth of a dip, of the light's largest radiance. dim: (R,) largest radiance that counts as none.
    candidates: how far above zero, and above its neighbors, a node of the grid is that may be near a dip."""
    degree = math.isqrt(lights.shape[1]) - 1
    directions, harmonics, neighbors = _grid(degree, _SUBDIVISIONS[degree > _COARSE])
    radiance = lights @ harmonics
    largest = np.abs(radiance).max(1)
    near_zero, near_lowest = (factor * largest for factor in candidates)
    owner, node = np.nonzero(radiance < np.where(largest > dim, near_zero, -np.inf)[:, None])
    for neighbor in neighbors:
        lower = radiance[owner, node] <= radiance[owner, neighbor[node]] + near_lowest[owner]
        owner, node = owner[lower], node[lower]
    expansion = (lights @ _derivatives(degree)).reshape(len(lights), 3 + 9, -1)[owner]
    bottom = directions[node]
    for _ in range(_NEWTON_STEPS):
        bottom = _lower(bottom, expansion)
    rows = _harmonics(bottom, degree)
    deep = (rows * lights[owner]).sum(1) < -depth * largest[owner]
    return owner[deep], rows[deep]


def _lower(directions: Array, expansion: Array) -> Array:
    """A Newton step down from directions (D, 3) along the principal axes of the radiance's curvature on the sphere.
    expansion: (D, 3 + 9, K), coefficients of each light's first and second derivatives."""
    derivatives = expansion @ _harmonics(directions, math.isqrt(expansion.shape[2]) - 1)[..., None]
    gradient, hessian = derivatives[:, :3], derivatives[:, 3:].reshape(-1, 3, 3)
    x, y, z = directions.T
    tangents = np.array(tangent_axes(x, y, z, np.copysign(1, z))).transpose(2, 0, 1)
    radial = directions[:, None] @ gradient
    curvature, turn = np.linalg.eigh(tangents @ hessian @ tangents.mT - radial * np.eye(2))
    axes = turn.mT @ tangents
    slope = (axes @ gradient)[..., 0]
    steepness = np.maximum(np.abs(curvature), np.linalg.norm(slope, axis=1, keepdims=True) / _LARGEST_STEP)
    moved = directions - ((slope / np.maximum(steepness, 1e-300))[:, None] @ axes)[:, 0]
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _harmonics(directions: Array, degree: int) -> Array:
    """(D, K): on the sphere, polynomials homogeneous of the degree and of the one below; `select_rows` of a few."""
    powers, coefficients = _polynomials(degree)
    rising = np.ones((degree + 1, *directions.T.shape))
    for power in range(degree):
        rising[power + 1] = rising[power] * directions.T
    x, y, z = rising.transpose(1, 0, 2)
    return (x[powers[0]] * y[powers[1]] * z[powers[2]]).T @ coefficients


@per_degree
def _polynomials(degree: int) -> tuple[Array, Array]:
    """(powers (3, J) of x, y and z in each monomial, the harmonics' coefficients (J, K))."""
    totals = range(degree, max(degree - 2, -1), -1)
    powers = [(a, b, total - a - b) for total in totals for a in range(total, -1, -1) for b in range(total - a, -1, -1)]
    homogeneous = [monomial_coefficients(total) * ((bands(total) - total) % 2 == 0) for total in totals]
    coefficients = [F.pad(part, (0, (degree + 1) ** 2 - part.shape[1])) for part in homogeneous]
    return np.array(powers).T, torch.cat(coefficients).numpy()


@per_degree
def _derivatives(degree: int) -> Array:
    """(K, (3 + 9) K): maps a light's coefficients to those of its first and second derivatives by x, y and z."""
    first = gradient_matrices(degree)
    second = (first[:, None] @ first).flatten(0, 1)
    return torch.cat([first, second]).flatten(0, 1).T.contiguous().numpy()


@per_degree
def _grid(degree: int, subdivisions: int) -> tuple[Array, Array, Array]:
    """(directions (N, 3), harmonics (K, N), indices (6, N) of the neighbors) of an icosphere's vertices."""
    from trimesh.creation import icosphere  # trimesh takes half a second

    sphere = icosphere(subdivisions)
    around = [[*near, *near[:1]][:6] for near in sphere.vertex_neighbors]  # twelve vertices have five
    directions = np.array(sphere.vertices)
    return directions, np.ascontiguousarray(_harmonics(directions, degree).T), np.array(around).T
