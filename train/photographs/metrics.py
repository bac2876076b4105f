"""The metrics of an evaluation, with 95 % intervals: recall, false positive rate, AUC, recall at fixed FPR.

Bootstrap replicates are samples of the images at hand, drawn with replacement, the same ones at every call, so that the
metrics of two networks on the same images are replicated in pairs.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np

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


# ------------------------------------------------------------------------------------- bootstrap


def draw_samples(*sizes: int, seed: int = IMAGES) -> Iterator[tuple[np.ndarray, ...]]:
    """Blocks of replicates: how often each image, or run, is drawn, (BLOCK, size) counts for each of the sizes.

    Each group is drawn apart (stratified), as many as it has. Equal sizes get equal draws.
    """
    generator = np.random.default_rng(seed)
    for _ in range(REPLICATES // BLOCK):
        yield tuple(_draw_counts(generator, size) for size in sizes)


def _draw_counts(generator: np.random.Generator, size: int) -> np.ndarray:
    drawn = generator.integers(size, size=(BLOCK, size)) + size * np.arange(BLOCK)[:, None]
    return np.bincount(drawn.ravel(), minlength=BLOCK * size).reshape(BLOCK, size)


def replicate_fraction(outcomes: np.ndarray) -> np.ndarray:
    """The fraction of true outcomes, (n,) with n at least 1, in each replicate: (REPLICATES,)."""
    return np.concatenate([counts @ outcomes / len(outcomes) for (counts,) in draw_samples(len(outcomes))])


def interval(replicates: np.ndarray) -> dict[str, float]:
    """low and high of the 95 % percentile interval (Efron and Tibshirani 1993, ch. 13) of (REPLICATES,) values.

    Percentiles, which pROC also uses for ROC curves (Robin et al. 2011), stay within the metric's range; the correction
    of BCa is undefined where all replicates agree, as at a recall of 1.
    """
    low, high = np.quantile(replicates, (0.025, 0.975))
    return {"low": float(low), "high": float(high)}


def replicate_difference(one: np.ndarray, other: np.ndarray, paired: bool) -> np.ndarray:
    """The difference of two groups' means in each replicate, (REPLICATES,), with runs drawn again, too.

    one, other: the replicates of each run, (S, REPLICATES) and (T, REPLICATES). paired: S = T, and the s-th runs of
    both groups are drawn together.
    """
    groups = [one - other] if paired else [one, -other]
    blocks = zip(*draw_samples(*map(len, groups), seed=RUNS), strict=True)
    counts = [np.concatenate(block) for block in blocks]  # each row sums to the group's size
    return sum((drawn.T * group).mean(axis=0) for drawn, group in zip(counts, groups, strict=True))


# ------------------------------------------------------------------------------------- ROC


class Roc:
    """The ROC curve of scores (n,) of positives and (m,) of negatives, n and m at least 1.

    An image is called positive where its score exceeds the threshold. The metrics are functions of a sample: how often
    each image counts. So scores are sorted once, and a bootstrap replicate costs a few sums.
    """

    def __init__(self, positives: Sequence[float], negatives: Sequence[float]):
        positive_scores, negative_scores = np.asarray(positives, np.float64), np.asarray(negatives, np.float64)
        self._positive_order, self._negative_order = positive_scores.argsort(), negative_scores.argsort()
        self._positives = positive_scores[self._positive_order]
        self._negatives = negative_scores[self._negative_order]

    def metrics(self, positive_counts: np.ndarray, negative_counts: np.ndarray) -> dict[str, np.ndarray]:
        """RANKED, (B,) each, of B samples: (B, n) and (B, m) counts whose rows sum to n and m.

        AUC is the probability that a positive scores above a negative, a tie counting half (Mann and Whitney 1947).
        Recall at a rate is the fraction of positives above the threshold, which is the lowest score that at most this
        fraction of the negatives exceeds; a positive that ties with it is missed.
        """
        n, m = len(self._positives), len(self._negatives)
        missed = _prefix_sums(positive_counts[:, self._positive_order])
        below = _prefix_sums(negative_counts[:, self._negative_order])
        beaten = [below[:, self._negatives.searchsorted(self._positives, side)] for side in ("left", "right")]
        auc = (positive_counts[:, self._positive_order] * sum(beaten)).sum(axis=1) / (2 * n * m)
        rows = np.arange(len(missed))
        return {"auc": auc} | {
            f"recall_at/{rate}": (n - missed[rows, self._positives.searchsorted(threshold, "right")]) / n
            for rate, threshold in self._thresholds(below).items()
        }

    def _thresholds(self, below: np.ndarray) -> dict[str, np.ndarray]:
        """The threshold at each of RATES, (B,), from the samples' sums over the sorted negatives, (B, 1 + m)."""
        m = len(self._negatives)
        above = m - below[:, self._negatives.searchsorted(self._negatives, "right")]  # falls along sorted scores
        allowed = {rate: int(Fraction(rate) * m) for rate in RATES}  # exact, unlike 0.29 * 100
        return {rate: self._negatives[(above > count).sum(axis=1)] for rate, count in allowed.items()}

    def values(self) -> dict[str, float]:
        """RANKED of the images themselves."""
        once = (np.ones((1, len(scores)), np.int64) for scores in (self._positives, self._negatives))
        return {name: float(value[0]) for name, value in self.metrics(*once).items()}

    def thresholds(self) -> dict[str, float]:
        """The threshold at each of RATES."""
        thresholds = self._thresholds(np.arange(len(self._negatives) + 1)[None])
        return {rate: float(threshold[0]) for rate, threshold in thresholds.items()}

    def replicates(self) -> dict[str, np.ndarray]:
        """RANKED in the bootstrap's replicates, (REPLICATES,) each."""
        blocks = [self.metrics(*counts) for counts in draw_samples(len(self._positives), len(self._negatives))]
        return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}

    def curve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """False positive rate, recall and threshold from (0, 0) to (1, 1), a point per distinct score.

        The last threshold is minus infinity, which all images exceed.
        """
        thresholds = np.append(np.unique(np.concatenate([self._positives, self._negatives]))[::-1], -np.inf)
        rate, recall = (
            (len(scores) - scores.searchsorted(thresholds, "right")) / len(scores)
            for scores in (self._negatives, self._positives)
        )
        return rate, recall, thresholds


