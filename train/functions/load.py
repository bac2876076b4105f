"""Load a network that is published with the library, with its results."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from augment.network import Classifier
from renderer.errors import InputError
from renderer.validation import require_kind
from train.results.metrics import METRICS, Metrics
from train.results.tables import Estimate
from train.run_folder import PUBLISHED
from train.saved_networks import load_run, load_selected
from train.settings import published

# Folder of the published networks, in the installation or in a clone.
PRETRAINED = Path("pretrained")
# Name of the score "accuracy on the test images of CIFAR-100".
ACCURACY = "test/accuracy"


class PublishedNetwork(Classifier):
    """A network that is published with the library, with its results.

    Attributes:
        results: Metrics with 95% intervals by name. "test/accuracy" is the
            accuracy on the test images of CIFAR-100. Metrics on photographs are
            "photographs/recall", "photographs/false_positive_rate",
            "photographs/auc" and others.
    """

    results: Mapping[str, Estimate]


def load(name: str) -> PublishedNetwork:
    """Load a network that is published with the library, with its results.

    Args:
        name: "best", "adversarial", "random" or "none". The file
            pretrained/README.md describes these networks.

    Returns:
        Classifier of images of 32 pixels per side. Its attribute `results` has
        its metrics.

    Raises:
        InputError: If there is no published network of this name.

    Example:
        >>> import norm_balls as nb
        >>> network = nb.load("best")
        >>> network.size, len(network.classes)
        (32, 100)
        >>> round(network.results["photographs/auc"].value, 3)
        0.966
    """
    require_kind("name", name, str, "the name of a published network, such as 'best'")
    names = published_names()
    if name not in names:
        known = ", ".join(names)
        raise InputError(f"name={name!r} is no published network: choose one of {known}")
    folder = published(PRETRAINED / name)
    loaded = load_run(folder)
    _, state = load_selected(folder)
    network = PublishedNetwork(loaded.function, loaded.size, loaded.classes, name)
    network.operating_points = loaded.operating_points
    network.results = _read_results(state["scores"])
    return network


def published_names() -> list[str]:
    """Return the names of the networks that are published with the library, sorted."""
    files = published(PRETRAINED).glob(f"*/{PUBLISHED}")
    return sorted(path.parent.name for path in files)


def _read_results(scores: Mapping[str, Any]) -> dict[str, Estimate]:
    """Read the results of a published network from the scores in its file.

    A folder's metrics are nested in `scores`, and get names such as "photographs/auc".
    """
    results = {ACCURACY: Estimate(scores[ACCURACY])}
    for folder, metrics in scores.items():
        if not isinstance(metrics, Mapping):
            continue
        for metric in METRICS:
            estimate = Metrics.read(metrics).find(metric)
            if estimate is not None and estimate.value is not None:
                results[f"{folder}/{metric}"] = estimate
    return results
