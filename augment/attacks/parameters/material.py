"""Attacks on the material of an object: its specular reflection and the hue of its albedo."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from augment.attacks.parameters.parameter import Parameter
from augment.parameter_settings import MaterialSettings
from augment.scene.conditions import Conditions
from augment.scene.materials import METALLIC, initial_materials
from augment.scene.scene import Scene
from renderer.light.ball import Ball, nearest_in_box
from renderer.settings import MIN_ROUGHNESS

# Positions among the four attack values of an example (`MATERIAL`): roughness,
# metallic and specular factor together, and the hue.
GLOSS = slice(0, 3)
HUE = slice(3, 4)

# `Material` keeps average roughness, metallic and specular factor this far from 0 and
# 1, because the renderer clamps there, which makes the gradient zero.
ROUNDING = 1e-6


class Material(Parameter):
    """Roughness, metallic and specular factor of an object, averaged over its faces, and its hue.

    The four values of an example are divided by the units of
    `MaterialSettings`. An attack changes all faces of the object by the same
    amount, so differences between faces remain. The averages stay in [0, 1],
    and the roughness does not fall below the lowest value that the renderer
    shows.

    A matte object starts with the material `SPECULAR_LAYER`. Otherwise its strength
    would be zero, and so would the gradient with respect to its roughness. A
    descent that lowers the strength would stay there.

    Args:
        scene: Scene to attack. Props and table stay as they are.
        settings: Norm-ball, steps and units of the attack.
    """

    name = "material"
    fits_other_meshes = False

    def __init__(self, scene: Scene, settings: MaterialSettings):
        self._object_of = scene.object_of
        self._face_count = max(len(item.mesh.faces) for item in scene.objects)

        gloss_units = [settings.roughness, settings.metallic, settings.specular_factor]
        units = torch.tensor([*gloss_units, settings.hue]).to(scene.lights)
        attacked_mask = units > 0
        self._changes_gloss = bool(attacked_mask[GLOSS].any())
        self._changes_hue = settings.hue > 0
        # Division by a unit of 0 is impossible. Values that are not attacked
        # have a unit of 1 instead.
        self._unit = torch.where(attacked_mask, units, 1)

        # Below, F is the number of faces of the largest mesh.
        materials = [initial_materials(item) for item in scene.objects]
        averages = [material.average() for material in materials]
        # Shape (objects, 3).
        self._average_gloss = torch.stack(averages).to(scene.lights)
        if all(material.is_uniform() for material in materials):
            # One row then replaces the rows of all faces, which saves memory.
            materials = [material.first_face() for material in materials]
        # Shapes (objects, F, 3) and (objects, F), or F = 1 for a single row.
        face_gloss = _stack_padded([material.face_gloss for material in materials])
        object_mask = _stack_padded([material.object_mask for material in materials])
        self._face_gloss = face_gloss.to(scene.lights)
        self._object_mask = object_mask.to(scene.lights)

        # `MIN_ROUGHNESS` is the lowest roughness that the renderer shows. The hue has
        # no limits: its lowest value is -∞, and its highest is 1 - (-∞) = ∞.
        lowest_material = self._unit.new_tensor([MIN_ROUGHNESS + ROUNDING, 0, 0, -math.inf])
        highest_material = 1 - self._unit.new_tensor([ROUNDING, ROUNDING, ROUNDING, -math.inf])
        self._lowest_values = lowest_material / self._unit
        self._highest_values = highest_material / self._unit
        # The rotation of the hue starts at 0.
        initial_material = F.pad(self._average_gloss, (0, 1))
        start = initial_material.clamp(lowest_material, highest_material) / self._unit
        used_mask = attacked_mask.repeat(len(start), 1)
        # Objects that are not metallic stay so.
        used_mask[:, METALLIC] &= self._average_gloss[:, METALLIC] > 0
        super().__init__(
            settings,
            start=start[scene.object_of],
            used_mask=used_mask[scene.object_of],
        )

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        """Return a copy of the conditions with the given gloss and hue of the objects.

        Args:
            values: Attack values, shape (A, 4). The columns are the average
                roughness, metallic factor and specular factor, and the rotation
                of the hue. Each is divided by its unit in the settings.
            conditions: Conditions of the A examples.
            examples: Indices of the examples in the scene, shape (A,).

        Returns:
            Conditions with the gloss and the hue of each face, differentiable
            with respect to the values.
        """
        if self.used_mask is not None:
            # `used_mask` and `start` have a row of four values for each example of the scene.
            # Values that the mask excludes are not attacked and keep their start.
            values = torch.where(self.used_mask[examples], values, self.start[examples])
        material = values * self._unit
        objects = self._object_of[examples]
        if self._changes_gloss:
            conditions = self._with_gloss(conditions, material[:, GLOSS], objects)
        if self._changes_hue:
            conditions = self._with_hue(conditions, material[:, HUE], objects)
        return conditions

    def _with_gloss(
        self,
        conditions: Conditions,
        average_gloss: Tensor,
        objects: Tensor,
    ) -> Conditions:
        """Return a copy of the conditions in which the gloss of the objects has given averages.

        Args:
            conditions: Conditions of the A examples.
            average_gloss: Average roughness, metallic and specular factor,
                shape (A, 3).
            objects: Index of the object of each example, shape (A,).
        """
        # Change of each example's average from that of the mesh, shape (A, 3).
        change = average_gloss - self._average_gloss[objects]
        # `_object_mask` is 1 for faces of the object itself and 0 for faces of props and table,
        # which do not change. Shape (A, F, 3).
        face_change = change[:, None] * self._object_mask[objects][..., None]
        return replace(conditions, gloss=(self._face_gloss[objects] + face_change).clamp(0, 1))

    def _with_hue(self, conditions: Conditions, angle: Tensor, objects: Tensor) -> Conditions:
        """Return a copy of the conditions in which the hue of the objects is rotated.

        Args:
            conditions: Conditions of the A examples.
            angle: Rotation angles in degrees, shape (A, 1).
            objects: Index of the object of each example, shape (A,).
        """
        hue = (angle * self._object_mask[objects]).expand(-1, self._face_count)
        albedo_offset = conditions.albedo
        if albedo_offset is None:
            # The renderer rotates hues only if a color is added to the albedo,
            # which may be black.
            albedo_offset = angle.new_zeros(len(angle), self._face_count, 3)
        return replace(conditions, hue=hue, albedo=albedo_offset)

    def project_feasible(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest values whose gloss the renderer can show.

        Args:
            values: Attack values, shape (A, 4), as in `apply`.
            within: Norm-ball that must contain the result, or None.

        Returns:
            Feasible values, shape (A, 4).
        """
        return nearest_in_box(values, self._lowest_values, self._highest_values, within)


def _stack_padded(tensors: list[Tensor]) -> Tensor:
    """Stack tensors with a row for each face of an object, and fill up the shorter ones with 0.

    Args:
        tensors: One tensor for each object, shape (faces of the object, ...).

    Returns:
        Stacked tensors, shape (objects, faces of the largest object, ...).
    """
    return pad_sequence(tensors, batch_first=True)
