"""Where to compute."""

import torch

from renderer.errors import InputError


def choose_device(name: str) -> torch.device:
    """auto (CUDA where there is a GPU, else the CPU) or any name torch knows; InputError where it is not available."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.zeros(1, device=name).device
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise InputError(f"device={name} is not available here: use auto or cpu") from error
