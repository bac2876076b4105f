"""Solver for least distance programs: the shortest vector that satisfies linear inequalities."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

# `shortest` stops if two errors are at most this number. The first is the violation of the
# inequalities, relative to their right sides. The second is the duality gap (the sum of
# the products of slacks and multipliers), relative to the squared length of y.
_TOLERANCE = 1e-9
# At the optimum, the shortest vector y is matrixᵀ multipliers. `shortest` only stops if the
# length of the difference is at most this number times the length of y.
_STATIONARITY_TOLERANCE = 1e-6
# Largest number of steps of `shortest`. 15 to 40 are usual.
_MAX_STEPS = 80
# A step goes this fraction of the way to the point at which a slack or a multiplier
# becomes 0.
_FRACTION_TO_BOUNDARY = 0.99
# Smallest slack at the start of `shortest`. The multipliers start with this number,
# divided by the mean squared length of a row of the matrix.
_START = 0.1


def shortest(matrix: Array, lower_bounds: Array) -> Array:
    """Find the shortest vector y with `matrix` y ≥ `lower_bounds`.

    This is a convex quadratic program. With slacks s = matrix y - lower_bounds
    and multipliers μ, the vector y is optimal if y = matrixᵀ μ, s ≥ 0, μ ≥ 0, and
    s_i μ_i = 0 for each inequality i. The predictor-corrector method solves
    these conditions (Mehrotra 1992, "On the implementation of a primal-dual
    interior point method"). The computing time does not depend on how many
    inequalities hold with equality. Some y must satisfy all inequalities strictly, and y = 0 must
    violate one of them. They hold up to 10⁻⁹ of the largest bound.
    """
    scale = np.abs(lower_bounds).max()
    iterate = _Iterate(matrix, lower_bounds / scale)
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
    """Direction of a step of the method that finds the shortest vector y.

    A step of length λ adds λ times these changes to the current vectors.

    Attributes:
        y: Change of y, shape (n,).
        slacks: Change of the slacks of the M inequalities, shape (M,).
        multipliers: Change of their multipliers, shape (M,).
    """

    y: Array
    slacks: Array
    multipliers: Array


class _Iterate:
    """Current vectors of the predictor-corrector method of `shortest`.

    The method finds the shortest y with matrix y ≥ lower_bounds. At the optimum,
    both residuals and the gap are 0.

    Attributes:
        y: Approximation of the shortest vector, shape (n,).
        slacks: Positive slack of each of the M inequalities, shape (M,).
        multipliers: Positive multiplier of each inequality, shape (M,).
        dual_residual: y - matrixᵀ multipliers, shape (n,).
        primal_residual: matrix y - slacks - lower_bounds, shape (M,).
        gap: Sum of the products of slacks and multipliers.

    Args:
        matrix: Left sides of the inequalities, shape (M, n).
        lower_bounds: Right sides of the inequalities, shape (M,).
    """

    def __init__(self, matrix: Array, lower_bounds: Array):
        """Start with y = 0, positive slacks and equal positive multipliers."""
        self._matrix = matrix
        self._lower_bounds = lower_bounds
        self.y = np.zeros(matrix.shape[1])
        self.slacks = np.maximum(-lower_bounds, _START)
        self.multipliers = np.full(len(matrix), _START / np.square(matrix).sum(1).mean())
        self._compute_residuals()

    def _compute_residuals(self) -> None:
        """Compute how far y, the slacks and the multipliers are from the optimum.

        At the optimum, `dual_residual`, `primal_residual` and `gap` are 0.
        """
        self.dual_residual = self.y - self._matrix.T @ self.multipliers
        self.primal_residual = self._matrix @ self.y - self.slacks - self._lower_bounds
        self.gap = self.slacks @ self.multipliers

    def is_optimal(self) -> bool:
        """Tell whether the gap and both residuals are 0, up to their tolerances."""
        limit = _STATIONARITY_TOLERANCE * np.linalg.norm(self.y)
        is_gap_closed = self.gap < _TOLERANCE * (self.y @ self.y)
        is_stationary = np.linalg.norm(self.dual_residual) < limit
        is_feasible = np.abs(self.primal_residual).max() < _TOLERANCE
        return bool(is_gap_closed and is_stationary and is_feasible)

    def step(self) -> None:
        """Change y, the slacks and the multipliers by one predictor-corrector step.

        The method finds the shortest vector y that satisfies inequalities. A slack
        tells how much an inequality could be tightened. At the optimum, the product
        s_i μ_i of the slack and the multiplier of each inequality i is 0.

        The predictor is a Newton step toward products of 0. It is not taken. Its
        length, up to which no slack or multiplier is negative, decides how small the
        products shall become: the longer, the smaller. The corrector is a Newton
        step toward these equal, positive products. It also removes the second-order
        error of the predictor.
        """
        weighted_rows = self._matrix * np.sqrt(self.multipliers / self.slacks)[:, None]
        system = weighted_rows.T @ weighted_rows + np.eye(len(self.y))
        factor = cho_factor(system, overwrite_a=True, check_finite=False)

        products = self.slacks * self.multipliers
        predictor = self._newton_change(factor, products)
        predictor_length = self._longest_step(predictor)
        predicted_slacks = self.slacks + predictor_length * predictor.slacks
        predicted_multipliers = self.multipliers + predictor_length * predictor.multipliers
        predicted_gap = predicted_slacks @ predicted_multipliers

        # The corrector moves each product of a slack and its multiplier toward this value.
        target_product = (predicted_gap / self.gap) ** 3 * self.gap / len(self._matrix)
        second_order = predictor.slacks * predictor.multipliers
        corrector = self._newton_change(factor, products + second_order - target_product)
        length = min(_FRACTION_TO_BOUNDARY * self._longest_step(corrector), 1)
        self.y = self.y + length * corrector.y
        self.slacks = self.slacks + length * corrector.slacks
        self.multipliers = self.multipliers + length * corrector.multipliers
        self._compute_residuals()

    def _newton_change(self, factor: tuple[Array, bool], reductions: Array) -> _Change:
        """Compute a Newton step that makes the residuals zero and reduces products.

        To first order, the step makes `dual_residual` and `primal_residual` zero,
        and reduces the products of slacks and multipliers by `reductions`.
        """
        # Eliminating the slacks and the multipliers leaves a linear system for y.
        eliminated = (self.multipliers * self.primal_residual + reductions) / self.slacks
        right_side = -self.dual_residual - self._matrix.T @ eliminated
        y_change = cho_solve(factor, right_side, check_finite=False)
        slack_change = self._matrix @ y_change + self.primal_residual
        multiplier_change = -(reductions + self.multipliers * slack_change) / self.slacks
        return _Change(y=y_change, slacks=slack_change, multipliers=multiplier_change)

    def _longest_step(self, change: _Change) -> float:
        """Compute how long a step may be, so that no slack or multiplier becomes negative."""
        # Largest fraction of its value that a slack loses in a step of length 1.
        slack_decrease = (-change.slacks / self.slacks).max()
        multiplier_decrease = (-change.multipliers / self.multipliers).max()
        return 1 / max(slack_decrease, multiplier_decrease, _FRACTION_TO_BOUNDARY)
