"""Metrics of an evaluation with 95% intervals: recall, false-positive rate, AUC and top-1.

A `Pool` is a set of predictions that are scored together. It computes their
`Metrics`. `Pooled` has all pools of one evaluation: the pool of all images, and
the pools of each label, source, mesh and class. The functions below them compute
the statistics: the jackknife and its intervals, the AUC, the recall at a given
false-positive rate, and means over classes.

A label is the name of a positive class. A prediction scores how well an image
fits a label. The image is a positive if it shows this class. Otherwise it is a
negative.
"""

import fractions
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from renderer.short_repr import ShortRepr
from train.results.predictions import Prediction
from train.results.tables import (
    IMAGES,
    OBJECTS,
    THESE_OBJECTS,
    Estimate,
    Proportion,
    fraction,
)

# False-positive rates at which the recall is reported. Decimal strings are exact,
# while a float such as 0.1 is not.
RATES = ("0.05", "0.10", "0.20")
# Names of the metrics that depend on the ranking of the images, in the order in which
# `auc_and_recalls` returns them.
ROC_METRICS = ("auc", *(f"recall_at/{rate}" for rate in RATES))
# Names of the metrics that need a threshold on the log-odds of each label.
AT_THRESHOLD: tuple[str, ...] = ("recall_at_threshold", "false_positive_rate_at_threshold")
# Top-1 and top-5 accuracy among all classes of the network, as means over classes.
# The value is the largest rank of the true class that counts as correct.
TOP_RANKS = {"class_top1": 1, "class_top5": 5}
# Names of the metrics that are fractions of images. The table of an evaluation shows
# them in this order.
FRACTION_METRICS: tuple[str, ...] = ("recall", "top5", "false_positive_rate", *AT_THRESHOLD)
# Names of the metrics that reports show, in this order. "recall_at/0.05" is the entry
# "0.05" of the entry "recall_at" in summary.json.
METRICS: tuple[str, ...] = (
    "recall",
    "false_positive_rate",
    *ROC_METRICS,
    *AT_THRESHOLD,
    *TOP_RANKS,
)
# Titles of the metrics in tables, by the name of the metric.
TITLES = {
    "recall": "recall",
    "top5": "top-5",
    "false_positive_rate": "FPR",
    "auc": "AUC",
    "recall_at_threshold": "recall at threshold",
    "false_positive_rate_at_threshold": "FPR at threshold",
    "class_top1": "top-1, mean over classes",
    "class_top5": "top-5, mean over classes",
}

# Words after the number of negatives, if there are several positive classes.
COUNTED_EACH = ", once for each of these classes"
# Operating points by label: thresholds on the log-odds above which an image counts as
# a detection.
Thresholds = Mapping[str, float]


# Smallest number of objects of each kind for intervals over objects. With fewer objects,
# the interval of an AUC covers more than half of [0, 1] (benchmarks/coverage.py).
MIN_OBJECTS = 5
# Largest number of groups into which the objects are divided, each of which is left out
# once. More groups would hardly change the interval, but the variance of a recall at a
# false-positive rate, which depends on a quantile, needs groups of several images.
MAX_GROUPS = 30
# Smallest ratio of the errors without a group to all errors. It keeps the logit finite if
# all errors are in one group.
MIN_RATIO = 0.2


