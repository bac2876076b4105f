"""The metrics of an evaluation, with 95 % intervals: recall, false positive rate, AUC, recall at fixed FPR."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, reduce
from typing import Any

import numpy as np
import torch

from train.photographs.predictions import Prediction
from train.tables import fraction

RATES = ("0.05", "0.10", "0.20")  # the false positive rates at which recall is reported
RANKED = ("auc", *(f"recall_at/{rate}" for rate in RATES))
METRICS = ("recall", "false_positive_rate", *RANKED)  # the main metrics, by their place in a summary or its sources
TITLES = {"recall": "recall", "false_positive_rate": "FPR", "auc": "AUC"}
OVERALL = ""  # in the place of a source: all images

REPLICATES = 2000
BLOCK = 250  # replicates at a time, which bounds the memory
IMAGES, RUNS = 0, 1  # seeds, so that images and runs are drawn independently
Scores = Sequence[float] | np.ndarray


def bootstrap(statistic: Callable[..., np.ndarray], *groups: np.ndarray) -> np.ndarray:
    """A statistic's values in the bootstrap's replicates, (..., REPLICATES).

    groups: values (n,) of images, n at least 1. A replicate draws as many from each group, with replacement. The
    statistic takes an array (BLOCK, n) per group and returns (..., BLOCK). Groups of equal sizes get equal draws at
    every call, so that the metrics of two networks on the same images are replicated in pairs.
    """
    generator = np.random.default_rng(IMAGES)
    blocks = []
    for _ in range(REPLICATES // BLOCK):
        samples = [group[generator.integers(len(group), size=(BLOCK, len(group)))] for group in groups]
        blocks.append(statistic(*samples))
    return np.concatenate(blocks, axis=-1)


def interval(replicates: np.ndarray) -> dict[str, float]:
    """low and high of the 95 % percentile interval (Efron and Tibshirani 1993, ch. 13) of (REPLICATES,) values.

    Percentiles stay within the metric's range; BCa is undefined where all replicates agree, as at a recall of 1.
    """
    low, high = np.quantile(replicates, (0.025, 0.975))
    return {"low": float(low), "high": float(high)}


def replicate_difference(one: np.ndarray, other: np.ndarray, paired: bool) -> np.ndarray:
    """The difference of two groups' means in each replicate, (REPLICATES,), with runs drawn again, too.

    one, other: the replicates of each run, (S, REPLICATES) and (T, REPLICATES). paired: S = T, and the s-th runs of
    both groups are drawn together.
    """
    generator = np.random.default_rng(RUNS)
    groups = [one - other] if paired else [one, -other]
    drawn = [np.take_along_axis(group, generator.integers(len(group), size=group.shape), axis=0) for group in groups]
    return sum(group.mean(axis=0) for group in drawn)


def auc_and_recalls(positives: np.ndarray, negatives: np.ndarray) -> np.ndarray:
    """RANKED, (4, ...), of scores (..., n) of positives and (..., m) of negatives.

    AUC is the probability that a positive scores above a negative, a tie counting half (Mann and Whitney 1947). Recall
    at a rate is the fraction of positives above the threshold; a positive that ties with it is missed.
    """
    values, ordered = (torch.from_numpy(np.sort(scores, axis=-1)) for scores in (positives, negatives))
    below = sum(torch.searchsorted(ordered, values, side=side).sum(-1).numpy() for side in ("left", "right"))
    recalls = [(positives > threshold[..., None]).mean(axis=-1) for threshold in thresholds(negatives)]
    return np.stack([below / (2 * positives.shape[-1] * negatives.shape[-1]), *recalls])


def thresholds(negatives: np.ndarray) -> list[np.ndarray]:
    """At each of RATES, (...), the lowest of the scores (..., m) that at most this fraction of them exceeds."""
    ordered, m = np.sort(negatives, axis=-1), negatives.shape[-1]
    return [ordered[..., m - 1 - int(Fraction(rate) * m)] for rate in RATES]  # exact, unlike 0.29 * 100


def roc_curve(positives: Scores, negatives: Scores) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """False positive rate, recall and threshold from (0, 0) to (1, 1), a point per distinct score.

    An image is called positive where its score exceeds the threshold; all exceed the last one, minus infinity.
    """
    thresholds = np.append(np.unique([*positives, *negatives])[::-1], -np.inf)
    rate, recall = (
        (len(scores) - np.sort(scores).searchsorted(thresholds, "right")) / len(scores)
        for scores in (negatives, positives)
    )
    return rate, recall, thresholds


def roc_metrics(positives: Scores, negatives: Scores) -> dict[str, Any]:
    """auc and recall_at, a mapping by rate: each {value, low, high}, None where either kind of image is missing.

    auc also has the numbers of positives and negatives, and each recall its threshold.
    """
    results: list[dict[str, Any]] = [{"value": None, "low": None, "high": None}] * len(RANKED)
    bars: list[float | None] = [None] * len(RATES)
    if len(positives) and len(negatives):
        groups = np.asarray(positives), np.asarray(negatives)
        pairs = zip(auc_and_recalls(*groups), bootstrap(auc_and_recalls, *groups), strict=True)
        results = [{"value": float(value), **interval(replicates)} for value, replicates in pairs]
        bars = [float(bar) for bar in thresholds(groups[1])]
    auc, *recalls = results
    recall_at = {rate: {**recall, "threshold": bar} for rate, recall, bar in zip(RATES, recalls, bars, strict=True)}
    return {"auc": {**auc, "positives": len(positives), "negatives": len(negatives)}, "recall_at": recall_at}


@dataclass(frozen=True)
class Pool:
    """Predictions that are scored together: of the class under study, `label`, and of everything else.

    ranked: the negatives of the ROC curve, with the named hard negatives of other sources.
    """

    label: str
    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]
    ranked: Sequence[Prediction]

    @property
    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """The log-odds of the positives, and of the negatives that they are ranked against."""
        return np.array([item.log_odds for item in self.positives]), np.array([item.log_odds for item in self.ranked])

    @property
    def outcomes(self) -> dict[str, list[bool]]:
        """Whether each image counts in recall, top5 and false_positive_rate."""
        ranks = [item.true_rank or np.inf for item in self.positives]
        return {
            "recall": [rank == 1 for rank in ranks],
            "top5": [rank <= 5 for rank in ranks],
            "false_positive_rate": [item.predicted == self.label for item in self.negatives],
        }

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """recall, top5 and false_positive_rate, as `fraction` returns them, and auc and recall_at of `roc_metrics`."""
        counted = {name: fraction(sum(values), len(values)) for name, values in self.outcomes.items()}
        return counted | roc_metrics(*self.scores)

    @cached_property
    def replicates(self) -> dict[str, np.ndarray]:
        """METRICS and top5 in the bootstrap's replicates, (REPLICATES,) each, without those that are unknown."""
        outcomes = {name: np.array(values) for name, values in self.outcomes.items() if values}
        counted = {name: bootstrap(lambda drawn: drawn.mean(axis=-1), values) for name, values in outcomes.items()}
        if not all(map(len, self.scores)):
            return counted
        return counted | dict(zip(RANKED, bootstrap(auc_and_recalls, *self.scores), strict=True))


