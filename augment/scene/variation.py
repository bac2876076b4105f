"""Random variation of a scene: objects, cameras, lighting, backgrounds and camera effects."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.progress import progress
from augment.scene.camera_effects import draw_camera_effects
from augment.scene.conditions import Example
from augment.scene.objects import SceneObject, add_specular_layer, resample_instance, rotated
from augment.scene.patterns import pixel_centers, random_colors
from augment.scene.scene import Scene
from augment.scene.tabletop import Room, above_table, irradiance, project_along_light
from augment.settings import CameraEffectSettings, SpecularLayerSettings, VariationSettings
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.image import clamp, decode, encode
from renderer.io.images import SUFFIXES, read_image
from renderer.light.basis import harmonics_of, split_light
from renderer.light.harmonics import degree_of
from renderer.light.presets import directional, load_light
from renderer.shading.gloss import Gloss
from renderer.transport.rays import Rays
from renderer.vectors import rotation_matrices

# The elevation of a camera above a table, in degrees.
MIN_ELEVATION = 15.0
MAX_ELEVATION = 75.0
# The smallest and the largest distance of a wall behind the object, in world units.
WALL_DISTANCES = (1.8, 8.0)
# The largest angle from the camera to a directional light, around the object and up or down,
# in degrees.
MAX_LIGHT_ANGLE = 70.0


def vary(
    scene: Scene, settings: VariationSettings, draws: torch.Generator, once: bool = False
) -> Scene:
    """Return a scene whose examples differ at random from the examples of a scene.

    All views of one example are moved in the same way.

    Args:
        scene: Scene to vary.
        settings: Ranges of the random changes.
        draws: CPU generator of the random numbers.
        once: Whether the new examples are rendered in one lighting only. If so,
            no transfer operators are built for them.

    Returns:
        The new scene, or the given scene if the settings vary nothing.

    Raises:
        InputError: If the folder of backgrounds has no images, or if tables
            are asked for and the scene already has tables or several views per
            example.

    Example:
        >>> from augment.scene.build import build_scene
        >>> scene = build_scene([("solid:orange", "orange")], size=16, samples=1)
        >>> settings = VariationSettings(exposure=[2.0, 2.0])
        >>> varied = vary(scene, settings, torch.Generator().manual_seed(0))
        >>> [round(example.exposure, 3) for example in varied.examples]
        [2.0]
    """
    is_on_table = torch.zeros(len(scene), dtype=torch.bool)
    if settings.tables:
        if scene.views > 1 or any(item.ground is not None for item in scene.objects):
            fault = "tables require one view per example and objects without a table of their own"
            raise InputError(f"{fault}: set views=1 and remove ground, or set tables=0")
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
    is_on_table: Tensor,
) -> Scene:
    """Draw the cameras, the backgrounds and the objects of all examples."""
    examples = _draw_cameras(scene, settings, draws, is_on_table)
    changed: dict[str, Any] = {}
    if settings.backgrounds is not None:
        folder = Path(settings.backgrounds)
        size = scene.settings.size
        changed["backgrounds"] = _draw_background_files(folder, len(scene), size, draws)
        examples = _number_backgrounds(examples)
    if settings.instances or settings.rotation or any(settings.gloss.specular_factor):
        # The views that show the same object from the same cameras share a drawn object.
        views = [(example.object, example.cameras) for example in scene.examples]
        index_of_view = {view: index for index, view in enumerate(dict.fromkeys(views))}
        objects = [scene.objects[number] for number, _ in index_of_view]
        changed["objects"] = _draw_objects(objects, settings, draws)
        examples = [
            replace(example, object=index_of_view[view])
            for example, view in zip(examples, views, strict=True)
        ]
    # If a view is rendered in one lighting only, a transfer operator costs more than direct
    # rendering, except if direct rendering would trace rays.
    needs_rays = bool(scene.basis.local_lights) or scene.settings.global_illumination
    one_light = once and settings.moves and not needs_rays
    return scene.changed(examples=examples, one_light=one_light, **changed)


def _draw_cameras(
    scene: Scene, settings: VariationSettings, draws: torch.Generator, is_on_table: Tensor
) -> list[Example]:
    """Draw the position and the size of each object in the image, and the direction of the view."""
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
    """Zoom by a factor, shift by (right, up) in image widths, and turn by (polar, azimuth)."""
    width = camera.width / scale
    right, up = shift
    turned = _turn_camera(camera, *angles)
    return replace(
        turned,
        width=width,
        right=camera.right + right * width,
        up=camera.up + up * width,
    )


def _turn_camera(camera: Camera, polar: float, azimuth: float) -> Camera:
    """Add angles in degrees to the direction of a camera."""
    return replace(camera, polar=camera.polar + polar, azimuth=camera.azimuth + azimuth)


def _raise_above_table(camera: Camera) -> Camera:
    """Mirror a camera to above a table and limit its elevation."""
    elevation = abs(math.degrees(math.asin(math.cos(math.radians(camera.polar)))))
    elevation = min(max(elevation, MIN_ELEVATION), MAX_ELEVATION)
    return replace(camera, polar=90 - elevation)


def _to_perspective(camera: Camera, fov: float) -> Camera:
    """Return a perspective camera that sees the same width at the origin, for a fov in degrees."""
    distance = camera.width / 2 / math.tan(math.radians(fov) / 2)
    if isinstance(camera, PerspectiveCamera):
        return replace(camera, distance=distance)
    shared = {item.name: getattr(camera, item.name) for item in fields(Camera)}
    return PerspectiveCamera(**shared, distance=distance)


def _draw_background_files(folder: Path, count: int, size: int, draws: torch.Generator) -> Tensor:
    """Read images (count, 3, size, size), drawn with repetition from all files below a folder."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(
            f"backgrounds={folder} holds no image: give a folder of .jpg or .png files"
        )
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    images = [read_image(files[index], size) for index in progress(chosen, "reading backgrounds")]
    return torch.stack(images)


