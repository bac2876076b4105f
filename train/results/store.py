"""Runs and attacks, read from the files in their folders, and tables of runs."""

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, cast

from omegaconf import DictConfig, OmegaConf

from augment.attack_settings import LINES
from augment.augmentation_settings import MODES
from renderer.errors import InputError, explained
from train import console, run_config, run_folder
from train.results.metrics import Metrics, Pool, Thresholds, describe_point
from train.results.predictions import PREDICTIONS, SUMMARY, read_predictions
from train.run_config import CONFIG, read_config
from train.run_folder import BEFORE, PUBLISHED, read_json, read_metrics
from train.settings import label_names, published_folder

# A method whose settings need a longer name than this is named by a number.
LONGEST_NAME = 56
# Name of the method of a network with whose weights other runs began.
INITIAL = "the initial network"
# Names of two networks in tables: a network that was trained with renders, and the
# network with whose weights it began.
BEFORE_HARDENING = "before hardening"
AFTER_HARDENING = "after hardening"
# Files that show that a folder holds a training run: any of them.
FILES_OF_RUN = {run_folder.METRICS, run_folder.FAILURE, run_folder.LAST, run_folder.BEST}
# Files of a network without a run: scores that pnb-evaluate wrote, or a published network.
FILES_OF_NETWORK = (SUMMARY, PUBLISHED)


@dataclass(frozen=True)
class StoredScores:
    """Scores of a network on one folder of photographs.

    They are read from summary.json, or from the file of a published network.

    Attributes:
        images: Hash of the photographs. Two networks were scored on the same
            photographs if the hashes are equal.
        labels: Positive classes.
        overall: Metrics of all photographs.
        thresholds: Threshold on the log-odds of each positive class. Empty if
            none was chosen.
        operating_point: How the thresholds were chosen, in words. Empty if none
            was chosen.
    """

    images: str
    labels: Sequence[str]
    overall: Metrics
    thresholds: Thresholds = field(default_factory=dict)
    operating_point: str = ""

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> "StoredScores":
        """Read scores from a mapping, also if an earlier version wrote it with fewer entries.

        A damaged mapping raises an error of any type.
        """
        labels = label_names(summary.get("label", ""))
        points = summary.get("operating_point", [])
        points = points if isinstance(points, list) else [points]
        # If the images are unknown, those of equal scores are the same.
        images = str(summary.get("images") or summary)
        thresholds = {point["label"]: float(point["threshold"]) for point in points}
        operating_point = " or ".join(dict.fromkeys(map(describe_point, points)))
        return cls(images, labels, Metrics.read(summary), thresholds, operating_point)


@dataclass(frozen=True)
class RunSummary:
    """Settings and scores of a finished training run, or of a network without a run.

    A published network, and a network that pnb-evaluate scored, have no run.

    Attributes:
        folder: Folder of the run or of the network.
        mode: Kind of renders in the training, such as "adversarial". Without a
            run, the name of the network.
        settings: Settings that decide the result, by dotted key.
        photographs: Scores on photographs, by the name of the sub-folder of
            `folder` that holds them.
        accuracy: Accuracy on the test images. None if it was not measured.
        seed: Seed of the run. None without a run.
        config: All settings of the run.
        epochs: Metrics of each epoch by name.
        scores: Final scores by name.
        before: Network with whose weights the run began. None if it began with
            random weights.
    """

    folder: Path
    mode: str
    settings: Mapping[str, object]
    photographs: Mapping[str, StoredScores]
    accuracy: float | None
    seed: int | None = None
    config: DictConfig = field(default_factory=lambda: OmegaConf.create())
    epochs: Sequence[dict[str, float]] = ()
    scores: Mapping[str, float] = field(default_factory=dict)
    before: "RunSummary | None" = None


# The runs of each method, by the name of the method. They differ in their seed.
Methods = Mapping[str, Sequence[RunSummary]]


class ScoredRun(NamedTuple):
    """A run, and the scores of its network on one folder of photographs.

    Attributes:
        run: The run.
        name: Name of the sub-folder of the run with these scores, or its absolute path.
    """

    run: RunSummary
    name: str

    @property
    def scores(self) -> StoredScores:
        """Scores in this sub-folder."""
        return self.run.photographs[self.name]

    @property
    def folder(self) -> Path:
        """Path of this sub-folder."""
        return self.run.folder / self.name

    def pooled(self) -> Pool:
        """Read the predictions."""
        path = self.folder / PREDICTIONS
        # The predictions of all runs are paired, so they are read in one order.
        labels = tuple(sorted(self.scores.labels))
        thresholds = tuple(self.scores.thresholds.items())
        return _pool(path, path.stat().st_mtime_ns, labels, thresholds)


