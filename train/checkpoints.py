"""Files of networks: checkpoints, the network that a run selected, published and exported ones.

Checkpoints are written atomically, and read without pickle. A checkpoint holds a dictionary of
plain values and tensors. best.pt has `model` (the network's state
dict), `architecture` (what rebuilds the network, see `train.networks.describe`) and `epoch`.
last.pt has all of `train.training.loop.Trainer.state_dict`.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor

from augment.classifier import Classifier, OperatingPoint, TaskNetwork
from augment.exposure import DIM, with_normalized_light
from augment.files import NetworkFacts, is_network_file, load_weights, require_no_facts
from augment.network import FROM_FILE, Inputs, say_inputs, say_once
from augment.settings import PYTHON, split_function
from augment.sources import SOURCES, import_function, load_classifier
from augment.switch import LIT_NAME, SWITCHES, Recognizer
from augment.tasks.detection import Detection
from renderer import errors
from renderer.errors import InputError, as_path, explained, keyed, require_kind
from renderer.io.files import atomic_write
from train.networks import DETECTOR, VERSION, WIDERESNET, build_network
from train.run_folder import BEST, LAST, PREVIOUS, PUBLISHED, WEIGHTS
from train.settings import TaskSettings, published_folder

# A name of a classifier that begins with this text names the folder of a training run.
RUN = "run:"
# Entry in best.pt of a run with `train.recognize`: what `Recognizer` needs beside the network.
RECOGNIZER = "recognizer"
# Entries in the file of a published network, in addition to the weights.
PUBLISHED_FACTS = ("architecture", "settings", "scores", "versions", "operating_point", RECOGNIZER)
# Entries in the description of a network that are no arguments of `build_network`.
FACTS = ("version", "encoding", "validation", "assumed")
# Entry in the description of a network that lists which facts about its images were assumed: fields
# of `Inputs`.
ASSUMED = "assumed"
# Entry in the description of a network that normalizes the light of images, with its settings.
NORMALIZE_LIGHT = "normalize_light"


def save(path: Path, state: Mapping[str, Any], previous: Path | None = None) -> None:
    """Write a checkpoint, so that the file is never half written.

    An existing file is moved to `previous`.
    """
    content = io.BytesIO()
    torch.save(state, content)
    atomic_write(path, content.getbuffer(), durable=True, previous=previous)


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint that `save` wrote. It is a zip file, whose checksums are compared."""
    errors.require_file(path, "give a run folder that holds a checkpoint")
    with _refused_if_damaged(path), ZipFile(path) as archive:
        if archive.testzip():
            raise ValueError("its content does not match its checksums")
        return _checked(torch.load(path, map_location="cpu", weights_only=True))


def _refused_if_damaged(path: Path) -> AbstractContextManager[None]:
    """Turn any error of a block that reads a checkpoint into an InputError."""
    return explained(f"checkpoint {path} is damaged or not a checkpoint", "use another one")


def checks_architecture(path: Path) -> AbstractContextManager[None]:
    """Raise InputError if the block cannot load weights into a network of another architecture."""
    name = f"checkpoint {path}"
    return errors.reading(name, "is from another architecture", "use the model settings of its run")


def _checked(state: dict[str, Any]) -> dict[str, Any]:
    """Check that a checkpoint has finite weights, and is not of a later version of the library."""
    version = state["architecture"].get("version", 1)
    if version not in range(VERSION + 1):
        raise ValueError(f"a later version of this library wrote it, with the format {version!r}")
    if not all(value.isfinite().all() for value in state["model"].values()):
        raise ValueError("its weights have NaN or infinity")
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


def load_network(
    name: str, weights: str | Path | None = None, *, trust_code: bool = False, **facts: Any
) -> Any:
    """Load a classifier by its name: the network of a training run, or any other classifier.

    The folder of a run or of a published network stands for "run:FOLDER".

    The arguments other than `name` are those of `nb.load_classifier`. The network of a run has
    its own weights and its own `facts`, such as classes and size, so these must then be None.
    """
    if name.startswith(SWITCHES):
        plain, other = split_switch(name)
        network = load_network(plain, weights, trust_code=trust_code, **facts)
        # A run has its own weights and facts.
        options: dict[str, Any] = {} if other.startswith(RUN) else {"weights": weights, **facts}
        second = load_network(other, trust_code=trust_code, **options)
        if name.startswith(LIT_NAME):
            say_once(f"{other} gets the images whose light it recognizes as that of its training")
            return network.with_lit(second)
        say_once(f"{other} gets the images whose 98th percentile of linear values is below {DIM}")
        return network.with_dim(second)
    path = Path(name)
    # weights.pt alone is no network. It lies in the folder of its run.
    folder = path.parent if path.name == WEIGHTS else path
    if name and ((folder / BEST).is_file() or (published_folder(folder) / PUBLISHED).is_file()):
        name = f"{RUN}{folder}"
    if not name.startswith(RUN):
        return load_classifier(name, weights, trust_code=trust_code, **facts)
    require_no_facts(name, NetworkFacts(**facts))
    # Error messages about the argument `run` begin with `name` instead, the argument of
    # this function.
    with keyed(run="name"):
        return load_run(name.removeprefix(RUN), weights, trust_code=trust_code)


