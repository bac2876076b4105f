"""The networks that this project trained, as classifiers to attack, beside those of other sources."""

from pathlib import Path

from augment import classifiers
from augment.classifiers import Classifier
from renderer.errors import InputError
from train.run_folder.checkpoint import load_network


def load_classifier(name: str, weights: str | Path | None = None) -> Classifier:
    """`run:FOLDER`, or a name that `augment.classifiers.load_classifier` knows, whose errors are raised."""
    return classifiers.load_classifier(name, weights, SOURCES)


def load_run(
    run: str, weights: str | Path | None = None, size: int | None = None, model: str | None = None
) -> Classifier:
    """The selected network of a run's folder, of a folder under pretrained/, or of a file of either.

    size, model: see `load_network`. InputError for a folder without a network, and for weights=, since the run holds
    its own.
    """
    if weights is not None:
        raise InputError(
            f"weights={weights} is not for classifier=run:{run}, which has weights of its own: leave it out"
        )
    network = load_network(Path(run), size, model)
    return Classifier(network.module, network.size, network.classes, f"run:{run}")


SOURCES = {**classifiers.SOURCES, "run:": load_run}
