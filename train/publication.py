"""Publish the network of a run, and load networks that are published with the library."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from augment.classifier import Classifier, OperatingPoint, TaskNetwork
from augment.settings import PYTHON
from renderer.errors import InputError, as_path, require_choice
from train.checkpoints import as_published, load_run, load_selected, write_published
from train.command_settings import require_calibration
from train.results.metrics import METRICS, Metrics
from train.results.overwrite import require_replaceable
from train.results.scoring import Predictor, choose_operating_points
from train.results.store import summarize, trained_labels
from train.results.tables import Estimate
from train.run_config import mapped
from train.run_folder import PUBLISHED, writable_folder
from train.settings import published_folder

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


class PublishedDetector(TaskNetwork):
    """A detector that is published with the library, with its results.

    Attributes:
        results: Metrics on generated solids that its training did not show: "held_out/recall",
            "held_out/ap50" and "held_out/false_per_image".
    """

    results: Mapping[str, Estimate]


def load(name: str) -> PublishedNetwork | PublishedDetector:
    """Load a network that is published with the library, with its results.

    Args:
        name: "best", "adversarial", "random", "none", "dim" or "detector". The file
            pretrained/README.md describes these networks.

    Returns:
        Classifier of images of 32 pixels per side, or a detector of generated
        solids in images of 128 pixels per side. Its attribute `results` has its
        metrics.

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
    files = published_folder(PRETRAINED).glob(f"*/{PUBLISHED}")
    require_choice("name", name, sorted(path.parent.name for path in files))
    folder = published_folder(PRETRAINED / name)
    loaded = load_run(folder)
    # The scores of a classifier are metrics by name, those of a detector are in groups of images.
    scores = load_selected(folder)[1]["scores"]
    facts = loaded.network, loaded.size, loaded.classes, name
    network: PublishedNetwork | PublishedDetector
    if isinstance(loaded, Classifier):
        network = PublishedNetwork(*facts)
        network.operating_points = loaded.operating_points
        network.results = _read_results(scores)
    else:
        network = PublishedDetector(*facts, task=loaded.task)
        network.results = {
            f"{images}/{metric}": Estimate(**metrics["all"][metric])
            for images, metrics in scores.items()
            for metric in ("recall", "ap50", "false_per_image")
        }
    network.inputs, network.recognizer = loaded.inputs, loaded.recognizer
    return network


def _read_results(scores: Mapping[str, Any]) -> dict[str, Estimate]:
    """Read a published network's results; those of folders get names like "photographs/auc"."""
    results = {ACCURACY: Estimate(scores[ACCURACY])}
    for folder, metrics in scores.items():
        for metric in METRICS if isinstance(metrics, Mapping) else ():
            estimate = Metrics.read(metrics).find(metric)
            if estimate is not None and estimate.value is not None:
                results[f"{folder}/{metric}"] = estimate
    return results


def publish(
    run: str | Path,
    out: str | Path,
    *,
    calibrate: str | Path | None = None,
    false_positive_rate: float | None = None,
    label: str | int | Sequence[str | int] | None = None,
    network: str | None = None,
    trust_code: bool = False,
    overwrite: bool = False,
) -> list[OperatingPoint]:
    """Write the network of a run as half-precision safetensors, for other users.

    The metadata of the file holds the settings and the scores of the run as JSON. `load_run`
    reads the file. A run that `load_run` cannot load cannot be published, either.

    Args:
        run: Folder of a finished run, or of a published network.
        out: Folder of the written file.
        calibrate: Folder of photographs on which a threshold on the log-odds of each positive
            class is chosen, with a sub-folder for each class. None for the threshold that a
            published network has, if any.
        false_positive_rate: False-positive rate of the thresholds on these photographs, in
            (0, 1). It is given together with `calibrate`.
        label: Class of the threshold, by name or index, or several. None for what the run was
            trained for.
        network: "python:package.module:function", if such a function built the network of the
            run.
        trust_code: Whether a function that the file of the network names may be called. It can
            run any code.
        overwrite: Whether to replace results in `out`.

    Returns:
        The chosen thresholds, one for each positive class. Empty without `calibrate`.

    Raises:
        InputError: If the network cannot be read or built, if the photographs cannot be read, or
            if `out` has other results.

    Example:
        >>> import norm_balls as nb
        >>> nb.publish("pretrained/best", "published/best")
        []
        >>> nb.load_run("published/best").size
        32
    """
    require_calibration(false_positive_rate, calibrate)
    target = writable_folder(as_path("out", out), "out")
    folder = as_path("run", run)
    path, state = load_selected(folder)
    # `run` may be the folder of a published network, which is then replaced, for example
    # to add a detection threshold to it.
    is_replaced = path.resolve() == (target / PUBLISHED).resolve()
    require_replaceable(target, "out", overwrite, [PUBLISHED] if is_replaced else [])
    if path.suffix != Path(PUBLISHED).suffix:
        found = summarize(folder)
        state["settings"] = mapped(dict(found.settings), _without_folder)
        state["versions"] = dict(found.config.versions)
        state["scores"] = dict(found.scores)
        for name, scores in found.photographs.items():
            facts = {"images": scores.images, "label": [*scores.labels]}
            state["scores"][name] = facts | scores.overall.to_summary()
    points: list[OperatingPoint] = []
    # A Python function of the user may build the network. It is called only if the
    # network must be calibrated.
    if calibrate is not None or not str(state["architecture"].get("name")).startswith(PYTHON):
        # `load_run` raises an InputError if nobody could load the published network.
        loaded = load_run(path, model=network, trust_code=trust_code)
        if calibrate is not None and false_positive_rate is not None:
            labels: Any = label if label is not None else trained_labels(folder)
            if not labels:
                raise InputError(f"label is not set, nor in run={run}: give label", "label")
            # Published weights have 16 bits, unless these cannot hold them.
            for weight in loaded.state_dict().values():
                weight.copy_(as_published(weight))
            predictor = Predictor(loaded, loaded.classes, loaded.size)
            negatives = as_path("calibrate", calibrate)
            points = choose_operating_points(predictor, negatives, labels, false_positive_rate)
            state["operating_point"] = [asdict(point) for point in points]
    target.mkdir(parents=True, exist_ok=True)
    write_published(target / PUBLISHED, state)
    return points


def _without_folder(text: str) -> str:
    """Remove the folders, which other machines do not have, from absolute paths only."""
    return Path(text).name if Path(text).is_absolute() else text
