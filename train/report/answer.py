"""What was asked and answered, in two sentences with numbers."""

from collections.abc import Sequence
from statistics import fmean

from renderer.errors import InputError
from train.photographs.figures import OVERALL, figure_title
from train.report.arms import Arms, Score
from train.report.attacks import Attack
from train.report.comparison import difference, format_difference, read_evaluation, require_comparable
from train.report.photographs import scored, scored_on, scores_of

RATE = "recall_at/0.10"  # what tells discernment: recall at equal false alarms


def of_runs(arms: Arms, name: str) -> str:
    """About all arms, and the last beside the first, on the images `name`, or on the test set where there are none."""
    runs = scored(arms, name)
    if not runs:
        told = ", ".join(f"{arm} {fmean(run.accuracy for run in group):.3f}" for arm, group in arms.items())
        return f"Asked: what do {len(arms)} ways of training reach on the test set? Answered: accuracy {told}."
    first = next(iter(runs.values()))[0]
    scores = [scores_of(runs, name, figure) for figure in ("recall", "false_alarms", "auc")]
    told = "; ".join(f"{arm} {_told(*(each.get(arm) for each in scores))}" for arm in runs)
    most = max(map(len, runs.values()))
    return (
        f"Asked: which network tells {first.config.label} from other things on {scored_on(first, name)}, and does not "
        f"only call more of them {first.config.label}? Answered, of {'one seed' if most == 1 else f'{most} seeds'}: "
        f"{told}{_difference(runs, name)}."
    )


def _told(recall: Score | None, alarms: Score | None, auc: Score | None) -> str:
    parts = [
        f"recognized {recall.value:.0%}" if recall else "",
        f"{alarms.value:.1%} false alarms" if alarms else "",
        f"AUC {auc.value:.3f}" if auc else "",
    ]
    return ", ".join(filter(None, parts)) or "has no score"


def _difference(runs: Arms, name: str) -> str:
    if len(runs) < 2:
        return ""
    (reference, base), *_, (arm, group) = runs.items()
    try:
        label = base[0].config.label
        others, first = ([read_evaluation(run, name, label) for run in each] for each in (group, base))
        require_comparable([*first, *others], name)
        figure = difference(others, first, OVERALL, RATE)
    except InputError:
        return ""
    if not figure:
        return ""
    title = figure_title(RATE, label)
    sure = "" if figure["low"] > 0 or figure["high"] < 0 else ", so that no difference is shown"
    return f"; {arm} minus {reference} in {title} is {format_difference(figure)}{sure}"


def of_attacks(attacks: Sequence[Attack]) -> str:
    success, total = sum(attack.success for attack in attacks), sum(len(attack.examples) for attack in attacks)
    before = sum(attack.success_before for attack in attacks)
    wrong = f", {before} more being wrong before any step" if before else ""
    draws = [share for attack in attacks if isinstance(share := attack.checks.get("random_search"), int | float)]
    random = f"; random search with as many tries fools {sum(draws) / len(draws):.0%}" if draws else ""
    return (
        f"Asked: can a change of the scene fool the classifier in {total} examples? "
        f"Answered: it does in {success} of {total}{wrong}{random}."
    )
