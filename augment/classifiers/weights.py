"""Files of weights: read without running code from them, and checked against the network that they are to fill."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from renderer.errors import InputError


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """The state dict that `torch.save` wrote, on the CPU; InputError for a file that is missing or holds none."""
    if not path.is_file():
        raise InputError(f"weights={path} does not exist: give the path of a file of weights")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged or foreign file
        raise InputError(
            f"weights={path} is damaged or no file of weights: save a state dict with torch.save"
        ) from error
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        raise InputError(f"weights={path} holds other things than weights: save the network's state_dict() alone")
    return state


def fill(network: nn.Module, state: Mapping[str, Tensor], source: str | Path, name: str) -> None:
    """Load weights into a network; InputError naming their source where they do not fit or are not finite."""
    try:
        network.load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        difference = _first_difference(network, state) or str(error).splitlines()[0]
        raise InputError(f"weights={source} are not of classifier={name}: {difference}; give that network's") from error
    if bad := next((key for key, value in network.state_dict().items() if not value.isfinite().all()), None):
        raise InputError(f"weights={source}: {bad} holds NaN or infinity, give weights that are finite")


def _first_difference(network: nn.Module, state: Mapping[str, Tensor]) -> str | None:
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in state.items()}
    for key in [*expected, *found]:
        if expected.get(key) != found.get(key) and not key.endswith("num_batches_tracked"):  # old files lack these
            return f"{key} has shape {found.get(key, 'none')} there and {expected.get(key, 'none')} in the network"
    return None
