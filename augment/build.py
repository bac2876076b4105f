"""A scene from meshes in one call, its backgrounds, and the settings of scene, renderer and local lights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from augment.degree import degree_of_scene, reached_gloss, warn_of_cut_light
from augment.objects import ObjectSettings, SceneObject, load_object, on_ground
from augment.progress import progress
from augment.scene import Scene
from renderer.camera import MOST_VIEWS, orbit_cameras
from renderer.errors import (
    FACTOR,
    InputError,
    as_device,
    require_bounded,
    require_choice,
    require_range,
)
from renderer.image import ImageSettings, samples_per_side
from renderer.io.images import gray_or_image
from renderer.light.basis import Basis, with_local_lights
from renderer.light.harmonics import MAX_DEGREE, degree_of
from renderer.light.lamps import Lamps
from renderer.light.local_lights import LOCAL_LIGHTS
from renderer.light.presets import load_light
from renderer.light.projector import Projector
from renderer.mesh import MOST_VERTICES, Mesh, normalize, require_mesh, subdivide
from renderer.rasterizer import NAMES, Rasterizer, choose
from renderer.validation import (
    as_list,
    as_tensor,
    describe,
    require_field_types,
    require_flag,
    require_kind,
    require_whole,
)

if TYPE_CHECKING:
    from augment.attacks.attack import AttackSettings
    from augment.variation import VariationSettings


@dataclass
class ProjectorSettings:
    """A `Projector`; angles in degrees. pattern: where attacks begin, a gray or an image file, of its power."""

    pixels: int = 16
    polar: float = 45.0
    azimuth: float = 45.0
    distance: float = 4.0
    fov: float = 30.0
    power: float = 1.0
    pattern: Any = 0.0

    def build(self) -> tuple[Projector, Tensor]:
        """Return the projector and the pattern (pixels², 3) that attacks begin with."""
        require_field_types(self)
        return Projector.from_settings(self)


@dataclass
class LampsSettings:
    """`Lamps` at positions [x, y, z], by default above four corners; points, or discs with a radius. start: the powers
    that attacks begin with, a number, [r, g, b] of each lamp, or the lamps.json of an adversary, whose positions, power
    and radius replace the others."""

    positions: list[Any] = field(default_factory=lambda: [[x, y, 2.0] for x in (2.0, -2.0) for y in (2.0, -2.0)])
    power: float = 10.0
    radius: float = 0.0
    start: Any = 0.0

    def build(self) -> tuple[Lamps, Tensor]:
        """Return the lamps and the powers (L, 3) that attacks begin with."""
        require_field_types(self)
        return Lamps.from_settings(self)


LOCAL_LIGHT_SETTINGS = {"projector": ProjectorSettings, "lamps": LampsSettings}


@dataclass
class SceneSettings:
    """What `build_scene` shows, and how; the schema of a command's `scene`, too.

    meshes: a file, `solid:NAME`, or a mapping with the keys of `ObjectSettings`, each. backgrounds: gray values or
    image files. views: cameras on a circle around each mesh; None where something else tells. polar: degrees off +z.
    azimuth: of the first view, degrees off +x towards +y. width: of the image in world units; a mesh spans [-1, 1].
    fov: degrees between the image's sides, as of a camera at that distance; None for parallel rays. vertices: subdivide
    meshes until they have more. light: what `renderer.load_light` takes or, in Python, coefficients. degree: of such a
    light; None for 6 or, where gloss is or becomes smoother than that shows, for what it needs. exposure: multiplies
    it. projector, lamps: local lights beside it. ground: color of a table under each mesh, RGB as displayed.
    """

    meshes: list[Any] = field(default_factory=lambda: ["solid:orange:0"])
    backgrounds: list[Any] = field(default_factory=lambda: [0.5])
    views: int | None = 1
    polar: float = 60.0
    azimuth: float = 0.0
    width: float = 2.0
    fov: float | None = None
    vertices: int = 0
    light: str = "grace"
    degree: int | None = None
    exposure: float = 1.0
    projector: ProjectorSettings | None = None
    lamps: LampsSettings | None = None
    ground: list[float] | None = None

    def __post_init__(self) -> None:
        require_field_types(self, "light", "vertices")
        require_range("exposure", self.exposure, 1 / FACTOR, FACTOR)
        require_range("degree", self.degree, 0, MAX_DEGREE)
        require_range("views", self.views, 1, MOST_VIEWS)
        require_range("vertices", self.vertices, 0, MOST_VERTICES)
        require_range("polar", self.polar, 0, 180)
        require_range("azimuth", self.azimuth, -360, 360)
        require_range("fov", self.fov, 0.1, 150)


@dataclass
class RendererSettings:
    """How `build_scene` renders; the schema of a command's `renderer`, too.

    rasterizer: auto, opengl, numba or numpy; or in Python, one that was chosen. samples, encoding, normals, shadows,
    bounces, silhouettes: as for `renderer.render`.
    """

    rasterizer: str = "auto"
    samples: int | None = None
    encoding: str = "linear"
    normals: str = "smooth"
    shadows: bool = False
    bounces: int = 0
    silhouettes: bool = False

    def __post_init__(self) -> None:
        self.image(size=1)  # which checks most
        if not isinstance(self.rasterizer, Rasterizer):
            require_choice("rasterizer", self.rasterizer, NAMES)

    def image(self, size: int) -> ImageSettings:
        """The settings of an image of `size` pixels per side."""
        choices = {name: value for name, value in vars(self).items() if name != "rasterizer"}
        choices["samples"] = samples_per_side(self.samples, self.silhouettes)
        return ImageSettings(size, **choices)


Shown = str | Path | Mesh
SCENE = {item.name for item in fields(SceneSettings)} - {"meshes", "views"}


def build_scene(
    meshes: Sequence[ObjectSettings | tuple[Shown, str]],
    size: int,
    views: int = 1,
    *,
    shared: bool = False,
    scene: SceneSettings | None = None,
    renderer: RendererSettings | None = None,
    attack: AttackSettings | None = None,
    vary: VariationSettings | None = None,
    device: torch.device | str = "cpu",
    **options: Any,
) -> Scene:
    """Every mesh from a circle of views over every background, at `size` pixels per side.

    meshes: pairs of a file, solid:NAME or `Mesh`, and the name of its class; or `ObjectSettings`. shared: the views of
    an example share one light, shape or color; otherwise each view is an example. scene, renderer: all further choices
    (their own `meshes` and `views` are ignored). attack, vary: what the scene will go through, by whose least roughness
    the degree of the light is chosen. options: fields of scene or renderer, which take precedence.
    InputError: what is missing, unknown or out of bounds, and more renders than there is memory for.

    >>> meshes = [("solid:orange", "orange"), ("solid:apple", "apple")]
    >>> scene = build_scene(meshes, size=32, views=3, backgrounds=[0.2, 0.8], polar=70.0, samples=1)
    >>> len(scene), scene.labels[0]
    (12, 'orange')
    """
    require_kind("scene", scene, SceneSettings | None, "SceneSettings(...) or None")
    require_kind("renderer", renderer, RendererSettings | None, "RendererSettings(...) or None")
    require_flag("shared", shared)
    require_whole("views", views)
    ImageSettings(size)
    known = SCENE | {item.name for item in fields(RendererSettings)}
    if unknown := sorted(options.keys() - known):
        raise InputError(f"{unknown[0]} is no option of build_scene: choose from {', '.join(sorted(known))}")
    meshes = _as_meshes(meshes)
    of_scene = {name: options.pop(name) for name in SCENE & options.keys()}
    shown = replace(scene or SceneSettings(), views=views, **of_scene)
    drawn = replace(renderer or RendererSettings(), **options)
    read = (_object(member, shown.vertices) for member in progress(meshes, "reading meshes"))
    objects = [on_ground(item, shown.ground) for item in read]
    environment: Any = shown.light
    named = isinstance(environment, str | Path)
    degree = None
    if named:
        reached = reached_gloss(objects, attack.material if attack else None, vary.gloss if vary else None)
        degree = degree_of_scene(reached, shown.degree, views * len(objects) * size**2)
        environment = load_light(environment, degree, reached.gloss)
        warn_of_cut_light(str(shown.light), environment)
    else:
        environment = as_tensor("light", environment)
        degree_of(environment)
        require_bounded(light=environment)
    basis, lights = _lights(shown, environment, degree)
    fov = None if shown.fov is None else math.radians(shown.fov)
    return Scene.grid(
        objects,
        orbit_cameras(views, shown.width, math.radians(shown.polar), math.radians(shown.azimuth), fov),
        load_backgrounds(shown.backgrounds, size),
        lights.to(as_device(device)),
        drawn.image(size),
        choose(drawn.rasterizer) if isinstance(drawn.rasterizer, str) else drawn.rasterizer,
        shared=shared,
        basis=basis,
        lights_of_degree=partial(_lights, shown, shown.light) if named and shown.degree is None else None,
    )


def _as_meshes(meshes: object) -> list[Any]:
    """Convert to a list of objects, or of pairs of what is shown and the name of its class; InputError otherwise."""
    expected = "a list of pairs such as ('solid:orange', 'orange'), or of augment.ObjectSettings"
    members = as_list("meshes", meshes, ObjectSettings | tuple | list, expected)
    if not members:
        raise InputError(f"meshes is empty: give {expected}")
    for index, member in enumerate(members):
        if isinstance(member, ObjectSettings):
            require_kind(f"meshes[{index}].label", member.label, str, "the name of a class")
            continue
        if len(member) != 2:
            raise InputError(f"meshes[{index}] is {describe(member)}: give {expected}")
        if not isinstance(member[0], str | Path):
            require_mesh(f"meshes[{index}]", member[0])
        require_kind(f"meshes[{index}]: its label", member[1], str, "the name of a class")
    return members


def _object(item: ObjectSettings | tuple[Shown, str], vertices: int) -> SceneObject:
    if isinstance(item, ObjectSettings):
        return load_object(item, vertices)
    mesh, label = item
    if isinstance(mesh, Mesh):
        return SceneObject(label, normalize(subdivide(mesh, vertices)))
    return load_object(ObjectSettings(str(mesh), label), vertices)


def _lights(
    shown: SceneSettings, environment: Tensor | str | Path, degree: int | None, roughness: float | None = None
) -> tuple[Basis, Tensor]:
    """The basis and the lights (size, 3) of the settings, of coefficients or of a named light of a degree, for surfaces
    of a roughness."""
    if isinstance(environment, str | Path):
        environment = load_light(environment, degree, roughness)
    settings = [getattr(shown, kind.name) for kind in LOCAL_LIGHTS]
    local = [light.build() for light in settings if light is not None]
    return with_local_lights(environment * shown.exposure, local)


def load_backgrounds(choices: Sequence[float | str | Path], size: int) -> Tensor:
    """(B, 3, size, size) of gray values or image files, or (B, 1, size, size) where all are gray; in [0, 1]."""
    choices = as_list("backgrounds", choices, object, "a list of gray values in [0, 1] or image files")
    if not choices:
        raise InputError("backgrounds is empty: give gray values in [0, 1] or image files")
    images = [gray_or_image("backgrounds", choice, size) for choice in choices]
    channels = max(len(image) for image in images)
    return torch.stack([image.expand(channels, -1, -1) for image in images])


def count_views(examples: int | None, objects: int, backgrounds: int, views: int | None) -> int:
    """Views per mesh, so that meshes × views × backgrounds are the examples; either is derived where it is None.

    The paper's 100 examples are 2 meshes × 10 views × 5 backgrounds. InputError where no such product exists.
    """
    if not objects or not backgrounds:
        raise InputError("scene.meshes and scene.backgrounds must not be empty: name one mesh and one background")
    if examples is None and views is not None:
        return views
    derived, rest = divmod(examples or 0, objects * backgrounds)
    if rest or derived < 1 or views not in (None, derived):
        product = f"{objects} meshes × {views or 'some'} views × {backgrounds} backgrounds"
        remedy = "derive the one from the other by scene.views=null or augment.examples=null"
        raise InputError(f"augment.examples={examples} is not {product}: change one of them, or {remedy}")
    return derived
