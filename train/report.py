"""Tables and model cards of finished runs, from the files in their folders."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean, stdev

from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from renderer.errors import InputError
from train import checkpoint
from train.epoch import PHASES
from train.experiment import PHOTOGRAPHS
from train.logs import METRICS, read_metrics
from train.photographs import share
from train.run_folder import CONFIG, read_config, read_json
from train.settings import decisive_settings

RECIPE = ("epochs", "batch_size", "learning_rate", "momentum", "weight_decay", "schedule", "precision")


@dataclass(frozen=True)
class RunSummary:
    """What a run's folder says: its resolved configuration, final scores and mean seconds per epoch and phase."""

    folder: Path
    config: DictConfig
    scores: dict[str, float]
    seconds: dict[str, float]
    photographs: dict | None

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
    photographs = folder / PHOTOGRAPHS / "summary.json"
    phases = sorted({name for line in lines for name in line if name.startswith("seconds/")})
    run = RunSummary(
        folder=folder,
        config=read_config(folder / CONFIG),
        scores=lines[-1],
        seconds={name.partition("/")[2]: fmean(line[name] for line in lines if name in line) for name in phases},
        photographs=read_json(photographs) if photographs.is_file() else None,
    )
    with _complete(folder):
        format_table([run])
        format_comparison([run], exclude=[])
    return run


@contextmanager
def _complete(folder: Path) -> Iterator[None]:
    """InputError where what is shown of a run is not in its files, or of another kind there."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, OmegaConfBaseException) as error:
        reason = f"{type(error).__name__}: {str(error).splitlines()[0]}" if str(error) else type(error).__name__
        raise InputError(
            f"{folder}: {CONFIG}, {METRICS} or {PHOTOGRAPHS}/summary.json is not as `python -m train` wrote it "
            f"({reason}): use another run"
        ) from error


def format_table(runs: Sequence[RunSummary]) -> str:
    """A Markdown table of the headline figures and what the runs differ in, one row per run, and the pictures."""
    label, varied = runs[0].config.label, _varied(runs)
    figures = ["test accuracy", f"{label} recognised", f"others called {label}", "seconds per epoch"]
    header = ["augment", *varied, "seed", *figures]
    rows = [
        [
            run.arm,
            *(str(run.settings.get(key)) for key in varied),
            str(run.config.seed),
            f"{run.scores['test/accuracy']:.3f}",
            *(_interval(run.photographs and run.photographs[name]) for name in ("recall", "false_alarms")),
            f"{sum(run.seconds[phase] for phase in PHASES):.1f}",
        ]
        for run in runs
    ]
    sheets = [run.folder / PHOTOGRAPHS / "contact_sheet.png" for run in runs if run.photographs]
    return "\n".join([_markdown(header, rows), *(f"picture: {sheet}" for sheet in sheets)])


def format_spread(runs: Sequence[RunSummary]) -> str:
    """A Markdown table, a row per group of runs that differ only in the seed: mean ± standard deviation; "" if none."""
    label, varied = runs[0].config.label, _varied(runs)
    groups: dict[str, list[RunSummary]] = {}
    for run in runs:
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    header = ["augment", *varied, "seeds", "test accuracy", f"{label} recognised", f"others called {label}"]
    rows = [
        [
            group[0].arm,
            *(str(group[0].settings.get(key)) for key in varied),
            str(len(group)),
            *map(_spread, zip(*map(_figures, group), strict=True)),
        ]
        for group in groups.values()
        if len(group) > 1
    ]
    return _markdown(header, rows) if rows else ""


def format_comparison(runs: Sequence[RunSummary], exclude: Sequence[str]) -> str:
    """Markdown tables of runs: accuracy, recall and false alarms by source, and seconds per epoch and phase.

    exclude: sources that the pooled figures leave out; InputError for one that is nowhere.
    """
    tables = [("Accuracy on the test set", _accuracy_table(runs)), ("Seconds per epoch", _seconds_table(runs))]
    if scored := [run for run in runs if run.photographs]:
        label = runs[0].config.label
        tables[1:1] = [
            (f"Photographs of {label} recognised", _source_table(scored, "recall", exclude)),
            (f"Photographs of other things called {label}", _source_table(scored, "false_alarms", exclude)),
        ]
    return "\n\n".join(f"### {title}\n\n{table}" for title, table in tables)


def publish_run(folder: Path, out: Path) -> None:
    """Write a finished run's selected network as half-precision safetensors, and a card beside it."""
    run = summarise(folder)
    with _complete(folder):
        card = _card(run, out.name)
    out.mkdir(parents=True, exist_ok=True)
    checkpoint.publish(out / checkpoint.PUBLISHED, checkpoint.load(folder / checkpoint.BEST))
    (out / "README.md").write_text(card, encoding="utf-8")


