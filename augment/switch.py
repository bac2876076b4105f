"""A second network for images in some light, beside another network for all other images."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

# A name that begins with one of these texts names a network, and a second one after a "+".
SWITCHES = DIM_NAME, LIT_NAME = "dim:", "lit:"
# Function that tells which of N images another network gets.
Chooser = Callable[[Tensor], Bool[Tensor, " N"]]


class Switch(nn.Module):
    """Network that shows the images which a function chooses to another network."""

    other: Any

    def __init__(self, network: nn.Module, other: nn.Module, chooses: Chooser):
        super().__init__()
        self.network, self.other, self.chooses = network, other, chooses
        self.training = network.training

    def forward(self, images: Tensor) -> Any:
        # Without images, there is nothing to choose, and no mean to choose by.
        is_chosen = self.chooses(images.detach()) if len(images) else torch.zeros(0)
        if not is_chosen.any():
            return self.network(images)
        if is_chosen.all():
            return self.other(images)
        # Place of each image among the outputs of both networks.
        places = torch.cat([(~is_chosen).nonzero(), is_chosen.nonzero()])[:, 0].argsort()
        outputs = [self.network(images[~is_chosen]), self.other(images[is_chosen])]
        if isinstance(outputs[0], Tensor):
            return torch.cat(outputs)[places]
        # Detectors return a list with an entry for each image.
        rows = [row for part in outputs for row in part]
        return [rows[place] for place in places.tolist()]

    def extra_repr(self) -> str:
        """Write what chooses, on which the keys of stored logits depend."""
        return repr(self.chooses)


@dataclass(frozen=True, eq=False)
class Recognizer:
    """Whether images are in the light of a training: a linear classifier of `statistics`.

    It says so if the statistics times `weights`, plus `bias`, are above 0.
    """

    network: nn.Module = field(repr=False)
    layers: Sequence[str]
    weights: Float[Tensor, " D"] | Sequence[float] = field(repr=False)
    bias: float

    def __call__(self, images: Float[Tensor, "N 3 H W"]) -> Bool[Tensor, " N"]:
        values = statistics(self.network, self.layers, images).double()
        weights = torch.as_tensor(self.weights, dtype=values.dtype, device=values.device)
        return values @ weights + self.bias > 0


@torch.no_grad()
def statistics(
    network: nn.Module, layers: Sequence[str], images: Float[Tensor, "N 3 H W"]
) -> Float[Tensor, "N D"]:
    """Compute mean and standard deviation of each channel in the outputs of layers of a network."""
    found: dict[str, Tensor] = {}

    def note(name: str, layer: nn.Module, _: Any, output: Tensor) -> None:
        # Linear layers have their channels last, and convolutions behind the images.
        channels = -1 if isinstance(layer, nn.Linear) else 1
        values = output.movedim(channels, 1).reshape(len(images), output.shape[channels], -1)
        found[name] = torch.cat([values.mean(2), values.std(2, correction=0)], 1)

    with ExitStack() as hooks:
        for name in layers:
            layer = network.get_submodule(name)
            hooks.enter_context(layer.register_forward_hook(partial(note, name)))
        network(images)
    return torch.cat([found[name] for name in layers], 1).float()
