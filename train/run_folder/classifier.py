"""A run's network, as a file beside what it takes to use it, to begin with, to publish, and as a classifier."""

import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from augment import classifiers
from augment.classifiers import Classifier
from renderer.errors import InputError
from renderer.image import ENCODINGS, LARGEST_SIZE
from train.networks import PYTHON, WIDERESNET, build_network
from train.run_folder.checkpoint import BEST, VERSION, checked, load

PUBLISHED = "model.safetensors"
SHAPE = ("classes", "size", "name", "depth", "width")  # what a network has in common with one that it starts from
SIZE = 32  # of images, for networks of version 1


def load_classifier(name: str, weights: str | Path | None = None) -> Classifier:
    """`run:FOLDER`, or a name that `augment.classifiers.load_classifier` knows, whose errors are raised."""
    return classifiers.load_classifier(name, weights, {**classifiers.SOURCES, "run:": load_run})


def load_weights(network: nn.Module, weights: Mapping[str, Tensor], path: Path) -> None:
    """Fill the network; InputError naming the file where the weights belong to another architecture."""
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        said = textwrap.shorten(str(error), 300)
        raise InputError(
            f"checkpoint {path} is from another architecture ({said}): use the model settings that it was trained with"
        ) from error


def describe(network: nn.Module, classes: Sequence[str], size: int, encoding: str, **shape: Any) -> dict[str, Any]:
    """What is stored with the weights, so that a network can be used without its run's configuration.

    shape: the network's own settings. Its normalization, unless it is its own affair, is a part of it.
    """
    statistics = {name: getattr(network, name).flatten().tolist() for name in ("mean", "std") if hasattr(network, name)}
    return {"version": VERSION, "classes": list(classes), "size": size, "encoding": encoding, **shape, **statistics}


def start_from(network: nn.Module, own: Mapping[str, Any], run: Path) -> None:
    """Give the network the weights and the normalization of another run's, which `load_selected` finds.

    own: what is known of the network (see `describe`). InputError where the other has other classes, another size or
    shape.
    """
    path, state = load_selected(run)
    stored, own = ({"name": WIDERESNET, "size": SIZE, **each} for each in (state["architecture"], own))
    differing = (key for key in SHAPE if stored.get(key, own.get(key)) != own.get(key))
    if key := next(differing, None):
        shown = "other classes" if key == "classes" else f"{key} {stored[key]}, not {own[key]}"
        raise InputError(f"train.init_from={run} was trained with {shown}: give this run the same")
    load_weights(network, state["model"], path)


def load_selected(run: Path) -> tuple[Path, dict[str, Any]]:
    """The file of a run's selected network, best.pt or model.safetensors or such a file itself, and what it holds."""
    path = run if run.is_file() else next((run / name for name in (BEST, PUBLISHED) if (run / name).is_file()), None)
    if path is None:
        raise InputError(
            f"run={run} holds neither {BEST} nor {PUBLISHED}: give a run folder that `python -m train` wrote"
        )
    return path, _load_published(path) if path.suffix == ".safetensors" else load(path)


def load_run(
    run: str | Path, weights: str | Path | None = None, size: int | None = None, model: str | None = None
) -> Classifier:
    """The network that `load_selected` finds for a run's folder, one under pretrained/, or a file of either.

    InputError for weights=, since the run holds its own. size: of images, for a network of version 1, whose file does
    not say; None: 32. InputError where it does say.
    model: the python:package.module:function that makes it, where one does: code runs because the user names it, never
    because a file does.
    """
    if weights is not None:
        raise InputError(
            f"weights={weights} is not for classifier=run:{run}, which has weights of its own: leave it out"
        )
    path, state = load_selected(Path(run))
    shape = dict(state["architecture"])
    stored_size = _pop_size(shape, path)
    if size and stored_size and size != stored_size:
        raise InputError(f"size={size}: {path} was trained on images of {stored_size} pixels per side; leave size out")
    size = stored_size or size or SIZE
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
        network = build_network(classes, size, **shape)
    except (TypeError, ValueError, KeyError, AttributeError, RuntimeError) as error:
        raise InputError(f"checkpoint {path} is from another architecture than can be built: {error}") from error
    load_weights(network, state["model"], path)
    return Classifier(network, size, classes, f"run:{run}")


def _pop_size(shape: dict[str, Any], path: Path) -> int | None:
    """Take from a description all that is not the network's shape; the images' size, where it says one.

    InputError where a file from elsewhere says what cannot be meant.
    """
    shape.pop("version", None)
    size, encoding = shape.pop("size", None), shape.pop("encoding", "linear")
    if size is not None and not (isinstance(size, int) and 1 <= size <= LARGEST_SIZE):
        raise InputError(f"checkpoint {path} says size={size!r}, not pixels per side up to {LARGEST_SIZE}: use another")
    if encoding not in ENCODINGS:
        raise InputError(f"checkpoint {path} says encoding={encoding!r}, not {' or '.join(ENCODINGS)}: use another")
    return size


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
    return checked({"model": weights, "architecture": architecture}, path)
