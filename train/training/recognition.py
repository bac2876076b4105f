"""Recognition of the light of an augmentation, for a network that gets only images in it."""

import math
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from augment.network import device_of, eval_mode, evenly_spaced
from augment.switch import statistics
from renderer.errors import InputError
from train import console
from train.data.sets import Split
from train.settings import LOW_LIGHT, RELIGHT, STRIPES
from train.training.averages import predict
from train.training.recipe import called_layers

# Largest number of layers whose outputs tell the light, and of images.
LAYERS, IMAGES = 12, 1000
# Statistics are divided by their standard deviations, or by at least this fraction of the median.
SMALLEST = 1e-3
# Weight of half the squared norm of the weights of standardized statistics.
DECAY = 0.01
# Fraction of the unchanged images for validation that are taken for unchanged ones.
KEPT = 0.99


def recognizing_layers(network: nn.Module, size: int) -> list[str]:
    """Return the names of up to LAYERS layers that have one row for each image, in their order.

    Outputs for parts of an image, such as windows, have several rows for each image, and outputs
    for positions have the same rows for any images.
    """
    found = [dict(called_layers(network, size, count)[0]) for count in (1, 2)]
    names = [name for name in found[0] if [_row_count(each.get(name)) for each in found] == [1, 2]]
    if not names:
        fault = "recognize=true needs layers of torch with a row for each image"
        raise InputError(f"{fault}, which this network lacks: set recognize=false", "recognize")
    return [names[place] for place in evenly_spaced(len(names), LAYERS).tolist()]


def _row_count(output: Any) -> int | None:
    """Return the number of rows of values. None if the output has no such rows."""
    return len(output) if isinstance(output, Tensor) and output.ndim > 1 else None


def fit_recognizer(
    network: nn.Module, train: Split, validation: Split, seed: int, light: str
) -> dict[str, Any]:
    """Fit a `Recognizer` of the light of an augmentation, and return its arguments but the network.

    The light is told from other lights and from unchanged images. The bias permits the fraction
    1 − KEPT of errors on unchanged images for validation.
    """
    device = device_of(network)
    shown, kept_aside = (each[evenly_spaced(len(each), IMAGES)] for each in (train, validation))
    layers = recognizing_layers(network, shown.sample(1).shape[-1])
    measure = partial(statistics, network, layers)
    # The light is shown as often as other lights.
    others = [other for other in (RELIGHT, LOW_LIGHT, STRIPES) if other not in light]
    with eval_mode(network):
        relit = [
            predict(measure, shown, device, seed, index, "recognition", light=kind)
            for index, kind in enumerate([*[light] * len(others), *others])
        ]
        values = torch.cat([*relit, predict(measure, shown, device)]).double()
        is_lit = torch.arange(len(values)) < len(shown) * len(others)
        weights = logistic_weights(values, is_lit)
        scores = predict(measure, kept_aside, device).double() @ weights
    threshold = scores.quantile(KEPT, interpolation="higher").item()
    message = "about %.0f%% of other images are recognized by mistake (threshold from %d images)"
    console.info(message, 100 * expected_errors(len(scores)), len(scores))
    return {"layers": layers, "weights": weights, "bias": -threshold}


def expected_errors(count: int) -> float:
    """Return the expected fraction of unchanged images that are taken for lit ones.

    The threshold is the quantile KEPT of the scores of `count` unchanged images. A further one
    exceeds it with this probability.
    """
    return (count - math.ceil(KEPT * (count - 1))) / (count + 1)


def logistic_weights(
    values: Float[Tensor, "N D"], is_positive: Bool[Tensor, " N"]
) -> Float[Tensor, " D"]:
    """Return the weights of a logistic regression in which both classes count the same."""
    deviations, means = torch.std_mean(values, 0)
    # A value that differs only by rounding would get a huge weight.
    deviations = deviations.clamp(min=SMALLEST * deviations[deviations > 0].median().item())
    standardized = (values - means) / deviations
    wanted = is_positive.to(values)
    counts = torch.where(is_positive, is_positive.sum(), (~is_positive).sum())
    parameters = standardized.new_zeros(values.shape[1] + 1).requires_grad_()
    optimizer = torch.optim.LBFGS([parameters], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        odds = standardized @ parameters[:-1] + parameters[-1]
        errors = F.binary_cross_entropy_with_logits(odds, wanted, 0.5 / counts, reduction="sum")
        total = errors + DECAY / 2 * parameters[:-1].square().sum()
        total.backward()
        return total

    optimizer.step(loss)
    return parameters[:-1].detach() / deviations
