"""What an attack may change: lights, shape, pose, material, colors, pixels; any at once."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from augment.attacks.norm_ball import Domain, StepSettings, anywhere
from augment.objects import SceneObject
from augment.progress import progress
from augment.scene import Conditions, Scene
from renderer.camera import PerspectiveCamera
from renderer.errors import FACTOR, InputError, require_range
from renderer.light.basis import Ball, nearest_in_box, parts_of
from renderer.light.local import Lamps
from renderer.light.presets import mean_luminance
from renderer.light.skylight import TURBIDITY, ZENITH, coefficients
from renderer.microfacets import LEAST
from renderer.vectors import rotation_matrices

POSE = ("rotation", "shift", "scale", "view", "distance")  # its parts, of 3, 2, 1, 2 and 1 values
MATERIAL = ("roughness", "metallic", "strength", "hue")
VARNISH = 0.5, 0.0, 1.0  # roughness, metallic and strength
ROUNDING = 1e-6  # by which a material stays off 0 and 1, where clamping would end its gradient
TURBIDITY_UNIT = 4.0  # its domain spans 2 of them, as the zenith's and the azimuth's span about 1.6 and 6


@dataclass
class SkylightSettings(StepSettings):
    """Where the sky begins: zenith and azimuth in degrees, turbidity."""

    zenith: float = 45.0
    azimuth: float = 0.0
    turbidity: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("zenith", self.zenith, 0, 90)  # to the horizon
        require_range("azimuth", self.azimuth, -FACTOR, FACTOR)
        require_range("turbidity", self.turbidity, *TURBIDITY)


@dataclass
class PoseSettings(StepSettings):
    """How far each part of a pose goes for a value of 1; with 0, the part is left as it is. rotation of the object, in
    degrees. shift: along the table, in world units. scale: of the object, as a fraction. view: the camera's polar and
    azimuthal angle, in degrees. distance: of the camera, as a fraction. joints: of a skinned mesh, degrees about each
    axis, which are also limits; of all joints or {name: degrees} of some."""

    rotation: float = 10.0
    shift: float = 0.1
    scale: float = 0.1
    view: float = 10.0
    distance: float = 0.1
    joints: Any = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in zip(POSE, (180, 10, 1, 180, 1), strict=True):
            require_range(name, getattr(self, name), 0, most)
        limits = self.joints if isinstance(self.joints, Mapping) else {"joints": self.joints}
        for name, degrees in limits.items():
            if isinstance(degrees, bool) or not isinstance(degrees, int | float):
                raise InputError(f"joints={self.joints}: give degrees, or {{name: degrees}}")
            require_range("joints" if name == "joints" else f"joints.{name}", degrees, 0, 180)
        if not any([*limits.values(), *(getattr(self, name) for name in POSE)]):
            raise InputError(f"{', '.join(POSE)} and joints are all 0: nothing of the pose would change")

    def of_joints(self, item: SceneObject) -> list[float]:
        """The degrees of each joint of an object. InputError: a joint that it has not, or no skin."""
        if not self.joints:
            return []
        if item.mesh.skin is None:
            raise InputError(f"joints: {item.name} has no skin: give a glTF file with one, or joints=0")
        names = item.mesh.skin.names
        limits = self.joints if isinstance(self.joints, Mapping) else dict.fromkeys(names, self.joints)
        if unknown := [name for name in limits if name not in names]:
            raise InputError(f"joints: {item.name} has no joint {unknown[0]}: choose from {', '.join(names)}")
        return [float(limits.get(name, 0)) for name in names]


@dataclass
class MaterialSettings(StepSettings):
    """How far each part of a material goes for a value of 1; with 0, the part is left as it is. roughness, metallic,
    strength: those of `renderer.Gloss`; metallic of what has some. hue: of the albedo, in degrees."""

    roughness: float = 0.3
    metallic: float = 0.3
    strength: float = 1.0
    hue: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in zip(MATERIAL, (1, 1, 1, 180), strict=True):
            require_range(name, getattr(self, name), 0, most)
        if not any(getattr(self, name) for name in MATERIAL):
            raise InputError(f"{', '.join(MATERIAL)} are all 0: nothing of the material would change")


@dataclass
class Parameter:
    """One kind of values (E, D) of a scene's E examples.

    start: (E, D), where attacks begin, and the center of the norm-balls. apply: the conditions of examples (A,) with
    this part of them set to values (A, D). domain: the set of possible values. used: (E, D) bool, where examples differ
    in how many values they use: the others stay as they are. None: all.
    """

    name: str
    settings: StepSettings
    start: Tensor
    apply: Callable[[Tensor, Conditions, Tensor], Conditions]
    domain: Domain = anywhere
    used: Tensor | None = None

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """The nearest values (A, D) of the examples (A,) within the norm-ball and the domain."""
        return self.settings.project(values, self.start[examples], self.domain)

    def sample(self, generator: torch.Generator, reached: Tensor | None = None) -> Tensor:
        """Uniform draws (E, D) from the norm-balls, within the domain. Without a radius: random directions, as far from
        the start as values (E, D) that an attack reached; InputError where these are not given."""
        if self.settings.radius is not None or reached is None:
            draws = self.settings.sample(self.start, generator, self.used)
            return self.settings.project(draws, self.start, self.domain)
        offset = torch.randn(reached.shape, generator=generator).to(reached)
        if self.used is not None:
            offset = offset * self.used
        distance = (reached - self.start).norm(dim=1, keepdim=True)
        return self.domain(self.start + offset * distance / offset.norm(dim=1, keepdim=True))


def lighting(scene: Scene, settings: StepSettings, nonnegative: bool = False) -> Parameter:
    """The light of the scene, or the first of several: that of the sky."""
    return _light(scene, settings, "lighting", parts_of(scene.basis)[0], nonnegative)


def projector(scene: Scene, settings: StepSettings) -> Parameter:
    """What a projector throws: each pixel's three channels, from 0 to its power."""
    return _light(scene, settings, "projector", _local_light(scene, "projector"))


