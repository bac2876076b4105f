"""A page of runs and attacks, report.html, which loads nothing else."""

import shlex
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import OmegaConf

from augment.progress import announced
from augment.settings import ARMS
from renderer.errors import InputError
from renderer.io.files import write_whole
from train.evaluation.scores.metrics import metric_title
from train.evaluation.scores.scoring import CONTACT_SHEET
from train.evaluation.scores.sheet import evenly
from train.evaluation.tables import Table, as_text, format_fraction, format_interval, fraction
from train.report import comparison as compare
from train.report import plots, summary
from train.report.plots import Picture
from train.report.summary import Arms, RunSummary, Scored
from train.runs.epoch_metrics import attack_success
from train.runs.run_config import CONFIG, read_config
from train.system.user_errors import one_sentence

PAGE = "report.html"
MOST_ARMS, MOST_SEEDS = 6, 5  # in plots and comparisons
MOST_UNFINISHED, MOST_ATTACKS = 3, 12  # unfinished runs in plots, attacks with images
ATTACK_EXAMPLES = 4  # with images of an attack
GRID, SHEET = (
    720,
    1100,
)  # pixels: the widest grid of renders, and the widest image of an attack or contact sheet
HEADLINES = ("auc", "recall_at/0.10", "false_positive_rate")  # of METRICS, in the first sentences
CURVES = {"train/accuracy": "training accuracy", "validation/accuracy": "validation accuracy"}


@announced("report")
def write_report(folders: Sequence[Path], out: Path) -> Path:
    """Write the page of the runs and attacks in folders and below them.

    Args:
        folders: Folders of runs and attacks, or folders that hold them.
        out: Folder that report.html is written to.

    Returns:
        Path of the page. A run or attack that cannot be read is named on it.

    Raises:
        InputError: As of `summary.find`.
    """
    found = summary.find(folders)
    arms = summary.arms_of(found.runs)
    drawn = {name: runs[:MOST_SEEDS] for name, runs in islice(arms.items(), MOST_ARMS)}
    trained = {arm: group[0] for arm, group in drawn.items() if group[0].epochs}
    title = "Attacks" if found.attacks else "Unfinished runs"
    groups = summary.by_images(drawn)
    return write_page(
        out,
        "runs.html.jinja",
        about=_about(found, folders),
        arms=arms,
        title=_title(arms) if arms else title,
        lead=_accuracy_sentences(arms),
        tables=[table for table in summary.run_tables(arms, {}) if table.rows],
        captions=ARMS,
        unfinished=[[str(run.folder), run.state, len(run.epochs)] for run in found.unfinished],
        curves=_curves(_drawn_epochs(drawn, found.unfinished)),
        seconds=summary.seconds_table(drawn),
        photographs=[scores_section(title, group) for title, group in groups.items()],
        renders={arm: _pictures(run, "epoch", "Renders") for arm, run in trained.items()},
        examples={arm: _pictures(run, "attacks", "Renders before and after") for arm, run in trained.items()},
        attacks=found.attacks,
        shown=[_attack(attack) for attack in found.attacks[:MOST_ATTACKS]],
    )


def _about(found: summary.Findings, folders: Sequence[Path]) -> str:
    """Say how much of what is on the page, and where and when it was written."""
    parts = []
    if found.runs:
        plural = "s" if len(found.runs) != 1 else ""
        parts.append(f"{len(found.runs)} network{plural}")
    if found.unfinished:
        parts.append(f"{len(found.unfinished)} unfinished or unreadable")
    if found.attacks:
        parts.append(f"{len(found.attacks)} attacks")
    place = ", ".join(map(str, folders))
    read = [run.folder for run in found.runs]
    read += [attack.folder for attack in found.attacks]
    files = [file for folder in read for file in folder.iterdir() if file.name != PAGE]
    if files:
        newest = max(file.stat().st_mtime for file in files)
        place += f", {datetime.fromtimestamp(newest):%Y-%m-%d %H:%M}"
    return f"{', '.join(parts)}; in {place}"


# The lines of the epochs of each run of each arm.
Epochs = Mapping[str, Sequence[Sequence[Mapping[str, float]]]]


