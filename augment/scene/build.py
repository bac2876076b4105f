"""Build a scene from meshes, names of lightings and files of backgrounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from augment.progress import progress
from augment.scene.degree import degree_of_scene, reached_gloss, warn_of_low_degree
from augment.scene.objects import SceneObject, add_table, load_object
from augment.scene.scene import Scene
from augment.settings import LOCAL_LIGHT_SETTINGS, ObjectSettings, RendererSettings, SceneSettings
from renderer.camera import Camera, orbit_cameras
from renderer.errors import InputError, as_device, describe, require_bounded
from renderer.io.images import gray_or_image
from renderer.light.basis import Basis, LocalBasis, with_local_lights
from renderer.light.harmonics import degree_of
from renderer.light.local_lights import LOCAL_LIGHTS
from renderer.light.presets import load_light
from renderer.mesh import Mesh, require_mesh, subdivide
from renderer.settings import ImageSettings
from renderer.validation import as_list, as_tensor, require_flag, require_kind, require_whole
from renderer.visibility.rasterizer import choose

if TYPE_CHECKING:
    from augment.attack_settings import AttackSettings
    from augment.settings import VariationSettings

# Description of a valid label in error messages.
LABEL = "the name of a class, or its index"
# A mesh is given as the path of its file, as "solid:NAME", or as a `Mesh`.
MeshSource = str | Path | Mesh
# Names of the fields of `SceneSettings` and `RendererSettings` that `build_scene` takes as keyword
# arguments.
SCENE_OPTIONS = {item.name for item in fields(SceneSettings)} - {"views"}
RENDERER_OPTIONS = {item.name for item in fields(RendererSettings)}


def build_scene(
    meshes: Sequence[ObjectSettings | tuple[MeshSource, str | int]],
    size: int,
    views: int = 1,
    *,
    cameras: Sequence[Camera] | None = None,
    normalize: bool = True,
    shared: bool = False,
    scene: SceneSettings | None = None,
    renderer: RendererSettings | None = None,
    attack: AttackSettings | None = None,
    vary: VariationSettings | None = None,
    device: torch.device | str = "cpu",
    **options: Any,
) -> Scene:
    """Build a scene that shows every mesh from every camera in front of every background.

    Args:
        meshes: Pairs of a mesh and the name or the index of its class, or
            `ObjectSettings`. A mesh is a file, solid:NAME or a `Mesh`.
        size: Pixels per side of the images.
        views: Number of cameras, which are placed on a circle around the mesh.
        cameras: Cameras to use instead of a circle, such as those of
            `nb.load_cameras`. `views` must then be left out.
        normalize: Whether the cameras see each mesh moved to the origin and
            scaled to span [-1, 1]. If False, they see it at its place, in the
            units of its file. The scene then moves and scales mesh and cameras
            together. In both cases, lengths in settings, such as positions of
            lamps, are measured from the center of the object in units of its
            `SceneObject.extent`.
        shared: Whether all views of an object in front of a background are one
            example, for which an attack finds one lighting, shape and color. By
            default, each view is an example of its own.
        scene: Further settings of the scene. Its `views` are
            ignored.
        renderer: Settings of the renderer.
        attack: Settings of an attack that will follow. The attack may make
            surfaces smoother. The degree of the lighting is then high enough
            for their highlights.
        vary: Settings of a random variation (`augment.scene.variation.vary`)
            that will follow. They matter for the same reason.
        device: Device of the images.
        options: Fields of `SceneSettings` or `RendererSettings`, which replace
            those of `scene` and `renderer`.

    Returns:
        The scene.

    Raises:
        InputError: If an argument has the wrong type, is unknown or out of
            bounds, if a file is missing, or if the renders do not fit in
            memory.

    Example:
        >>> from dataclasses import replace
        >>> import norm_balls as nb
        >>> meshes = [("solid:orange", "orange"), ("solid:apple", "apple")]
        >>> scene = nb.build_scene(meshes, size=32, views=3, backgrounds=[0.2, 0.8], samples=1)
        >>> len(scene), scene.labels[0]
        (12, 'orange')

        A mesh and cameras in world units, as photogrammetry gives them:

        >>> mesh = nb.solid("orange")
        >>> placed = replace(mesh, vertices=mesh.vertices + [10.0, 0.0, 0.0])
        >>> view = [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 15], [0, 0, 0, 1]]
        >>> camera = nb.PinholeCamera.from_matrix(view, [[40, 0, 16], [0, 40, 16], [0, 0, 1]], 32)
        >>> scene = nb.build_scene([(placed, "orange")], 32, cameras=[camera], normalize=False)
        >>> round(scene.objects[0].center[0])
        10
    """
    require_kind("scene", scene, SceneSettings | None, "SceneSettings(...) or None")
    require_kind("renderer", renderer, RendererSettings | None, "RendererSettings(...) or None")
    require_flag("shared", shared)
    require_whole("views", views)
    require_flag("normalize", normalize)
    given_cameras = _as_cameras(cameras, views, normalize)
    views = len(given_cameras) or views
    ImageSettings(size)
    _require_known(options)
    members = _as_meshes(meshes)
    scene_options = {name: options[name] for name in options.keys() & SCENE_OPTIONS}
    renderer_options = {name: options[name] for name in options.keys() - SCENE_OPTIONS}
    scene_settings = replace(scene or SceneSettings(), views=views, **scene_options)
    renderer_settings = replace(renderer or RendererSettings(), **renderer_options)
    objects = []
    for member in progress(members, "reading meshes"):
        item = _load_member(member, scene_settings.vertices)
        objects.append(add_table(item, scene_settings.ground))
    environment: Any = scene_settings.light
    is_named = isinstance(environment, str | Path)
    degree = None
    if is_named:
        material = attack.material if attack else None
        smoothest = reached_gloss(objects, material, vary.gloss if vary else None)
        pixels = views * len(objects) * size**2
        degree = degree_of_scene(smoothest, scene_settings.degree, pixels)
        environment = load_light(environment, degree, smoothest.gloss_roughness)
        warn_of_low_degree(str(scene_settings.light), environment)
    else:
        environment = as_tensor("light", environment)
        # `degree_of` raises InputError if the shape is not that of coefficients.
        degree_of(environment)
        require_bounded(light=environment)
    basis, lights = _build_lights(scene_settings, environment, degree)
    # `lights_of_degree` loads the lighting again with a higher degree, which a smoother surface
    # may need later. It stays None if the user gave coefficients or chose the degree.
    lights_of_degree = None
    if is_named and scene_settings.degree is None:
        lights_of_degree = partial(_build_lights, scene_settings, scene_settings.light)
    rasterizer = renderer_settings.rasterizer
    return Scene.grid(
        objects,
        given_cameras or _place_cameras(scene_settings, views),
        load_backgrounds(scene_settings.backgrounds, size),
        lights.to(as_device(device)),
        renderer_settings.image(size),
        choose(rasterizer) if isinstance(rasterizer, str) else rasterizer,
        shared=shared,
        placed=not normalize,
        basis=basis,
        lights_of_degree=lights_of_degree,
    )


def _require_known(options: Mapping[str, Any]) -> None:
    """Check that `build_scene` got known options only: fields of two classes of settings."""
    known = SCENE_OPTIONS | RENDERER_OPTIONS
    unknown = sorted(options.keys() - known)
    if unknown:
        choices = ", ".join(sorted(known))
        raise InputError(f"{unknown[0]} is no option of build_scene: choose from {choices}")


def _as_meshes(meshes: object) -> list[Any]:
    """Check the argument `meshes` of `build_scene`, and return it as a list."""
    expected = "a list of pairs such as ('solid:orange', 'orange'), or of nb.ObjectSettings"
    members = as_list("meshes", meshes, ObjectSettings | tuple | list, expected)
    if not members:
        raise InputError("meshes is empty: give pairs such as ('solid:orange', 'orange')")
    for index, member in enumerate(members):
        if isinstance(member, ObjectSettings):
            require_kind(f"meshes[{index}].label", member.label, str, LABEL)
            continue
        if len(member) != 2:
            raise InputError(
                f"meshes[{index}] is {describe(member)}: give a pair of a mesh and a label, "
                "such as ('solid:orange', 'orange')"
            )
        mesh, label = member
        if not isinstance(mesh, str | Path):
            require_mesh(f"meshes[{index}]", mesh)
        require_kind(f"meshes[{index}]: its label", label, str | int, LABEL)
    return members


def _load_member(
    member: ObjectSettings | tuple[MeshSource, str | int], vertices: int
) -> SceneObject:
    """Load an object from a member of the argument `meshes` of `build_scene`."""
    if isinstance(member, ObjectSettings):
        return load_object(member, vertices)
    mesh, label = member
    if isinstance(mesh, Mesh):
        return SceneObject.from_mesh(label, subdivide(mesh, vertices))
    loaded = load_object(ObjectSettings(str(mesh), str(label)), vertices)
    # An index remains a number, because a class may have this number as its name.
    return replace(loaded, label=label)


def _as_cameras(cameras: object, views: int, normalize: bool) -> list[Camera]:
    """Check the arguments `cameras`, `views` and `normalize` of `build_scene`.

    Return the given cameras without gradients, or an empty list for None.
    """
    if cameras is None:
        if not normalize:
            raise InputError(
                "normalize=False needs cameras: give cameras=[...] in the coordinates of the mesh"
            )
        return []
    expected = "a list of cameras, such as list(nb.load_cameras(path).values())"
    given = as_list("cameras", cameras, Camera, expected)
    if not given:
        raise InputError("cameras is empty: give one camera for each view, or leave it out")
    if views not in (1, len(given)):
        raise InputError(f"views={views} does not fit {len(given)} cameras: leave views out")
    fixed = [camera.fixed() for camera in given]
    if not normalize:
        return fixed
    # The scene turns cameras about the origin. Make the origin the center of these cameras.
    return [camera.normalized(np.zeros(3), 1.0) for camera in fixed]


def _place_cameras(settings: SceneSettings, count: int) -> list[Camera]:
    """Place cameras on a circle around the object, as the settings of a scene say."""
    return orbit_cameras(count, settings.width, settings.polar, settings.azimuth, settings.fov)


def _build_lights(
    settings: SceneSettings,
    environment: Tensor | str | Path,
    degree: int | None,
    roughness: float | None = None,
) -> tuple[Basis, Tensor]:
    """Join the environment lighting with the projector and the lamps of the settings.

    A named lighting is loaded with the degree, for a roughness that is None without gloss. Return
    the basis of all lights and their RGB coefficients.
    """
    if isinstance(environment, str | Path):
        environment = load_light(environment, degree, roughness)
    local_settings = [getattr(settings, name) for name in LOCAL_LIGHTS]
    local = [build_local_light(light) for light in local_settings if light is not None]
    return with_local_lights(environment * settings.exposure, local)


def build_local_light(settings: Any) -> tuple[LocalBasis, Tensor]:
    """Build a local light, which is a projector or a group of lamps.

    Return its basis and its RGB coefficients: the pixels of the projector or the powers of the
    lamps.
    """
    for name, kind in LOCAL_LIGHTS.items():
        if type(settings) is LOCAL_LIGHT_SETTINGS[name]:
            return kind.from_settings(settings)
    raise TypeError(f"{type(settings).__name__} is not the settings of a local light")


def load_backgrounds(choices: Sequence[float | str | Path], size: int) -> Tensor:
    """Load the backgrounds of a scene.

    The shape is (B, 3, size, size), or (B, 1, size, size) if all backgrounds are gray.
    """
    expected = "a list of gray values in [0, 1] or image files"
    choices = as_list("backgrounds", choices, object, expected)
    if not choices:
        raise InputError("backgrounds is empty: give gray values in [0, 1] or image files")
    images = [gray_or_image("backgrounds", choice, size) for choice in choices]
    channels = max(len(image) for image in images)
    return torch.stack([image.expand(channels, -1, -1) for image in images])