@dataclass(frozen=True)
class AreaUnderCurve(Estimate):
    """Area under the ROC curve with its 95% interval.

    The area is unknown if there are no positives or no negatives.

    Attributes:
        positives: Number of positive images.
        positive_objects: Number of different objects in the positive images.
        negatives: Number of negative images.
        negative_objects: Number of different objects in the negative images.
    """

    positives: int = 0
    positive_objects: int = 0
    negatives: int = 0
    negative_objects: int = 0


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Metrics of predictions that are scored together, in the order of summary.json.

    A positive is an image of the positive class. A negative is any other image.

    Attributes:
        n: Number of images, positives and negatives together.
        recall: Fraction of the positives whose predicted class is the positive
            class.
        top5: Fraction of the positives for which the positive class is among
            the five most probable classes.
        false_positive_rate: Fraction of the negatives whose predicted class is
            the positive class.
        recall_at_threshold: Fraction of the positives whose log-odds exceed the
            threshold. None without a threshold.
        false_positive_rate_at_threshold: Fraction of the negatives whose
            log-odds exceed the threshold. None without a threshold.
        auc: Area under the ROC curve.
        recall_at: Recall at each false-positive rate in `RATES`.
        class_top1: Top-1 accuracy among all classes of the network, as a mean
            over the classes of the images. Images of classes that the network
            lacks do not count. None if all images are of such classes.
        class_top5: Top-5 accuracy, computed like `class_top1`.
    """

    n: int = 0
    recall: Proportion = field(default_factory=Proportion)
    top5: Proportion = field(default_factory=Proportion)
    false_positive_rate: Proportion = field(default_factory=Proportion)
    recall_at_threshold: Proportion | None = None
    false_positive_rate_at_threshold: Proportion | None = None
    auc: AreaUnderCurve = field(default_factory=AreaUnderCurve)
    recall_at: Mapping[str, Estimate] = field(default_factory=dict)
    class_top1: Estimate | None = None
    class_top5: Estimate | None = None

    def find(self, name: str) -> Estimate | None:
        """Return a metric by its name.

        A name is "auc", "top5" or "recall_at/0.05". None if it was not computed.
        """
        attribute, _, rate = name.partition("/")
        return self.recall_at.get(rate) if rate else getattr(self, attribute)

    def to_summary(self) -> dict[str, Any]:
        """Convert the metrics to entries of summary.json. Metrics that are None are left out."""
        entries = asdict(self)
        return {name: entry for name, entry in entries.items() if entry is not None}

    @classmethod
    def read(cls, entries: Mapping[str, Any]) -> "Metrics":
        """Read metrics from summary.json, or from the file of a published network.

        A metric that an earlier version did not write is unknown. The number of images is not read,
        because summary.json has another entry of this name.
        """
        kinds = {**dict.fromkeys(FRACTION_METRICS, Proportion), "auc": AreaUnderCurve}
        found: dict[str, Any] = {}
        for name in (*kinds, *TOP_RANKS):
            if entries.get(name):
                found[name] = _read_estimate(entries[name], kinds.get(name, Estimate))
        # summary.json has all rates under one name. A published network has a name for each.
        nested = entries.get("recall_at") or {}
        of_rates = {rate: entries.get(f"recall_at/{rate}") or nested.get(rate) for rate in RATES}
        found["recall_at"] = {
            rate: _read_estimate(entry, Estimate) for rate, entry in of_rates.items() if entry
        }
        return cls(**found)


def _read_estimate(entry: Mapping[str, Any], kind: type[Estimate]) -> Estimate:
    """Read an estimate of a kind. Its value is needed; what an earlier version lacks is unknown."""
    numbers = {item.name: entry[item.name] for item in fields(kind) if item.name in entry}
    for name in ("value", "low", "high"):
        if entry["value"] is not None:
            numbers[name] = float(entry[name])
    return kind(**numbers)


class RocPredictions(NamedTuple):
    """Predictions whose log-odds give a ROC curve.

    Attributes:
        positives: Predictions for images of the positive class.
        negatives: Predictions for other images.
    """

    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]


@dataclass(frozen=True)
class Outcome:
    """Predictions, and which of them are hits. A metric is the fraction of hits.

    Attributes:
        predictions: Predictions over which the fraction is taken.
        hits: Whether each prediction is a hit.
    """

    predictions: Sequence[Prediction]
    hits: Sequence[bool]

    @cached_property
    def proportion(self) -> Proportion:
        """Fraction of hits with its 95% interval, which is Wilson's if no unit is repeated."""
        proportion = fraction(sum(self.hits), len(self.hits))
        if proportion.value is None:
            return proportion
        if self.jackknife.unit_count == proportion.n:
            return replace(proportion, over=self.jackknife.over)
        ends = self.jackknife.estimate
        return replace(proportion, low=ends.low, high=ends.high, over=ends.over)

    @cached_property
    def jackknife(self) -> "Jackknife":
        """Fraction of hits without each unit."""
        statistic = partial(weighted_means, np.array([self.hits], float))
        (jackknife,) = leave_out(statistic, choose_units(self.predictions))
        return jackknife


def within_rank(predictions: Sequence[Prediction], max_rank: int) -> Outcome:
    """Find the predictions whose true class is among the most probable classes."""
    # `true_rank` is None if the network lacks the class. No prediction is then a hit, because
    # infinity is above every rank.
    hits = [(prediction.true_rank or np.inf) <= max_rank for prediction in predictions]
    return Outcome(predictions, hits)


