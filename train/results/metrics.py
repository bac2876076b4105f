"""Metrics of an evaluation: recall, false-positive rate, AUC and top-1.

A `Pool` is a set of predictions that are scored together. It computes their
`Metrics`. `Pooled` has all pools of one evaluation: the pool of all images, and
the pools of each label, source, mesh and class.

A label is the name of a positive class. A prediction scores how well an image
fits a label. The image is a positive if it shows this class. Otherwise it is a
negative.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from renderer.short_repr import ShortRepr
from train.results.intervals import (
    RATES,
    Jackknife,
    Units,
    class_means,
    leave_out,
    leave_out_of_roc,
    weighted_means,
)
from train.results.predictions import Prediction
from train.results.tables import IMAGES, OBJECTS, THESE_OBJECTS, Estimate, Proportion, fraction

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
        kinds: dict[str, type[Estimate]] = {
            **dict.fromkeys(FRACTION_METRICS, Proportion),
            "auc": AreaUnderCurve,
        }
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
        groups = group_predictions(self._included, lambda prediction: prediction.label)
        return {label: pool(group, self.thresholds) for label, group in groups.items()}

    @cached_property
    def by_source(self) -> dict[str, Pool]:
        """For each source, the predictions for its images, which are scored together.

        Excluded sources are included here.

        The ROC curve compares the positives of a source with its negatives. A
        positive can name other sources in its `hard_negatives`. The negatives
        of these sources are added.
        """
        groups = group_predictions(
            self.predictions, lambda prediction: prediction.photograph.source
        )
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
        for name, group in group_predictions(self._included, name_of).items():
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


def group_predictions(
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
