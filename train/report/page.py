"""A page of runs and attacks: report.html, which loads nothing else, and report.png, its headline.

A page is a list of sections; a section has a title and blocks: sentences, tables, galleries and folded text.
"""

import base64
import os
import re
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from PIL import Image

from renderer.errors import InputError
from train.attack_examples import SUFFIX, Side, read_attack_examples
from train.errors import one_sentence
from train.photographs.metrics import OVERALL, Roc, find_metric, metric_title
from train.photographs.sheet import evenly
from train.report import plots
from train.report.command import attack_command, training_command
from train.report.compare import (
    Evaluation,
    difference,
    difference_tables,
    format_difference,
    read_evaluation,
    require_comparable,
)
from train.report.plots import Picture
from train.report.summary import (
    Arms,
    AttackSummary,
    RunSummary,
    Score,
    UnfinishedRun,
    arms_of,
    find,
    photograph_folders,
    run_tables,
    score,
    spread_tables,
    varied_settings,
)
from train.run_folder import CONFIG, PHASES, read_config
from train.settings import PHOTOGRAPHS
from train.tables import Table, as_text

PAGE, HEADLINE = "report.html", "report.png"
MOST_ARMS, MOST_SEEDS = 6, 5  # in plots and comparisons
MOST_ROWS, MOST_UNFINISHED, MOST_ATTACKS = 30, 3, 12  # rows of a table, unfinished runs in plots, attacks in sections
EXAMPLES, ATTACK_EXAMPLES = 3, 4  # in the headline, with images of an attack
GRID, SHEET = 720, 1100  # pixels: the widest grid of renders, and the widest image of an attack or contact sheet
SHOWN = ("recall", "false_positive_rate", "auc", "recall_at/0.10")  # of METRICS, by source


@dataclass(frozen=True)
class Gallery:
    """Images side by side under a title."""

    title: str
    images: Sequence[Picture]


@dataclass(frozen=True)
class Code:
    """Verbatim text, folded away under a title."""

    title: str
    text: str


Block = str | Table | Gallery | Code


@dataclass(frozen=True)
class Section:
    title: str
    blocks: Sequence[Block]


def write_report(folders: Sequence[Path], out: Path) -> Path:
    """Write the page of the runs and attacks in folders and below them, and return its path.

    A run or attack that cannot be read is named on the page. InputError as of `find`.
    """
    findings = find(folders)
    arms = arms_of(findings.runs)
    drawn = {name: runs[:MOST_SEEDS] for name, runs in islice(arms.items(), MOST_ARMS)}
    top = _headline(drawn) if drawn else None
    sections = [
        _in_short(drawn, findings.attacks, top, findings.problems),
        Section("Arms", [*_tables(arms)]),
        _unfinished(findings.unfinished),
        _epochs(drawn, findings.unfinished),
        *(section for name in photograph_folders(_all(drawn)) for section in _photographs(drawn, name)),
        Section("Renders", [_renders(arm, group[0].folder) for arm, group in drawn.items()]),
        Section("Attack examples", [*_attack_examples(drawn)]),
        _reproduction(drawn),
        *_attacks(findings.attacks),
    ]
    runs = len(findings.runs), len(findings.runs) + len(findings.unfinished)
    about = f"{runs[0]} of {runs[1]} runs finished, {len(findings.attacks)} attacks"
    out.mkdir(parents=True, exist_ok=True)
    if top:
        (out / HEADLINE).write_bytes(top.data)
    (out / PAGE).write_text(_html(sections, about), encoding="utf-8", errors="replace")
    return out / PAGE


def report_of(folders: Sequence[Path], out: Path) -> str:
    """The last line of a training: the path of its report, or why there is none, since a report never fails a run."""
    try:
        return f"report: {write_report(folders, out)}"
    except Exception as error:  # the run is finished and saved
        return f"no report: {one_sentence(error) or traceback.format_exc()}"


