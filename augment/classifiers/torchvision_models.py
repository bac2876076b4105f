"""torchvision's ImageNet classifiers, with a local file of weights or torchvision's own download."""

import re
from collections.abc import Mapping
from pathlib import Path

import torchvision
from torch import Tensor, nn
from torchvision.models import WeightsEnum, get_model, get_model_weights, list_models

from augment.classifiers.adapter import Classifier, Normalise, nearest
from augment.classifiers.weights import fill, read_weights
from renderer.errors import InputError

# Set by torchvision's builders where they are given weights: these networks turn ImageNet's normalisation into the
# one that they were trained with.
_TRANSFORMS_INPUT = ("googlenet", "inception_v3")


def load_torchvision(model: str, weights: Path | None) -> Classifier:
    """Any classifier of `torchvision.models`, by its name there.

    Size, mean and std are those of torchvision's weights: the set whose file is named like `weights`, or else the
    default set, which is downloaded (and kept) where `weights` is None. InputError for an unknown model, weights that
    do not fit it, and a failed download.
    """
    name, choices = f"torchvision:{model}", list_models(module=torchvision.models)
    if model not in choices:
        raise InputError(
            f"classifier={name} is no classifier of torchvision: choose one, such as {nearest(model, choices)}"
        )
    published = published_weights(model, weights)
    state = _download(published, name) if weights is None else read_weights(weights)
    network = build_network(model, published)
    fill(network, _current_keys(model, state), weights or published.url, name)
    transforms = published.transforms()
    return Classifier(
        nn.Sequential(Normalise(transforms.mean, transforms.std), network),
        _size(published),
        published.meta["categories"],
        name,
    )


def published_weights(model: str, weights: Path | None) -> WeightsEnum:
    """The set of weights that torchvision publishes under the file's name, or the model's default."""
    published = get_model_weights(model)
    same_name = (each for each in published if weights and each.url.endswith(f"/{weights.name}"))
    return next((each for each in same_name if each.meta["categories"]), published.DEFAULT)


def build_network(model: str, published: WeightsEnum) -> nn.Module:
    """The architecture (no weights yet) that torchvision builds for a published set of weights."""
    if model in _TRANSFORMS_INPUT:
        return get_model(model, transform_input=True, init_weights=False)
    if model.startswith("vit_"):
        return get_model(model, image_size=_size(published))
    return get_model(model)


def _size(published: WeightsEnum) -> int:
    (size,) = published.transforms().crop_size
    return size


def _download(published: WeightsEnum, name: str) -> Mapping[str, Tensor]:
    try:
        return published.get_state_dict(map_location="cpu", check_hash=True, weights_only=True)
    except Exception as error:  # no network, no room, another hash, a damaged copy from before
        reason = " ".join(str(error).split())
        raise InputError(
            f"classifier={name} cannot be had from {published.url} ({reason}): give weights=FILE, a copy of that file"
        ) from error


def _current_keys(model: str, state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """DenseNet's published files are older than the rule that a module's name holds no dot: norm.1 is now norm1."""
    if not model.startswith("densenet"):
        return state
    return {re.sub(r"\.(norm|conv)\.([12])\.", r".\1\2.", key): value for key, value in state.items()}
