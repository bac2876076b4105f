"""Checkpoints. They are written atomically with a hash of their content, and read without pickle.

A file holds a dictionary of plain values and tensors. best.pt has `model` (the network's state
dict), `architecture` (what rebuilds the network, see `train.networks.describe`) and `epoch`.
last.pt has all of `train.training.loop.Trainer.state_dict`.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, cuda

from renderer.errors import InputError, require_file
from renderer.io.files import atomic_write
from train.networks import VERSION
from train.system.hashing import content_hash

# Files of the last and the second to last checkpoint, and of the network that
# validated best.
LAST = "last.pt"
PREVIOUS = "previous.pt"
BEST = "best.pt"
# Key of the hash in a checkpoint.
HASH = "sha256"


def save(path: Path, state: Mapping[str, Any], previous: Path | None = None) -> None:
    """Write a checkpoint with `atomic_write`.

    Args:
        path: Path of the file.
        state: Tensors and plain values.
        previous: Path to which an existing file is moved. None replaces it.
    """
    content = io.BytesIO()
    torch.save({**state, HASH: content_hash(state)}, content)
    atomic_write(path, content.getbuffer(), durable=True, previous=previous)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint.

    Args:
        path: The file.

    Returns:
        The state that `save` wrote, on the CPU.

    Raises:
        InputError: If the file is missing, damaged or not a checkpoint.
    """
    require_file(path, "give a run folder that holds a checkpoint")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict) or state.pop(HASH, None) != content_hash(state):
            raise ValueError("its content does not match its hash")
    except Exception as error:
        # torch raises errors of many types if a file is damaged or no checkpoint.
        raise InputError(
            f"checkpoint {path} is damaged or not a checkpoint: use another checkpoint of the run",
        ) from error
    return checked(state, path)


def checked(state: dict[str, Any], path: Path) -> dict[str, Any]:
    """Check that a state can be used.

    Args:
        state: The state.
        path: The file that an error names.

    Returns:
        The same state.

    Raises:
        InputError: If it lacks finite weights or an architecture, or comes from a later version.
    """
    try:
        version = state["architecture"].get("version", 1)
        finite = all(value.isfinite().all() for value in state["model"].values())
    except (LookupError, AttributeError) as error:
        raise InputError(
            f"checkpoint {path} has no architecture or weights: use another one",
        ) from error
    if version not in range(VERSION + 1):
        raise InputError(
            f"checkpoint {path} was written by a later version ({version!r}): install that version",
        )
    if not finite:
        raise InputError(f"checkpoint {path} has NaN or infinity in its weights: use another one")
    return state


def exists(folder: Path) -> bool:
    """Return whether a folder holds a checkpoint to resume from."""
    return any((folder / name).exists() for name in (LAST, PREVIOUS))


def load_newest(folder: Path) -> tuple[dict[str, Any], str | None]:
    """Read the newest whole checkpoint of a run.

    Args:
        folder: The folder of the run.

    Returns:
        The state, and the fault of last.pt if it is damaged and previous.pt was
        read. The fault is None if last.pt was read.

    Raises:
        InputError: If there is no whole checkpoint.
    """
    try:
        return load(folder / LAST), None
    except InputError as error:
        if not (folder / PREVIOUS).is_file():
            raise
        return load(folder / PREVIOUS), str(error)


def random_state() -> dict[str, Tensor | list[Tensor]]:
    """Return the states of torch's random generators.

    Returns:
        State of the CPU under "cpu", and a list with the state of each GPU under
        "cuda".
    """
    states = cuda.get_rng_state_all() if cuda.is_available() else []
    return {"cpu": torch.get_rng_state(), "cuda": states}


def restore_random_state(state: Mapping[str, Any]) -> None:
    """Restore random generators, on as many GPUs as both machines have.

    Args:
        state: States under "cpu" and "cuda", as `random_state` returns them.
    """
    torch.set_rng_state(state["cpu"])
    for device, values in zip(range(cuda.device_count()), state["cuda"], strict=False):
        cuda.set_rng_state(values, device)
