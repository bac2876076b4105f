"""What was asked and answered, in two sentences with numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

from renderer.errors import InputError
from train.comparison import difference, read_evaluations
from train.photographs import figure_title, find_figure
from train.photographs.figures import OVERALL
from train.showcase.attacks import Attack
from train.showcase.folders import Run
from train.showcase.sections import scored_on

RATE = "recall_at/0.10"  # what tells discernment: recall at equal false alarms


def of_runs(arms: Mapping[str, Sequence[Run]], name: str) -> str:
    """About the first and the last arm, on the photographs in the sub-folder `name`."""
    scored = {
        arm: [run.summary for run in group] for arm, group in arms.items() if name in group[0].summary.photographs
    }
    if not scored:
        accuracy = ", ".join(f"{arm} {group[0].summary.scores['test/accuracy']:.3f}" for arm, group in arms.items())
        return f"Asked: what do {len(arms)} ways of training reach on the test set? Answered: accuracy {accuracy}."
    first = next(iter(scored.values()))[0]
    label, where = first.config.label, scored_on(first, name)
    told = "; ".join(f"{arm} {_told(group[0].photographs[name])}" for arm, group in scored.items())
    return (
        f"Asked: does a network trained in another way tell {label} from other things on {where}, and not only call "
        f"more of them {label}? Answered, of the first seed of each arm: {told}{_difference(scored, name)}."
    )


def _told(summary: dict[str, Any]) -> str:
    recall, alarms, auc = (find_figure(summary, figure) for figure in ("recall", "false_alarms", "auc"))
    if recall.get("value") is None or alarms.get("value") is None:
        return "has no score"
    ranked = f", AUC {auc['value']:.3f}" if auc.get("value") is not None else ""
    return f"recognised {recall['value']:.0%} with {alarms['value']:.1%} false alarms{ranked}"


def _difference(scored: Mapping[str, Sequence], name: str) -> str:
    if len(scored) < 2:
        return ""
    (reference, base), *_, (arm, group) = scored.items()
    try:
        evaluations = read_evaluations([*base, *group], [], name)
        figure = difference(evaluations[len(base) :], evaluations[: len(base)], OVERALL, RATE)
    except InputError:
        return ""
    if not figure:
        return ""
    title = figure_title(RATE, base[0].config.label)
    sure = "" if figure["low"] > 0 or figure["high"] < 0 else ", so that no difference is shown"
    value = f"{figure['value']:+.3f} [{figure['low']:+.3f}, {figure['high']:+.3f}]"
    return f"; {arm} minus {reference} in {title} is {value}{sure}"


def of_attacks(attacks: Sequence[Attack]) -> str:
    fooled, total = sum(attack.fooled for attack in attacks), sum(len(attack.examples) for attack in attacks)
    before = sum(attack.fooled_before for attack in attacks)
    wrong = f", {before} more being wrong before any step" if before else ""
    draws = [share for attack in attacks if isinstance(share := attack.checks.get("random_search"), int | float)]
    random = f"; random search with as many tries fools {sum(draws) / len(draws):.0%}" if draws else ""
    return (
        f"Asked: can a change of the scene fool the classifier in {total} examples? "
        f"Answered: it does in {fooled} of {total}{wrong}{random}."
    )
