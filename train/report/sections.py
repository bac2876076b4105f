"""What is told of runs, in order."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice

from omegaconf import OmegaConf

from train.report import images, photographs, plots
from train.report.arms import Arms, drawn, settings_table
from train.report.blocks import Block, Code, Gallery, Section
from train.report.command import training_command
from train.report.folders import UnfinishedRun
from train.report.overview import run_tables, spread_tables
from train.report.summary import RunSummary
from train.report.tables import Table
from train.run_folder.logs import PHASES

MOST_ROWS, MOST_UNFINISHED = 30, 3  # rows of a table, and lines in plots
LONGEST_NAME = 24  # characters of an unfinished run's folder in a legend
Run = RunSummary | UnfinishedRun
Lines = Mapping[str, Sequence[Run]]  # by arm, and those that are under way


def of_runs(arms: Arms, unfinished: Sequence[UnfinishedRun]) -> Iterator[Section]:
    """Tables of all `arms`, as `arms_of` makes them of runs; plots and images of those that are drawn."""
    yield Section("Arms", [*_tables(arms)])
    yield _states(unfinished)
    few = drawn(arms)
    yield _training(few, unfinished)
    for name in sorted({name for group in few.values() for run in group for name in run.photographs}):
        yield from photographs.sections(few, name)
    yield Section("Renders", [images.renders(group[0].folder, arm) for arm, group in few.items()])
    yield _fooled(few)
    yield _reproduction(few)


def _tables(arms: Arms) -> Iterator[Block]:
    """Means over seeds, a row for each run, and what the arms differ in."""
    several = {arm: group for arm, group in arms.items() if len(group) > 1}
    seeds = [[arm, str(len(group))] for arm, group in several.items()]
    every = [(arm, run) for arm, group in arms.items() for run in group]
    names = [[arm, str(run.config.seed)] for arm, run in every[:MOST_ROWS]]
    yield from map(_cut, spread_tables(["arm", "seeds"], seeds, [*several.values()]))
    yield from run_tables(["arm", "seed"], names, [run for _, run in every[:MOST_ROWS]])
    yield _cut(settings_table(arms))
    told = [f"{run.folder}: {arm}, seed {run.config.seed}, {run.accuracy:.3f}" for arm, run in every]
    yield Code(f"folders and test accuracy of all {len(every)} finished runs", "\n".join(told))


def _cut(table: Table) -> Table:
    return Table(table.title, table.header, table.rows[:MOST_ROWS])


def _states(runs: Sequence[UnfinishedRun]) -> Section:
    rows = [[str(run.folder), run.state, len(run.epochs)] for run in runs[:MOST_ROWS]]
    more = [f"{run.folder}: {run.state}" for run in runs[MOST_ROWS:]]
    table = Table("", ["run", "state", "epochs"], rows)
    return Section("Runs that are not finished", [table, Code(f"{len(more)} more", "\n".join(more))])


def _training(arms: Arms, unfinished: Sequence[UnfinishedRun]) -> Section:
    begun = islice((run for run in unfinished if run.epochs), MOST_UNFINISHED)
    under_way = {f"unfinished: {run.folder.name[-LONGEST_NAME:]}": [run] for run in begun}
    lines: Lines = {**arms, **under_way}
    drawn = [
        plots.curves(_series(lines, "train/accuracy"), "accuracy, training", "epoch"),
        plots.curves(_series(lines, "validation/accuracy"), "accuracy, validation", "epoch"),
        plots.curves(_recall(lines), "recall of renders before training on them", "epoch"),
        plots.curves(_series(lines, "augment/attack_success"), "share of renders fooled", "epoch"),
        plots.curves(_series(lines, "augment/steps"), "steps of the attack", "epoch", None),
    ]
    seconds = [
        [arm, *(_rounded(group[0].seconds.get(phase)) for phase in (*PHASES, "operators"))]
        for arm, group in arms.items()
    ]
    table = Table("Seconds per epoch, and once for the operators", ["arm", *PHASES, "operators"], seconds)
    gallery = Gallery("", [image for image in drawn if image])
    return Section("Over the epochs", [gallery, table])


def _rounded(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.2f}"


def _series(lines: Lines, name: str) -> plots.Series:
    return {arm: [_line(run, name) for run in group] for arm, group in lines.items()}


def _line(run: Run, name: str) -> tuple[list[float], list[float]]:
    points = [(line["epoch"], line[name]) for line in run.epochs if name in line]
    return [x for x, _ in points], [y for _, y in points]


def _recall(lines: Lines) -> plots.Series:
    """The share of an epoch's renders that the network got right as they were made."""
    success = _series(lines, "augment/attack_success")
    return {arm: [(x, [1 - share for share in y]) for x, y in group] for arm, group in success.items()}


def _fooled(arms: Arms) -> Section:
    blocks = [gallery for arm, group in arms.items() for gallery in images.attack_examples(group[0].folder, arm)]
    return Section("Light that fooled", blocks)


def _reproduction(arms: Arms) -> Section:
    heads = {arm: group[0] for arm, group in arms.items()}
    commands = "\n\n".join(f"# {arm}\n{training_command(run.config)}" for arm, run in heads.items())
    configs = [Code(f"configuration: {arm}", OmegaConf.to_yaml(run.config)) for arm, run in heads.items()]
    return Section("To reproduce", [Code("commands", commands), *configs])
