"""Base class of attacks on one of the lights of a scene, such as its environment."""

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
    """Attack on all RGB coefficients of one light, such as the environment or the projector.

    The attack starts at the light of the scene. If radiance must not be
    negative, the start is the nearest light without negative radiance that has
    the same mean. Each step then ends in the nearest coefficients that lie in
    the norm-ball and have no negative radiance.
    """

    def __init__(
        self,
        scene: Scene,
        settings: StepSettings,
        rows: slice,
        basis: Harmonics | LocalBasis,
        nonnegative: bool,
    ):
        """Compute the light at which the attack starts.

        Args:
            scene: Scene to attack. Its other lights stay as they are.
            settings: Norm-ball and steps of the attack.
            rows: Rows of this light in the coefficients of all lights of the scene,
                shape (size of the scene's basis, 3).
            basis: Basis of this light.
            nonnegative: Whether radiance must not be negative. It is always True
                for projectors and lamps.
        """
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
            values: Red, green and blue of the K coefficients of this light in each of A examples,
                shape (A, 3 K).
            conditions: Light, shape and colors of the A examples.
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
        # RGB of each of the K coefficients, shape (A, K, 3).
        coefficients = values.unflatten(1, (-1, 3))
        ball = None if within is None else within.unflatten(-1, 3)
        return self._basis.nearest_nonnegative(coefficients, ball).flatten(1)


def environment_light(scene: Scene) -> tuple[slice, Harmonics | LocalBasis]:
    """Find the environment lighting among the lights of a scene.

    Args:
        scene: Scene with environment lighting, and possibly with a projector
            or lamps.

    Returns:
        Rows of the environment lighting in the coefficients of all lights, and
        the basis of the environment lighting.
    """
    # `parts_of` returns one pair for each light. The environment comes first.
    lights = parts_of(scene.basis)
    return lights[0]


def replace_light(conditions: Conditions, rows: slice, coefficients: Tensor) -> Conditions:
    """Return a copy of the conditions with other coefficients for one light.

    Args:
        conditions: Light, shape and colors of A examples.
        rows: Rows of the replaced light in the coefficients of all lights.
        coefficients: New RGB coefficients of this light, shape (A, K, 3).

    Returns:
        Conditions in which all other lights are the same.
    """
    all_lights = conditions.light
    # A scene with a single light needs no concatenation.
    if coefficients.shape[1] == all_lights.shape[1]:
        return replace(conditions, light=coefficients)
    before = all_lights[:, : rows.start]
    after = all_lights[:, rows.stop :]
    return replace(conditions, light=torch.cat([before, coefficients, after], dim=1))
