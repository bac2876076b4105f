"""Tables and model cards of finished runs, from the files in their folders."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from renderer.errors import InputError
from train.networks import PYTHON, model_title
from train.photographs import FIGURES, SUMMARY, figure_title, find_figure, format_interval
from train.report.tables import Table, aligned
from train.run_folder import checkpoint
from train.run_folder.classifier import PUBLISHED, load_run, publish
from train.run_folder.files import CONFIG, read_config, read_json
from train.run_folder.logs import METRICS, PHASES, read_metrics
from train.settings import decisive_settings

RECIPE = (
    "epochs",
    "images_per_epoch",
    "batch_size",
    "learning_rate",
    "momentum",
    "weight_decay",
    "schedule",
    "ranking",
    "distillation",
    "averaging",
    "soup",
    "precision",
)


@dataclass(frozen=True)
class RunSummary:
    """What a run's folder says: its resolved configuration, final scores and mean seconds per epoch and phase.

    photographs: the summary of each folder of photographs that it was scored on, by the name of the sub-folder.
    """

    folder: Path
    config: DictConfig
    scores: dict[str, float]
    seconds: dict[str, float]
    photographs: dict[str, dict[str, Any]]

    @property
    def arm(self) -> str:
        return self.config.augment.arm

    @cached_property
    def settings(self) -> dict[str, object]:
        return decisive_settings(self.config)


def is_finished(folder: Path) -> bool:
    """Whether the folder holds a run with its final scores."""
    lines = read_metrics(folder)
    return bool(lines) and "epoch" not in lines[-1]


def summarise(folder: Path) -> RunSummary:
    """Read a finished run; InputError for a folder that holds none, or whose files lack what the tables show."""
    if not is_finished(folder):
        raise InputError(f"{folder} holds no finished run: let it finish, or resume it with train.resume=true")
    lines = read_metrics(folder)
    phases = sorted({name for line in lines for name in line if name.startswith("seconds/")})
    run = RunSummary(
        folder=folder,
        config=read_config(folder / CONFIG),
        scores=lines[-1],
        seconds={name.partition("/")[2]: fmean(line[name] for line in lines if name in line) for name in phases},
        photographs={path.parent.name: read_json(path) for path in sorted(folder.glob(f"*/{SUMMARY}"))},
    )
    with complete(folder):
        for key, value, kind in (
            ("augment.arm", run.arm, str),
            ("label", run.config.label, str),
            ("seed", run.config.seed, int),
        ):
            if not isinstance(value, kind):
                raise TypeError(f"{key} is {value}")
        if not 0 <= run.scores["test/accuracy"] <= 1:  # NaN is not
            raise ValueError(f"test/accuracy is {run.scores['test/accuracy']}")
        format_table([run])
    return run


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


def format_table(runs: Sequence[RunSummary]) -> str:
    """`headline_tables` as Markdown, and the contact sheets."""
    sheets = [f"image: {run.folder / folder / 'contact_sheet.png'}" for run in runs for folder in run.photographs]
    return "\n\n".join(filter(None, [*map(_titled, headline_tables(runs)), "\n".join(sheets)]))


def headline_tables(runs: Sequence[RunSummary]) -> list[Table]:
    """One row per run.

    The first table has what the runs differ in, accuracy and time; one for each folder of photographs has its figures.
    """
    varied = varied_settings(runs)
    header = ["augment", *varied, "seed"]
    names = [[*_name(run, varied), str(run.config.seed)] for run in runs]
    scores = [[f"{run.scores['test/accuracy']:.3f}", f"{_epoch_seconds(run):.1f}"] for run in runs]
    tables = [_beside("", header, names, ["test accuracy", "seconds per epoch"], scores)]
    for folder in _folders(runs):
        figures = [[format_interval(figure) for figure in _figures(run, folder)] for run in runs]
        tables.append(_beside(folder, header, names, _titles(runs), figures))
    return tables


def format_spread(runs: Sequence[RunSummary]) -> str:
    """`spread_tables` as Markdown."""
    return "\n\n".join(map(_titled, spread_tables(runs)))


def spread_tables(runs: Sequence[RunSummary]) -> list[Table]:
    """Those tables with a row per group of runs that differ only in the seed: mean ± standard deviation; [] if none."""
    groups = [group for group in group_by_settings(runs) if len(group) > 1]
    if not groups:
        return []
    varied = varied_settings(runs)
    header = ["augment", *varied, "seeds"]
    names = [[*_name(group[0], varied), str(len(group))] for group in groups]
    accuracies = [[_spread([run.scores["test/accuracy"] for run in group])] for group in groups]
    tables = [_beside("", header, names, ["test accuracy"], accuracies)]
    for folder in _folders(runs):
        figures = [[_spread(values) for values in _values(group, folder)] for group in groups]
        tables.append(_beside(folder, header, names, _titles(runs), figures))
    return tables


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


def publish_run(folder: Path, out: Path) -> None:
    """Write a finished run's selected network as half-precision safetensors, and a card beside it."""
    run = summarise(folder)
    with complete(folder):
        card = _card(run, out.name)
    state = checkpoint.load(folder / checkpoint.BEST)
    if not str(state["architecture"].get("name")).startswith(PYTHON):  # whose code only its user runs
        load_run(folder / checkpoint.BEST)  # or raises: nobody could use it
    out.mkdir(parents=True, exist_ok=True)
    publish(out / PUBLISHED, state)
    (out / "README.md").write_text(card, encoding="utf-8")


