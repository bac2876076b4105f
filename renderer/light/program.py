"""A solver for least distance programs: the shortest vector that satisfies linear inequalities."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

# `shortest` stops if the errors of the inequalities and of the duality gap, the sum
# of the products of slacks and multipliers, are at most this fraction.
_TOLERANCE = 1e-9
# It also requires that y = sidesᵀ multipliers holds up to this relative error.
_STATIONARITY_TOLERANCE = 1e-6
# Steps of the method. 15 to 40 are usual.
_MAX_STEPS = 80
# A step goes this fraction of the way to where a slack or a multiplier is zero.
_FRACTION_TO_BOUNDARY = 0.99
# Every slack and the mean multiplier start at about this value.
_START = 0.1


def shortest(sides: Array, least: Array) -> Array:
    """Find the shortest vector y with `sides` y ≥ `least`.

    This is a convex quadratic program. With slacks s = sides y - least and
    multipliers μ, its conditions of optimality are y = sidesᵀ μ, s ≥ 0, μ ≥ 0
    and s μ = 0. They are solved by the predictor-corrector method (Mehrotra
    1992, "On the implementation of a primal-dual interior point method"). Its
    time does not depend on how many inequalities hold with equality.

    Args:
        sides: Left sides of M ≥ 1 inequalities, shape (M, n).
        least: Right sides, shape (M,). Some y must satisfy all inequalities
            strictly, and y = 0 must violate one of them.

    Returns:
        The vector y, shape (n,). The inequalities hold up to 10⁻⁹ of the
        largest magnitude in `least`.

    Example:
        >>> sides = np.array([[1.0, 0.0], [1.0, 1.0]])
        >>> shortest(sides, np.array([1.0, 3.0])).round(6).tolist()
        [1.5, 1.5]
    """
    scale = np.abs(least).max()
    iterate = _Iterate(sides, least / scale)
    for _ in range(_MAX_STEPS):
        if iterate.is_optimal():
            break
        try:
            iterate.step()
        except np.linalg.LinAlgError:
            # Near the optimum, the ratios of multipliers and slacks may differ
            # by more than rounding allows, so that no step can be computed.
            break
    return iterate.y * scale


@dataclass(frozen=True)
class _Change:
    """Changes of y (n,), of the slacks (M,) and of the multipliers (M,)."""

    y: Array
    slacks: Array
    multipliers: Array


class _Iterate:
    """The vectors of the method, and the residuals of the conditions at them.

    Attributes:
        y: The vector that is sought, shape (n,).
        slacks: Positive slacks, shape (M,).
        multipliers: Positive multipliers, shape (M,).
        dual_residual: y - sidesᵀ multipliers, shape (n,).
        primal_residual: sides y - slacks - least, shape (M,).
        gap: Sum of the products of slacks and multipliers.
    """

    def __init__(self, sides: Array, least: Array):
        self._sides = sides
        self._least = least
        self.y = np.zeros(sides.shape[1])
        self.slacks = np.maximum(-least, _START)
        self.multipliers = np.full(len(sides), _START / np.square(sides).sum(1).mean())
        self._compute_residuals()

    def _compute_residuals(self) -> None:
        """Compute the residuals and the gap at the current vectors."""
        self.dual_residual = self.y - self._sides.T @ self.multipliers
        self.primal_residual = self._sides @ self.y - self.slacks - self._least
        self.gap = self.slacks @ self.multipliers

    def is_optimal(self) -> bool:
        """Return whether all conditions hold up to their tolerances."""
        limit = _STATIONARITY_TOLERANCE * np.linalg.norm(self.y)
        is_gap_closed = self.gap < _TOLERANCE * (self.y @ self.y)
        is_stationary = np.linalg.norm(self.dual_residual) < limit
        is_feasible = np.abs(self.primal_residual).max() < _TOLERANCE
        return bool(is_gap_closed and is_stationary and is_feasible)

    def step(self) -> None:
        """Take a predictor-corrector step.

        The predictor aims at products of slacks and multipliers of zero. The
        corrector aims at equal products, which are smaller the further the
        predictor could go. It also removes the predictor's second-order error.

        Raises:
            LinAlgError: If the linear system is not positive definite.
        """
        weighted = self._sides * np.sqrt(self.multipliers / self.slacks)[:, None]
        matrix = weighted.T @ weighted + np.eye(len(self.y))
        factor = cho_factor(matrix, overwrite_a=True, check_finite=False)
        products = self.slacks * self.multipliers
        predictor = self._newton_change(factor, products)
        length = self._longest_step(predictor)
        predicted_slacks = self.slacks + length * predictor.slacks
        predicted_multipliers = self.multipliers + length * predictor.multipliers
        predicted_gap = predicted_slacks @ predicted_multipliers
        centering = (predicted_gap / self.gap) ** 3 * self.gap / len(self._sides)
        second_order = predictor.slacks * predictor.multipliers
        change = self._newton_change(factor, products + second_order - centering)
        length = min(_FRACTION_TO_BOUNDARY * self._longest_step(change), 1)
        self.y = self.y + length * change.y
        self.slacks = self.slacks + length * change.slacks
        self.multipliers = self.multipliers + length * change.multipliers
        self._compute_residuals()

    def _newton_change(self, factor: tuple[Array, bool], products: Array) -> _Change:
        """Return the changes that make both residuals and the products (M,) zero to first order.

        `factor` is the Cholesky factor of
        I + sidesᵀ diag(multipliers / slacks) sides.
        """
        weighted = (self.multipliers * self.primal_residual + products) / self.slacks
        right_side = -self.dual_residual - self._sides.T @ weighted
        change_of_y = cho_solve(factor, right_side, check_finite=False)
        change_of_slacks = self._sides @ change_of_y + self.primal_residual
        change_of_multipliers = -(products + self.multipliers * change_of_slacks) / self.slacks
        return _Change(change_of_y, change_of_slacks, change_of_multipliers)

    def _longest_step(self, change: _Change) -> float:
        """Return the longest step at which no slack and no multiplier is negative.

        The result is at most 1 / _FRACTION_TO_BOUNDARY.
        """
        of_slacks = (-change.slacks / self.slacks).max()
        of_multipliers = (-change.multipliers / self.multipliers).max()
        return 1 / max(of_slacks, of_multipliers, _FRACTION_TO_BOUNDARY)