def split_switch(name: str) -> tuple[str, str]:
    """Split dim:NETWORK+OTHER_NETWORK, or lit:, into the names of both networks."""
    prefix, _, names = name.partition(":")
    plain, plus, other = names.rpartition("+")
    if f"+{RUN}" in names and not is_classifier(other):
        # A folder that a sweep has named may have a "+" in its name.
        plain, _, folder_name = names.rpartition(f"+{RUN}")
        other = RUN + folder_name
    if not plus:
        reason = f"name={name} names one network: give {prefix}:NETWORK+OTHER_NETWORK"
        raise InputError(reason, "name")
    return plain, other


def load_chosen(settings: TaskSettings) -> Any:
    """Load the network that the settings of a command choose, with its task."""
    names = ("weights", "classes", "size", "normalization", "prompt")
    given = {name: getattr(settings, name) for name in names}
    task = None
    if settings.decode is not None:
        advice = "give package.module:function, and start the command in the folder of the module"
        # The user's code may raise any exception, and even end the program.
        kinds = (Exception, SystemExit)
        with explained(f"decode={settings.decode} cannot be imported", advice, "decode", *kinds):
            task = Detection(decode=import_function(settings.decode))
    # Error messages about the arguments `name` and `task` begin with these settings instead.
    with keyed(name="network", task="decode"):
        network = load_network(str(settings.network), trust_code=settings.trust, task=task, **given)
        network = network.normalizing_light(settings.normalize_light)
    return with_task(network, settings)


def with_task(network: TaskNetwork, settings: TaskSettings) -> TaskNetwork:
    """Return a network with the settings of its task that are given."""
    own: Any = network.task
    if settings.task not in (None, own.name):
        fault = f"task={settings.task}, but {network.title} returns {own.returns}"
        raise InputError(f"{fault}: leave the task out", "task")
    # None stands for a setting that the user leaves as it is.
    values = {name: getattr(settings, name, None) for name in ("threshold", "iou", "goal")}
    given = {name: value for name, value in values.items() if value is not None}
    for name, value in given.items():
        if not hasattr(own, name):
            raise InputError(f"{name}={value} is no setting of {own.name}: leave it out", name)
    if not given:
        return network
    changed = network.with_task(replace(own, **given))
    say_once(f"network {network.name}: its task is {changed.task}")
    return changed


@torch.inference_mode(False)  # Attacks need autograd.
def load_run(
    run: str | Path,
    weights: str | Path | None = None,
    model: str | None = None,
    trust_code: bool = False,
) -> Classifier:
    """Load the network that a training run selected, or a published network.

    A run of `harden` on a plain network in memory cannot be loaded, because its file has the
    weights, but not the code. Keep the network that `harden` returns, and save its `state_dict()`.

    Args:
        run: Folder of the run, folder below pretrained/, or the file of the network in it.
        weights: Must be None, because a run has its own weights.
        model: "python:package.module:function" if this function of the user built the network.
            The file of the network names the function, too, but code from a file is never run
            unless the user names or trusts it. None for any other network.
        trust_code: Whether to trust code that the file names: such a function, or a file of
            TorchScript or `torch.export` that the run hardened, which is then loaded again.

    Returns:
        The network.

    Raises:
        InputError: If there is no such network, if `weights` is not None, if `model` or
            `trust_code` is missing, or if `model` is another function.

    Example:
        >>> import norm_balls as nb
        >>> nb.load_run("pretrained/best").size
        32
    """
    if weights is not None:
        raise InputError(f"weights={weights}, but a run has its own: leave it out", "weights")
    require_kind("model", model, str | None, "python:package.module:function, or None")
    path, state = load_selected(as_path("run", run))
    # Arguments of `build_network`, and entries for the wrapper around the network.
    shape = {key: value for key, value in state["architecture"].items() if key not in FACTS}
    name = str(shape.get("name", WIDERESNET))
    is_named = model is not None and split_function(model) == split_function(name)
    if name.startswith(PYTHON) and not is_named and not trust_code:
        advice = "set trust=true (trust_code=True in Python) to run that code"
        raise InputError(f"{path} is built by {name}: {advice}")
    if model is not None and not is_named:
        raise InputError(f"{path} is built by {name}, not by {model}: leave {model} out")
    with checks_architecture(path):
        size = int(shape.pop("size"))
        classes = tuple(map(str, shape.pop("classes")))
        light = shape.pop(NORMALIZE_LIGHT, None)
        built = build_network(classes, size, trust_code=trust_code, **shape)
        network = with_normalized_light(built, light)
        load_weights(network, state["model"])
        facts = network, size, classes, f"{RUN}{run}"
        loaded: Any
        if name == DETECTOR:
            loaded = TaskNetwork(*facts, task=Detection())
        else:
            loaded = Classifier(*facts)
            points = state.get("operating_point", [])
            loaded.operating_points = [OperatingPoint(**values) for values in points]
        loaded.inputs = stated_inputs(state["architecture"])
        if RECOGNIZER in state:
            loaded.recognizer = Recognizer(network, **state[RECOGNIZER])
        say_inputs(loaded.name, network, size, loaded.inputs)
        return loaded


