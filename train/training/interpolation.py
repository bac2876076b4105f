"""Interpolation between the weights of a network before and after the training.

See Wortsman et al. 2022, "Robust fine-tuning of zero-shot models" (WiSE-FT). The
factor is chosen on validation images. They need no labels, because predictions
are compared with those of the network before the training.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from augment.losses import kl_divergence
from augment.network import compute_outputs
from augment.progress import progress
from augment.projected_light import relight_photographs
from augment.random_streams import stream_seed
from train import console
from train.data.sets import Split
from train.device import MixedPrecision

# Factors of the interpolation that are tried: 0 gives the weights before the training, and
# 1 the weights after it.
FACTORS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Entry of a checkpoint with interpolated weights. Its value is the factor.
INTERPOLATION = "interpolation"
# Number of images in a pass through a network.
BATCH = 32


def interpolate(
    initial: MixedPrecision,
    selected: MixedPrecision,
    trained: Mapping[str, Tensor],
    validation: Split,
    seed: int,
    weights: tuple[float, float] = (1.0, 1.0),
) -> tuple[dict[str, Tensor], float]:
    """Interpolate between two sets of weights, by the factor with the lowest loss.

    The loss is measured on validation images. It is a weighted sum of two
    divergences from the predictions of the initial network for these images:
    that of the predictions of the interpolated network for the same images, and
    that of its predictions for the images in the light of a projector. `weights` belong to the
    unchanged and to the relit images. Return the interpolated weights on the CPU, and the factor,
    which is the smallest of equally good ones.
    """
    device = next(initial.parameters()).device
    initial_weights = {name: value.cpu() for name, value in initial.network.state_dict().items()}
    targets = predict(initial, validation, device)
    # Key of the random stream of the light. All factors are tried in the same light.
    light_key = (seed, "validation")
    lowest_loss = float("inf")
    best_factor = FACTORS[0]
    for factor in FACTORS:
        selected.network.load_state_dict(mix(initial_weights, trained, factor))
        unchanged = predict(selected, validation, device)
        relit = predict(selected, validation, device, *light_key)
        loss_unchanged = weights[0] * divergence(unchanged, targets)
        loss = loss_unchanged + weights[1] * divergence(relit, targets)
        console.debug(
            "weights %.2f: loss %.4f, agreement %.4f, relit %.4f",
            factor,
            loss,
            agreement(unchanged, targets),
            agreement(relit, targets),
        )
        if loss < lowest_loss:
            lowest_loss = loss
            best_factor = factor
    percentage = 100 * best_factor
    console.info("weights: %.0f%% trained, %.0f%% original", percentage, 100 - percentage)
    return mix(initial_weights, trained, best_factor), best_factor


def mix(
    initial: Mapping[str, Tensor], trained: Mapping[str, Tensor], factor: float
) -> dict[str, Tensor]:
    """Interpolate linearly between the weights of two networks.

    The factor 0 gives `initial`. Integers, such as counters, are those of `trained`.
    """
    mixed = {}
    for name, value in trained.items():
        mixed[name] = value.clone()
        if value.is_floating_point():
            mixed[name] = torch.lerp(initial[name].to(value), value, factor)
    return mixed


def agreement(logits: Float[Tensor, "N classes"], targets: Float[Tensor, "N classes"]) -> float:
    """Return the fraction of images for which two networks predict the same class."""
    return float((logits.argmax(1) == targets.argmax(1)).double().mean())


def divergence(logits: Float[Tensor, "N classes"], targets: Float[Tensor, "N classes"]) -> float:
    """Return the mean Kullback-Leibler divergence of predictions from those of another network."""
    return float(kl_divergence(logits, targets).mean())


def predict(
    model: Callable[[Tensor], Tensor], split: Split, device: torch.device, *light_key: int | str
) -> Float[Tensor, "N classes"]:
    """Compute the logits of a network for images, as they are or in the light of a projector.

    Without a key for the random stream of the light, there is no projector. The logits are on the
    CPU.
    """
    batches = torch.arange(len(split)).split(BATCH)
    shown = progress(split.squares(batches), f"{len(split)} images", len(batches))
    if light_key:
        shown = (
            relight_photographs(images, stream_seed(*light_key, index, "relit"), slides=images)
            for index, images in enumerate(shown)
        )
    return compute_outputs(model, shown, BATCH, device).cpu()
