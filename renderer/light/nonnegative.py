"""Projections of environment light onto lights without negative radiance.

In this module, a light is an array of K SH coefficients of one color channel. A
physical light has non-negative radiance in every direction ω. With the harmonics
Y(ω) of this direction, shape (K,), and the coefficients x, the constraint is
Y(ω) · x ≥ 0. Both public functions solve quadratic programs with this constraint
for every direction. A dip of a light is a local minimum of its radiance with a
negative value.

`project_nonnegative` keeps the mean of the given light v, so x₀ = v₀. It
minimizes the error of the irradiance, Σ A_l² (x − v)², with the factors A_l of
`lambertian_factors`. Coefficients with A_l = 0 get a small weight instead (see
`window.irradiance_weights`), so of all lights with the same irradiance, the
nearest one is chosen. The program is solved for the directions of a grid and of
the dips that are found. If dips are left after a few solutions, the light times
`nonnegative_window` is mixed in to fill them. This windowed light is
non-negative if the given light is a physical light that was cut off at a degree.
Without a fixed mean, the nearest coefficients would brighten the whole sky to
fill the dips beside a bright source.

`nearest_nonnegative` is used after each step of an attack. For coefficients v,
it solves

    min |x − v|² / 2   such that   R x ≥ 0,

optionally with low ≤ x ≤ high (a ball in the maximum norm). Each row of R holds
the harmonics of one of finitely many directions. With multipliers μ ≥ 0, the
Karush-Kuhn-Tucker conditions are

    x = v + Rᵀ μ,    R x ≥ 0,    μ · R x = 0.

This is least distance programming, which non-negative least squares solves
exactly (Lawson and Hanson 1974, chapter 23).

With a ball |x − c| ≤ r in the L2 norm, the first condition becomes
x + λ (x − c) = v + Rᵀ μ, with λ ≥ 0 and λ (|x − c| − r) = 0. Then x is the
projection, without the ball, of c + t (v − c) with t = 1 / (1 + λ). As long as
the rows with positive multipliers stay the same, x is affine in t. Newton steps
on t therefore find |x − c| = r.

Both functions use the exchange method (Hettich and Kortanek 1993, "Semi-infinite
programming", section 7). The method adds the directions at the bottoms of the
dips of the current solution, and solves again, until the solution has no dips.
Dips are found on a grid and refined by Newton's method on the sphere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
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

# The radiance of results is at least minus this fraction of their largest radiance.
TOLERANCE = 1e-4

# Smallest depth of a dip that `_find_dips` reports, as a fraction of the largest
# radiance. It is smaller than TOLERANCE, because a flat valley may be deeper between
# two dips than at the dips.
_MIN_DIP_DEPTH = TOLERANCE / 10
# A channel counts as dark if its radiance is nowhere above this fraction of the norm
# of its coefficients. The dips of a dark channel are only rounding errors.
_DARK_FRACTION = 1e-6
# Largest number of rounds of the exchange method in both public functions. Seven are
# usual.
_MAX_ROUNDS = 50
# `project_nonnegative` solves its program at most this many times. Dips that are left
# are filled by mixing in a windowed light.
_MAX_SOLUTIONS = 4
# `project_nonnegative` keeps the results for this many channels.
_MAX_KEPT_CHANNELS = 256
# A solution x counts as lying on the sphere |x - c| = r if |x - c| differs from r by
# at most this fraction of r.
_RADIUS_TOLERANCE = 1e-7
# Largest number of Newton steps on t in `_Program.add`. Two are usual.
_MAX_RADIUS_STEPS = 10
# Smallest denominator of divisions in this module. It avoids a division by 0.
_TINY = 1e-300
# Dips are sought on the vertices of an icosphere. Lights up to the degree
# _COARSE_GRID_DEGREE use _COARSE_SUBDIVISIONS, with which neighboring vertices are
# 0.07 radians apart. Other lights use _FINE_SUBDIVISIONS, with half this distance.
_COARSE_SUBDIVISIONS = 4
_FINE_SUBDIVISIONS = 5
_COARSE_GRID_DEGREE = 10
# Longest Newton step in `_step_down`, in radians.
_MAX_ANGLE = 0.1
# Number of Newton steps from a vertex of the grid to the bottom of a dip.
_BOTTOM_STEPS = 2


@dataclass(frozen=True)
class _NodeLimits:
    """Conditions under which the search for a dip starts from a node of the grid.

    The limits are fractions of the largest radiance of the light.

    Attributes:
        above_zero: The radiance at the node is below this limit.
        above_neighbors: The radiance at the node is above the radiance at each
            neighbor by at most this limit.
    """

    above_zero: float
    above_neighbors: float


# Conditions of `nearest_nonnegative`, under which few dips are missed.
_ALL_CANDIDATES = _NodeLimits(above_zero=0.04, above_neighbors=1e-3)
# Conditions of `project_nonnegative`, under which the search only starts from nodes
# that are lower than all neighbors. The search is faster, and the next round of the
# exchange method finds the missed dips.
_LOWEST_NODES = _NodeLimits(above_zero=0.04, above_neighbors=0.0)


def project_nonnegative(lights: Tensor) -> Tensor:
    """Replace lights by the non-negative lights with the same mean and the closest irradiance.

    The channels of a light are projected separately, in float64. The result has
    no gradient.

    Args:
        lights: SH coefficients, shape (..., (degree + 1)², C) with C channels.

    Returns:
        SH coefficients in the same shape and dtype. The radiance of a channel is
        at least -`TOLERANCE` times its largest radiance. The first coefficient
        is unchanged, or 0 if it was negative. A channel without negative
        radiance keeps its bits.

    Example:
        >>> import norm_balls as nb
        >>> physical = project_nonnegative(nb.load_light("grace"))
        >>> physical.shape
        torch.Size([49, 3])
    """
    # Equal channels, such as those of a gray light, are projected once.
    channels, row_to_channel = np.unique(_by_channel(lights)[:, 0], axis=0, return_inverse=True)
    dip_to_channel, _ = _find_dips(channels, _dark_radiance(channels), _LOWEST_NODES)
    # One row of K coefficients for each channel of each light, shape (lights · 3, K).
    rows = lights.detach().mT.flatten(0, -2).clone()
    for channel in np.unique(dip_to_channel):
        projected = _project_once(channels[channel].tobytes())
        has_channel = torch.from_numpy(row_to_channel.reshape(-1) == channel)
        rows[has_channel] = projected.to(rows)
    return rows.view(lights.mT.shape).mT


@lru_cache(maxsize=_MAX_KEPT_CHANNELS)
def _project_once(channel: bytes) -> Tensor:
    """Call `_project_with_mean`, and keep the result for later calls.

    Several attacks often start in the same light. At degree 39, a projection takes
    half a minute.

    Args:
        channel: Bytes of the K SH coefficients of one channel, float64.

    Returns:
        SH coefficients, float64, shape (K,).
    """
    return torch.from_numpy(_project_with_mean(np.frombuffer(channel).copy()))


def _project_with_mean(light: Array) -> Array:
    """Find the non-negative light with the same mean as a light and the closest irradiance.

    Args:
        light: SH coefficients of one channel, shape (K,).

    Returns:
        SH coefficients, shape (K,).
    """
    mean = light[0]
    dark = _dark_radiance(light[None])
    uniform = np.concatenate([[max(mean, 0.0)], 0 * light[1:]])
    if mean <= dark:
        return uniform
    degree = math.isqrt(len(light)) - 1
    weights = irradiance_weights(degree).numpy()
    window = nonnegative_window(degree).numpy()
    # Harmonics of the directions in which the radiance is constrained.
    direction_rows = _grid(degree, _COARSE_SUBDIVISIONS).harmonics.T
    nearest = light
    for number in range(_MAX_ROUNDS):
        _, dip_rows = _find_dips(nearest[None], dark, _LOWEST_NODES)
        if not len(dip_rows):
            break
        if number < _MAX_SOLUTIONS:
            direction_rows = np.concatenate([direction_rows, dip_rows])
            # The length of the weighted change is the error of the irradiance.
            weighted_change = shortest(direction_rows[:, 1:] / weights[1:], -direction_rows @ light)
            nearest = np.concatenate([[mean], light[1:] + weighted_change / weights[1:]])
        else:
            # A dip is a direction with negative radiance. After `_MAX_SOLUTIONS` rounds,
            # dips are removed by mixing: first, uniform light is mixed into the windowed
            # light until that has no dips. Then this light is mixed into `nearest`.
            windowed = _mix_to_nonnegative(window * light, uniform, direction_rows)
            windowed = _mix_to_nonnegative(windowed, uniform, dip_rows)
            nearest = _mix_to_nonnegative(nearest, windowed, dip_rows)
    return nearest


def _mix_to_nonnegative(light: Array, filler: Array, direction_rows: Array) -> Array:
    """Mix as little of a second light into a light as makes it non-negative in D directions.

    The result is light + s (filler - light) with the smallest possible s ≥ 0.

    Args:
        light: SH coefficients of the light, shape (K,).
        filler: SH coefficients of the second light, which is brighter in the
            directions in which the light is negative, shape (K,).
        direction_rows: Harmonics of the directions, shape (D, K).

    Returns:
        SH coefficients of the mixture, shape (K,).
    """
    radiance = direction_rows @ light
    difference = direction_rows @ (filler - light)
    is_negative = radiance < 0
    share = (-radiance[is_negative] / difference[is_negative]).max(initial=0)
    return light + (filler - light) * share


def nearest_nonnegative(lights: Tensor, within: Ball | None = None) -> Tensor:
    """Replace lights by the non-negative lights with the nearest coefficients.

    The distance between two lights is the Euclidean distance of their
    coefficients. The mean radiance changes, and often rises if a light has deep
    dips. The computation uses float64. The result has no gradient.

    Args:
        lights: SH coefficients, shape (..., (degree + 1)², C) with C channels.
        within: Ball in which the result must lie. The lights then have the shape
            (A, (degree + 1)², C). The centers must be non-negative lights. The
            norm "l2" is taken over all channels of a light together. None for no
            ball.

    Returns:
        SH coefficients in the same shape and dtype. The radiance of a channel is
        at least -`TOLERANCE` times its largest radiance. A channel that
        satisfies the constraints keeps its bits.
    """
    programs = _programs(lights, within)
    unsolved = programs
    for _ in range(_MAX_ROUNDS):
        nearest = np.concatenate([program.nearest for program in unsolved])
        original = np.concatenate([program.original for program in unsolved])
        dip_to_channel, dip_rows = _find_dips(nearest, _dark_radiance(original), _ALL_CANDIDATES)
        # All programs have the same number of channels.
        channels_per_program = len(nearest) // len(unsolved)
        with_dips = np.unique(dip_to_channel // channels_per_program)
        for index in with_dips:
            first_channel = index * channels_per_program
            channels = range(first_channel, first_channel + channels_per_program)
            unsolved[index].add([dip_rows[dip_to_channel == channel] for channel in channels])
        unsolved = [unsolved[index] for index in with_dips]
        if not unsolved:
            break
    nearest = np.concatenate([program.nearest for program in programs])
    return torch.from_numpy(nearest).view(lights.mT.shape).to(lights).mT


def _programs(lights: Tensor, within: Ball | None) -> "list[_Program]":
    """Create the quadratic programs whose solutions are the nearest non-negative lights.

    Args:
        lights: SH coefficients, shape (..., K, C), or (A, K, C) with a ball.
        within: Ball in which the results must lie, or None.

    Returns:
        One program per light for a ball of the norm "l2", which couples the C
        channels of a light. Otherwise, one program per channel.
    """
    original = _by_channel(lights)
    if within is None:
        return [_Program(channel) for channel in original]
    if within.norm == "linf":
        low, high = map(_by_channel, within.ends)
        return [_Program(*arguments) for arguments in zip(original, low, high, strict=True)]
    # (A, K, C) becomes (A, C, K).
    shape = (len(lights), lights.shape[2], lights.shape[1])
    centers = _by_channel(within.center).reshape(shape)
    pairs = zip(original.reshape(shape), centers, strict=True)
    return [_Program(light, center=center, radius=within.radius) for light, center in pairs]


def _dark_radiance(channels: Array) -> Array:
    """Compute the largest radiance that counts as zero, because of rounding errors.

    Args:
        channels: SH coefficients of R channels, shape (R, K).

    Returns:
        Radiance for each channel, shape (R,).
    """
    return _DARK_FRACTION * np.linalg.norm(channels, axis=1)


def _by_channel(lights: Tensor) -> Array:
    """Convert lights to an array with one row for each channel of each light.

    Args:
        lights: SH coefficients, shape (..., K, C).

    Returns:
        SH coefficients of the R channels of all lights, float64, shape (R, 1, K).
        The axis of length 1 is the number of channels in a `_Program`.
    """
    return lights.detach().mT.flatten(0, -2)[:, None].cpu().double().numpy()


class _Program:
    """Quadratic program for the non-negative light that is nearest to a light of C channels.

    The radiance is only constrained in directions that were added. The light also
    has either bounds for each coefficient, or lies in an L2 ball. In the notation
    of the module docstring, v is `original`, c is `_center`, r is `_radius` and
    v - c is `_offset`.

    Attributes:
        original: SH coefficients of the given light, shape (C, K).
        nearest: SH coefficients of the solution, shape (C, K).

    Args:
        original: SH coefficients of the given light, shape (C, K).
        low: Lower bounds of the coefficients, shape (C, K) or a number.
        high: Upper bounds of the coefficients, shape (C, K) or a number.
        center: Center of the ball, shape (C, K) or a number.
        radius: Radius of the ball. Infinity for no ball.
    """

    def __init__(
        self,
        original: Array,
        low: Array | float = -np.inf,
        high: Array | float = np.inf,
        center: Array | float = 0.0,
        radius: float = np.inf,
    ):
        """Solve the program without directions: the result fulfills the bounds or the ball."""
        self.original = original
        self._center = center
        self._radius = radius
        self._offset = original - center
        self._low = np.broadcast_to(low, original.shape)
        self._high = np.broadcast_to(high, original.shape)
        # With this t, c + t (v - c) lies on the sphere |x - c| = r. The constraints
        # only shorten the distance from c, so t never needs to be smaller.
        distance = float(np.linalg.norm(self._offset))
        self._min_t = min(radius / max(distance, _TINY), 1.0)
        self._t = self._min_t
        self.nearest = self._target().clip(low, high)
        # For each channel, the harmonics of the M active directions, shape (M, K).
        # A direction is active if its multiplier μ is positive. At first, there are
        # no directions.
        self._active_rows = [original[:0]] * len(original)

    def _target(self) -> Array:
        """Compute c + t (v - c) for the current t, shape (C, K)."""
        return self.original if self._t == 1 else self._center + self._t * self._offset

    def add(self, new_rows: Sequence[Array]) -> None:
        """Constrain the radiance in additional directions, and solve the program again.

        Directions that are not active, because their multiplier is zero, are
        dropped. The loop takes Newton steps on t. It ends if the solution x lies
        on the sphere |x − c| = r, or inside of the sphere with t = 1.

        Args:
            new_rows: For each of the C channels, the harmonics of M new
                directions, shape (M, K).
        """
        rows_by_channel = [
            np.concatenate(pair) for pair in zip(self._active_rows, new_rows, strict=True)
        ]
        for _ in range(_MAX_RADIUS_STEPS):
            target = self._target()
            nearest, self._active_rows = self._project(target, rows_by_channel)
            displacement = nearest - self._center
            distance = float(np.linalg.norm(displacement))
            missing = self._radius - distance
            is_inside = self._t == 1 and missing > 0
            is_on_sphere = abs(missing) <= _RADIUS_TOLERANCE * self._radius
            if is_inside or is_on_sphere:
                break
            # The constraints moved each channel by Rᵀ μ.
            moved_by_constraints = nearest - target
            # Derivatives of the solution by t, for each channel.
            motions = list(map(_motion, self._offset, moved_by_constraints, self._active_rows))
            velocity = np.stack([motion.light for motion in motions])
            # r² - |x - c|².
            missing_squared = missing * (self._radius + distance)
            step = self._step_to_sphere(velocity, displacement, missing_squared)
            self._t += step
            if all(motion.keeps_rows(step) for motion in motions):
                # The same directions stay active, so the solution is affine in t, and
                # the step is exact.
                displacement = displacement + step * velocity
                break
        # Rounding may leave the solution slightly outside of the ball.
        scale = min(1, self._radius / max(float(np.linalg.norm(displacement)), _TINY))
        self.nearest = self._center + displacement * scale

    def _project(
        self, target: Array, rows_by_channel: Sequence[Array]
    ) -> tuple[Array, list[Array]]:
        """Project each channel onto the lights that fulfill the constraints, without the ball.

        Args:
            target: Light to project, shape (C, K).
            rows_by_channel: For each channel, the harmonics of the M constrained
                directions, shape (M, K).

        Returns:
            The projections, shape (C, K), and for each channel, the rows with
            positive multipliers.
        """
        solutions = map(_least_distance, target, rows_by_channel, self._low, self._high)
        nearest, active_rows = zip(*solutions, strict=True)
        return np.stack(nearest), list(active_rows)

    def _step_to_sphere(
        self, velocity: Array, displacement: Array, missing_squared: float
    ) -> float:
        """Find the step on t that brings the solution onto the sphere |x - c| = r.

        The step s solves the quadratic equation |displacement + s velocity| = r.
        It is clipped so that t stays between its minimum and 1.

        Args:
            velocity: Derivative of the solution x by t, shape (C, K).
            displacement: Current x - c, shape (C, K).
            missing_squared: r² - |x - c|².

        Returns:
            The step s.
        """
        squared_speed = float((velocity * velocity).sum())
        slope = float((velocity * displacement).sum())
        root = math.sqrt(max(slope**2 + squared_speed * missing_squared, 0))
        step = (root - slope) / max(squared_speed, _TINY)
        return min(max(step, self._min_t - self._t), 1 - self._t)


@dataclass(frozen=True)
class _Motion:
    """Derivatives by t of one channel of a solution, while the same M directions stay active.

    Attributes:
        light: Derivative of the solution by t, shape (K,).
        multipliers: Multiplier μ of each active direction, shape (M,).
        multiplier_changes: Derivatives of the multipliers by t, shape (M,).
    """

    light: Array
    multipliers: Array
    multiplier_changes: Array

    def keeps_rows(self, step: float) -> bool:
        """Tell whether all active directions stay active if t changes by `step`."""
        return bool(np.all(self.multipliers + step * self.multiplier_changes >= 0))


def _motion(offset: Array, moved_by_constraints: Array, active_rows: Array) -> _Motion:
    """Compute the derivatives by t of one channel of a solution.

    The solution is c + t (v − c) + Rᵀ μ with R x = 0 for the active directions.
    The derivative of μ solves the least squares problem Rᵀ μ' ≈ −(v − c).

    Args:
        offset: v − c, shape (K,).
        moved_by_constraints: Rᵀ μ, shape (K,). The multipliers μ are computed
            from it.
        active_rows: Matrix R, the harmonics of the M active directions,
            shape (M, K).

    Returns:
        Derivatives by t, and multipliers.
    """
    right_sides = np.stack([-offset, moved_by_constraints], axis=1)
    solution = np.linalg.lstsq(active_rows.T, right_sides)[0]
    multiplier_changes, multipliers = solution.T
    return _Motion(
        light=offset + active_rows.T @ multiplier_changes,
        multipliers=multipliers,
        multiplier_changes=multiplier_changes,
    )


def _least_distance(original: Array, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Find the light that is nearest to a light, with rows · x ≥ 0 and low ≤ x ≤ high.

    All constraints together are G d ≥ h for the difference d = x - original.
    Algorithm LDP of Lawson and Hanson finds the shortest d. It solves a problem of
    non-negative least squares: the u ≥ 0 that minimizes |E u − f|, with the rows
    of Gᵀ and then hᵀ in E, and f = (0, ..., 0, 1). With the residual
    r = E u − f of size K + 1, the result is d_j = −r_j / r_(K+1).

    Args:
        original: SH coefficients of the light, shape (K,).
        rows: Harmonics of the M constrained directions, shape (M, K).
        low: Lower bounds, shape (K,). Minus infinity for no bound.
        high: Upper bounds, shape (K,).

    Returns:
        The nearest light x, shape (K,), and the rows with positive multipliers.
    """
    if not len(rows):
        return original, rows
    size = len(original)
    # Dividing h by the norm of the light divides d by the norm, too.
    scale = np.linalg.norm(original)
    is_bounded = np.isfinite(low)
    axes = np.eye(size)[is_bounded]
    # Matrix G and vector h of all constraints G d ≥ h: first those of the M directions, then
    # the lower bounds, and then the upper bounds.
    left_sides = np.concatenate([rows, axes, -axes])
    from_low = (low - original)[is_bounded]
    from_high = (original - high)[is_bounded]
    right_sides = np.concatenate([-rows @ original, from_low, from_high])
    # Matrix E and vector f of the non-negative least squares problem.
    dual_matrix = np.concatenate([left_sides.T, right_sides[None] / scale])
    last_unit_vector = np.eye(size + 1)[size]
    multipliers, _ = nnls(dual_matrix, last_unit_vector)
    residual = dual_matrix @ multipliers
    residual[size] -= 1
    if residual[size] > -(_MIN_DIP_DEPTH**2):
        # Up to rounding, only one point fulfills the constraints.
        return original.clip(low, high), rows
    nearest = original - residual[:size] / residual[size] * scale
    is_active = multipliers[: len(rows)] > 0
    return nearest.clip(low, high), rows[is_active]