@lru_cache(maxsize=64)
def _pool(
    path: Path, modified: int, labels: tuple[str, ...], thresholds: tuple[tuple[str, float], ...]
) -> Pool:
    """Read predictions.csv once at a time of modification, for all tables and pages."""
    return Pool(read_predictions(path, labels), dict(thresholds))


# The runs of each method with their scores on the same images.
Scored = Mapping[str, Sequence[ScoredRun]]


def is_finished(folder: Path) -> bool:
    """Return whether a folder holds a finished run, which has its final scores.

    The last line of metrics.jsonl then has scores. All lines before it have the number of an epoch.
    """
    lines = read_metrics(folder)
    return bool(lines) and "epoch" not in lines[-1]


def summarize(folder: Path) -> RunSummary:
    """Read the settings and scores in the folder of a run, an evaluation or a published network."""
    folder = published_folder(folder)
    # An entry that is missing or of a wrong type raises errors of many types.
    with explained(f"{folder} has a file that is not as `pnb-train` wrote it", "use another run"):
        return _read(folder)


def trained_labels(folder: Path) -> list[str]:
    """Return the positive classes for which a run, or a published network, was trained."""
    try:
        run = summarize(folder)
    except InputError:
        return []
    if run.settings.get("label") is not None:
        return label_names(cast(Any, run.settings["label"]))
    return next(([*scores.labels] for scores in run.photographs.values()), [])


def _read(folder: Path) -> RunSummary:
    """Read the settings and scores in a folder."""
    if is_finished(folder):
        return _read_run(folder)
    path = folder.absolute()
    # The last two parts of the path are the name of a network without a run.
    name = str(Path(*path.parts[-2:]))
    settings: dict[str, Any] = {"network": str(path)}
    if (folder / SUMMARY).is_file():
        summary = read_json(folder / SUMMARY)
        if "task" in summary:
            fault = f"{folder} has scores of {summary['task']}"
            raise InputError(f"{fault}: give pnb-compare and pnb-report those of classifiers")
        # pnb-evaluate wrote it. The folder lies in its parent as scores lie in the folder of a run.
        scores = {path.name: StoredScores.read(summary)}
        return RunSummary(path.parent, name, settings, scores, accuracy=None)
    if (folder / PUBLISHED).is_file():
        # This import is here because it imports torch, which other results do not need.
        from train.checkpoints import load_selected

        state = load_selected(folder)[1]
        stored = state.get("scores", {})
        # Its training, or else its thresholds, tell the positive classes.
        of_points = [point["label"] for point in state.get("operating_point", ())]
        label = state.get("settings", {}).get("label") or of_points
        if label:
            settings["label"] = label
        # Scores on photographs are mappings. Others are numbers.
        scores = {key: StoredScores.read(of) for key, of in stored.items() if isinstance(of, dict)}
        # The accuracy is None for a network that was not scored on test images.
        return RunSummary(folder, name, settings, scores, stored.get("test/accuracy"))
    advice = "let its run finish or resume it, or give another folder"
    raise InputError(f"{folder} holds no finished run: {advice}")


def _read_run(folder: Path) -> RunSummary:
    """Read a finished run; `before` is None if it began with random weights."""
    # Each line of metrics.jsonl is an epoch. The last line has the final scores.
    *epochs, scores = read_metrics(folder)
    config = read_config(folder / CONFIG)
    before = None
    if "test/accuracy_before" in scores:
        path = folder / BEFORE
        # The settings that determine the network before all training.
        original = run_folder.find_original(folder, config.network)
        config_of_network = read_config(original.with_name(CONFIG)) if original else config
        keys = ("network", "weights", "classes", "normalization", "normalize_light", "size")
        settings = {key: OmegaConf.select(config_of_network, key) for key in keys}
        accuracy = scores["test/accuracy_before"]
        before = RunSummary(path, INITIAL, settings, read_summaries(path), accuracy)
    settings = run_config.decisive_settings(config)
    photographs = read_summaries(folder)
    accuracy = scores["test/accuracy"]
    facts = int(config.seed), config, epochs, scores, before
    return RunSummary(folder, str(config.augment.mode), settings, photographs, accuracy, *facts)


def read_summaries(folder: Path) -> dict[str, StoredScores]:
    """Read the scores of a classifier on photographs in all sub-folders of a folder."""
    found = {path.parent.name: read_json(path) for path in sorted(folder.glob(f"*/{SUMMARY}"))}
    # Scores of a detector tell their task.
    return {name: StoredScores.read(item) for name, item in found.items() if "task" not in item}