def _number_backgrounds(examples: Sequence[Example]) -> list[Example]:
    """Return copies of the examples in which example i has background i."""
    return [replace(example, background=index) for index, example in enumerate(examples)]


def _draw_objects(
    objects: Sequence[SceneObject], settings: VariationSettings, draws: torch.Generator
) -> list[SceneObject]:
    """Draw the instance, the rotation and the gloss of each object."""
    drawn = list(objects)
    if settings.instances:
        seeds = torch.randint(2**31, (len(drawn),), generator=draws).tolist()
        pairs = progress(zip(drawn, seeds, strict=True), "new instances", len(drawn))
        drawn = [resample_instance(item, seed) for item, seed in pairs]
    if settings.rotation:
        rotations = _draw_rotations(settings.rotation, len(drawn), draws)
        drawn = [rotated(item, rotation) for item, rotation in zip(drawn, rotations, strict=True)]
    if any(settings.gloss.specular_factor):
        glosses = _draw_glosses(settings.gloss, len(drawn), draws)
        drawn = [
            add_specular_layer(item, gloss) for item, gloss in zip(drawn, glosses, strict=True)
        ]
    return drawn


def _draw_rotations(max_angle: float, count: int, draws: torch.Generator) -> np.ndarray:
    """Draw matrices (count, 3, 3) of rotations by up to max_angle degrees about random axes."""
    axes = torch.randn(count, 3, generator=draws, dtype=torch.float64)
    angles = max_angle * torch.rand(count, 1, generator=draws, dtype=torch.float64)
    return rotation_matrices(angles * axes / axes.norm(dim=1, keepdim=True)).numpy()


def _draw_glosses(
    settings: SpecularLayerSettings, count: int, draws: torch.Generator
) -> list[Gloss]:
    """Draw the roughness and the specular factor of each gloss uniformly from their ranges."""
    ranges = torch.tensor([settings.roughness, settings.specular_factor], dtype=torch.float64)
    fractions = torch.rand(count, 2, generator=draws, dtype=torch.float64)
    values = torch.lerp(ranges[:, 0], ranges[:, 1], fractions)
    return [
        Gloss(roughness, specular_factor=specular_factor)
        for roughness, specular_factor in values.tolist()
    ]


