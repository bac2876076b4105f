"""Rows of a scene drawn anew: instance, pose, view, light, background and camera effects of each example."""

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.progress import progress
from augment.scene.camera_effects import draw_camera_effects
from augment.scene.conditions import Example
from augment.scene.objects import another_instance, rotated, varnished
from augment.scene.patterns import pixel_middles, random_colors
from augment.scene.room import Room, above_table, across_light, irradiance
from augment.scene.scene import Scene
from augment.settings import CameraEffectSettings, VariationSettings
from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.image import clamp, decode, encode
from renderer.io.images import SUFFIXES, read_image
from renderer.light.basis import harmonics_of, split_light
from renderer.light.harmonics import degree_of
from renderer.light.presets import directional, load_light
from renderer.surface.gloss import Gloss
from renderer.transport.rays import Rays
from renderer.vectors import rotation_matrices

UNCHANGED, NONE = (1.0, 1.0), (0.0, 0.0)
WIDEST = 45.0  # degrees, of a lens that a normalized mesh is in front of
ELEVATION = math.radians(15), math.radians(75)  # least and most, of a camera above a table
WALL = 1.8, 8.0  # least and largest distance of a wall behind the object
DIRECTIONAL_ANGLE = math.radians(70)  # between camera and directional light, around the mesh and up or down, at most


def vary(scene: Scene, settings: VariationSettings, draws: torch.Generator, once: bool = False) -> Scene:
    """The scene with rows drawn anew around its own; the scene itself where nothing varies.

    All views of a row are moved alike. once: they are rendered in one light only. InputError: a folder without images,
    or tables under objects that stand on one, or seen by several cameras.
    """
    on_table = torch.zeros(len(scene), dtype=torch.bool)
    if settings.tables:
        if scene.views > 1 or any(item.ground is not None for item in scene.objects):
            raise InputError("tables are for one view of objects that stand on none: leave ground out, or tables")
        on_table = torch.rand(len(scene), generator=draws) < settings.tables
    if settings.moves or settings.backgrounds is not None:
        scene = _with_moved_rows(scene, settings, draws, once, on_table)
    return scene if settings == VariationSettings() else _with_other_light(scene, settings, draws, on_table)


def _with_moved_rows(
    scene: Scene, settings: VariationSettings, draws: torch.Generator, once: bool, on_table: Tensor
) -> Scene:
    shifts = _offsets(settings.shift, len(scene), draws)
    scales = _log_uniform(settings.scale, len(scene), draws)
    angles = _offsets(math.radians(settings.azimuth), len(scene), draws)
    fovs = [0.0] * len(scene)
    if any(settings.fov):
        low, high = map(math.radians, settings.fov)
        fovs = (low + (high - low) * torch.rand(len(scene), generator=draws, dtype=torch.float64)).tolist()
    rows, changed = list[Example](), dict[str, Any]()
    drawn = zip(scene.examples, shifts, scales, angles, fovs, on_table.tolist(), strict=True)
    for row, (right, up), scale, angle, fov, above in drawn:
        cameras = []
        for camera in row.cameras:
            width = camera.width / scale
            shift = {"right": camera.right + right * width, "up": camera.up + up * width}
            moved = replace(_turned(camera, *angle), width=width, **shift)
            moved = _above_table(moved) if above else moved
            cameras.append(_in_perspective(moved, fov) if fov else moved)
        rows.append(replace(row, cameras=tuple(cameras)))
    if settings.backgrounds is not None:
        changed["backgrounds"] = _images(Path(settings.backgrounds), len(scene), scene.settings.size, draws)
        rows = [replace(row, background=index) for index, row in enumerate(rows)]
    shiny = any(settings.gloss.strength)
    if settings.instances or settings.rotation or shiny:
        views = dict.fromkeys((row.object, row.cameras) for row in scene.examples)
        numbers = {view: index for index, view in enumerate(views)}
        objects = [scene.objects[index] for index, _ in views]
        if settings.instances:
            seeds = torch.randint(2**31, (len(views),), generator=draws).tolist()
            counted = progress(zip(objects, seeds, strict=True), "new instances", len(views))
            objects = [another_instance(item, seed) for item, seed in counted]
        if settings.rotation:
            rotations = _rotations(math.radians(settings.rotation), len(views), draws)
            objects = [rotated(item, rotation) for item, rotation in zip(objects, rotations, strict=True)]
        if shiny:
            ranges = torch.tensor([settings.gloss.roughness, settings.gloss.strength], dtype=torch.float64)
            fractions = torch.rand(len(views), 2, generator=draws, dtype=torch.float64)
            values = torch.lerp(ranges[:, 0], ranges[:, 1], fractions)
            varnish = (Gloss(roughness, strength=strength) for roughness, strength in values.tolist())
            objects = [varnished(item, gloss) for item, gloss in zip(objects, varnish, strict=True)]
        changed["objects"] = objects
        shown = [numbers[row.object, row.cameras] for row in scene.examples]
        rows = [replace(row, object=number) for row, number in zip(rows, shown, strict=True)]
    # Rays take longer than an operator.
    has_rays = bool(scene.basis.local_lights) or scene.settings.global_illumination
    return scene.changed(examples=rows, one_light=once and settings.moves and not has_rays, **changed)