def varied_settings(runs: Sequence[RunSummary]) -> dict[str, str]:
    """Find the settings in which runs differ, with their names in words.

    The kind of renders and the seed are left out, because tables always show them.
    """
    keys = {key for run in runs for key in run.settings} - {"augment.mode", "seed"}
    return {
        # "train.learning_rate" becomes "learning rate".
        key: re.sub(r"^(augment|train|scene|renderer|evaluate)\.|[._]", " ", key).strip()
        for key in sorted(keys)
        if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs)
    }


def group_by_method(runs: Sequence[RunSummary]) -> Methods:
    """Group runs that differ only in the seed, and name each group.

    The networks with whose weights runs began come first, each once. Many varied settings in a name
    become a number.
    """
    # Initial networks with the same settings are one network, which has the scores of all, once for
    # the same images. Those of later runs are named by the absolute path of their folder.
    initial: dict[str, RunSummary] = {}
    for before in filter(None, (run.before for run in runs)):
        first = initial.setdefault(repr(before.settings), before)
        known = {scores.images for scores in first.photographs.values()}
        more = {
            str(before.folder.absolute() / name): scores
            for name, scores in before.photographs.items()
            if scores.images not in known
        }
        initial[repr(before.settings)] = replace(first, photographs={**first.photographs, **more})
    # The key of a group is the text of the settings without the seed.
    groups: dict[str, list[RunSummary]] = {}
    for run in (*initial.values(), *runs):
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    # Runs of a group differ only in their seed. The first one stands for all.
    heads = [group[0] for group in groups.values()]
    if len(heads) == 2 and heads[0].mode == INITIAL and heads[1].mode != "none":
        # One network, before and after it was trained with renders.
        return dict(zip((BEFORE_HARDENING, AFTER_HARDENING), groups.values(), strict=True))
    named: dict[str, list[RunSummary]] = {}
    for number, group in enumerate(groups.values(), 1):
        head = group[0]
        # Settings in which the groups with the same kind of renders differ.
        varied = varied_settings([other for other in heads if other.mode == head.mode])
        values = [f"{words}={head.settings.get(key)}" for key, words in varied.items()]
        name = ", ".join([head.mode, *values])
        if len(name) > LONGEST_NAME or name in named:
            name = f"{number}: {head.mode}"
        named[name] = group
    return named


# Row of a table about an example that is attacked: its number, the true classes of its views, the
# predicted classes before and after the attack, such as "81.0% orange, 55.3% lemon", and the
# outcome, such as "success in 12 steps".
ExampleRow = tuple[int, str, str, str, str]


def _example_row(line: Mapping[str, Any]) -> ExampleRow:
    """Make the row of an example from its line of attack.jsonl."""
    views = []
    for end in ("_before", ""):
        pairs = zip(line[f"predicted{end}"], line[f"confidence{end}"], strict=True)
        # The predicted class of each view.
        views.append(", ".join(f"{probability:.1%} {name}" for name, probability in pairs))
    outcome = "success only without noise" if line["success_without_noise"] else "no success"
    outcome = f"{'success' if line['success'] else outcome} in {int(line['steps'])} steps"
    if line["success_before"]:
        outcome = "wrong before any step"
    # The dictionary removes the class of a view if an earlier view has the same class.
    label = ", ".join(dict.fromkeys(map(str, line["label"])))
    before, after = views
    return int(line["example"]), label, before, after, outcome


@dataclass(frozen=True)
class AttackSummary:
    """Outcome of an attack, read from its folder.

    Attributes:
        folder: Folder of the attack.
        rows: A row for each attacked example.
        successes: Number of examples that are misclassified after the attack, in
            images with the simulated noise of a sensor.
        without_noise: Number of examples that are misclassified after the attack
            in images without noise.
        correct: Number of examples that are classified correctly before the
            attack. Only these can count as successes.
        checks: Results of `nb.check` by name.
    """

    folder: Path
    rows: Sequence[ExampleRow]
    successes: int
    without_noise: int
    correct: int
    checks: Mapping[str, Any]


def read_attack(folder: Path) -> AttackSummary:
    """Read the outcome of an attack from its folder."""
    path = folder / LINES
    # A file with other contents than expected raises errors of many types.
    fault = f"{path} is damaged or was written by no attack"
    with explained(fault, "use the folder of another attack"):
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        # A line has the key "example" or, if it is about the whole attack, "checks".
        examples = [line for line in lines if "example" in line]
        if len({line["example"] for line in examples}) < len(examples):
            raise ValueError("it has an example twice")
        # Examples that were classified correctly before the attack.
        correct = [line for line in examples if not line["success_before"]]
        checks = next((dict(line["checks"]) for line in lines if "checks" in line), {})
        successes = sum(bool(line["success"]) for line in correct)
        without_noise = sum(bool(line["success_without_noise"]) for line in correct)
        rows = [*map(_example_row, examples)]
        return AttackSummary(folder, rows, successes, without_noise, len(correct), checks)


