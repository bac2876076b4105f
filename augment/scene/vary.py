"""Random variation of a scene: objects, cameras, lighting, backgrounds and camera effects."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.augmentation_settings import (
    CameraEffectSettings,
    SpecularLayerSettings,
    VariationSettings,
)
from augment.progress import progress
from augment.scene.camera_effects import draw_camera_effects, draw_image_files
from augment.scene.objects import (
    Example,
    SceneObject,
    add_specular_layer,
    resample_instance,
    rotated,
)
from augment.scene.patterns import pixel_centers, random_colors
from augment.scene.scene import Scene
from augment.scene.tabletop import Room, above_table, irradiance, project_along_light
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.image import clamp, decode, encode
from renderer.light.basis import harmonics_of, split_light
from renderer.light.files import directional, load_light
from renderer.light.harmonics import degree_of
from renderer.operators.rays import Rays
from renderer.surface.gloss import Gloss
from renderer.vectors import rotation_matrices

# Smallest and largest elevation of a camera above a table, in degrees.
MIN_ELEVATION = 15.0
MAX_ELEVATION = 75.0
# Smallest and largest distance of a wall behind an object, in world units.
WALL_DISTANCES = (1.8, 8.0)
# Largest difference in degrees between the direction of a random directional light and that of the
# camera, in polar angle and in azimuth.
MAX_LIGHT_ANGLE = 70.0


def vary(
    scene: Scene, settings: VariationSettings, draws: torch.Generator, once: bool = False
) -> Scene:
    """Change objects, cameras, lighting and backgrounds of a scene at random.

    All views of one example change in the same way. With `once`, the examples are rendered in one
    lighting only, and directly, without matrices from light to image.
    """
    is_on_table = torch.zeros(len(scene), dtype=torch.bool)
    if settings.tables:
        if scene.views > 1 or any(item.ground is not None for item in scene.objects):
            raise InputError(
                "tables require one view per example and objects without a table of their own: "
                "set views=1 and remove ground, or set tables=0",
            )
        is_on_table = torch.rand(len(scene), generator=draws) < settings.tables
    if settings.moves or settings.backgrounds is not None:
        scene = _vary_geometry(scene, settings, draws, once, is_on_table)
    if settings == VariationSettings():
        return scene
    return _vary_lighting(scene, settings, draws, is_on_table)


# Objects, cameras and backgrounds.


def _vary_geometry(
    scene: Scene,
    settings: VariationSettings,
    draws: torch.Generator,
    once: bool,
    is_on_table: Bool[Tensor, " E"],
) -> Scene:
    """Return a copy of a scene with random cameras, backgrounds and objects."""
    examples = _draw_cameras(scene, settings, draws, is_on_table)
    # Arguments of `Scene` that differ in the copy.
    changed: dict[str, Any] = {}
    if settings.backgrounds is not None:
        folder = Path(settings.backgrounds)
        size = scene.settings.size
        changed["backgrounds"] = draw_image_files(folder, "backgrounds", len(scene), size, draws)
        examples = _number_backgrounds(examples)
    if settings.instances or settings.rotation or any(settings.gloss.specular_factor):
        # Examples of the same object and the same cameras get the same random object. They
        # differ in their backgrounds only.
        pairs = [(example.object, example.cameras) for example in scene.examples]
        different_pairs = dict.fromkeys(pairs)
        pair_to_new_object = {pair: index for index, pair in enumerate(different_pairs)}
        objects = [scene.objects[object_index] for object_index, _ in different_pairs]
        changed["objects"] = _draw_objects(objects, settings, draws)
        examples = [
            replace(example, object=pair_to_new_object[pair])
            for example, pair in zip(examples, pairs, strict=True)
        ]
    # Direct rendering of a view in one lighting is faster than the construction of its transfer
    # operator, except if direct rendering would trace rays.
    needs_rays = bool(scene.basis.local_lights) or scene.settings.global_illumination
    one_light = once and settings.moves and not needs_rays
    return scene.changed(examples=examples, one_light=one_light, **changed)


def _draw_cameras(
    scene: Scene,
    settings: VariationSettings,
    draws: torch.Generator,
    is_on_table: Bool[Tensor, " E"],
) -> list[Example]:
    """Return copies of the examples of a scene with randomly changed cameras.

    The image is shifted and zoomed, and the camera turns around the object. If the settings
    have a range of fields of view, the camera also gets one of them. All cameras of one example
    get the same changes.
    """
    count = len(scene)
    shifts = _draw_pairs(settings.shift, count, draws)
    scales = _draw_log_uniform(settings.scale, count, draws)
    angles = _draw_pairs(settings.azimuth, count, draws)
    fovs = [0.0] * count
    if any(settings.fov):
        low, high = settings.fov
        fractions = torch.rand(count, generator=draws, dtype=torch.float64)
        fovs = (low + (high - low) * fractions).tolist()
    examples = []
    for index, example in enumerate(scene.examples):
        cameras = []
        for camera in example.cameras:
            moved = _move_camera(camera, shifts[index], scales[index], angles[index])
            if is_on_table[index]:
                moved = _raise_above_table(moved)
            if fovs[index]:
                moved = _to_perspective(moved, fovs[index])
            cameras.append(moved)
        examples.append(replace(example, cameras=tuple(cameras)))
    return examples


def _move_camera(
    camera: Camera, shift: Sequence[float], scale: float, angles: Sequence[float]
) -> Camera:
    """Return a copy of a camera that is zoomed, shifted and turned around the object.

    The shift is that of the object to the right and up, as fractions of the image width. `scale`
    enlarges the object. Angles are changes of polar angle and azimuth in degrees.
    """
    width = camera.width / scale
    right, up = shift
    polar, azimuth = angles
    turned = _turn_camera(camera, polar, azimuth)
    return replace(
        turned,
        width=width,
        right=camera.right + right * width,
        up=camera.up + up * width,
    )


def _turn_camera(camera: Camera, polar: float, azimuth: float) -> Camera:
    """Return a copy of a camera that is turned around the object."""
    return replace(camera, polar=camera.polar + polar, azimuth=camera.azimuth + azimuth)


def _raise_above_table(camera: Camera) -> Camera:
    """Return a copy of a camera whose elevation above a table is within limits.

    A camera below the horizon is mirrored to the same elevation above. The elevation is then
    limited to the range from `MIN_ELEVATION` to `MAX_ELEVATION`.
    """
    # The polar angle is measured from the vertical, so its cosine is the sine of the elevation.
    elevation = abs(math.degrees(math.asin(math.cos(math.radians(camera.polar)))))
    elevation = min(max(elevation, MIN_ELEVATION), MAX_ELEVATION)
    return replace(camera, polar=90 - elevation)


def _to_perspective(camera: Camera, fov: float) -> Camera:
    """Return a perspective copy of a camera with a given field of view.

    The copy is at such a distance that it sees the same width at the origin as before.
    """
    distance = camera.width / 2 / math.tan(math.radians(fov) / 2)
    if isinstance(camera, PerspectiveCamera):
        return replace(camera, distance=distance)
    fields_of_camera = {item.name: getattr(camera, item.name) for item in fields(Camera)}
    return PerspectiveCamera(**fields_of_camera, distance=distance)


def _number_backgrounds(examples: Sequence[Example]) -> list[Example]:
    """Return copies of examples, in which example i refers to background i."""
    return [replace(example, background=index) for index, example in enumerate(examples)]


def _draw_objects(
    objects: Sequence[SceneObject], settings: VariationSettings, draws: torch.Generator
) -> list[SceneObject]:
    """Return copies of objects with a random shape, rotation and gloss.

    A random shape is possible for generated solids only: another orange, for example.
    """
    varied = list(objects)
    if settings.instances:
        seeds = torch.randint(2**31, (len(varied),), generator=draws).tolist()
        pairs = progress(zip(varied, seeds, strict=True), "new instances", len(varied))
        varied = [resample_instance(item, seed) for item, seed in pairs]
    if settings.rotation:
        rotations = _draw_rotations(settings.rotation, len(varied), draws)
        varied = [rotated(item, rotation) for item, rotation in zip(varied, rotations, strict=True)]
    if any(settings.gloss.specular_factor):
        glosses = _draw_glosses(settings.gloss, len(varied), draws)
        varied = [
            add_specular_layer(item, gloss) for item, gloss in zip(varied, glosses, strict=True)
        ]
    return varied


def _draw_rotations(
    max_angle: float, count: int, draws: torch.Generator
) -> Float[np.ndarray, "count 3 3"]:
    """Draw rotations about random axes by random angles. The largest angle is in degrees."""
    axes = torch.randn(count, 3, generator=draws, dtype=torch.float64)
    angles = max_angle * torch.rand(count, 1, generator=draws, dtype=torch.float64)
    # A rotation vector points along the axis, and its length is the angle.
    rotation_vectors = angles * axes / axes.norm(dim=1, keepdim=True)
    return rotation_matrices(rotation_vectors).numpy()


def _draw_glosses(
    settings: SpecularLayerSettings, count: int, draws: torch.Generator
) -> list[Gloss]:
    """Draw glosses with a uniformly distributed roughness and specular factor."""
    # Row 0 is the roughness, row 1 the specular factor. Columns are the lowest and highest value.
    ranges = torch.tensor([settings.roughness, settings.specular_factor], dtype=torch.float64)
    fractions = torch.rand(count, 2, generator=draws, dtype=torch.float64)
    # Roughness and specular factor of each gloss, shape (count, 2).
    values = torch.lerp(ranges[:, 0], ranges[:, 1], fractions)
    return [
        Gloss(roughness, specular_factor=specular_factor)
        for roughness, specular_factor in values.tolist()
    ]


@dataclass(frozen=True, eq=False)
class _DrawnLights:
    """The random lighting of E examples.

    Attributes:
        environment: RGB coefficients of the environment lighting in K harmonics.
        directions: Unit vector from each object towards its directional light. Zero stands for no
            directional light.
        local: RGB coefficients of projector and lamps.
    """

    environment: Float[Tensor, "E K 3"]
    directions: Float[Tensor, "E 3"]
    local: Float[Tensor, "E L 3"]

    def coefficients(self) -> Float[Tensor, "E _ 3"]:
        """Combine environment, directional light, projector and lamps of each example.

        Directional lights are white, and a surface that faces them has irradiance 1. There are K
        for the environment, then L for projector and lamps.
        """
        environment = self.environment
        is_directional = self.directions.any(1)
        if is_directional.any():
            added = directional(self.directions, torch.ones(3), degree_of(environment[0]))
            # Add the directional light only in the examples that have one.
            mask = is_directional[:, None, None].to(environment.device)
            environment = torch.where(mask, added.to(environment) + environment, environment)
        return torch.cat([environment, self.local], dim=1)

    def without_ground(
        self, is_on_table: Bool[Tensor, " E"], albedo: Float[Tensor, "E C size size"]
    ) -> "_DrawnLights":
        """Return a copy in which the light from below is what a table reflects.

        The table has the mean albedo of the image, which is linear.
        """
        environment = self.environment.clone()
        environment[is_on_table] = above_table(
            environment[is_on_table],
            self.directions[is_on_table],
            albedo[is_on_table].mean((2, 3)),
        )
        return replace(self, environment=environment)


def _vary_lighting(
    scene: Scene,
    settings: VariationSettings,
    draws: torch.Generator,
    is_on_table: Bool[Tensor, " E"],
) -> Scene:
    """Return a copy of a scene with random lighting and random effects of the camera.

    The background of some examples becomes a table and a wall.
    """
    exposures = _draw_log_uniform(settings.exposure, len(scene), draws)
    examples = [
        replace(example, exposure=example.exposure * factor)
        for example, factor in zip(scene.examples, exposures, strict=True)
    ]
    lights = _draw_lights(scene, settings, draws, is_on_table)
    # Arguments of `Scene` that differ in the copy.
    changed: dict[str, Any] = {}
    # Point of a projected pattern that each pixel shows. None if the pattern fills the image.
    pattern_points = None
    if settings.lit_background or settings.tables or settings.background_saturation:
        albedo = _draw_background_albedo(scene, settings, draws)
        if settings.tables:
            lights = lights.without_ground(is_on_table, albedo)
        lit_scene = scene.changed(examples=examples, lights=lights.coefficients())
        changed["backgrounds"], pattern_points = _light_backgrounds(
            lit_scene, lights, albedo, settings, draws, is_on_table
        )
        # Each example now has a background of its own.
        examples = _number_backgrounds(examples)
    if settings.camera != CameraEffectSettings():
        changed["camera_effects"] = draw_camera_effects(
            settings.camera, len(scene), scene.settings, draws, scene.lights.device, pattern_points
        )
    return scene.changed(examples=examples, lights=lights.coefficients(), **changed)


def _light_backgrounds(
    scene: Scene,
    lights: _DrawnLights,
    albedo: Float[Tensor, "E _ size size"],
    settings: VariationSettings,
    draws: torch.Generator,
    is_on_table: Bool[Tensor, " E"],
) -> tuple[Tensor, Tensor | None]:
    """Compute the background images of all examples from their albedo and the random lighting.

    Return the images, and the x and y of the point of a projected pattern that each pixel shows,
    shape (2, E, size, size), or None without tables.
    """
    # If backgrounds are not lit, an irradiance of 1 leaves the albedo as it is.
    background_irradiance = albedo.new_ones(3, 1, 1)
    if settings.lit_background:
        background_irradiance = _facing_irradiance(scene)
    linear = albedo * background_irradiance
    pattern_points = None
    if settings.tables:
        wall_distances = _draw_log_uniform(WALL_DISTANCES, len(scene), draws)
        table_irradiance, pattern_points = _light_rooms(scene, lights, wall_distances, is_on_table)
        linear[is_on_table] = albedo[is_on_table] * table_irradiance.to(albedo)
    return encode(clamp(linear), scene.settings.encoding), pattern_points


def _draw_lights(
    scene: Scene,
    settings: VariationSettings,
    draws: torch.Generator,
    is_on_table: Bool[Tensor, " E"],
) -> _DrawnLights:
    """Draw a random environment and a random directional light for each example.

    Projector and lamps stay the same. So does the environment if the settings name none.
    """
    harmonics = harmonics_of(scene.basis)
    # Split the coefficients into those of the environment, and those of projector and lamps.
    environment, local = scene.lights.tensor_split([harmonics.size], dim=1)
    directions = torch.zeros(len(scene), 3, dtype=torch.float64)
    if settings.environments:
        chosen = torch.randint(len(settings.environments), (len(scene),), generator=draws)
        loaded = [load_light(light, harmonics.degree) for light in settings.environments]
        environment = torch.stack(loaded)[chosen].to(scene.lights)
    lights = _DrawnLights(environment, directions, local)
    if settings.directional_fraction > 0:
        lights = _draw_directional(lights, scene, settings, draws, is_on_table)
    return lights


def _draw_directional(
    lights: _DrawnLights,
    scene: Scene,
    settings: VariationSettings,
    draws: torch.Generator,
    is_on_table: Bool[Tensor, " E"],
) -> _DrawnLights:
    """Add a directional light to some examples, and dim their environment lighting.

    The directions are random, but differ from the direction of the camera by at most
    `MAX_LIGHT_ANGLE` in polar angle and in azimuth.
    """
    low, high = settings.fill_light
    shape = (len(scene), 1, 1)
    fill = low + (high - low) * torch.rand(shape, generator=draws)
    is_chosen = torch.rand(shape, generator=draws) < settings.directional_fraction
    angles = _draw_pairs(MAX_LIGHT_ANGLE, len(scene), draws)
    to_lights = []
    for example, (polar, azimuth) in zip(scene.examples, angles, strict=True):
        turned = _turn_camera(example.cameras[0], polar, azimuth)
        # The third axis of a camera points from the origin to the camera.
        to_lights.append(turned.axes()[2])
    directions = torch.from_numpy(np.stack(to_lights))
    # A table blocks light from below, so such directions are mirrored to above.
    grounds = [scene.objects[example.object].ground for example in scene.examples]
    has_table = is_on_table | torch.tensor([ground is not None for ground in grounds])
    directions[has_table, 2] = directions[has_table, 2].abs()
    environment = lights.environment
    dimmed = fill.to(environment) * environment
    return replace(
        lights,
        environment=torch.where(is_chosen.to(environment.device), dimmed, environment),
        directions=directions * is_chosen[:, 0],
    )


def _draw_background_albedo(
    scene: Scene, settings: VariationSettings, draws: torch.Generator
) -> Float[Tensor, "E _ size size"]:
    """Convert the background of each example to an albedo, and multiply it by a random color.

    The values of a background are taken as its albedo. The result is linear.
    """
    backgrounds = decode(scene.backgrounds, scene.settings.encoding)
    albedo = backgrounds[[example.background for example in scene.examples]]
    if settings.background_saturation:
        fractions = torch.rand(len(scene), 2, generator=draws)
        hue_and_saturation = fractions * torch.tensor([1, settings.background_saturation])
        albedo = albedo * random_colors(hue_and_saturation).to(albedo)
    return albedo


def _facing_irradiance(scene: Scene) -> Float[Tensor, "E 3 1 1"]:
    """Compute the irradiance of a surface that faces the camera, in the environment light.

    It is multiplied by the exposure. The first camera of each example counts.
    """
    # The normal of the surface points to the camera.
    directions = [example.cameras[0].axes()[2] for example in scene.examples]
    normals = torch.from_numpy(np.stack(directions))
    exposures = torch.tensor([example.exposure for example in scene.examples])[:, None]
    harmonics = harmonics_of(scene.basis)
    # RGB coefficients of the K harmonics that the irradiance depends on, shape (E, K, 3).
    coefficients = scene.lights.cpu().double()[:, harmonics.nonzero]
    facing = torch.einsum("ek,ekc->ec", harmonics.irradiance(normals), coefficients) * exposures
    return facing.to(scene.backgrounds)[:, :, None, None]


def _light_rooms(
    scene: Scene,
    lights: _DrawnLights,
    wall_distances: Sequence[float],
    is_on_table: Bool[Tensor, " E"],
) -> tuple[Tensor, Tensor]:
    """Light a table and a wall in some examples, and find where a projected pattern falls.

    The pattern falls on table, wall and object along the directional light of the example or, if it
    has none, along the direction of the view. Distances are in world units. Return the irradiance
    of table and wall in the N examples with a table, shape (N, 3, size, size), and the x and y of
    the point of the pattern that each pixel of all E examples shows, shape (2, E, size, size).
    """
    room_examples = torch.nonzero(is_on_table).squeeze(1).tolist()
    environments = lights.environment.cpu().double()
    settings = scene.settings
    irradiance_images = []
    # Without a table, the pattern fills the image: each pixel shows the point at its center.
    points = pixel_centers(settings.size).repeat(1, len(scene), 1, 1)
    # Build the ray tracer of an object once for all successive examples that show this object.
    groups = groupby(progress(room_examples, "tables"), lambda index: scene.examples[index].object)
    for object_index, examples_of_object in groups:
        item = scene.objects[object_index]
        rays = Rays(item.mesh)
        for index in examples_of_object:
            example = scene.examples[index]
            camera = example.cameras[0]
            room = Room(rays, item.radius, item.lowest, wall_distances[index])
            direction = lights.directions[index]
            local = split_light(scene.basis, scene.lights[index].cpu().double()).local_lights
            arriving = irradiance(room, camera, settings, environments[index], direction, local)
            irradiance_images.append(example.exposure * arriving)
            # A direction of zero stands for no directional light.
            if not direction.any():
                direction = torch.from_numpy(camera.axes()[2])
            points[:, index] = project_along_light(
                room, item.mesh, camera, settings, direction
            ).float()
    if not irradiance_images:
        return torch.zeros(0, 3, settings.size, settings.size), points
    return torch.stack(irradiance_images), points


# Random numbers.


def _draw_log_uniform(limits: Sequence[float], count: int, draws: torch.Generator) -> list[float]:
    """Draw numbers whose logarithms are uniformly distributed."""
    low, high = (math.log(limit) for limit in limits)
    fractions = torch.rand(count, generator=draws, dtype=torch.float64)
    return (low + (high - low) * fractions).exp().tolist()


def _draw_pairs(limit: float, count: int, draws: torch.Generator) -> list[list[float]]:
    """Draw pairs of numbers uniformly from [-limit, limit]."""
    fractions = torch.rand(count, 2, generator=draws, dtype=torch.float64)
    return (limit * (2 * fractions - 1)).tolist()
