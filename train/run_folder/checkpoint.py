"""Checkpoints: written atomically with a hash of their content, read without pickle."""

import hashlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, cuda, get_rng_state, set_rng_state

from renderer.errors import InputError
from train.run_folder.files import write_whole

LAST, PREVIOUS, BEST = "last.pt", "previous.pt", "best.pt"
HASH = "sha256"
VERSION = 2  # of what is stored as a network's architecture; 1 had neither size nor normalization nor encoding


def save(path: Path, state: Mapping[str, Any], previous: Path | None = None) -> None:
    """Write tensors and plain values as `write_whole` does."""
    content = io.BytesIO()
    torch.save({**state, HASH: content_hash(state)}, content)
    write_whole(path, content.getbuffer(), previous)


def load(path: Path) -> dict[str, Any]:
    """What `save` wrote, on the CPU; InputError for a file that is not there, not a checkpoint or not as written."""
    if not path.is_file():
        raise InputError(f"checkpoint {path} does not exist: give a run folder that holds one")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        whole = isinstance(state, dict) and state.pop(HASH, None) == content_hash(state)
    except Exception as error:  # torch raises many kinds for a damaged or foreign file
        raise InputError(f"checkpoint {path} is damaged or no checkpoint; use another one of the run") from error
    if not isinstance(state, dict) or "model" not in state or not isinstance(state.get("architecture"), dict):
        raise InputError(f"checkpoint {path} lacks its model or architecture: give one that `python -m train` wrote")
    if not whole:
        raise InputError(f"checkpoint {path} is damaged: its content is not what its hash says; use another one")
    return checked(state, path)


def checked(state: dict[str, Any], path: Path) -> dict[str, Any]:
    """The state; InputError for what anyone may have written, with a right hash: weights that are none, or of later."""
    weights, version = state["model"], state["architecture"].get("version", 1)
    if not isinstance(version, int) or version > VERSION:
        raise InputError(f"checkpoint {path} was written by a later version ({version!r}): install that one")
    if not isinstance(weights, Mapping) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise InputError(f"checkpoint {path} holds other things than weights under model: use another one")
    if not_finite := [name for name, value in weights.items() if not value.isfinite().all()]:
        raise InputError(f"checkpoint {path} has NaN or infinity in {not_finite[0]}: use another one")
    return state


def exists(folder: Path) -> bool:
    """Whether there is a run to go on with."""
    return any((folder / name).exists() for name in (LAST, PREVIOUS))


def load_newest(folder: Path) -> tuple[dict[str, Any], str | None]:
    """The run's newest checkpoint that is whole, and what was wrong with a newer one; InputError where none is."""
    try:
        return load(folder / LAST), None
    except InputError as error:
        if not (folder / PREVIOUS).is_file():
            raise
        return load(folder / PREVIOUS), str(error)


def content_hash(state: Any) -> str:
    """SHA-256 over keys, types, shapes and values of nested mappings and sequences of tensors and plain values."""
    digest = hashlib.sha256()
    for part in _parts(state):
        digest.update(part)
    return digest.hexdigest()


def _parts(value: Any) -> Iterator[bytes | memoryview]:
    if isinstance(value, Tensor):
        plain = value.detach().cpu().contiguous()
        yield f"{plain.dtype}{tuple(plain.shape)}".encode()
        yield memoryview(plain.flatten().view(torch.uint8).numpy().data)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield f"{key!r}:".encode()
            yield from _parts(item)
    elif isinstance(value, list | tuple):
        yield f"[{len(value)}]".encode()
        for item in value:
            yield from _parts(item)
    else:
        yield f"{value!r};".encode()


def random_state() -> dict[str, Tensor | list[Tensor]]:
    """The CPU's and, where there are any, the GPUs'."""
    return {"cpu": get_rng_state(), "cuda": cuda.get_rng_state_all() if cuda.is_available() else []}


def restore_random_state(state: Mapping[str, Any]) -> None:
    """What `random_state` gave, on as many GPUs as there were and are."""
    set_rng_state(state["cpu"])
    for device, values in zip(range(cuda.device_count()), state["cuda"], strict=False):
        cuda.set_rng_state(values, device)
