"""Rows of a scene drawn anew: instance, view, light, background and camera effects of each example."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.objects import another_instance
from augment.scene import Example, Scene
from augment.utils import progress
from renderer.camera import Camera
from renderer.errors import FACTOR, InputError, require_limits, require_range
from renderer.image import ImageSettings, clamp, decode, encode
from renderer.io.images import SUFFIXES, read_image
from renderer.light.basis import HARMONICS
from renderer.light.presets import directional, load_light

UNCHANGED = (1.0, 1.0)
DIRECTIONAL_ANGLE = math.radians(70)  # between camera and directional light, around the mesh and up or down, at most
BLUR_RADIUS = 3  # pixels to either side that a blur averages over


@dataclass
class CameraEffectSettings:
    """The effects on each image, each uniform up to its value; by default none.

    pattern_fraction: of the images, under a projected pattern. pattern_fill: [least, most] of the scene's own light
    that stays beneath it. white_balance: stops, up or down, of each channel. blur: standard deviation in pixels.
    noise: standard deviation of the image's values.
    """

    pattern_fraction: float = 0.0
    pattern_fill: list[float] = field(default_factory=lambda: [0.0, 0.0])
    white_balance: float = 0.0
    blur: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        for name, most in (("pattern_fraction", 1), ("white_balance", 5), ("blur", BLUR_RADIUS / 2), ("noise", 1)):
            require_range(name, getattr(self, name), 0, most)
        require_limits("pattern_fill", self.pattern_fill, 0, 1)


@dataclass
class VariationSettings:
    """What is drawn for each example in each regeneration; by default nothing, which leaves the paper's grid.

    shift: of the mesh's center, at most, as a fraction of the frame's width, to either side and up and down.
    scale, exposure: [least, most] factor of the mesh's size in the frame, and of the light; log-uniform. backgrounds:
    a folder of images, one behind each example. instances: every solid that is named without a seed is another instance
    in each of its views. azimuth: degrees that the camera moves around the mesh, at most, to either side and up and
    down. environments: each example is in one of these lights, as `load_light` takes them. directional_fraction: of the
    examples, in a directional light from the camera's side, up to 70° off, plus [least, most] `fill_light` of their own
    light. lit_background: a background is a wall that faces the camera, in the example's light.

    >>> VariationSettings(shift=0.1).moves, VariationSettings(exposure=[0.5, 2.0]).moves
    (True, False)
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
        for name, most in (("shift", 1), ("azimuth", 180), ("directional_fraction", 1)):
            require_range(name, getattr(self, name), 0, most)
        require_limits("fill_light", self.fill_light, 0, 1)
        for name in ("scale", "exposure"):
            require_limits(name, getattr(self, name), 1 / FACTOR, FACTOR)

    @property
    def moves(self) -> bool:
        """Whether views change, which then are rasterized in every regeneration."""
        return self.shift > 0 or tuple(self.scale) != UNCHANGED or self.azimuth > 0 or self.instances


def vary(scene: Scene, settings: VariationSettings, draws: torch.Generator, once: bool = False) -> Scene:
    """The scene with rows drawn anew around its own; the scene itself where nothing varies.

    All views of a row are moved alike. once: they are rendered in one light only. InputError: a folder without images.
    """
    if settings.moves or settings.backgrounds is not None:
        scene = _with_moved_rows(scene, settings, draws, once)
    return scene if settings == VariationSettings() else _with_other_light(scene, settings, draws)


def _with_moved_rows(scene: Scene, settings: VariationSettings, draws: torch.Generator, once: bool) -> Scene:
    shifts = _offsets(settings.shift, len(scene), draws)
    scales = _log_uniform(settings.scale, len(scene), draws)
    angles = _offsets(math.radians(settings.azimuth), len(scene), draws)
    rows, changed = list[Example](), dict[str, Any]()
    for row, (right, up), scale, angle in zip(scene.examples, shifts, scales, angles, strict=True):
        cameras = []
        for camera in row.cameras:
            width = camera.width / scale
            shift = {"right": camera.right + right * width, "up": camera.up + up * width}
            cameras.append(replace(_turned(camera, *angle), width=width, **shift))
        rows.append(replace(row, cameras=tuple(cameras)))
    if settings.backgrounds is not None:
        changed["backgrounds"] = _images(Path(settings.backgrounds), len(scene), scene.settings.size, draws)
        rows = [replace(row, background=index) for index, row in enumerate(rows)]
    if settings.instances:
        views = dict.fromkeys((row.object, row.cameras) for row in scene.examples)
        numbers = {view: index for index, view in enumerate(views)}
        instances = zip(views, torch.randint(2**31, (len(views),), generator=draws).tolist(), strict=True)
        counted = progress(instances, "new instances", len(views))
        changed["objects"] = [another_instance(scene.objects[index], seed) for (index, _), seed in counted]
        shown = [numbers[row.object, row.cameras] for row in scene.examples]
        rows = [replace(row, object=number) for row, number in zip(rows, shown, strict=True)]
    has_rays = scene.basis != HARMONICS or scene.settings.global_illumination  # which take longer than an operator
    return replace(scene, examples=rows, one_light=once and settings.moves and not has_rays, **changed)


