"""What an epoch trains on, data and renders, in rounds, and how far it has come."""

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from augment import processes
from augment.seeding import generator
from augment.service import Renders
from renderer.image import to_bytes
from train.batches import Round, to_unit
from train.data import Split
from train.distributed import summed

PHASES = ("attack", "training", "evaluation", "input_output")  # of an epoch; others are parts of these, or once a run


def with_room(split: Split, count: int) -> Split:
    """The split's pictures and, behind them, room for a round's renders."""
    images, labels = split.images, split.labels
    return Split(
        torch.cat([images, images.new_zeros(count, *images.shape[1:])]), torch.cat([labels, labels.new_zeros(count)])
    )


def put_last(split: Split, renders: Renders) -> None:
    """Overwrite the split's last pictures with the renders, as 8-bit pictures."""
    first = len(split) - len(renders.labels)
    split.images[first:] = to_bytes(renders.images)
    split.labels[first:] = renders.labels


def rounds_of_epoch(
    images: int, renders: int, seed: int, epoch: int, images_per_epoch: int | None, every: int | None
) -> list[Round]:
    """The epoch's images, drawn anew each epoch where they are not all, in rounds of `every`, each with all renders.

    images, renders: how many there are; renders come last. None: all images, and one round.
    """
    drawn = torch.randperm(images, generator=generator(seed, epoch, "rounds"))[:images_per_epoch]
    parts = drawn.split(every or len(drawn))
    last = torch.arange(images, images + renders)
    return [
        Round(epoch * len(parts) + index, epoch, torch.cat([part.sort().values, last]))
        for index, part in enumerate(parts)
    ]


@dataclass
class EpochUnderWay:
    """How far an epoch has come.

    renders: of the round under way. sums: loss and hits over the pictures this process has seen (2,). history: the
    diagnostics of each round's renders so far. step: steps taken, in all rounds.
    """

    renders: Renders
    sums: Tensor
    history: list[Mapping[str, float]]
    step: int = 0

    @classmethod
    def begun(cls, renders: Renders) -> "EpochUnderWay":
        """Before the first step, with the first round's renders."""
        return cls(renders, torch.zeros(2, device=renders.labels.device), [renders.diagnostics])

    def next_round(self, renders: Renders) -> None:
        self.renders = renders
        self.history.append(renders.diagnostics)

    @property
    def round(self) -> int:
        """Of the epoch, from 0."""
        return len(self.history) - 1

    @property
    def diagnostics(self) -> dict[str, float]:
        """Means over the rounds."""
        return {name: fmean(each[name] for each in self.history) for name in self.renders.diagnostics}

    def state_dict(self) -> dict[str, Any]:
        """Plain values and tensors, over all processes; the renders as bytes, as they are trained on."""
        return {
            "images": to_bytes(self.renders.images),
            "labels": self.renders.labels,
            "history": [dict(each) for each in self.history],
            "sums": summed(self.sums.clone()),
            "step": self.step,
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], device: torch.device) -> "EpochUnderWay":
        history = state["history"]
        renders = Renders(to_unit(state["images"]).to(device), state["labels"].to(device), history[-1])
        sums = state["sums"] if processes.index() == 0 else torch.zeros(2)
        return cls(renders, sums.to(device), history, state["step"])