def _html(sections: Sequence[Section], about: str) -> str:
    """The page, without empty blocks and sections; paths below the current folder are relative, as in commands."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    sections = [Section(section.title, [*filter(_has_content, section.blocks)]) for section in sections]
    loader = PackageLoader("train.report", ".")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"as_text": as_text, "data_uri": _data_uri}
    template = environment.get_template("page.html.jinja")
    page = template.render(sections=[section for section in sections if section.blocks], about=about)
    return re.sub(rf"(?<![\w./-]){re.escape(os.getcwd())}/", "", page)


def _has_content(block: Block) -> bool:
    match block:
        case Gallery(images=content) | Table(rows=content) | Code(text=content):
            return bool(content)
    return bool(block)


def _data_uri(picture: Picture) -> str:
    kind = "svg+xml" if picture.kind == "svg" else picture.kind
    return f"data:image/{kind};base64,{base64.b64encode(picture.data).decode()}"


def _all(arms: Arms) -> list[RunSummary]:
    return [run for group in arms.values() for run in group]


# ------------------------------------------------------------------------------------- in short


def _in_short(arms: Arms, attacks: Sequence[AttackSummary], top: Picture | None, problems: Sequence[str]) -> Section:
    sentences = [*_difference_in_words(_scored(arms, name := _most_scored(arms)), name)]
    if attacks:
        total, correct = sum(len(attack.rows) for attack in attacks), sum(attack.correct for attack in attacks)
        sentence = f"Attacks succeed on {sum(attack.successes for attack in attacks)} of {correct} examples"
        if total > correct:
            sentence += f"; {total - correct} more were wrong before any step"
        rates = [rate for attack in attacks if isinstance(rate := attack.checks.get("random_search"), int | float)]
        if rates:
            sentence += f"; random search with as many renders succeeds on {sum(rates) / len(rates):.0%}"
        sentences.append(f"{sentence}.")
    return Section("In short", [*sentences, Gallery("", [top] if top else []), *problems])


def _difference_in_words(runs: Arms, name: str) -> Iterator[str]:
    """The last arm against the first in recall at a fixed false positive rate, where they can be compared."""
    if len(runs) < 2:
        return
    (reference, base), *_, (arm, group) = runs.items()
    metric = "recall_at/0.10"
    with suppress(InputError):
        first, last = ([read_evaluation(run, name, base[0].label) for run in runs] for runs in (base, group))
        require_comparable([*first, *last], name)
        if result := difference(last, first, OVERALL, metric):
            unsure = "" if result["low"] > 0 or result["high"] < 0 else ", so that no difference is shown"
            images = _images_name(base[0], name)
            yield f"{arm} minus {reference}, {metric_title(metric)} on {images}: {format_difference(result)}{unsure}."


def _headline(arms: Arms) -> Picture | None:
    """None if no arm's first run has an example that was right before its attack and wrong after."""
    name = _most_scored(arms)
    pairs = next((found for group in reversed([*arms.values()]) if (found := _changed(group[0].folder))), None)
    if not pairs:
        return None
    first, runs = next(iter(arms.values()))[0], _scored(arms, name)
    scores = {
        metric_title(metric): {
            arm: value for arm, group in runs.items() if (value := score(run.metrics(name)[metric] for run in group))
        }
        for metric in ("recall", "false_positive_rate", "auc")
    }
    scores = {title: by_arm for title, by_arm in scores.items() if by_arm}
    return plots.headline(pairs, scores, first.label, _images_name(first, name))


def _changed(folder: Path) -> list[tuple[Side, Side]]:
    """The newest of a run's attack examples that were right before and wrong after, a few."""
    for _, rows in reversed([*_read_examples(folder)]):
        if pairs := [(before, after) for label, before, after in rows if before.predicted == label != after.predicted]:
            return pairs[:EXAMPLES]
    return []


# ------------------------------------------------------------------------------------- runs


def _tables(arms: Arms) -> Iterator[Block]:
    """Means over seeds, a row for each run, and the settings in which the arms differ."""
    several = {arm: group for arm, group in arms.items() if len(group) > 1}
    seeds = [[arm, str(len(group))] for arm, group in several.items()]
    runs = [(arm, run) for arm, group in arms.items() for run in group]
    names = [[arm, str(run.seed)] for arm, run in runs[:MOST_ROWS]]
    yield from map(_cut, spread_tables(["arm", "seeds"], seeds, [*several.values()]))
    yield from run_tables(["arm", "seed"], names, [run for _, run in runs[:MOST_ROWS]])
    heads = {arm: group[0] for arm, group in arms.items()}
    if varied := varied_settings([*heads.values()]):
        rows = [[arm, *(str(head.settings.get(key)) for key in varied)] for arm, head in heads.items()]
        yield _cut(Table("Settings in which the arms differ", ["arm", *varied], rows))
    lines = [f"{run.folder}: {arm}, seed {run.seed}, {run.accuracy:.3f}" for arm, run in runs]
    yield Code(f"folders and test accuracy of all {len(runs)} finished runs", "\n".join(lines))


def _cut(table: Table) -> Table:
    return Table(table.title, table.header, table.rows[:MOST_ROWS])


def _unfinished(runs: Sequence[UnfinishedRun]) -> Section:
    rows = [[str(run.folder), run.state, len(run.epochs)] for run in runs[:MOST_ROWS]]
    more = [f"{run.folder}: {run.state}" for run in runs[MOST_ROWS:]]
    table = Table("", ["run", "state", "epochs"], rows)
    return Section("Unfinished runs", [table, Code(f"{len(more)} more", "\n".join(more))])