def pool(predictions: Sequence[Prediction], label: str) -> Pool:
    """All predictions, the positives ranked against all negatives."""
    negatives = [item for item in predictions if item.photograph.label != label]
    return Pool(label, [item for item in predictions if item.photograph.label == label], negatives, negatives)


def pool_by_source(predictions: Sequence[Prediction], label: str, exclude: Sequence[str] = ()) -> dict[str, Pool]:
    """OVERALL, without the sources to exclude, and a pool per source.

    A source's positives are ranked against its own negatives and those of the sources that the positives name as hard
    negatives, as far as those could be read.
    """
    pools = {OVERALL: pool([item for item in predictions if item.photograph.source not in exclude], label)}
    for source in sorted({item.photograph.source for item in predictions if item.photograph.source is not None}):
        group = pool([item for item in predictions if item.photograph.source == source], label)
        named = {name for item in group.positives for name in item.photograph.hard_negatives} - {source}
        others = pool([item for item in predictions if item.photograph.source in named], label).negatives
        pools[source] = replace(group, ranked=[*group.negatives, *others])
    return pools


def find_metric(summary: dict[str, Any], name: str) -> dict[str, Any]:
    """One of METRICS in a summary, or in one of its sources; empty if it is not there."""
    return reduce(lambda part, key: part.get(key, {}), name.split("/"), summary)


def metric_title(name: str) -> str:
    """The name of one of METRICS in tables."""
    return TITLES.get(name) or f"recall at {float(name.rpartition('/')[2]):.0%} FPR"
