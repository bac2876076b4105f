"""Normalize the light of images: white balance, exposure and encoding."""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from augment.settings import NormalizedLightSettings
from renderer.image import clamp, decode, encode

# Smallest sRGB value above black in an image of 8 bits. Below it, the gamma curve is a line.
DARKEST_ENCODED = 1 / 255
# Linear value of this sRGB value. Images are brightened as if their brightness were at least this,
# so that black images stay black.
DARKEST = DARKEST_ENCODED / 12.92


def normalize_light(
    images: Float[Tensor, "N 3 H W"], settings: NormalizedLightSettings
) -> Float[Tensor, "N 3 H W"]:
    """Normalize color and brightness of the light of each image.

    Each image is treated by itself, in linear light:

    1. White balance: each channel is multiplied by (m / m_c)^`white_balance`. Here, m_c is the
       mean of the channel, and m is the mean of all channels.
    2. Exposure: the image is multiplied by a factor that maps the given percentile of all pixels
       and channels to `level`. Values above 1 are clipped.
    3. Encoding: the sRGB curve, and then the exponent `gamma`.

    The result is differentiable almost everywhere.
    """
    linear = decode(clamp(images), "srgb")
    balanced = linear * _balance(linear, settings.white_balance)
    exposed = clamp(balanced * _exposure(balanced, settings))
    encoded = encode(exposed, "srgb")
    return _apply_gamma(encoded, settings.gamma)


def _balance(linear: Float[Tensor, "N 3 H W"], degree: float) -> Float[Tensor, "N 3 1 1"]:
    """Compute the factors of the white balance: (mean of all channels / mean of channel)^degree.

    With degree 1 all channels get the same mean, and with 0 they stay as they are.
    """
    channel_means = linear.mean((2, 3), keepdim=True)
    mean = channel_means.mean(1, keepdim=True)
    ratio = mean.clamp(min=DARKEST) / channel_means.clamp(min=DARKEST)
    return ratio**degree


def _exposure(
    linear: Float[Tensor, "N 3 H W"], settings: NormalizedLightSettings
) -> Float[Tensor, "N 1 1 1"]:
    """Compute the factors of the exposure, which map a percentile of an image to a given value."""
    values = linear.flatten(1)
    # The percentile is the value with this rank among the sorted values. Ranks start at 1.
    rank = math.ceil(settings.percentile / 100 * values.shape[1])
    bright = values.kthvalue(rank, dim=1).values
    factors = settings.level / bright.clamp(min=DARKEST)
    return factors.view(-1, 1, 1, 1)


def _apply_gamma(encoded: Float[Tensor, "N 3 H W"], gamma: float) -> Tensor:
    """Raise the values of images to a power, except that the curve is a line near black."""
    if gamma == 1:
        return encoded
    # x^gamma is x · x^(gamma - 1). The second factor is constant below `DARKEST_ENCODED`, because
    # it would be infinite at 0 if gamma is less than 1.
    factor = encoded.clamp(min=DARKEST_ENCODED) ** (gamma - 1)
    return encoded * factor