def _with_other_light(scene: Scene, settings: VariationSettings, draws: torch.Generator, on_table: Tensor) -> Scene:
    exposures = _log_uniform(settings.exposure, len(scene), draws)
    rows = [replace(row, exposure=row.exposure * factor) for row, factor in zip(scene.examples, exposures, strict=True)]
    changed: dict[str, Any] = {}
    harmonics = harmonics_of(scene.basis)
    sky, local = scene.lights.tensor_split([harmonics.size], dim=1)  # projector and lamps stay as they are
    lamps = torch.zeros(len(rows), 3, dtype=torch.float64)
    if settings.environments:
        chosen = torch.randint(len(settings.environments), (len(rows),), generator=draws)
        lights = torch.stack([load_light(light, harmonics.degree) for light in settings.environments])
        sky = lights[chosen].to(scene.lights)
    if settings.directional_fraction > 0:
        sky, lamps = _with_lamps(sky, scene, settings, draws, on_table)
    points = None
    if settings.lit_background or settings.tables or settings.background_saturation:
        encoding = scene.settings.encoding
        albedo = decode(scene.backgrounds, encoding)[[row.background for row in rows]]
        if settings.background_saturation:
            drawn = torch.rand(len(rows), 2, generator=draws)
            albedo = albedo * random_colors(drawn * torch.tensor([1, settings.background_saturation])).to(albedo)
        if settings.tables:
            sky = sky.clone()
            sky[on_table] = above_table(sky[on_table], lamps[on_table], albedo[on_table].mean((2, 3)))
        lit = scene.changed(examples=rows, lights=torch.cat([_with_directional(sky, lamps), local], dim=1))
        values = albedo * _facing(lit) if settings.lit_background else albedo.expand(-1, 3, -1, -1).clone()
        if settings.tables:
            arriving, points = _in_rooms(lit, sky, lamps, _log_uniform(WALL, len(rows), draws), on_table)
            values[on_table] = albedo[on_table] * arriving.to(albedo)
        rows = [replace(row, background=index) for index, row in enumerate(rows)]
        changed["backgrounds"] = encode(clamp(values), encoding)
    if settings.camera != CameraEffectSettings():
        effects = settings.camera, len(rows), scene.settings, draws, scene.lights.device, points
        changed["camera_effects"] = draw_camera_effects(*effects)
    lights = torch.cat([_with_directional(sky, lamps), local], dim=1)
    return scene.changed(examples=rows, lights=lights, **changed)


def _log_uniform(limits: Sequence[float], count: int, draws: torch.Generator) -> list[float]:
    low, high = (math.log(limit) for limit in limits)
    return (low + (high - low) * torch.rand(count, generator=draws, dtype=torch.float64)).exp().tolist()


def _offsets(most: float, count: int, draws: torch.Generator) -> list[list[float]]:
    """(count, 2), uniform in ±most."""
    return (most * (2 * torch.rand(count, 2, generator=draws, dtype=torch.float64) - 1)).tolist()


def _turned(camera: Camera, polar: float, azimuth: float) -> Camera:
    return replace(camera, polar=camera.polar + polar, azimuth=camera.azimuth + azimuth)


