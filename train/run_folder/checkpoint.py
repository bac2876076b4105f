"""Checkpoints: written atomically with a hash of their content, read without pickle, checked against their network."""

import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, cuda, get_rng_state, nn, set_rng_state

from renderer.errors import InputError
from renderer.image import ENCODINGS, LARGEST_SIZE
from train.networks import PYTHON, WIDERESNET, build_network

LAST, PREVIOUS, BEST, PUBLISHED = "last.pt", "previous.pt", "best.pt", "model.safetensors"
HASH = "sha256"
VERSION = 2  # of what is stored as a network's architecture; 1 had neither size nor normalisation nor encoding
SIZE = 32  # of images, for networks of version 1


@dataclass(frozen=True)
class TrainedNetwork:
    """A network in eval mode, with what its file says of it.

    size: pixels per side of the images that it was trained on. encoding: of the renders among them, linear or srgb.
    architecture: all that is stored beside the weights.
    """

    module: nn.Module
    classes: tuple[str, ...]
    size: int
    encoding: str
    architecture: Mapping[str, Any]


def save(path: Path, state: Mapping[str, Any], previous: Path | None = None) -> None:
    """Write tensors and plain values so that the file is, at any moment, either the old one or the new one.

    previous: where the old one is kept. OSError that names the path where the disk does not take it; the old one stays.
    """
    content = io.BytesIO()
    torch.save({**state, HASH: content_hash(state)}, content)
    temporary = path.with_suffix(".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        if previous and path.exists():
            os.replace(path, previous)
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


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
    return _checked(state, path)


def _checked(state: dict[str, Any], path: Path) -> dict[str, Any]:
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


def _sync_folder(folder: Path) -> None:
    """Make the renaming last through a loss of power, where folders can be synchronised."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def load_weights(network: nn.Module, weights: Mapping[str, torch.Tensor], path: Path) -> None:
    """Fill the network; InputError naming the file where the weights belong to another architecture."""
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in weights.items()}
    if expected != found:
        name = next(iter(sorted(set(expected.items()) ^ set(found.items()))))[0]
        raise InputError(
            f"checkpoint {path} is from another architecture: {name} has shape {found.get(name, 'none')} there and "
            f"{expected.get(name, 'none')} here; use the model settings that it was trained with"
        )
    network.load_state_dict(weights)


def describe(network: nn.Module, classes: Sequence[str], size: int, encoding: str, **shape: Any) -> dict[str, Any]:
    """What is stored with the weights, so that a network can be used without its run's configuration.

    shape: the network's own settings. Its normalisation, unless it is its own affair, is a part of it.
    """
    statistics = {name: getattr(network, name).flatten().tolist() for name in ("mean", "std") if hasattr(network, name)}
    return {"version": VERSION, "classes": list(classes), "size": size, "encoding": encoding, **shape, **statistics}


def contradiction(stored: Mapping[str, Any], own: Mapping[str, Any], keys: Sequence[str] | None = None) -> str | None:
    """The first key of two descriptions that both have and in which they differ; of `keys` alone where they are given.

    None where there is none.
    """
    common = [key for key in keys or stored if key in stored and key in own and key != "version"]
    return next((key for key in common if stored[key] != own[key]), None)


def start_from(network: nn.Module, own: Mapping[str, Any], run: Path) -> None:
    """Give the network the weights and the normalisation of another run's, which `load_network` finds.

    own: what is known of the network (see `describe`). InputError where the other has other classes, another size or
    shape.
    """
    path, state = _selected(run)
    stored, own = ({"name": WIDERESNET, "size": SIZE, **each} for each in (state["architecture"], own))
    if key := contradiction(stored, own, ("classes", "size", "name", "depth", "width")):
        shown = "other classes" if key == "classes" else f"{key} {stored[key]}, not {own[key]}"
        raise InputError(f"train.init_from={run} was trained with {shown}: give this run the same")
    load_weights(network, state["model"], path)


def _selected(run: Path) -> tuple[Path, dict[str, Any]]:
    """The file of a run's selected network, and what it holds."""
    path = run if run.is_file() else next((run / name for name in (BEST, PUBLISHED) if (run / name).is_file()), None)
    if path is None:
        raise InputError(
            f"run={run} holds neither {BEST} nor {PUBLISHED}: give a run folder that `python -m train` wrote"
        )
    return path, _load_published(path) if path.suffix == ".safetensors" else load(path)


def load_network(run: Path, size: int | None = None, model: str | None = None) -> TrainedNetwork:
    """The selected network of a run folder (best.pt or model.safetensors) or of such a file.

    size: of images, for a network of version 1, whose file does not say; None: 32. InputError where it does say.
    model: the python:package.module:function that makes it, where one does: code runs because the user names it, never
    because a file does.
    """
    path, state = _selected(run)
    shape = dict(state["architecture"])
    stored_size, encoding = _pop_images(shape, path)
    name = str(shape.get("name", WIDERESNET))
    if name.startswith(PYTHON) and name != model:
        raise InputError(
            f"the network in {path} is made by {name}: give model={name} to run that code, which a file alone must not "
            "do; an attack takes it as classifier=python: with a function that loads its weights"
        )
    try:
        classes = tuple(map(str, shape.pop("classes")))
        if not classes:
            raise ValueError("it has no classes")
        network = build_network(classes, stored_size or size or SIZE, **shape)
    except (TypeError, ValueError, KeyError, AttributeError, RuntimeError) as error:
        raise InputError(f"checkpoint {path} is from another architecture than can be built: {error}") from error
    if size and stored_size and size != stored_size:
        raise InputError(f"size={size}: {path} was trained on images of {stored_size} pixels per side; leave size out")
    load_weights(network, state["model"], path)
    return TrainedNetwork(network.eval(), classes, stored_size or size or SIZE, encoding, state["architecture"])


def _pop_images(shape: dict[str, Any], path: Path) -> tuple[int | None, str]:
    """Take from a description what it says of the images, their size and encoding, and its version.

    InputError where a file from elsewhere says what cannot be meant.
    """
    shape.pop("version", None)
    size = shape.pop("size", None)
    if size is not None and not (isinstance(size, int) and 1 <= size <= LARGEST_SIZE):
        raise InputError(f"checkpoint {path} says size={size!r}, not pixels per side up to {LARGEST_SIZE}: use another")
    encoding = shape.pop("encoding", "linear")
    if encoding not in ENCODINGS:
        raise InputError(f"checkpoint {path} says encoding={encoding!r}, not {' or '.join(ENCODINGS)}: use another")
    return size, encoding


def publish(path: Path, state: Mapping[str, Any]) -> None:
    """Write a checkpoint's network as half-precision safetensors, its architecture in the file's metadata."""
    weights = {
        name: value.half().contiguous() if value.is_floating_point() else value
        for name, value in state["model"].items()
    }
    path.write_bytes(safetensors.torch.save(weights, {"architecture": json.dumps(state["architecture"])}))


def _load_published(path: Path) -> dict[str, Any]:
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        weights = {name: value.float() if value.is_floating_point() else value for name, value in weights.items()}
        architecture = json.loads(metadata["architecture"])
        if not isinstance(architecture, dict):
            raise ValueError("it is no object of keys and values")
    except (SafetensorError, KeyError, ValueError, RecursionError, OSError) as error:
        raise InputError(f"checkpoint {path} is damaged or lacks its architecture; use another one") from error
    return _checked({"model": weights, "architecture": architecture}, path)


def random_state() -> dict[str, Tensor | list[Tensor]]:
    """The CPU's and, where there are any, the GPUs'."""
    return {"cpu": get_rng_state(), "cuda": cuda.get_rng_state_all() if cuda.is_available() else []}


def restore_random_state(state: Mapping[str, Any]) -> None:
    """What `random_state` gave, on as many GPUs as there were and are."""
    set_rng_state(state["cpu"])
    for device, values in zip(range(cuda.device_count()), state["cuda"], strict=False):
        cuda.set_rng_state(values, device)
