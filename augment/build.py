"""A scene from meshes in one call."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.backgrounds import load_background, load_backgrounds
from augment.objects import ObjectSettings, SceneObject, load_object, on_ground
from augment.scene import Scene
from renderer.cache import OperatorCache
from renderer.camera import orbit_cameras
from renderer.errors import FACTOR, InputError, as_device, require_range
from renderer.image import ImageSettings
from renderer.io.lights import read_light
from renderer.light.basis import with_local_lights
from renderer.light.local import Lamps, Projector
from renderer.light.presets import load_light
from renderer.mesh import Mesh, normalize
from renderer.rasterizer import Rasterizer, choose
from renderer.subdivision import subdivide


@dataclass
class ProjectorSettings:
    """A `Projector`, its angles in degrees. pattern: where attacks begin, in shares of its power: a gray value or an
    image file."""

    pixels: int = 16
    polar: float = 45.0
    azimuth: float = 45.0
    distance: float = 4.0
    fov: float = 30.0
    power: float = 1.0
    pattern: Any = 0.0

    def build(self) -> tuple[Projector, Tensor]:
        """The basis, and the pattern (pixels², 3)."""
        require_range("scene.projector.polar", self.polar, 0, 180)
        require_range("scene.projector.azimuth", self.azimuth, -360, 360)
        require_range("scene.projector.fov", self.fov, 0.1, 170)
        polar, azimuth, fov = map(math.radians, (self.polar, self.azimuth, self.fov))
        basis = Projector(self.pixels, polar, azimuth, self.distance, fov, self.power)
        pattern = load_background(self.pattern, self.pixels, "scene.projector.pattern").expand(3, -1, -1)
        return basis, self.power * pattern.flatten(1).T


@dataclass
class LampsSettings:
    """`Lamps` at places [x, y, z], above four corners unless told otherwise, points or discs of a radius. start: the
    powers that attacks begin with, a number, [r, g, b] of each lamp, or the lamps.json of an adversary, whose places,
    power and radius take the others' place."""

    positions: list[Any] = field(default_factory=lambda: [[x, y, 2.0] for x in (2.0, -2.0) for y in (2.0, -2.0)])
    power: float = 10.0
    radius: float = 0.0
    start: Any = 0.0

    def build(self) -> tuple[Lamps, Tensor]:
        """The basis, and the powers (L, 3)."""
        if isinstance(self.start, str):
            lamps, powers = read_light(Path(self.start), Lamps)
            return lamps, lamps.project_nonnegative(powers)
        try:
            positions = tuple((float(x), float(y), float(z)) for x, y, z in self.positions)
            start = torch.tensor(self.start, dtype=torch.float32).expand(len(positions), 3)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise InputError(
                f"scene.lamps: give positions [x, y, z] and, as start, a number or [r, g, b]s ({error})"
            ) from error
        basis = Lamps(positions, self.power, self.radius)
        if not ((start >= 0) & (start <= self.power)).all():  # NaN is neither
            raise InputError(f"scene.lamps.start={self.start}: give powers from 0 to scene.lamps.power={self.power:g}")
        return basis, basis.project_nonnegative(start)


Shown = str | Path | Mesh
Member = ObjectSettings | tuple[Shown, str]


def build_scene(
    meshes: Sequence[Member],
    size: int,
    views: int = 1,
    *,
    shared: bool = False,
    backgrounds: Sequence[float | str | Path] = (0.5,),
    light: str | Tensor = "grace",
    exposure: float = 1.0,
    projector: ProjectorSettings | None = None,
    lamps: LampsSettings | None = None,
    ground: Sequence[float] | None = None,
    polar: float = 60.0,
    azimuth: float = 0.0,
    width: float = 2.0,
    fov: float | None = None,
    vertices: int = 0,
    samples: int = 2,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    rasterizer: str | Rasterizer = "auto",
    operators: OperatorCache | None = None,
    device: torch.device | str = "cpu",
) -> Scene:
    """Every mesh from a ring of views over every background, at `size` pixels per side.

    meshes: (file, solid:NAME or `Mesh`; the name of its class) each, or `ObjectSettings`. shared: the views of an
    example share one light, shape or color; otherwise each is an example. backgrounds: gray values or image files.
    light: coefficients or what `renderer.load_light` takes; exposure multiplies it. projector, lamps: that shine as
    well. ground: the color of a table under each mesh (`on_ground`). polar: degrees off +z; azimuth: of the first
    view, off +x. width: width of the image in world units. fov: degrees between its sides, None of an
    orthographic camera. vertices: subdivide until there are more. samples, encoding, normals, shadows,
    bounces, rasterizer: as for `renderer.render`, or a rasterizer that was chosen. operators: where rendered views are
    kept.
    InputError: what is missing, unknown or out of bounds, and more renders than there is memory for.

    >>> scene = build_scene([("solid:orange", "orange"), ("solid:apple", "apple")], 32, views=3, backgrounds=[0.2, 0.8])
    >>> len(scene), scene.labels[0]
    (12, 'orange')
    """
    settings, device = ImageSettings(size, samples, encoding, normals, shadows, bounces), as_device(device)
    require_range("exposure", exposure, 0, FACTOR)
    sky = (load_light(light) if isinstance(light, str) else light) * exposure
    basis, lights = with_local_lights(sky, [each.build() for each in (projector, lamps) if each is not None])
    angle = None if fov is None else math.radians(fov)
    return Scene.grid(
        [on_ground(_object(member, vertices), ground) for member in meshes],
        orbit_cameras(views, width, math.radians(polar), math.radians(azimuth), angle),
        load_backgrounds(backgrounds, size),
        lights.to(device),
        settings,
        choose(rasterizer) if isinstance(rasterizer, str) else rasterizer,
        operators,
        shared=shared,
        basis=basis,
    )


def _object(member: Member, vertices: int) -> SceneObject:
    if isinstance(member, ObjectSettings):
        return load_object(member, vertices)
    mesh, label = member
    if isinstance(mesh, Mesh):
        return SceneObject(label, normalize(subdivide(mesh, vertices)))
    return load_object(ObjectSettings(str(mesh), label), vertices)


def count_views(examples: int | None, objects: int, backgrounds: int, views: int | None) -> int:
    """Views per mesh, so that meshes × views × backgrounds are the examples; either is derived where it is None.

    The paper's 100 examples are 2 meshes × 10 views × 5 backgrounds. InputError where no such product exists.
    """
    if not objects or not backgrounds:
        raise InputError("scene.meshes and scene.backgrounds must not be empty: name one mesh and one background")
    if examples is None:
        if views is None:
            raise InputError("augment.examples=null makes as many renders as scene.views says: set either")
        return views
    derived, rest = divmod(examples, objects * backgrounds)
    if rest or derived < 1:
        raise InputError(
            f"augment.examples={examples} is not a multiple of {objects} meshes × {backgrounds} backgrounds: "
            f"set it to a multiple of {objects * backgrounds}"
        )
    if views is not None and views != derived:
        raise InputError(
            f"augment.examples={examples} is not {objects} meshes × {views} views × {backgrounds} backgrounds = "
            f"{objects * views * backgrounds}: change one of them, or set scene.views=null to derive the views"
        )
    return derived