def _epochs(arms: Arms, unfinished: Sequence[UnfinishedRun]) -> Section:
    begun = islice((run for run in unfinished if run.epochs), MOST_UNFINISHED)
    runs: Mapping[str, Sequence[RunSummary | UnfinishedRun]] = {
        **arms,
        **{f"unfinished: {run.folder.name[-24:]}": [run] for run in begun},
    }

    def series(name: str) -> plots.Series:
        return {
            arm: [
                ([line["epoch"] for line in run.epochs if name in line], [e[name] for e in run.epochs if name in e])
                for run in group
            ]
            for arm, group in runs.items()
        }

    success = series("augment/attack_success")
    recall = {arm: [(x, [1 - value for value in y]) for x, y in group] for arm, group in success.items()}
    pictures = [
        plots.curves(series("train/accuracy"), "training accuracy"),
        plots.curves(series("validation/accuracy"), "validation accuracy"),
        plots.curves(recall, "recall of renders before training on them"),
        plots.curves(success, "attack success rate"),
        plots.curves(series("augment/steps"), "steps of the attack", None),
    ]
    phases = [*PHASES, "operators"]
    rows = [
        [arm, *("-" if (value := group[0].seconds.get(phase)) is None else f"{value:.2f}" for phase in phases)]
        for arm, group in arms.items()
    ]
    table = Table("Seconds per epoch, and once for the operators", ["arm", *phases], rows)
    return Section("Epochs", [Gallery("", [picture for picture in pictures if picture]), table])


def _first_middle_last(folder: Path, suffix: str) -> list[tuple[int, Path]]:
    """Of a run's files renders/epoch_NUMBER with a suffix, three with their numbers."""
    numbers = [(path.stem.removeprefix("epoch_"), path) for path in (folder / "renders").glob(f"epoch_*{suffix}")]
    return evenly(sorted((int(number), path) for number, path in numbers if number.isdigit()), 3)


def _renders(arm: str, folder: Path) -> Gallery:
    files = _first_middle_last(folder, ".png")
    images = [plots.from_file(path, f"Renders of epoch {n}, {arm}", GRID, f"epoch {n}") for n, path in files]
    return Gallery(arm, [image for found in images for image in found])


def _read_examples(folder: Path) -> Iterator[tuple[int, list[tuple[str, Side, Side]]]]:
    """Epoch, and label, before and after of each example, of a run's first, middle and last epoch with examples."""
    for epoch, path in _first_middle_last(folder, SUFFIX):
        with suppress(InputError):
            yield epoch, read_attack_examples(path)


def _attack_examples(arms: Arms) -> Iterator[Gallery]:
    for arm, group in arms.items():
        for epoch, rows in _read_examples(group[0].folder):
            images = [
                _side(label, when, side) for label, *sides in rows for when, side in zip(WHEN, sides, strict=True)
            ]
            yield Gallery(f"{arm}, epoch {epoch}", images)


WHEN = ("before", "after")