def lamps(scene: Scene, settings: StepSettings) -> Parameter:
    """What each lamp emits, three channels from 0 to the largest power."""
    return _light(scene, settings, "lamps", _local_light(scene, "lamps"))


def _light(
    scene: Scene, settings: StepSettings, name: str, part: tuple[slice, Any], nonnegative: bool = True
) -> Parameter:
    """Every coefficient of one of the bases that a scene's light is of. The start is the examples' own. Where light is
    not to be negative, the start is `project_nonnegative` of it, which keeps its mean. A step then ends in the nearest
    light, in coefficients, that can be emitted and lies within the norm-ball; its mean may differ from what the step
    asked for, since within a ball there need not be such a light of that mean.

    part: the coefficients of the basis among the scene's, and the basis.
    """
    where, basis = part
    start = scene.lights[:, where]

    def possible(values: Tensor, within: Ball | None = None) -> Tensor:
        of_lights = None if within is None else within.unflatten(-1, 3)
        return basis.nearest_nonnegative(values.unflatten(1, (-1, 3)), of_lights).flatten(1)

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return _relit(conditions, where, values.unflatten(1, (-1, 3)))

    if not nonnegative and basis.allow_negative:
        return Parameter(name, settings, start.flatten(1), apply)
    return Parameter(name, settings, basis.project_nonnegative(start).flatten(1), apply, possible)


def _relit(conditions: Conditions, where: slice, coefficients: Tensor) -> Conditions:
    """With other coefficients of one of the light's bases."""
    light = conditions.light
    if coefficients.shape[1] < light.shape[1]:
        coefficients = torch.cat([light[:, : where.start], coefficients, light[:, where.stop :]], dim=1)
    return replace(conditions, light=coefficients)


def _local_light(scene: Scene, name: str, attacked: str = "") -> tuple[slice, Any]:
    """The coefficients and the basis of the scene's light of a name. InputError where there is none to be attacked."""
    for part in parts_of(scene.basis):
        if part[1].name == name:
            return part
    raise InputError(f"attack={attacked or name}: the scene has no {name}: set scene.{name}")


def positions(scene: Scene, settings: StepSettings) -> Parameter:
    """Where each lamp is, in world units. Shadows are cast anew in each image, and are fixed in its derivative."""
    placed = _local_light(scene, Lamps.name, "positions")[1].positions
    start = torch.tensor(placed).to(scene.lights).flatten().expand(len(scene), -1)

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, positions=values.unflatten(1, (-1, 3)))

    return Parameter("positions", settings, start, apply)


