"""Base class of attacks on one of the lights of a scene, such as its environment."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
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
        """Compute the light at which the attack starts."""
        self._rows = rows
        self._basis = basis
        self._nonnegative = nonnegative or not basis.allow_negative
        initial_light = scene.lights[:, rows]
        if self._nonnegative:
            initial_light = basis.project_nonnegative(initial_light)
        super().__init__(settings, start=initial_light.flatten(1))

    def apply(
        self, values: Float[Tensor, "A D"], conditions: Conditions, examples: Tensor
    ) -> Conditions:
        """Return a copy of the conditions with other coefficients of this light."""
        return replace_light(conditions, self._rows, values.unflatten(1, (-1, 3)))

    def project_feasible(
        self, values: Float[Tensor, "A D"], within: Ball | None = None
    ) -> Float[Tensor, "A D"]:
        """Find the nearest coefficients whose radiance is not negative."""
        if not self._nonnegative:
            return super().project_feasible(values, within)
        # RGB of each of the K coefficients, shape (A, K, 3).
        coefficients = values.unflatten(1, (-1, 3))
        ball = None if within is None else within.unflatten(-1, 3)
        return self._basis.nearest_nonnegative(coefficients, ball).flatten(1)


def environment_light(scene: Scene) -> tuple[slice, Harmonics | LocalBasis]:
    """Find the environment lighting among the lights of a scene.

    Return its rows in the coefficients of all lights, and its basis.
    """
    # `parts_of` returns one pair for each light. The environment comes first.
    lights = parts_of(scene.basis)
    return lights[0]


def replace_light(
    conditions: Conditions, rows: slice, coefficients: Float[Tensor, "A K 3"]
) -> Conditions:
    """Return a copy of the conditions with other coefficients for one light.

    `rows` are the rows of this light in the coefficients of all lights.
    """
    all_lights = conditions.light
    # A scene with a single light needs no concatenation.
    if coefficients.shape[1] == all_lights.shape[1]:
        return replace(conditions, light=coefficients)
    before = all_lights[:, : rows.start]
    after = all_lights[:, rows.stop :]
    return replace(conditions, light=torch.cat([before, coefficients, after], dim=1))
