"""Runs in groups that differ only in the seed, under short names, and what becomes of their scores."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from train.photographs.text import format_interval
from train.report.summary import RunSummary, group_by_settings, name_among, varied_settings
from train.report.tables import Table

MOST_ARMS, MOST_SEEDS = 6, 5  # that are drawn and compared
MOST_NAMED, LONGEST_NAME = 30, 36  # arms by their settings, and characters of such a name
Arms = Mapping[str, Sequence[RunSummary]]


def arms_of(runs: Sequence[RunSummary]) -> Arms:
    """The runs by arm and the settings that tell it apart; by number where those are many or long."""
    groups = group_by_settings(runs)
    return dict(zip(_names([group[0] for group in groups]), groups, strict=True))


def _names(heads: Sequence[RunSummary]) -> list[str]:
    if len(heads) <= MOST_NAMED:
        names = [name_among(head, heads) for head in heads]
        if max(map(len, names), default=0) <= LONGEST_NAME and len(set(names)) == len(names):
            return names
    return [f"{number}: {head.arm}" for number, head in enumerate(heads, 1)]


def drawn(arms: Arms) -> Arms:
    """The first MOST_ARMS, MOST_SEEDS of each."""
    return {name: runs[:MOST_SEEDS] for name, runs in [*arms.items()][:MOST_ARMS]}


def settings_table(arms: Arms) -> Table:
    """What the arms differ in, a row each; without rows where it is the seed alone."""
    heads = {name: runs[0] for name, runs in arms.items()}
    varied = varied_settings([*heads.values()])
    rows = [[name, *(str(head.settings.get(key)) for key in varied)] for name, head in heads.items()]
    return Table("What the arms differ in", ["arm", *varied], rows if varied else [])


@dataclass(frozen=True)
class Score:
    """A figure of an arm: of one seed with its 95 % interval, of several the mean, the lowest and the highest."""

    value: float
    low: float
    high: float
    seeds: int

    def __str__(self) -> str:
        return format_interval({"value": self.value, "low": self.low, "high": self.high})


def score(figures: Iterable[Mapping[str, Any]]) -> Score | None:
    """Of the figures of an arm's seeds, {value, low, high} where they are known."""
    known = [figure for figure in figures if figure.get("value") is not None]
    if len(known) == 1:
        return Score(known[0]["value"], known[0]["low"], known[0]["high"], 1)
    values = [figure["value"] for figure in known]
    return Score(fmean(values), min(values), max(values), len(values)) if values else None
