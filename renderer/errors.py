"""The one exception for what a user can mend, and the check that keeps NaN out."""

import torch
from torch import Tensor

LARGEST = 1e30  # beyond it, sums and products of float32 values overflow, and infinity minus infinity is NaN


class InputError(ValueError):
    """Bad input. The message is one sentence that names the file or key at fault and says what to do.

    Entry points print it without a traceback and exit with status 2.
    """


def require_finite(**tensors: Tensor) -> None:
    """InputError naming the first tensor that holds NaN, infinity or magnitudes beyond 1e30."""
    for name, tensor in tensors.items():
        largest = tensor.detach().abs().max() if tensor.numel() else 0.0  # NaN wins any maximum
        if not largest <= min(LARGEST, torch.finfo(tensor.dtype).max):
            raise InputError(f"{name} holds NaN, infinity or magnitudes beyond {LARGEST:g}: give finite values")