def _drawn_epochs(drawn: Arms, unfinished: Sequence[summary.Unfinished]) -> Epochs:
    """Return the epochs that plots show, those of some unfinished runs, too."""
    epochs = {arm: [run.epochs for run in group] for arm, group in drawn.items()}
    begun = [run for run in unfinished if run.epochs]
    for run in begun[:MOST_UNFINISHED]:
        epochs[f"unfinished: {run.folder.name[-24:]}"] = [run.epochs]
    return epochs


def write_page(out: Path, body: str, **content: Any) -> Path:
    """Write report.html into a folder: a template's sections in the page that all share. content: of the template, with
    the page's `title`, and `about`, the line beneath it."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    options: dict[str, Any] = {"autoescape": True, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=PackageLoader("train.report", "."), undefined=StrictUndefined, **options)
    environment.filters |= {"as_text": as_text, "yaml": OmegaConf.to_yaml, "command": _command}
    environment.filters |= {
        "fraction": fraction,
        "hits": format_fraction,
        "interval": format_interval,
    }
    page = environment.get_template("page.html.jinja").render(body=body, **content)
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / PAGE, page)
    return out / PAGE


def report_of(folders: Sequence[Path], out: Path) -> str:
    """The last line of a training: the path of its report, or why there is none, since a report never fails a run."""
    try:
        return f"report: {write_report(folders, out)}"
    except Exception as error:  # the run is finished and saved
        return f"no report: {one_sentence(error) or traceback.format_exc()}"


def _command(config: Mapping[str, Any]) -> str:
    """The command of a run or an attack, in the folder that it was given in; "" where that is not recorded."""
    folder, command = config.get("working_folder"), config.get("command") or ""
    return f"cd {shlex.quote(folder)}\n{command}" if folder and command else command


def _curves(arms: Epochs) -> list[Picture]:
    """Draw accuracies by epoch, and the success of attacks by round of renders."""
    pictures = []
    for name, title in CURVES.items():
        lines = {}
        for arm, runs in arms.items():
            lines[arm] = [[(line["epoch"], line.get(name)) for line in run] for run in runs]
        pictures.append(plots.curves(lines, title))
    rates = {}
    for arm, runs in arms.items():
        rates[arm] = [[*enumerate(_attacks_by_round(run), 1)] for run in runs]
    title = "attack success on clean-correct renders"
    pictures.append(plots.curves(rates, title, "round of renders"))
    return [picture for picture in pictures if picture]


def _attacks_by_round(epochs: Sequence[Mapping[str, float]]) -> list[float | None]:
    """The attack's success in each round of renders of a run, or in each epoch of one with a round per epoch."""
    rates = []
    for line in epochs:
        rounds = sorted({int(name[6 : name.index("/")]) for name in line if name.startswith("round_")})
        rates += [attack_success(line, f"round_{number}/") for number in rounds] or [attack_success(line, "augment/")]
    return rates


def _pictures(run: RunSummary, name: str, title: str) -> list[Picture]:
    """A run's images renders/NAME_EPOCH.png of its first, middle and last epoch with any."""
    numbers = [(path.stem.rpartition("_")[2], path) for path in (run.folder / "renders").glob(f"{name}_*.png")]
    files = evenly(sorted((int(number), path) for number, path in numbers if number.isdigit()), 3)
    images = [plots.from_file(path, f"{title}, epoch {n}, {run.arm}", GRID, f"epoch {n}") for n, path in files]
    return [image for pictures in images for image in pictures]


def _title(arms: Arms) -> str:
    evaluations = [scores for group in arms.values() for scores in group[0].photographs.values()]
    labels = {label for scores in evaluations for label in scores.labels}
    names = [arm for arm, group in arms.items() if group[0].arm != summary.INITIAL]
    return f"{' and '.join(sorted(labels)) or 'Networks'}, trained with renders: {', '.join(names)}"