def stated_inputs(architecture: Mapping[str, Any]) -> Inputs:
    """Return who states the facts about the images of a network, by its description."""
    given = architecture.get(ASSUMED, ())
    assumed: dict[str, Any] = {name: None for name in vars(FROM_FILE) if name in given}
    return replace(FROM_FILE, **assumed)


def is_classifier(name: str) -> bool:
    """Return whether a name stands for a classifier that no training run has made."""
    source, colon, _ = name.partition(":")
    return source + colon in SOURCES or is_network_file(name)


def selected_file(run: Path) -> Path | None:
    """Find the file of the network that a training run selected, or of a published network.

    None if there is none. `run` can also be the file itself, or a folder below pretrained/.
    """
    found = published_folder(run)
    return next(filter(Path.is_file, (found, found / BEST, found / PUBLISHED)), None)


def lacks_architecture(path: Path) -> bool:
    """Return whether a file has weights without a description of their network.

    `torch.save(network.state_dict(), path)` writes such a file.
    """
    with suppress(Exception):  # `torch.load` raises errors of many types for other files.
        return "architecture" not in torch.load(path, map_location="cpu", weights_only=True)
    return False


def load_selected(run: Path) -> tuple[Path, dict[str, Any]]:
    """Read the file of the network that a training run selected, or of a published network."""
    path = selected_file(run)
    if path is None:
        raise InputError(f"run={run} has no {BEST} or {PUBLISHED}: give another folder", "run")
    if path.suffix == ".safetensors":
        return path, _load_published(path)
    return path, load(path)


def plain_weights(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights in the file of a network, without a wrapper that normalizes light."""
    weights: dict[str, Tensor] = state["model"]
    if NORMALIZE_LIGHT not in state["architecture"]:
        return weights
    # The wrapper keeps the network as its attribute `network`.
    return {name.removeprefix("network."): value for name, value in weights.items()}


def as_published(value: Tensor) -> Tensor:
    """Convert a weight to half precision, unless it is too large for that."""
    half = value.half()
    has_range = value.is_floating_point() and half.isfinite().all()
    return (half if has_range else value).contiguous()


def write_published(path: Path, state: Mapping[str, Any]) -> None:
    """Write the network of a checkpoint in half precision, as a file for other users.

    The format is safetensors, with the entries PUBLISHED_FACTS as JSON in its metadata.
    """
    # The weights of a recognizer are a tensor.
    as_json = partial(json.dumps, ensure_ascii=False, default=Tensor.tolist)
    metadata = {key: as_json(state[key]) for key in PUBLISHED_FACTS if key in state}
    weights = {name: as_published(value) for name, value in state["model"].items()}
    atomic_write(path, safetensors.torch.save(weights, metadata), durable=True)


def _load_published(path: Path) -> dict[str, Any]:
    """Read a file of `write_published`. The weights, in single precision, are in "model"."""
    weights: dict[str, Tensor] = {}
    with _refused_if_damaged(path), safe_open(path, "pt") as file:
        facts = {name: json.loads(text) for name, text in file.metadata().items()}
        for name in file.keys():  # noqa: SIM118 (The file is no mapping.)
            value = file.get_tensor(name)
            weights[name] = value.float() if value.is_floating_point() else value
        if isinstance(points := facts.get("operating_point"), dict):
            # Earlier versions stored a single operating point instead of a list.
            facts["operating_point"] = [points]
        return _checked({**facts, "model": weights})


def hash_weights(state: Mapping[str, Any]) -> str:
    """Compute the SHA-256 of the weights of a network, which need not come from an input file."""
    digest = hashlib.sha256()
    for tensor in (value for value in state.values() if isinstance(value, Tensor)):
        # A copy, because the strides of tensors that were expanded do not permit the view.
        copy = tensor.detach().cpu().flatten().clone(memory_format=torch.contiguous_format)
        digest.update(copy.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
