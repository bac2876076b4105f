"""A scene from meshes in one call, with the choices of the commands as keywords."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from augment.backgrounds import load_backgrounds
from augment.objects import ObjectSettings, SceneObject, load_object, on_ground
from augment.placed_lights import LampsSettings, ProjectorSettings
from augment.scene import Scene
from renderer.arguments import as_device, checked
from renderer.basis import with_placed
from renderer.cache import OperatorCache
from renderer.camera import ring
from renderer.errors import FACTOR, InputError, require_range
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.mesh import Mesh, normalise
from renderer.subdivision import subdivide
from renderer.visibility import Backend, choose

Shown = str | Path | Mesh
Member = ObjectSettings | tuple[Shown, str]


@checked
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
    field_of_view: float = 2.0,
    perspective: float | None = None,
    vertices: int = 0,
    samples: int = 2,
    encoding: str = "linear",
    normals: str = "smooth",
    transport: str = "direct",
    visibility: str | Backend = "auto",
    operators: OperatorCache | None = None,
    device: torch.device | str = "cpu",
) -> Scene:
    """Every mesh from a ring of views over every background, at `size` pixels per side.

    meshes: (file, solid:NAME or `Mesh`; the name of its class) each, or `ObjectSettings`. shared: the views of an
    example share one light, shape or colour; otherwise each is an example. backgrounds: grey values or image files.
    light: coefficients or what `renderer.load_light` takes; exposure multiplies it. projector, lamps: that shine as
    well. ground: the colour of a table under each mesh (`on_ground`). polar: degrees off +z; azimuth: of the first
    view, off +x. field_of_view: width of the image in world units. perspective: degrees between its sides, None of an
    orthographic camera. vertices: subdivide until there are more. samples, encoding, normals, transport, visibility:
    as for `renderer.render`, or a rasteriser that was chosen. operators: where rendered views are kept.
    InputError: what is missing, unknown or out of bounds, and more renders than there is memory for.
    """
    settings, device = ImageSettings(size, samples, encoding, normals, transport), as_device(device)
    require_range("exposure", exposure, 0, FACTOR)
    sky = (load_light(light) if isinstance(light, str) else light) * exposure
    basis, lights = with_placed(sky, [each.build() for each in (projector, lamps) if each is not None])
    angle = None if perspective is None else math.radians(perspective)
    return Scene.grid(
        [on_ground(_object(member, vertices), ground) for member in meshes],
        ring(views, field_of_view, math.radians(polar), math.radians(azimuth), angle),
        load_backgrounds(backgrounds, size),
        lights.to(device),
        settings,
        choose(visibility) if isinstance(visibility, str) else visibility,
        operators,
        shared=shared,
        basis=basis,
    )


def _object(member: Member, vertices: int) -> SceneObject:
    if isinstance(member, ObjectSettings):
        return load_object(member, vertices)
    mesh, label = member
    if isinstance(mesh, Mesh):
        return SceneObject(label, normalise(subdivide(mesh, vertices)))
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
