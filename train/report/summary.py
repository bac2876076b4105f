"""Finished runs, read from the files in their folders, and the settings that tell them apart."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from renderer.errors import InputError
from train.photographs.figures import FIGURES, find_figure
from train.photographs.scoring import SUMMARY
from train.photographs.text import format_interval
from train.run_folder.continuation import decisive_settings
from train.run_folder.files import CONFIG, read_config, read_json
from train.run_folder.logs import METRICS, PHASES, read_metrics


@dataclass(frozen=True)
class RunSummary:
    """What a run's folder says: its resolved configuration, its epochs' lines of metrics, final scores, and mean
    seconds per epoch and phase.

    photographs: the summary of each folder of photographs that it was scored on, by the name of the sub-folder.
    """

    folder: Path
    config: DictConfig
    epochs: list[dict[str, float]]
    scores: dict[str, float]
    seconds: dict[str, float]
    photographs: dict[str, dict[str, Any]]

    @property
    def arm(self) -> str:
        return self.config.augment.arm

    @property
    def accuracy(self) -> float:
        return self.scores["test/accuracy"]

    @property
    def epoch_seconds(self) -> float:
        return sum(self.seconds[phase] for phase in PHASES)

    @cached_property
    def settings(self) -> dict[str, object]:
        return decisive_settings(self.config)

    def figures(self, name: str) -> dict[str, dict[str, Any]]:
        """Each of FIGURES on the photographs `name`; empty where it was not scored on them."""
        return {figure: find_figure(self.photographs.get(name, {}), figure) for figure in FIGURES}


def is_finished(folder: Path) -> bool:
    """Whether the folder holds a run with its final scores."""
    lines = read_metrics(folder)
    return bool(lines) and "epoch" not in lines[-1]


def summarize(folder: Path) -> RunSummary:
    """Read a finished run; InputError for a folder that holds none, or whose files lack what the tables show."""
    if not is_finished(folder):
        raise InputError(f"{folder} holds no finished run: let it finish, or resume it with train.resume=true")
    lines = read_metrics(folder)
    phases = sorted({name for line in lines for name in line if name.startswith("seconds/")})
    run = RunSummary(
        folder=folder,
        config=read_config(folder / CONFIG),
        epochs=[line for line in lines if "epoch" in line],
        scores=lines[-1],
        seconds={name.partition("/")[2]: fmean(line[name] for line in lines if name in line) for name in phases},
        photographs={path.parent.name: read_json(path) for path in sorted(folder.glob(f"*/{SUMMARY}"))},
    )
    with complete(folder):
        _require_shown(run)
    return run


def _require_shown(run: RunSummary) -> None:
    """An error of any of the kinds that `complete` knows where something that tables show is missing or of no sense."""
    for key, value, kind in (
        ("augment.arm", run.arm, str),
        ("label", run.config.label, str),
        ("seed", run.config.seed, int),
    ):
        if not isinstance(value, kind):
            raise TypeError(f"{key} is {value}")
    if not 0 <= run.accuracy <= 1:  # NaN is not
        raise ValueError(f"test/accuracy is {run.accuracy}")
    _ = run.settings, f"{run.epoch_seconds:.1f}"
    for name in run.photographs:
        [format_interval(figure) for figure in run.figures(name).values()]


@contextmanager
def complete(folder: Path) -> Iterator[None]:
    """InputError where what is shown of a run is not in its files, or of another kind there."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, OmegaConfBaseException) as error:
        reason = f"{type(error).__name__}: {str(error).splitlines()[0]}" if str(error) else type(error).__name__
        raise InputError(
            f"{folder}: {CONFIG}, {METRICS} or a {SUMMARY} is not as `python -m train` wrote it "
            f"({reason}): use another run"
        ) from error


def group_by_settings(runs: Sequence[RunSummary]) -> list[list[RunSummary]]:
    """Runs that differ only in the seed, in the order of the first of each group."""
    groups: dict[str, list[RunSummary]] = {}
    for run in runs:
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    return list(groups.values())


def varied_settings(runs: Sequence[RunSummary]) -> list[str]:
    """The settings that the runs differ in, but for the arm and the seed, which tables always show."""
    keys = sorted({key for run in runs for key in run.settings} - {"augment.arm", "seed"})
    return [key for key in keys if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs)]


def name_among(run: RunSummary, runs: Sequence[RunSummary]) -> str:
    """The run's arm, and the settings that it does not share with all others of the runs of this arm."""
    alike = [other for other in runs if other.arm == run.arm]
    return ", ".join([run.arm, *(f"{key}={run.settings.get(key)}" for key in varied_settings(alike))])
