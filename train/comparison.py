"""Finished runs side by side: accuracy, time, figures on photographs by source, and how far arms differ in them."""

from collections.abc import Sequence

from train.epoch import PHASES
from train.evaluations import Evaluation, difference, have_same_seeds, read_evaluations
from train.photographs import FIGURES, figure_title, find_figure, format_interval
from train.report import RunSummary, complete, group_by_settings, varied_settings
from train.settings import PHOTOGRAPHS
from train.tables import aligned


def format_comparison(runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str = PHOTOGRAPHS) -> str:
    """Markdown tables of runs: accuracy, figures on photographs by source, and seconds per epoch and phase.

    Runs that differ only in the seed are a group; a table for each group shows how far it is from the first one.
    exclude: sources that the pooled figures leave out; photographs: the sub-folder of each run with its scores.

    InputError as of `read_evaluations`, and for a run whose files lack what is shown.
    """
    for run in runs:
        with complete(run.folder):
            _accuracy_table([run]), _seconds_table([run])
    sections = [("Accuracy on the test set", _accuracy_table(runs)), ("Seconds per epoch", _seconds_table(runs))]
    if evaluations := read_evaluations(runs, exclude, photographs):
        pooled = f"all but {', '.join(exclude)}" if exclude else "all"
        label = evaluations[0].label
        sections[1:1] = [
            *(
                (f"Photographs: {figure_title(name, label)}", _figure_table(evaluations, name, pooled))
                for name in FIGURES
            ),
            *_difference_sections(evaluations, pooled),
        ]
    return "\n\n".join(f"### {title}\n\n{table}" for title, table in sections)


def _accuracy_table(runs: Sequence[RunSummary]) -> str:
    header = ["augment", "seed", "selected on validation", "at epoch", "last epoch"]
    rows = [
        [
            run.arm,
            str(run.config.seed),
            f"{run.scores['test/accuracy']:.4f}",
            str(run.scores["test/epoch"]),
            f"{run.scores['test/accuracy_last']:.4f}",
        ]
        for run in runs
    ]
    return aligned(header, rows)


def _figure_table(evaluations: Sequence[Evaluation], name: str, pooled: str) -> str:
    """A figure by source, a column per run; without the sources that have none."""
    rows = [
        [source or pooled, *(format_interval(find_figure(run.figures[source], name)) for run in evaluations)]
        for source in evaluations[0].pools
    ]
    header = ["source", *(f"{_name(run, evaluations)}, seed {run.seed}" for run in evaluations)]
    return aligned(header, [row for row in rows if set(row[1:]) != {"-"}])


def _name(evaluation: Evaluation, evaluations: Sequence[Evaluation]) -> str:
    """The run's arm, and the settings that it does not share with all other runs of this arm."""
    run = evaluation.run
    alike = [other.run for other in evaluations if other.run.arm == run.arm]
    return ", ".join([run.arm, *(f"{key}={run.settings.get(key)}" for key in varied_settings(alike))])


def _difference_sections(evaluations: Sequence[Evaluation], pooled: str) -> list[tuple[str, str]]:
    """A title and a table for each group of runs but the first: how far it is from the first, by source and figure."""
    by_folder = {evaluation.run.folder: evaluation for evaluation in evaluations}
    groups = group_by_settings([evaluation.run for evaluation in evaluations])
    reference, *others = [[by_folder[run.folder] for run in group] for group in groups]
    sections = []
    for group in others:
        rows = [
            [source or pooled, *(_format_difference(difference(group, reference, source, name)) for name in FIGURES)]
            for source in evaluations[0].pools
        ]
        header = ["source", *(figure_title(name, evaluations[0].label) for name in FIGURES)]
        names = f"{_name(group[0], evaluations)} minus {_name(reference[0], evaluations)}"
        sections.append((f"{names}, {_format_seeds(group, reference)}", aligned(header, rows)))
    return sections


def _format_seeds(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> str:
    if have_same_seeds(group, reference):
        return f"{len(group)} seeds in pairs" if len(group) > 1 else "one seed"
    return f"different seeds ({len(group)} and {len(reference)})"


def _format_difference(figure: dict) -> str:
    return f"{figure['value']:+.3f} [{figure['low']:+.3f}, {figure['high']:+.3f}]" if figure else "-"


def _seconds_table(runs: Sequence[RunSummary]) -> str:
    """Means per epoch; the operators are built once a run. The own share is the attack outside the classifier."""
    header = ["augment", *PHASES, "attack's own share", "attack's share of the epoch", "operators, once"]
    return aligned(header, [[run.arm, *_seconds_row(run.seconds)] for run in runs])


def _seconds_row(seconds: dict[str, float]) -> list[str]:
    phases = [f"{seconds[phase]:.2f}" for phase in PHASES]
    if "attack_classifier" not in seconds:
        return [*phases, "-", "-", "-"]
    own = 1 - seconds["attack_classifier"] / seconds["attack"]
    return [
        *phases,
        f"{own:.1%}",
        f"{seconds['attack'] / sum(seconds[phase] for phase in PHASES):.1%}",
        f"{seconds['operators']:.2f}",
    ]
