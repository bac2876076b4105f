"""Interpolation between the initial and the trained weights of a network.

See Wortsman et al. 2022, "Robust fine-tuning of zero-shot models" (WiSE-FT). The
factor is chosen on images that are kept aside. They need no labels: a
prediction is right if it is that of the initial network for the unchanged
image.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from augment.model_passes import eval_mode
from augment.photographs.projected_light import relight_photographs
from augment.progress import progress
from augment.random_streams import stream_seed
from renderer.image import to_unit
from train import console
from train.data.sets import Split
from train.system.device import MixedPrecision

# Factors to choose from. At 0, the network is the initial one.
FACTORS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Entry of a checkpoint with the factor of its weights.
INTERPOLATION = "interpolation"
# Images per pass.
BATCH = 32


def interpolate(
    initial: MixedPrecision,
    selected: MixedPrecision,
    trained: Mapping[str, Tensor],
    validation: Split,
    seed: int,
) -> tuple[dict[str, Tensor], float]:
    """Interpolate by the factor that validates best on unchanged and relit images.

    Args:
        initial: Network before the training.
        selected: Network of the same architecture. It gets other weights.
        trained: Weights after the training.
        validation: Images that neither network learned from.
        seed: Seed of the light.

    Returns:
        The weights, on the CPU, and the factor. Among equally good factors,
        the smallest one is chosen.
    """
    begin = {name: value.cpu() for name, value in initial.network.state_dict().items()}
    wanted = predict(initial, validation)
    best_score = -1.0
    best_factor = FACTORS[0]
    for factor in FACTORS:
        selected.network.load_state_dict(mix(begin, trained, factor))
        unchanged = agreement(predict(selected, validation), wanted)
        relit_predictions = predict_relit(selected, validation, seed, "validation")
        relit = agreement(relit_predictions, wanted)
        console.debug("weights %.2f: agreement %.4f, relit %.4f", factor, unchanged, relit)
        score = (unchanged + relit) / 2
        if score > best_score:
            best_score = score
            best_factor = factor
    console.info(
        "weights: %.0f%% trained, %.0f%% original", 100 * best_factor, 100 - 100 * best_factor
    )
    return mix(begin, trained, best_factor), best_factor


def mix(
    initial: Mapping[str, Tensor], trained: Mapping[str, Tensor], factor: float
) -> dict[str, Tensor]:
    """Interpolate linearly between the weights of two networks.

    Args:
        initial: Weights at the factor 0.
        trained: Weights at the factor 1.
        factor: Factor, from 0 to 1.

    Returns:
        The weights. Whole numbers, such as counters, are the trained ones.
    """
    mixed = {}
    for name, value in trained.items():
        mixed[name] = value.clone()
        if value.is_floating_point():
            mixed[name] = torch.lerp(initial[name].to(value), value, factor)
    return mixed


def predict(model: MixedPrecision, split: Split) -> Tensor:
    """Return the classes that a network predicts for images.

    Args:
        model: Network.
        split: Images.

    Returns:
        Classes, on the CPU, shape (N,).
    """
    return _predict(model, split, None)


def predict_relit(model: MixedPrecision, split: Split, seed: int, key: str) -> Tensor:
    """Return the classes that a network predicts for images in the light of a projector.

    Args:
        model: Network.
        split: Images.
        seed: Seed of the light.
        key: Key of the random stream, such as "test".

    Returns:
        Classes, on the CPU, shape (N,).
    """
    return _predict(model, split, stream_seed(seed, key, "relit"))


def agreement(predicted: Tensor, wanted: Tensor) -> float:
    """Return the fraction of images for which two predictions are the same class.

    Args:
        predicted: Classes, shape (N,).
        wanted: Other classes, shape (N,).

    Returns:
        The fraction, in [0, 1].
    """
    return float((predicted == wanted).double().mean())


@torch.no_grad()
def _predict(model: MixedPrecision, split: Split, seed: int | None) -> Tensor:
    """Return predictions (N,) for the images of a split, which are relit if there is a seed."""
    device = next(model.parameters()).device
    batches = torch.arange(len(split)).split(BATCH)
    predicted = []
    with eval_mode(model):
        shown = progress(split.squares(batches), f"{len(split)} images", len(batches))
        for index, images in enumerate(shown):
            if seed is not None:
                images = relight_photographs(images, stream_seed(seed, index), slides=images)
            predicted.append(model(to_unit(images.to(device))).argmax(1).cpu())
    return torch.cat(predicted)
