"""How well scores tell a class from other things: ROC curve, AUC, and recall at equal false alarms."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from train.photographs.bootstrap import draw_samples, interval

RATES = ("0.05", "0.10", "0.20")  # false alarm rates at which recall is told
UNKNOWN = {"value": None, "low": None, "high": None}


class Ranking:
    """Images of a class among others, by their scores: (n,) and (m,) float64, n and m at least 1.

    An image is called the class where its score exceeds a threshold. The figures are functions of a sample, which is
    how often each image counts: once each, or as a bootstrap's replicate has it. So all scores are sorted once, and a
    replicate costs a few sums.
    """

    def __init__(self, label: Sequence[float], others: Sequence[float]):
        scores, further = np.asarray(label, np.float64), np.asarray(others, np.float64)
        self._label_order, self._others_order = scores.argsort(), further.argsort()
        self._label, self._others = scores[self._label_order], further[self._others_order]

    def figures(self, label_counts: np.ndarray, others_counts: np.ndarray) -> dict[str, np.ndarray]:
        """AUC and recall at each of RATES, (B,) each, of B samples: (B, n) and (B, m) counts whose rows sum to n and m.

        auc is the chance that an image of the class scores above one of the others, a tie counting half (Mann and
        Whitney 1947). recall at a rate is the share of the class above the threshold, which is the lowest score that
        at most this share of the others exceeds; a tie with it counts against the network.
        """
        n, m = len(self._label), len(self._others)
        missed = _prefix_sums(label_counts[:, self._label_order])
        below = _prefix_sums(others_counts[:, self._others_order])
        beaten = [below[:, self._others.searchsorted(self._label, side)] for side in ("left", "right")]
        auc = (label_counts[:, self._label_order] * sum(beaten)).sum(axis=1) / (2 * n * m)
        return {"auc": auc} | {
            rate: (n - missed[np.arange(len(missed)), self._label.searchsorted(thresholds, "right")]) / n
            for rate, thresholds in self._thresholds(below).items()
        }

    def _thresholds(self, below: np.ndarray) -> dict[str, np.ndarray]:
        """The threshold of each of RATES, (B,), from the samples' sums over the sorted others, (B, 1 + m)."""
        m = len(self._others)
        above = m - below[:, self._others.searchsorted(self._others, "right")]  # falls along the sorted others
        allowed = {rate: int(Fraction(rate) * m) for rate in RATES}  # exact, unlike 0.29 * 100
        return {rate: self._others[(above > count).sum(axis=1)] for rate, count in allowed.items()}

    def values(self) -> dict[str, float]:
        """`figures` of the images themselves."""
        return {name: float(value[0]) for name, value in self.figures(*map(_once, (self._label, self._others))).items()}

    def thresholds(self) -> dict[str, float]:
        """The threshold at each of RATES."""
        thresholds = self._thresholds(_prefix_sums(_once(self._others)))
        return {rate: float(threshold[0]) for rate, threshold in thresholds.items()}

    def replicates(self) -> dict[str, np.ndarray]:
        """`figures` of the bootstrap's replicates, (REPLICATES,) each."""
        blocks = [self.figures(*counts) for counts in draw_samples(len(self._label), len(self._others))]
        return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}

    def curve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The ROC curve from (0, 0) to (1, 1), a point per distinct score: false alarm rate, recall and threshold.

        The last threshold is minus infinity, which all images exceed.
        """
        thresholds = np.append(np.unique(np.concatenate([self._label, self._others]))[::-1], -np.inf)
        alarms, recall = (
            (len(scores) - scores.searchsorted(thresholds, "right")) / len(scores)
            for scores in (self._others, self._label)
        )
        return alarms, recall, thresholds


def rank(label: Sequence[float], others: Sequence[float]) -> dict[str, Any]:
    """Images of a class against others, by their scores.

    Returns auc: value, low, high, and how many images of the class (label) and others; recall_at: by rate, value, low,
    high and threshold. The intervals are 95 % bootstrap intervals over images, the class and the others apart. Values
    are None where either kind is missing.
    """
    told: Mapping[str, Mapping[str, float | None]] = {name: UNKNOWN for name in ("auc", *RATES)}
    thresholds: Mapping[str, float | None] = dict.fromkeys(RATES)
    if len(label) and len(others):
        ranking = Ranking(label, others)
        values, replicates, thresholds = ranking.values(), ranking.replicates(), ranking.thresholds()
        told = {name: {"value": values[name], **interval(replicates[name])} for name in values}
    return {
        "auc": {**told["auc"], "label": len(label), "others": len(others)},
        "recall_at": {rate: {**told[rate], "threshold": thresholds[rate]} for rate in RATES},
    }


def _once(scores: np.ndarray) -> np.ndarray:
    """The sample that holds each image once: (1, n) counts."""
    return np.ones((1, len(scores)), np.int64)


def _prefix_sums(counts: np.ndarray) -> np.ndarray:
    """(B, k) to (B, 1 + k): the sums of the first 0, 1, ..., k counts."""
    return np.pad(counts.cumsum(axis=1), ((0, 0), (1, 0)))
