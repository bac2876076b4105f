"""Effects of a camera on images, and patterns of a projector beneath them, drawn for each example."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from renderer.errors import require_limits, require_range
from renderer.image import ImageSettings, clamp, decode, encode
from renderer.validation import require_field_types

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
        require_field_types(self)
        for name, most in (("pattern_fraction", 1), ("white_balance", 5), ("blur", BLUR_RADIUS / 2), ("noise", 1)):
            require_range(name, getattr(self, name), 0, most)
        require_limits("pattern_fill", self.pattern_fill, 0, 1)


def draw_camera_effects(
    settings: CameraEffectSettings,
    count: int,
    image: ImageSettings,
    draws: torch.Generator,
    device: torch.device | str = "cpu",
    points: Tensor | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """Random effects of `count` examples: a differentiable function of images (A, V, 3, size, size) and their examples
    (A,). Projected patterns and white balance scale the linear light of object and background. points: (2, count, size,
    size), where in a pattern, which spans [-1, 1], each pixel is; by default, as if projected by the camera."""
    patterns = draw_patterns(count, image.size, draws, points)
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


def pixel_middles(size: int) -> Tensor:
    """(2, 1, size, size) of the pixels, right and down in an image that spans [-1, 1]."""
    middles = (torch.arange(size) + 0.5) / size * 2 - 1
    return torch.stack(torch.meshgrid(middles, middles, indexing="xy"))[:, None]


def draw_patterns(count: int, size: int, draws: torch.Generator, points: Tensor | None = None) -> Tensor:
    """(count, 3, size, size) linear light in [0, 1]: stripes, checkers, spots, halves and solid colors, each of two
    random colors, at a random angle, scale and position. points: as of `draw_camera_effects`."""
    points = pixel_middles(size) if points is None else points
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
    first, second = random_colors(colors[:, :2]), random_colors(colors[:, 2:4])
    second = second * colors[:, 4:, None, None]  # down to black
    return second + weight * (first - second)


FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (  # masks of points and a shift, both of x and y first
    lambda points, shift: ((points + shift) % 1 < 0.5)[0],  # stripes
    lambda points, shift: ((points + shift) % 1 < 0.5).sum(0) == 1,  # checkers
    lambda points, shift: ((points + shift) % 1 - 0.5).square().sum(0) < 0.4**2,  # spots, over half the area
    lambda points, shift: (points > shift - 0.5)[0],  # a half
    lambda points, shift: torch.ones_like(points[0]),  # a solid color
)


def random_colors(draws: Tensor) -> Tensor:
    """(N, 3, 1, 1) linear, of hues and saturations (N, 2): from white to pure; the largest channel is 1."""
    hue, saturation = draws.split(1, dim=1)
    ramps = (6 * hue + torch.tensor([0.0, 4.0, 2.0])) % 6  # of the hexcone (Smith 1978)
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")[:, :, None, None]
