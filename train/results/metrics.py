"""Metrics of an evaluation: recall, false-positive rate, AUC and top-1.

A `Pool` has predictions that are scored together, and computes their `Metrics`. That of a whole
evaluation has the pools of each label, source, mesh and class. A label is the name of a positive
class. An image is a positive if it shows this class, and otherwise a negative.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property, partial
from typing import Any

import numpy as np

from renderer.errors import ShortRepr
from train.results import intervals
from train.results.intervals import RATES, Jackknife, Units, leave_out
from train.results.predictions import Predictions, as_column
from train.results.tables import IMAGES, OBJECTS, THESE_OBJECTS, Estimate, Proportion

# Names of the metrics that depend on the ranking of the images, in the order in which
# `auc_and_recalls` returns them.
ROC_METRICS = ("auc", *(f"recall_at/{rate}" for rate in RATES))
# Names of the metrics that need a threshold on the log-odds of each label.
AT_THRESHOLD: tuple[str, ...] = ("recall_at_threshold", "false_positive_rate_at_threshold")
# Top-1 and top-5 accuracy among all classes of the network, as means over classes.
# The value is the largest rank of the true class that counts as correct.
TOP_RANKS = {"class_top1": 1, "class_top5": 5}
# Name of the false-positive rate as a mean over several positive classes.
CLASS_RATE = "class_false_positive_rate"
# Names of the metrics that are fractions of images. The table of an evaluation shows
# them in this order.
FRACTION_METRICS: tuple[str, ...] = ("recall", "top5", "false_positive_rate", *AT_THRESHOLD)
# Names of the metrics that reports show, in this order. "recall_at/0.05" is the entry
# "0.05" of the entry "recall_at" in summary.json.
METRICS = ("recall", "false_positive_rate", *ROC_METRICS, *AT_THRESHOLD, *TOP_RANKS)
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
    **{f"recall_at/{rate}": f"recall at {float(rate):.0%} FPR" for rate in RATES},
}

# Words after the number of negatives, if there are several positive classes.
COUNTED_EACH = ", once for each of these classes"
# Operating points by label: thresholds on the log-odds above which an image counts as
# a detection.
Thresholds = Mapping[str, float]


# Smallest number of objects of each kind for intervals over objects. With fewer objects,
# the interval of an AUC covers more than half of [0, 1] (benchmarks/coverage.py).
MIN_OBJECTS = 5


@dataclass(frozen=True)
class AreaUnderCurve(Estimate):
    """Area under the ROC curve with its 95% interval.

    The area is unknown if there are no positives or no negatives.

    Attributes:
        positives: Number of positive images.
        positive_objects: Number of different objects in the positive images that have
            a name, or of different images if no object has.
        negatives: Number of negative images.
        negative_objects: Number of objects in the negative images, as in `positive_objects`.
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
        class_false_positive_rate: False-positive rate as a mean over the
            positive classes. None if there is one.
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
    class_false_positive_rate: Estimate | None = None

    def find(self, name: str) -> Estimate | None:
        """Return a metric by its name.

        A name is "auc", "top5" or "recall_at/0.05". None if it was not computed.
        """
        attribute, _, rate = name.partition("/")
        return self.recall_at.get(rate) if rate else getattr(self, attribute)

    def to_summary(self) -> dict[str, Any]:
        """Convert the metrics to entries of summary.json. Metrics that are None are left out."""
        return {name: entry for name, entry in asdict(self).items() if entry is not None}

    @classmethod
    def read(cls, entries: Mapping[str, Any]) -> "Metrics":
        """Read metrics from summary.json, or from the file of a published network.

        A metric that an earlier version did not write is unknown. The number of images is not read,
        because summary.json has another entry of this name.
        """
        kinds = {**dict.fromkeys(FRACTION_METRICS, Proportion), "auc": AreaUnderCurve}
        # summary.json has all rates under one name. A published network has a name for each.
        nested = entries.get("recall_at") or {}
        rates = {rate: entries.get(f"recall_at/{rate}") or nested.get(rate) for rate in RATES}
        # Entries are missing for metrics that were not computed.
        estimates: dict[str, Any] = {
            name: _read_estimate(entries[name], kinds.get(name, Estimate))
            for name in (*kinds, *TOP_RANKS)
            if entries.get(name)
        }
        recalls = {rate: _read_estimate(item, Estimate) for rate, item in rates.items() if item}
        return cls(**estimates, recall_at=recalls)