def _with_other_light(scene: Scene, settings: VariationSettings, draws: torch.Generator) -> Scene:
    exposures = _log_uniform(settings.exposure, len(scene), draws)
    rows = [replace(row, exposure=row.exposure * factor) for row, factor in zip(scene.examples, exposures, strict=True)]
    changed: dict[str, Any] = {}
    if settings.environments:
        chosen = torch.randint(len(settings.environments), (len(rows),), generator=draws)
        lights = torch.stack([load_light(light) for light in settings.environments])
        changed["lights"] = lights[chosen].to(scene.lights)
    if settings.directional_fraction > 0:
        changed["lights"] = _in_directional_light(changed.get("lights", scene.lights), scene, settings, draws)
    if settings.camera != CameraEffectSettings():
        device = scene.lights.device
        changed["camera_effects"] = draw_camera_effects(settings.camera, len(rows), scene.settings, draws, device)
    varied = replace(scene, examples=rows, **changed)
    return _with_lit_walls(varied) if settings.lit_background else varied


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


def _in_directional_light(lights: Tensor, scene: Scene, settings: VariationSettings, draws: torch.Generator) -> Tensor:
    """The lights (E, 49, 3), a fraction of them dimmed, plus a white directional light of irradiance 1.

    An object on a table has no light from below: a direction that is drawn there is mirrored.
    """
    low, high = settings.fill_light
    shape = (len(scene), 1, 1)
    fill = low + (high - low) * torch.rand(shape, generator=draws)
    chosen = torch.rand(shape, generator=draws) < settings.directional_fraction
    angles = _offsets(DIRECTIONAL_ANGLE, len(scene), draws)
    cameras = [_turned(row.cameras[0], *turn) for row, turn in zip(scene.examples, angles, strict=True)]
    towards = torch.from_numpy(np.stack([camera.axes()[2] for camera in cameras]))
    on_table = torch.tensor([scene.objects[row.object].ground is not None for row in scene.examples])
    towards[on_table, 2] = towards[on_table, 2].abs()
    lit = directional(towards, torch.ones(3)).to(lights) + fill.to(lights) * lights
    return torch.where(chosen.to(lights.device), lit, lights)


def _with_lit_walls(scene: Scene) -> Scene:
    """Each row before its own background, times the irradiance of a surface that faces the row's first camera."""
    towards = torch.from_numpy(np.stack([row.cameras[0].axes()[2] for row in scene.examples]))
    exposures = torch.tensor([row.exposure for row in scene.examples])[:, None]
    coefficients = scene.lights.cpu().double()[:, HARMONICS.nonzero]
    irradiance = torch.einsum("ek,ekc->ec", HARMONICS.irradiance(towards), coefficients) * exposures
    images = scene.backgrounds[[row.background for row in scene.examples]]
    encoding = scene.settings.encoding
    lit = encode(clamp(decode(images, encoding) * irradiance.to(images)[:, :, None, None]), encoding)
    rows = [replace(row, background=index) for index, row in enumerate(scene.examples)]
    return replace(scene, examples=rows, backgrounds=lit)


