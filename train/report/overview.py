"""Tables of finished runs: accuracy, time and figures on photographs, of each run and as means over seeds."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from train.photographs.figures import FIGURES, figure_title
from train.photographs.text import format_interval
from train.report.summary import RunSummary, group_by_settings, varied_settings
from train.report.tables import Table

Names = Sequence[Sequence[str]]  # the first cells of each row


def format_table(runs: Sequence[RunSummary]) -> str:
    """`run_tables` as Markdown, with what the runs differ in, and the contact sheets."""
    varied = varied_settings(runs)
    names = [[*_settings(run, varied), str(run.config.seed)] for run in runs]
    sheets = [f"image: {run.folder / name / 'contact_sheet.png'}" for run in runs for name in run.photographs]
    tables = _joined(run_tables(["augment", *varied, "seed"], names, runs))
    return "\n\n".join(filter(None, [tables, "\n".join(sheets)]))


def format_spread(runs: Sequence[RunSummary]) -> str:
    """`spread_tables` as Markdown, of the groups of several runs that differ only in the seed; nothing without one."""
    groups = [group for group in group_by_settings(runs) if len(group) > 1]
    varied = varied_settings(runs)
    names = [[*_settings(group[0], varied), str(len(group))] for group in groups]
    return _joined(spread_tables(["augment", *varied, "seeds"], names, groups)) if groups else ""


def run_tables(header: Sequence[str], names: Names, runs: Sequence[RunSummary]) -> Iterator[Table]:
    """A row per run: one table of accuracy and time, and one for each folder of photographs of the figures on it."""
    named = [*zip(names, runs, strict=True)]
    rows = [[*name, f"{run.accuracy:.3f}", f"{run.epoch_seconds:.1f}"] for name, run in named]
    yield Table("", [*header, "test accuracy", "seconds per epoch"], rows)
    for folder in _folders(runs):
        rows = [[*name, *map(format_interval, run.figures(folder).values())] for name, run in named]
        yield Table(folder, [*header, *_titles(runs)], rows)


def spread_tables(header: Sequence[str], names: Names, groups: Sequence[Sequence[RunSummary]]) -> Iterator[Table]:
    """Those tables, but for the time, with a row per group of runs: mean ± standard deviation."""
    runs, named = [run for group in groups for run in group], [*zip(names, groups, strict=True)]
    rows = [[*name, _spread([run.accuracy for run in group])] for name, group in named]
    yield Table("", [*header, "test accuracy"], rows)
    for folder in _folders(runs):
        rows = [[*name, *_spreads(group, folder)] for name, group in named]
        yield Table(folder, [*header, *_titles(runs)], rows)


def _settings(run: RunSummary, varied: Sequence[str]) -> list[str]:
    return [run.arm, *(str(run.settings.get(key)) for key in varied)]


def _joined(tables: Iterable[Table]) -> str:
    return "\n\n".join(f"{table.title}:\n{table}" if table.title else str(table) for table in tables)


def _folders(runs: Sequence[RunSummary]) -> list[str]:
    """The folders of photographs that any of the runs was scored on."""
    return sorted({folder for run in runs for folder in run.photographs})


def _titles(runs: Sequence[RunSummary]) -> list[str]:
    return [figure_title(name, runs[0].config.label) for name in FIGURES]


def _spreads(group: Sequence[RunSummary], folder: str) -> Iterator[str]:
    for figures in zip(*(run.figures(folder).values() for run in group), strict=True):
        yield _spread([figure.get("value") for figure in figures])


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return "-"
    with np.errstate(invalid="ignore"):  # where a damaged file has no finite number
        return f"{np.mean(known):.3f} ± {np.std(known, ddof=1):.3f}"
