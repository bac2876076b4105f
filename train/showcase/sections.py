"""What is told of runs, in order."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from renderer.errors import InputError
from train.comparison import comparison_tables
from train.epoch import PHASES
from train.photographs import figure_title, find_figure
from train.photographs.answers_table import ANSWERS, read_answers
from train.photographs.figures import OVERALL, pool_answers
from train.photographs.ranking import Ranking
from train.photographs.roc import rank_pools
from train.report import RunSummary, group_by_settings, headline_tables, name_among, spread_tables
from train.showcase import images, plots
from train.showcase.blocks import Block, Code, Gallery, Illustration, Section
from train.showcase.command import training_command
from train.showcase.folders import Run
from train.tables import Table

MOST_ARMS, MOST_SEEDS = 6, 5  # that are drawn and compared; all are in the tables of means
MOST_ROWS = 30
LONGEST_NAME = 36  # characters
Arms = Mapping[str, Sequence[Run]]


def arms_of(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The finished runs by arm and the settings that tell it apart, at most MOST_ARMS of MOST_SEEDS each."""
    by_folder = {run.folder: run for run in runs if run.summary}
    summaries = [run.summary for run in by_folder.values()]
    groups = group_by_settings(summaries)[:MOST_ARMS]
    names = _short_names([group[0] for group in groups])
    seeds = [[by_folder[run.folder] for run in group[:MOST_SEEDS]] for group in groups]
    return dict(zip(names, seeds, strict=True))


def _short_names(heads: Sequence[RunSummary]) -> list[str]:
    """As the other tables have them; numbers, in the order of these, where they are too long for a legend."""
    names = [name_among(head, heads) for head in heads]
    if max(map(len, names), default=0) <= LONGEST_NAME and len(set(names)) == len(names):
        return names
    return [f"{number}: {head.arm}" for number, head in enumerate(heads, 1)]


def of_runs(runs: Sequence[Run]) -> Iterator[Section]:
    """Tables first, then plots, then images."""
    finished, arms = [run.summary for run in runs if run.summary], arms_of(runs)
    if finished:
        yield _tables(finished)
    yield _states(runs)
    yield _training(runs, arms)
    names = sorted({name for run in finished for name in run.photographs})
    for name in names:
        yield from _photographs(name, arms)
    yield Section("Renders", [images.renders(group[0].folder, arm) for arm, group in arms.items()])
    yield _fooled(arms)
    yield _reproduction(arms)


def _tables(finished: Sequence[RunSummary]) -> Section:
    tables = [*spread_tables(finished), *headline_tables(finished[:MOST_ROWS])]
    left = len(finished) - MOST_ROWS
    more = [f"The first {MOST_ROWS} runs have a row of their own; {left} more are in the means."] if left > 0 else []
    return Section("Arms", [*(_cut(table) for table in tables), *more])


def _cut(table: Table) -> Table:
    return Table(table.title, table.header, table.rows[:MOST_ROWS])


def _states(runs: Sequence[Run]) -> Section:
    others = [run for run in runs if not run.summary]
    rows = [[str(run.folder), run.state, len(run.epochs)] for run in others[:MOST_ROWS]]
    names = "\n".join(f"{run.folder}: {run.state}" for run in others[MOST_ROWS:])
    blocks: list[Block] = [Table("", ["run", "state", "epochs"], rows)] if rows else []
    return Section("Runs that are not finished", blocks + ([Code("the others", names)] if names else []))


def _training(runs: Sequence[Run], arms: Arms) -> Section:
    under_way = {run.folder.name: [run] for run in islice((run for run in runs if not run.summary and run.epochs), 3)}
    lines = {**arms, **under_way}
    drawn = [
        plots.curves(_series(lines, "train/accuracy"), "accuracy, training", "epoch"),
        plots.curves(_series(lines, "validation/accuracy"), "accuracy, validation", "epoch"),
        plots.curves(_recall(lines), "recall of renders before training on them", "epoch"),
        plots.curves(_series(lines, "augment/fooled"), "share of renders fooled", "epoch"),
        plots.curves(_series(lines, "augment/steps"), "steps of the attack", "epoch", None),
    ]
    seconds = [
        [arm, *(_rounded(group[0].summary.seconds.get(phase)) for phase in (*PHASES, "operators"))]
        for arm, group in arms.items()
    ]
    table = Table("Seconds per epoch, and once for the operators", ["arm", *PHASES, "operators"], seconds)
    gallery = Gallery("", [image for image in drawn if image])
    return Section("Over the epochs", [gallery, *([table] if seconds else [])])