@dataclass(frozen=True, repr=False)
class Pool(ShortRepr):
    """Set of predictions that are scored together.

    With several labels, a photograph has one prediction for each label. All of
    these predictions count.

    Attributes:
        positives: Predictions for photographs whose class is the label.
        negatives: Predictions for all other photographs.
        for_roc: Predictions for the ROC curve. They may include photographs of
            other sources or meshes than `positives` and `negatives` do.
        thresholds: Threshold on the log-odds of each label. If it is empty, the
            metrics in `AT_THRESHOLD` are None.
    """

    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]
    for_roc: RocPredictions
    thresholds: Thresholds = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Labels of the predictions as text, such as "orange" or "orange or lemon"."""
        predictions = [*self.positives, *self.negatives]
        # The keys of a dictionary are unique, and keep the order of first appearance.
        return " or ".join(dict.fromkeys(prediction.label for prediction in predictions))

    @property
    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """Log-odds for the ROC curve: of the positives, shape (n,), and of the negatives, (m,)."""
        positives = np.array([prediction.log_odds for prediction in self.for_roc.positives])
        negatives = np.array([prediction.log_odds for prediction in self.for_roc.negatives])
        return positives, negatives

    @cached_property
    def outcomes(self) -> dict[str, Outcome]:
        """Hits and misses for each metric that is a fraction of images, such as recall."""
        false_positives = [item.predicted == item.label for item in self.negatives]
        outcomes = {
            "recall": within_rank(self.positives, 1),
            "top5": within_rank(self.positives, 5),
            "false_positive_rate": Outcome(self.negatives, false_positives),
        }
        if self.thresholds:
            recall, false_positive_rate = AT_THRESHOLD
            outcomes[recall] = self._above_threshold(self.positives)
            outcomes[false_positive_rate] = self._above_threshold(self.negatives)
        return outcomes

    def _above_threshold(self, predictions: Sequence[Prediction]) -> Outcome:
        """Find the predictions whose log-odds exceed the threshold of their label."""
        hits = [item.log_odds > self.thresholds[item.label] for item in predictions]
        return Outcome(predictions, hits)

    @cached_property
    def metrics(self) -> Metrics:
        """Metrics of the predictions with their 95% intervals."""
        proportions = {name: outcome.proportion for name, outcome in self.outcomes.items()}
        known = {name: jackknife.estimate for name, jackknife in self._ranked.items()}
        auc, *recalls = (known.get(name, Estimate()) for name in ROC_METRICS)
        auc_with_counts = AreaUnderCurve(
            **asdict(auc),
            positives=len(self.for_roc.positives),
            positive_objects=_count_objects(self.for_roc.positives),
            negatives=len(self.for_roc.negatives),
            negative_objects=_count_objects(self.for_roc.negatives),
        )
        return Metrics(
            n=len(self.positives) + len(self.negatives),
            auc=auc_with_counts,
            recall_at=dict(zip(RATES, recalls, strict=True)),
            **proportions,
            class_top1=known.get("class_top1"),
            class_top5=known.get("class_top5"),
        )

    @cached_property
    def classified(self) -> list[Prediction]:
        """One prediction for each photograph whose class is a class of the network.

        With several labels, a photograph has several predictions. All of them
        have the same predicted class, so the first one is taken.
        """
        prediction_of_path: dict[PurePosixPath, Prediction] = {}
        for prediction in (*self.positives, *self.negatives):
            if prediction.true_rank is not None:
                prediction_of_path.setdefault(prediction.photograph.path, prediction)
        return list(prediction_of_path.values())

    @cached_property
    def _ranked(self) -> dict[str, "Jackknife"]:
        """Values without each unit of the known metrics that depend on a ranking."""
        jackknives: dict[str, Jackknife] = {}
        if self.for_roc.positives and self.for_roc.negatives:
            of_roc = leave_out_of_roc(*self.scores, choose_units(*self.for_roc))
            jackknives.update(zip(ROC_METRICS, of_roc, strict=True))
        if self.classified:
            names = [prediction.photograph.label for prediction in self.classified]
            ranks = np.array([prediction.true_rank for prediction in self.classified])
            # One row for top-1 and one for top-5, shape (2, n).
            hits = np.stack([ranks <= max_rank for max_rank in TOP_RANKS.values()])
            of_classes = leave_out(partial(class_means, hits, names), choose_units(self.classified))
            jackknives.update(zip(TOP_RANKS, of_classes, strict=True))
        return jackknives

    @cached_property
    def jackknives(self) -> dict[str, "Jackknife"]:
        """For each metric that is known, its values without each unit."""
        outcomes = {name: item.jackknife for name, item in self.outcomes.items() if item.hits}
        return {**outcomes, **self._ranked}


class Units(NamedTuple):
    """Units over which an interval is taken: objects, or images.

    Attributes:
        groups: For each group of images, the index of the unit that each image
            belongs to, from 0, shape (n,).
        over: What the units are: OBJECTS, IMAGES or THESE_OBJECTS.
    """

    groups: Sequence[np.ndarray]
    over: str


def choose_units(*groups: Sequence[Prediction]) -> Units:
    """Choose objects as units if each group shows enough of them, and otherwise images.

    Images show the same object if they have the same mesh. An image with an
    unknown mesh counts as a different object.
    """
    objects = [[item.photograph.mesh or item.photograph.path for item in group] for group in groups]
    if all(len({*names}) >= MIN_OBJECTS for names in objects):
        has_mesh = any(item.photograph.mesh for group in groups for item in group)
        return Units([_number(names) for names in objects], OBJECTS if has_mesh else IMAGES)
    images = [[item.photograph.path for item in group] for group in groups]
    over = IMAGES if images == objects else THESE_OBJECTS
    return Units([_number(names) for names in images], over)


def _number(names: Sequence[object]) -> np.ndarray:
    """Number names from 0 in order of first appearance, shape (n,)."""
    number_of_name: dict[object, int] = {}
    return np.array([number_of_name.setdefault(name, len(number_of_name)) for name in names])


def _count_objects(predictions: Sequence[Prediction]) -> int:
    """Count the different objects in the photographs of predictions."""
    return len({item.photograph.mesh or item.photograph.path for item in predictions})


def pool(predictions: Sequence[Prediction], thresholds: Thresholds | None = None) -> Pool:
    """Collect predictions that are scored together, with one ROC curve of all of them.

    `thresholds` are limits of the log-odds by label. None omits the metrics that need them.
    """
    positives = [prediction for prediction in predictions if prediction.positive]
    negatives = [prediction for prediction in predictions if not prediction.positive]
    return Pool(
        positives=positives,
        negatives=negatives,
        for_roc=RocPredictions(positives, negatives),
        thresholds=thresholds or {},
    )


@dataclass(frozen=True, repr=False)
class Pooled(ShortRepr):
    """Predictions of one evaluation, grouped by label, source, mesh and class.

    Each group is a `Pool`, whose predictions are scored together.

    Attributes:
        predictions: Predictions for one or several labels.
        exclude: Names of sources that are left out of all groups except
            `by_source`.
        thresholds: Threshold on the log-odds of each label. If it is empty, the
            metrics in `AT_THRESHOLD` are None.
    """

    predictions: Sequence[Prediction]
    exclude: Sequence[str] = ()
    thresholds: Thresholds = field(default_factory=dict)

    @cached_property
    def all(self) -> Pool:
        """Predictions that are scored together: all, except those of excluded sources."""
        return pool(self._included, self.thresholds)

    def groups(self, by: str) -> dict[str, Pool]:
        """Groups by a property: "label", "source", "mesh" or "class". "all" is one group, ""."""
        return {"": self.all} if by == "all" else getattr(self, f"by_{by}")

    @cached_property
    def by_label(self) -> dict[str, Pool]:
        """For each label, its predictions, which are scored together."""
        groups = _group(self._included, lambda prediction: prediction.label)
        return {label: pool(group, self.thresholds) for label, group in groups.items()}

    @cached_property
    def by_source(self) -> dict[str, Pool]:
        """For each source, the predictions for its images, which are scored together.

        Excluded sources are included here.

        The ROC curve compares the positives of a source with its negatives. A
        positive can name other sources in its `hard_negatives`. The negatives
        of these sources are added.
        """
        groups = _group(self.predictions, lambda prediction: prediction.photograph.source)
        pools = {}
        for source, group in groups.items():
            source_pool = pool(group, self.thresholds)
            hard_negatives = self._hard_negatives(source_pool.positives, source)
            for_roc = RocPredictions(
                positives=source_pool.positives,
                negatives=[*source_pool.negatives, *hard_negatives],
            )
            pools[source] = replace(source_pool, for_roc=for_roc)
        return pools

    def _hard_negatives(self, positives: Sequence[Prediction], source: str) -> list[Prediction]:
        """Find the negatives in the sources that positives name as hard negatives.

        The negatives of `source` itself are left out.
        """
        wanted = set()
        for prediction in positives:
            for other_source in prediction.photograph.hard_negatives:
                if other_source != source:
                    wanted.add((prediction.label, other_source))
        hard_negatives = []
        for prediction in self.predictions:
            label_and_source = (prediction.label, prediction.photograph.source)
            if not prediction.positive and label_and_source in wanted:
                hard_negatives.append(prediction)
        return hard_negatives

    @cached_property
    def by_mesh(self) -> dict[str, Pool]:
        """For each known mesh, the predictions for its images, which are scored together."""
        return self._by_content(lambda prediction: prediction.photograph.mesh)

    @cached_property
    def by_class(self) -> dict[str, Pool]:
        """For each class, the predictions for its images, which are scored together."""
        return self._by_content(lambda prediction: prediction.photograph.label)

    def _by_content(self, name_of: Callable[[Prediction], str | None]) -> dict[str, Pool]:
        """Collect the predictions for the images of each mesh, or of each class.

        The ROC curve of a mesh of a positive class compares the images of this
        mesh with all negatives. The ROC curve of another mesh compares all
        positives with the images of this mesh. The same holds for classes.
        """
        labels = {prediction.label for prediction in self.predictions}
        pools = {}
        for name, group in _group(self._included, name_of).items():
            own_pool = pool(group, self.thresholds)
            # Images of positive classes are left out. With the labels orange and lemon,
            # an image of an orange is also a negative for lemon, so oranges would be
            # compared with themselves.
            negatives = [
                prediction
                for prediction in own_pool.negatives
                if prediction.photograph.label not in labels
            ]
            for_roc = RocPredictions(
                positives=own_pool.positives or self.all.positives,
                negatives=negatives or self.all.negatives,
            )
            pools[name] = replace(own_pool, for_roc=for_roc)
        return pools

    @cached_property
    def _included(self) -> list[Prediction]:
        """Predictions for images of sources that are not excluded."""
        return [item for item in self.predictions if item.photograph.source not in self.exclude]


def _group(
    predictions: Sequence[Prediction], name_of: Callable[[Prediction], str | None]
) -> dict[str, list[Prediction]]:
    """Group predictions by a name, such as the name of their source.

    Predictions whose name is None are left out. The names are sorted.
    """
    groups: dict[str, list[Prediction]] = {}
    for prediction in predictions:
        name = name_of(prediction)
        if name is not None:
            groups.setdefault(name, []).append(prediction)
    return {name: groups[name] for name in sorted(groups)}


@dataclass(frozen=True)
class Jackknife:
    """Statistics in [0, 1], and their values if one unit is left out.

    Attributes:
        value: Values on all images, shape (...).
        without: For each group of units, such as the positive and the negative
            objects, the values without each unit, shape (..., k).
        unit_count: Smallest number of units in a group.
        over: What the units are.
        at_ends: Values at both ends of the interval of the threshold, shape (2, ...),
            for a recall whose threshold depends on the second group. Otherwise None.
    """

    value: np.ndarray
    without: Sequence[np.ndarray]
    unit_count: int
    over: str
    at_ends: np.ndarray | None = None

    @cached_property
    def interval(self) -> np.ndarray:
        """Ends of the 95% intervals, logit(value) ± t · standard error, shape (2, ...).

        The variance of logit(value) is the sum of the jackknife variances of
        the groups (Efron and Stein 1981). The degrees of freedom of the
        quantile t are the harmonic mean of those of the groups, weighted by
        variance. They do not exceed those of Welch and Satterthwaite, which
        cover too little if effects of objects have heavy tails. Without
        variance, as at a value of 1, the interval is Wilson's for a fraction of
        the units.

        With `at_ends`, this is the interval at a fixed threshold. Its distances from the value and
        those of `at_ends` are added in squares (Zou and Donner 2008).
        """
        value = np.asarray(self.value)
        if self.at_ends is not None:
            positives, _, *seeds = self.without
            fixed = replace(self, without=[positives, *seeds], at_ends=None).interval
            down, up = np.hypot(fixed - value, self.at_ends - value)
            return np.clip([value - down, value + up], 0, 1)
        if min((item.shape[-1] for item in self.without), default=0) < 2:
            return np.stack([np.zeros_like(value), np.ones_like(value)])
        is_inner = (value > 0) & (value < 1)
        inner = np.where(is_inner, value, 0.5)
        errors = [_keep_errors(item, inner[..., None]) for item in self.without]
        spread = _Spread.of([np.where(is_inner[..., None], _logit(item), 0.0) for item in errors])
        half_width = spread.quantile * spread.variance**0.5
        ends = 1 / (1 + np.exp(np.stack([half_width, -half_width]) - _logit(inner)))
        wilson = _wilson(value, self.unit_count, spread.quantile)
        return np.where(spread.variance > 0, ends, wilson)

    @property
    def is_open(self) -> np.ndarray:
        """Whether no positive exceeds the high end of the threshold, shape (...)."""
        return np.zeros_like(self.value, bool) if self.at_ends is None else self.at_ends[0] == 0

    @property
    def estimate(self) -> Estimate:
        """Value with its 95% interval."""
        return Estimate(float(self.value), *map(float, self.interval), self.over)


def leave_out(statistic: Callable[..., np.ndarray], units: Units) -> list[Jackknife]:
    """Evaluate M statistics without each unit, or without each of MAX_GROUPS groups of units.

    Images of the same object are not independent, so an object is left out with
    all its images. The groups of units depend only on `units`. Metrics of two
    networks on the same images are therefore paired. `statistic` takes, for each group, how often
    each of its n images counts, shape (k, n), and returns an array of shape (M, ..., k).
    """
    counts = [np.ones((1, len(unit_of_image)), int) for unit_of_image in units.groups]
    values = statistic(*counts)
    unit_counts = [int(unit_of_image.max()) + 1 for unit_of_image in units.groups]
    without = []
    for group, unit_of_image in enumerate(units.groups):
        unit_count = unit_counts[group]
        if unit_count == 1:
            without.append(values)
            continue
        part_count = min(unit_count, MAX_GROUPS)
        # A random order divides the units into parts of about equal size.
        order = np.random.default_rng(0).permutation(unit_count)
        part_of_image = (order * part_count // unit_count)[unit_of_image]
        is_kept = part_of_image != np.arange(part_count)[:, None]
        kept = [*counts[:group], is_kept.astype(int), *counts[group + 1 :]]
        without.append(statistic(*kept))
    rows = zip(values[..., 0], *without, strict=True)
    return [Jackknife(value, others, min(unit_counts), units.over) for value, *others in rows]


def leave_out_of_roc(
    positives: Num[np.ndarray, "... n"], negatives: Num[np.ndarray, "... m"], units: Units
) -> list[Jackknife]:
    """Evaluate ROC_METRICS without each unit, and the recalls at the ends of their thresholds.

    The false-positive rate at the estimated threshold has an interval around the nominal rate. The
    ends of the interval of the threshold are the scores that these fractions of the negatives
    exceed (Woodruff 1952). If less than half a negative exceeds an end, it may be above all scores.
    """
    # The axis before the last is for the units that are left out.
    statistic = partial(auc_and_recalls, positives[..., None, :], negatives[..., None, :])
    auc, *recalls = leave_out(statistic, units)
    count = negatives.shape[-1]
    descending = -np.sort(-negatives, axis=-1)
    results = [auc]
    levels = thresholds(negatives, np.ones(count, int))
    for rate, recall, threshold in zip(RATES, recalls, levels, strict=True):
        is_above = negatives > threshold[..., None]
        is_tied = negatives == threshold[..., None]
        # Negatives at the threshold count in part, so that the rate is the nominal one.
        missing = float(rate) * count - is_above.sum(axis=-1, keepdims=True)
        hits = is_above + is_tied * missing / is_tied.sum(axis=-1, keepdims=True)
        (rates,) = leave_out(partial(weighted_means, hits[None]), Units(units.groups[1:], ""))
        exceeding = rates.interval * count
        places = exceeding.astype(int).clip(max=count - 1)[..., None]
        is_detected = positives > _take(descending, places)
        at_ends = np.where(exceeding < 0.5, 0.0, is_detected.mean(axis=-1))
        results.append(replace(recall, at_ends=at_ends))
    return results


def average(runs: Sequence[Jackknife]) -> Jackknife:
    """Average a metric over training runs. Several runs are a further group of units."""
    values = np.stack([run.value for run in runs])
    groups = zip(*(run.without for run in runs), strict=True)
    without = [np.mean(group, axis=0) for group in groups]
    over = runs[0].over
    if len(runs) > 1:
        without.append(np.moveaxis((values.sum(axis=0) - values) / (len(runs) - 1), 0, -1))
        over = f"seeds and {over}"
    all_ends = [run.at_ends for run in runs if run.at_ends is not None]
    at_ends = np.mean(all_ends, axis=0) if all_ends else None
    return Jackknife(values.mean(axis=0), without, runs[0].unit_count, over, at_ends)


def change(
    after: Sequence[Jackknife], before: Sequence[Jackknife], is_paired: bool = True
) -> Estimate:
    """Subtract the means of a metric over two groups of runs, with the 95% interval.

    The interval combines those of both means and their correlation (Zou and
    Donner 2008), so it is as asymmetric as they are. If both groups have the
    same values without each unit, it is that of 0 changes in Wilson's sense. `is_paired` says that
    run i of both has the same seed.
    """
    one, other = average(after), average(before)
    over = max(one.over, other.over, key=len)
    ends = change_ends(one, other, is_paired)
    return Estimate(float(one.value - other.value), *map(float, ends), over)


def change_ends(one: Jackknife, other: Jackknife, is_paired: bool = True) -> np.ndarray:
    """Compute the ends of the interval of `change` from averages over runs, shape (2, ...)."""
    value = one.value - other.value
    if min((item.shape[-1] for item in [*one.without, *other.without]), default=0) < 2:
        return np.stack([np.full_like(value, -1), np.full_like(value, 1)])
    # Runs that are not paired are the last group.
    group_count = len(one.without) if is_paired else -1
    pairs = list(zip(one.without[:group_count], other.without, strict=False))
    product = _Spread.of(one.without).variance * _Spread.of(other.without).variance
    covariance = np.sum([_covariance(*pair) for pair in pairs], axis=0)
    correlation = np.where(product > 0, covariance / np.where(product > 0, product, 1) ** 0.5, 0)
    low, high = one.interval
    other_low, other_high = other.interval
    down = _half_width(one.value - low, other_high - other.value, correlation, one.is_open)
    up = _half_width(high - one.value, other.value - other_low, correlation, other.is_open)
    ends = np.clip([value - down, value + up], -1, 1)
    is_same = (value == 0) & np.all([(a == b).all(axis=-1) for a, b in pairs], axis=0)
    if one.at_ends is not None and other.at_ends is not None:
        is_same &= (one.at_ends == other.at_ends).all(axis=0)
    margin = fraction(0, one.unit_count).high
    assert margin is not None
    return np.where(is_same, np.multiply.outer([-margin, margin], np.ones_like(value)), ends)


def _half_width(
    a: np.ndarray, b: np.ndarray, correlation: np.ndarray, is_open: np.ndarray
) -> np.ndarray:
    """Half width of a difference whose parts have the half widths a and b.

    If the threshold of a recall may be above all scores (`is_open`), the recall has no lower limit.
    Its distance is then no error that partly cancels, and the distances are added.
    """
    squared = np.where(is_open, (a + b) ** 2, a * a + b * b - 2 * correlation * a * b)
    return np.maximum(0.0, squared) ** 0.5


def _covariance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Jackknife covariance of two statistics, from their values without each of k units."""
    count = one.shape[-1]
    deviations = (x - x.mean(axis=-1, keepdims=True) for x in (one, other))
    return (count - 1) * np.mean(np.multiply(*deviations), axis=-1)


