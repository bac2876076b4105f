"""Interpolation between the initial and the trained weights of a network.

See Wortsman et al. 2022, "Robust fine-tuning of zero-shot models" (WiSE-FT). The
factor is chosen on images that are kept aside. They need no labels, because
predictions are compared with those of the initial network for the unchanged
images.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from augment.losses import kl_divergence
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
    weights: tuple[float, float] = (1.0, 1.0),
) -> tuple[dict[str, Tensor], float]:
    """Interpolate by the factor with the lowest loss on validation images.

    The loss is the weighted sum of two divergences. The first compares the
    predictions for unchanged images, and the second the predictions for images
    in the light of a projector. Both are divergences from the predictions of
    the initial network for the unchanged images, as in the training.

    Args:
        initial: Network before the training.
        selected: Network of the same architecture. It gets other weights.
        trained: Weights after the training.
        validation: Images that neither network learned from.
        seed: Seed of the light.
        weights: Weights of both parts of the loss: unchanged and relit.

    Returns:
        The weights, on the CPU, and the factor. Among equally good factors,
        the smallest one is chosen.
    """
    begin = {name: value.cpu() for name, value in initial.network.state_dict().items()}
    wanted = predict(initial, validation)
    # Key of the random stream of the light, which is the same for all factors.
    key = (seed, "validation")
    lowest = float("inf")
    best_factor = FACTORS[0]
    for factor in FACTORS:
        selected.network.load_state_dict(mix(begin, trained, factor))
        unchanged = predict(selected, validation)
        relit = predict(selected, validation, *key)
        loss = weights[0] * divergence(unchanged, wanted) + weights[1] * divergence(relit, wanted)
        console.debug(
            "weights %.2f: loss %.4f, agreement %.4f, relit %.4f",
            factor,
            loss,
            agreement(unchanged, wanted),
            agreement(relit, wanted),
        )
        if loss < lowest:
            lowest = loss
            best_factor = factor
    trained_share = 100 * best_factor
    console.info("weights: %.0f%% trained, %.0f%% original", trained_share, 100 - trained_share)
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


def agreement(logits: Tensor, wanted: Tensor) -> float:
    """Return the fraction of images for which two networks predict the same class.

    Args:
        logits: Logits of a network, shape (N, classes).
        wanted: Logits of the other network, shape (N, classes).

    Returns:
        The fraction, in [0, 1].
    """
    return float((logits.argmax(1) == wanted.argmax(1)).double().mean())


def divergence(logits: Tensor, wanted: Tensor) -> float:
    """Return the mean divergence of predictions from those of another network.

    Args:
        logits: Logits of a network, shape (N, classes).
        wanted: Logits of the other network, shape (N, classes).

    Returns:
        Kullback–Leibler divergence, at least 0.
    """
    return float(kl_divergence(logits, wanted).mean())


@torch.no_grad()
def predict(model: MixedPrecision, split: Split, *light_key: int | str) -> Tensor:
    """Compute the logits of a network for images.

    Args:
        model: Network.
        split: Images.
        light_key: Key of the random stream of the light of a projector. The
            images are unchanged if there is none.

    Returns:
        Logits, on the CPU, shape (N, classes).
    """
    device = next(model.parameters()).device
    batches = torch.arange(len(split)).split(BATCH)
    logits = []
    with eval_mode(model):
        shown = progress(split.squares(batches), f"{len(split)} images", len(batches))
        for index, images in enumerate(shown):
            if light_key:
                light_seed = stream_seed(*light_key, index, "relit")
                images = relight_photographs(images, light_seed, slides=images)
            logits.append(model(to_unit(images.to(device))).float().cpu())
    return torch.cat(logits)
