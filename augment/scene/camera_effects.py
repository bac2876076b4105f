"""Effects of a camera on images, and patterns of a projector beneath them, drawn for each example."""

from collections.abc import Callable

import torch
from torch import Tensor

from augment.scene.patterns import draw_patterns
from augment.settings import CameraEffectSettings
from renderer.image import clamp, decode, encode
from renderer.settings import ImageSettings

BLUR_RADIUS = 3  # pixels to either side that a blur averages over


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
