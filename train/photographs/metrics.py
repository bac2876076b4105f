"""The metrics of an evaluation, with 95 % intervals: recall, false positive rate, AUC, recall at fixed FPR."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, partial, reduce
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from train.photographs.predictions import Prediction
from train.tables import fraction

RATES = ("0.05", "0.10", "0.20")  # the false positive rates at which recall is reported
RANKED = ("auc", *(f"recall_at/{rate}" for rate in RATES))
AT_THRESHOLD = ("recall_at_threshold", "false_positive_rate_at_threshold")  # of an operating point, where there is one
METRICS = ("recall", "false_positive_rate", *RANKED, *AT_THRESHOLD)  # by their place in a summary or its sources
TITLES = {"recall": "recall", "top5": "top-5", "false_positive_rate": "FPR", "auc": "AUC"}
TITLES |= {"recall_at_threshold": "recall at threshold", "false_positive_rate_at_threshold": "FPR at threshold"}
Thresholds = Mapping[str, float]  # by label
OVERALL = ""  # in the place of a source: all images
LABEL = "label="  # begins what stands there for all images and one of several labels
GROUPS = ("source", "mesh")

REPLICATES = 2000
BLOCK = 250  # replicates at a time, which bounds the memory
IMAGES, RUNS = 0, 1  # seeds, so that images and runs are drawn independently


def bootstrap(statistic: Callable[..., np.ndarray], *groups: np.ndarray) -> np.ndarray:
    """A statistic's values, (..., REPLICATES), of how often replicates draw each image, (BLOCK, n) per group.

    groups: the object of each image, (n,) numbers by first appearance from 0 on, n at least 1. A replicate draws as
    many objects as a group has, with replacement, and from each as many images as it has (Davison and Hinkley 1997,
    section 3.8); with an image per object that is the bootstrap over images. The variance of a mean over k objects
    comes out (k - 1) / k times too small, and with that of the images, but for one object, counted about twice. Equal
    groups get equal draws at every call, so that the metrics of networks on the same images are replicated in pairs.
    """
    generator = np.random.default_rng(IMAGES)
    blocks = ([_draw(objects, generator) for objects in groups] for _ in range(REPLICATES // BLOCK))
    return np.concatenate([statistic(*counts) for counts in blocks], axis=-1)


def _draw(objects: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    n, sizes = len(objects), np.bincount(objects)
    images = generator.integers(len(sizes), size=(BLOCK, len(sizes)))
    rows = np.arange(BLOCK).repeat(len(sizes))
    if len(sizes) < n:  # objects are drawn, and now images of each
        counts, first = sizes[images].ravel(), (sizes.cumsum() - sizes)[images].ravel()
        places = first.repeat(counts) + generator.integers(counts.repeat(counts))
        images, rows = objects.argsort(kind="stable")[places], rows.repeat(counts)
    return np.bincount(rows * n + images.ravel(), minlength=BLOCK * n).reshape(BLOCK, n)


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


def auc_and_recalls(
    positives: np.ndarray, negatives: np.ndarray, drawn: np.ndarray | None = None, others: np.ndarray | None = None
) -> np.ndarray:
    """RANKED, (4, ...), of scores (n,) of positives and (m,) of negatives.

    AUC is the probability that a positive scores above a negative, a tie counting half (Mann and Whitney 1947). Recall
    at a rate is the fraction of positives above the threshold; a positive that ties with it is missed.
    drawn, others: how often each positive (..., n) and negative (..., m) counts, once by default.
    """
    drawn = np.ones(len(positives), int) if drawn is None else drawn
    others = np.ones(len(negatives), int) if others is None else others
    order, total = negatives.argsort(), drawn.sum(axis=-1)
    below = np.insert(others[..., order].cumsum(axis=-1), 0, 0, axis=-1)
    places = [negatives[order].searchsorted(positives, side) for side in ("left", "right")]
    wins = sum((drawn * below[..., place]).sum(axis=-1) for place in places)
    recalls = [(drawn * (positives > bar[..., None])).sum(axis=-1) / total for bar in thresholds(negatives, others)]
    return np.stack([wins / (2 * total * below[..., -1]), *recalls])


def thresholds(negatives: np.ndarray, counts: np.ndarray, rates: Sequence[str] = RATES) -> list[np.ndarray]:
    """At each rate, (...), the lowest of the scores (m,), each there `counts` times (..., m), that at most this
    fraction of them exceeds."""
    order = negatives.argsort()
    below = counts[..., order].cumsum(axis=-1)
    exact = [Fraction(rate) for rate in rates]  # unlike 0.29 * 100
    allowed = [rate.numerator * below[..., -1] // rate.denominator for rate in exact]
    return [negatives[order][(below < (below[..., -1] - most)[..., None]).sum(axis=-1)] for most in allowed]


def roc_curve(positives: np.ndarray, negatives: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """False positive rate, recall and threshold from (0, 0) to (1, 1), a point per distinct score.

    An image is called positive where its score exceeds the threshold; all exceed the last one, minus infinity.
    """
    thresholds = np.append(np.unique([*positives, *negatives])[::-1], -np.inf)
    rate, recall = (
        (len(scores) - np.sort(scores).searchsorted(thresholds, "right")) / len(scores)
        for scores in (negatives, positives)
    )
    return rate, recall, thresholds


def resampled(auc: Mapping[str, Any]) -> str:
    """What the intervals of an `auc` resample: images, or objects of several images, too."""
    single = all(auc.get(f"{kind}_objects") in (None, auc.get(f"{kind}s")) for kind in ("positive", "negative"))
    return "images" if single else "objects and images"


@dataclass(frozen=True)
class Pool:
    """Predictions that are scored together: of photographs of the class under study, and of everything else.

    With several classes under study, a photograph counts once for each, by the prediction about it. ranked: the
    positives and the negatives of the ROC curve, which may be of other sources or meshes. thresholds: on the log-odds
    of each class, for AT_THRESHOLD; or none.
    """

    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]
    ranked: tuple[Sequence[Prediction], Sequence[Prediction]]
    thresholds: Thresholds = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The classes under study, in words."""
        return " or ".join(dict.fromkeys(item.label for item in (*self.positives, *self.negatives)))

    @property
    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """The log-odds of the positives and the negatives of the ROC curve."""
        positives, negatives = (np.array([item.log_odds for item in group]) for group in self.ranked)
        return positives, negatives

    @property
    def outcomes(self) -> dict[str, tuple[Sequence[Prediction], list[bool]]]:
        """The images of recall, top5, false_positive_rate and AT_THRESHOLD, and whether each counts."""
        ranks = [item.true_rank or np.inf for item in self.positives]
        outcomes = {
            "recall": (self.positives, [rank == 1 for rank in ranks]),
            "top5": (self.positives, [rank <= 5 for rank in ranks]),
            "false_positive_rate": (self.negatives, [item.predicted == item.label for item in self.negatives]),
        }
        if self.thresholds:
            for name, group in zip(AT_THRESHOLD, (self.positives, self.negatives), strict=True):
                outcomes[name] = group, [item.log_odds > self.thresholds[item.label] for item in group]
        return outcomes

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """n, fractions of `outcomes` as `fraction` returns them, and auc and recall_at, a mapping by rate.

        The last two are {value, low, high}, None where either kind of image is missing. auc also has the numbers of
        positives and negatives, and of their objects.
        """
        counted = {name: fraction(sum(hits), len(hits)) for name, (_, hits) in self.outcomes.items()}
        ranked: list[dict[str, Any]] = [{"value": None, "low": None, "high": None}] * len(RANKED)
        if all(self.ranked):
            values = zip(auc_and_recalls(*self.scores), self._ranked_replicates, strict=True)
            ranked = [{"value": float(value), **interval(replicates)} for value, replicates in values]
        auc, *recalls = ranked
        for kind, group in zip(("positive", "negative"), self.ranked, strict=True):
            auc = {**auc, f"{kind}s": len(group), f"{kind}_objects": len(set(_objects(group)))}
        recall_at = dict(zip(RATES, recalls, strict=True))
        return {"n": len(self.positives) + len(self.negatives), **counted, "auc": auc, "recall_at": recall_at}

    @cached_property
    def _ranked_replicates(self) -> np.ndarray:
        return bootstrap(partial(auc_and_recalls, *self.scores), *map(_objects, self.ranked))

    @cached_property
    def replicates(self) -> dict[str, np.ndarray]:
        """METRICS and `outcomes` in the bootstrap's replicates, (REPLICATES,) each, without those that are unknown."""
        replicates = {
            name: bootstrap(partial(weighted_mean, np.array(hits)), _objects(group))
            for name, (group, hits) in self.outcomes.items()
            if hits
        }
        return replicates | dict(zip(RANKED, self._ranked_replicates if all(self.ranked) else (), strict=False))


