"""pnb-evaluate: scores of a network on a folder of photographs."""

from pathlib import Path

from augment.classifiers import Classifier
from train.command_settings import EvaluateSettings
from train.commands.results import require_replaceable
from train.data.photographs import require_outside
from train.evaluation.scores import scoring
from train.evaluation.scores.predictions import Predictor
from train.runs.run_lock import sole_writer
from train.runs.saved_networks import load_network, load_run
from train.settings import label_names, published
from train.system.device import MixedPrecision, choose_device, choose_precision
from train.system.user_errors import keyed, renamed, writable_folder


def evaluate(settings: EvaluateSettings) -> None:
    """Score a network on photographs, write tables and images, and print a summary.

    Raises:
        InputError: If the network, a class or the photographs cannot be used.
    """
    device = choose_device(settings.device)
    network = _load_network(settings)
    labels = label_names(settings.label)
    for name in labels:
        with keyed("label"):
            network.label(name)  # or InputError that names the network
    precision = choose_precision(settings.precision, device)
    model = MixedPrecision(network.to(device), precision)
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    points = network.operating_points
    predictor = Predictor(model, network.classes, network.size, device)
    with sole_writer("out", out):
        if settings.calibrate and settings.false_positive_rate:
            folder = published(Path(settings.calibrate))
            rate = settings.false_positive_rate
            skip = settings.skip_unreadable
            with renamed(folder="calibrate"):
                points = scoring.choose_operating_points(predictor, folder, labels, rate, skip)
        by_label = {point.label: point for point in points}
        has_all = by_label.keys() >= set(labels)
        points = [by_label[name] for name in labels] if has_all else []
        photos = published(Path(settings.photos))
        require_outside(out, photos)
        answers = predictor.predict(photos, labels, settings.skip_unreadable)
        scores = scoring.score(answers, settings.by, points)
        scoring.write(scores, out)
    print(f"{scoring.format_scores(scores)}\n\ntable, scores and image: {out}")


def _load_network(settings: EvaluateSettings) -> Classifier:
    """Load the network of a run, or any other classifier."""
    if settings.run is None:
        with renamed(name="classifier"):
            return load_network(str(settings.classifier), settings.weights)
    return load_run(settings.run, settings.weights, settings.model)
