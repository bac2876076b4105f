"""A page of runs and attacks, report.html, which loads nothing else."""

import os
import re
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import OmegaConf
from PIL import Image, ImageDraw

from renderer.errors import InputError
from train.attack_examples import SUFFIX, Side, read_attack_examples
from train.errors import one_sentence
from train.loop import attack_success
from train.photographs.metrics import METRICS, OVERALL, find_metric, metric_title
from train.photographs.sheet import evenly
from train.report import compare, plots
from train.report.plots import Picture
from train.report.summary import (
    Arms,
    AttackSummary,
    Findings,
    RunSummary,
    arms_of,
    by_images,
    find,
    pairs_of,
    run_table,
    run_tables,
    seconds_table,
)
from train.run_folder import BEFORE, CONFIG, read_config
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
}
ROUNDS = "attack success on clean-correct renders"


def write_report(folders: Sequence[Path], out: Path) -> Path:
    """Write the page of the runs and attacks in folders and below them, and return its path.

    A run or attack that cannot be read is named on the page. InputError as of `find`.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    findings = find(folders)
    arms = arms_of(findings.runs)
    drawn = {name: runs[:MOST_SEEDS] for name, runs in islice(arms.items(), MOST_ARMS)}
    photographs = [_photographs(title, group) for title, group in by_images(drawn).items()]
    loader = PackageLoader("train.report", ".")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"as_text": as_text, "yaml": OmegaConf.to_yaml}
    page = environment.get_template("page.html.jinja").render(
        arms=arms,
        findings=findings,
        **_about(folders, arms, findings),
        lead=[*_accuracy_sentences(arms), _attack_sentence(findings.attacks)],
        tables=[table for table in run_tables(arms, photographs=False) if table.rows],
        unfinished=[[str(folder), state, len(epochs)] for folder, state, epochs in findings.unfinished],
        curves=_curves(drawn, findings),
        seconds=seconds_table(drawn),
        photographs=photographs,
        renders={arm: _renders(group[0]) for arm, group in drawn.items() if group[0].epochs},
        examples={arm: _attack_examples(group[0]) for arm, group in drawn.items() if group[0].epochs},
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
    rounds = {arm: [[*enumerate(_attacks_by_round(lines), 1)] for lines in seeds] for arm, seeds in epochs.items()}
    rates = {
        arm: [([n for n, value in line if value is not None], [v for _, v in line if v is not None]) for line in lines]
        for arm, lines in rounds.items()
    }
    pictures.append(plots.curves(rates, ROUNDS, "round of renders"))
    return [picture for picture in pictures if picture]


def _attacks_by_round(epochs: Sequence[Mapping[str, float]]) -> list[float | None]:
    """The attack's success in each round of renders of a run, or in each epoch of one with a round per epoch."""
    rates = []
    for line in epochs:
        rounds = sorted({int(name[6 : name.index("/")]) for name in line if name.startswith("round_")})
        for prefix in [f"round_{number}/" for number in rounds] or ["augment/"]:
            rates.append(attack_success(line, prefix))
    return rates


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
    pair = Image.new("RGBA", (plots.SMALL + plots.GAP + sphere.width, plots.SMALL))  # transparent, also around the ball
    pair.paste(image.resize((plots.SMALL, plots.SMALL), Image.Resampling.NEAREST))
    ball = Image.new("L", (4 * sphere.width, 4 * sphere.height))
    ImageDraw.Draw(ball).ellipse((0, 0, *ball.size), 255)
    place = plots.SMALL + plots.GAP, (plots.SMALL - sphere.height) // 2
    pair.paste(sphere, place, ball.resize(sphere.size, Image.Resampling.BOX))
    predicted = f"{side.confidence:.0%} {side.predicted}"
    return plots.encoded(pair, f"{label} {when}: {predicted}; a ball in its light", f"{when}: {predicted}")


