"""What is told of runs, in order."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice

from omegaconf import OmegaConf

from train.report import images, photographs, plots
from train.report.arms import Arms, drawn, settings_table
from train.report.blocks import Block, Code, Gallery, Section
from train.report.command import training_command
from train.report.folders import Run
from train.report.summary import RunSummary, headline_tables, spread_tables, varied_settings
from train.report.tables import Table
from train.run_folder.logs import PHASES

MOST_ROWS, MOST_UNFINISHED = 30, 3  # rows of a table, and lines in plots
LONGEST_NAME = 24  # characters of an unfinished run's folder in a legend
Lines = Mapping[str, Sequence[Run]]  # by arm, and those that are under way


def of_runs(runs: Sequence[Run], arms: Arms) -> Iterator[Section]:
    """Tables of all `arms`, as `arms_of` makes them of the runs; plots and images of those that are drawn."""
    if arms:
        yield Section("Arms", [*_tables(arms)])
    yield _states(runs)
    few = drawn(arms)
    yield _training(runs, few)
    for name in sorted({name for group in few.values() for run in group for name in run.summary.photographs}):
        yield from photographs.sections(few, name)
    yield Section("Renders", [images.renders(group[0].folder, arm) for arm, group in few.items()])
    yield _fooled(few)
    yield _reproduction(few)


def _tables(arms: Arms) -> Iterator[Block]:
    """Means over seeds, a row for each run, and what the arms differ in."""
    every = [(arm, run.summary) for arm, group in arms.items() for run in group]
    names, runs = zip(*every, strict=True)
    several = [arm for arm, group in arms.items() if len(group) > 1]
    yield from _with_names(spread_tables(runs), several, runs)
    yield from _with_names(headline_tables(runs[:MOST_ROWS]), names[:MOST_ROWS], runs[:MOST_ROWS])
    yield _cut(settings_table(arms))
    told = [f"{run.folder}: {arm}, seed {run.config.seed}, {run.scores['test/accuracy']:.3f}" for arm, run in every]
    yield Code(f"folders and test accuracy of all {len(every)} finished runs", "\n".join(told))


def _with_names(tables: Sequence[Table], names: Sequence[str], runs: Sequence[RunSummary]) -> Iterator[Table]:
    """The tables of `runs` with the names of the arms in the place of their settings."""
    columns = 1 + len(varied_settings(runs))
    for table in tables:
        rows = [[name, *row[columns:]] for name, row in zip(names, table.rows, strict=True)]
        yield _cut(Table(table.title, ["arm", *table.header[columns:]], rows))


def _cut(table: Table) -> Table:
    return Table(table.title, table.header, table.rows[:MOST_ROWS])


def _states(runs: Sequence[Run]) -> Section:
    others = [run for run in runs if not run.summary]
    rows = [[str(run.folder), run.state, len(run.epochs)] for run in others[:MOST_ROWS]]
    more = [f"{run.folder}: {run.state}" for run in others[MOST_ROWS:]]
    table = Table("", ["run", "state", "epochs"], rows)
    return Section("Runs that are not finished", [table, Code(f"{len(more)} more", "\n".join(more))])


def _training(runs: Sequence[Run], arms: Arms) -> Section:
    unfinished = islice((run for run in runs if not run.summary and run.epochs), MOST_UNFINISHED)
    under_way = {f"unfinished: {run.folder.name[-LONGEST_NAME:]}": [run] for run in unfinished}
    lines: Lines = {**arms, **under_way}
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


def _series(lines: Lines, name: str) -> plots.Series:
    return {arm: [_line(run, name) for run in group] for arm, group in lines.items()}


def _line(run: Run, name: str) -> tuple[list[float], list[float]]:
    points = [(line["epoch"], line[name]) for line in run.epochs if name in line]
    return [x for x, _ in points], [y for _, y in points]


def _recall(lines: Lines) -> plots.Series:
    """The share of an epoch's renders that the network got right as they were made."""
    fooled = _series(lines, "augment/fooled")
    return {arm: [(x, [1 - share for share in y]) for x, y in group] for arm, group in fooled.items()}


def _fooled(arms: Arms) -> Section:
    blocks = [gallery for arm, group in arms.items() for gallery in images.specimens(group[0].folder, arm)]
    return Section("Light that fooled", blocks)


def _reproduction(arms: Arms) -> Section:
    heads = {arm: group[0].summary for arm, group in arms.items()}
    commands = "\n\n".join(f"# {arm}\n{training_command(run.config)}" for arm, run in heads.items())
    configs = [Code(f"configuration: {arm}", OmegaConf.to_yaml(run.config)) for arm, run in heads.items()]
    return Section("To reproduce", [Code("commands", commands), *configs] if heads else [])
