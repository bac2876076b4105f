"""Projections of lights onto those that something could emit.

A physical light has non-negative radiance in every direction ω. With the
harmonics Y(ω) of that direction, shape (K,), and the coefficients x of one
channel, the constraint is Y(ω) · x ≥ 0. Both public functions solve quadratic
programs with this constraint for every direction.

`project_nonnegative` keeps the mean, x₀ = v₀, of the given light v. It minimizes
the error of the irradiance, Σ A_l² (x − v)², with the factors A_l of
`lambertian_factors`. Bands that do not reach a diffuse surface have a small
weight instead of A_l = 0 (see `window.irradiance_weights`), so the nearest of
the lights with the same irradiance is chosen. The program is solved for the
directions of a grid and of the dips (local minima of negative radiance) that
are found. Dips that are left after a few solutions are filled by mixing in the
light times `nonnegative_window`, which is physical if the given light is the
projection of a physical one. Without a fixed mean, the nearest coefficients
would brighten the whole sky to fill the dips beside a bright source.

`nearest_nonnegative` is the projection of an attack's step. Of coefficients v
(K,), it solves

    min |x − v|² / 2   such that   R x ≥ 0,

optionally with low ≤ x ≤ high (a ball in the maximum norm). The rows of R are
the harmonics of finitely many directions. With multipliers μ ≥ 0, the
Karush-Kuhn-Tucker conditions are

    x = v + Rᵀ μ,    R x ≥ 0,    μ · R x = 0.

This is least distance programming, which non-negative least squares solves
exactly (Lawson and Hanson 1974, chapter 23).

With a ball |x − c| ≤ r in the L2 norm, the first condition becomes
x + λ (x − c) = v + Rᵀ μ, with λ ≥ 0 and λ (|x − c| − r) = 0. Then x is the
projection, without the ball, of c + t (v − c) with t = 1 / (1 + λ). As long as
the rows with positive multipliers stay the same, x is affine in t. Newton steps
on t therefore find |x − c| = r.

Both use the exchange method (Hettich and Kortanek 1993, "Semi-infinite
programming", section 7). It adds the directions at the bottoms of the dips of
the current solution until the solution has no dips. Dips are found on a grid
and refined by Newton's method on the sphere.

In this module, "light" means one channel of a light: an array of K coefficients.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
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

# Results may be below zero by this fraction of the light's largest radiance.
TOLERANCE = 1e-4

# Both functions search for dips of this depth. It is smaller than TOLERANCE,
# because a flat valley may be deeper between two dips that were found.
_MIN_DIP_DEPTH = TOLERANCE / 10
# Radiance counts as zero below this fraction of the norm of the light: there,
# a dip is the rounding error of the input.
_DARK_FRACTION = 1e-6
# Exchange steps of both functions. Seven are usual.
_MAX_ROUNDS = 50
# `project_nonnegative` solves its program this many times before it fills dips.
_MAX_SOLUTIONS = 4
# Relative error of the distance |x - c| from the radius of a ball.
_RADIUS_TOLERANCE = 1e-7
# Newton steps on t. Two are usual.
_MAX_RADIUS_STEPS = 10
# The smallest denominator, which avoids a division by zero.
_TINY = 1e-300
# The grid of directions is an icosphere. Its nodes are 0.07 radians apart with the
# coarse number of subdivisions, which is used for lights up to the degree
# _COARSE_GRID_DEGREE. The nodes of the fine grid are half as far apart.
_COARSE_SUBDIVISIONS = 4
_FINE_SUBDIVISIONS = 5
_COARSE_GRID_DEGREE = 10
# The longest Newton step on the sphere, in radians.
_MAX_ANGLE = 0.1
# Newton steps on the sphere from a node of the grid to the bottom of a dip.
_BOTTOM_STEPS = 2


@dataclass(frozen=True)
class _NodeLimits:
    """Limits for the nodes of the grid from which a dip is sought.

    Both are fractions of the light's largest radiance. A node is a candidate if
    its radiance is below `above_zero` and exceeds that of no neighbor by more
    than `above_neighbors`.
    """

    above_zero: float
    above_neighbors: float


_ALL_CANDIDATES = _NodeLimits(above_zero=0.04, above_neighbors=1e-3)
# Limits under which a candidate must be lower than all its neighbors. They are
# faster. Dips that they miss are found by the next exchange step.
_LOWEST_NODES = _NodeLimits(above_zero=0.04, above_neighbors=0.0)


def project_nonnegative(lights: Tensor) -> Tensor:
    """Project lights onto the non-negative lights with the same mean radiance.

    The result has the irradiance closest to that of the given light. The
    channels of a light are projected separately, in float64, without a graph.

    Args:
        lights: Coefficients, shape (..., (degree + 1)², C).

    Returns:
        Coefficients of the same shape and dtype. The radiance of a channel is
        at least -`TOLERANCE` times its largest radiance. The first coefficient
        is unchanged, or zero if it was negative. A channel whose radiance is
        non-negative everywhere keeps its bits.

    Example:
        >>> import norm_balls as nb
        >>> physical = project_nonnegative(nb.load_light("grace"))
        >>> physical.shape
        torch.Size([49, 3])
    """
    channels, channel_of_light = np.unique(_by_channel(lights)[:, 0], axis=0, return_inverse=True)
    owners, _ = _find_dips(channels, _dark_radiance(channels), _LOWEST_NODES)
    physical = lights.detach().mT.flatten(0, -2).clone()
    for channel in np.unique(owners):
        projected = torch.from_numpy(_project_with_mean(channels[channel])).to(physical)
        physical[torch.from_numpy(channel_of_light.reshape(-1) == channel)] = projected
    return physical.view(lights.mT.shape).mT


def _project_with_mean(light: Array) -> Array:
    """Return the non-negative light (K,) with the mean of a light and the closest irradiance."""
    mean = light[0]
    dark = _dark_radiance(light[None])
    uniform = np.concatenate([[max(mean, 0.0)], 0 * light[1:]])
    if mean <= dark:
        return uniform
    degree = math.isqrt(len(light)) - 1
    weights = irradiance_weights(degree).numpy()
    window = nonnegative_window(degree).numpy()
    rows = _grid(degree, _COARSE_SUBDIVISIONS).harmonics.T
    nearest = light
    for number in range(_MAX_ROUNDS):
        _, bottoms = _find_dips(nearest[None], dark, _LOWEST_NODES)
        if not len(bottoms):
            break
        if number < _MAX_SOLUTIONS:
            rows = np.concatenate([rows, bottoms])
            change = shortest(rows[:, 1:] / weights[1:], -rows @ light)
            nearest = np.concatenate([[mean], light[1:] + change / weights[1:]])
        else:
            # The windowed light is made non-negative with uniform light, and
            # then fills the dips of the last solution.
            windowed = _mix_to_nonnegative(window * light, uniform, rows)
            windowed = _mix_to_nonnegative(windowed, uniform, bottoms)
            nearest = _mix_to_nonnegative(nearest, windowed, bottoms)
    return nearest


def _mix_to_nonnegative(light: Array, brighter: Array, rows: Array) -> Array:
    """Mix a light (K,) with a brighter one, so that it is non-negative in R directions.

    The result is light + s (brighter - light) with the smallest possible s ≥ 0.
    The rows (R, K) are the harmonics of the directions.
    """
    radiance = rows @ light
    added = rows @ (brighter - light)
    is_negative = radiance < 0
    share = (-radiance[is_negative] / added[is_negative]).max(initial=0)
    return light + (brighter - light) * share


def nearest_nonnegative(lights: Tensor, within: Ball | None = None) -> Tensor:
    """Project lights onto the non-negative lights with the nearest coefficients.

    Distances are Euclidean. The mean radiance changes, and often rises if a
    light has deep dips. The computation is in float64, without a graph.

    Args:
        lights: Coefficients, shape (..., (degree + 1)², C).
        within: Ball in which the result lies, for lights (A, (degree + 1)², C).
            Its centers must be non-negative lights. The norm "l2" is taken over
            all channels of a light together. None for no ball.

    Returns:
        Coefficients of the same shape and dtype. The radiance of a channel is
        at least -`TOLERANCE` times its largest radiance. A channel that
        satisfies the constraints keeps its bits.
    """
    programs = _programs(lights, within)
    unsolved = programs
    for _ in range(_MAX_ROUNDS):
        nearest = np.concatenate([program.nearest for program in unsolved])
        original = np.concatenate([program.original for program in unsolved])
        owners, rows = _find_dips(nearest, _dark_radiance(original), _ALL_CANDIDATES)
        channel_count = len(nearest) // len(unsolved)
        indices = np.unique(owners // channel_count)
        for index in indices:
            first = index * channel_count
            channels = range(first, first + channel_count)
            unsolved[index].add([rows[owners == channel] for channel in channels])
        unsolved = [unsolved[index] for index in indices]
        if not unsolved:
            break
    nearest = np.concatenate([program.nearest for program in programs])
    return torch.from_numpy(nearest).view(lights.mT.shape).to(lights).mT


def _programs(lights: Tensor, within: Ball | None) -> "list[_Program]":
    """Return one program per light if the ball has the norm "l2", or else one per channel."""
    original = _by_channel(lights)
    if within is None:
        return [_Program(light) for light in original]
    if within.norm == "linf":
        low, high = map(_by_channel, within.ends)
        return [_Program(*arguments) for arguments in zip(original, low, high, strict=True)]
    shape = (len(lights), lights.shape[2], lights.shape[1])
    centers = _by_channel(within.center).reshape(shape)
    pairs = zip(original.reshape(shape), centers, strict=True)
    return [_Program(light, center=center, radius=within.radius) for light, center in pairs]


def _dark_radiance(channels: Array) -> Array:
    """Return the largest radiance (R,) that counts as zero, for channels (R, K)."""
    return _DARK_FRACTION * np.linalg.norm(channels, axis=1)


def _by_channel(lights: Tensor) -> Array:
    """Return the channels of lights (..., K, C) as an array (channels, 1, K) of float64."""
    return lights.detach().mT.flatten(0, -2)[:, None].cpu().double().numpy()


class _Program:
    """The nearest non-negative light of C channels, for a growing set of directions.

    It has either bounds or a ball in the L2 norm. In the notation of the
    module's docstring, v is `original`, c is `_center`, r is `_radius` and
    v - c is `_offset`.

    Attributes:
        original: The given light, shape (C, K).
        nearest: The solution for the directions that were added, shape (C, K).
    """

    def __init__(
        self,
        original: Array,
        low: Array | float = -np.inf,
        high: Array | float = np.inf,
        center: Array | float = 0.0,
        radius: float = np.inf,
    ):
        self.original = original
        self._center = center
        self._radius = radius
        self._offset = original - center
        self._low = np.broadcast_to(low, original.shape)
        self._high = np.broadcast_to(high, original.shape)
        # The t that brings the light without constraints onto the sphere.
        # Constraints only shorten the distance, so no smaller t is needed.
        distance = float(np.linalg.norm(self._offset))
        self._min_t = min(radius / max(distance, _TINY), 1.0)
        self._t = self._min_t
        self.nearest = self._target().clip(low, high)
        # A channel has the harmonics (M, K) of the M directions whose multipliers
        # are positive.
        self._active_rows = [original[:0]] * len(original)

    def _target(self) -> Array:
        """Return c + t (v - c), shape (C, K)."""
        return self.original if self._t == 1 else self._center + self._t * self._offset

    def add(self, rows: Sequence[Array]) -> None:
        """Add directions, given by their harmonics (M, K) for each channel, and solve again.

        Directions whose multiplier is zero are dropped. The loop takes Newton
        steps on t until the solution x is on the sphere |x − c| = r, or inside
        of it with t = 1.
        """
        rows = [np.concatenate(pair) for pair in zip(self._active_rows, rows, strict=True)]
        for _ in range(_MAX_RADIUS_STEPS):
            target = self._target()
            nearest, self._active_rows = self._project(target, rows)
            displacement = nearest - self._center
            distance = float(np.linalg.norm(displacement))
            missing = self._radius - distance
            is_inside = self._t == 1 and missing > 0
            is_on_sphere = abs(missing) <= _RADIUS_TOLERANCE * self._radius
            if is_inside or is_on_sphere:
                break
            # The constraints moved each channel by Rᵀ μ.
            moved_by_constraints = nearest - target
            motions = list(map(_motion, self._offset, moved_by_constraints, self._active_rows))
            direction = np.stack([motion.light for motion in motions])
            missing_squared = missing * (self._radius + distance)
            step = self._step_to_sphere(direction, displacement, missing_squared)
            self._t += step
            if all(motion.keeps_rows(step) for motion in motions):
                # The solution is affine in t up to here, so the step is exact.
                displacement = displacement + step * direction
                break
        scale = min(1, self._radius / max(float(np.linalg.norm(displacement)), _TINY))
        self.nearest = self._center + displacement * scale

    def _project(self, target: Array, rows: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the projections (C, K) of all channels, and the active rows of each channel."""
        solved = map(_least_distance, target, rows, self._low, self._high)
        nearest, active_rows = zip(*solved, strict=True)
        return np.stack(nearest), list(active_rows)

    def _step_to_sphere(
        self, direction: Array, displacement: Array, missing_squared: float
    ) -> float:
        """Return the step on t after which |displacement + step direction| is the radius.

        This is the root of a quadratic equation. `missing_squared` is the squared
        radius minus the squared displacement. The step keeps t between its
        minimum and 1.
        """
        speed = float((direction * direction).sum())
        slope = float((direction * displacement).sum())
        root = math.sqrt(max(slope**2 + speed * missing_squared, 0))
        step = (root - slope) / max(speed, _TINY)
        return min(max(step, self._min_t - self._t), 1 - self._t)


