"""What is told of the images that runs were scored on: ROC, figures by source, hits and misses."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError
from train.photographs.answers import ANSWERS, read_answers
from train.photographs.figures import OVERALL, figure_title, find_figure
from train.photographs.ranking import Ranking
from train.report import images, plots
from train.report.arms import Arms, Score, score
from train.report.blocks import Block, Gallery, Illustration, Section
from train.report.comparison import Evaluation, difference_tables, read_evaluation, require_comparable
from train.report.summary import RunSummary
from train.report.tables import Table
from train.settings import PHOTOGRAPHS

FIGURES = ("recall", "false_alarms", "auc", "recall_at/0.10")
MOST_SOURCES = 30
Evaluations = Mapping[str, Sequence[Evaluation]]  # by arm


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
    found = {arm: score(run.figures(name)[figure] for run in group) for arm, group in runs.items()}
    return {arm: each for arm, each in found.items() if each}


def sections(arms: Arms, name: str) -> Iterator[Section]:
    """By source, and hits and misses of each arm's first run."""
    runs = scored(arms, name)
    yield Section(f"{name}: by source", [*_by_source(runs, name)])
    shown = [each for arm, group in runs.items() for each in _tiles(arm, group[0], name)]
    yield Section(f"{name}: hits and misses", shown)


def _by_source(runs: Arms, name: str) -> Iterator[Block]:
    label = next(iter(runs.values()))[0].config.label
    try:
        evaluations = {arm: [read_evaluation(run, name, label) for run in group] for arm, group in runs.items()}
        scores = {figure: _scores(evaluations, figure) for figure in FIGURES}
        yield Gallery("", [image for image in _plots(evaluations, scores, label) if image])
        yield "Lines on bars, and brackets: of one seed its 95 % interval, of several the lowest and the highest."
        for figure, by_source in scores.items():
            rows = [[source, *(found or "-" for found in by_arm.values())] for source, by_arm in by_source.items()]
            yield Table(figure_title(figure, label), ["source", *runs], rows)
        require_comparable([each for group in evaluations.values() for each in group], name)
        yield from difference_tables(evaluations, "all")
    except InputError as error:
        yield str(error)


def _scores(evaluations: Evaluations, figure: str) -> dict[str, dict[str, Score | None]]:
    """By source and arm, all sources together first; without those that have none of the figure."""
    every = [evaluation for group in evaluations.values() for evaluation in group]
    sources = dict.fromkeys(source for evaluation in every for source in (OVERALL, *evaluation.pools))
    if len(sources) == 2:  # which together are the one
        del sources[OVERALL]
    found = {
        source or "all": {
            arm: score(find_figure(each.figures.get(source, {}), figure) for each in group)
            for arm, group in evaluations.items()
        }
        for source in [*sources][:MOST_SOURCES]
    }
    return {source: by_arm for source, by_arm in found.items() if any(by_arm.values())}


def _plots(
    evaluations: Evaluations, scores: Mapping[str, Mapping[str, Mapping[str, Score | None]]], label: str
) -> Iterator[Illustration | None]:
    pools = {arm: [each.pools[OVERALL].scores for each in group] for arm, group in evaluations.items()}
    rankings = {arm: [Ranking(*each) for each in group if all(each)] for arm, group in pools.items()}
    yield plots.roc(rankings, label, "ROC")
    for figure, found in scores.items():
        yield plots.bars(found, f"{figure_title(figure, label)}, by source or pattern")


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
    photos = OmegaConf.select(run.config, "evaluate.photos")
    found = photos.get(name) if isinstance(photos, DictConfig) else photos
    return Path(found) if isinstance(found, str) else None


def scored_on(run: RunSummary, name: str) -> str:
    """What the images are that a run was scored on, in the sub-folder `name`."""
    own = OmegaConf.select(run.config, "data.images")
    return "held-out renders" if own and photographs_folder(run, name) == Path(own) else name