def _name(run: RunSummary, varied: Sequence[str]) -> list[str]:
    return [run.arm, *(str(run.settings.get(key)) for key in varied)]


def _titled(table: Table) -> str:
    return f"{table.title}:\n{table}" if table.title else str(table)


def _beside(
    title: str, names_header: list[str], names: list[list[str]], header: list[str], rows: list[list[str]]
) -> Table:
    """A table whose rows begin with names."""
    return Table(title, [*names_header, *header], [[*name, *row] for name, row in zip(names, rows, strict=True)])


def _epoch_seconds(run: RunSummary) -> float:
    return sum(run.seconds[phase] for phase in PHASES)


def _folders(runs: Sequence[RunSummary]) -> list[str]:
    """The folders of photographs that any of the runs was scored on."""
    return sorted({folder for run in runs for folder in run.photographs})


def _titles(runs: Sequence[RunSummary]) -> list[str]:
    return [figure_title(name, runs[0].config.label) for name in FIGURES]


def _figures(run: RunSummary, folder: str) -> list[dict[str, Any]]:
    return [find_figure(run.photographs.get(folder, {}), name) for name in FIGURES]


def _values(group: Sequence[RunSummary], folder: str) -> list[tuple[float | None, ...]]:
    """Each figure's values over the runs of a group."""
    return [*zip(*([figure.get("value") for figure in _figures(run, folder)] for run in group), strict=True)]


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return "-"
    with np.errstate(invalid="ignore"):  # where a damaged file has no finite number
        return f"{np.mean(known):.3f} ± {np.std(known, ddof=1):.3f}"


def _counted(meshes: Sequence[Any]) -> str:
    """Names of scene.meshes or scene.look_alikes, each with how often it is there."""
    counts = Counter(Path(mesh if isinstance(mesh, str) else mesh.mesh).name for mesh in meshes)
    return ", ".join(f"{count} × {name}" if count > 1 else name for name, count in counts.items())


def _card(run: RunSummary, name: str) -> str:
    config, scores = run.config, run.scores
    architecture = model_title(**config.model)
    data = Path(config.data.path).name if config.data.name in ("npz", "folder") else config.data.name
    meshes, look_alikes = config.scene.meshes, config.scene.get("look_alikes") or []
    beside = f" beside {_counted(look_alikes)}" if look_alikes else ""
    often = f"every {config.augment.every} training images" if config.augment.get("every") else "each epoch"
    each = len(meshes) + len(look_alikes), config.scene.views, len(config.scene.backgrounds)
    count = config.augment.examples or math.prod(each)
    renders = f"{count} renders of {_counted(meshes)}{beside}" if run.arm != "none" else "none"
    start = config.train.get("init_from")
    selection = "of which the mean is kept" if config.train.get("soup") else "selected on validation"
    rows = [
        ("network", architecture),
        ("data", f"{data}, {config.data.validation:.0%} of training for validation"),
        *([("begun from", Path(start).name)] if start else []),
        ("augmentation", f"{run.arm}; renders {often}: {renders}"),
        ("recipe", ", ".join(f"{name} {config.train[name]}" for name in RECIPE if config.train.get(name))),
        ("seed", str(config.seed)),
        ("epoch", f"{scores['test/epoch']}, {selection}"),
        ("test accuracy", f"{scores['test/accuracy']:.4f}"),
        *(
            (f"{folder}: {figure_title(name, config.label)}", format_interval(find_figure(summary, name)))
            for folder, summary in run.photographs.items()
            for name in FIGURES
        ),
        ("versions", ", ".join(f"{name} {version}" for name, version in config.versions.items())),
    ]
    title = f"# {architecture}, augment={run.arm}"
    note = "Half-precision weights; images are RGB in [0, 1], normalised inside. Score photographs with"
    command = f"`python scripts/evaluate_photos.py run=pretrained/{name} photos=...`."
    return f"{title}\n\n{note} {command}\n\n{aligned(['what', 'value'], [list(row) for row in rows])}\n"