class Unfinished(NamedTuple):
    """A run that is not finished, or a folder that cannot be read.

    Attributes:
        folder: The folder.
        state: State of the run in words, or why the folder cannot be read.
        epoch_count: Number of finished epochs.
    """

    folder: Path
    state: str
    epoch_count: int


@dataclass(frozen=True)
class Findings:
    """Runs and attacks that were found in folders.

    Attributes:
        runs: Networks without a run, and then finished runs, those without
            renders first. Tables compare all others with the first one.
        attacks: Attacks.
        unfinished: Runs that are not finished, and folders that cannot be read.
    """

    runs: list[RunSummary] = field(default_factory=list)
    attacks: list[AttackSummary] = field(default_factory=list)
    unfinished: list[Unfinished] = field(default_factory=list)


def find(folders: Sequence[Path]) -> Findings:
    """Find the runs and attacks in folders and in all folders below them."""
    # A dictionary has each folder once.
    paths: dict[Path, Path] = {}
    for folder in map(published_folder, folders):
        if not folder.is_dir():
            raise InputError(f"runs: {folder} is not a folder: give folders of runs or of attacks")
        for path in _walk(folder):
            paths.setdefault(path.resolve(), path)
    if not paths:
        names = ", ".join(map(str, folders))
        raise InputError(f"runs: {names} holds no run and no attack: give other folders")
    found = Findings()
    for path in paths.values():
        try:
            if (path / LINES).is_file():
                found.attacks.append(read_attack(path))
            elif is_finished(path) or any((path / name).is_file() for name in FILES_OF_NETWORK):
                found.runs.append(summarize(path))
            else:
                epoch_count = len(read_metrics(path))
                found.unfinished.append(Unfinished(path, run_folder.state(path), epoch_count))
        except (InputError, OSError) as error:
            # OSError is raised if the folder belongs to another user.
            found.unfinished.append(Unfinished(path, f"cannot be read: {error}", 0))
    # Runs follow in the order of `MODES`. Runs of any other mode come first.
    order = {mode: number for number, mode in enumerate(MODES)}
    found.runs.sort(key=lambda run: order.get(run.mode, -1))
    return replace(found, runs=_without_repetitions(found.runs))


def _without_repetitions(runs: Iterable[RunSummary]) -> list[RunSummary]:
    """Leave out repetitions and copies of runs, which would make intervals over seeds too narrow.

    A repetition has the settings, the seed and the scores of another run.
    """
    kept: list[RunSummary] = []
    for run in runs:
        result = run.settings, run.scores, run.photographs
        same = [one for one in kept if (one.settings, one.scores, one.photographs) == result]
        if same and run.seed is not None:
            console.warning("left out: %s (repeats %s)", run.folder, same[0].folder)
        else:
            kept.append(run)
    return kept


def finished_runs(folders: Sequence[Path]) -> list[RunSummary]:
    """Read the finished runs in folders and below them, and warn about the others."""
    # Networks that were scored into sub-folders of one folder differ only in the mode: their names.
    runs: dict[tuple[Path, str], RunSummary] = {}
    for folder in folders:
        found = find([folder])
        if not found.runs:
            state = found.unfinished[0].state if found.unfinished else ""
            if state.startswith("cannot be read: "):
                raise InputError(f"runs: {state.partition(': ')[2]}")
            reasons = [f" ({run.folder}: {run.state})" for run in found.unfinished]
            fault = f"runs: {folder} holds no finished run{''.join(reasons[:1])}"
            raise InputError(f"{fault}: finish or resume it, or give another folder")
        for first in found.unfinished[:1]:
            left_out = f"{len(found.unfinished)} unfinished of {folder}"
            console.warning("left out: %s (%s: %s)", left_out, first.folder, first.state)
        for summary in found.runs:
            # A run that is in several folders counts once.
            runs.setdefault((summary.folder.resolve(), summary.mode), summary)
    return _without_repetitions(runs.values())


def _walk(folder: Path) -> Iterator[Path]:
    """Yield a folder and those below with a run, an attack or scores, except scores of a run."""
    for root, subfolders, file_names in os.walk(folder):
        path = Path(root)
        names = set(file_names)
        subfolders.sort()
        is_run = bool(names & FILES_OF_RUN)
        if is_run:
            scored = {name for name in subfolders if (path / name / SUMMARY).is_file()}
            # os.walk continues with the folders that stay in this list.
            subfolders[:] = [name for name in subfolders if name not in {BEFORE, *scored}]
        # A run that has not finished an epoch has only a configuration and a log.
        if is_run or names & {LINES, *FILES_OF_NETWORK} or {CONFIG, "train.log"} <= names:
            yield path
