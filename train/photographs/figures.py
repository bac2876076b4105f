"""The figures of an evaluation: computed from a model's answers, and found by name in a summary."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from train.photographs.answers import Answer
from train.photographs.bootstrap import replicate_share
from train.photographs.ranking import RATES, Ranking, rank
from train.photographs.shares import share

OVERALL = ""  # in the place of a source: all images
# The headline figures, by their place in a summary or in one of its sources.
RANKED = ("auc", *(f"recall_at/{rate}" for rate in RATES))
FIGURES = ("recall", "false_alarms", *RANKED)


@dataclass(frozen=True)
class Pool:
    """Answers that are scored together: of images of the class asked for, and of other things.

    others: those that may be false alarms; rivals: those that the class is ranked against, look-alikes included.
    """

    mine: Sequence[Answer]
    others: Sequence[Answer]
    rivals: Sequence[Answer]

    @property
    def scores(self) -> tuple[list[float], list[float]]:
        """The log-odds, where known, of the class and of what it is ranked against."""
        mine, rivals = (
            [answer.asked_log_odds for answer in group if answer.asked_log_odds is not None]
            for group in (self.mine, self.rivals)
        )
        return mine, rivals


def pool_answers(answers: Sequence[Answer], label: str) -> dict[str, Pool]:
    """OVERALL, where each image of the class is ranked against every other thing, and each known source by its name.

    A source's images of the class are ranked against the others of it and of the sources that they name as look-alikes.
    """
    by_source = defaultdict(list)
    for answer in answers:
        if answer.photograph.source is not None:
            by_source[answer.photograph.source].append(answer)
    own = {source: pool_all(group, label) for source, group in sorted(by_source.items())}
    return {OVERALL: pool_all(answers, label)} | {
        source: Pool(
            pool.mine, pool.others, [rival for name in _paired(source, pool, own) for rival in own[name].others]
        )
        for source, pool in own.items()
    }


def pool_all(answers: Sequence[Answer], label: str) -> Pool:
    """The answers, each image of the class against every other thing."""
    others = [answer for answer in answers if answer.photograph.label != label]
    return Pool([answer for answer in answers if answer.photograph.label == label], others, others)


def _paired(source: str, pool: Pool, known: Iterable[str]) -> list[str]:
    """The source and those that its images of the class name as look-alikes, but for such as could not be read."""
    return sorted({source}.union(*(answer.photograph.look_alikes for answer in pool.mine)).intersection(known))


def figures(pool: Pool, label: str) -> dict[str, Any]:
    """recall, top5 and false_alarms, as `share` returns them, and auc and recall_at, as `rank` does."""
    return {
        "recall": share_true(answer.true_rank == 1 for answer in pool.mine),
        "top5": share_true(answer.true_rank is not None and answer.true_rank <= 5 for answer in pool.mine),
        "false_alarms": share_true(answer.prediction == label for answer in pool.others),
        **rank(*pool.scores),
    }


def replicate_figures(pool: Pool, label: str) -> dict[str, np.ndarray]:
    """FIGURES in the bootstrap's replicates, (REPLICATES,) each, without those that are unknown.

    Those of two networks on the same images are pairs: each replicate has the same images.
    """
    outcomes = {
        "recall": [answer.true_rank == 1 for answer in pool.mine],
        "false_alarms": [answer.prediction == label for answer in pool.others],
    }
    replicates = {name: replicate_share(np.array(told)) for name, told in outcomes.items() if told}
    if all(pool.scores):
        ranked = Ranking(*pool.scores).replicates()
        replicates |= dict(zip(RANKED, (ranked["auc"], *(ranked[rate] for rate in RATES)), strict=True))
    return replicates


def share_true(outcomes: Iterable[bool]) -> dict[str, Any]:
    """The share of the outcomes that are true."""
    outcomes = list(outcomes)
    return share(sum(outcomes), len(outcomes))


def find_figure(summary: dict[str, Any], name: str) -> dict[str, Any]:
    """A figure of a summary, or of one of its sources, by its name in FIGURES; empty where it has none."""
    return reduce(lambda part, key: part.get(key, {}), name.split("/"), summary)


def figure_title(name: str, label: str) -> str:
    """What tables call a figure."""
    titles = {"recall": f"{label} recognized", "false_alarms": f"others called {label}", "auc": "AUC"}
    return titles.get(name) or f"recall at {float(name.rpartition('/')[2]):.0%} false alarms"
