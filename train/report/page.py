"""A page of runs and attacks, report.html, which loads nothing else."""

import os
import re
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from PIL import Image

from renderer.errors import InputError
from train.attack_examples import SUFFIX, Side, read_attack_examples
from train.errors import one_sentence
from train.photographs.metrics import OVERALL, metric_title
from train.photographs.sheet import evenly
from train.report import compare, plots
from train.report.plots import Picture
from train.report.summary import Arms, AttackSummary, Findings, RunSummary, arms_of, find, run_tables, seconds_table
from train.run_folder import CONFIG, read_config
from train.tables import as_text

PAGE = "report.html"
MOST_ARMS, MOST_SEEDS = 6, 5  # in plots and comparisons
MOST_UNFINISHED, MOST_ATTACKS = 3, 12  # unfinished runs in plots, attacks with images
ATTACK_EXAMPLES = 4  # with images of an attack
GRID, SHEET = 720, 1100  # pixels: the widest grid of renders, and the widest image of an attack or contact sheet
HEADLINE = "recall_at/0.10"  # of METRICS, in the first sentence
CURVES = {
    "train/accuracy": "training accuracy",
    "validation/accuracy": "validation accuracy",
    "augment/attack_success": "attack success rate",
    "augment/steps": "steps of the attack",
}


def write_report(folders: Sequence[Path], out: Path) -> Path:
    """Write the page of the runs and attacks in folders and below them, and return its path.

    A run or attack that cannot be read is named on the page. InputError as of `find`.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    findings = find(folders)
    arms = arms_of(findings.runs)
    drawn = {name: runs[:MOST_SEEDS] for name, runs in islice(arms.items(), MOST_ARMS)}
    folders_scored = sorted({name for group in drawn.values() for run in group for name in run.photographs})
    loader = PackageLoader("train.report", ".")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"as_text": as_text, "yaml": OmegaConf.to_yaml}
    page = environment.get_template("page.html.jinja").render(
        arms=arms,
        findings=findings,
        lead=_attack_sentence(findings.attacks),
        tables=run_tables(arms),
        unfinished=[[str(folder), state, len(epochs)] for folder, state, epochs in findings.unfinished],
        curves=_curves(drawn, findings),
        seconds=seconds_table(drawn),
        photographs=[_photographs(drawn, name) for name in folders_scored],
        renders={arm: _renders(group[0]) for arm, group in drawn.items()},
        examples={arm: _attack_examples(group[0]) for arm, group in drawn.items()},
        attacks=[_attack(attack) for attack in findings.attacks[:MOST_ATTACKS]],
        further=findings.attacks[MOST_ATTACKS:],
    )
    page = re.sub(rf"(?<![\w./-]){re.escape(os.getcwd())}/", "", page)  # paths are relative, as in commands
    out.mkdir(parents=True, exist_ok=True)
    (out / PAGE).write_text(page, encoding="utf-8", errors="replace")
    return out / PAGE


def report_of(folders: Sequence[Path], out: Path) -> str:
    """The last line of a training: the path of its report, or why there is none, since a report never fails a run."""
    try:
        return f"report: {write_report(folders, out)}"
    except Exception as error:  # the run is finished and saved
        return f"no report: {one_sentence(error) or traceback.format_exc()}"


def _curves(arms: Arms, findings: Findings) -> list[Picture]:
    epochs = {arm: [run.epochs for run in group] for arm, group in arms.items()}
    for folder, _, lines in [run for run in findings.unfinished if run[2]][:MOST_UNFINISHED]:
        epochs[f"unfinished: {folder.name[-24:]}"] = [lines]
    pictures = []
    for name, title in CURVES.items():
        known = {arm: [[line for line in lines if name in line] for lines in seeds] for arm, seeds in epochs.items()}
        series = {
            arm: [([line["epoch"] for line in lines], [line[name] for line in lines]) for lines in seeds]
            for arm, seeds in known.items()
        }
        pictures.append(plots.curves(series, title))
    return [picture for picture in pictures if picture]


def _first_middle_last(run: RunSummary, suffix: str) -> list[tuple[int, Path]]:
    """Of a run's files renders/epoch_NUMBER with a suffix, three with their numbers."""
    numbers = [(path.stem.removeprefix("epoch_"), path) for path in (run.folder / "renders").glob(f"epoch_*{suffix}")]
    return evenly(sorted((int(number), path) for number, path in numbers if number.isdigit()), 3)


def _renders(run: RunSummary) -> list[Picture]:
    files = _first_middle_last(run, ".png")
    images = [plots.from_file(path, f"Renders of epoch {n}, {run.arm}", GRID, f"epoch {n}") for n, path in files]
    return [image for pictures in images for image in pictures]


