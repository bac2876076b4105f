"""Rows drawn afresh: which instance is shown, from where, in which light, before what, and through which camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.camera_effects import CameraEffectSettings, draw_camera_effects
from augment.objects import another_instance
from augment.scene import Example, Scene
from renderer.arguments import require_fields
from renderer.cache import OperatorCache
from renderer.camera import Camera
from renderer.errors import FACTOR, InputError, require_limits, require_range
from renderer.files.image_files import SUFFIXES, read_image
from renderer.harmonics import irradiance_basis, live_coefficients
from renderer.image import clamp, decode, encode
from renderer.lights import directional, load_light
from renderer.transfer import DEGREE

UNCHANGED = (1.0, 1.0)
LAMP_REACH = 70.0  # degrees around the mesh and up or down, from the camera


@dataclass
class VariationSettings:
    """What is drawn for each example in each round; by default nothing, which leaves the grid of the paper.

    shift: the mesh's middle is moved by at most this share of the frame's width, to either side and up and down. scale,
    exposure: [least, most] that its size in the frame and the light are multiplied by, uniform in the logarithm.
    backgrounds: a folder of images, each example before one of them. instances: every solid that is named without a
    seed is another of its kind in each of its views. azimuth: degrees that the camera goes around the mesh, at most, to
    either side and up and down. environments: each example is in one of these, as `load_light` takes them.
    directional_fraction: the fraction of examples that stand in the parallel light of a lamp on the camera's side, up
    to 70° off, over [least, most] `fill_light` of their own. lit_background: a background is a wall that faces the
    camera in the example's light. camera: what a camera makes of the images.
    """

    shift: float = 0.0
    scale: list[float] = field(default_factory=lambda: list(UNCHANGED))
    exposure: list[float] = field(default_factory=lambda: list(UNCHANGED))
    backgrounds: str | None = None
    instances: bool = False
    azimuth: float = 0.0
    environments: list[str] = field(default_factory=list)
    directional_fraction: float = 0.0
    fill_light: list[float] = field(default_factory=lambda: [0.0, 0.0])
    lit_background: bool = False
    camera: CameraEffectSettings = field(default_factory=CameraEffectSettings)

    def __post_init__(self) -> None:
        require_fields(self)
        for name, most in (("shift", 1), ("azimuth", 180), ("directional_fraction", 1)):
            require_range(f"augment.vary.{name}", getattr(self, name), 0, most)
        require_limits("augment.vary.fill_light", self.fill_light, 0, 1)
        for name in ("scale", "exposure"):
            require_limits(f"augment.vary.{name}", getattr(self, name), 1 / FACTOR, FACTOR)

    @property
    def moves(self) -> bool:
        """Whether views change, which then are rasterised in every round."""
        return self.shift > 0 or tuple(self.scale) != UNCHANGED or self.azimuth > 0 or self.instances

    @property
    def varies(self) -> bool:
        """Whether anything is drawn at all."""
        of_light = (
            tuple(self.exposure) != UNCHANGED
            or self.environments
            or self.directional_fraction > 0
            or self.lit_background
        )
        return bool(self.moves or of_light or self.backgrounds is not None or self.camera.changes)


def vary(scene: Scene, settings: VariationSettings, draws: torch.Generator, lights: int = 1) -> Scene:
    """The scene with rows drawn afresh around its own; the scene itself where nothing varies.

    All views of a row are moved alike. lights: how often all rows come, one after the other, each time the same but for
    the light and the camera's part. InputError where the folder of backgrounds has no readable image.
    """
    moved = _moved_rows(scene, settings, draws) if settings.moves or settings.backgrounds is not None else scene
    if lights > 1:
        moved = replace(moved, examples=[*moved.examples] * lights, lights=moved.lights.repeat(lights, 1, 1))
    return _taken_anew(moved, settings, draws) if settings.varies else moved


def _moved_rows(scene: Scene, settings: VariationSettings, draws: torch.Generator) -> Scene:
    """What is shown, where and before what."""
    place = settings.shift * (2 * torch.rand(len(scene), 2, generator=draws, dtype=torch.float64) - 1)
    scale = _between(settings.scale, len(scene), draws)
    angles = _angles(settings.azimuth, len(scene), draws)
    rows = [
        _moved(row, right, up, size, *angle)
        for row, (right, up), size, angle in zip(scene.examples, place.tolist(), scale, angles, strict=True)
    ]
    changed: dict[str, Any] = {}
    if settings.backgrounds is not None:
        changed["backgrounds"] = _images(Path(settings.backgrounds), len(scene), scene.settings.size, draws)
        rows = [replace(row, background=index) for index, row in enumerate(rows)]
    if settings.instances:
        views = list(dict.fromkeys((row.object, row.cameras) for row in scene.examples))
        seeds = torch.randint(2**31, (len(views),), generator=draws).tolist()
        drawn = zip(views, seeds, strict=True)
        changed["objects"] = [another_instance(scene.objects[index], seed) for (index, _), seed in drawn]
        number = {view: index for index, view in enumerate(views)}
        which = [number[row.object, row.cameras] for row in scene.examples]
        rows = [replace(row, object=index) for row, index in zip(rows, which, strict=True)]
    if settings.moves:  # views that never come again are not worth a place on the disk
        changed["operators"] = OperatorCache()
    return replace(scene, examples=rows, **changed)


def _taken_anew(scene: Scene, settings: VariationSettings, draws: torch.Generator) -> Scene:
    """In which light, and through which camera."""
    exposure = _between(settings.exposure, len(scene), draws)
    rows = [replace(row, exposure=row.exposure * each) for row, each in zip(scene.examples, exposure, strict=True)]
    changed: dict[str, Any] = {}
    if settings.environments:
        which = torch.randint(len(settings.environments), (len(rows),), generator=draws)
        changed["lights"] = torch.stack([load_light(light) for light in settings.environments])[which].to(scene.lights)
    if settings.directional_fraction > 0:
        changed["lights"] = _in_lamplight(changed.get("lights", scene.lights), scene, settings, draws)
    if settings.camera.changes:
        changed["camera_effects"] = draw_camera_effects(settings.camera, len(rows), scene.settings, draws).to(
            scene.lights.device
        )
    varied = replace(scene, examples=rows, **changed)
    return _with_lit_walls(varied) if settings.lit_background else varied


def _between(limits: Sequence[float], count: int, draws: torch.Generator) -> list[float]:
    low, high = (math.log(limit) for limit in limits)
    return (low + (high - low) * torch.rand(count, generator=draws, dtype=torch.float64)).exp().tolist()


def _moved(row: Example, right: float, up: float, scale: float, polar: float, azimuth: float) -> Example:
    """By shares of the frame's width, which shows the mesh so much larger, and by radians around it."""
    cameras = []
    for camera in row.cameras:
        width = camera.field_of_view / scale
        place = {"right": camera.right + right * width, "up": camera.up + up * width}
        turned = _turned(camera, polar, azimuth)
        cameras.append(replace(turned, field_of_view=width, **place))
    return replace(row, cameras=tuple(cameras))


