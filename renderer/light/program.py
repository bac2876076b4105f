"""Solver for least distance programs: the shortest vector that satisfies linear inequalities."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

# `shortest` stops if the inequalities hold up to this error, relative to the largest
# magnitude of their right sides, and if the duality gap is at most this fraction of the
# squared length of y. The gap is the sum of the products of slacks and multipliers.
_TOLERANCE = 1e-9
# For `shortest` to stop, y = sidesᵀ multipliers must also hold up to this error,
# relative to the length of y.
_STATIONARITY_TOLERANCE = 1e-6
# Largest number of steps of `shortest`. 15 to 40 are usual.
_MAX_STEPS = 80
# A step goes this fraction of the way to the point at which a slack or a multiplier
# becomes 0.
_FRACTION_TO_BOUNDARY = 0.99
# Start value of the slacks (at least this), and approximate start value of the products
# of multipliers and squared rows of `sides`.
_START = 0.1


def shortest(sides: Array, least: Array) -> Array:
    """Find the shortest vector y with `sides` y ≥ `least`.

    This is a convex quadratic program. With slacks s = sides y - least and
    multipliers μ, the vector y is optimal if y = sidesᵀ μ, s ≥ 0, μ ≥ 0, and
    s_i μ_i = 0 for each inequality i. The predictor-corrector method solves
    these conditions (Mehrotra 1992, "On the implementation of a primal-dual
    interior point method"). The computing time does not depend on how many
    inequalities hold with equality.

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
            # Near the optimum, multipliers divided by slacks may differ so much in
            # magnitude that rounding errors prevent another step.
            break
    return iterate.y * scale


@dataclass(frozen=True)
class _Change:
    """Changes of the vectors of an `_Iterate` in one step of length 1.

    Attributes:
        y: Change of y, shape (n,).
        slacks: Change of the slacks, shape (M,).
        multipliers: Change of the multipliers, shape (M,).
    """

    y: Array
    slacks: Array
    multipliers: Array


class _Iterate:
    """Current vectors of the predictor-corrector method, and how far they are from optimal.

    Attributes:
        y: Approximation of the shortest vector, shape (n,).
        slacks: Positive slack of each of the M inequalities, shape (M,).
        multipliers: Positive multiplier of each inequality, shape (M,).
        dual_residual: y - sidesᵀ multipliers, shape (n,).
        primal_residual: sides y - slacks - least, shape (M,).
        gap: Sum of the products of slacks and multipliers.

    Args:
        sides: Left sides of the inequalities sides y ≥ least, shape (M, n).
        least: Right sides, shape (M,).
    """

    def __init__(self, sides: Array, least: Array):
        """Start with y = 0, and with positive slacks and multipliers."""
        self._sides = sides
        self._least = least
        self.y = np.zeros(sides.shape[1])
        self.slacks = np.maximum(-least, _START)
        self.multipliers = np.full(len(sides), _START / np.square(sides).sum(1).mean())
        self._compute_residuals()

    def _compute_residuals(self) -> None:
        """Compute `dual_residual`, `primal_residual` and `gap` from the current vectors."""
        self.dual_residual = self.y - self._sides.T @ self.multipliers
        self.primal_residual = self._sides @ self.y - self.slacks - self._least
        self.gap = self.slacks @ self.multipliers

    def is_optimal(self) -> bool:
        """Tell whether all conditions of optimality hold up to their tolerances."""
        limit = _STATIONARITY_TOLERANCE * np.linalg.norm(self.y)
        is_gap_closed = self.gap < _TOLERANCE * (self.y @ self.y)
        is_stationary = np.linalg.norm(self.dual_residual) < limit
        is_feasible = np.abs(self.primal_residual).max() < _TOLERANCE
        return bool(is_gap_closed and is_stationary and is_feasible)

    def step(self) -> None:
        """Change y, the slacks and the multipliers by one predictor-corrector step.

        The predictor is a Newton step toward products of slacks and multipliers
        that are 0. The corrector is a Newton step toward products that are equal
        and positive. The longer the predictor could be, the smaller these
        products are. The corrector also removes the second-order error of the
        predictor.

        Raises:
            LinAlgError: If the linear system is not positive definite.
        """
        # Cholesky factor of I + sidesᵀ diag(multipliers / slacks) sides.
        weighted_sides = self._sides * np.sqrt(self.multipliers / self.slacks)[:, None]
        matrix = weighted_sides.T @ weighted_sides + np.eye(len(self.y))
        factor = cho_factor(matrix, overwrite_a=True, check_finite=False)

        products = self.slacks * self.multipliers
        predictor = self._newton_change(factor, products)
        predictor_length = self._longest_step(predictor)
        predicted_slacks = self.slacks + predictor_length * predictor.slacks
        predicted_multipliers = self.multipliers + predictor_length * predictor.multipliers
        predicted_gap = predicted_slacks @ predicted_multipliers

        # The corrector moves each product of a slack and its multiplier toward this value.
        centering = (predicted_gap / self.gap) ** 3 * self.gap / len(self._sides)
        second_order = predictor.slacks * predictor.multipliers
        corrector = self._newton_change(factor, products + second_order - centering)
        length = min(_FRACTION_TO_BOUNDARY * self._longest_step(corrector), 1)
        self.y = self.y + length * corrector.y
        self.slacks = self.slacks + length * corrector.slacks
        self.multipliers = self.multipliers + length * corrector.multipliers
        self._compute_residuals()

    def _newton_change(self, factor: tuple[Array, bool], products: Array) -> _Change:
        """Compute a Newton step that makes the residuals zero and reduces products.

        To first order, the step makes `dual_residual` and `primal_residual` zero,
        and reduces the products of slacks and multipliers by `products`.

        Args:
            factor: Cholesky factor of
                I + sidesᵀ diag(multipliers / slacks) sides, from cho_factor.
            products: Numbers by which the products are reduced, shape (M,).

        Returns:
            Changes of y, the slacks and the multipliers.
        """
        eliminated = (self.multipliers * self.primal_residual + products) / self.slacks
        right_side = -self.dual_residual - self._sides.T @ eliminated
        y_change = cho_solve(factor, right_side, check_finite=False)
        slack_change = self._sides @ y_change + self.primal_residual
        multiplier_change = -(products + self.multipliers * slack_change) / self.slacks
        return _Change(y=y_change, slacks=slack_change, multipliers=multiplier_change)

    def _longest_step(self, change: _Change) -> float:
        """Compute the longest step along a change at which no slack or multiplier is negative.

        Args:
            change: Change of the vectors in a step of length 1.

        Returns:
            Length of the step, at most 1 / _FRACTION_TO_BOUNDARY.
        """
        # Largest decrease of a slack, and of a multiplier, relative to its value.
        slack_decrease = (-change.slacks / self.slacks).max()
        multiplier_decrease = (-change.multipliers / self.multipliers).max()
        return 1 / max(slack_decrease, multiplier_decrease, _FRACTION_TO_BOUNDARY)