def _find_dips(lights: Array, dark: Array, limits: _NodeLimits) -> tuple[Array, Array]:
    """Find the local minima with negative radiance (dips) of R lights.

    Args:
        lights: SH coefficients, shape (R, K).
        dark: Largest radiance of each light that counts as zero, shape (R,). A
            light without larger radiance has no dips.
        limits: Conditions for nodes of the grid from which a search starts.

    Returns:
        A tuple of
        - the index of the light of each of D dips, shape (D,);
        - the harmonics of the direction at the bottom of each dip,
          shape (D, K).
    """
    degree = math.isqrt(lights.shape[1]) - 1
    is_coarse = degree <= _COARSE_GRID_DEGREE
    grid = _grid(degree, _COARSE_SUBDIVISIONS if is_coarse else _FINE_SUBDIVISIONS)
    # Radiance of each light at each node of the grid, shape (R, N).
    radiance = lights @ grid.harmonics
    largest = np.abs(radiance).max(1)
    upper_limit = np.where(largest > dark, limits.above_zero * largest, -np.inf)
    # Pairs of a light and a node from which a search may start.
    light_index, node = np.nonzero(radiance < upper_limit[:, None])
    margin = limits.above_neighbors * largest
    # Each row of `neighbors` has one neighbor of each node.
    for neighbors in grid.neighbors:
        neighbor_radiance = radiance[light_index, neighbors[node]]
        is_lower = radiance[light_index, node] <= neighbor_radiance + margin[light_index]
        light_index = light_index[is_lower]
        node = node[is_lower]
    # SH coefficients of 3 first and 9 second derivatives, shape (D, 12, K).
    derivatives = (lights @ _derivatives(degree)).reshape(len(lights), 3 + 9, -1)[light_index]
    bottoms = grid.directions[node]
    for _ in range(_BOTTOM_STEPS):
        bottoms = _step_down(bottoms, derivatives)
    dip_rows = _harmonics(bottoms, degree)
    bottom_radiance = (dip_rows * lights[light_index]).sum(1)
    is_deep = bottom_radiance < -_MIN_DIP_DEPTH * largest[light_index]
    return light_index[is_deep], dip_rows[is_deep]