def _side(label: str, when: str, side: Side) -> Picture:
    image, sphere = (Image.fromarray(pixels.permute(1, 2, 0).numpy()) for pixels in (side.image, side.sphere))
    pair = Image.new("RGB", (plots.SMALL + sphere.width, plots.SMALL), "white")
    pair.paste(image.resize((plots.SMALL, plots.SMALL), Image.Resampling.NEAREST))
    pair.paste(sphere, (plots.SMALL, (plots.SMALL - sphere.height) // 2))
    predicted = f"{side.confidence:.0%} {side.predicted}"
    return plots.encoded(pair, f"{label} {when}: {predicted}; a ball in its light", f"{when}: {predicted}")


def _reproduction(arms: Arms) -> Section:
    heads = {arm: group[0] for arm, group in arms.items()}
    commands = "\n\n".join(f"# {arm}\n{training_command(run.config)}" for arm, run in heads.items())
    configs = [Code(f"configuration: {arm}", OmegaConf.to_yaml(run.config)) for arm, run in heads.items()]
    return Section("To reproduce", [Code("commands", commands), *configs])


# ------------------------------------------------------------------------------------- photographs


def _scored(arms: Arms, name: str) -> dict[str, list[RunSummary]]:
    """The runs of each arm that were scored on the photographs `name`, without arms that have none."""
    runs = {arm: [run for run in group if name in run.photographs] for arm, group in arms.items()}
    return {arm: group for arm, group in runs.items() if group}


def _most_scored(arms: Arms) -> str:
    """The name of the photographs that most arms were scored on, first PHOTOGRAPHS."""
    names = photograph_folders(_all(arms))
    return max(names, key=lambda name: (len(_scored(arms, name)), name == PHOTOGRAPHS), default=PHOTOGRAPHS)


def _photographs_folder(run: RunSummary, name: str) -> Path | None:
    """The folder of the photographs `name` in a run's configuration."""
    photos = OmegaConf.select(run.config, "evaluate.photos")
    folder = photos.get(name) if isinstance(photos, DictConfig) else photos
    return Path(folder) if isinstance(folder, str) else None


def _images_name(run: RunSummary, name: str) -> str:
    rendered = OmegaConf.select(run.config, "data.images")
    return "held-out renders" if rendered and _photographs_folder(run, name) == Path(rendered) else name


def _photographs(arms: Arms, name: str) -> Iterator[Section]:
    """Metrics by source, and the contact sheet of each arm's first run."""
    runs = _scored(arms, name)
    yield Section(f"{name}: by source", [*_by_source(runs, name)])
    sheets = {arm: group[0].folder / name / "contact_sheet.png" for arm, group in runs.items()}
    blocks = [
        Gallery(arm, plots.from_file(path, f"{name}, predictions of {arm}", SHEET)) for arm, path in sheets.items()
    ]
    yield Section(f"{name}: predictions", blocks)


def _by_source(runs: Arms, name: str) -> Iterator[Block]:
    label = _all(runs)[0].label
    try:
        evaluations = {arm: [read_evaluation(run, name, label) for run in group] for arm, group in runs.items()}
        scores = {metric: _scores(evaluations, metric) for metric in SHOWN}
        curves = {arm: [each.pools[OVERALL].scores for each in group] for arm, group in evaluations.items()}
        rocs = {arm: [Roc(*pair) for pair in group if all(pair)] for arm, group in curves.items()}
        titles = {metric: f"{metric_title(metric)} of {label}" for metric in SHOWN}
        pictures = [plots.roc(rocs, label), *(plots.bars(scores[metric], titles[metric]) for metric in SHOWN)]
        yield Gallery("", [picture for picture in pictures if picture])
        yield (
            "Lines on bars, and brackets: the 95 % interval of one seed, or the lowest and highest of several seeds. "
            f"FPR, the false positive rate: the fraction of other things that are predicted as {label}."
        )
        pairs = dict.fromkeys((source, arm) for by_source in scores.values() for source in by_source for arm in runs)
        rows = [[*pair, *(_cell(scores[metric], *pair) for metric in SHOWN)] for pair in pairs]
        yield Table("", ["source", "arm", *map(metric_title, SHOWN)], rows)
        require_comparable([each for group in evaluations.values() for each in group], name)
        yield from difference_tables(evaluations, "all")
    except InputError as error:
        yield str(error)


def _scores(evaluations: Mapping[str, Sequence[Evaluation]], metric: str) -> dict[str, dict[str, Score | None]]:
    """By source and arm, all sources together first; without sources that have none."""
    sources = dict.fromkeys([OVERALL, *(s for group in evaluations.values() for each in group for s in each.pools)])
    if len(sources) == 2:  # the one source is all
        del sources[OVERALL]
    scores = {
        source or "all": {
            arm: score(find_metric(each.metrics.get(source, {}), metric) for each in group)
            for arm, group in evaluations.items()
        }
        for source in islice(sources, MOST_ROWS)
    }
    return {source: by_arm for source, by_arm in scores.items() if any(by_arm.values())}


def _cell(scores: Mapping[str, Mapping[str, Score | None]], source: str, arm: str) -> str:
    return str(scores.get(source, {}).get(arm) or "-")


# ------------------------------------------------------------------------------------- attacks


def _attacks(attacks: Sequence[AttackSummary]) -> Iterator[Section]:
    for attack in attacks[:MOST_ATTACKS]:
        yield Section(f"Attack {attack.folder.parent.name}/{attack.folder.name}", [*_attack(attack)])
    if others := attacks[MOST_ATTACKS:]:
        lines = [f"{attack.folder}: {attack.successes} of {attack.correct} succeed" for attack in others]
        yield Section("Further attacks", [Code(f"{len(others)} more", "\n".join(lines))])


def _attack(attack: AttackSummary) -> Iterator[Block]:
    for number, label, before, after, outcome in evenly(attack.rows, ATTACK_EXAMPLES):
        title = f"Example {number}, {label}: {outcome}"
        alt = f"{title}; before, after, their difference and the lights; predicted {before}, then {after}"
        yield Gallery(title, plots.from_file(attack.folder / f"example_{number:03d}.png", alt, SHEET))
    yield Table("", ["example", "label", "before", "after", "outcome"], attack.rows[:MOST_ROWS])
    checks = [[name, value] for name, value in attack.checks.items() if not isinstance(value, dict)]
    yield Table("Checks", ["check", "value"], checks)
    with suppress(InputError, AttributeError):  # a configuration that is missing, damaged or of another version
        config = read_config(attack.folder.parent / CONFIG)
        yield Code("command", attack_command(config))
        yield Code("configuration", OmegaConf.to_yaml(config))