def _accuracy_sentences(arms: Arms) -> list[str]:
    """How the test accuracy of each arm compares with that of the network that it began with."""
    sentences = []
    for arm, group in arms.items():
        if bases := [run.before.accuracy for run in group if run.before and run.before.accuracy is not None]:
            after, before = fmean(run.scores["test/accuracy"] for run in group), fmean(bases)
            images = group[0].config.get("test_images", "the test images")
            sentences.append(f"{arm}: accuracy went from {before:.1%} to {after:.1%}, on {images}.")
    return sentences


def scores_section(title: str, group: Scored) -> dict[str, Any]:
    """Collect what the page shows of scores on the same images.

    Args:
        title: Title of the images.
        group: Scored runs of each arm, as `summary.by_images` groups them.

    Returns:
        Values of the template: plots, tables, sentences, and a contact sheet of
        each arm.
    """
    sheets = {}
    for arm, (first, *_) in group.items():
        alt = f"predictions of {arm} on {title}"
        sheets[arm] = plots.from_file(first.folder / CONTACT_SHEET, alt, SHEET)
    tables = [summary.score_table("", group)]
    rocs: list[Picture | None] = []
    sentences: list[str] = []
    try:
        evaluations = compare.read_evaluations(group)
        if evaluations:
            rocs = _rocs(evaluations)
            sentences = _difference_sentences(evaluations, title)
            tables += _evaluation_tables(evaluations)
    except InputError as error:
        sentences = [str(error)]
    return {
        "name": title,
        "sheets": sheets,
        "rocs": rocs,
        "tables": [table.known for table in tables],
        "sentences": sentences,
    }


def _rocs(arms: compare.Evaluations) -> list[Picture | None]:
    """Draw the ROC curves of all images and, with several labels, of each label."""
    first = next(iter(arms.values()))[0]
    pictures = []
    for part, pool in first.pools.items():
        if part.is_overall:
            scores = {arm: [run.pools[part].scores for run in runs] for arm, runs in arms.items()}
            pictures.append(plots.roc(scores, pool.label))
    return pictures


def _evaluation_tables(arms: compare.Evaluations) -> list[Table]:
    """Make the tables of differences and, if there are any, of labels and sources."""
    tables = [compare.overall_differences(arms)]
    first = next(iter(arms.values()))[0]
    if len(first.pools) > 1:
        tables.append(compare.group_table(arms))
    return tables


def _difference_sentences(arms: compare.Evaluations, images: str) -> list[str]:
    """Say how far each of HEADLINES is from that of the network that an arm is compared with."""
    sentences = []
    for arm, base in compare.pairs_of(arms):
        parts = []
        for name in HEADLINES:
            result = compare.difference(arms[arm], arms[base], compare.ALL, name)
            if result is not None:
                parts.append(f"{metric_title(name)} {_compared(result)}")
        if parts:
            sentences.append(f"{images}, {base} and {arm}: {'; '.join(parts)}.")
    return sentences


def _compared(result: compare.Difference) -> str:
    """Write both means and, if the interval does not hold zero, their difference."""
    assert result.low is not None and result.high is not None
    text = format_interval(result, sign="+")
    if result.low <= 0 <= result.high:
        text = "no difference is shown"
    return f"{result.before:.2f} and {result.after:.2f} ({text})"


def _attack(attack: summary.AttackSummary) -> dict[str, Any]:
    """Collect what the page shows of an attack: examples, images, checks and configuration."""
    images = {}
    for row in evenly(attack.rows, ATTACK_EXAMPLES):
        title = f"Example {row.number}, {row.label}: {row.outcome}"
        alt = f"{title}; before, after, their difference and the lights; "
        alt += f"predicted {row.before}, then {row.after}"
        path = attack.folder / f"example_{row.number:03d}.png"
        images[title] = plots.from_file(path, alt, SHEET)
    config: Mapping[str, Any] = {}
    with suppress(InputError):
        config = read_config(attack.folder.parent / CONFIG)
    checks = []
    for name, value in attack.checks.items():
        if not isinstance(value, dict):
            checks.append((name.replace("_", " "), value))
    return {
        "folder": attack.folder,
        "rows": attack.rows,
        "checks": checks,
        "images": images,
        "config": config,
    }