def skylight(scene: Scene, settings: SkylightSettings) -> Parameter:
    """Three values: zenith, azimuth, turbidity / 4. The sky is scaled to the mean luminance of the example's own light
    where the attack starts, and by the same factor elsewhere. Lights in the scene stay as they are."""
    begin = math.radians(settings.zenith), math.radians(settings.azimuth), settings.turbidity
    start = torch.tensor([*begin[:2], begin[2] / TURBIDITY_UNIT], dtype=torch.float64).to(scene.lights)
    luminance = mean_luminance(coefficients(*begin))
    where, harmonics = parts_of(scene.basis)[0]
    scales = [mean_luminance(light) / luminance for light in scene.lights[:, where]]
    scale = torch.tensor(scales, dtype=torch.float64, device=start.device)[:, None, None]

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        zenith, azimuth, turbidity = values.unbind(1)
        sky = coefficients(zenith, azimuth, turbidity * TURBIDITY_UNIT) * scale[examples]
        sky = F.pad(sky, (0, 0, 0, harmonics.size - sky.shape[-2]))
        return _relit(conditions, where, sky.to(conditions.light))

    def possible(values: Tensor, within: Ball | None = None) -> Tensor:
        clear, hazy = (limit / TURBIDITY_UNIT for limit in TURBIDITY)
        low, high = values.new_tensor([[ZENITH[0], -math.inf, clear], [ZENITH[1], math.inf, hazy]])
        return nearest_in_box(values, low, high, within)

    return Parameter("skylight", settings, start.expand(len(scene), -1), apply, possible)


def geometry(scene: Scene, settings: StepSettings) -> Parameter:
    """Displacements of the object's vertices, in world units; it spans [-1, 1]. The gradient sees how normals turn
    and, with `silhouettes`, how outlines move."""
    own = [item.own_vertices for item in scene.objects]
    return _of_mesh(scene, settings, "geometry", own, "vertices", scene.vertices)


def pose(scene: Scene, settings: PoseSettings) -> Parameter:
    """Nine values: the object's rotation vector (about the origin), its shift along x and y and the logarithm of its
    scale; the polar angle, the azimuth and the logarithm of the distance of the cameras, in the settings' units; and
    rotation vectors of its joints, if these move, which turn before the object and after its geometry. Among props or
    on a table, the object stays on their ground. InputError without `silhouettes`, or without the joints."""
    if not scene.settings.silhouettes:
        raise InputError("attack=pose needs gradients of outlines: set renderer.silhouettes=true")
    angle, view = math.radians(settings.rotation), math.radians(settings.view)
    units = [angle] * 3 + [settings.shift] * 2 + [math.log1p(settings.scale)] + [view] * 2
    units.append(math.log1p(settings.distance))
    turns = [[math.radians(limit) for limit in settings.of_joints(item) for _ in range(3)] for item in scene.objects]
    rows = [torch.tensor(units + of_joints, dtype=torch.float64) for of_joints in turns]
    unit = pad_sequence(rows, batch_first=True).to(scene.lights)  # (M, D)
    own = pad_sequence([torch.from_numpy(item.own_vertices) for item in scene.objects], batch_first=True).to(
        unit.device
    )
    lowest = [None if item.own is None else item.lowest for item in scene.objects]

    def placed(object: int, vertices: Tensor, part: Tensor) -> Tensor:
        skin, bends = scene.objects[object].mesh.skin, part[9 : len(rows[object])]
        if skin is not None and len(bends):
            bent = skin.displacements(rotation_matrices(bends.view(-1, 3)))
            vertices = vertices + F.pad(bent, (0, 0, 0, len(vertices) - len(bent)))
        moved = part[5].exp() * vertices @ rotation_matrices(part[:3]).T + F.pad(part[3:5], (0, 1))
        ground = lowest[object]
        if ground is not None:
            moved = moved + (ground - moved[own[object], 2].amin()) * moved.new_tensor([0, 0, 1])
        return torch.where(own[object][:, None], moved, vertices)

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        objects = scene.object_of[examples]
        parts = values * unit[objects]
        before = scene.vertices[objects] if conditions.vertices is None else conditions.vertices
        after = [placed(*row) for row in zip(objects.tolist(), before, parts, strict=True)]
        return replace(conditions, vertices=torch.stack(after) if after else before, cameras=parts[:, 6:9])

    # However an object grows and a camera with perspective comes closer, they do not meet.
    cameras = [camera for views in scene.cameras for camera in views if isinstance(camera, PerspectiveCamera)]
    reach = float(scene.vertices.norm(dim=-1).max()) + settings.shift
    room = max(0.45 * math.log(min((camera.distance for camera in cameras), default=math.inf) / reach), 0.0)
    limit = unit.new_tensor([math.inf] * 9 + [1.0] * (unit.shape[1] - 9))
    limit[[5, 8]] = room / limit.new_tensor(units)[[5, 8]].clamp(min=1e-9)
    domain = partial(nearest_in_box, low=-limit, high=limit)
    used = (unit > 0)[scene.object_of]
    return Parameter("pose", settings, unit.new_zeros(used.shape), apply, domain, None if used.all() else used)


