"""A scene from meshes in one call, its backgrounds, and the settings of scene, renderer and local lights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from augment.progress import progress
from augment.scene.degree import degree_of_scene, reached_gloss, warn_of_cut_light
from augment.scene.objects import SceneObject, load_object, on_ground
from augment.scene.scene import Scene
from augment.settings import LOCAL_LIGHT_SETTINGS, ObjectSettings, RendererSettings, SceneSettings
from renderer.camera import orbit_cameras
from renderer.errors import (
    InputError,
    as_device,
    describe,
    require_bounded,
)
from renderer.geometry.mesh import Mesh, normalize, require_mesh, subdivide
from renderer.io.images import gray_or_image
from renderer.light.basis import Basis, LocalBasis, with_local_lights
from renderer.light.harmonics import degree_of
from renderer.light.local_lights import LOCAL_LIGHTS
from renderer.light.presets import load_light
from renderer.settings import ImageSettings
from renderer.validation import as_list, as_tensor, require_flag, require_kind, require_whole
from renderer.visibility.rasterizers import choose

if TYPE_CHECKING:
    from augment.attacks.settings import AttackSettings
    from augment.settings import VariationSettings


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
    local = [build_local_light(light) for light in settings if light is not None]
    return with_local_lights(environment * shown.exposure, local)


def build_local_light(settings: Any) -> tuple[LocalBasis, Tensor]:
    """Build a local light.

    Args:
        settings: Settings of its kind, such as `ProjectorSettings`.

    Returns:
        The light, and the coefficients (size, 3) with which attacks start.

    Raises:
        InputError: If a file cannot be read, or a value does not fit the others.
    """
    [kind] = [kind for kind in LOCAL_LIGHTS if type(settings) is LOCAL_LIGHT_SETTINGS[kind.name]]
    return kind.from_settings(settings)


def load_backgrounds(choices: Sequence[float | str | Path], size: int) -> Tensor:
    """(B, 3, size, size) of gray values or image files, or (B, 1, size, size) where all are gray; in [0, 1]."""
    choices = as_list("backgrounds", choices, object, "a list of gray values in [0, 1] or image files")
    if not choices:
        raise InputError("backgrounds is empty: give gray values in [0, 1] or image files")
    images = [gray_or_image("backgrounds", choice, size) for choice in choices]
    channels = max(len(image) for image in images)
    return torch.stack([image.expand(channels, -1, -1) for image in images])