def _step_down(directions: Array, derivatives: Array) -> Array:
    """Take one Newton step on the sphere toward lower radiance, from D directions.

    Args:
        directions: Unit vectors, shape (D, 3).
        derivatives: SH coefficients of the derivatives of the light of each
            direction: 3 first and 9 second derivatives by x, y and z,
            shape (D, 12, K).

    Returns:
        Unit vectors after the step, shape (D, 3).
    """
    degree = math.isqrt(derivatives.shape[2]) - 1
    # Values of the derivatives at the directions, shape (D, 12, 1).
    values = derivatives @ _harmonics(directions, degree)[..., None]
    gradient = values[:, :3]
    hessian = values[:, 3:].reshape(-1, 3, 3)
    x, y, z = directions.T
    # Two unit tangents of the sphere for each direction, shape (D, 2, 3).
    tangents = np.array(tangent_axes(x, y, z, np.copysign(1, z))).transpose(2, 0, 1)
    # On the sphere, the second derivatives also contain the radial derivative.
    radial_derivative = directions[:, None] @ gradient
    sphere_hessian = tangents @ hessian @ tangents.mT - radial_derivative * np.eye(2)
    curvature, eigenvectors = np.linalg.eigh(sphere_hessian)
    # Along these two axes, the second derivatives are the two curvatures.
    principal_axes = eigenvectors.mT @ tangents
    slope = (principal_axes @ gradient)[..., 0]
    # A Newton step is the slope divided by the curvature. The absolute value makes
    # it lead downward, and the second limit keeps it shorter than _MAX_ANGLE.
    smallest_divisor = np.linalg.norm(slope, axis=1, keepdims=True) / _MAX_ANGLE
    divisor = np.maximum(np.abs(curvature), smallest_divisor)
    step = (slope / np.maximum(divisor, _TINY))[:, None] @ principal_axes
    moved = directions - step[:, 0]
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _harmonics(directions: Array, degree: int) -> Array:
    """Evaluate all harmonics up to a degree, faster than `select_rows` for few directions.

    On the unit sphere, x² + y² + z² = 1. A harmonic is therefore a homogeneous
    polynomial of degree `degree` or `degree` - 1.

    Args:
        directions: Unit vectors, shape (D, 3).
        degree: Largest degree of the harmonics.

    Returns:
        K = (degree + 1)² harmonics, shape (D, K).
    """
    exponents, coefficients = _polynomials(degree)
    # Powers 0 to degree of the components, shape (degree + 1, 3, D).
    powers = np.ones((degree + 1, *directions.T.shape))
    for power in range(degree):
        powers[power + 1] = powers[power] * directions.T
    x_powers, y_powers, z_powers = powers.transpose(1, 0, 2)
    # Values of the J monomials at the D directions, shape (J, D).
    monomials = x_powers[exponents[0]] * y_powers[exponents[1]] * z_powers[exponents[2]]
    return monomials.T @ coefficients