def material(scene: Scene, settings: MaterialSettings) -> Parameter:
    """Four values in the settings' units: roughness, metallic and strength of the object, in [0, 1] and at least the
    least roughness that is shaded; and the angle by which the hue of its albedo is turned. Where its faces differ, the
    first three are their means, and the differences stay. A matte object begins with VARNISH: without strength, the
    gradient by roughness is zero, and a descent that lowers strength would never leave."""
    units = settings.roughness, settings.metallic, settings.strength, math.radians(settings.hue)
    attacked = torch.tensor(units).to(scene.lights)
    unit = torch.where(attacked > 0, attacked, 1)
    pairs = [initial_gloss(item) for item in scene.objects]
    mean = torch.stack([rows[mask].mean(0) for rows, mask in pairs]).to(unit)
    if all(mask.all() and (rows == rows[0]).all() for rows, mask in pairs):
        pairs = [(rows[:1], mask[:1]) for rows, mask in pairs]
    gloss, own = (pad_sequence(part, batch_first=True).to(unit) for part in map(list, zip(*pairs, strict=True)))
    low, high = mean.new_tensor([LEAST + ROUNDING, 0, 0, -math.inf]), 1 - mean.new_tensor([ROUNDING] * 3 + [-math.inf])
    start = (F.pad(mean, (0, 1)).clamp(low, high) / unit)[scene.object_of]
    used = (attacked > 0).expand_as(start) & F.pad(mean[:, 1:2] > 0, (1, 2), value=True)[scene.object_of]

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        objects, now = scene.object_of[examples], torch.where(used[examples], values, start[examples]) * unit
        change = (now[:, :3] - mean[objects])[:, None] * own[objects][..., None]
        if attacked[:3].any():
            conditions = replace(conditions, gloss=(gloss[objects] + change).clamp(0, 1))
        if not settings.hue:
            return conditions
        faces = max(len(item.mesh.faces) for item in scene.objects)
        none = now.new_zeros(len(now), faces, 3) if conditions.albedo is None else conditions.albedo
        return replace(conditions, hue=(now[:, 3:] * own[objects]).expand(-1, faces), albedo=none)

    domain = partial(nearest_in_box, low=low / unit, high=high / unit)
    return Parameter("material", settings, start, apply, domain, None if used.all() else used)


def initial_gloss(item: SceneObject) -> tuple[Tensor, Tensor]:
    """Return what an attack on the material begins with: a matte object's own faces have VARNISH.

    Args:
        item: The object, whose mesh has F faces.

    Returns:
        Roughness, metallic and strength of all faces (F, 3), and which faces are the object's own, (F,) bool.
    """
    own, gloss = torch.from_numpy(item.own_faces), item.mesh.gloss
    rows = torch.tensor([[1.0, 0, 0]]).expand(len(own), 3) if gloss is None else torch.from_numpy(gloss)
    matte = not rows[own, 1:].any()
    return torch.where(own[:, None], rows.new_tensor(VARNISH), rows) if matte else rows, own


def albedo(scene: Scene, settings: StepSettings) -> Parameter:
    """What is added to the linear albedo of each face, per channel; the sum is clamped to [0, 1]."""
    return _of_mesh(scene, settings, "albedo", [item.own_faces for item in scene.objects], "albedo")