def _prefix_sums(counts: np.ndarray) -> np.ndarray:
    """(B, k) to (B, 1 + k): the sums of the first 0, 1, ..., k counts."""
    return np.pad(counts.cumsum(axis=1), ((0, 0), (1, 0)))


def roc_metrics(positives: Sequence[float], negatives: Sequence[float]) -> dict[str, Any]:
    """auc and recall_at, a mapping by rate: each {value, low, high}, None where either kind of image is missing.

    auc also has the numbers of positives and negatives, and each recall its threshold.
    """
    results: dict[str, dict[str, Any]] = {name: {"value": None, "low": None, "high": None} for name in RANKED}
    thresholds: Mapping[str, float | None] = dict.fromkeys(RATES)
    if len(positives) and len(negatives):
        roc = Roc(positives, negatives)
        replicates, thresholds = roc.replicates(), roc.thresholds()
        results = {name: {"value": value, **interval(replicates[name])} for name, value in roc.values().items()}
    return {
        "auc": {**results["auc"], "positives": len(positives), "negatives": len(negatives)},
        "recall_at": {rate: {**results[f"recall_at/{rate}"], "threshold": thresholds[rate]} for rate in RATES},
    }


# ------------------------------------------------------------------------------------- pools of predictions


@dataclass(frozen=True)
class Pool:
    """Predictions that are scored together.

    positives: of the class under study. negatives: of everything else, which may become false positives. ranked: the
    negatives of the ROC curve, with the named hard negatives of other sources.
    """

    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]
    ranked: Sequence[Prediction]

    @property
    def scores(self) -> tuple[list[float], list[float]]:
        """The log-odds of the positives, and of the negatives that they are ranked against."""
        return [item.log_odds for item in self.positives], [item.log_odds for item in self.ranked]


def pool(predictions: Sequence[Prediction], label: str) -> Pool:
    """All predictions, the positives ranked against all negatives."""
    negatives = [item for item in predictions if item.photograph.label != label]
    return Pool([item for item in predictions if item.photograph.label == label], negatives, negatives)


def pool_by_source(predictions: Sequence[Prediction], label: str) -> dict[str, Pool]:
    """A pool per source, and OVERALL.

    A source's positives are ranked against its own negatives and those of the sources that the positives name as hard
    negatives, as far as those could be read.
    """
    by_source = defaultdict(list)
    for item in predictions:
        if item.photograph.source is not None:
            by_source[item.photograph.source].append(item)
    pools = {source: pool(group, label) for source, group in sorted(by_source.items())}
    ranked = {}
    for source, group in pools.items():
        named = {source}.union(*(item.photograph.hard_negatives for item in group.positives))
        negatives = [item for name in sorted(named & pools.keys()) for item in pools[name].negatives]
        ranked[source] = Pool(group.positives, group.negatives, negatives)
    return {OVERALL: pool(predictions, label), **ranked}


def compute_metrics(group: Pool, label: str) -> dict[str, Any]:
    """recall, top5 and false_positive_rate, as `fraction` returns them, and auc and recall_at of `roc_metrics`."""
    return {
        "recall": true_fraction(item.true_rank == 1 for item in group.positives),
        "top5": true_fraction(item.true_rank is not None and item.true_rank <= 5 for item in group.positives),
        "false_positive_rate": true_fraction(item.predicted == label for item in group.negatives),
        **roc_metrics(*group.scores),
    }


def replicate_metrics(group: Pool, label: str) -> dict[str, np.ndarray]:
    """METRICS in the bootstrap's replicates, (REPLICATES,) each, without those that are unknown."""
    outcomes = {
        "recall": [item.true_rank == 1 for item in group.positives],
        "false_positive_rate": [item.predicted == label for item in group.negatives],
    }
    replicates = {name: replicate_fraction(np.array(values)) for name, values in outcomes.items() if values}
    return replicates | (Roc(*group.scores).replicates() if all(group.scores) else {})


def true_fraction(outcomes: Iterable[bool]) -> dict[str, Any]:
    """The fraction of true outcomes, with its interval."""
    outcomes = list(outcomes)
    return fraction(sum(outcomes), len(outcomes))


def find_metric(summary: dict[str, Any], name: str) -> dict[str, Any]:
    """One of METRICS in a summary, or in one of its sources; empty if it is not there."""
    return reduce(lambda part, key: part.get(key, {}), name.split("/"), summary)


def metric_title(name: str) -> str:
    """The name of one of METRICS in tables."""
    return TITLES.get(name) or f"recall at {float(name.rpartition('/')[2]):.0%} FPR"
