"""A network for dim images beside the network for all others."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from augment.network import percentiles
from renderer.image import clamp, decode

# Percentile of the linear values of an image that tells whether it is dim.
DIM_PERCENTILE = 98.0
# Images are dim if this percentile is below this value.
DIM = 0.25

# A name that begins with this text names a network, and one for dim images after a "+".
DIM_NAME = "dim:"


def are_dim(images: Float[Tensor, "N 3 H W"], below: float = DIM) -> Bool[Tensor, " N"]:
    """Return whether the 98th percentile of the linear values of each image is below a limit."""
    linear = decode(clamp(images.detach()), "srgb")
    return percentiles(linear, DIM_PERCENTILE) < below


class DimSwitch(nn.Module):
    """Network that shows dim images to another network."""

    def __init__(self, network: nn.Module, dim: nn.Module, below: float):
        super().__init__()
        self.network, self.dim, self.below = network, dim, below
        self.training = network.training

    def forward(self, images: Tensor) -> Any:
        is_dim = are_dim(images, self.below)
        if not is_dim.any():
            return self.network(images)
        if is_dim.all():
            return self.dim(images)
        # Place of each image among the outputs of both networks.
        places = torch.cat([(~is_dim).nonzero(), is_dim.nonzero()])[:, 0].argsort()
        return _joined([self.network(images[~is_dim]), self.dim(images[is_dim])], places)

    def extra_repr(self) -> str:
        """Write the limit, on which the keys of stored logits depend."""
        return f"below={self.below}"


def _joined(outputs: list[Any], places: Int[Tensor, " N"]) -> Any:
    """Join outputs of several batches of images, and put them in another order."""
    first = outputs[0]
    if isinstance(first, Tensor):
        return torch.cat(outputs)[places]
    if isinstance(first, Mapping):
        # Outputs of transformers have keys without values.
        given = [key for key, value in first.items() if value is not None]
        parts = {key: [item[key] for item in outputs] for key in given}
        return type(first)(**{key: _joined(values, places) for key, values in parts.items()})
    rows = [row for item in outputs for row in item]
    return [rows[place] for place in places.tolist()]