def _turned(camera: Camera, polar: float, azimuth: float) -> Camera:
    return replace(camera, polar=camera.polar + polar, azimuth=camera.azimuth + azimuth)


def _images(folder: Path, count: int, size: int, draws: torch.Generator) -> Tensor:
    """(count, 3, size, size), with repetition."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"augment.vary.backgrounds={folder} holds no image: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    return torch.stack([read_image(files[index], size) for index in chosen])


def _angles(most: float, count: int, draws: torch.Generator) -> list[list[float]]:
    """(count, 2) in radians, uniform, `most` in degrees."""
    return (math.radians(most) * (2 * torch.rand(count, 2, generator=draws, dtype=torch.float64) - 1)).tolist()


def _in_lamplight(lights: Tensor, scene: Scene, settings: VariationSettings, draws: torch.Generator) -> Tensor:
    """The lights (E, 49, 3), some of them dimmed, with a white lamp that gives 1 to a surface facing it.

    What stands on a table has no lamp below it: one that is drawn there is mirrored.
    """
    low, high = settings.fill_light
    shape = (len(scene), 1, 1)
    ambient = low + (high - low) * torch.rand(shape, generator=draws)
    chosen = torch.rand(shape, generator=draws) < settings.directional_fraction
    lamps = []
    for row, angles in zip(scene.examples, _angles(LAMP_REACH, len(scene), draws), strict=True):
        towards = torch.from_numpy(_turned(row.cameras[0], *angles).axes()[2])
        if scene.objects[row.object].ground is not None:
            towards[2].abs_()
        lamps.append(directional(towards, torch.ones(3)).to(lights))
    lit = torch.stack(lamps) + ambient.to(lights) * lights
    return torch.where(chosen.to(lights.device), lit, lights)


def _with_lit_walls(scene: Scene) -> Scene:
    """Each row before its own background, times the irradiance of a surface that faces the row's first camera."""
    towards = torch.from_numpy(np.stack([row.cameras[0].axes()[2] for row in scene.examples]))
    exposures = torch.tensor([row.exposure for row in scene.examples])[:, None]
    live = scene.lights.cpu().double()[:, live_coefficients(DEGREE)]
    irradiance = torch.einsum("ek,ekc->ec", irradiance_basis(towards, DEGREE), live) * exposures
    images = scene.backgrounds[[row.background for row in scene.examples]]
    encoding = scene.settings.encoding
    lit = encode(clamp(decode(images, encoding) * irradiance.to(images)[:, :, None, None]), encoding)
    rows = [replace(row, background=index) for index, row in enumerate(scene.examples)]
    return replace(scene, examples=rows, backgrounds=lit)
