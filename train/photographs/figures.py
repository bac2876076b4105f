"""The figures of an evaluation: computed from a model's answers, and found by name in a summary."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

from train.photographs.answers import Answer
from train.photographs.ranking import RATES, rank
from train.photographs.shares import share

# The headline figures, by their place in a summary or in one of its sources.
FIGURES = ("recall", "false_alarms", "auc", *(f"recall_at/{rate}" for rate in RATES))


@dataclass(frozen=True)
class Pool:
    """Answers that are scored together: of images of the class asked for, and of other things.

    others: those that may be false alarms; rivals: those that the class is ranked against, look-alikes included.
    """

    mine: Sequence[Answer]
    others: Sequence[Answer]
    rivals: Sequence[Answer]


def pool_all(answers: Sequence[Answer], label: str) -> Pool:
    """All answers, each image of the class against every other thing."""
    others = [answer for answer in answers if answer.photograph.label != label]
    return Pool([answer for answer in answers if answer.photograph.label == label], others, others)


def pool_by_source(answers: Sequence[Answer], label: str) -> dict[str, Pool]:
    """A pool per known source, in alphabetical order, with the others of the sources that it is paired with."""
    by_source = defaultdict(list)
    for answer in answers:
        if answer.photograph.source is not None:
            by_source[answer.photograph.source].append(answer)
    pools = {source: pool_all(group, label) for source, group in sorted(by_source.items())}
    return {
        source: Pool(pool.mine, pool.others, [rival for name in _rivals(source, pool) for rival in pools[name].others])
        for source, pool in pools.items()
    }


def _rivals(source: str, pool: Pool) -> list[str]:
    """The source and those that its images of the class name as look-alikes."""
    return sorted({source}.union(*(answer.photograph.look_alikes for answer in pool.mine)))


def figures(pool: Pool, label: str) -> dict:
    """recall, top5 and false_alarms, as `share` returns them, and auc and recall_at, as `rank` does."""
    return {
        "recall": share_true(answer.true_rank == 1 for answer in pool.mine),
        "top5": share_true(answer.true_rank <= 5 for answer in pool.mine),
        "false_alarms": share_true(answer.prediction == label for answer in pool.others),
        **rank(*([answer.asked_log_odds for answer in group] for group in (pool.mine, pool.rivals))),
    }


def share_true(outcomes: Iterable[bool]) -> dict:
    """The share of the outcomes that are true."""
    outcomes = list(outcomes)
    return share(sum(outcomes), len(outcomes))


def find_figure(summary: dict, name: str) -> dict:
    """A figure of a summary, or of one of its sources, by its name in FIGURES; empty where it has none."""
    return reduce(lambda part, key: part.get(key, {}), name.split("/"), summary)


def figure_title(name: str, label: str) -> str:
    """What tables call a figure."""
    titles = {"recall": f"{label} recognised", "false_alarms": f"others called {label}", "auc": "AUC"}
    return titles.get(name) or f"recall at {float(name.rpartition('/')[2]):.0%} false alarms"
