"""The image as a classifier gets it: rounded to 8 bits, with the noise of a sensor, or under random transformations, as
of an unsteady camera."""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn

from augment.random_streams import generator
from renderer.errors import require_range
from renderer.image import clamp, to_bytes, to_unit
from renderer.validation import require_field_types

NOISE_DRAWS = 3  # of the sensor's noise, all of which an adversary must survive


@dataclass
class EOTSettings:
    """Random transformations of an image over which an attack takes the expectation (Athalye et al. 2018, EOT).

    draws: transformations of each image at each step, beside the image as it is; 0 for none. jitter: of the camera, at
    most this fraction of the image's width, radians and fraction of the distance. exposure: stops, up or down. noise:
    standard deviation of pixel values. jpeg: the least quality, of at most 100.
    """

    draws: int = 0
    jitter: float = 0.03
    exposure: float = 0.2
    noise: float = 0.02
    jpeg: int = 75

    def __post_init__(self) -> None:
        require_field_types(self)
        require_range("draws", self.draws, 0, 1000)
        for name, most in (("jitter", 0.5), ("exposure", 5), ("noise", 1)):
            require_range(name, getattr(self, name), 0, most)
        require_range("jpeg", self.jpeg, 1, 100)


class Rounded(nn.Module):
    """A model whose images are rounded to 8 bits per channel; the derivative passes straight through."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> Tensor:
        return self.model(straight_through(images, lambda exact: to_unit(to_bytes(exact)).to(exact)))


def stored(images: Tensor, deviation: float, examples: Tensor, *key: int | str) -> Iterator[Tensor]:
    """Images as a camera stores them, in each of `NOISE_DRAWS` draws of its noise.

    A sensor adds its noise before the values are rounded, and so does this. An example's noise depends on the key and
    on its number alone: not on the other examples, nor on the device, and no other random stream changes.

    Args:
        images: (A, V, 3, H, W) in [0, 1].
        deviation: the standard deviation of the Gaussian noise, in steps of 8 bits (1/255).
        examples: (A,) int64, the numbers of the examples.
        key: of the random stream, such as the seed of an attack; see `augment.random_streams.stream_seed`.

    Yields:
        (A, V, 3, H, W) in [0, 1], of 8 bits, with values of the images' type.
    """
    draws = [generator(*key, example) for example in examples.tolist()]
    for _ in range(NOISE_DRAWS):
        noise = [torch.randn(images.shape[1:], generator=draw) for draw in draws]
        noisy = images + deviation / 255 * torch.stack(noise).to(images)
        yield to_unit(to_bytes(clamp(noisy))).to(images)


class ExpectationOverTransformations:
    """The mean of a model's log-probabilities over images and random transformations of them, drawn anew in each call;
    the derivative passes straight through their compression."""

    def __init__(self, settings: EOTSettings, draws: torch.Generator):
        self.settings, self._draws = settings, draws

    def __call__(self, model: nn.Module, images: Tensor, logits: Tensor) -> Tensor:
        """(N, C) of images (N, 3, H, W) with logits (N, C); the logits themselves, where nothing is to be drawn."""
        if not self.settings.draws:
            return logits
        others = (model(self._transformed(images)) for _ in range(self.settings.draws))
        return torch.stack([each.log_softmax(1) for each in (logits, *others)]).mean(0)

    def _transformed(self, images: Tensor) -> Tensor:
        """Images (N, 3, H, W), each with its own transformation."""
        settings, count = self.settings, len(images)
        moved = _moved(images, settings.jitter * self._uniform(count, 4).to(images))
        brighter = clamp(moved * (2 ** (settings.exposure * self._uniform(count, 1, 1, 1))).to(images))
        noise = settings.noise * torch.randn(images.shape, generator=self._draws)
        noisy = clamp(brighter + noise.to(images))
        quality = int(torch.randint(settings.jpeg, 101, (), generator=self._draws))
        return straight_through(noisy, lambda exact: as_jpeg(exact.cpu(), quality).to(exact))

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
    """Images (N, 3, H, W) shifted, rotated and scaled by amounts (N, 4): fractions of the width across and down,
    radians, fraction of the size; pixels from outside repeat the border."""
    across, down, angle, scale = amounts.unbind(1)
    cos, sin = (1 + scale) * angle.cos(), (1 + scale) * angle.sin()
    rows = torch.stack([cos, -sin, 2 * across, sin, cos, 2 * down], dim=1)
    grid = F.affine_grid(rows.view(-1, 2, 3), list(images.shape), align_corners=False)
    return F.grid_sample(images, grid, padding_mode="border", align_corners=False)
