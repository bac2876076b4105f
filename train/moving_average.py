"""The moving average of a network's weights over training steps, which generalises better than the last ones."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


class MovingAverage:
    """A copy of a model whose weights and statistics are the exponential moving average over its steps.

    As `torch.optim.swa_utils.AveragedModel`, which makes a GPU wait at every step, since it counts them on the CPU.
    """

    def __init__(self, model: nn.Module, decay: float):
        self.module = deepcopy(model)
        self._decay = decay
        self._begun = False

    def update(self, model: nn.Module) -> None:
        """Take in what the model has become by a step; the first one counts whole."""
        average = get_ema_multi_avg_fn(self._decay if self._begun else 0.0)
        own, latest = _tensors(self.module), _tensors(model)
        for dtype in {tensor.dtype for tensor in own}:
            kept, new = ([tensor for tensor in tensors if tensor.dtype == dtype] for tensors in (own, latest))
            average(kept, new, None)
        self._begun = True

    def state_dict(self) -> dict[str, Any]:
        return {"module": self.module.state_dict(), "begun": self._begun}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """What `state_dict` gave."""
        self.module.load_state_dict(state["module"])
        self._begun = state["begun"]


def _tensors(model: nn.Module) -> list[Tensor]:
    """Parameters and buffers, without their gradients' history."""
    return [tensor.detach() for tensor in (*model.parameters(), *model.buffers())]