@dataclass(frozen=True, eq=False)
class _DrawnLights:
    """The lighting of E examples.

    Attributes:
        environment: Coefficients of the environment lighting, shape (E, K, 3).
        directions: Unit vectors from the objects towards directional lights,
            shape (E, 3). Zero stands for no directional light.
        local: Coefficients of the local lights, shape (E, L, 3).
    """

    environment: Tensor
    directions: Tensor
    local: Tensor

    def coefficients(self) -> Tensor:
        """Return the lights (E, K + L, 3), in which directional lights have irradiance 1."""
        environment = self.environment
        is_directional = self.directions.any(1)
        if is_directional.any():
            added = directional(self.directions, torch.ones(3), degree_of(environment[0]))
            where = is_directional[:, None, None].to(environment.device)
            environment = torch.where(where, added.to(environment) + environment, environment)
        return torch.cat([environment, self.local], dim=1)

    def without_ground(self, is_on_table: Tensor, albedo: Tensor) -> "_DrawnLights":
        """Replace light from below by the light that a table reflects.

        Args:
            is_on_table: Mask of the examples with a table, shape (E,).
            albedo: Albedo of the background images, shape (E, C, size, size).
                A table has the mean albedo of its image.

        Returns:
            A copy with the changed environment light.
        """
        environment = self.environment.clone()
        environment[is_on_table] = above_table(
            environment[is_on_table],
            self.directions[is_on_table],
            albedo[is_on_table].mean((2, 3)),
        )
        return replace(self, environment=environment)


def _vary_lighting(
    scene: Scene, settings: VariationSettings, draws: torch.Generator, is_on_table: Tensor
) -> Scene:
    """Draw the lighting of all examples, light their backgrounds, and draw the camera effects."""
    exposures = _draw_log_uniform(settings.exposure, len(scene), draws)
    examples = [
        replace(example, exposure=example.exposure * factor)
        for example, factor in zip(scene.examples, exposures, strict=True)
    ]
    lights = _draw_lights(scene, settings, draws, is_on_table)
    changed: dict[str, Any] = {}
    points = None
    if settings.lit_background or settings.tables or settings.background_saturation:
        albedo = _draw_background_albedo(scene, settings, draws)
        if settings.tables:
            lights = lights.without_ground(is_on_table, albedo)
        lit = scene.changed(examples=examples, lights=lights.coefficients())
        white = albedo.new_ones(3, 1, 1)
        values = albedo * (_facing_irradiance(lit) if settings.lit_background else white)
        if settings.tables:
            walls = _draw_log_uniform(WALL_DISTANCES, len(scene), draws)
            arriving, points = _light_rooms(lit, lights, walls, is_on_table)
            values[is_on_table] = albedo[is_on_table] * arriving.to(albedo)
        changed["backgrounds"] = encode(clamp(values), scene.settings.encoding)
        examples = _number_backgrounds(examples)
    if settings.camera != CameraEffectSettings():
        changed["camera_effects"] = draw_camera_effects(
            settings.camera, len(scene), scene.settings, draws, scene.lights.device, points
        )
    return scene.changed(examples=examples, lights=lights.coefficients(), **changed)