def draw_camera_effects(
    settings: CameraEffectSettings,
    count: int,
    image: ImageSettings,
    draws: torch.Generator,
    device: torch.device | str = "cpu",
) -> Callable[[Tensor, Tensor], Tensor]:
    """Random effects of `count` examples: a differentiable function of images (A, V, 3, size, size) and their examples
    (A,). Projected patterns and white balance scale the linear light of object and background."""
    patterns = draw_patterns(count, image.size, draws)
    low, high = settings.pattern_fill
    fill = low + (high - low) * torch.rand(count, 1, 1, 1, generator=draws)
    plain = torch.rand(count, 1, 1, 1, generator=draws) >= settings.pattern_fraction
    light = torch.where(plain, 1.0, fill + (1 - fill) * patterns)
    stops = settings.white_balance * (2 * torch.rand(count, 3, 1, 1, generator=draws) - 1)
    sigma = settings.blur * torch.rand(count, generator=draws)
    deviation = settings.noise * torch.rand(count, 1, 1, 1, generator=draws)
    noises = deviation * torch.randn(count, 3, image.size, image.size, generator=draws)
    gains, blur, noise = (drawn.to(device) for drawn in (light * 2**stops, sigma, noises))

    def effects(images: Tensor, examples: Tensor) -> Tensor:
        gained = decode(images, image.encoding) * gains[examples, None]
        blurred = encode(clamp(_blurred(gained, blur[examples])), image.encoding)
        return clamp(blurred + noise[examples, None])

    return effects


def _blurred(images: Tensor, sigma: Tensor) -> Tensor:
    """Each example (V, 3, size, size) convolved with its Gaussian, by rows and by columns; the border is repeated."""
    offsets = torch.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, device=images.device)
    weights = torch.exp(-0.5 * (offsets / sigma.clamp(min=1e-3)[:, None]) ** 2)  # (A, taps)
    weights = (weights / weights.sum(1, keepdim=True)).to(images)
    size = images.shape[-1]
    columns = (torch.arange(size, device=images.device)[:, None] + offsets).clamp(0, size - 1)  # (size, taps)
    matrix = images.new_zeros(len(images), size, size)
    matrix.scatter_add_(2, columns.expand(len(images), -1, -1), weights[:, None].expand(-1, size, -1))
    return torch.einsum("aij,avcjk,alk->avcil", matrix, images, matrix)


def draw_patterns(count: int, size: int, draws: torch.Generator) -> Tensor:
    """(count, 3, size, size) linear light in [0, 1]: stripes, checkers, spots, halves and solid colors, each of two
    random colors, at a random angle, scale and position."""
    middles = (torch.arange(size) + 0.5) / size * 2 - 1
    points = torch.stack(torch.meshgrid(middles, middles, indexing="xy"))[:, None]  # (2, 1, size, size)
    rows = []
    for _ in range(count):
        place, family = torch.rand(4, generator=draws), torch.randint(len(FAMILIES), (), generator=draws)
        rows.append((place, family, torch.rand(5, generator=draws)))
    places, families, colors = (torch.stack(column) for column in zip(*rows, strict=True))
    turn, period, *shift = places.T[:, :, None, None]
    cosine, sine = (2 * math.pi * turn).cos(), (2 * math.pi * turn).sin()
    x, y = points / (0.25 + 0.75 * period)
    rotated, shifts = torch.stack([cosine * x - sine * y, sine * x + cosine * y]), torch.stack(shift)
    weight = torch.empty(count, 1, *points.shape[2:])
    for index, mask in enumerate(FAMILIES):
        here = torch.nonzero(families == index).squeeze(1)
        weight[here, 0] = mask(rotated[:, here], shifts[:, here]).float()
    first, second = _colors(colors[:, :2]), _colors(colors[:, 2:4]) * colors[:, 4:, None, None]  # down to black
    return second + weight * (first - second)


FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (  # masks of points and a shift, both of x and y first
    lambda points, shift: ((points + shift) % 1 < 0.5)[0],  # stripes
    lambda points, shift: ((points + shift) % 1 < 0.5).sum(0) == 1,  # checkers
    lambda points, shift: ((points + shift) % 1 - 0.5).norm(dim=0) < 0.4,  # spots on a square grid, over half its area
    lambda points, shift: (points > shift - 0.5)[0],  # a half
    lambda points, shift: torch.ones_like(points[0]),  # a solid color
)


def _colors(draws: Tensor) -> Tensor:
    """(N, 3, 1, 1) linear, of hues and saturations (N, 2): from white to pure; the largest channel is 1."""
    hue, saturation = draws.split(1, dim=1)
    ramps = (6 * hue + torch.tensor([0.0, 4.0, 2.0])) % 6  # of the hexcone (Smith 1978)
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")[:, :, None, None]