def _images(folder: Path, count: int, size: int, draws: torch.Generator) -> Tensor:
    """(count, 3, size, size), drawn with repetition."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"backgrounds={folder} holds no image: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    return torch.stack([read_image(files[index], size) for index in progress(chosen, "reading backgrounds")])


def _rotations(most: float, count: int, draws: torch.Generator) -> np.ndarray:
    """(count, 3, 3) by an angle up to `most` about a random axis."""
    axes = torch.randn(count, 3, generator=draws, dtype=torch.float64)
    angles = most * torch.rand(count, 1, generator=draws, dtype=torch.float64)
    return rotation_matrices(angles * axes / axes.norm(dim=1, keepdim=True)).numpy()


def _above_table(camera: Camera) -> Camera:
    """The camera mirrored to above a table."""
    elevation = abs(math.asin(math.cos(camera.polar)))
    return replace(camera, polar=math.pi / 2 - min(max(elevation, ELEVATION[0]), ELEVATION[1]))


def _in_perspective(camera: Camera, fov: float) -> Camera:
    shared = {item.name: getattr(camera, item.name) for item in fields(Camera)}
    return PerspectiveCamera(**shared, distance=camera.width / 2 / math.tan(fov / 2))


def _with_lamps(
    sky: Tensor, scene: Scene, settings: VariationSettings, draws: torch.Generator, on_table: Tensor
) -> tuple[Tensor, Tensor]:
    """The lights (E, K, 3), a fraction of them dimmed, and the directions (E, 3) of white light beside those, or zero.

    An object on a table has no light from below: a direction that is drawn there is mirrored.
    """
    low, high = settings.fill_light
    shape = (len(scene), 1, 1)
    fill = low + (high - low) * torch.rand(shape, generator=draws)
    chosen = torch.rand(shape, generator=draws) < settings.directional_fraction
    angles = _offsets(DIRECTIONAL_ANGLE, len(scene), draws)
    cameras = [_turned(row.cameras[0], *turn) for row, turn in zip(scene.examples, angles, strict=True)]
    towards = torch.from_numpy(np.stack([camera.axes()[2] for camera in cameras]))
    on_table = on_table | torch.tensor([scene.objects[row.object].ground is not None for row in scene.examples])
    towards[on_table, 2] = towards[on_table, 2].abs()
    return torch.where(chosen.to(sky.device), fill.to(sky) * sky, sky), towards * chosen[:, 0]


def _with_directional(sky: Tensor, lamps: Tensor) -> Tensor:
    """The lights (E, K, 3) and those of irradiance 1 from directions (E, 3), where these are not zero."""
    lit = lamps.any(1)
    if not lit.any():
        return sky
    added = directional(lamps, torch.ones(3), degree_of(sky[0])).to(sky)
    return torch.where(lit[:, None, None].to(sky.device), added + sky, sky)


def _facing(scene: Scene) -> Tensor:
    """(E, 3, 1, 1) irradiance of a surface that faces the row's first camera, in the backgrounds' type."""
    towards = torch.from_numpy(np.stack([row.cameras[0].axes()[2] for row in scene.examples]))
    exposures = torch.tensor([row.exposure for row in scene.examples])[:, None]
    harmonics = harmonics_of(scene.basis)
    coefficients = scene.lights.cpu().double()[:, harmonics.nonzero]
    facing = torch.einsum("ek,ekc->ec", harmonics.irradiance(towards), coefficients) * exposures
    return facing.to(scene.backgrounds)[:, :, None, None]


def _in_rooms(
    scene: Scene, sky: Tensor, lamps: Tensor, walls: Sequence[float], on_table: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the irradiance of the rooms, and where projected patterns fall in every example.

    The first, (N, 3, size, size), is that of table and wall in the N examples on tables. The
    second, (2, E, size, size), has coordinates across the light. In a room, the pattern falls on
    table, wall and object along the lamp or, without a lamp, along the view.
    """
    rows = torch.nonzero(on_table).squeeze(1).tolist()
    skies = sky.cpu().double()
    settings = scene.settings
    images = []
    points = pixel_middles(settings.size).repeat(1, len(scene), 1, 1)
    for number, group in groupby(progress(rows, "tables"), lambda row: scene.examples[row].object):
        item = scene.objects[number]
        rays = Rays(item.mesh)
        for row in group:
            example = scene.examples[row]
            camera = example.cameras[0]
            around = Room(rays, item.radius, item.lowest, walls[row])
            light = scene.lights[row].cpu().double()
            local = split_light(scene.basis, light).local_lights
            arriving = irradiance(around, camera, settings, skies[row], lamps[row], local)
            images.append(example.exposure * arriving)
            towards = lamps[row] if lamps[row].any() else torch.from_numpy(camera.axes()[2])
            across = across_light(around, item.mesh, camera, settings, towards)
            points[:, row] = across.float()
    size = settings.size
    return torch.stack(images) if images else torch.zeros(0, 3, size, size), points
