"""pnb-evaluate: scores of a network on a folder of photographs."""

from pathlib import Path

from augment.network import Classifier
from augment.plain_networks import as_facts, require_no_facts
from train.command_settings import EvaluateSettings
from train.data.photographs import class_folders
from train.device import choose_device
from train.functions.evaluate import evaluate as evaluate_network
from train.results.scoring import format_overall, format_scores
from train.results.store import trained_labels
from train.saved_networks import load_chosen, load_run
from train.settings import label_names, published
from train.system import is_verbose
from train.user_errors import keyed


def evaluate(settings: EvaluateSettings) -> None:
    """Score a network on photographs, write tables and images, and print a summary."""
    network = _load_network(settings)
    label = settings.label
    if (
        label is None
        and settings.run
        and class_folders(published(Path(settings.photos)), network.classes)
    ):
        label = trained_labels(Path(settings.run)) or None
    with keyed("label"):
        for name in [] if label is None else label_names(label):
            network.label(name)
    scores = evaluate_network(
        network,
        settings.photos,
        label,
        by=settings.by,
        calibrate=settings.calibrate,
        false_positive_rate=settings.false_positive_rate,
        skip_unreadable=settings.skip_unreadable,
        precision=settings.precision,
        device=choose_device(settings.device),
        out=settings.out,
        overwrite=settings.overwrite,
    )
    if settings.label is None:
        source = "each class with a sub-folder" if label is None else f"those of {settings.run}"
        print(f"positive classes: {', '.join(scores.predicted.labels)} ({source})")
    text = format_scores(scores) if is_verbose() else format_overall(scores)
    print(f"{text}\ntable, scores and image: {Path(settings.out)}")


def _load_network(settings: EvaluateSettings) -> Classifier:
    """Load the network of the training run `settings.run`, or else `settings.network`."""
    if settings.run is None:
        # Error messages about the argument `name` begin with the setting `network` instead.
        with keyed(name="network"):
            return load_chosen(settings)
    # The file of a training run has its classes, size and normalization. These settings
    # are therefore an error here.
    given_values = as_facts(settings.classes, settings.size, settings.normalization)
    require_no_facts(f"run={settings.run}", given_values)
    classifier = load_run(settings.run, settings.weights, settings.network, settings.trust)
    # The returned copy normalizes the light of each image, unless the setting is None.
    return classifier.normalizing_light(settings.normalize_light)
