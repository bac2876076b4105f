"""What an attack may change: light, sky, a projector's pattern, lamps, shape, colours, pixels; any of them at once."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from augment.kind import Kind, StepSettings
from augment.scene import Conditions, Scene
from renderer.basis import Distant, Placed, parts_of
from renderer.convex import Ball, nearest_in_box
from renderer.errors import InputError
from renderer.lamps import Lamps
from renderer.lights import mean_luminance
from renderer.projector import Projector
from renderer.skylight import TURBIDITY, ZENITH, coefficients

TURBIDITY_UNIT = 4.0  # its domain spans 2 of them, as the zenith's and the azimuth's span about 1.6 and 6


@dataclass
class SkylightSettings(StepSettings):
    """Where the sky begins: zenith and azimuth in degrees, turbidity."""

    zenith: float = 45.0
    azimuth: float = 0.0
    turbidity: float = 3.0


class OfMesh(Kind):
    """Three values for each of the items, vertices or faces, that a mesh has; the first of them in a smaller mesh, and
    used where they are the object's own."""

    def __init__(self, scene: Scene, settings: StepSettings, own: Sequence[np.ndarray]):
        """own: bool, of the items of each object."""
        items = pad_sequence([torch.from_numpy(each) for each in own], batch_first=True).to(scene.lights.device)
        used = items.repeat_interleave(3, dim=1)[scene.object_of]
        start = scene.lights.new_zeros(used.shape)
        super().__init__(scene, start, settings, None if used.all() else used)

    def by_item(self, values: Tensor, examples: Tensor) -> Tensor:
        """(A, items, 3) of values (A, D): zero where they are not used."""
        used = values if self.used is None else values * self.used[examples]
        return used.unflatten(1, (-1, 3))


class OfLight(Kind):
    """Every coefficient of one of the bases that a scene's light is of. The start is the examples' own; or, where light
    is to be physical, what is nearest to it that something can emit, and so is every light from there on."""

    def __init__(self, scene: Scene, settings: StepSettings, where: slice, basis: Distant | Placed, physical: bool):
        """where: the coefficients of the basis among the scene's."""
        self.basis, self.physical, self._where = basis, physical or not basis.signed, where
        start = scene.lights[:, where]
        super().__init__(scene, (basis.nearest_physical(start) if self.physical else start).flatten(1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return _relit(conditions, self._where, values.unflatten(1, (-1, 3)))

    def within_domain(self, values: Tensor, within: Ball | None = None) -> Tensor:
        if not self.physical:
            return super().within_domain(values, within)
        of_lights = None if within is None else within.unflatten(-1, 3)
        return self.basis.nearest_physical(values.unflatten(1, (-1, 3)), of_lights).flatten(1)


def _relit(conditions: Conditions, where: slice, own: Tensor) -> Conditions:
    """With other coefficients of one of the light's bases."""
    light = conditions.light
    if own.shape[1] < light.shape[1]:
        own = torch.cat([light[:, : where.start], own, light[:, where.stop :]], dim=1)
    return replace(conditions, light=own)


class Lighting(OfLight):
    """The light of the scene, or the first of several: that of the sky."""

    name = "lighting"

    def __init__(self, scene: Scene, settings: StepSettings, physical: bool = False):
        super().__init__(scene, settings, *parts_of(scene.basis)[0], physical)


class OfPlace(OfLight):
    """The light from places, of which a scene has one kind each. InputError where it has none."""

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, *_of_name(scene, self.name, self.name), physical=True)


def _of_name(scene: Scene, name: str, attacked: str) -> tuple[slice, Any]:
    """(the coefficients of, the) light of a scene that has a name. InputError where there is none to be attacked."""
    for part in parts_of(scene.basis):
        if part[1].name == name:
            return part
    raise InputError(f"attack={attacked}: the scene has no {name}: set scene.{name}")


class ProjectorPattern(OfPlace):
    """What a projector throws: each pixel's three channels, from 0 to its power."""

    name = Projector.name


class LampPowers(OfPlace):
    """What each lamp emits, three channels from 0 to the largest power."""

    name = Lamps.name


class LampPlaces(Kind):
    """Where each lamp is, three coordinates in world units. Shadows are cast anew in each image, and are held in its
    derivative. InputError where the scene has no lamps."""

    name = "places"

    def __init__(self, scene: Scene, settings: StepSettings):
        lamps = _of_name(scene, Lamps.name, self.name)[1]
        start = torch.tensor(lamps.places).to(scene.lights).flatten()
        super().__init__(scene, start.expand(len(scene), -1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, places=values.unflatten(1, (-1, 3)))


class Skylight(Kind):
    """Three values: zenith, azimuth, turbidity / 4. The sky is scaled to the mean luminance of the example's own light
    where the attack starts, and by the same factor elsewhere. Lights in the scene stay as they are."""

    name = "skylight"

    def __init__(self, scene: Scene, settings: SkylightSettings):
        zenith, azimuth = math.radians(settings.zenith), math.radians(settings.azimuth)
        turbidity = settings.turbidity
        start = torch.tensor([zenith, azimuth, turbidity / TURBIDITY_UNIT], dtype=torch.float64).to(scene.lights)
        super().__init__(scene, start.expand(len(scene), -1), settings)
        sky = mean_luminance(coefficients(zenith, azimuth, turbidity))
        self._where, _ = parts_of(scene.basis)[0]
        scales = [mean_luminance(light) / sky for light in scene.lights[:, self._where]]
        self._scale = torch.tensor(scales, dtype=torch.float64, device=start.device)[:, None, None]

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        zenith, azimuth, turbidity = values.unbind(1)
        sky = coefficients(zenith, azimuth, turbidity * TURBIDITY_UNIT) * self._scale[examples]
        return _relit(conditions, self._where, sky.to(conditions.light))

    def within_domain(self, values: Tensor, within: Ball | None = None) -> Tensor:
        clear, hazy = (limit / TURBIDITY_UNIT for limit in TURBIDITY)
        low, high = values.new_tensor([[ZENITH[0], -math.inf, clear], [ZENITH[1], math.inf, hazy]])
        return nearest_in_box(values, low, high, within)


class Geometry(OfMesh):
    """Displacements of the object's vertices, in world units; it spans [-1, 1]. The gradient sees how normals turn."""

    name = "geometry"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, [item.own_vertices for item in scene.objects])

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        vertices = self.scene.vertices[self.scene.object_of[examples]]
        return replace(conditions, vertices=vertices + self.by_item(values, examples))


class Albedo(OfMesh):
    """What is added to the linear albedo of each face, per channel; the sum is clamped to [0, 1]."""

    name = "albedo"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, [item.own_faces for item in scene.objects])

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, albedo=self.by_item(values, examples))


class Pixels(Kind):
    """What is added to each image's values, background included; the sum is clamped to [0, 1].

    One step of the radius along the sign is FGSM (Goodfellow et al. 2014); several smaller ones are the iterated
    method, and with random restarts PGD (Madry et al. 2017).
    """

    name = "pixels"

    def __init__(self, scene: Scene, settings: StepSettings):
        values = scene.views * 3 * scene.settings.size**2
        super().__init__(scene, scene.lights.new_zeros(len(scene), values), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        size = self.scene.settings.size
        return replace(conditions, pixels=values.unflatten(1, (self.scene.views, 3, size, size)))


KINDS: dict[str, Callable[..., Kind]] = {
    kind.name: kind for kind in (Lighting, Skylight, ProjectorPattern, LampPowers, LampPlaces, Geometry, Albedo, Pixels)
}
