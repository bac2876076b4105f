"""Training runs of tests, made by the steps that `python -m train` takes."""

from pathlib import Path

from train.data.sets import DataSet
from train.settings import ExperimentSettings
from train.training.inputs import load_data, load_initial, with_label
from train.training.run import Run


def loaded_run(settings: ExperimentSettings, folder: Path, data: DataSet | None = None) -> Run:
    """Make a run, load it and begin it. Without data, it loads those of the settings."""
    settings = with_label(settings)
    initial = load_initial(settings)
    if data is None:
        data = load_data(settings, initial)
    run = Run(settings, data, initial, folder)
    run.begin()
    return run


def completed_run(
    settings: ExperimentSettings, folder: Path, data: DataSet | None = None
) -> dict[str, float]:
    """Make, train and score a run, and return its scores."""
    return loaded_run(settings, folder, data).train()