class _Spread(NamedTuple):
    """Jackknife variance of a statistic, and the quantile of Student's t for its interval."""

    variance: np.ndarray
    quantile: np.ndarray

    @classmethod
    def of(cls, without: Sequence[np.ndarray]) -> "_Spread":
        """Add the variances of the groups of units, from the values without each unit."""
        # This import is here because it takes a second.
        from scipy.special import stdtrit

        degrees = np.array([item.shape[-1] - 1 for item in without])
        variances = np.stack([_covariance(values, values) for values in without], axis=-1)
        total = variances.sum(axis=-1)
        terms = (variances / degrees).sum(axis=-1)
        freedom = np.where(total > 0, total / np.where(total > 0, terms, 1), degrees.min())
        return cls(total, stdtrit(freedom, 0.975))


def _keep_errors(values: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Keep at least MIN_RATIO of the distance of a value from 0 and from 1."""
    return values.clip(MIN_RATIO * value, 1 - MIN_RATIO * (1 - value))


def _logit(values: np.ndarray) -> np.ndarray:
    """Log-odds of values in (0, 1)."""
    return np.log(values) - np.log1p(np.negative(values))


def _wilson(value: np.ndarray, n: int, quantile: np.ndarray) -> np.ndarray:
    """Ends of Wilson's interval of a fraction of n units, with a quantile of Student's t."""
    shift = quantile**2 / n
    center = (value + shift / 2) / (1 + shift)
    half_width = (value * (1 - value) * shift + shift**2 / 4) ** 0.5 / (1 + shift)
    return np.clip([center - half_width, center + half_width], 0, 1)


def weighted_means(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Compute means over images that count several times: (..., n) and (k, n) to (..., k)."""
    return values @ counts.T / counts.sum(axis=-1)


def class_means(
    hits: Bool[np.ndarray, "... n"], names: Sequence[str], counts: Num[np.ndarray, "k n"]
) -> Float[np.ndarray, "... k"]:
    """Compute the fraction of hits in each class, and average it over the classes.

    This is the mean over all images if an image of a class with n images has
    the weight 1 / n. `functools.partial(class_means, hits, names)` is a
    statistic for `leave_out`. `hits` has a row for each definition of a hit, such as top-1, and
    `counts` says how often each image counts.
    """
    _, class_of_image, class_sizes = np.unique(names, return_inverse=True, return_counts=True)
    weights = 1 / class_sizes[class_of_image]
    # Sums in the same order make a mean of ones exactly 1.
    weight_of_image = weights * counts
    return (hits[..., None, :] * weight_of_image).sum(axis=-1) / weight_of_image.sum(axis=-1)


def auc_and_recalls(
    positives: Num[np.ndarray, "... n"],
    negatives: Num[np.ndarray, "... m"],
    positive_counts: Int[np.ndarray, "... n"] | None = None,
    negative_counts: Int[np.ndarray, "... m"] | None = None,
) -> Float[np.ndarray, "4 ..."]:
    """Compute the AUC, and the recall at each false-positive rate in `RATES`.

    The AUC is the probability that a random positive has a higher score than a
    random negative. A tie counts half (Mann and Whitney 1947). The recall is the
    fraction of the positives that score above the threshold for a
    false-positive rate. A positive at the threshold counts as missed. The counts say how often each
    image counts. None counts each once.
    """
    if positive_counts is None:
        positive_counts = np.ones(positives.shape[-1], int)
    if negative_counts is None:
        negative_counts = np.ones(negatives.shape[-1], int)
    positive_total = positive_counts.sum(axis=-1)

    order = negatives.argsort(axis=-1)
    sorted_negatives = _take(negatives, order)
    # Entry i of `counts_below` is the sum of the counts of the i negatives with the
    # lowest scores, for i from 0 to m, shape (..., m + 1).
    counts_below = np.insert(_take(negative_counts, order).cumsum(axis=-1), 0, 0, axis=-1)
    negative_total = counts_below[..., -1]
    # Number of negatives with a lower score than each positive, shape (..., n).
    lower = _take(counts_below, _search(sorted_negatives, positives, "left"))
    # Number of negatives whose score is lower than that of each positive, or equal to it.
    lower_or_equal = _take(counts_below, _search(sorted_negatives, positives, "right"))
    wins = (positive_counts * lower).sum(axis=-1)
    wins_and_ties = (positive_counts * lower_or_equal).sum(axis=-1)
    # The mean of both numbers counts a tie half.
    auc = (wins + wins_and_ties) / (2 * positive_total * negative_total)

    recalls = []
    for threshold in thresholds(negatives, negative_counts):
        is_above = positives > threshold[..., None]
        recalls.append((positive_counts * is_above).sum(axis=-1) / positive_total)
    return np.stack([auc, *recalls])


def thresholds(
    negatives: Num[np.ndarray, "... m"],
    counts: Int[np.ndarray, "... m"],
    rates: Sequence[str] = RATES,
) -> list[np.ndarray]:
    """Find the score threshold for each false-positive rate.

    The threshold is the score of a negative. It is the lowest such score that
    at most the given fraction of the negatives exceed. With the rate 0.10 and
    20 negatives, at most 2 negatives exceed the threshold. `rates` are decimal strings, because
    these are exact.
    """
    order = negatives.argsort(axis=-1)
    sorted_negatives = _take(negatives, order)
    # Entry i is the sum of the counts of the i + 1 negatives with the lowest scores,
    # shape (..., m).
    counts_up_to = _take(counts, order).cumsum(axis=-1)
    total = counts_up_to[..., -1]
    thresholds_by_rate = []
    for rate in rates:
        # A float would be inexact: 0.29 * 100 is less than 29 and would become 28.
        exact_rate = fractions.Fraction(rate)
        allowed_above = exact_rate.numerator * total // exact_rate.denominator
        needed_up_to = total - allowed_above
        # The index is the number of scores that too many negatives exceed.
        index = (counts_up_to < needed_up_to[..., None]).sum(axis=-1)
        thresholds_by_rate.append(_take(sorted_negatives, index[..., None])[..., 0])
    return thresholds_by_rate


def _take(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Take entries of the last axis: (..., n) and (..., k) to (..., k)."""
    shape = np.broadcast_shapes(values.shape[:-1], indices.shape[:-1])
    values, indices = (np.broadcast_to(item, shape + item.shape[-1:]) for item in (values, indices))
    return np.take_along_axis(values, indices, axis=-1)


def _search(ascending: np.ndarray, scores: np.ndarray, side: str) -> np.ndarray:
    """Find the places of scores in sorted arrays: (..., m) and (..., n) to (..., n)."""
    search = np.vectorize(partial(np.searchsorted, side=side), signature="(m),(n)->(n)")
    return search(ascending, scores)


def roc_curve(
    positives: Float[np.ndarray, " n"],
    negatives: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Compute the points of the ROC curve, from (0, 0) to (1, 1).

    An image counts as detected if its score exceeds a threshold. Each distinct
    score is the threshold of one point of the curve. The last point has the
    threshold minus infinity, which all scores exceed. Return the false-positive rates, the recalls
    and the descending thresholds.
    """
    distinct_scores = np.unique([*positives, *negatives])
    descending_thresholds = np.append(distinct_scores[::-1], -np.inf)
    false_positive_rate = _fraction_above(negatives, descending_thresholds)
    recall = _fraction_above(positives, descending_thresholds)
    return false_positive_rate, recall, descending_thresholds


def _fraction_above(
    scores: Float[np.ndarray, " n"], thresholds: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Compute the fraction of the scores that exceed each threshold."""
    count_at_or_below = np.sort(scores).searchsorted(thresholds, "right")
    return (len(scores) - count_at_or_below) / len(scores)


def metric_title(name: str) -> str:
    """Return the title of a metric in tables. An example is "recall at 10% FPR"."""
    if name in TITLES:
        return TITLES[name]
    # All other names have the form "recall_at/RATE".
    _, _, rate = name.partition("/")
    return f"recall at {float(rate):.0%} FPR"


def operating_points(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Read the operating points in the content of summary.json."""
    entry = summary.get("operating_point", [])
    return entry if isinstance(entry, list) else [entry]


def describe_point(point: Mapping[str, Any]) -> str:
    """Describe for which false-positive rate and on which images an operating point was chosen."""
    images = f"{point['folder']}, {point['negatives']} negatives"
    if point.get("in_sample"):
        images = "these very images, in-sample"
    return f"{point['false_positive_rate']:.1%} FPR on {images}"