def _about(folders: Sequence[Path], arms: Arms, findings: Findings) -> dict[str, str]:
    """The page's title, of what it is, and where and when that was made."""
    labels = " and ".join(dict.fromkeys(group[0].label for group in arms.values() if group[0].label))
    paths = [item.folder for part in (findings.runs, findings.attacks) for item in part]
    last = max((file.stat().st_mtime for path in paths for file in path.iterdir() if file.name != PAGE), default=None)
    names = [arm for arm, group in arms.items() if group[0].arm != BEFORE]
    subject = f"{labels}: {', '.join(names)}" if arms else "Attacks" if findings.attacks else "Unfinished runs"
    date = f"{datetime.fromtimestamp(last):%Y-%m-%d %H:%M}" if last else ""
    return {"title": subject, "place": ", ".join(map(str, folders)), "date": date}


def _accuracy_sentences(arms: Arms) -> list[str]:
    """How the test accuracy of each arm compares with that of the network that it began with."""
    sentences = []
    for arm, group in arms.items():
        bases = [run.before.accuracy for run in group if run.before and run.before.accuracy is not None]
        if bases:
            after, before = fmean(run.scores["test/accuracy"] for run in group), fmean(bases)
            verb = "rose" if after > before else "fell" if after < before else "stayed"
            sentences.append(f"{arm}: test accuracy {verb} from {before:.1%} to {after:.1%}.")
    return sentences


def _photographs(title: str, group: Mapping[str, Sequence[tuple[RunSummary, str]]]) -> dict[str, Any]:
    """What the page shows of the scores on the same images: plots, tables, and a contact sheet of each arm."""
    scored = {
        arm: [(run.seed, [run.metric(name, metric) for metric in METRICS]) for run, name in runs]
        for arm, runs in group.items()
    }
    content: dict[str, Any] = {
        "name": title,
        "sheets": {
            arm: plots.from_file(run.folder / name / "contact_sheet.png", f"predictions of {arm} on {title}", SHEET)
            for arm, ((run, name), *_) in group.items()
        },
        "roc": None,
        "tables": [run_table("", [*map(metric_title, METRICS)], scored)],
        "sentences": [],
    }
    try:
        evaluations = compare.read_evaluations(group)
        if not evaluations:
            return content
        scores = {arm: [run.pools[OVERALL].scores for run in runs] for arm, runs in evaluations.items()}
        content["roc"] = plots.roc(scores, next(iter(evaluations.values()))[0].label)
        content["sentences"] = _difference_sentences(evaluations, title)
        sources = len(next(iter(evaluations.values()))[0].pools) > 1
        content["tables"].append(compare.overall_differences(evaluations))
        if sources:
            content["tables"].append(compare.source_table(evaluations))
    except InputError as error:
        content["sentences"] = [str(error)]
    return content


def _difference_sentences(arms: compare.Evaluations, images: str) -> list[str]:
    """How far recall at a fixed false positive rate is from that of the arm that an arm is compared with."""
    sentences = []
    for arm, base in pairs_of({arm: [evaluation.run for evaluation in group] for arm, group in arms.items()}):
        result = compare.difference(arms[arm], arms[base], OVERALL, HEADLINE)
        if result:
            means = [
                fmean(find_metric(run.metrics[OVERALL], HEADLINE)["value"] for run in arms[a]) for a in (base, arm)
            ]
            surely = result["low"] > 0 or result["high"] < 0
            sentences.append(
                f"{images}: {metric_title(HEADLINE)} is {means[0]:.2f} with {base} and {means[1]:.2f} with {arm}. "
                f"The difference is {compare.format_difference(result)}"
                f"{'' if surely else ', so that no difference is shown'}."
            )
    return sentences


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
    checks = {name.replace("_", " "): value for name, value in attack.checks.items() if not isinstance(value, dict)}
    return {"folder": attack.folder, "images": images, "rows": attack.rows, "checks": checks, "config": config}