def _read_estimate(entry: Mapping[str, Any], kind: type[Estimate]) -> Estimate:
    """Read an estimate of the class `kind`. Counts that an earlier version lacks are unknown."""
    numbers = {item.name: entry[item.name] for item in fields(kind) if item.name in entry}
    if entry["value"] is not None:
        numbers |= {name: float(entry[name]) for name in ("value", "low", "high")}
    return kind(**numbers)


@dataclass(frozen=True)
class Outcome:
    """Predictions, and which of them are hits. A metric is the fraction of hits."""

    predictions: Predictions
    hits: np.ndarray

    @cached_property
    def proportion(self) -> Proportion:
        """Fraction of hits with its 95% interval, which is Wilson's if no unit is repeated."""
        return self.jackknife.proportion(self.hits) if len(self.hits) else Proportion()

    @cached_property
    def jackknife(self) -> Jackknife:
        """Fraction of hits without each unit."""
        return intervals.leave_out_of_mean(self.hits, choose_units(self.predictions))


@dataclass(frozen=True, repr=False)
class Pool(ShortRepr):
    """Predictions that are scored together.

    With several labels, a photograph has one prediction for each label. All of
    these predictions count.

    Attributes:
        predictions: The predictions.
        thresholds: Threshold on the log-odds of each label. If it is empty, the
            metrics in `AT_THRESHOLD` are None.
        for_roc: Positives and negatives of the ROC curve, if it has photographs of other
            sources or meshes, too. None for those of `predictions`.
    """

    predictions: Predictions
    thresholds: Thresholds = field(default_factory=dict)
    for_roc: tuple[Predictions, Predictions] | None = None

    @cached_property
    def positives(self) -> Predictions:
        """Predictions for photographs whose class is the label."""
        return self.predictions[self.predictions.positive]

    @cached_property
    def negatives(self) -> Predictions:
        """Predictions for all other photographs."""
        return self.predictions[~self.predictions.positive]

    @property
    def ranked(self) -> tuple[Predictions, Predictions]:
        """Positives and negatives of the ROC curve."""
        return self.for_roc or (self.positives, self.negatives)

    @property
    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """Log-odds for the ROC curve: of the positives, shape (n,), and of the negatives, (m,)."""
        positives, negatives = self.ranked
        return positives.log_odds, negatives.log_odds

    @cached_property
    def outcomes(self) -> dict[str, Outcome]:
        """Hits and misses for each metric that is a fraction of images, such as recall."""
        positives, negatives = self.positives, self.negatives
        outcomes = {
            "recall": Outcome(positives, positives.true_rank <= 1),
            "top5": Outcome(positives, positives.true_rank <= 5),
            "false_positive_rate": Outcome(negatives, negatives.predicted == negatives.label),
        }
        if self.thresholds:
            for name, group in zip(AT_THRESHOLD, (positives, negatives), strict=True):
                # The threshold on the log-odds of each prediction, shape (n,).
                limits = as_column([self.thresholds[label] for label in group.label])
                outcomes[name] = Outcome(group, group.log_odds > limits)
        return outcomes

    @cached_property
    def metrics(self) -> Metrics:
        """Metrics of the predictions with their 95% intervals."""
        # ROC metrics are missing without positives or without negatives. They are then unknown.
        known = {name: jackknife.estimate for name, jackknife in self._rankings.items()}
        auc, *recalls = (known.get(name, Estimate()) for name in ROC_METRICS)
        # Numbers of images and objects.
        positives, negatives = ((len(group), len(_objects(group))) for group in self.ranked)
        area = auc.value, auc.low, auc.high, auc.over
        auc_with_counts = AreaUnderCurve(*area, *positives, *negatives)
        recall_at = dict(zip(RATES, recalls, strict=True))
        others: dict[str, Any] = {name: known.get(name) for name in (*TOP_RANKS, CLASS_RATE)}
        others |= {name: outcome.proportion for name, outcome in self.outcomes.items()}
        return Metrics(n=len(self.predictions), auc=auc_with_counts, recall_at=recall_at, **others)

    @cached_property
    def classified(self) -> Predictions:
        """One prediction for each photograph whose class is a class of the network.

        With several labels, a photograph has several predictions. All of them
        have the same predicted class, so the first one is taken.
        """
        known = self.predictions[np.isfinite(self.predictions.true_rank)]
        row_of_path: dict[object, int] = {}
        for row in (*np.flatnonzero(known.positive), *np.flatnonzero(~known.positive)):
            row_of_path.setdefault(known.photograph[row].path, row)
        return known[[*row_of_path.values()]]

    @cached_property
    def _rankings(self) -> dict[str, Jackknife]:
        """Jackknives of AUC, recalls and top ranks by name, without metrics that are unknown."""
        jackknives: dict[str, Jackknife] = {}
        # A ROC curve needs positives and negatives.
        if all(map(len, self.ranked)):
            of_roc = intervals.leave_out_of_roc(*self.scores, choose_units(*self.ranked))
            jackknives.update(zip(ROC_METRICS, of_roc, strict=True))
        negatives = self.negatives
        if len(negatives) and len(self.predictions.labels) > 1:
            hits = self.outcomes["false_positive_rate"].hits[None]
            statistic = partial(intervals.class_means, hits, negatives.label.tolist())
            (jackknives[CLASS_RATE],) = leave_out(statistic, choose_units(negatives))
        # One prediction for each image of a class of the network.
        images = self.classified
        if len(images):
            # One row for top-1 and one for top-5, shape (2, n).
            hits = np.stack([images.true_rank <= max_rank for max_rank in TOP_RANKS.values()])
            statistic = partial(intervals.class_means, hits, images.shown.tolist())
            of_classes = leave_out(statistic, choose_units(images))
            jackknives.update(zip(TOP_RANKS, of_classes, strict=True))
        return jackknives

    @cached_property
    def jackknives(self) -> dict[str, Jackknife]:
        """For each metric that is known, its values without each unit."""
        outcomes = {name: item.jackknife for name, item in self.outcomes.items() if len(item.hits)}
        return {**outcomes, **self._rankings}

    def groups(self, by: str) -> dict[str, "Pool"]:
        """Groups by a property: "label", "source", "mesh" or "class". "all" is one group, ""."""
        return {"": self} if by == "all" else getattr(self, f"by_{by}")

    @cached_property
    def by_label(self) -> dict[str, "Pool"]:
        """For each label, its predictions, which are scored together."""
        groups = group_rows(self.predictions, self.predictions.label)
        return {label: Pool(group, self.thresholds) for label, group in groups.items()}

    @cached_property
    def by_source(self) -> dict[str, "Pool"]:
        """For each source, the predictions for its images, which are scored together.

        The ROC curve compares the positives of a source with its negatives. A
        positive can name other sources in its `hard_negatives`. The negatives
        of these sources are added.
        """
        everything = self.predictions
        pools = {}
        for source, group in group_rows(everything, everything.source).items():
            positives = group[group.positive]
            # Labels and other sources whose negatives the positives of this source name.
            wanted = {
                (label, other)
                for label, photograph in zip(positives.label, positives.photograph, strict=True)
                for other in photograph.hard_negatives
                if other != source
            }
            # The prediction for a label counts only for the positives of this label.
            keys = zip(everything.label, everything.source, strict=True)
            is_hard = np.array([key in wanted for key in keys]) & ~everything.positive
            is_own = (everything.source == source) & ~everything.positive
            rows = np.concatenate([np.flatnonzero(is_own), np.flatnonzero(is_hard)])
            pools[source] = Pool(group, self.thresholds, (positives, everything[rows]))
        return pools

    @cached_property
    def by_mesh(self) -> dict[str, "Pool"]:
        """For each known mesh, the predictions for its images, which are scored together.

        If photographs of several labels name the same mesh, these are different objects, and the
        label stands before the name.
        """
        items = self.predictions.photograph
        labels = Counter(mesh for _, mesh in {(item.label, item.mesh) for item in items})
        shared = {mesh for mesh, count in labels.items() if mesh and count > 1}
        names = [f"{of.label}: {of.mesh}" if of.mesh in shared else of.mesh for of in items]
        return self._by_content(names)

    @cached_property
    def by_class(self) -> dict[str, "Pool"]:
        """For each class, the predictions for its images, which are scored together."""
        return self._by_content(self.predictions.shown)

    def _by_content(self, names: Iterable[Any]) -> dict[str, "Pool"]:
        """Collect the predictions for the images of each mesh, or of each class.

        The ROC curve of a positive mesh compares its images with all negatives, and that of another
        mesh all positives with its images. The same holds for classes.
        """
        pools = {}
        for name, group in group_rows(self.predictions, names).items():
            positives = group[group.positive]
            # Images of positive classes are left out. With the labels orange and lemon,
            # an image of an orange is also a negative for lemon, so oranges would be
            # compared with themselves.
            negatives = group[~np.isin(group.shown, self.predictions.labels)]
            for_roc = (
                positives if len(positives) else self.positives,
                negatives if len(negatives) else self.negatives,
            )
            pools[name] = Pool(group, self.thresholds, for_roc)
        return pools


