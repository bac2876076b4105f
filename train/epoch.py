"""What an epoch trains on, data and renders, and how far it has come."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from augment import processes
from augment.service import Renders
from renderer.image import to_bytes
from train.batches import to_unit
from train.data import Split
from train.distributed import summed

PHASES = ("attack", "training", "evaluation", "input_output")  # of an epoch; others are parts of these, or once a run


def with_room(split: Split, count: int) -> Split:
    """The split's pictures and, behind them, room for an epoch's renders."""
    images, labels = split.images, split.labels
    return Split(
        torch.cat([images, images.new_zeros(count, *images.shape[1:])]), torch.cat([labels, labels.new_zeros(count)])
    )


def put_last(split: Split, renders: Renders) -> None:
    """Overwrite the split's last pictures with the renders, as 8-bit pictures."""
    first = len(split) - len(renders.labels)
    split.images[first:] = to_bytes(renders.images)
    split.labels[first:] = renders.labels


@dataclass
class EpochUnderWay:
    """Its renders, the steps taken, and the sums of loss and hits over the pictures this process has seen (2,)."""

    renders: Renders
    sums: Tensor
    step: int = 0

    def state_dict(self) -> dict[str, Any]:
        """Plain values and tensors, over all processes; the renders as bytes, as they are trained on."""
        diagnostics = dict(self.renders.diagnostics)
        renders = {"images": to_bytes(self.renders.images), "labels": self.renders.labels, "diagnostics": diagnostics}
        return {"renders": renders, "sums": summed(self.sums.clone()), "step": self.step}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], device: torch.device) -> "EpochUnderWay":
        images, labels, diagnostics = (state["renders"][name] for name in ("images", "labels", "diagnostics"))
        renders = Renders(to_unit(images).to(device), labels.to(device), diagnostics)
        sums = state["sums"] if processes.index() == 0 else torch.zeros(2)
        return cls(renders, sums.to(device), state["step"])