def _rounded(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.2f}"


def _series(lines: Arms, name: str) -> plots.Series:
    return {arm: [_line(run, name) for run in group] for arm, group in lines.items()}


def _line(run: Run, name: str) -> tuple[list[float], list[float]]:
    points = [(line["epoch"], line[name]) for line in run.epochs if name in line]
    return [x for x, _ in points], [y for _, y in points]


def _recall(lines: Arms) -> plots.Series:
    """The share of an epoch's renders that the network got right as they were made."""
    fooled = _series(lines, "augment/fooled")
    return {arm: [(x, [1 - share for share in y]) for x, y in group] for arm, group in fooled.items()}


def _photographs(name: str, arms: Arms) -> Iterator[Section]:
    scored = {arm: [run.summary for run in group if name in run.summary.photographs] for arm, group in arms.items()}
    scored = {arm: group for arm, group in scored.items() if group}
    if not scored:
        return
    label = next(iter(scored.values()))[0].config.label
    blocks: list[Block] = []
    try:
        summaries = [run for group in scored.values() for run in group]
        blocks += [
            _cut(table) for table in comparison_tables(summaries, [], name) if "seconds" not in table.title.lower()
        ]
        rankings = {arm: _rankings(group, name, label) for arm, group in scored.items()}
        blocks.insert(0, Gallery("", _plots(scored, rankings, name, label)))
    except InputError as error:
        blocks.append(str(error))
    yield Section(f"{name}: by source", blocks)
    yield Section(
        f"{name}: hits and misses", [each for arm, group in scored.items() for each in _tiles(arm, group[0], name)]
    )


def _rankings(group: Sequence[RunSummary], name: str, label: str) -> list[Ranking]:
    pools = [pool_answers(read_answers(run.folder / name / ANSWERS, label), label) for run in group]
    return [ranking for each in pools if (ranking := rank_pools({OVERALL: each[OVERALL]}).get(OVERALL))]


def _plots(
    scored: Mapping[str, Sequence[RunSummary]], rankings: Mapping[str, Any], name: str, label: str
) -> list[Illustration]:
    first = {arm: group[0].photographs[name] for arm, group in scored.items()}
    sources = sorted({source for summary in first.values() for source in summary.get("by_source", {})})[:MOST_ROWS]
    drawn = [plots.roc(rankings, label, "ROC")]
    for figure in ("recall", "false_alarms", "auc") if sources else ():
        values = {
            arm: [find_figure(summary["by_source"].get(source, {}), figure) for source in sources]
            for arm, summary in first.items()
        }
        drawn.append(plots.bars(values, sources, f"{figure_title(figure, label)}, by source or pattern"))
    return [image for image in drawn if image]


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
    photos = OmegaConf.to_container(run.config).get("evaluate", {}).get("photos")
    found = photos.get(name) if isinstance(photos, dict) else photos
    return Path(found) if isinstance(found, str) else None


def scored_on(run: RunSummary, name: str) -> str:
    """What the images are that a run was scored on, in the sub-folder `name`."""
    own = OmegaConf.to_container(run.config).get("data", {}).get("images")
    return "held-out renders" if own and photographs_folder(run, name) == Path(own) else name


def _fooled(arms: Arms) -> Section:
    blocks = [gallery for arm, group in arms.items() for gallery in images.specimens(group[0].folder, arm)]
    return Section("Light that fooled", blocks)


def _reproduction(arms: Arms) -> Section:
    heads = {arm: group[0].summary for arm, group in arms.items()}
    commands = "\n\n".join(f"# {arm}\n{training_command(run.config)}" for arm, run in heads.items())
    configs = [Code(f"configuration: {arm}", OmegaConf.to_yaml(run.config)) for arm, run in heads.items()]
    return Section("To reproduce", [Code("commands", commands), *configs] if heads else [])
