"""The networks that runs have trained: finding, loading, publishing and exporting them."""

import io
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor, nn

from augment.classifiers import SOURCES, Classifier, OperatingPoint, load_classifier
from augment.classifiers.adapter import unwrapped, with_normalized_light
from augment.classifiers.files import is_network_file
from augment.classifiers.plain_networks import Normalization, as_facts, require_no_facts
from augment.settings import NormalizeLight
from renderer.errors import InputError, single_line
from renderer.io.files import atomic_write
from renderer.validation import as_path, require_kind
from train.command_settings import ClassifierSettings
from train.networks import PYTHON, WIDERESNET, build_network
from train.runs.checkpoint import BEST, checked, load
from train.settings import published
from train.system.user_errors import keyed

# The name of a trained network among the sources of classifiers is this, and then a folder.
RUN = "run:"
# The file of a published network, in half precision.
PUBLISHED = "model.safetensors"
# The file of a network that began as a classifier, whose weights have the names of its own file.
WEIGHTS = "weights.pt"
# Facts in the file of a published network besides the weights.
PUBLISHED_FACTS = ("architecture", "settings", "scores", "versions", "operating_point")
# Entries of the description of a network that are not needed to build it.
FACTS = ("version", "encoding", "validation")
# Entry of the description of a network that normalizes the light of images, with the settings.
NORMALIZE_LIGHT = "normalize_light"
# Prefix of the names of the weights of a network that normalizes the light of images.
LIGHT_PREFIX = "network."
# `of_one_architecture` cuts the reason in its error to this many characters.
LONGEST_REASON = 300


def load_network(
    name: str,
    weights: str | Path | None = None,
    classes: Sequence[str] | str | None = None,
    size: int | None = None,
    normalization: Normalization = None,
    normalize_light: NormalizeLight = None,
) -> Classifier:
    """Load a classifier by its name: a trained network, or one that was trained elsewhere.

    Args:
        name: "run:FOLDER" for the network of a run, or a name that `nb.load_classifier`
            takes.
        weights: A local file of weights, if the source brings none.
        classes: Names of the classes, or a file of them, as for `nb.load_classifier`.
        size: Pixels per side of the images, as there.
        normalization: Normalization of the images, as there.
        normalize_light: Whether the light of each image is normalized first, as there.

    Returns:
        The classifier.

    Raises:
        InputError: If there is no such network, or the weights are not for it.
    """
    require_kind("name", name, str, "the name of a classifier, such as 'torchvision:resnet50'")
    folder = _run_of(Path(name))
    if folder is not None:
        raise InputError(f"name={name} belongs to a run: give {RUN}{folder}", "name")
    if name.startswith(RUN):
        require_no_facts(name, as_facts(classes, size, normalization))
        with keyed(run="name"):
            classifier = load_run(name.removeprefix(RUN), weights)
        return classifier.normalizing_light(normalize_light)
    return load_classifier(name, weights, classes, size, normalization, normalize_light)


def _run_of(path: Path) -> Path | None:
    """Find the run that a path belongs to.

    Args:
        path: Any path. The folder of a run has a file best.pt.

    Returns:
        Folder of the run, if the path is this folder or its file weights.pt.
        Otherwise None.
    """
    for folder in (path, path.parent):
        is_named = folder == path or path.name == WEIGHTS
        if is_named and (folder / BEST).is_file():
            return folder
    return None


def load_chosen(settings: ClassifierSettings) -> Classifier:
    """Load the classifier that the settings of a command choose; see `load_network`."""
    return load_network(
        str(settings.classifier),
        settings.weights,
        settings.classes,
        settings.size,
        settings.normalization,
        settings.normalize_light,
    )


def load_run(
    run: str | Path,
    weights: str | Path | None = None,
    model: str | None = None,
) -> Classifier:
    """Load the network that a run selected.

    Args:
        run: The folder of the run, a folder below pretrained/, or a file of either.
        weights: None. A run has its own weights.
        model: "python:package.module:function", if such a function makes the network. Code runs
            because the user names it, and never because a file does.

    Returns:
        The network.

    Raises:
        InputError: If there is no such network, `weights` is given, or `model` is missing.

    Example:
        >>> import norm_balls as nb
        >>> nb.load_run("pretrained/best").size
        32
    """
    if weights is not None:
        raise InputError(
            f"weights={weights} is not for {RUN}{run}, which has its own: leave it out",
            "weights",
        )
    require_kind("model", model, str | None, "python:package.module:function, or None")
    path, state = load_selected(as_path("run", run))
    shape = {key: value for key, value in state["architecture"].items() if key not in FACTS}
    name = str(shape.get("name", WIDERESNET))
    if name.startswith(PYTHON) and name != model:
        raise InputError(
            f"the network in {path} is made by {name}: "
            f"give model={name} to run that code or, "
            f"for an attack, name {PYTHON}MODULE:FUNCTION, a function that loads the weights",
        )
    with of_one_architecture(path):
        size = int(shape.pop("size"))
        classes = tuple(map(str, shape.pop("classes")))
        light = shape.pop(NORMALIZE_LIGHT, None)
        network = with_normalized_light(build_network(classes, size, **shape), light)
        network.load_state_dict(state["model"])
        classifier = Classifier(network, size, classes, f"{RUN}{run}")
        classifier.operating_points = _operating_points(state)
        for point in classifier.operating_points:
            classifier.label(point.label)  # This raises InputError if the class is missing.
        return classifier


