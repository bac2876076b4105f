"""How tests make training runs: by the steps that `python -m train` takes."""

from pathlib import Path

from train.data.load import load_data
from train.data.sets import DataSet
from train.settings import ExperimentSettings
from train.training.initial import load_initial
from train.training.run import Run


def loaded_run(settings: ExperimentSettings, folder: Path, data: DataSet | None = None) -> Run:
    """Make a run and load it. Without data, the settings name them."""
    initial = load_initial(settings)
    run = Run(settings, data or load_data(settings, initial.size if initial else None), folder, initial)
    run.load()
    return run


def finish(run: Run) -> dict[str, float]:
    """Train and score a run that was loaded; return its scores."""
    run.fit()
    scores = run.score()
    run.export()
    return scores


def completed_run(settings: ExperimentSettings, folder: Path, data: DataSet | None = None) -> dict[str, float]:
    """Make, train and score a run; return its scores."""
    return finish(loaded_run(settings, folder, data))
