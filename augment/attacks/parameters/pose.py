"""Attacks on the pose of an object and of its cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import chain

import torch
import torch.nn.functional as F
from torch.nn.utils.rnn import pad_sequence

from augment.attack_settings import PoseSettings
from augment.attacks.objective import Examples, Values
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from renderer.errors import InputError
from renderer.vectors import rotation_matrices

# An attack on the pose changes a vector of values. The following constants are positions in it:
# of the rotation vector of the object, of its shift along x and y, of the logarithm of its scale,
# and of the three changes of the cameras (the last is the logarithm of their distance).
ROTATION = slice(0, 3)
SHIFT = slice(3, 5)
SCALE = 5
CAMERA = slice(6, 9)
DISTANCE = 8

# An attack on the pose may let the object grow and the camera approach. Each may close this
# fraction of the gap between them. The sum is below 1, so they never meet.
MAX_APPROACH = 0.45


class Pose(Parameter):
    """Attack on the pose of an object and of its cameras.

    The attack values of an example, each divided by its unit in
    `PoseSettings`, are

    - the rotation vector of the object about the origin (3 values),
    - its shift along x and y (2),
    - the logarithm of its scale (1),
    - the changes of the polar angle, the azimuth and the logarithm of the
      distance of all cameras (3).

    If another parameter displaces the vertices, it does so before. An object
    with props or a table keeps standing on the same ground.
    """

    name = "pose"
    fits_other_meshes = False

    def __init__(self, scene: Scene, settings: PoseSettings):
        """Compute units and limits of the attack values."""
        if not scene.settings.silhouettes:
            advice = "set silhouettes=True, since an attack on the pose needs them"
            raise InputError(f"silhouettes=False: {advice}", "silhouettes")
        self._scene = scene
        masks = [torch.from_numpy(item.own_vertices) for item in scene.objects]
        # Mask of the vertices of each object itself, without props and table, shape (objects, N).
        self._object_masks = pad_sequence(masks, batch_first=True).to(scene.lights.device)
        # Height z of the ground of each object. NaN for an object without props or table, which
        # may float.
        grounds = [math.nan if item.own is None else item.lowest for item in scene.objects]
        self._grounds = scene.lights.new_tensor(grounds)
        # Units of the rotation vector in degrees (3), the shift in world units (2), the logarithm
        # of the scale (1), polar angle and azimuth of the cameras in degrees (2), and the
        # logarithm of their distance (1).
        units = [settings.rotation] * 3 + [settings.shift] * 2 + [math.log1p(settings.scale)]
        units += [settings.view] * 2 + [math.log1p(settings.distance)]
        self._unit = torch.tensor(units, dtype=torch.float64).to(scene.lights)
        all_cameras = chain.from_iterable(scene.cameras)
        distances = [camera.distance for camera in all_cameras if camera.has_perspective]
        object_radius = float(scene.vertices.norm(dim=-1).max()) + settings.shift
        # Logarithm of the factor by which the object can grow before it meets the nearest
        # perspective camera. It is infinite if there is no such camera.
        log_gap = math.log(min(distances, default=math.inf) / object_radius)
        # Largest magnitude of each attack value. Only scale and distance have limits, so that the
        # object and a perspective camera do not meet. A unit may be 0.
        limit = torch.full_like(self._unit, math.inf)
        small_units = self._unit[[SCALE, DISTANCE]].clamp(min=1e-9)
        limit[[SCALE, DISTANCE]] = max(MAX_APPROACH * log_gap, 0.0) / small_units
        self.box = -limit, limit
        # A value with the unit 0 has no effect.
        used_mask = (self._unit > 0).expand(len(scene.object_of), -1)
        super().__init__(settings, start=self._unit.new_zeros(used_mask.shape), used_mask=used_mask)

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with moved objects and cameras.

        The values are the pose divided by the units of the settings. Vertices that another
        parameter has displaced are moved, too.
        """
        objects = self._scene.object_of[examples]
        changes = values * self._unit
        given = conditions.vertices
        vertices = self._scene.vertices[objects] if given is None else given
        object_mask = self._object_masks[objects]
        scaled = changes[:, SCALE, None, None].exp() * vertices
        rotated = scaled @ rotation_matrices(changes[:, ROTATION]).mT
        # Append 0 for the shift along z.
        moved = rotated + F.pad(changes[:, SHIFT], (0, 1))[:, None]
        # Lift each object with a ground until its lowest vertex is on it. Props and table stay.
        lowest = moved[..., 2].masked_fill(~object_mask, math.inf).amin(1)
        ground = self._grounds[objects]
        lift = torch.where(ground.isnan(), 0, ground - lowest)
        moved = moved + F.pad(lift[:, None], (2, 0))[:, None]
        vertices = torch.where(object_mask[..., None], moved, vertices)
        return replace(conditions, vertices=vertices, cameras=changes[:, CAMERA])
