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
from train.data.cache import content_hash
from train.networks import VERSION
from train.run_folder import LAST, PREVIOUS

# Key in a checkpoint. Its value is the hash of the other entries.
HASH = "sha256"


def save(path: Path, state: Mapping[str, Any], previous: Path | None = None) -> None:
    """Write a checkpoint with the hash of its content. The file is never half written.

    An existing file is moved to `previous`.
    """
    content = io.BytesIO()
    torch.save({**state, HASH: content_hash(state)}, content)
    atomic_write(path, content.getbuffer(), durable=True, previous=previous)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint that `save` wrote, and check its hash."""
    require_file(path, "give a run folder that holds a checkpoint")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise ValueError("it is not a dictionary")
        stored_hash = state.pop(HASH, None)
        if stored_hash != content_hash(state):
            raise ValueError("its content does not match its hash")
    except Exception as error:
        # `torch.load` raises errors of many types for a damaged file.
        raise InputError(
            f"checkpoint {path} is damaged or not a checkpoint: use another checkpoint of the run",
        ) from error
    return checked(state, path)


def checked(state: dict[str, Any], path: Path) -> dict[str, Any]:
    """Check that the content of a checkpoint has an architecture and finite weights.

    The content of a later version of the library raises InputError, too.
    """
    try:
        version = state["architecture"].get("version", 1)
        is_finite = all(value.isfinite().all() for value in state["model"].values())
    except (LookupError, AttributeError) as error:
        raise InputError(
            f"checkpoint {path} has no architecture or weights: use another checkpoint",
        ) from error
    if version not in range(VERSION + 1):
        raise InputError(
            f"checkpoint {path} has format version {version!r}, and this library knows versions "
            f"up to {VERSION}: install the later version of the library that wrote it",
        )
    if not is_finite:
        raise InputError(
            f"checkpoint {path} has NaN or infinity in its weights: use another checkpoint"
        )
    return state


def exists(folder: Path) -> bool:
    """Return whether the folder of a run holds a checkpoint from which the run can continue."""
    return any((folder / name).exists() for name in (LAST, PREVIOUS))


def load_newest(folder: Path) -> tuple[dict[str, Any], str | None]:
    """Read the newest undamaged checkpoint of a run: last.pt, or else previous.pt.

    The second value says what is wrong with last.pt, or is None.
    """
    try:
        return load(folder / LAST), None
    except InputError as error:
        if not (folder / PREVIOUS).is_file():
            raise
        return load(folder / PREVIOUS), str(error)


def random_state() -> dict[str, Tensor | list[Tensor]]:
    """Return the states of the random generators of torch. "cuda" has one state for each GPU."""
    states = cuda.get_rng_state_all() if cuda.is_available() else []
    return {"cpu": torch.get_rng_state(), "cuda": states}


def restore_random_state(state: Mapping[str, Any]) -> None:
    """Set the random generators of torch to states that `random_state` returned.

    Surplus states or GPUs are ignored.
    """
    torch.set_rng_state(state["cpu"])
    for device, values in zip(range(cuda.device_count()), state["cuda"], strict=False):
        cuda.set_rng_state(values, device)
