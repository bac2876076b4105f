"""What an attack is to reach, and the cost that it decreases on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.labels import require_known

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

NO_CLASS = -1  # in place of a class that does not count


@dataclass(frozen=True)
class Goal:
    """Per example and view, the class whose confidence falls and, where there is a target, the one whose rises.

    decrease: NO_CLASS where the target alone counts. increase: the same, or None for an attack that takes
    any error, as it does where it is NO_CLASS. An example is fooled where every view is given its target, or without
    one, anything but `decrease`.
    """

    decrease: Int[Tensor, "E V"]
    increase: Int[Tensor, "E V"] | None = None

    def of(self, examples: Tensor) -> Goal:
        """The same for some of the examples."""
        return Goal(self.decrease[examples], None if self.increase is None else self.increase[examples])

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Whether all views of an example are, for predicted classes."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, "E V"]:
        """Whether each view is, for predicted classes."""
        erred = predicted != self.decrease
        if self.increase is None:
            return erred
        return torch.where(self.increase == NO_CLASS, erred, predicted == self.increase)


def adversarial_cost(
    logits: Float[Tensor, "E classes"], decrease: Int[Tensor, " E"], increase: Int[Tensor, " E"] | None = None
) -> Float[Tensor, " E"]:
    """-CE(f, L_d) + CE(f, L_i) per example, the paper's equation 1, which an attack decreases.

    decrease: the classes whose confidence falls. increase: those whose confidence rises; None attacks without a target.
    NO_CLASS in either leaves its term out. InputError for a class that there are no logits of.
    """
    require_known(decrease, logits)
    cost = -F.cross_entropy(logits, decrease, reduction="none", ignore_index=NO_CLASS)
    if increase is not None:
        cost = cost + F.cross_entropy(logits, increase, reduction="none", ignore_index=NO_CLASS)
    return cost


def logit_gap(logits: Tensor, decrease: Tensor, increase: Tensor | None = None) -> Tensor:
    """By how much the goal is exceeded, negative where it is not reached: that of the wanted class over all others, or
    without one, that of the best other class over `decrease`. (E,)

    Shapes as in `adversarial_cost`.
    """
    wanted = torch.full_like(decrease, NO_CLASS) if increase is None else increase
    chosen = torch.where(wanted == NO_CLASS, decrease, wanted)[:, None]
    gap = logits.gather(1, chosen)[:, 0] - logits.scatter(1, chosen, -torch.inf).amax(1)
    return torch.where(wanted == NO_CLASS, -gap, gap)
