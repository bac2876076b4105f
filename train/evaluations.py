"""Evaluations of several runs on the same photographs, and how far groups of them differ."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from renderer.errors import InputError
from train.photographs.answers import Answer
from train.photographs.answers_table import ANSWERS, read_answers
from train.photographs.bootstrap import interval, replicate_difference
from train.photographs.figures import OVERALL, Pool, figures, find_figure, pool_all, pool_answers, replicate_figures
from train.report import RunSummary
from train.settings import PHOTOGRAPHS


@dataclass(frozen=True)
class Evaluation:
    """A run's answers about the class `label`, pooled by source; OVERALL, the last, lacks those of excluded sources."""

    run: RunSummary
    pools: dict[str, Pool]
    label: str

    @property
    def seed(self) -> int:
        return self.run.config.seed

    @cached_property
    def figures(self) -> dict[str, dict]:
        """By source, as `train.photographs.figures.figures` returns them."""
        return {source: figures(pool, self.label) for source, pool in self.pools.items()}

    @cached_property
    def replicates(self) -> dict[str, dict[str, np.ndarray]]:
        """By source, as `replicate_figures` returns them."""
        return {source: replicate_figures(pool, self.label) for source, pool in self.pools.items()}


def read_evaluations(runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str) -> list[Evaluation]:
    """What is in the sub-folder `photographs` of the runs that were scored; exclude: sources to leave out of OVERALL.

    InputError for a sub-folder (but the usual one) or source that is nowhere, and for runs that were scored on
    different photographs.
    """
    scored = [run for run in runs if photographs in run.photographs]
    if not scored and photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    label = runs[0].config.label
    answers = [read_answers(run.folder / photographs / ANSWERS, label) for run in scored]
    for run, said in zip(scored, answers, strict=True):
        if [answer.photograph for answer in said] != [answer.photograph for answer in answers[0]]:
            raise InputError(
                f"{run.folder / photographs} has other photographs or sources than {scored[0].folder / photographs}: "
                "score both networks on the same folder with scripts/evaluate_photos.py"
            )
    return [Evaluation(run, _pool(said, label, exclude), label) for run, said in zip(scored, answers, strict=True)]


def _pool(answers: Sequence[Answer], label: str, exclude: Sequence[str]) -> dict[str, Pool]:
    by_source = pool_answers(answers, label)
    del by_source[OVERALL]
    if unknown := set(exclude).difference(by_source):
        raise InputError(
            f"exclude: no photograph is of source {min(unknown)!r}; the sources are {', '.join(by_source)}"
        )
    return by_source | {OVERALL: pool_all([item for item in answers if item.photograph.source not in exclude], label)}


def have_same_seeds(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> bool:
    return sorted(run.seed for run in group) == sorted(run.seed for run in reference)


def difference(group: Sequence[Evaluation], reference: Sequence[Evaluation], source: str, name: str) -> dict:
    """How far the mean of a figure over a group's seeds is from that over the reference's: value, low and high.

    The interval is a 95 % bootstrap interval over images, of which each replicate has the same ones for all runs, and
    over seeds, which are drawn in pairs where both groups have the same. Few seeds tell little of their spread: of n,
    the bootstrap sees a variance too small by 1/n, and with one none at all. Empty where a run lacks the figure.
    """
    groups = [sorted(runs, key=lambda evaluation: evaluation.seed) for runs in (group, reference)]
    if any(name not in evaluation.replicates[source] for runs in groups for evaluation in runs):
        return {}
    values = [np.mean([find_figure(run.figures[source], name)["value"] for run in runs]) for runs in groups]
    replicates = [np.stack([run.replicates[source][name] for run in runs]) for runs in groups]
    drawn = replicate_difference(*replicates, paired=have_same_seeds(group, reference))
    return {"value": float(values[0] - values[1]), **interval(drawn)}