def _attack_examples(run: RunSummary) -> dict[int, list[Picture]]:
    """The examples of the first, middle and last epoch with any, before and after their attacks, by epoch."""
    pictures = {}
    for epoch, path in _first_middle_last(run, SUFFIX):
        with suppress(InputError):
            rows = read_attack_examples(path)
            pictures[epoch] = [
                _side(label, *side) for label, *sides in rows for side in zip(("before", "after"), sides, strict=True)
            ]
    return pictures


def _side(label: str, when: str, side: Side) -> Picture:
    image, sphere = (Image.fromarray(pixels.permute(1, 2, 0).numpy()) for pixels in (side.image, side.sphere))
    pair = Image.new("RGB", (plots.SMALL + sphere.width, plots.SMALL), "white")
    pair.paste(image.resize((plots.SMALL, plots.SMALL), Image.Resampling.NEAREST))
    pair.paste(sphere, (plots.SMALL, (plots.SMALL - sphere.height) // 2))
    predicted = f"{side.confidence:.0%} {side.predicted}"
    return plots.encoded(pair, f"{label} {when}: {predicted}; a ball in its light", f"{when}: {predicted}")


def _photographs(arms: Arms, name: str) -> dict[str, Any]:
    """What the page shows of the photographs `name`: plots, tables, and the contact sheet of each arm's first run."""
    runs = {arm: [run for run in group if name in run.photographs] for arm, group in arms.items()}
    first = next(run for group in runs.values() for run in group)
    rendered = OmegaConf.select(first.config, "data.images")
    images = "held-out renders" if rendered and OmegaConf.select(first.config, "evaluate.photos") == rendered else name
    metrics = {
        metric_title(metric): {
            arm: compare.mean_metric(run.metric(name, metric) for run in group) for arm, group in runs.items()
        }
        for metric in ("recall", "false_positive_rate", "auc")
    }
    sheets = {arm: group[0].folder / name / "contact_sheet.png" for arm, group in runs.items() if group}
    content: dict[str, Any] = {
        "name": images,
        "bars": plots.bars(metrics, f"{first.label} on {images}"),
        "sheets": {arm: plots.from_file(path, f"{name}, predictions of {arm}", SHEET) for arm, path in sheets.items()},
        "roc": None,
        "tables": [],
        "sentence": "",
    }
    try:
        evaluations = {arm: [compare.read_evaluation(run, name) for run in group] for arm, group in runs.items()}
        scores = {arm: [run.pools[OVERALL].scores for run in group] for arm, group in evaluations.items()}
        evaluations = {arm: group for arm, group in evaluations.items() if group}
        content |= {"roc": plots.roc(scores, first.label), "tables": [compare.source_table(evaluations, "all")]}
        compare.require_comparable(evaluations, name)
        content["tables"] += compare.difference_tables(evaluations, "all")
        content["sentence"] = _difference_sentence(evaluations, images)
    except InputError as error:
        content["sentence"] = str(error)
    return content


def _difference_sentence(arms: compare.Evaluations, images: str) -> str:
    """The last arm against the first in recall at a fixed false positive rate."""
    pairs = [*arms.items()]
    (reference, base), (arm, group) = pairs[0], pairs[-1]
    result = compare.difference(group, base, OVERALL, HEADLINE)
    if arm == reference or not result:
        return ""
    unsure = "" if result["low"] > 0 or result["high"] < 0 else ", so that no difference is shown"
    return (
        f"{arm} minus {reference}, {metric_title(HEADLINE)} on {images}: {compare.format_difference(result)}{unsure}."
    )


def _attack_sentence(attacks: Sequence[AttackSummary]) -> str:
    if not attacks:
        return ""
    total, correct = sum(len(attack.rows) for attack in attacks), sum(attack.correct for attack in attacks)
    sentence = f"Attacks succeed on {sum(attack.successes for attack in attacks)} of {correct} examples"
    if total > correct:
        sentence += f"; {total - correct} more were wrong before any step"
    rates = [rate for attack in attacks if isinstance(rate := attack.checks.get("random_search"), int | float)]
    if rates:
        sentence += f"; random search with as many renders succeeds on {sum(rates) / len(rates):.0%}"
    return f"{sentence}."


def _attack(attack: AttackSummary) -> dict[str, Any]:
    """An attack's images by title, numbers, and configuration, which is {} where it is missing or damaged."""
    images = {}
    for number, label, before, after, outcome in evenly(attack.rows, ATTACK_EXAMPLES):
        title = f"Example {number}, {label}: {outcome}"
        alt = f"{title}; before, after, their difference and the lights; predicted {before}, then {after}"
        images[title] = plots.from_file(attack.folder / f"example_{number:03d}.png", alt, SHEET)
    config: Mapping[str, Any] = {}
    with suppress(InputError):
        config = read_config(attack.folder.parent / CONFIG)
    checks = {name: value for name, value in attack.checks.items() if not isinstance(value, dict)}
    return {"folder": attack.folder, "images": images, "rows": attack.rows, "checks": checks, "config": config}
