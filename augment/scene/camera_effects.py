"""Random camera effects on images, and random projected patterns on the scene."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from augment.scene.image_files import draw_image_files
from augment.scene.patterns import draw_patterns, draw_photograph_patterns, pixel_centers
from augment.settings import CameraEffectSettings
from renderer.image import clamp, decode, encode
from renderer.settings import ImageSettings

# `_blur` averages each pixel with this number of neighbors on each side.
BLUR_RADIUS = 3
# Smallest standard deviation of the Gaussian in `_blur`, in pixels. A blur of this width leaves
# images as they are. It replaces 0, by which `_blur` cannot divide.
MIN_BLUR = 1e-3
# Probability that a pattern shows a photograph if the settings name a folder of photographs.
PHOTOGRAPH_PROBABILITY = 0.5


def draw_camera_effects(
    settings: CameraEffectSettings,
    count: int,
    image: ImageSettings,
    draws: torch.Generator,
    device: torch.device | str = "cpu",
    points: Tensor | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """Draw the effects of a camera and a projected pattern for each example.

    Patterns and white balance scale the linear light of object and background.
    The blur and then the noise follow.

    Args:
        settings: Ranges of the effects.
        count: Number of examples.
        image: Size and encoding of the images.
        draws: Generator of the random numbers.
        device: Device of the images.
        points: Point of the pattern that each pixel shows, in [-1, 1], shape
            (2, count, size, size). By default, the pattern fills the image, as
            if the camera projected it.

    Returns:
        A differentiable function. It takes images (A, V, 3, size, size), with
        V views of each of A examples, and the indices of these examples (A,).
        It returns the changed images.

    Example:
        >>> draws = torch.Generator().manual_seed(0)
        >>> effects = draw_camera_effects(CameraEffectSettings(), 5, ImageSettings(8), draws)
        >>> effects(torch.rand(2, 1, 3, 8, 8), torch.tensor([0, 4])).shape
        torch.Size([2, 1, 3, 8, 8])
    """
    # The pattern multiplies the linear light, shape (count, 3, size, size). `fill` is the
    # fraction of the light that does not come from the projector.
    patterns = draw_patterns(count, image.size, draws, points)
    if settings.slides is not None:
        patterns = _with_photographs(patterns, settings.slides, draws, points)
    low, high = settings.pattern_fill
    fill = low + (high - low) * torch.rand(count, 1, 1, 1, generator=draws)
    # Mask of the examples without a pattern, shape (count, 1, 1, 1).
    is_plain = torch.rand(count, 1, 1, 1, generator=draws) >= settings.pattern_fraction
    pattern_gains = torch.where(is_plain, 1.0, fill + (1 - fill) * patterns)
    # White balance in stops of each color channel. One stop is a factor of 2.
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
    patterns: Tensor, folder: str, draws: torch.Generator, points: Tensor | None
) -> Tensor:
    """Replace some patterns by photographs.

    Args:
        patterns: Linear light in [0, 1], shape (count, 3, size, size).
        folder: Folder of the photographs.
        draws: Generator of the random numbers.
        points: See `draw_camera_effects`.

    Returns:
        The patterns, of the same shape.
    """
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
    """Effects of a camera on the images of E examples.

    Attributes:
        gains: Factors of the linear light, shape (E, 3, size, size).
        blurs: Standard deviations of the blur in pixels, shape (E,).
        noises: Values that are added to the images, shape
            (E, 3, size, size).
        encoding: Encoding of the images.
    """

    gains: Tensor
    blurs: Tensor
    noises: Tensor
    encoding: str

    def __call__(self, images: Tensor, examples: Tensor) -> Tensor:
        """Apply the effects to images.

        Args:
            images: Image values of V views of A examples, shape (A, V, 3, size, size).
            examples: Indices of the A examples, shape (A,).

        Returns:
            Changed images in [0, 1], shape (A, V, 3, size, size).
        """
        gained = decode(images, self.encoding) * self.gains[examples, None]
        blurred = _blur(gained, self.blurs[examples])
        encoded = encode(clamp(blurred), self.encoding)
        return clamp(encoded + self.noises[examples, None])


def _blur(images: Tensor, deviations: Tensor) -> Tensor:
    """Convolve images with Gaussians.

    The pixels at the border of an image are repeated beyond the border.

    Args:
        images: V images of each of A examples, shape (A, V, 3, size, size).
        deviations: Standard deviation of the Gaussian of each example in pixels, shape (A,).

    Returns:
        Blurred images, shape (A, V, 3, size, size).
    """
    size = images.shape[-1]
    # Below, N = 2 · BLUR_RADIUS + 1 is the number of pixels over which a pixel is averaged.
    offsets = torch.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, device=images.device)
    # Shape (A, N).
    weights = torch.exp(-0.5 * (offsets / deviations.clamp(min=MIN_BLUR)[:, None]) ** 2)
    weights = (weights / weights.sum(1, keepdim=True)).to(images)
    pixels = torch.arange(size, device=images.device)
    # Index along one axis of the N pixels around each pixel, shape (size, N).
    neighbors = (pixels[:, None] + offsets).clamp(0, size - 1)
    # The matrix (size, size) of an example blurs its images along one axis. Row i has the
    # weights with which the pixels contribute to pixel i.
    matrices = images.new_zeros(len(images), size, size)
    matrices.scatter_add_(
        2,
        neighbors.expand(len(images), -1, -1),
        weights[:, None].expand(-1, size, -1),
    )
    # A Gaussian blur is separable. The first matrix blurs each image vertically (j to i), and
    # the second horizontally (k to l).
    return torch.einsum("aij,avcjk,alk->avcil", matrices, images, matrices)