def _operating_points(state: Mapping[str, Any]) -> list[OperatingPoint]:
    """Read the operating points that are stored with a network.

    Args:
        state: Content of the file of a network. "operating_point" holds the
            fields of one point, or a list with the fields of several.
    """
    stored = state.get("operating_point", [])
    if not isinstance(stored, list):
        stored = [stored]
    return [OperatingPoint(**facts) for facts in stored]


@contextmanager
def of_one_architecture(path: Path) -> Iterator[None]:
    """Raise InputError if a file does not fit the network that is built or filled inside.

    Args:
        path: The file that the error names.
    """
    try:
        yield
    except (TypeError, ValueError, LookupError, AttributeError, RuntimeError) as error:
        reason = textwrap.shorten(single_line(error), LONGEST_REASON)
        raise InputError(
            f"checkpoint {path} is from another architecture ({reason}): "
            "use the model settings of its training",
        ) from error


def is_classifier(name: str) -> bool:
    """Return whether `train.init_from` names a classifier, rather than a run or a file.

    Args:
        name: The name.

    Returns:
        Whether it is the name of a classifier that was trained elsewhere.
    """
    source, colon, _ = name.partition(":")
    return source + colon in SOURCES or is_network_file(name)


def selected_file(run: Path) -> Path | None:
    """Find the file of a run's selected network.

    Args:
        run: The folder of the run, a folder below pretrained/, or a file of either.

    Returns:
        best.pt, model.safetensors or the file itself. None if there is no such file.
    """
    found = published(run)
    for file in (found, found / BEST, found / PUBLISHED):
        if file.is_file():
            return file
    return None


def is_state_dict(path: Path) -> bool:
    """Return whether a file has weights alone, as `torch.save(network.state_dict())` writes it."""
    if not path.is_file() or path.suffix == ".safetensors":
        return False
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # torch raises many kinds of errors for files of other programs.
        return False
    return isinstance(content, dict) and all(
        isinstance(value, Tensor) for value in content.values()
    )


def load_selected(run: Path) -> tuple[Path, dict[str, Any]]:
    """Read a run's selected network.

    Args:
        run: The folder of the run, a folder below pretrained/, or a file of either.

    Returns:
        The file and its content.

    Raises:
        InputError: If there is no such file, or it is damaged.
    """
    path = selected_file(run)
    if path is None:
        raise InputError(
            f"run={run} holds neither {BEST} nor {PUBLISHED}: give a folder that pnb-train wrote",
            "run",
        )
    if path.suffix == ".safetensors":
        return path, _load_published(path)
    return path, load(path)


def plain_weights(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights of a network by their names without normalized light.

    Args:
        state: Content of a file, as `load_selected` returns it.

    Returns:
        State dict of the network behind the normalization of light.
    """
    weights: dict[str, Tensor] = state["model"]
    if NORMALIZE_LIGHT not in state["architecture"]:
        return weights
    return {name.removeprefix(LIGHT_PREFIX): value for name, value in weights.items()}


def publish(path: Path, state: Mapping[str, Any]) -> None:
    """Write the network of a checkpoint in half precision.

    Args:
        path: File in the format safetensors. Its metadata hold the entries in
            PUBLISHED_FACTS as JSON.
        state: Checkpoint, with the weights under "model".
    """
    metadata = {}
    for key in PUBLISHED_FACTS:
        if key in state:
            metadata[key] = json.dumps(state[key], ensure_ascii=False)
    weights = {}
    for name, value in state["model"].items():
        weights[name] = value.half().contiguous() if value.is_floating_point() else value
    atomic_write(path, safetensors.torch.save(weights, metadata), durable=True)


def _load_published(path: Path) -> dict[str, Any]:
    """Read a file that `publish` wrote.

    Args:
        path: The file.

    Returns:
        Weights in single precision under "model", and the facts in
        PUBLISHED_FACTS that the file has.

    Raises:
        InputError: If the file is damaged.
    """
    weights: dict[str, Tensor] = {}
    try:
        with safe_open(path, "pt") as file:
            facts = {name: json.loads(text) for name, text in file.metadata().items()}
            for name in file.keys():  # noqa: SIM118 (The file is no mapping.)
                value = file.get_tensor(name)
                weights[name] = value.float() if value.is_floating_point() else value
    except Exception as error:  # safetensors and JSON raise many kinds for a foreign file.
        raise InputError(
            f"checkpoint {path} is damaged or lacks its architecture; use another one",
        ) from error
    return checked({**facts, "model": weights}, path)


def export(path: Path, network: nn.Module) -> None:
    """Write the weights of a network that began as a classifier.

    Args:
        path: The file, for `torch.load`. Its weights have the names of the classifier's own file.
        network: The network.
    """
    state = unwrapped(network).state_dict()
    content = io.BytesIO()
    torch.save({name: value.cpu() for name, value in state.items()}, content)
    atomic_write(path, content.getbuffer(), durable=True)