def _varied(runs: Sequence[RunSummary]) -> list[str]:
    """The settings that the runs differ in, but for the arm and the seed, which tables always show."""
    keys = sorted({key for run in runs for key in run.settings} - {"augment.arm", "seed"})
    return [key for key in keys if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs)]


def _figures(run: RunSummary) -> list[float | None]:
    shares = [run.photographs and run.photographs[name]["value"] for name in ("recall", "false_alarms")]
    return [run.scores["test/accuracy"], *shares]


def _spread(values: Sequence[float | None]) -> str:
    return "-" if None in values else f"{fmean(values):.3f} ± {stdev(values):.3f}"


def _accuracy_table(runs: Sequence[RunSummary]) -> str:
    header = ["augment", "seed", "selected on validation", "at epoch", "last epoch"]
    rows = [
        [
            run.arm,
            str(run.config.seed),
            f"{run.scores['test/accuracy']:.4f}",
            str(run.scores["test/epoch"]),
            f"{run.scores['test/accuracy_last']:.4f}",
        ]
        for run in runs
    ]
    return _markdown(header, rows)


def _source_table(runs: Sequence[RunSummary], figure: str, exclude: Sequence[str]) -> str:
    sources = sorted({source for run in runs for source in run.photographs["by_source"]})
    if unknown := set(exclude).difference(sources):
        raise InputError(f"exclude: no photograph is of source {min(unknown)!r}; the sources are {', '.join(sources)}")
    rows = [
        [source, *(_interval(run.photographs["by_source"].get(source, {}).get(figure)) for run in runs)]
        for source in sources
    ]
    title = f"all but {', '.join(exclude)}" if exclude else "all"
    rows.append([title, *(_interval(_share_without(run.photographs, exclude, figure)) for run in runs)])
    header = ["source", *(f"{run.arm}, seed {run.config.seed}" for run in runs)]
    return _markdown(header, [row for row in rows if set(row[1:]) != {"-"}])


def _share_without(photographs: dict, exclude: Sequence[str], figure: str) -> dict:
    """The share over all photographs but those of some sources."""
    by_source = photographs["by_source"]
    excluded = [by_source[source][figure] for source in set(exclude) if source in by_source]
    return share(*(photographs[figure][count] - sum(part[count] for part in excluded) for count in ("hits", "n")))


def _seconds_table(runs: Sequence[RunSummary]) -> str:
    """Means per epoch; the operators are built once a run. The own share is the attack outside the classifier."""
    header = ["augment", *PHASES, "attack's own share", "attack's share of the epoch", "operators, once"]
    return _markdown(header, [[run.arm, *_seconds_row(run.seconds)] for run in runs])


def _seconds_row(seconds: dict[str, float]) -> list[str]:
    phases = [f"{seconds[phase]:.2f}" for phase in PHASES]
    if "attack_classifier" not in seconds:
        return [*phases, "-", "-", "-"]
    own = 1 - seconds["attack_classifier"] / seconds["attack"]
    return [
        *phases,
        f"{own:.1%}",
        f"{seconds['attack'] / sum(seconds[phase] for phase in PHASES):.1%}",
        f"{seconds['operators']:.2f}",
    ]


def _card(run: RunSummary, name: str) -> str:
    config, scores = run.config, run.scores
    architecture = f"WideResNet-{config.model.depth}-{config.model.width}, dropout {config.model.dropout}"
    data = Path(config.data.path).name if config.data.name in ("npz", "folder") else config.data.name
    meshes = [Path(mesh if isinstance(mesh, str) else mesh.mesh).name for mesh in config.scene.meshes]
    renders = f"{config.augment.examples} renders of {', '.join(meshes)}" if run.arm != "none" else "none"
    rows = [
        ("network", architecture),
        ("data", f"{data}, {config.data.validation:.0%} of training for validation"),
        ("augmentation", f"{run.arm}; renders each epoch: {renders}"),
        ("recipe", ", ".join(f"{name} {config.train[name]}" for name in RECIPE)),
        ("seed", str(config.seed)),
        ("epoch", f"{scores['test/epoch']}, selected on validation"),
        ("test accuracy", f"{scores['test/accuracy']:.4f}"),
        *((name, _interval(run.photographs[name])) for name in ("recall", "false_alarms") if run.photographs),
        ("versions", ", ".join(f"{name} {version}" for name, version in config.versions.items())),
    ]
    title = f"# {architecture}, augment={run.arm}"
    note = "Half-precision weights; images are RGB in [0, 1], normalised inside. Score photographs with"
    command = f"`python scripts/evaluate_photos.py run=pretrained/{name} photos=...`."
    return f"{title}\n\n{note} {command}\n\n{_markdown(['what', 'value'], [list(row) for row in rows])}\n"


def _interval(figure: dict | None) -> str:
    if not figure or figure["value"] is None:
        return "-"
    return f"{figure['value']:.3f} [{figure['low']:.3f}, {figure['high']:.3f}]"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )
