"""Images as a camera takes them: a thrown pattern, white balance, blur and noise after the render."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from augment.patterns import draw_patterns
from renderer.arguments import require_fields
from renderer.errors import require_limits, require_range
from renderer.image import ImageSettings, clamp, decode, encode

REACH = 3  # pixels to either side that a blur takes in


@dataclass
class SnapshotSettings:
    """What a camera makes of each image, uniform up to these; by default nothing.

    patterns: the share of images under a pattern that a projector throws. ambient: [least, most] of the scene's own
    light beneath it. white_balance: stops, up or down, of each channel. blur: standard deviation in pixels. noise:
    standard deviation of the image's values.
    """

    patterns: float = 0.0
    ambient: list[float] = field(default_factory=lambda: [0.0, 0.0])
    white_balance: float = 0.0
    blur: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        require_fields(self)
        for name, most in (("patterns", 1), ("white_balance", 5), ("blur", REACH / 2), ("noise", 1)):
            require_range(f"augment.vary.snapshot.{name}", getattr(self, name), 0, most)
        require_limits("augment.vary.snapshot.ambient", self.ambient, 0, 1)

    @property
    def changes(self) -> bool:
        """Whether images are any other than the renders."""
        return max(self.patterns, self.white_balance, self.blur, self.noise) > 0


@dataclass(frozen=True)
class Snapshot:
    """What becomes of the images of E examples, each part as it was drawn.

    gains: (E, 3, 1 or size, 1 or size), what the linear light of object and background is multiplied by: the thrown
    pattern, times the white balance's gain of each channel. blur: (E,) standard deviation of a Gaussian, in pixels, 0
    for none. noise: (E, 3, size, size), added to the image's values.
    """

    gains: Tensor
    blur: Tensor
    noise: Tensor
    encoding: str

    def to(self, device: torch.device) -> "Snapshot":
        return Snapshot(self.gains.to(device), self.blur.to(device), self.noise.to(device), self.encoding)

    def __call__(self, images: Tensor, examples: Tensor) -> Tensor:
        """Images (A, V, 3, size, size) of examples (A,) as they are photographed; differentiable in them."""
        light = decode(images, self.encoding) * self.gains[examples, None]
        image = encode(clamp(_blurred(light, self.blur[examples])), self.encoding)
        return clamp(image + self.noise[examples, None])


def draw_snapshot(settings: SnapshotSettings, count: int, image: ImageSettings, draws: torch.Generator) -> Snapshot:
    """What is drawn for each of `count` examples, on the CPU."""
    thrown = draw_patterns(count, image.size, draws)
    low, high = settings.ambient
    ambient = low + (high - low) * torch.rand(count, 1, 1, 1, generator=draws)
    none = torch.rand(count, 1, 1, 1, generator=draws) >= settings.patterns
    light = torch.where(none, 1.0, ambient + (1 - ambient) * thrown)
    stops = settings.white_balance * (2 * torch.rand(count, 3, 1, 1, generator=draws) - 1)
    blur = settings.blur * torch.rand(count, generator=draws)
    deviation = settings.noise * torch.rand(count, 1, 1, 1, generator=draws)
    noise = deviation * torch.randn(count, 3, image.size, image.size, generator=draws)
    return Snapshot(light * 2**stops, blur, noise, image.encoding)


def _blurred(images: Tensor, sigma: Tensor) -> Tensor:
    """Each example (V, 3, size, size) convolved with its Gaussian, by rows and by columns; the border is repeated."""
    offsets = torch.arange(-REACH, REACH + 1, device=images.device)
    weights = torch.exp(-0.5 * (offsets / sigma.clamp(min=1e-3)[:, None]) ** 2)  # (A, taps)
    weights = (weights / weights.sum(1, keepdim=True)).to(images)
    size = images.shape[-1]
    places = (torch.arange(size, device=images.device)[:, None] + offsets).clamp(0, size - 1)  # (size, taps)
    matrix = images.new_zeros(len(images), size, size)
    matrix.scatter_add_(2, places.expand(len(images), -1, -1), weights[:, None].expand(-1, size, -1))
    return torch.einsum("aij,avcjk,alk->avcil", matrix, images, matrix)
