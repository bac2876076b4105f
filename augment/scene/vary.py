"""Random variation of a scene: objects, cameras, lighting, backgrounds and camera effects."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from augment.augmentation_settings import CameraEffectSettings, VariationSettings
from augment.progress import progress
from augment.scene import patterns
from augment.scene.build import reached_gloss
from augment.scene.objects import (
    Example,
    SceneObject,
    resample_instance,
    rotated,
    with_field,
    with_own_mesh,
)
from augment.scene.scene import Scene
from augment.scene.surfaces import between
from augment.scene.tabletop import Room, above_table, irradiance, project_along_light
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.image import clamp, decode, encode
from renderer.io.images import SUFFIXES, is_hidden, read_image
from renderer.light.basis import harmonics_of, split_light
from renderer.light.files import directional, load_light
from renderer.light.harmonics import degree_of
from renderer.operators.rays import Rays
from renderer.settings import ImageSettings, Size
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
# A Gaussian blur averages each pixel with this number of neighbors on each side.
BLUR_RADIUS = 3
# This standard deviation of a Gaussian blur, in pixels, replaces 0, by which one cannot divide. It
# is so small that the blur changes nothing.
MIN_BLUR = 1e-3
# Probability that a random projected pattern shows a photograph, if there are photographs.
PHOTOGRAPH_PROBABILITY = 0.5


def vary(scene: Scene, settings: VariationSettings, draws: Generator, once: bool = False) -> Scene:
    """Change objects, cameras, lighting and backgrounds of a scene at random.

    All views of one example change in the same way. With `once`, the examples are rendered in one
    lighting only, and directly, without matrices from light to image.
    """
    # Mask of the examples whose background becomes a table and a wall.
    is_on_table = torch.zeros(len(scene), dtype=torch.bool)
    if settings.tables:
        if scene.views > 1 or any(item.ground is not None for item in scene.objects):
            raise InputError("tables need views=1 and ground=None: set both, or tables=0")
        is_on_table = torch.rand(len(scene), generator=draws) < settings.tables
    if settings.moves or settings.backgrounds is not None:
        scene = _Variation(scene, settings, draws, is_on_table).change_geometry(once)
    if settings == VariationSettings():
        return scene
    return _Variation(scene, settings, draws, is_on_table).change_lighting()


@dataclass(frozen=True)
class _Variation:
    """Random changes of the E examples of a scene.

    The background of the examples in the mask `is_on_table` becomes a table and a wall.
    """

    scene: Scene
    settings: VariationSettings
    draws: Generator
    is_on_table: Bool[Tensor, " E"]

    def change_geometry(self, once: bool) -> Scene:
        """Return a copy of the scene with random cameras, backgrounds and objects (see `vary`)."""
        scene, settings = self.scene, self.settings
        examples = self._draw_cameras()
        # Arguments of `Scene` that differ in the copy.
        changed: dict[str, Any] = {}
        if settings.backgrounds is not None:
            files = settings.backgrounds, "backgrounds", len(scene), scene.settings.size
            changed["backgrounds"] = _draw_image_files(*files, self.draws)
            examples = with_field(examples, "background", range(len(examples)))
        if settings.instances or settings.rotation or any(settings.gloss.specular_factor):
            # Examples of the same object and the same cameras get the same random object. They
            # differ in their backgrounds only.
            pairs = [(example.object, example.cameras) for example in scene.examples]
            pair_to_new_object = {pair: index for index, pair in enumerate(dict.fromkeys(pairs))}
            objects = [scene.objects[object_index] for object_index, _ in pair_to_new_object]
            changed["objects"] = self._draw_objects(objects)
            examples = with_field(examples, "object", [pair_to_new_object[pair] for pair in pairs])
        # Direct rendering of a view in one lighting is faster than the construction of its transfer
        # operator, except if direct rendering would trace rays.
        one_light = scene.one_light or (once and settings.moves and not scene.needs_rays)
        return scene.changed(examples=examples, one_light=one_light, **changed)

    def _draw_cameras(self) -> list[Example]:
        """Return copies of the examples with randomly changed cameras.

        All cameras of one example get the same changes.
        """
        settings = self.settings
        shifts = self._draw_pairs(settings.shift)
        scales = self._draw_log_uniform(settings.scale)
        angles = self._draw_pairs(settings.azimuth)
        # A field of view of 0 leaves the kind and the distance of a camera as they are.
        has_fov = any(settings.fov)
        fovs = self._draw_uniform(*settings.fov).tolist() if has_fov else [0.0] * len(shifts)
        changes = zip(shifts, scales, angles, fovs, self.is_on_table.tolist(), strict=True)
        return [
            replace(example, cameras=tuple(_move(camera, *change) for camera in example.cameras))
            for example, change in zip(self.scene.examples, changes, strict=True)
        ]

    def _draw_objects(self, objects: list[SceneObject]) -> list[SceneObject]:
        """Return copies of objects with a random shape, rotation and gloss.

        A random shape is possible for generated solids only: another orange, for example.
        """
        settings, count = self.settings, len(objects)
        if settings.instances:
            seeds = torch.randint(2**31, (count,), generator=self.draws).tolist()
            pairs = progress(zip(objects, seeds, strict=True), "new instances", count)
            objects = [resample_instance(item, seed) for item, seed in pairs]
        if settings.rotation:
            axes = torch.randn(count, 3, generator=self.draws, dtype=torch.float64)
            angles = torch.rand(count, 1, generator=self.draws, dtype=torch.float64)
            # A rotation vector points along the axis, and its length is the angle in degrees.
            rotation_vectors = settings.rotation * angles * axes / axes.norm(dim=1, keepdim=True)
            objects = list(map(rotated, objects, rotation_matrices(rotation_vectors).numpy()))
        if any(settings.gloss.specular_factor):
            gloss = settings.gloss
            ranges = torch.tensor([gloss.roughness, gloss.specular_factor], dtype=torch.float64)
            fractions = torch.rand(count, 2, generator=self.draws, dtype=torch.float64)
            # Roughness and specular factor of each object, uniform between both ends of a range.
            values = torch.lerp(ranges[:, 0], ranges[:, 1], fractions).tolist()
            objects = [
                with_own_mesh(item, Gloss(rough, specular_factor=strength).on(item.own_mesh))
                for item, (rough, strength) in zip(objects, values, strict=True)
            ]
        return objects

    def change_lighting(self) -> Scene:
        """Return a copy of the scene with random lighting and random effects of the camera."""
        scene, settings = self.scene, self.settings
        pairs = zip(scene.examples, self._draw_log_uniform(settings.exposure), strict=True)
        exposures = [example.exposure * factor for example, factor in pairs]
        examples = with_field(scene.examples, "exposure", exposures)
        environment, directions = self._draw_lights()
        # Projector and lamps stay the same.
        local = scene.lights[:, environment.shape[1] :]
        albedo = None
        if settings.lit_background or settings.tables or settings.background_saturation:
            albedo = self._draw_background_albedo()
            if self.is_on_table.any():
                # The light from below is what the table reflects, with the albedo of the image.
                rows = self.is_on_table
                mean_albedo = albedo[rows].mean((2, 3))
                environment = environment.clone()
                environment[rows] = above_table(environment[rows], directions[rows], mean_albedo)
        lights = torch.cat([_with_directional(environment, directions), local], dim=1)
        # Arguments of `Scene` that differ in the copy.
        changed: dict[str, Any] = {"lights": lights}
        # Point of a projected pattern that each pixel shows. None if the pattern fills the image.
        pattern_points = None
        if albedo is not None:
            lit = replace(self, scene=scene.changed(examples=examples, lights=lights))
            backgrounds = lit._light_backgrounds(albedo, environment, directions)
            changed["backgrounds"], pattern_points = backgrounds
            # Each example now has a background of its own.
            examples = with_field(examples, "background", range(len(examples)))
        if settings.camera != CameraEffectSettings():
            drawn = len(scene), scene.settings, self.draws, scene.lights.device, pattern_points
            changed["camera_effects"] = draw_camera_effects(settings.camera, *drawn)
        return scene.changed(examples=examples, **changed)

    def _draw_lights(self) -> tuple[Float[Tensor, "E K 3"], Float[Tensor, "E 3"]]:
        """Draw an environment, and the unit vector towards a directional light, of each example.

        Zero stands for no directional light. An example with one has a dimmed environment. The
        directions differ from that of the camera by at most `MAX_LIGHT_ANGLE` in polar angle and
        in azimuth.
        """
        scene, settings, count = self.scene, self.settings, len(self.scene)
        harmonics = harmonics_of(scene.basis)
        environment = scene.lights[:, : harmonics.size]
        if settings.environments:
            chosen = torch.randint(len(settings.environments), (count,), generator=self.draws)
            # With the roughness, highlights on glossy objects get no dark rings.
            roughness = reached_gloss(scene.objects).gloss_roughness
            maps = [load_light(name, harmonics.degree, roughness) for name in settings.environments]
            environment = scene.exposure * torch.stack(maps)[chosen].to(scene.lights)
        if not settings.directional_fraction:
            return environment, torch.zeros(count, 3, dtype=torch.float64)
        # Factor by which the environment of an example with a directional light is dimmed.
        fill = between(torch.rand(count, 1, 1, generator=self.draws), *settings.fill_light)
        is_chosen = torch.rand(count, 1, 1, generator=self.draws) < settings.directional_fraction
        turns = zip(scene.cameras, self._draw_pairs(MAX_LIGHT_ANGLE), strict=True)
        directions = _towards_cameras([_turn(cameras[0], *turn) for cameras, turn in turns])
        # A table blocks light from below, so such directions are mirrored to above.
        grounds = [scene.objects[example.object].ground for example in scene.examples]
        has_table = self.is_on_table | torch.tensor([ground is not None for ground in grounds])
        directions[has_table, 2] = directions[has_table, 2].abs()
        dimmed = fill.to(environment) * environment
        environment = torch.where(is_chosen.to(environment.device), dimmed, environment)
        return environment, directions * is_chosen[:, 0]

    def _draw_background_albedo(self) -> Float[Tensor, "E _ height width"]:
        """Convert the background of each example to an albedo, and multiply it by a random color.

        The values of a background are taken as its albedo. The result is linear.
        """
        scene = self.scene
        albedo = decode(scene.backgrounds, scene.settings.encoding)
        albedo = albedo[[example.background for example in scene.examples]]
        if self.settings.background_saturation:
            fractions = torch.rand(len(scene), 2, generator=self.draws)
            # Hue in [0, 1], and saturation up to that of the settings.
            saturations = fractions * torch.tensor([1, self.settings.background_saturation])
            albedo = albedo * patterns.random_colors(saturations).to(albedo)
        return albedo

    def _light_backgrounds(
        self,
        albedo: Float[Tensor, "E _ height width"],
        environment: Float[Tensor, "E K 3"],
        directions: Float[Tensor, "E 3"],
    ) -> tuple[Tensor, Tensor | None]:
        """Compute the background images of all examples from their albedo and their lighting.

        Return the images, and the x and y of the point of a projected pattern that each pixel
        shows, shape (2, E, height, width), or None without tables.
        """
        scene = self.scene
        # If backgrounds are not lit, an irradiance of 1 leaves the albedo as it is.
        is_lit = self.settings.lit_background
        # A background is lit as a surface that faces the camera. Tables and walls follow below.
        linear = albedo * (_facing_irradiance(scene) if is_lit else albedo.new_ones(3, 1, 1))
        pattern_points = None
        if self.settings.tables:
            # Without a table, the pattern fills the image.
            pattern_points = patterns.pixel_centers(scene.settings.size).repeat(1, len(scene), 1, 1)
            distances = self._draw_log_uniform(WALL_DISTANCES)
            indices = torch.nonzero(self.is_on_table).squeeze(1).tolist()
            # Build the ray tracer of an object once for all successive examples that show it.
            groups = groupby(progress(indices, "tables"), lambda row: scene.examples[row].object)
            for object_index, rows in groups:
                rays = Rays(scene.objects[object_index].mesh)
                for row in rows:
                    shown = row, rays, distances[row], environment[row], directions[row]
                    arriving, pattern_points[:, row] = self._light_room(*shown)
                    linear[row] = albedo[row] * arriving.to(albedo)
        return encode(clamp(linear), scene.settings.encoding), pattern_points

    def _light_room(
        self, row: int, rays: Rays, wall_distance: float, sky: Tensor, lamp: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "2 height width"]]:
        """Light a table and a wall in an example, and find where a projected pattern falls.

        The pattern falls on table, wall and object along the directional light of the example or,
        if it has none, along the direction of the view. Return the irradiance of table and wall,
        and the x and y of the point of the pattern that each pixel shows.
        """
        scene = self.scene
        example = scene.examples[row]
        # Scenes with tables have one view.
        item, camera = scene.objects[example.object], example.cameras[0]
        # The table stands at the lowest vertex, and the wall is behind all objects.
        room = Room(rays, item.radius, item.lowest, max(wall_distance, item.radius))
        # Projector and lamps of the scene, which also light the room.
        local = split_light(scene.basis, scene.lights[row].cpu().double()).local_lights
        # The exposure multiplies all light below, but must not change theirs.
        local = [(basis, values / example.exposure) for basis, values in local]
        arriving = irradiance(room, camera, scene.settings, sky.cpu().double(), lamp, local)
        # A lamp at zero stands for no directional light. The third axis points to the camera.
        towards = lamp if lamp.any() else torch.from_numpy(camera.axes()[2])
        points = project_along_light(room, item.mesh, camera, scene.settings, towards)
        return example.exposure * arriving, points.float()

    def _draw_log_uniform(self, limits: Sequence[float]) -> list[float]:
        """Draw a number for each example, whose logarithm is uniformly distributed."""
        return self._draw_uniform(*map(math.log, limits)).exp().tolist()

    def _draw_uniform(self, low: float, high: float) -> Float[Tensor, " E"]:
        """Draw a uniformly distributed number for each example."""
        fractions = torch.rand(len(self.scene), generator=self.draws, dtype=torch.float64)
        return between(fractions, low, high)

    def _draw_pairs(self, limit: float) -> list[list[float]]:
        """Draw a pair of numbers for each example uniformly from [-limit, limit]."""
        fractions = torch.rand(len(self.scene), 2, generator=self.draws, dtype=torch.float64)
        return (limit * (2 * fractions - 1)).tolist()


def _towards_cameras(cameras: Sequence[Camera]) -> Float[Tensor, "E 3"]:
    """Return the unit vectors from the origin to cameras, which are their third axes."""
    return torch.from_numpy(np.stack([camera.axes()[2] for camera in cameras]))


def _turn(camera: Camera, polar: float, azimuth: float) -> Camera:
    """Return a copy of a camera that is turned around the object."""
    return replace(camera, polar=camera.polar + polar, azimuth=camera.azimuth + azimuth)


def _move(
    camera: Camera, shift: list[float], scale: float, turn: list[float], fov: float, has_table: bool
) -> Camera:
    """Return a copy of a camera that is zoomed, shifted and turned around the object.

    The shift is that of the object to the right and up, as fractions of the image width. `scale`
    enlarges the object. `turn` has the changes of polar angle and azimuth in degrees. A camera
    gets the field of view, at the distance from which it sees the same width at the origin, unless
    this is 0. Above a table, a camera below the horizon is mirrored, and its elevation is limited.
    """
    # A camera that sees half the width shows the object at twice the size.
    width = camera.width / scale
    right, up = camera.right + shift[0] * width, camera.up + shift[1] * width
    moved = replace(_turn(camera, *turn), width=width, right=right, up=up)
    if has_table:
        # The polar angle is measured from the vertical, so its cosine is the sine of the elevation.
        elevation = abs(math.degrees(math.asin(math.cos(math.radians(moved.polar)))))
        moved = replace(moved, polar=90 - min(max(elevation, MIN_ELEVATION), MAX_ELEVATION))
    if not fov:
        return moved
    distance = width / 2 / math.tan(math.radians(fov) / 2)
    # An orthographic camera becomes a perspective camera with the same fields.
    kind = type(moved) if isinstance(moved, PerspectiveCamera) else PerspectiveCamera
    return kind(**vars(moved) | {"distance": distance})


def _with_directional(environment: Float[Tensor, "E K 3"], directions: Tensor) -> Tensor:
    """Add white directional lights to environments, except where the direction is zero.

    A surface that faces such a light has irradiance 1.
    """
    added = directional(directions, torch.ones(3), degree_of(environment[0]))
    mask = directions.any(1)[:, None, None].to(environment.device)
    return torch.where(mask, added.to(environment) + environment, environment)


def _facing_irradiance(scene: Scene) -> Float[Tensor, "E 3 1 1"]:
    """Compute the irradiance of a surface that faces the camera, in the environment light.

    It is multiplied by the exposure. The first camera of each example counts.
    """
    normals = _towards_cameras([cameras[0] for cameras in scene.cameras])
    exposures = torch.tensor([example.exposure for example in scene.examples])[:, None]
    harmonics = harmonics_of(scene.basis)
    # Only the harmonics with the indices `nonzero` contribute irradiance.
    coefficients = scene.lights.cpu().double()[:, harmonics.nonzero]
    facing = torch.einsum("ek,ekc->ec", harmonics.irradiance(normals), coefficients) * exposures
    return facing.to(scene.backgrounds)[:, :, None, None]


def draw_camera_effects(
    settings: CameraEffectSettings,
    count: int,
    image: ImageSettings,
    draws: Generator,
    device: torch.device | str = "cpu",
    points: Float[Tensor, "2 count height width"] | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """Draw the effects of a camera and of a projector for the images of each example.

    The linear light of an image is multiplied by a random pattern, as of a projector, and by a
    random white balance. Then the image is blurred, and noise is added. The returned function takes
    images of A examples, shape (A, V, 3, height, width), and their indices. `points` are x and y in
    [-1, 1] of the point of the pattern that each pixel shows. None lets the pattern fill the image.
    """
    size = image.size
    light = patterns.draw_patterns(count, size, draws, points)
    if settings.slides is not None:
        is_photograph = torch.rand(count, generator=draws) < PHOTOGRAPH_PROBABILITY
        if is_photograph.any():
            photograph_count = int(is_photograph.sum())
            files = _draw_image_files(settings.slides, "slides", photograph_count, size, draws)
            shown = patterns.pixel_centers(size) if points is None else points[:, is_photograph]
            slides = patterns.draw_photograph_patterns(decode(files, "srgb"), shown, draws)
            light[is_photograph] = slides
    # Fraction of the light of each example that does not come from the projector.
    fill = between(torch.rand(count, 1, 1, 1, generator=draws), *settings.pattern_fill)
    # Some examples have no pattern.
    has_pattern = torch.rand(count, 1, 1, 1, generator=draws) < settings.pattern_fraction
    pattern_gains = torch.where(has_pattern, fill + (1 - fill) * light, 1.0)
    # Change of the white balance of each channel, in stops. One stop is a factor of 2.
    stops = settings.white_balance * (2 * torch.rand(count, 3, 1, 1, generator=draws) - 1)
    deviations = (settings.blur * torch.rand(count, generator=draws)).to(device)
    noise_deviations = settings.noise * torch.rand(count, 1, 1, 1, generator=draws)
    noises = (noise_deviations * torch.randn(count, 3, *image.shape, generator=draws)).to(device)
    # Factor of each channel and pixel, by pattern and white balance.
    gains = (pattern_gains * 2**stops).to(device)

    def apply_effects(
        images: Float[Tensor, "A V 3 height width"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A V 3 height width"]:
        """Apply the effects to images."""
        gained = decode(images, image.encoding) * gains[examples, None]
        blurred = _blur(gained, deviations[examples])
        return clamp(encode(clamp(blurred), image.encoding) + noises[examples, None])

    return apply_effects


def _blur(images: Float[Tensor, "A V 3 height width"], deviations: Float[Tensor, " A"]) -> Tensor:
    """Blur the images of each example by a Gaussian of its own width.

    The pixels at the border of an image are repeated beyond the border. Deviations are in pixels.
    """
    count = len(images)
    # A pixel is averaged over the N pixels with these offsets from it.
    offsets = torch.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, device=images.device)
    # Weight of each offset in each example, shape (A, N).
    weights = torch.exp(-0.5 * (offsets / deviations.clamp(min=MIN_BLUR)[:, None]) ** 2)
    weights = (weights / weights.sum(1, keepdim=True)).to(images)
    # A Gaussian blur is separable: the first matrix blurs along columns, the second along rows.
    by_axis = []
    for side in images.shape[-2:]:
        # Position along the axis of the N pixels around each pixel, shape (side, N).
        pixels = torch.arange(side, device=images.device)
        neighbors = (pixels[:, None] + offsets).clamp(0, side - 1).expand(count, -1, -1)
        # One matrix for each example. Its row i has the weights of all pixels in the average for
        # pixel i, along one axis of the image. Shape (A, side, side).
        matrices = images.new_zeros(count, side, side)
        by_axis.append(matrices.scatter_add_(2, neighbors, weights[:, None].expand(-1, side, -1)))
    return torch.einsum("aij,avcjk,alk->avcil", by_axis[0], images, by_axis[1])


def _draw_image_files(
    folder: str | Path, key: str, count: int, size: Size, draws: Generator
) -> Float[Tensor, "count 3 height width"]:
    """Read randomly chosen images of a folder, with replacement."""
    paths = (path.relative_to(folder) for path in Path(folder).rglob("*"))
    names = sorted(path for path in paths if not any(map(is_hidden, path.parts)))
    files = [Path(folder, name) for name in names if name.suffix.lower() in SUFFIXES]
    if not files:
        raise InputError(f"{key}={folder} has no images: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    images = [read_image(files[index], size) for index in progress(chosen, f"reading {key}")]
    return torch.stack(images)