def _of_mesh(
    scene: Scene,
    settings: StepSettings,
    name: str,
    own: Sequence[np.ndarray],
    condition: str,
    of_objects: Tensor | None = None,
) -> Parameter:
    """Three values for each vertex or face of the largest mesh, used where a mesh has it and it is the object's own.

    own: (items,) bool, of each object. condition: the one to change. of_objects: (M, items, 3), to add the values to.
    """
    items = pad_sequence([torch.from_numpy(mask) for mask in own], batch_first=True).to(scene.lights.device)
    used = items.repeat_interleave(3, dim=1)[scene.object_of]
    all_used = bool(used.all())

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        changed = (values if all_used else values * used[examples]).unflatten(1, (-1, 3))
        if of_objects is not None:
            changed = of_objects[scene.object_of[examples]] + changed
        return replace(conditions, **{condition: changed})

    return Parameter(name, settings, scene.lights.new_zeros(used.shape), apply, used=None if all_used else used)


def pixels(scene: Scene, settings: StepSettings) -> Parameter:
    """What is added to each image's values, background included; the sum is clamped to [0, 1].

    One step of the radius along the sign is FGSM (Goodfellow et al. 2014); several smaller ones are the iterated
    method, and with random restarts PGD (Madry et al. 2017).
    """
    shape = scene.views, 3, scene.settings.size, scene.settings.size

    def apply(values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, pixels=values.unflatten(1, shape))

    return Parameter("pixels", settings, scene.lights.new_zeros(len(scene), math.prod(shape)), apply)


PARAMETERS: dict[str, Callable[..., Parameter]] = {
    make.__name__: make
    for make in (lighting, skylight, projector, lamps, positions, geometry, pose, material, albedo, pixels)
}


class AttackProblem:
    """Parameters side by side: values (E, D) are theirs, one after the other; start: where descent begins."""

    def __init__(self, scene: Scene, parameters: Sequence[Parameter]):
        self.scene, self.parameters, self.at_once = scene, parameters, scene.at_once
        self.start = torch.cat([parameter.start.to(scene.lights) for parameter in parameters], dim=1)
        self.everything = torch.arange(len(scene), device=self.start.device)
        self._sizes = [parameter.start.shape[1] for parameter in parameters]

    def conditions(self, values: Tensor, examples: Tensor) -> Conditions:
        """The scene's conditions of examples (A,), changed by values (A, D)."""
        conditions = self.scene.conditions(examples)
        for parameter, part in self.by_parameter(values):
            conditions = parameter.apply(part, conditions, examples)
        return conditions

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        """Images (A, V, 3, size, size) in [0, 1] of examples (A,) under values (A, D)."""
        return self.scene.render(self.conditions(values, examples), examples)

    @torch.no_grad()
    def images(self, values: Tensor, examples: Tensor | None = None) -> Tensor:
        """(A, V, 3, size, size) of examples (A,), by default all, with values (E, D) of all; rendered by parts."""
        size, examples = self.scene.settings.size, self.everything if examples is None else examples
        images = values.new_empty(len(examples), self.scene.views, 3, size, size)
        parts = [*zip(images.split(self.at_once), examples.split(self.at_once), strict=True)]
        for part, rows in progress(parts, "images") if len(parts) > 1 else parts:
            part.copy_(self.render(values[rows], rows))
        return images

    def step(self, gradient: Tensor) -> Tensor:
        """The step for a gradient (A, D), to be subtracted."""
        return torch.cat([parameter.settings.along(part) for parameter, part in self.by_parameter(gradient)], dim=1)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """The nearest permitted values (A, D) of examples (A,)."""
        return torch.cat([parameter.project(part, examples) for parameter, part in self.by_parameter(values)], dim=1)

    def sample(self, generator: torch.Generator, reached: Tensor | None = None) -> Tensor:
        """Draws (E, D), one parameter after the other; see `Parameter.sample`."""
        pairs = self.by_parameter(self.start if reached is None else reached)
        draws = (parameter.sample(generator, None if reached is None else part) for parameter, part in pairs)
        return torch.cat([draw.to(self.start) for draw in draws], dim=1)

    def by_parameter(self, values: Tensor) -> list[tuple[Parameter, Tensor]]:
        """Each parameter with its part (A, D_k) of values (A, D)."""
        return [*zip(self.parameters, values.split(self._sizes, dim=1), strict=True)]
