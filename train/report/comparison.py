"""Finished runs side by side: accuracy, time, figures on photographs by source, and how far arms differ in them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from renderer.errors import InputError
from train.photographs.answers import ANSWERS, Answer, read_answers
from train.photographs.bootstrap import interval, replicate_difference
from train.photographs.figures import (
    FIGURES,
    OVERALL,
    Pool,
    figure_title,
    figures,
    find_figure,
    pool_all,
    pool_answers,
    replicate_figures,
)
from train.photographs.text import format_interval
from train.report.summary import RunSummary, complete, name_among
from train.report.tables import Table
from train.run_folder.logs import PHASES
from train.settings import PHOTOGRAPHS


@dataclass(frozen=True)
class Evaluation:
    """A run's answers about the class `label`, and their pools by source; OVERALL, the last, lacks excluded sources."""

    run: RunSummary
    label: str
    answers: list[Answer]
    pools: dict[str, Pool]

    @property
    def seed(self) -> int:
        return self.run.config.seed

    @cached_property
    def figures(self) -> dict[str, dict[str, Any]]:
        """By source, as `train.photographs.figures.figures` returns them."""
        return {source: figures(pool, self.label) for source, pool in self.pools.items()}

    @cached_property
    def replicates(self) -> dict[str, dict[str, np.ndarray]]:
        """By source, as `replicate_figures` returns them."""
        return {source: replicate_figures(pool, self.label) for source, pool in self.pools.items()}


def read_evaluation(run: RunSummary, photographs: str, label: str, exclude: Sequence[str] = ()) -> Evaluation:
    """What is in the sub-folder `photographs` of a run; exclude: sources to leave out of OVERALL.

    InputError as of `read_answers`, and for a source that is nowhere.
    """
    answers = read_answers(run.folder / photographs / ANSWERS, label)
    return Evaluation(run, label, answers, _pool(answers, label, exclude))


def require_comparable(evaluations: Sequence[Evaluation], photographs: str) -> None:
    """InputError where runs were scored on different photographs."""
    first, *others = evaluations
    for other in others:
        if [answer.photograph for answer in other.answers] != [answer.photograph for answer in first.answers]:
            raise InputError(
                f"{other.run.folder / photographs} has other photographs or sources than "
                f"{first.run.folder / photographs}: score both networks on the same folder with "
                "scripts/evaluate_photos.py"
            )


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


def difference(group: Sequence[Evaluation], reference: Sequence[Evaluation], source: str, name: str) -> dict[str, Any]:
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
    drawn = replicate_difference(replicates[0], replicates[1], paired=have_same_seeds(group, reference))
    return {"value": float(values[0] - values[1]), **interval(drawn)}


def format_comparison(runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str = PHOTOGRAPHS) -> str:
    """Tables of runs as Markdown: accuracy, figures on photographs by source, and seconds per epoch and phase.

    Runs that differ only in the seed are a group; a table for each group shows how far it is from the first one.
    exclude: sources that the pooled figures leave out; photographs: the sub-folder of each run with its scores.

    InputError as of `read_evaluation` and `require_comparable`, for a sub-folder (but the usual one) that no run has,
    and for a run whose files lack what is shown.
    """
    for run in runs:
        with complete(run.folder):
            _accuracy_table([run]), _seconds_table([run])
    tables = [_accuracy_table(runs), _seconds_table(runs)]
    scored = [run for run in runs if photographs in run.photographs]
    if not scored and photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    if scored:
        evaluations = [read_evaluation(run, photographs, runs[0].config.label, exclude) for run in scored]
        require_comparable(evaluations, photographs)
        pooled = f"all but {', '.join(exclude)}" if exclude else "all"
        arms: dict[str, list[Evaluation]] = {}
        for evaluation in evaluations:
            arms.setdefault(name_among(evaluation.run, scored), []).append(evaluation)
        names = [f"{name_among(run, scored)}, seed {run.config.seed}" for run in scored]
        tables[1:1] = [*_figure_tables(evaluations, names, pooled), *difference_tables(arms, pooled)]
    return "\n\n".join(f"### {table.title}\n\n{table}" for table in tables)


def _accuracy_table(runs: Sequence[RunSummary]) -> Table:
    header = ["augment", "seed", "selected on validation", "at epoch", "last epoch"]
    rows = [
        [
            run.arm,
            str(run.config.seed),
            f"{run.accuracy:.4f}",
            str(run.scores["test/epoch"]),
            f"{run.scores['test/accuracy_last']:.4f}",
        ]
        for run in runs
    ]
    return Table("Accuracy on the test set", header, rows)


def _figure_tables(evaluations: Sequence[Evaluation], names: Sequence[str], pooled: str) -> Iterator[Table]:
    """Each figure by source, a column per run; without the sources that have none."""
    for figure in FIGURES:
        rows = [
            [source or pooled, *(format_interval(find_figure(run.figures[source], figure)) for run in evaluations)]
            for source in evaluations[0].pools
        ]
        title = f"Photographs: {figure_title(figure, evaluations[0].label)}"
        yield Table(title, ["source", *names], [row for row in rows if set(row[1:]) != {"-"}])


def difference_tables(arms: Mapping[str, Sequence[Evaluation]], pooled: str) -> Iterator[Table]:
    """A table for each arm but the first: how far it is from the first, by source and figure."""
    (first, reference), *others = arms.items()
    header = ["source", *(figure_title(figure, reference[0].label) for figure in FIGURES)]
    for arm, group in others:
        rows = [
            [source or pooled, *(format_difference(difference(group, reference, source, name)) for name in FIGURES)]
            for source in reference[0].pools
        ]
        yield Table(f"{arm} minus {first}, {_format_seeds(group, reference)}", header, rows)


def _format_seeds(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> str:
    if have_same_seeds(group, reference):
        return f"{len(group)} seeds in pairs" if len(group) > 1 else "one seed"
    return f"different seeds ({len(group)} and {len(reference)})"


def format_difference(figure: dict[str, Any]) -> str:
    """Of `difference`, with its sign; "-" where it is unknown."""
    return f"{figure['value']:+.3f} [{figure['low']:+.3f}, {figure['high']:+.3f}]" if figure else "-"


def _seconds_table(runs: Sequence[RunSummary]) -> Table:
    """Means per epoch; the operators are built once a run. The own share is the attack outside the classifier."""
    header = ["augment", *PHASES, "attack's own share", "attack's share of the epoch", "operators, once"]
    return Table("Seconds per epoch", header, [[run.arm, *_seconds_row(run)] for run in runs])


def _seconds_row(run: RunSummary) -> list[str]:
    seconds = run.seconds
    phases = [f"{seconds[phase]:.2f}" for phase in PHASES]
    if "attack_classifier" not in seconds:
        return [*phases, "-", "-", "-"]
    own = 1 - seconds["attack_classifier"] / seconds["attack"]
    return [
        *phases,
        f"{own:.1%}",
        f"{seconds['attack'] / run.epoch_seconds:.1%}",
        f"{seconds['operators']:.2f}",
    ]
