"""The networks that this project trained, as classifiers to attack, beside those of other sources."""

from pathlib import Path

from omegaconf import OmegaConf

from augment import classifiers
from augment.classifiers import Classifier
from renderer.errors import InputError
from train.checkpoint import load_network
from train.run_folder import CONFIG, read_config

SIZE = 32  # of the data sets whose configuration has no size, CIFAR-100 above all


def load_classifier(name: str, weights: str | Path | None = None) -> Classifier:
    """`run:FOLDER`, or a name that `augment.classifiers.load_classifier` knows, whose errors are raised."""
    return classifiers.load_classifier(name, weights, SOURCES)


def load_run(run: str, weights: Path | None = None) -> Classifier:
    """The selected network of a run's folder, of a folder under pretrained/, or of a file of either.

    The classes are the checkpoint's; the size is the run's data.size, or 32 where no configuration names one.
    InputError for a folder without a network, and for weights=, since the run holds its own.
    """
    if weights is not None:
        raise InputError(
            f"weights={weights} is not for classifier=run:{run}, which has weights of its own: leave it out"
        )
    network, classes = load_network(Path(run))
    return Classifier(network, _size(Path(run)), classes, f"run:{run}")


def _size(run: Path) -> int:
    config = (run.parent if run.is_file() else run) / CONFIG
    size = OmegaConf.select(read_config(config), "data.size", default=SIZE) if config.is_file() else SIZE
    if not isinstance(size, int) or size < 1:
        raise InputError(f"{config} has data.size={size}: it must be a whole number, the pixels per side")
    return size


SOURCES = {**classifiers.SOURCES, "run:": load_run}