def weighted_mean(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """A statistic for `bootstrap`: the mean of values (n,), each of which counts as often as it is drawn (..., n)."""
    return counts @ values / counts.sum(axis=-1)


def _objects(predictions: Sequence[Prediction]) -> np.ndarray:
    """The object of each image as a number, as `bootstrap` takes them; one of unknown mesh is an object of its own."""
    numbers: dict[str | PurePosixPath, int] = {}
    names = (item.photograph.mesh or item.photograph.path for item in predictions)
    return np.array([numbers.setdefault(name, len(numbers)) for name in names])


def pool(predictions: Sequence[Prediction], thresholds: Thresholds | None = None) -> Pool:
    """All predictions, the positives ranked against all negatives."""
    positives = [item for item in predictions if item.positive]
    negatives = [item for item in predictions if not item.positive]
    return Pool(positives, negatives, (positives, negatives), thresholds or {})


def pool_by(
    predictions: Sequence[Prediction], by: str, exclude: Sequence[str] = (), thresholds: Thresholds | None = None
) -> dict[str, Pool]:
    """OVERALL, without the sources to exclude, and a pool per source or, of what is in OVERALL, per mesh or per label,
    the class under study.

    A source's positives are ranked against its own negatives and those of the sources that the positives name as hard
    negatives, as far as those could be read; a mesh's images against all of the other kind.
    """
    whole = pool([item for item in predictions if item.photograph.source not in exclude], thresholds)
    pools, labels = {OVERALL: whole}, {item.label for item in predictions}
    items = predictions if by == "source" else [*whole.positives, *whole.negatives]

    def name_of(item: Prediction) -> str | None:
        return item.label if by == "label" else getattr(item.photograph, by)

    for name in sorted({name for item in items if (name := name_of(item)) is not None}):
        group = pool([item for item in items if name_of(item) == name], thresholds)
        if by == "mesh":
            of_none = [item for item in group.negatives if item.photograph.label not in labels]
            group = replace(group, ranked=(group.positives or whole.positives, of_none or whole.negatives))
        if by == "source":
            pairs = {(item.label, source) for item in group.positives for source in item.photograph.hard_negatives}
            named = pairs - {(label, name) for label, _ in pairs}
            others = pool([item for item in items if (item.label, item.photograph.source) in named]).negatives
            group = replace(group, ranked=(group.positives, [*group.negatives, *others]))
        pools[name] = group
    return pools


def find_metric(summary: dict[str, Any], name: str) -> dict[str, Any]:
    """One of METRICS in a summary, or in one of its sources; empty if it is not there."""
    return reduce(lambda part, key: part.get(key, {}), name.split("/"), summary)


def metric_title(name: str) -> str:
    """The name of one of METRICS in tables."""
    return TITLES.get(name) or f"recall at {float(name.rpartition('/')[2]):.0%} FPR"