def choose_units(*groups: Predictions) -> Units:
    """Choose objects as units if each group shows enough of them, and otherwise images.

    Images show the same object if they have the same label and mesh. If the mesh of an image is
    unknown, images are the units.
    """
    items = [item for group in groups for item in group.photograph]
    is_named = [bool(item.mesh) for item in items]
    has_enough = all(is_named) and all(len(_objects(group)) >= MIN_OBJECTS for group in groups)
    objects = [(item.label, item.mesh) for item in items]
    images = [item.path for item in items]
    units, over = (objects, OBJECTS) if has_enough else (images, THESE_OBJECTS)
    # With several labels, an image can be a positive and a negative.
    numbers = np.split(_number(units), np.cumsum([*map(len, groups)])[:-1])
    return Units(numbers, over if any(is_named) else IMAGES)


def _objects(predictions: Predictions) -> set[object]:
    """Name the objects that photographs show. Without any name, each photograph is an object."""
    items = predictions.photograph
    return {(item.label, item.mesh) for item in items if item.mesh} or {item.path for item in items}


def _number(names: Iterable[object]) -> np.ndarray:
    """Number names from 0 in order of first appearance, shape (n,)."""
    number_of_name: dict[object, int] = {}
    return np.array([number_of_name.setdefault(name, len(number_of_name)) for name in names])


def group_rows(predictions: Predictions, names: Iterable[Any]) -> dict[str, Predictions]:
    """Group predictions by a name, such as the name of their source.

    Predictions whose name is None are left out. The names are sorted.
    """
    column = as_column([*names])
    return {name: predictions[column == name] for name in sorted({*column} - {None})}


def describe_point(point: Mapping[str, Any]) -> str:
    """Describe for which false-positive rate and on which images an operating point was chosen."""
    images = f"{point['folder']}, {point['negatives']} negatives"
    if point.get("in_sample"):
        images = "these very images, in-sample"
    return f"{point['false_positive_rate']:.1%} FPR on {images}"
