"""Random camera effects on images, and random projected patterns on the scene."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.augmentation_settings import CameraEffectSettings
from augment.progress import progress
from augment.scene.patterns import draw_patterns, draw_photograph_patterns, pixel_centers
from renderer.errors import InputError
from renderer.image import clamp, decode, encode
from renderer.io.images import SUFFIXES, read_image
from renderer.settings import ImageSettings

# A Gaussian blur averages each pixel with this number of neighbors on each side.
BLUR_RADIUS = 3
# This standard deviation of a Gaussian blur, in pixels, replaces 0, by which one cannot divide. It
# is so small that the blur changes nothing.
MIN_BLUR = 1e-3
# Probability that a random projected pattern shows a photograph, if there are photographs.
PHOTOGRAPH_PROBABILITY = 0.5


def draw_camera_effects(
    settings: CameraEffectSettings,
    count: int,
    image: ImageSettings,
    draws: torch.Generator,
    device: torch.device | str = "cpu",
    points: Float[Tensor, "2 count size size"] | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """Draw the effects of a camera and of a projector for the images of each example.

    The linear light of an image is multiplied by a random pattern, as of a projector, and by a
    random white balance. Then the image is blurred, and noise is added. The returned function takes
    images of A examples, shape (A, V, 3, size, size), and their indices. `points` are x and y in
    [-1, 1] of the point of the pattern that each pixel shows. None lets the pattern fill the image.
    """
    # Relative light of the projector at each pixel, shape (count, 3, size, size).
    patterns = draw_patterns(count, image.size, draws, points)
    if settings.slides is not None:
        patterns = _with_photographs(patterns, settings.slides, draws, points)
    low, high = settings.pattern_fill
    # Fraction of the light of each example that does not come from the projector.
    fill = low + (high - low) * torch.rand(count, 1, 1, 1, generator=draws)
    # Some examples have no pattern.
    has_pattern = torch.rand(count, 1, 1, 1, generator=draws) < settings.pattern_fraction
    pattern_gains = torch.where(has_pattern, fill + (1 - fill) * patterns, 1.0)
    # Change of the white balance of each channel, in stops. One stop is a factor of 2.
    stops = settings.white_balance * (2 * torch.rand(count, 3, 1, 1, generator=draws) - 1)
    blurs = settings.blur * torch.rand(count, generator=draws)
    noise_deviations = settings.noise * torch.rand(count, 1, 1, 1, generator=draws)
    noises = noise_deviations * torch.randn(count, 3, image.size, image.size, generator=draws)
    return _CameraEffects(
        gains=(pattern_gains * 2**stops).to(device),
        blurs=blurs.to(device),
        noises=noises.to(device),
        encoding=image.encoding,
    )


def _with_photographs(
    patterns: Float[Tensor, "count 3 size size"],
    folder: str,
    draws: torch.Generator,
    points: Float[Tensor, "2 count size size"] | None,
) -> Tensor:
    """Replace some of the patterns that a projector shows by photographs."""
    count, _, size, _ = patterns.shape
    is_replaced = torch.rand(count, generator=draws) < PHOTOGRAPH_PROBABILITY
    replaced_count = int(is_replaced.sum())
    if not replaced_count:
        return patterns
    images = draw_image_files(folder, "slides", replaced_count, size, draws)
    shown_points = pixel_centers(size) if points is None else points[:, is_replaced]
    photographs = draw_photograph_patterns(decode(images, "srgb"), shown_points, draws)
    result = patterns.clone()
    result[is_replaced] = photographs
    return result


@dataclass(frozen=True, eq=False)
class _CameraEffects:
    """Function that applies the effects of a camera to the images of E examples.

    Attributes:
        gains: Factor of the linear light of each pixel.
        blurs: Standard deviation of the blur of each example in pixels.
        noises: Noise that is added to each pixel value.
        encoding: Encoding of the images, such as "srgb".
    """

    gains: Float[Tensor, "E 3 size size"]
    blurs: Float[Tensor, " E"]
    noises: Float[Tensor, "E 3 size size"]
    encoding: str

    def __call__(
        self, images: Float[Tensor, "A V 3 size size"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A V 3 size size"]:
        """Apply the effects to images."""
        gained = decode(images, self.encoding) * self.gains[examples, None]
        blurred = _blur(gained, self.blurs[examples])
        encoded = encode(clamp(blurred), self.encoding)
        return clamp(encoded + self.noises[examples, None])


def _blur(
    images: Float[Tensor, "A V 3 size size"], deviations: Float[Tensor, " A"]
) -> Float[Tensor, "A V 3 size size"]:
    """Blur the images of each example by a Gaussian of its own width.

    The pixels at the border of an image are repeated beyond the border. Deviations are in pixels.
    """
    count = len(images)
    size = images.shape[-1]
    # A pixel is averaged over the N pixels with these offsets from it.
    offsets = torch.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, device=images.device)
    # Weight of each offset in each example, shape (A, N).
    weights = torch.exp(-0.5 * (offsets / deviations.clamp(min=MIN_BLUR)[:, None]) ** 2)
    weights = (weights / weights.sum(1, keepdim=True)).to(images)
    # Position along a row or a column of the N pixels around each pixel, shape (size, N).
    pixels = torch.arange(size, device=images.device)
    neighbors = (pixels[:, None] + offsets).clamp(0, size - 1)
    # One matrix for each example. Its row i has the weights of all pixels in the average for
    # pixel i, along one axis of the image. Shape (A, size, size).
    matrices = images.new_zeros(count, size, size)
    matrices.scatter_add_(
        2,
        neighbors.expand(count, -1, -1),
        weights[:, None].expand(-1, size, -1),
    )
    # A Gaussian blur is separable: the first matrix blurs along columns, the second along rows.
    return torch.einsum("aij,avcjk,alk->avcil", matrices, images, matrices)


def draw_image_files(
    folder: str | Path, key: str, count: int, size: int, draws: torch.Generator
) -> Float[Tensor, "count 3 size size"]:
    """Read randomly chosen images of a folder, with replacement."""
    files = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"{key}={folder} has no images: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    images = [read_image(files[index], size) for index in progress(chosen, f"reading {key}")]
    return torch.stack(images)
