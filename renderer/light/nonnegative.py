"""Projections of environment light onto lights without negative radiance.

In this module, a light is an array of K spherical-harmonic (SH) coefficients of
one color channel. A physical light has non-negative radiance in every direction
ω. With the harmonics Y(ω) of this direction, shape (K,), and the coefficients x,
the constraint is Y(ω) · x ≥ 0. Both public functions solve quadratic programs
with this constraint for every direction. A negative minimum of a light is a
direction in which its radiance has a local minimum and is negative.

`project_nonnegative` keeps the mean of the given light v, so x₀ = v₀. It
minimizes the error of the irradiance, Σ A_l² (x − v)², with the factors A_l of
`lambertian_factors`. Coefficients with A_l = 0 get a small weight instead (see
`irradiance_weights`), so of all lights with the same irradiance, the
nearest one is chosen. If negative minima are left after some solutions, the light times
`nonnegative_window` is mixed in to remove them. This windowed light is non-negative if the
given light is a physical light that was cut off at a degree. Above degree
_PROGRAM_DEGREE, the program would take long, and the window alone is used. Without a
fixed mean, the nearest coefficients would brighten the whole sky to remove the negative
minima beside a bright source.

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
programming", section 7). The method adds the negative minima of the current
solution to the directions, and solves again, until the solution has no negative
minima. They are found on a grid and refined by Newton's method on the sphere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from renderer.light.harmonics import bands, cache_tensors, gradient_matrices, monomial_coefficients
from renderer.light.ringing import irradiance_weights, least_distance, nonnegative_window
from renderer.vectors import Ball, tangent_axes

Array = NDArray[Any]

# The radiance of a result of `project_nonnegative` or `nearest_nonnegative` is
# at least minus this fraction of its largest radiance in every direction.
TOLERANCE = 1e-4

# `_find_negative_minima` ignores a minimum that is less negative than minus this fraction
# of the largest radiance. The fraction is below TOLERANCE, because the radiance between
# two minima in a flat valley may be lower than at the minima that were found.
_MIN_DEPTH = TOLERANCE / 10
# A channel of a light counts as dark if its radiance is nowhere above this fraction of the
# norm of its SH coefficients. Negative radiance of a dark channel is only rounding error.
_DARK_FRACTION = 1e-6
# Largest number of rounds of the exchange method. A round adds constraints in the
# directions with negative radiance, and solves again. Ten to twenty rounds are usual.
_MAX_ROUNDS = 50
# `project_nonnegative` solves its quadratic program at most this many times. Negative
# radiance that is left is then removed by adding a smoothed version of the light.
_MAX_SOLUTIONS = 80
# Number of color channels for which `project_nonnegative` keeps its results in a cache.
_MAX_CACHED_CHANNELS = 256
# A solution x counts as lying on the sphere |x - c| = r if |x - c| differs from r by
# at most this fraction of r.
_RADIUS_TOLERANCE = 1e-7
# Largest number of Newton steps with which `_QuadraticProgram.add_constraints` brings
# its solution onto the surface of the ball. Two steps are usual.
_MAX_RADIUS_STEPS = 10
# Smallest denominator of divisions in this module. It avoids a division by 0.
_TINY = 1e-300
# Above this degree, `project_nonnegative` uses the window alone.
_PROGRAM_DEGREE = 10
# Negative radiance is searched at the vertices of an icosphere. For lights up to degree
# _COARSE_GRID_DEGREE, the icosphere has _COARSE_SUBDIVISIONS, and neighboring vertices are
# 0.07 radians apart. For other lights, it has _FINE_SUBDIVISIONS and half this distance.
_COARSE_SUBDIVISIONS = 4
_FINE_SUBDIVISIONS = 5
_COARSE_GRID_DEGREE = 6
# Longest step on the unit sphere, in radians, in the search for a minimum of the radiance.
_MAX_ANGLE = 0.1
# Number of Newton steps from a vertex of the icosphere to a local minimum of the radiance
# near this vertex.
_NEWTON_STEPS = 2


# The search for a negative minimum starts from grid directions whose radiance is below this
# fraction of the largest radiance of the light,
_ABOVE_ZERO = 0.04
# and exceeds the radiance of no neighbor by more than this fraction. Few minima are missed
# with the first value. The search is several times faster with the second one.
_MANY_STARTS = 1e-3
_LOWEST_STARTS = 0.0


def project_nonnegative(coefficients: Tensor) -> Tensor:
    """Replace lights by the non-negative lights with the same mean and the closest irradiance.

    A light is non-negative if its radiance is negative in no direction. The
    channels of a light are projected separately, in float64. The result has no
    gradient. The radiance is at least -`TOLERANCE` times the largest one of the channel. The
    first coefficient stays, or becomes 0 if it was negative. A channel without negative radiance
    is unchanged. Above degree _PROGRAM_DEGREE, the highest degrees stay zero if all are.
    """
    low = (_PROGRAM_DEGREE + 1) ** 2
    if coefficients.shape[-2] > low and not coefficients[..., low:, :].any():
        projected = project_nonnegative(coefficients[..., :low, :])
        return F.pad(projected, (0, 0, 0, coefficients.shape[-2] - low))
    # Find the distinct channels, so that the equal channels of a gray light are projected
    # only once.
    channels = _split_channels(coefficients)[0][:, 0]
    unique_channels, unique_index = np.unique(channels, axis=0, return_inverse=True)
    rounding_radiance = _rounding_radiance(unique_channels)
    light_of_minimum, _ = _find_negative_minima(unique_channels, rounding_radiance, _LOWEST_STARTS)
    # One row for each channel of each light, shape (lights · C, K).
    rows = coefficients.detach().mT.flatten(0, -2).clone()
    for index in np.unique(light_of_minimum):
        projected = torch.tensor(_project_channel(unique_channels[index].tobytes()))
        is_same_channel = torch.from_numpy(unique_index.reshape(-1) == index)
        rows[is_same_channel] = projected.to(rows)
    return rows.view(coefficients.mT.shape).mT


@lru_cache(maxsize=_MAX_CACHED_CHANNELS)
def _project_channel(channel: bytes) -> Array:
    """Find the non-negative light with the same mean as a light and the closest irradiance.

    The light is one color channel, in bytes that can be hashed.
    """
    light = np.frombuffer(bytearray(channel))
    mean = light[0]
    rounding_radiance = _rounding_radiance(light[None])
    uniform = np.concatenate([[max(mean, 0.0)], 0 * light[1:]])
    if mean <= rounding_radiance:
        return uniform
    degree = math.isqrt(len(light)) - 1
    nearest = light
    if degree <= _PROGRAM_DEGREE:
        # Only the mean, which is the first coefficient, is bounded.
        low = np.concatenate([[mean], np.full(len(light) - 1, -np.inf)])
        high = np.where(low == mean, mean, np.inf)
        weights = irradiance_weights(degree).numpy()
        program = _QuadraticProgram(light[None], low, high, weights=weights)
        _exchange([program], _LOWEST_STARTS, _MAX_SOLUTIONS)
        nearest = program.nearest[0]
    windowed = nonnegative_window(degree).numpy() * light
    # Harmonics in the directions in which the radiance must not be negative, one row
    # for each direction.
    constraints = _grid(degree, _COARSE_SUBDIVISIONS)[1].T
    # Lights of low degrees have few minima, and the window alone leaves few.
    starts = _MANY_STARTS if _COARSE_GRID_DEGREE < degree <= _PROGRAM_DEGREE else _LOWEST_STARTS
    for _ in range(_MAX_ROUNDS):
        _, new_constraints = _find_negative_minima(nearest[None], rounding_radiance, starts)
        if not len(new_constraints):
            break
        # Mix uniform light into the windowed light until its radiance is not negative in
        # any direction that was found. Then mix the result into the nearest light.
        filler = _mix_to_nonnegative(windowed, uniform, constraints)
        filler = _mix_to_nonnegative(filler, uniform, new_constraints)
        nearest = _mix_to_nonnegative(nearest, filler, new_constraints)
    return nearest


def _mix_to_nonnegative(light: Array, filler: Array, harmonics: Array) -> Array:
    """Mix a light with as little of a filler as makes it non-negative in D directions.

    The filler must be brighter than the light wherever the light is negative.
    """
    radiance = harmonics @ light
    difference = harmonics @ (filler - light)
    is_negative = radiance < 0
    # Each negative direction needs the fraction -radiance / difference. The largest one serves all.
    filler_fraction = (-radiance[is_negative] / difference[is_negative]).max(initial=0)
    return light + (filler - light) * filler_fraction


def nearest_nonnegative(coefficients: Tensor, within: Ball | None = None) -> Tensor:
    """Replace lights by the non-negative lights with the nearest coefficients.

    A light is non-negative if its radiance is negative in no direction. The
    distance between two lights is the Euclidean distance of their coefficients.
    The mean radiance changes, and often rises if a light is far below zero in
    some directions. The computation uses float64. The result has no gradient. With `within`, each
    of A lights (A, K, C) lies in its ball, whose center must be non-negative. The norm "l2" is
    taken over all channels of a light together. The radiance of a channel is at least
    -`TOLERANCE` times its largest one.
    """
    if within is None or within.norm == "linf":
        bounds = () if within is None else within.ends
        channels = _split_channels(coefficients, *bounds)
        programs = [_QuadraticProgram(*arrays) for arrays in zip(*channels, strict=True)]
    else:
        # An L2 ball couples the channels of a light, which become one block (C, K).
        channels = _split_channels(coefficients, within.center)
        blocks = (each.reshape(coefficients.mT.shape) for each in channels)
        programs = [
            _QuadraticProgram(light, center=center, radius=within.radius)
            for light, center in zip(*blocks, strict=True)
        ]
    # Few starts find most minima, and many find the rest.
    for starts in (_LOWEST_STARTS, _MANY_STARTS):
        _exchange(programs, starts)
    nearest = np.concatenate([program.nearest for program in programs])
    # The copy to a GPU does not wait. The driver buffers the array before this function ends.
    rows = torch.from_numpy(nearest).to(coefficients, non_blocking=True)
    return rows.view(coefficients.mT.shape).mT


def _exchange(
    programs: "list[_QuadraticProgram]", starts: float, rounds: int = _MAX_ROUNDS
) -> None:
    """Solve programs until no negative minimum is found, see `_find_negative_minima`."""
    for _ in range(rounds):
        # Channels of all programs that are still negative somewhere, one below the other.
        nearest = np.concatenate([program.nearest for program in programs])
        original = np.concatenate([program.original for program in programs])
        rounding_radiance = _rounding_radiance(original)
        channel_of_minimum, harmonics = _find_negative_minima(nearest, rounding_radiance, starts)
        # Each quadratic program has the same number of channels.
        channels_per_program = len(nearest) // len(programs)
        still_negative = np.unique(channel_of_minimum // channels_per_program)
        for index in still_negative:
            first_channel = index * channels_per_program
            channels = range(first_channel, first_channel + channels_per_program)
            constraints = [harmonics[channel_of_minimum == channel] for channel in channels]
            programs[index].add_constraints(constraints)
        programs = [programs[index] for index in still_negative]
        if not programs:
            break


def _rounding_radiance(channels: Array) -> Array:
    """Compute the largest radiance of each row that may be nothing but a rounding error."""
    return _DARK_FRACTION * np.linalg.norm(channels, axis=1)


def _split_channels(*coefficients: Float[Tensor, "... K C"]) -> Array:
    """Convert tensors of lights to arrays (R, 1, K) of the R color channels of all lights.

    All tensors are copied from a GPU together, so that the CPU waits once.
    """
    rows = torch.stack(coefficients).detach().mT.flatten(1, -2)
    return rows[:, :, None].cpu().double().numpy()


@dataclass(eq=False)
class _QuadraticProgram:
    """Quadratic program for the non-negative light that is nearest to a light of C channels.

    The radiance is only constrained in the directions that `add_constraints`
    adds. In addition, the light lies within bounds for each coefficient or within
    an L2 ball. For the ball, let v be the given light, c the center and r the
    radius. The solution is the projection of the point c + t (v - c), without the
    ball. The number t from 0 to 1 is chosen so that the solution lies in the ball.

    The arrays `original` (v), `nearest` (the solution), `low`, `high` and `center` have the
    shape (C, K), or the last three are numbers. Without a ball, `weights` may weight the
    distance of each coefficient.
    """

    original: Array
    low: Array | float = -np.inf
    high: Array | float = np.inf
    center: Array | float = 0.0
    radius: float = np.inf
    weights: Array | float = 1.0

    def __post_init__(self) -> None:
        """Solve the program without constraints on the radiance, within the bounds or the ball."""
        self._offset = self.original - self.center
        distance = float(np.linalg.norm(self._offset))
        # With this t, the point c + t (v - c) lies on the surface of the ball. Constraints
        # only move the solution closer to the center c, so a smaller t is never needed.
        self._min_t = min(self.radius / max(distance, _TINY), 1.0)
        self._t = self._min_t
        self.nearest = self._unconstrained_point().clip(self.low, self.high)
        # Harmonics in the M directions whose constraint is active (its multiplier is positive),
        # one array (M, K) for each channel. At first, there are no directions.
        self._active_constraints = [self.original[:0]] * len(self.original)

    def _unconstrained_point(self) -> Array:
        """Compute the point c + t (v - c), whose projection is the solution, shape (C, K)."""
        return self.original if self._t == 1 else self.center + self._t * self._offset

    def add_constraints(self, new_harmonics: Sequence[Array]) -> None:
        """Constrain the radiance in additional directions, and solve the program again.

        Earlier constraints that are not active (their multiplier is zero) are
        dropped. With a ball of center c and radius r, the solution x is the
        projection of the point c + t (v - c) between the center (t = 0) and the
        given light v (t = 1). Newton steps change t until x lies on the sphere
        |x − c| = r, or inside of it with t = 1. The new harmonics are one matrix (M, K) for each
        channel.
        """
        pairs = zip(self._active_constraints, new_harmonics, strict=True)
        constraints = [np.concatenate(pair) for pair in pairs]
        low, high = (np.broadcast_to(end, self.original.shape) for end in (self.low, self.high))
        for _ in range(_MAX_RADIUS_STEPS):
            target = self._unconstrained_point()
            channels = zip(target, constraints, low, high, strict=True)
            solutions = [_nearest(*channel, self.weights) for channel in channels]
            nearest = np.stack([solution for solution, _ in solutions])
            self._active_constraints = [active for _, active in solutions]
            displacement = nearest - self.center
            distance = float(np.linalg.norm(displacement))
            missing = self.radius - distance
            is_inside = self._t == 1 and missing > 0
            is_on_sphere = abs(missing) <= _RADIUS_TOLERANCE * self.radius
            if is_inside or is_on_sphere:
                break
            arrays = zip(self._offset, nearest - target, self._active_constraints, strict=True)
            derivatives = [_differentiate(*channel) for channel in arrays]
            velocities, multipliers, rates = zip(*derivatives, strict=True)
            velocity = np.stack(velocities)
            # The change s of t with |x - c + s velocity| = r solves the quadratic equation
            # s² |velocity|² + 2 s slope = r² - |x - c|² = (r - |x - c|) (r + |x - c|).
            missing_squared = missing * (self.radius + distance)
            squared_speed = float((velocity * velocity).sum())
            slope = float((velocity * displacement).sum())
            root = math.sqrt(max(slope**2 + squared_speed * missing_squared, 0))
            step = (root - slope) / max(squared_speed, _TINY)
            # Keep t in its range.
            step = min(max(step, self._min_t - self._t), 1 - self._t)
            self._t += step
            # A constraint stays active if its multiplier does not become negative.
            if (np.concatenate(multipliers) + step * np.concatenate(rates) >= 0).all():
                # The same constraints stay active, so the solution is affine in t, and
                # the step is exact.
                displacement = displacement + step * velocity
                break
        # Rounding may leave the solution slightly outside of the ball.
        scale = min(1, self.radius / max(float(np.linalg.norm(displacement)), _TINY))
        self.nearest = self.center + displacement * scale


def _differentiate(offset: Array, correction: Array, active_rows: Array) -> tuple[Array, ...]:
    """Differentiate one channel of the solution of a `_QuadraticProgram` with respect to t.

    With the matrix R of the M active constraints, the solution is x = c + t (v − c) + Rᵀ μ, and R x
    = 0. The derivative of the multipliers μ is therefore the solution μ' of the least squares
    problem Rᵀ μ' ≈ −(v − c). `offset` is v − c, and `correction` is Rᵀ μ, from which μ is computed.
    The results are the derivative of x, μ and μ'.
    """
    right_sides = np.stack([-offset, correction], axis=1)
    rates, multipliers = np.linalg.lstsq(active_rows.T, right_sides)[0].T
    return offset + active_rows.T @ rates, multipliers, rates


def _nearest(
    original: Array, harmonics: Array, low: Array, high: Array, weights: Array | float
) -> tuple[Array, Array]:
    """Find the nearest light x with harmonics · x ≥ 0 and low ≤ x ≤ high.

    The distance is the length of the difference d = x - original, times the weights. The
    constraints are G d ≥ h with a matrix G and a vector h. A bound may be infinite. The result is x
    and the rows of `harmonics` with positive multipliers.
    """
    if not len(harmonics):
        return original, harmonics
    is_bounded = np.isfinite(low)
    axes = np.eye(len(original))[is_bounded]
    # Matrix G of the constraints G d ≥ h. First come the rows for the radiance in M
    # directions, then those for the lower bounds, and then those for the upper bounds.
    left_sides = np.concatenate([harmonics, axes, -axes])
    from_low = (low - original)[is_bounded]
    from_high = (original - high)[is_bounded]
    # Vector h of the constraints G d ≥ h, in the order of the rows of G.
    right_sides = np.concatenate([-harmonics @ original, from_low, from_high])
    norm = float(np.linalg.norm(original))
    direction, rest, multipliers = least_distance(left_sides / weights, right_sides / norm)
    if rest < _MIN_DEPTH**2:
        # Only one point satisfies the constraints, up to rounding.
        return original.clip(low, high), harmonics
    nearest = original + direction / rest * norm / weights
    return nearest.clip(low, high), harmonics[multipliers[: len(harmonics)] > 0]


def _find_negative_minima(
    lights: Array, rounding_radiance: Array, above_neighbors: float
) -> tuple[Array, Array]:
    """Find the directions in which the radiance of R lights has a negative local minimum.

    A light that is nowhere brighter than its `rounding_radiance` has none. The result is the
    index of the light of each minimum, and the harmonics in its direction (D, K).
    """
    degree = math.isqrt(lights.shape[1]) - 1
    subdivisions = _COARSE_SUBDIVISIONS if degree <= _COARSE_GRID_DEGREE else _FINE_SUBDIVISIONS
    grid_directions, grid_harmonics, grid_neighbors = _grid(degree, subdivisions)
    # Radiance of each light (rows) in each direction of the grid (columns).
    radiance = _product(lights, grid_harmonics)
    largest = np.abs(radiance).max(1)
    upper_limit = np.where(largest > rounding_radiance, _ABOVE_ZERO * largest, -np.inf)
    light_index, grid_index = np.nonzero(radiance < upper_limit[:, None])
    # Each of the six rows of `grid_neighbors` has one neighbor of every grid direction.
    for neighbors in grid_neighbors:
        neighbor_radiance = radiance[light_index, neighbors[grid_index]]
        margin = above_neighbors * largest[light_index]
        is_low = radiance[light_index, grid_index] <= neighbor_radiance + margin
        light_index = light_index[is_low]
        grid_index = grid_index[is_low]
    # SH coefficients of the 3 first and the 9 second derivatives of the light of each start
    # direction. Axes: start, derivative, coefficient.
    derivatives = _product(lights, _derivatives(degree)).reshape(len(lights), 3 + 9, -1)
    derivatives = derivatives[light_index]
    directions = grid_directions[grid_index]
    for _ in range(_NEWTON_STEPS):
        directions = _step_down(directions, derivatives)
    harmonics = _harmonics(directions, degree)
    lowest_radiance = (harmonics * lights[light_index]).sum(1)
    is_negative = lowest_radiance < -_MIN_DEPTH * largest[light_index]
    return light_index[is_negative], harmonics[is_negative]


def _step_down(directions: Array, derivatives: Array) -> Array:
    """Take a Newton step toward lower radiance on the sphere. `derivatives` is (D, 12, K)."""
    degree = math.isqrt(derivatives.shape[2]) - 1
    # Values of the derivatives in the directions, shape (D, 12, 1).
    values = derivatives @ _harmonics(directions, degree)[..., None]
    gradient = values[:, :3]
    hessian = values[:, 3:].reshape(-1, 3, 3)
    x, y, z = directions.T
    # Two unit tangents of the sphere for each direction, shape (D, 2, 3).
    tangents = np.array(tangent_axes(x, y, z, np.copysign(1, z))).transpose(2, 0, 1)
    # A path on the sphere bends toward the center, so the second derivative along the
    # path is the one in space minus the radial derivative.
    radial_derivative = directions[:, None] @ gradient
    sphere_hessian = tangents @ hessian @ tangents.mT - radial_derivative * np.eye(2)
    curvature, eigenvectors = np.linalg.eigh(sphere_hessian)
    # The two unit tangents along which `curvature` holds the second derivatives.
    principal_axes = eigenvectors.mT @ tangents
    slope = (principal_axes @ gradient)[..., 0]
    # A Newton step is the slope divided by the curvature. This lower limit of the divisor
    # keeps the step shorter than _MAX_ANGLE.
    smallest_divisor = np.linalg.norm(slope, axis=1, keepdims=True) / _MAX_ANGLE
    # The absolute value makes the step lead downward where the curvature is negative.
    divisor = np.maximum(np.abs(curvature), smallest_divisor)
    step = (slope / np.maximum(divisor, _TINY))[:, None] @ principal_axes
    moved = directions - step[:, 0]
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _harmonics(directions: Array, degree: int) -> Array:
    """Evaluate all spherical harmonics up to a degree, in few directions.

    A factor x² + y² + z² is 1 on the unit sphere, and raises the degree of a
    polynomial by 2. So each harmonic equals a homogeneous polynomial of degree
    `degree` or `degree` - 1 in x, y and z. For few directions, this is faster than
    `harmonics.evaluate_harmonics`. The result has one row for each direction.
    """
    exponents, coefficients = _polynomials(degree)
    # Powers 0 to degree of x, y and z of D directions, shape (degree + 1, 3, D).
    powers = np.ones((degree + 1, *directions.T.shape))
    for power in range(degree):
        powers[power + 1] = powers[power] * directions.T
    x_powers, y_powers, z_powers = powers.transpose(1, 0, 2)
    # One row for each monomial x^a y^b z^c, one column for each direction.
    monomials = x_powers[exponents[0]] * y_powers[exponents[1]] * z_powers[exponents[2]]
    return _product(monomials.T, coefficients)


@cache_tensors
def _polynomials(degree: int) -> tuple[Array, Array]:
    """Express the spherical harmonics on the unit sphere by J monomials x^a y^b z^c.

    The monomials have a + b + c = degree or a + b + c = degree - 1. Harmonics of
    bands with the same parity as `degree` only need the first kind, and the other
    harmonics only need the second kind. The result is the exponents a, b and c, shape (3, J), and
    the coefficients of the monomials in the K harmonics, shape (J, K).
    """
    exponents = []
    coefficients = []
    # The order of the exponents is that of the rows of `monomial_coefficients`.
    for total in range(degree, max(degree - 2, -1), -1):
        for a in range(total, -1, -1):
            exponents += [(a, b, total - a - b) for b in range(total - a, -1, -1)]
        # Monomials of degree `total` only express harmonics whose degree has the same
        # parity (even or odd) as `total`. Set the columns of all others to 0.
        homogeneous = monomial_coefficients(total) * ((bands(total) - total) % 2 == 0)
        coefficients.append(F.pad(homogeneous, (0, (degree + 1) ** 2 - homogeneous.shape[1])))
    return np.array(exponents).T, torch.cat(coefficients).numpy()


@cache_tensors
def _derivatives(degree: int) -> Array:
    """Return the matrix (K, 12 K) to the coefficients of the 3 first, then 9 second derivatives."""
    # The shapes are (3, K, K) for the first and (9, K, K) for the second derivatives.
    first = gradient_matrices(degree)
    second = (first[:, None] @ first).flatten(0, 1)
    return torch.cat([first, second]).flatten(0, 1).T.contiguous().numpy()


@cache_tensors
def _grid(degree: int, subdivisions: int) -> tuple[Array, Array, Array]:
    """Create the grid of N directions in which negative radiance is searched.

    They are the vertices of an icosphere. The results are unit vectors, shape (N, 3), the K
    harmonics in each direction, shape (K, N), and the indices of the six neighbors of each
    direction, shape (6, N). Twelve directions have only five. One of these occurs twice.
    """
    # trimesh is imported here because the import takes half a second.
    from trimesh.creation import icosphere

    sphere = icosphere(subdivisions)
    # A vertex has 5 or 6 neighbors. If it has 5, the first one is repeated.
    neighbors = [[*around, *around[:1]][:6] for around in sphere.vertex_neighbors]
    directions = np.array(sphere.vertices)
    harmonics = np.ascontiguousarray(_harmonics(directions, degree).T)
    return directions, harmonics, np.array(neighbors).T


def _product(left: Array, right: Array) -> Array:
    """Multiply matrices in torch, as threads of NumPy's BLAS would spin beside those of torch."""
    return (torch.from_numpy(left) @ torch.from_numpy(right)).numpy()