@per_degree
def _polynomials(degree: int) -> tuple[Array, Array]:
    """Express K = (degree + 1)² harmonics on the unit sphere by J monomials.

    The monomials x^a y^b z^c have a + b + c = degree or degree - 1.

    Args:
        degree: Largest degree of the harmonics.

    Returns:
        A tuple of
        - the exponents a, b and c of the monomials, shape (3, J);
        - the coefficients of the harmonics, shape (J, K).
    """
    exponents = []
    coefficients = []
    for total in range(degree, max(degree - 2, -1), -1):
        for a in range(total, -1, -1):
            exponents += [(a, b, total - a - b) for b in range(total - a, -1, -1)]
        # Harmonics of the other parity belong to the other set of monomials.
        has_parity = (bands(total) - total) % 2 == 0
        homogeneous = monomial_coefficients(total) * has_parity
        coefficients.append(F.pad(homogeneous, (0, (degree + 1) ** 2 - homogeneous.shape[1])))
    return np.array(exponents).T, torch.cat(coefficients).numpy()


@per_degree
def _derivatives(degree: int) -> Array:
    """Compute the matrix that differentiates lights, given by SH coefficients, once and twice.

    Args:
        degree: Degree of the light, which has K = (degree + 1)² coefficients.

    Returns:
        Matrix, shape (K, 12 K). Its columns give 3 first and 9 second
        derivatives by x, y and z, with K coefficients each.
    """
    # Shapes (3, K, K) and (9, K, K).
    first = gradient_matrices(degree)
    second = (first[:, None] @ first).flatten(0, 1)
    return torch.cat([first, second]).flatten(0, 1).T.contiguous().numpy()


@dataclass(frozen=True)
class _Grid:
    """Directions at the N vertices (nodes) of an icosphere.

    Attributes:
        directions: Unit vectors, shape (N, 3).
        harmonics: K harmonics in each direction, shape (K, N).
        neighbors: Indices of the six neighbors of each node, shape (6, N).
            Twelve nodes have only five neighbors. One of these occurs twice.
    """

    directions: Array
    harmonics: Array
    neighbors: Array


@per_degree
def _grid(degree: int, subdivisions: int) -> _Grid:
    """Create the grid of directions on which dips are sought.

    Args:
        degree: Largest degree of the harmonics.
        subdivisions: Number of subdivisions of the icosphere.

    Returns:
        Grid with the harmonics in all directions.
    """
    # trimesh is imported here because the import takes half a second.
    from trimesh.creation import icosphere

    sphere = icosphere(subdivisions)
    neighbors = [[*around, *around[:1]][:6] for around in sphere.vertex_neighbors]
    directions = np.array(sphere.vertices)
    harmonics = np.ascontiguousarray(_harmonics(directions, degree).T)
    return _Grid(directions, harmonics, np.array(neighbors).T)
