"""What is told of the images that runs were scored on: ROC, figures by source, hits and misses."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from renderer.errors import InputError
from train.command_line.configuration import as_dict
from train.photographs.answers import ANSWERS, read_answers
from train.photographs.figures import figure_title, find_figure, pool_all
from train.photographs.ranking import Ranking
from train.photographs.text import format_interval
from train.report import images, plots
from train.report.arms import Arms, Score, score
from train.report.blocks import Block, Gallery, Illustration, Section
from train.report.comparison import difference_tables, read_evaluations
from train.report.summary import RunSummary, complete
from train.report.tables import Table
from train.settings import PHOTOGRAPHS

FIGURES = ("recall", "false_alarms", "auc", "recall_at/0.10")
MOST_SOURCES = 30
ByArm = dict[str, Score | None]


def scored(arms: Arms, name: str) -> dict[str, list[RunSummary]]:
    """The arms with the runs of each that were scored on the images `name`."""
    found = {arm: [run for run in runs if name in run.photographs] for arm, runs in arms.items()}
    return {arm: runs for arm, runs in found.items() if runs}


def most_scored(arms: Arms) -> str:
    """The name of the images that most arms were scored on, first PHOTOGRAPHS."""
    names = sorted({name for runs in arms.values() for run in runs for name in run.photographs})
    return max(names, key=lambda name: (len(scored(arms, name)), name == PHOTOGRAPHS), default=PHOTOGRAPHS)


def scores_of(runs: Arms, name: str, figure: str) -> dict[str, Score]:
    """A figure on the images `name`, of the arms that have it."""
    found = {
        arm: score(find_figure(run.photographs.get(name, {}), figure) for run in group) for arm, group in runs.items()
    }
    return {arm: each for arm, each in found.items() if each}


def sections(arms: Arms, name: str) -> Iterator[Section]:
    """By source, and hits and misses of each arm's first run."""
    runs = scored(arms, name)
    yield Section(f"{name}: by source", [*_by_source(runs, name)])
    shown = [each for arm, group in runs.items() for each in _tiles(arm, group[0], name)]
    yield Section(f"{name}: hits and misses", shown)


def _by_source(runs: Arms, name: str) -> Iterator[Block]:
    every = [run for group in runs.values() for run in group]
    label = every[0].config.label
    try:
        scores = _scores(runs, name)
        yield Gallery("", [image for image in _plots(runs, scores, name, label) if image])
        yield "Lines on bars, and brackets: of one seed its 95 % interval, of several the lowest and the highest."
        for figure, by_source in scores.items():
            rows = [[source, *(found or "-" for found in by_arm.values())] for source, by_arm in by_source.items()]
            yield Table(figure_title(figure, label), ["source", *runs], rows)
        yield from difference_tables(read_evaluations(every, [], name), "all")
    except InputError as error:
        yield str(error)


def _scores(runs: Arms, name: str) -> dict[str, dict[str, ByArm]]:
    """By figure, source and arm, without the sources that have none of a figure."""
    parts = {arm: [_parts(run, name) for run in group] for arm, group in runs.items()}
    sources = [*dict.fromkeys(source for group in parts.values() for part in group for source in part)][:MOST_SOURCES]
    found = {figure: {source: _by_arm(parts, source, figure) for source in sources} for figure in FIGURES}
    return {
        figure: {source: by_arm for source, by_arm in by_source.items() if any(by_arm.values())}
        for figure, by_source in found.items()
    }


def _by_arm(parts: Mapping[str, Sequence[dict[str, Any]]], source: str, figure: str) -> ByArm:
    return {arm: score(find_figure(part.get(source, {}), figure) for part in group) for arm, group in parts.items()}


def _parts(run: RunSummary, name: str) -> dict[str, dict[str, Any]]:
    """A run's figures by source, those of all together first where there are several."""
    summary = run.photographs[name]
    with complete(run.folder):
        sources = summary.get("by_source", {})
        for source in sources.values():
            [format_interval(find_figure(source, figure)) for figure in FIGURES]
    return sources if len(sources) == 1 else {"all": summary, **sources}


def _plots(
    runs: Arms, scores: Mapping[str, Mapping[str, ByArm]], name: str, label: str
) -> Iterator[Illustration | None]:
    rankings = {arm: [*_rankings(group, name, label)] for arm, group in runs.items()}
    yield plots.roc(rankings, label, "ROC")
    for figure in FIGURES:
        yield plots.bars(scores[figure], f"{figure_title(figure, label)}, by source or pattern")


def _rankings(group: Sequence[RunSummary], name: str, label: str) -> Iterator[Ranking]:
    for run in group:
        pool = pool_all(read_answers(run.folder / name / ANSWERS, label), label)
        if all(pool.scores):
            yield Ranking(*pool.scores)


def _tiles(arm: str, run: RunSummary, name: str) -> Iterator[Block]:
    folder = photographs_folder(run, name)
    if folder is None or not folder.is_dir():
        sheet = images.from_file(run.folder / name / "contact_sheet.png", f"Answers of {arm} on {name}", 1100)
        yield Gallery(arm, sheet)
        return
    try:
        answers = read_answers(run.folder / name / ANSWERS, run.config.label)
    except InputError as error:
        yield str(error)
        return
    yield from images.photographs(answers, folder, run.config.label, arm)


def photographs_folder(run: RunSummary, name: str) -> Path | None:
    """Where the images were that a run was scored on, as its configuration has it."""
    photos = as_dict(run.config).get("evaluate", {}).get("photos")
    found = photos.get(name) if isinstance(photos, dict) else photos
    return Path(found) if isinstance(found, str) else None


def scored_on(run: RunSummary, name: str) -> str:
    """What the images are that a run was scored on, in the sub-folder `name`."""
    own = as_dict(run.config).get("data", {}).get("images")
    return "held-out renders" if own and photographs_folder(run, name) == Path(own) else name
