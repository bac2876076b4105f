"""The paper's cost (equation 1), which an attack decreases."""

import torch.nn.functional as F
from torch import Tensor


def adversarial_cost(logits: Tensor, decrease: Tensor, increase: Tensor | None = None) -> Tensor:
    """-CE(f, L_d) + CE(f, L_i) per example. (E,)

    logits: (E, classes). decrease: (E,) int64, the classes whose confidence falls. increase: (E,) int64, those whose
    confidence rises; None attacks without a target.
    """
    cost = -F.cross_entropy(logits, decrease, reduction="none")
    if increase is not None:
        cost = cost + F.cross_entropy(logits, increase, reduction="none")
    return cost
