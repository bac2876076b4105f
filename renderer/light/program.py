"""A convex quadratic program with inequalities alone: the shortest vector that satisfies them."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

_TOLERANCE = 1e-9
_STEPS = 80  # 15 to 40 are usual
_SHORT_OF_EDGE = 0.99  # of the way to where a slack or a multiplier is zero


def shortest(sides: Array, least: Array) -> Array:
    """The y (n,) of smallest |y| with `sides` y ≥ `least`.

    With slacks s = sides y - least and multipliers μ, the conditions of optimality are y = sidesᵀ μ, s ≥ 0, μ ≥ 0 and
    s μ = 0. The predictor-corrector method (Mehrotra 1992, "On the implementation of a primal-dual interior point
    method") solves them; its time does not depend on how many of the inequalities are equalities in the end.

    Args:
        sides: (M, n), with M ≥ 1 rows.
        least: (M,). Some y satisfies all inequalities strictly, and y = 0 does not satisfy all of them.

    Returns:
        (n,) up to 10⁻⁹ of the largest value of `least`.
    """
    scale = np.abs(least).max()
    least = least / scale
    y = np.zeros(sides.shape[1])
    slacks = np.maximum(-least, 0.1)
    multipliers = np.full(len(sides), 0.1 / np.square(sides).sum(1).mean())
    for _ in range(_STEPS):
        unlike = y - sides.T @ multipliers
        outside = sides @ y - slacks - least
        gap = slacks @ multipliers
        optimal = gap < _TOLERANCE * (y @ y) and np.linalg.norm(unlike) < 1e-6 * np.linalg.norm(y)
        if optimal and np.abs(outside).max() < _TOLERANCE:
            break
        weighted = sides * np.sqrt(multipliers / slacks)[:, None]
        try:
            factor = cho_factor(weighted.T @ weighted + np.eye(len(y)), overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:  # the weights differ by more than rounding allows: the optimum is near
            break
        state = factor, sides, slacks, multipliers, unlike, outside
        _, of_slacks, of_multipliers = _newton_step(*state, slacks * multipliers)
        length = _step_length(slacks, multipliers, of_slacks, of_multipliers)
        predicted = (slacks + length * of_slacks) @ (multipliers + length * of_multipliers)
        centering = (predicted / gap) ** 3 * gap / len(sides)
        products = slacks * multipliers + of_slacks * of_multipliers - centering
        of_y, of_slacks, of_multipliers = _newton_step(*state, products)
        length = min(_SHORT_OF_EDGE * _step_length(slacks, multipliers, of_slacks, of_multipliers), 1)
        y = y + length * of_y
        slacks = slacks + length * of_slacks
        multipliers = multipliers + length * of_multipliers
    return y * scale


def _newton_step(
    factor: tuple[Array, bool],
    sides: Array,
    slacks: Array,
    multipliers: Array,
    unlike: Array,
    outside: Array,
    products: Array,
) -> tuple[Array, Array, Array]:
    """Return the changes of y, slacks and multipliers that make both residuals and the products (M,) zero.

    They do so to first order. The factor is Cholesky's of I + sidesᵀ diag(multipliers / slacks) sides.
    """
    right = -unlike - sides.T @ ((multipliers * outside + products) / slacks)
    of_y = cho_solve(factor, right, check_finite=False)
    of_slacks = sides @ of_y + outside
    return of_y, of_slacks, -(products + multipliers * of_slacks) / slacks


def _step_length(slacks: Array, multipliers: Array, of_slacks: Array, of_multipliers: Array) -> float:
    """Return the longest step with which slacks and multipliers stay positive, at most 1 / _SHORT_OF_EDGE."""
    shrinking = max((-of_slacks / slacks).max(), (-of_multipliers / multipliers).max())
    return 1 / max(shrinking, _SHORT_OF_EDGE)
