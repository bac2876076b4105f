"""Base class of attacks on one of the lights of a scene, and where this light is among all."""

from dataclasses import replace

import torch
from torch import Tensor

from augment.attacks.parameters.parameter import Parameter
from augment.parameter_settings import StepSettings
from augment.scene.conditions import Conditions
from augment.scene.scene import Scene
from renderer.light.ball import Ball
from renderer.light.basis import Harmonics, LocalBasis, parts_of


class LightParameter(Parameter):
    """All RGB coefficients of one light of a scene, such as its environment or its projector.

    The attack starts at the light of each example. If radiance must not be
    negative, it starts at `project_nonnegative` of this light, which has the
    same mean. Each step then ends in the nearest coefficients whose radiance is
    not negative and that lie in the norm-ball. Their mean may differ from the
    mean that the step asked for, because the ball need not contain a
    non-negative light of that mean.

    Args:
        scene: Scene to attack. Its other lights stay as they are.
        settings: Norm-ball and steps of the attack.
        rows: Rows of this light among the coefficients of all lights of the
            scene, shape (size of the scene's basis, 3).
        basis: Basis of this light.
        nonnegative: Whether radiance must not be negative. Projectors and lamps
            never have negative radiance, whatever is given here.
    """

    def __init__(
        self,
        scene: Scene,
        settings: StepSettings,
        rows: slice,
        basis: Harmonics | LocalBasis,
        nonnegative: bool,
    ):
        self._rows = rows
        self._basis = basis
        self._nonnegative = nonnegative or not basis.allow_negative
        initial_light = scene.lights[:, rows]
        if self._nonnegative:
            initial_light = basis.project_nonnegative(initial_light)
        super().__init__(settings, start=initial_light.flatten(1))

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        """Return a copy of the conditions with other coefficients of this light.

        Args:
            values: Red, green and blue of the K coefficients of this light, shape (A, 3 K).
            conditions: Conditions of the A examples.
            examples: Not used. All parameters have this argument.

        Returns:
            Conditions with the light, differentiable with respect to the values.
        """
        return replace_light(conditions, self._rows, values.unflatten(1, (-1, 3)))

    def project_feasible(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest coefficients whose radiance is not negative.

        Args:
            values: Red, green and blue of the K coefficients, shape (A, 3 K).
            within: Norm-ball that must contain the result, or None.

        Returns:
            Feasible values, shape (A, 3 K). If radiance may be negative, all values are
            feasible.
        """
        if not self._nonnegative:
            return super().project_feasible(values, within)
        # Shape (A, K, 3).
        coefficients = values.unflatten(1, (-1, 3))
        ball = None if within is None else within.unflatten(-1, 3)
        return self._basis.nearest_nonnegative(coefficients, ball).flatten(1)


def environment_light(scene: Scene) -> tuple[slice, Harmonics | LocalBasis]:
    """Find the environment lighting among the lights of a scene.

    Args:
        scene: Scene with environment lighting.

    Returns:
        Rows of the environment lighting among the coefficients of all lights,
        and the basis of the environment lighting.
    """
    # The environment lighting is the first part of the basis of all lights.
    parts = parts_of(scene.basis)
    return parts[0]


def replace_light(conditions: Conditions, rows: slice, coefficients: Tensor) -> Conditions:
    """Return a copy of the conditions with other coefficients for one light.

    Args:
        conditions: Conditions of A examples.
        rows: Rows of the replaced light among the coefficients of all lights.
        coefficients: New coefficients of this light, shape (A, its size, 3).

    Returns:
        Conditions in which the coefficients of all other lights are the same.
    """
    all_lights = conditions.light
    # A scene with a single light needs no concatenation.
    if coefficients.shape[1] == all_lights.shape[1]:
        return replace(conditions, light=coefficients)
    before = all_lights[:, : rows.start]
    after = all_lights[:, rows.stop :]
    return replace(conditions, light=torch.cat([before, coefficients, after], dim=1))
