"""What an attack may change: light, sky, a projector's pattern, lamps, shape, colors, pixels; any at once."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from augment.attacks.norm_ball import StepSettings, anywhere
from augment.scene import Conditions, Scene
from renderer.errors import InputError
from renderer.light.basis import Harmonics, LocalBasis, parts_of
from renderer.light.convex import Ball, nearest_in_box
from renderer.light.local import Lamps, Projector
from renderer.light.presets import mean_luminance
from renderer.light.skylight import TURBIDITY, ZENITH, coefficients


class Parameter(ABC):
    """One kind of parameter of a scene's E examples. `start` (E, D) is where attacks begin and its balls' center.

    used: (E, D) bool, where examples differ in how many values they use: the others stay as they are. None: all.
    """

    name: str

    def __init__(self, scene: Scene, start: Tensor, settings: StepSettings, used: Tensor | None = None):
        self.scene, self.start, self.settings, self.used = scene, start, settings, used

    @abstractmethod
    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        """The conditions of examples (A,) with this part of them set to values (A, D)."""

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """The nearest values (A, D) of the examples (A,) within the norm-ball and its domain."""
        return self.settings.project(values, self.start[examples], self.within_domain)

    def sample(self, generator: torch.Generator, examples: Tensor) -> Tensor:
        """Uniform draws (A, D) from the balls of the examples (A,), within the domain."""
        used = None if self.used is None else self.used[examples]
        return self.project(self.settings.sample(self.start[examples], generator, used), examples)

    def sample_as_far(self, values: Tensor, generator: torch.Generator, examples: Tensor) -> Tensor:
        """`sample` where there is a radius; else a random direction at the L2 distance of values (A, D) from the
        start, within the domain."""
        if self.settings.radius is not None:
            return self.sample(generator, examples)
        start = self.start[examples].to(values)
        offset = torch.randn(values.shape, generator=generator).to(values)
        if self.used is not None:
            offset = offset * self.used[examples]
        reach = (values - start).norm(dim=1, keepdim=True)
        return self.within_domain(start + offset * reach / offset.norm(dim=1, keepdim=True))

    def within_domain(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """See `augment.attacks.norm_ball.Domain`; by default there is no bound."""
        return anywhere(values, within)


TURBIDITY_UNIT = 4.0  # its domain spans 2 of them, as the zenith's and the azimuth's span about 1.6 and 6


@dataclass
class SkylightSettings(StepSettings):
    """Where the sky begins: zenith and azimuth in degrees, turbidity."""

    zenith: float = 45.0
    azimuth: float = 0.0
    turbidity: float = 3.0


class OfMesh(Parameter):
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


class OfLight(Parameter):
    """Every coefficient of one of the bases that a scene's light is of. The start is the examples' own; or, where light
    is not to be negative, the nearest light that can be emitted, and so is every light from there on."""

    def __init__(
        self,
        scene: Scene,
        settings: StepSettings,
        where: slice,
        basis: Harmonics | LocalBasis,
        nonnegative: bool,
    ):
        """where: the coefficients of the basis among the scene's."""
        self.basis, self.nonnegative, self._where = basis, nonnegative or not basis.allow_negative, where
        start = scene.lights[:, where]
        super().__init__(scene, (basis.project_nonnegative(start) if self.nonnegative else start).flatten(1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return _relit(conditions, self._where, values.unflatten(1, (-1, 3)))

    def within_domain(self, values: Tensor, within: Ball | None = None) -> Tensor:
        if not self.nonnegative:
            return super().within_domain(values, within)
        of_lights = None if within is None else within.unflatten(-1, 3)
        return self.basis.project_nonnegative(values.unflatten(1, (-1, 3)), of_lights).flatten(1)


def _relit(conditions: Conditions, where: slice, own: Tensor) -> Conditions:
    """With other coefficients of one of the light's bases."""
    light = conditions.light
    if own.shape[1] < light.shape[1]:
        own = torch.cat([light[:, : where.start], own, light[:, where.stop :]], dim=1)
    return replace(conditions, light=own)


class Lighting(OfLight):
    """The light of the scene, or the first of several: that of the sky."""

    name = "lighting"

    def __init__(self, scene: Scene, settings: StepSettings, nonnegative: bool = False):
        super().__init__(scene, settings, *parts_of(scene.basis)[0], nonnegative)


class OfLocalLight(OfLight):
    """The local light of one basis, of which a scene has one each. InputError where it has none."""

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, *_of_name(scene, self.name, self.name), nonnegative=True)


def _of_name(scene: Scene, name: str, attacked: str) -> tuple[slice, Any]:
    """(the coefficients of, the) light of a scene that has a name. InputError where there is none to be attacked."""
    for part in parts_of(scene.basis):
        if part[1].name == name:
            return part
    raise InputError(f"attack={attacked}: the scene has no {name}: set scene.{name}")


class ProjectorPattern(OfLocalLight):
    """What a projector throws: each pixel's three channels, from 0 to its power."""

    name = Projector.name


class LampPowers(OfLocalLight):
    """What each lamp emits, three channels from 0 to the largest power."""

    name = Lamps.name


class LampPlaces(Parameter):
    """Where each lamp is, three coordinates in world units. Shadows are cast anew in each image, and are held in its
    derivative. InputError where the scene has no lamps."""

    name = "positions"

    def __init__(self, scene: Scene, settings: StepSettings):
        lamps = _of_name(scene, Lamps.name, self.name)[1]
        start = torch.tensor(lamps.positions).to(scene.lights).flatten()
        super().__init__(scene, start.expand(len(scene), -1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, positions=values.unflatten(1, (-1, 3)))


class Skylight(Parameter):
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


class Pixels(Parameter):
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


PARAMETERS: dict[str, Callable[..., Parameter]] = {
    parameter.name: parameter
    for parameter in (Lighting, Skylight, ProjectorPattern, LampPowers, LampPlaces, Geometry, Albedo, Pixels)
}


class AttackProblem:
    """Kinds side by side: values (E, D) are theirs, one after the other. See `augment.attacks.descent.Problem`."""

    def __init__(self, scene: Scene, parameters: Sequence[Parameter]):
        self.scene, self.parameters = scene, parameters
        self.start = torch.cat([parameter.start.to(scene.lights) for parameter in parameters], dim=1)
        self.everything = torch.arange(len(scene), device=self.start.device)
        self._sizes = [parameter.start.shape[1] for parameter in parameters]

    def conditions(self, values: Tensor, examples: Tensor) -> Conditions:
        """What values (A, D) make of the scene of examples (A,)."""
        conditions = self.scene.conditions(examples)
        for parameter, part in zip(self.parameters, self.split(values), strict=True):
            conditions = parameter.apply(part, conditions, examples)
        return conditions

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.scene.render(self.conditions(values, examples), examples)

    @torch.no_grad()
    def images(self, values: Tensor) -> Tensor:
        """(E, V, 3, size, size) of values (E, D), rendered by parts, so that little memory beside theirs is used."""
        size = self.scene.settings.size
        images = values.new_empty(len(values), self.scene.views, 3, size, size)
        for part in self.everything.split(self.scene.at_once):
            images[part] = self.render(values[part], part)
        return images

    def step(self, gradient: Tensor) -> Tensor:
        parts = zip(self.parameters, self.split(gradient), strict=True)
        return torch.cat([parameter.settings.along(part) for parameter, part in parts], dim=1)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        parts = zip(self.parameters, self.split(values), strict=True)
        return torch.cat([parameter.project(part, examples) for parameter, part in parts], dim=1)

    def sample(self, generator: torch.Generator) -> Tensor:
        """Uniform draws (E, D) from every kind's ball around its start, within its domain."""
        drawn = [parameter.sample(generator, self.everything).to(self.start) for parameter in self.parameters]
        return torch.cat(drawn, dim=1)

    def sample_as_far(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Draws (E, D) as far as values went: uniform in a kind's ball where it has a radius, else in a random
        direction at the values' own L2 distance from the start."""
        parts = zip(self.parameters, self.split(values), strict=True)
        drawn = [parameter.sample_as_far(part, generator, self.everything).to(self.start) for parameter, part in parts]
        return torch.cat(drawn, dim=1)

    def split(self, values: Tensor) -> tuple[Tensor, ...]:
        """Each kind's part (A, D_k) of values (A, D)."""
        return values.split(self._sizes, dim=1)