@dataclass(frozen=True)
class _Motion:
    """Derivatives of a channel of the solution by t while the same rows stay active.

    `light` (K,) is the derivative of the solution by t, `multipliers` (M,) are
    those of the active rows, and `changes` (M,) are their derivatives by t.
    """

    light: Array
    multipliers: Array
    changes: Array

    def keeps_rows(self, step: float) -> bool:
        """Return whether all multipliers are non-negative after a step of t."""
        return bool(np.all(self.multipliers + step * self.changes >= 0))


def _motion(offset: Array, added: Array, rows: Array) -> _Motion:
    """Return the motion of a channel with the offset v − c (K,) and the active rows (M, K).

    `added` (K,) is Rᵀ μ, from which the multipliers μ are recovered.
    """
    solution = np.linalg.lstsq(rows.T, np.stack([-offset, added], axis=1))[0]
    changes, multipliers = solution.T
    return _Motion(offset + rows.T @ changes, multipliers, changes)


def _least_distance(original: Array, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the x (K,) nearest to a light with rows · x ≥ 0 and low ≤ x ≤ high.

    The second result holds the rows with positive multipliers.

    All constraints together are G d ≥ h for the difference d = x - original.
    Algorithm LDP of Lawson and Hanson finds the shortest d. It solves a problem of
    non-negative least squares: the u ≥ 0 that minimizes |E u − f|, with the rows
    of Gᵀ and then hᵀ in E, and f = (0, ..., 0, 1). With the residual
    r = E u − f of size K + 1, the result is d_j = −r_j / r_(K+1).
    """
    if not len(rows):
        return original, rows
    size = len(original)
    scale = np.linalg.norm(original)
    is_bounded = np.isfinite(low)
    axes = np.eye(size)[is_bounded]
    # These are G and h. Dividing h by the norm of the light divides d by it, too.
    left_sides = np.concatenate([rows, axes, -axes])
    from_low = (low - original)[is_bounded]
    from_high = (original - high)[is_bounded]
    right_sides = np.concatenate([-rows @ original, from_low, from_high])
    dual = np.concatenate([left_sides.T, right_sides[None] / scale])
    last_unit_vector = np.eye(size + 1)[size]
    multipliers, _ = nnls(dual, last_unit_vector)
    residual = dual @ multipliers
    residual[size] -= 1
    if residual[size] > -(_MIN_DIP_DEPTH**2):
        # The bounds leave no room beyond rounding.
        return original.clip(low, high), rows
    nearest = original - residual[:size] / residual[size] * scale
    is_active = multipliers[: len(rows)] > 0
    return nearest.clip(low, high), rows[is_active]


def _find_dips(lights: Array, dark: Array, limits: _NodeLimits) -> tuple[Array, Array]:
    """Find the local minima of lights (R, K) at which radiance is negative.

    `dark` (R,) is the largest radiance that counts as zero. Returns, for each
    of D dips, the index (D,) of the light, and the harmonics (D, K) of the
    direction at the bottom.
    """
    degree = math.isqrt(lights.shape[1]) - 1
    is_coarse = degree <= _COARSE_GRID_DEGREE
    grid = _grid(degree, _COARSE_SUBDIVISIONS if is_coarse else _FINE_SUBDIVISIONS)
    radiance = lights @ grid.harmonics
    largest = np.abs(radiance).max(1)
    below = np.where(largest > dark, limits.above_zero * largest, -np.inf)
    owners, nodes = np.nonzero(radiance < below[:, None])
    margin = limits.above_neighbors * largest
    for neighbors in grid.neighbors:
        neighbor_radiance = radiance[owners, neighbors[nodes]]
        is_lower = radiance[owners, nodes] <= neighbor_radiance + margin[owners]
        owners = owners[is_lower]
        nodes = nodes[is_lower]
    expansions = (lights @ _derivatives(degree)).reshape(len(lights), 3 + 9, -1)[owners]
    bottoms = grid.directions[nodes]
    for _ in range(_BOTTOM_STEPS):
        bottoms = _step_down(bottoms, expansions)
    rows = _harmonics(bottoms, degree)
    is_deep = (rows * lights[owners]).sum(1) < -_MIN_DIP_DEPTH * largest[owners]
    return owners[is_deep], rows[is_deep]


def _step_down(directions: Array, expansions: Array) -> Array:
    """Take one Newton step from unit directions (D, 3) towards lower radiance on the sphere.

    The step is taken along the principal axes of the radiance's curvature.
    `expansions` (D, 3 + 9, K) are the coefficients of the first and second
    derivatives of each direction's light by x, y and z.
    """
    degree = math.isqrt(expansions.shape[2]) - 1
    derivatives = expansions @ _harmonics(directions, degree)[..., None]
    gradient = derivatives[:, :3]
    hessian = derivatives[:, 3:].reshape(-1, 3, 3)
    x, y, z = directions.T
    # Shape (D, 2, 3): two unit tangents of the sphere for each direction.
    tangents = np.array(tangent_axes(x, y, z, np.copysign(1, z))).transpose(2, 0, 1)
    radial = directions[:, None] @ gradient
    curvature, turn = np.linalg.eigh(tangents @ hessian @ tangents.mT - radial * np.eye(2))
    axes = turn.mT @ tangents
    slope = (axes @ gradient)[..., 0]
    # A larger curvature shortens the step: no step is longer than _MAX_ANGLE.
    limit = np.linalg.norm(slope, axis=1, keepdims=True) / _MAX_ANGLE
    steepness = np.maximum(np.abs(curvature), limit)
    step = (slope / np.maximum(steepness, _TINY))[:, None] @ axes
    moved = directions - step[:, 0]
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _harmonics(directions: Array, degree: int) -> Array:
    """Return the harmonics (D, K) of a few unit directions (D, 3), faster than `select_rows`.

    On the unit sphere, they are polynomials that are homogeneous of the degree
    or of the degree below, because x² + y² + z² = 1.
    """
    exponents, coefficients = _polynomials(degree)
    powers = np.ones((degree + 1, *directions.T.shape))
    for power in range(degree):
        powers[power + 1] = powers[power] * directions.T
    x, y, z = powers.transpose(1, 0, 2)
    return (x[exponents[0]] * y[exponents[1]] * z[exponents[2]]).T @ coefficients


@per_degree
def _polynomials(degree: int) -> tuple[Array, Array]:
    """Return the exponents (3, J) of x, y and z in J monomials, and the harmonics' coefficients.

    The coefficients have the shape (J, K).
    """
    exponents = []
    coefficients = []
    for total in range(degree, max(degree - 2, -1), -1):
        for a in range(total, -1, -1):
            exponents += [(a, b, total - a - b) for b in range(total - a, -1, -1)]
        has_parity = (bands(total) - total) % 2 == 0
        homogeneous = monomial_coefficients(total) * has_parity
        coefficients.append(F.pad(homogeneous, (0, (degree + 1) ** 2 - homogeneous.shape[1])))
    return np.array(exponents).T, torch.cat(coefficients).numpy()


@per_degree
def _derivatives(degree: int) -> Array:
    """Return the matrix (K, (3 + 9) K) that differentiates lights once and twice by x, y and z."""
    first = gradient_matrices(degree)
    second = (first[:, None] @ first).flatten(0, 1)
    return torch.cat([first, second]).flatten(0, 1).T.contiguous().numpy()


@dataclass(frozen=True)
class _Grid:
    """The N vertices of an icosphere.

    Attributes:
        directions: Unit vectors, shape (N, 3).
        harmonics: Harmonics of each vertex, shape (K, N).
        neighbors: Indices of the six neighbors of each vertex, shape (6, N).
            Twelve vertices have five neighbors, of which one occurs twice.
    """

    directions: Array
    harmonics: Array
    neighbors: Array


@per_degree
def _grid(degree: int, subdivisions: int) -> _Grid:
    """Build the grid of directions on which dips are sought."""
    # Importing trimesh takes half a second.
    from trimesh.creation import icosphere

    sphere = icosphere(subdivisions)
    neighbors = [[*around, *around[:1]][:6] for around in sphere.vertex_neighbors]
    directions = np.array(sphere.vertices)
    harmonics = np.ascontiguousarray(_harmonics(directions, degree).T)
    return _Grid(directions, harmonics, np.array(neighbors).T)