def _draw_lights(
    scene: Scene, settings: VariationSettings, draws: torch.Generator, is_on_table: Tensor
) -> _DrawnLights:
    """Draw environment and directional lighting. The local lights stay those of the scene."""
    harmonics = harmonics_of(scene.basis)
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
    is_on_table: Tensor,
) -> _DrawnLights:
    """Choose a fraction of the examples, dim their environment and draw a directional light."""
    low, high = settings.fill_light
    shape = (len(scene), 1, 1)
    fill = low + (high - low) * torch.rand(shape, generator=draws)
    is_chosen = torch.rand(shape, generator=draws) < settings.directional_fraction
    angles = _draw_pairs(MAX_LIGHT_ANGLE, len(scene), draws)
    cameras = [
        _turn_camera(example.cameras[0], *turn)
        for example, turn in zip(scene.examples, angles, strict=True)
    ]
    directions = torch.from_numpy(np.stack([camera.axes()[2] for camera in cameras]))
    # A table blocks light from below, so directions from below are mirrored.
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
) -> Tensor:
    """Return the linear albedo (E, 1 or 3, size, size) of all backgrounds, in random colors."""
    backgrounds = decode(scene.backgrounds, scene.settings.encoding)
    albedo = backgrounds[[example.background for example in scene.examples]]
    if settings.background_saturation:
        fractions = torch.rand(len(scene), 2, generator=draws)
        hue_and_saturation = fractions * torch.tensor([1, settings.background_saturation])
        albedo = albedo * random_colors(hue_and_saturation).to(albedo)
    return albedo


def _facing_irradiance(scene: Scene) -> Tensor:
    """Return the irradiance (E, 3, 1, 1) of surfaces that face the first camera of each example."""
    directions = [example.cameras[0].axes()[2] for example in scene.examples]
    normals = torch.from_numpy(np.stack(directions))
    exposures = torch.tensor([example.exposure for example in scene.examples])[:, None]
    harmonics = harmonics_of(scene.basis)
    coefficients = scene.lights.cpu().double()[:, harmonics.nonzero]
    facing = torch.einsum("ek,ekc->ec", harmonics.irradiance(normals), coefficients) * exposures
    return facing.to(scene.backgrounds)[:, :, None, None]


def _light_rooms(
    scene: Scene, lights: _DrawnLights, walls: Sequence[float], is_on_table: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the irradiance of the rooms, and the points of projected patterns.

    In a room, a pattern falls on table, wall and object along the directional
    light. Without a directional light, it falls along the view.

    Args:
        scene: The scene of E examples, in the drawn lighting.
        lights: The drawn lighting.
        walls: Distance of the wall behind each object, in world units.
        is_on_table: Which N of the examples are in rooms, shape (E,).

    Returns:
        The irradiance of table and wall in the N rooms, shape
        (N, 3, size, size), and the point of the pattern that reaches each
        pixel of each example, shape (2, E, size, size).
    """
    rows = torch.nonzero(is_on_table).squeeze(1).tolist()
    environments = lights.environment.cpu().double()
    settings = scene.settings
    images = []
    points = pixel_centers(settings.size).repeat(1, len(scene), 1, 1)
    # The room of every example of an object has the same rays.
    groups = groupby(progress(rows, "tables"), lambda row: scene.examples[row].object)
    for number, rows_of_object in groups:
        item = scene.objects[number]
        rays = Rays(item.mesh)
        for row in rows_of_object:
            example = scene.examples[row]
            camera = example.cameras[0]
            room = Room(rays, item.radius, item.lowest, walls[row])
            direction = lights.directions[row]
            local = split_light(scene.basis, scene.lights[row].cpu().double()).local_lights
            arriving = irradiance(room, camera, settings, environments[row], direction, local)
            images.append(example.exposure * arriving)
            if not direction.any():
                direction = torch.from_numpy(camera.axes()[2])
            points[:, row] = project_along_light(
                room, item.mesh, camera, settings, direction
            ).float()
    if not images:
        return torch.zeros(0, 3, settings.size, settings.size), points
    return torch.stack(images), points


# Random numbers.


def _draw_log_uniform(limits: Sequence[float], count: int, draws: torch.Generator) -> list[float]:
    """Draw numbers between two limits, with uniformly distributed logarithms."""
    low, high = (math.log(limit) for limit in limits)
    fractions = torch.rand(count, generator=draws, dtype=torch.float64)
    return (low + (high - low) * fractions).exp().tolist()


def _draw_pairs(limit: float, count: int, draws: torch.Generator) -> list[list[float]]:
    """Draw pairs (count, 2) of numbers uniformly from [-limit, limit]."""
    fractions = torch.rand(count, 2, generator=draws, dtype=torch.float64)
    return (limit * (2 * fractions - 1)).tolist()
