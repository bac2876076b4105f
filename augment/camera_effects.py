"""A camera's effects on rendered images: a projected pattern, white balance, blur and noise."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from renderer.errors import require_limits, require_range
from renderer.image import ImageSettings, clamp, decode, encode

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


@dataclass(frozen=True)
class CameraEffects:
    """The effects on the images of E examples.

    gains: (E, 3, 1 or size, 1 or size), factors of the linear light of object and background: the projected pattern
    times the white balance. blur: (E,) standard deviation of a Gaussian, in pixels; 0 for none. noise: (E, 3, size,
    size), added to the image's values.
    """

    gains: Tensor
    blur: Tensor
    noise: Tensor
    encoding: str

    def __call__(self, images: Tensor, examples: Tensor) -> Tensor:
        """Images (A, V, 3, size, size) of examples (A,) with their effects; differentiable in the images."""
        light = decode(images, self.encoding) * self.gains[examples, None]
        image = encode(clamp(_blurred(light, self.blur[examples])), self.encoding)
        return clamp(image + self.noise[examples, None])


def draw_camera_effects(
    settings: CameraEffectSettings,
    count: int,
    image: ImageSettings,
    draws: torch.Generator,
    device: torch.device | str = "cpu",
) -> CameraEffects:
    """Random effects for `count` examples."""
    patterns = draw_patterns(count, image.size, draws)
    low, high = settings.pattern_fill
    fill = low + (high - low) * torch.rand(count, 1, 1, 1, generator=draws)
    plain = torch.rand(count, 1, 1, 1, generator=draws) >= settings.pattern_fraction
    light = torch.where(plain, 1.0, fill + (1 - fill) * patterns)
    stops = settings.white_balance * (2 * torch.rand(count, 3, 1, 1, generator=draws) - 1)
    blur = settings.blur * torch.rand(count, generator=draws)
    deviation = settings.noise * torch.rand(count, 1, 1, 1, generator=draws)
    noise = deviation * torch.randn(count, 3, image.size, image.size, generator=draws)
    return CameraEffects((light * 2**stops).to(device), blur.to(device), noise.to(device), image.encoding)


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
    points = torch.stack(torch.meshgrid(middles, middles, indexing="xy"))  # (2, size, size)
    return torch.stack([_pattern(points, draws) for _ in range(count)])


def _pattern(points: Tensor, draws: torch.Generator) -> Tensor:
    angle, period, *shift = torch.rand(4, generator=draws) * torch.tensor([2 * math.pi, 1.0, 1.0, 1.0])
    rotation = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    rotated = torch.einsum("ij,jyx->iyx", rotation, points)
    family = FAMILIES[int(torch.randint(len(FAMILIES), (), generator=draws))]
    weight = family(rotated / (0.25 + 0.75 * period), torch.stack(shift)[:, None, None]).float()
    first, second = _color(draws), _color(draws) * torch.rand(1, generator=draws)  # the darker one down to black
    return second[:, None, None] + weight * (first - second)[:, None, None]


FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (  # masks of points and a shift, both of x and y
    lambda points, shift: ((points + shift) % 1 < 0.5)[0],  # stripes
    lambda points, shift: ((points + shift) % 1 < 0.5).sum(0) == 1,  # checkers
    lambda points, shift: ((points + shift) % 1 - 0.5).norm(dim=0) < 0.4,  # spots on a square grid, over half its area
    lambda points, shift: (points > shift - 0.5)[0],  # a half
    lambda points, shift: torch.ones_like(points[0]),  # a solid color
)


def _color(draws: torch.Generator) -> Tensor:
    """(3,) linear, of any hue, from white to pure; the largest channel is 1."""
    hue, saturation = torch.rand(2, generator=draws)
    ramps = (6 * hue + torch.tensor([0.0, 4.0, 2.0])) % 6  # of the hexcone (Smith 1978)
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")
