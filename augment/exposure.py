"""Exposure of images: normalized light, and which images are dim."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from augment.network import Network, plain_outputs
from augment.settings import NormalizedLightSettings, NormalizeLight, read_normalized_light
from renderer.errors import InputError
from renderer.image import clamp, decode, encode

# Smallest sRGB value above black in an image of 8 bits. Below it, the gamma curve is a line.
DARKEST_ENCODED = 1 / 255
# Linear value of this sRGB value. Images are brightened as if they were at least this bright.
DARKEST = DARKEST_ENCODED / 12.92
# Percentile of the linear values of an image that tells whether it is dim.
DIM_PERCENTILE = 98.0
# Images are dim if this percentile is below this value.
DIM = 0.25


class LightNormalization(nn.Module):
    """Transform images by `normalize_light`."""

    def __init__(self, settings: NormalizedLightSettings):
        super().__init__()
        self.settings = settings

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N 3 H W"]:
        return normalize_light(images, self.settings)

    def extra_repr(self) -> str:
        """Write the settings, on which the keys of stored logits depend."""
        return str(self.settings)


class MeanOfLights(Network):
    """Classifier that averages probabilities of a dim image over unchanged and normalized light.

    Both are computed for all images, because CUDA graphs need fixed shapes.
    """

    def forward(self, images: Tensor, *_: Any) -> Tensor:
        unchanged, normalized = map(plain_outputs, (self.network(images), super().forward(images)))
        if not isinstance(unchanged, Tensor) or unchanged.ndim != 2:
            raise InputError("normalize_light.average is for classifiers alone: set it to false")
        unchanged, normalized = unchanged.log_softmax(1), normalized.log_softmax(1)
        mean = torch.logaddexp(unchanged, normalized) - math.log(2)
        return torch.where(IsDim()(images)[:, None], mean, unchanged)


def with_normalized_light(network: nn.Module, value: NormalizeLight) -> nn.Module:
    """Return a network that normalizes the light of images and then calls a given network."""
    settings = read_normalized_light(value)
    if settings is None:
        return network
    if light_settings(network) is not None:
        reason = "normalize_light is set, but the network normalizes light already"
        raise InputError(f"{reason}: remove normalize_light", "normalize_light")
    return (MeanOfLights if settings.average else Network)(network, [LightNormalization(settings)])


def light_settings(network: object) -> NormalizedLightSettings | None:
    """Return the settings with which a network normalizes light. None if it does not."""
    transforms = network.transforms if isinstance(network, Network) else ()
    return next((one.settings for one in transforms if isinstance(one, LightNormalization)), None)


def without_normalized_light(network: Any) -> Any:
    """Remove the normalization of light, if there is one, from in front of a network."""
    return network if light_settings(network) is None else network.network


def normalize_light(images: Float[Tensor, "N 3 H W"], settings: NormalizedLightSettings) -> Tensor:
    """Normalize color and brightness of the light of each image.

    Each image is treated by itself, in linear light:

    1. White balance: each channel is multiplied by (m / m_c)^`white_balance`. Here, m_c is the
       mean of the channel, and m is the mean of all channels.
    2. Exposure: a factor maps the given percentile of all values to `level`. Values above 1 are
       clipped.
    3. Encoding: the sRGB curve, and then the exponent `gamma`.

    The result is differentiable almost everywhere.
    """
    linear = decode(clamp(images), "srgb")
    channel_means = linear.mean((2, 3), keepdim=True)
    mean = channel_means.mean(1, keepdim=True)
    ratio = mean.clamp(min=DARKEST) / channel_means.clamp(min=DARKEST)
    balanced = linear * ratio**settings.white_balance

    factors = settings.level / percentiles(balanced, settings.percentile).clamp(min=DARKEST)
    encoded = encode(clamp(balanced * factors.view(-1, 1, 1, 1)), "srgb")

    # x^gamma is x · x^(gamma - 1). The second factor would be infinite at 0 if gamma is below 1.
    return encoded * encoded.clamp(min=DARKEST_ENCODED) ** (settings.gamma - 1)


def percentiles(images: Float[Tensor, "N 3 H W"], percentile: float) -> Float[Tensor, " N"]:
    """Return the value of each image with the rank ⌈percentile / 100 · number of values⌉."""
    values = images.flatten(1)
    return values.kthvalue(math.ceil(percentile / 100 * values.shape[1]), dim=1).values


@dataclass(frozen=True)
class IsDim:
    """Whether the 98th percentile of the linear values of each image is below a limit."""

    below: float = DIM

    def __call__(self, images: Float[Tensor, "N 3 H W"]) -> Bool[Tensor, " N"]:
        return percentiles(decode(clamp(images.detach()), "srgb"), DIM_PERCENTILE) < self.below
