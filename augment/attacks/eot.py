"""What a classifier is given of a rendered image: as it is, rounded to 8 bits, or as unsteady cameras might take it."""

import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn

from renderer.errors import require_range
from renderer.image import clamp, to_bytes, to_unit


@dataclass
class EOTSettings:
    """Random changes of an image over which an attack takes the expectation (Athalye et al. 2018, EOT).

    draws: of each image at each step, beside the image as it is; none by default. jitter: of the camera, up to this
    share of the image's width, radians and share of the distance. exposure: stops, up or down. noise: standard
    deviation of values. jpeg: the least quality, of which the greatest is 100.
    """

    draws: int = 0
    jitter: float = 0.03
    exposure: float = 0.2
    noise: float = 0.02
    jpeg: int = 75

    def __post_init__(self) -> None:
        require_range("attack.eot.draws", self.draws, 0, 1000)
        for name, most in (("jitter", 0.5), ("exposure", 5), ("noise", 1)):
            require_range(f"attack.eot.{name}", getattr(self, name), 0, most)
        require_range("attack.eot.jpeg", self.jpeg, 1, 100)


class Rounded(nn.Module):
    """A model that is given 8 bits a channel; the derivative passes straight through."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> Tensor:
        return self.model(straight_through(images, lambda each: to_unit(to_bytes(each)).to(each)))


class ExpectationOverTransformations(nn.Module):
    """A model's mean log-probabilities over images and random changes of them, drawn anew each time; the derivative
    passes straight through their compression."""

    def __init__(self, model: nn.Module, settings: EOTSettings, draws: torch.Generator):
        super().__init__()
        self.model, self.settings, self._draws = model, settings, draws

    def forward(self, images: Tensor) -> Tensor:
        seen = [images, *(self._changed(images) for _ in range(self.settings.draws))]
        return torch.stack([self.model(each).log_softmax(1) for each in seen]).mean(0)

    def _changed(self, images: Tensor) -> Tensor:
        """Images (N, 3, H, W), each under changes of its own."""
        settings, count = self.settings, len(images)
        moved = _moved(images, settings.jitter * self._uniform(count, 4).to(images))
        brighter = clamp(moved * (2 ** (settings.exposure * self._uniform(count, 1, 1, 1))).to(images))
        noise = settings.noise * torch.randn(images.shape, generator=self._draws)
        noisy = clamp(brighter + noise.to(images))
        quality = int(torch.randint(settings.jpeg, 101, (), generator=self._draws))
        return straight_through(noisy, lambda each: as_jpeg(each.cpu(), quality).to(each))

    def _uniform(self, *shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=self._draws) - 1


def straight_through(images: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Changed images whose derivative is that of the images as they are."""
    return images + (change(images.detach()) - images.detach())


def as_jpeg(images: Tensor, quality: int) -> Tensor:
    """Images (..., 3, H, W) in [0, 1], float32 on the CPU, compressed at a quality from 1 to 100 and read back."""
    compressed = []
    for image in to_bytes(images).flatten(0, -4):
        file = io.BytesIO()
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=quality)
        with Image.open(file) as read:
            compressed.append(torch.from_numpy(np.array(read)).permute(2, 0, 1))
    return to_unit(torch.stack(compressed)).view(images.shape)


def _moved(images: Tensor, amounts: Tensor) -> Tensor:
    """Images (N, 3, H, W) shifted, turned and enlarged by amounts (N, 4): shares of the width, across and down,
    radians, share of the size; what comes in from outside is the border."""
    across, down, angle, scale = amounts.unbind(1)
    cos, sin = (1 + scale) * angle.cos(), (1 + scale) * angle.sin()
    rows = torch.stack([cos, -sin, 2 * across, sin, cos, 2 * down], dim=1)
    grid = F.affine_grid(rows.view(-1, 2, 3), list(images.shape), align_corners=False)
    return F.grid_sample(images, grid, padding_mode="border", align_corners=False)
