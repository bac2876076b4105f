"""Attacks on the material of an object: its specular reflection and the hue of its albedo."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch.nn.utils.rnn import pad_sequence

from augment.attack_settings import MaterialSettings
from augment.attacks.objective import Examples, Values
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import METALLIC, Conditions, initial_materials
from augment.scene.scene import Scene
from renderer.settings import MIN_ROUGHNESS

# The four attack values of an attack on the material are roughness, metallic, specular factor and
# hue. `GLOSS` selects the first three, and `HUE` the last.
GLOSS = slice(0, 3)
HUE = slice(3, 4)

# An attack keeps roughness, metallic and specular factor this far from 0 and 1. At 0 and 1, the
# renderer clamps them, and the gradient would be zero.
ROUNDING = 1e-6


class Material(Parameter):
    """Attack on the roughness, the metallic factor, the specular factor and the hue of an object.

    The first three attack values are averages over the faces of the object. An
    attack changes all faces by the same amount, so that differences between
    faces remain. The fourth value is a rotation of the hue. Each value is
    divided by its unit in `MaterialSettings`. The averages stay in [0, 1], and
    the roughness does not fall below the lowest value that the renderer can
    show.

    A matte object starts with the material `SPECULAR_LAYER`. With a specular
    factor of zero, the gradient with respect to its roughness would be zero.

    Args:
        scene: Scene to attack. Props and table stay as they are.
        settings: Norm-ball, steps and units of the attack.
    """

    name = "material"
    fits_other_meshes = False

    def __init__(self, scene: Scene, settings: MaterialSettings):
        """Read the materials at which the attack starts, and the units."""
        self._object_of = scene.object_of
        self._face_count = max(len(item.mesh.faces) for item in scene.objects)
        glosses = [initial_materials(item) for item in scene.objects]
        # Masks of the faces of each object itself, without props and table.
        masks = [torch.from_numpy(item.own_faces) for item in scene.objects]
        pairs = [*zip(glosses, masks, strict=True)]
        averages = [gloss[mask].mean(0) for gloss, mask in pairs]
        # Average roughness, metallic and specular factor of each object, shape (objects, 3).
        self._average_gloss = torch.stack(averages).to(scene.lights)
        # Save memory: of faces that are alike, keep one only.
        are_alike = all(mask.all() and (gloss == gloss[0]).all() for gloss, mask in pairs)
        kept = slice(1 if are_alike else None)
        # F is the number of faces of the largest mesh, or 1 if the faces of each object are
        # alike. The shapes are (objects, F, 3) and (objects, F).
        face_gloss = pad_sequence([gloss[kept] for gloss in glosses], batch_first=True)
        object_mask = pad_sequence([mask[kept] for mask in masks], batch_first=True)
        self._face_gloss = face_gloss.to(scene.lights)
        self._object_mask = object_mask.to(scene.lights)

        gloss_units = [settings.roughness, settings.metallic, settings.specular_factor]
        units = torch.tensor([*gloss_units, settings.hue]).to(scene.lights)
        attacked_mask = units > 0
        self._changes_gloss = bool(attacked_mask[GLOSS].any())
        self._changes_hue = settings.hue > 0
        # A unit of 0 marks a value that is not attacked. It is replaced by 1, because values
        # are divided by their units.
        self._unit = torch.where(attacked_mask, units, 1)

        # Limits of roughness, metallic, specular factor and hue. The hue has no limits.
        highest = 1 - ROUNDING
        lowest_material = self._unit.new_tensor([MIN_ROUGHNESS + ROUNDING, 0, 0, -math.inf])
        highest_material = self._unit.new_tensor([highest, highest, highest, math.inf])
        self.box = lowest_material / self._unit, highest_material / self._unit
        # Append a fourth column for the rotation of the hue, which starts at 0.
        initial_material = F.pad(self._average_gloss, (0, 1))
        start = initial_material.clamp(lowest_material, highest_material) / self._unit
        used_mask = attacked_mask.repeat(len(start), 1)
        # The metallic factor of an object is attacked only if the object is metallic.
        used_mask[:, METALLIC] &= self._average_gloss[:, METALLIC] > 0
        super().__init__(settings, start[scene.object_of], used_mask[scene.object_of])

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with the given gloss and hue of the objects.

        The columns of the values are average roughness, metallic factor and specular factor, and
        the rotation of the hue, each divided by its unit.
        """
        # Values that are not attacked keep their start.
        values = torch.where(self.used_mask[examples], values, self.start[examples])
        material = values * self._unit
        objects = self._object_of[examples]
        # Columns `GLOSS` are the three factors, and column `HUE` is the rotation.
        # One row for each example, one column for each face: 1 for faces of the object itself, and
        # 0 for faces of props and table.
        object_mask = self._object_mask[objects]
        if self._changes_gloss:
            # Change of the averages of each example, shape (E, 3), and of its faces, (E, F, 3).
            change = material[:, GLOSS] - self._average_gloss[objects]
            face_change = change[:, None] * object_mask[..., None]
            gloss = (self._face_gloss[objects] + face_change).clamp(0, 1)
            conditions = replace(conditions, gloss=gloss)
        if self._changes_hue:
            # Rotation in degrees.
            hue = (material[:, HUE] * object_mask).expand(-1, self._face_count)
            conditions = replace(conditions, hue=hue)
        return conditions
