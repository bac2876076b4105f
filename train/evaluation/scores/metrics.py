"""Metrics of an evaluation with 95% intervals: recall, false-positive rate, AUC and top-1.

A `Pool` is a set of predictions that are scored together. It computes their
`Metrics`. `Pooled` has all pools of one evaluation: the pool of all images, and
the pools of each label, source, mesh and class. The functions below them compute
the statistics: the bootstrap, the AUC, the recall at a given false-positive
rate, and means over classes.

A label is the name of a positive class. A prediction scores how well an image
fits a label. The image is a positive if it shows this class. Otherwise it is a
negative.
"""

import fractions
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from renderer.short_repr import ShortRepr
from train.evaluation.scores.predictions import Prediction
from train.evaluation.tables import Estimate, Proportion, fraction

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

# Operating points by label: thresholds on the log-odds above which an image counts as
# a detection.
Thresholds = Mapping[str, float]


# Number of random resamples (replicates) of the images from which the bootstrap
# computes an interval.
REPLICATES = 2000
# Number of bootstrap replicates that are computed at once. A smaller number needs
# less memory.
BLOCK = 250
# Images and training runs are drawn with different random seeds, so that the draws
# are independent.
IMAGE_SEED = 0
RUN_SEED = 1


@dataclass(frozen=True)
class AreaUnderCurve(Estimate):
    """Area under the ROC curve with its bootstrap interval.

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

    @property
    def has_repeated_objects(self) -> bool:
        """Whether some object is shown in several images.

        The bootstrap of the interval then draws objects as well as images.
        """
        is_in_positives = self.positive_objects != self.positives
        is_in_negatives = self.negative_objects != self.negatives
        return is_in_positives or is_in_negatives


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

    n: int
    recall: Proportion
    top5: Proportion
    false_positive_rate: Proportion
    recall_at_threshold: Proportion | None = None
    false_positive_rate_at_threshold: Proportion | None = None
    auc: AreaUnderCurve
    recall_at: Mapping[str, Estimate]
    class_top1: Estimate | None = None
    class_top5: Estimate | None = None

    def find(self, name: str) -> Estimate | None:
        """Return a metric by its name.

        Args:
            name: Name of the metric in `METRICS`, such as "auc" or
                "recall_at/0.05", or "top5".

        Returns:
            The metric. None if it was not computed, such as a recall at a
            threshold without a threshold.
        """
        attribute, _, rate = name.partition("/")
        if rate:
            return self.recall_at[rate]
        return getattr(self, attribute)

    def to_summary(self) -> dict[str, Any]:
        """Convert the metrics to entries of summary.json. Metrics that are None are left out."""
        entries = asdict(self)
        return {name: entry for name, entry in entries.items() if entry is not None}


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
        """Fraction of hits with its 95% interval.

        Wilson's interval treats each image as a different object. If some object
        is shown in several images, it is too narrow. The interval is then that of
        the bootstrap over objects and images.
        """
        proportion = fraction(sum(self.hits), len(self.hits))
        object_count = _count_objects(self.predictions)
        if proportion.value is None or object_count == proportion.n:
            return proportion
        interval = _estimate_or_wilson(proportion.value, self.replicates, object_count)
        return replace(proportion, low=interval.low, high=interval.high)

    @cached_property
    def replicates(self) -> np.ndarray:
        """Bootstrap replicates of the fraction of hits, shape (REPLICATES,)."""
        statistic = partial(weighted_mean, np.array(self.hits))
        return bootstrap(statistic, _object_indices(self.predictions))


def within_rank(predictions: Sequence[Prediction], max_rank: int) -> Outcome:
    """Find the predictions whose true class is among the most probable classes.

    Args:
        predictions: Predictions for photographs.
        max_rank: Largest rank of the true class that counts as a hit.

    Returns:
        All given predictions, and whether each is a hit.
    """
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
        """Find the predictions whose log-odds exceed the threshold of their label.

        Args:
            predictions: Predictions. Each of their labels has a threshold.

        Returns:
            All given predictions, and whether each is a hit: above the threshold.
        """
        hits = [item.log_odds > self.thresholds[item.label] for item in predictions]
        return Outcome(predictions, hits)

    @cached_property
    def metrics(self) -> Metrics:
        """Metrics of the predictions with their 95% intervals."""
        proportions = {name: outcome.proportion for name, outcome in self.outcomes.items()}
        auc, *recalls = self._roc_estimates()
        top_accuracies = self._top_estimates()
        auc_with_counts = AreaUnderCurve(
            value=auc.value,
            low=auc.low,
            high=auc.high,
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
            class_top1=top_accuracies.get("class_top1"),
            class_top5=top_accuracies.get("class_top5"),
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

    def _top_estimates(self) -> dict[str, Estimate]:
        """Compute top-1 and top-5 accuracy with their bootstrap intervals.

        Returns:
            "class_top1" and "class_top5". Empty if no photograph shows a class
            of the network.
        """
        if not self.classified:
            return {}
        values = self._top_statistic(np.ones(len(self.classified)))
        estimates = {}
        for name, value, replicates in zip(TOP_RANKS, values, self._top_replicates, strict=True):
            estimates[name] = _estimate_or_wilson(float(value), replicates, self.object_count(name))
        return estimates

    @property
    def _top_statistic(self) -> Callable[[np.ndarray], np.ndarray]:
        """Function that computes top-1 and top-5 accuracy on resampled photographs.

        Its argument is how often each of the n photographs in `classified` is
        drawn, shape (..., n). It returns the two accuracies, shape (2, ...).
        """
        names = [prediction.photograph.label for prediction in self.classified]
        ranks = np.array([prediction.true_rank for prediction in self.classified])
        # The first row says which photographs are correct for top-1, the second row
        # for top-5, shape (2, n).
        hits = np.stack([ranks <= max_rank for max_rank in TOP_RANKS.values()])
        return partial(class_means, hits, names)

    @cached_property
    def _top_replicates(self) -> np.ndarray:
        """Bootstrap replicates of top-1 and of top-5 accuracy, shape (2, REPLICATES)."""
        return bootstrap(self._top_statistic, _object_indices(self.classified))

    def _roc_estimates(self) -> list[Estimate]:
        """Compute the AUC and the recalls with their bootstrap intervals.

        Returns:
            The AUC, followed by the recall at each false-positive rate in
            `RATES`. All are unknown without positives or without negatives.
        """
        if not self._has_roc_curve:
            return [Estimate() for _ in ROC_METRICS]
        values = auc_and_recalls(*self.scores)
        estimates = []
        for name, value, replicates in zip(ROC_METRICS, values, self._roc_replicates, strict=True):
            estimates.append(_estimate_or_wilson(float(value), replicates, self.object_count(name)))
        return estimates

    def object_count(self, name: str) -> int:
        """Count the different objects in the photographs on which a metric depends.

        Args:
            name: Name of a metric that has bootstrap replicates.

        Returns:
            Number of objects. For a metric of the ROC curve, it is the number of
            positive or of negative objects, whichever is smaller.
        """
        if name in self.outcomes:
            return _count_objects(self.outcomes[name].predictions)
        if name in TOP_RANKS:
            return _count_objects(self.classified)
        return min(_count_objects(predictions) for predictions in self.for_roc)

    @property
    def _has_roc_curve(self) -> bool:
        """Whether there are both positives and negatives, which a ROC curve needs."""
        return bool(self.for_roc.positives) and bool(self.for_roc.negatives)

    @cached_property
    def _roc_replicates(self) -> np.ndarray:
        """Bootstrap replicates of the AUC and of the three recalls, shape (4, REPLICATES)."""
        statistic = partial(auc_and_recalls, *self.scores)
        positive_objects = _object_indices(self.for_roc.positives)
        negative_objects = _object_indices(self.for_roc.negatives)
        return bootstrap(statistic, positive_objects, negative_objects)

    @cached_property
    def replicates(self) -> dict[str, np.ndarray]:
        """For each metric that is known, its bootstrap replicates, shape (REPLICATES,)."""
        replicates = {}
        for name, outcome in self.outcomes.items():
            if outcome.hits:
                replicates[name] = outcome.replicates
        if self._has_roc_curve:
            replicates.update(zip(ROC_METRICS, self._roc_replicates, strict=True))
        if self.classified:
            replicates.update(zip(TOP_RANKS, self._top_replicates, strict=True))
        return replicates


def _estimate_or_wilson(value: float, replicates: np.ndarray, object_count: int) -> Estimate:
    """Add a 95% interval to the value of a metric.

    This is the percentile interval of the bootstrap, except if all replicates
    are equal. The percentile interval would then have no width. It is replaced
    by Wilson's interval, which treats the value as a fraction of the objects.

    Args:
        value: Value of the metric, in [0, 1].
        replicates: Bootstrap replicates of the metric, shape (REPLICATES,).
        object_count: Number of different objects that the images show.

    Returns:
        The value with its interval.
    """
    with_percentiles = estimate(value, replicates)
    if with_percentiles.low != with_percentiles.high:
        return with_percentiles
    wilson = fraction(round(value * object_count), object_count)
    assert wilson.low is not None and wilson.high is not None
    return Estimate(value=value, low=min(wilson.low, value), high=max(wilson.high, value))


def _object_indices(predictions: Sequence[Prediction]) -> np.ndarray:
    """Number the different objects in photographs, in order of first appearance.

    Photographs show the same object if they have the same mesh. A photograph
    with an unknown mesh counts as a different object.

    Args:
        predictions: One prediction for each of n photographs.

    Returns:
        Number of the object in each photograph, from 0, shape (n,).
    """
    index_of_object: dict[str | PurePosixPath, int] = {}
    object_indices = []
    for prediction in predictions:
        name = prediction.photograph.mesh or prediction.photograph.path
        next_index = len(index_of_object)
        object_indices.append(index_of_object.setdefault(name, next_index))
    return np.array(object_indices)


def _count_objects(predictions: Sequence[Prediction]) -> int:
    """Count the different objects in the photographs of predictions."""
    return len(np.unique(_object_indices(predictions)))


def pool(predictions: Sequence[Prediction], thresholds: Thresholds | None = None) -> Pool:
    """Collect predictions that are scored together, with one ROC curve of all of them.

    Args:
        predictions: Predictions that are scored together.
        thresholds: Threshold on the log-odds of each label. None omits the
            metrics that need a threshold.

    Returns:
        The predictions, divided into positives and negatives.
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

        Args:
            positives: Positives of one source. The photograph of each may name
                other sources in `hard_negatives`.
            source: Name of the source of the positives. Its own negatives are
                not returned.

        Returns:
            Negatives from the named sources. Each has the label of a positive
            that names its source.
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

        Args:
            name_of: Function that returns the name of the mesh or class in the
                image of a prediction. If it returns None, the image is left
                out.

        Returns:
            For the name of each mesh or class, its predictions, which are
            scored together.
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

    Args:
        predictions: Predictions to group.
        name_of: Function from a prediction to the name of its group. If it
            returns None, the prediction is left out.

    Returns:
        Predictions of each group by its name, in alphabetical order of the
        names. The predictions of a group keep their order.
    """
    groups: dict[str, list[Prediction]] = {}
    for prediction in predictions:
        name = name_of(prediction)
        if name is not None:
            groups.setdefault(name, []).append(prediction)
    return {name: groups[name] for name in sorted(groups)}


def bootstrap(statistic: Callable[..., np.ndarray], *groups: np.ndarray) -> np.ndarray:
    """Evaluate a statistic on random resamples (bootstrap replicates) of images.

    Images of the same object are not independent. Each replicate therefore
    draws objects with replacement, as many as there are. For each drawn object,
    it draws images of the object with replacement, as many as the object has
    (Davison and Hinkley 1997, section 3.8). With one image per object, this is
    the ordinary bootstrap over images.

    The draws depend only on `groups`. Metrics of two networks on the same
    images are therefore paired: replicate i has the same images for both.

    The interval is approximate. The variance of a mean over k objects is too
    small by a factor of (k - 1) / k. With several objects, the variance over
    images is counted about twice.

    Args:
        statistic: Function that is evaluated for BLOCK replicates at a time.
            Its arguments are one array for each group: how often each replicate
            draws each image, shape (BLOCK, n). It returns an array of shape
            (..., BLOCK).
        *groups: Groups of images that are resampled separately, such as the
            positives and the negatives. For each group of n ≥ 1 images, the
            index of the object that each image shows, shape (n,). Objects are
            numbered from 0 in order of first appearance.

    Returns:
        Value of the statistic for each replicate, shape (..., REPLICATES).
    """
    generator = np.random.default_rng(IMAGE_SEED)
    blocks = []
    for _ in range(REPLICATES // BLOCK):
        draw_counts = [_draw_images(object_of_image, generator) for object_of_image in groups]
        blocks.append(statistic(*draw_counts))
    return np.concatenate(blocks, axis=-1)


def _draw_images(object_of_image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw the images of BLOCK bootstrap replicates: first objects, then images of each object.

    Args:
        object_of_image: Index of the object that each image shows, shape (n,).
            Objects are numbered from 0 in order of first appearance.
        generator: Random number generator.

    Returns:
        How often each replicate draws each image, shape (BLOCK, n).
    """
    image_count = len(object_of_image)
    images_per_object = np.bincount(object_of_image)
    object_count = len(images_per_object)
    # Objects that are drawn for each of BLOCK replicates, as one list, shape (BLOCK · objects,).
    drawn_objects = generator.integers(object_count, size=(BLOCK, object_count)).ravel()
    replicate_of_draw = np.arange(BLOCK).repeat(object_count)
    if object_count == image_count:
        # Each object has a single image, and image i shows object i.
        drawn_images = drawn_objects
    else:
        drawn_sizes = images_per_object[drawn_objects]
        # `images_by_object` lists the images of object 0, then of object 1, and so on.
        # `first_position` is the position in this list at which each object starts.
        images_by_object = object_of_image.argsort(kind="stable")
        first_position = images_per_object.cumsum() - images_per_object
        # An object with n images gets n random numbers below n.
        position_in_object = generator.integers(drawn_sizes.repeat(drawn_sizes))
        object_start = first_position[drawn_objects].repeat(drawn_sizes)
        drawn_images = images_by_object[object_start + position_in_object]
        replicate_of_draw = replicate_of_draw.repeat(drawn_sizes)
    # Each pair of a replicate and an image has its own number, so that `bincount`
    # counts how often the pair is drawn.
    pair_numbers = replicate_of_draw * image_count + drawn_images
    draw_counts = np.bincount(pair_numbers, minlength=BLOCK * image_count)
    return draw_counts.reshape(BLOCK, image_count)


def weighted_mean(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Compute the mean of values, each counted several times.

    `functools.partial(weighted_mean, values)` is a statistic for `bootstrap`.

    Args:
        values: Values, shape (n,).
        counts: How often each value counts, shape (..., n).

    Returns:
        Weighted mean, shape (...).
    """
    return counts @ values / counts.sum(axis=-1)


def class_means(hits: np.ndarray, names: Sequence[str], counts: np.ndarray) -> np.ndarray:
    """Compute the fraction of hits in each class, and average it over the classes.

    This is the mean over all images if an image of a class with n images has
    the weight 1 / n. `functools.partial(class_means, hits, names)` is a
    statistic for `bootstrap`.

    Args:
        hits: Whether each image is a hit, by K definitions of a hit such as
            top-1 and top-5. One row for each definition, shape (K, n).
        names: Name of the class of each of the n images.
        counts: How often each image counts, shape (..., n).

    Returns:
        Mean over classes for each definition of a hit, shape (K, ...).
    """
    _, class_of_image, class_sizes = np.unique(names, return_inverse=True, return_counts=True)
    weights = 1 / class_sizes[class_of_image]
    total_weight = counts @ weights
    return np.stack([counts @ (weights * row) / total_weight for row in hits])


def estimate(value: float, replicates: np.ndarray) -> Estimate:
    """Add the 95% percentile interval of the bootstrap to the value of a metric.

    The interval is described by Efron and Tibshirani (1993), chapter 13. Unlike
    an interval of standard errors, it stays within the range of the metric.
    Unlike their BCa interval, it is defined if all replicates are equal, as at
    a recall of 1.

    Args:
        value: Value of the metric on all images.
        replicates: Values of the metric on bootstrap replicates, shape
            (REPLICATES,).

    Returns:
        Value with its interval.
    """
    low, high = np.quantile(replicates, (0.025, 0.975))
    return Estimate(value=value, low=float(low), high=float(high))


def replicate_difference(one: np.ndarray, other: np.ndarray, paired: bool) -> np.ndarray:
    """Compute bootstrap replicates of the difference between two groups of training runs.

    A group has runs with different random seeds. Each replicate also resamples
    the runs: it draws as many runs as the group has, with replacement, and
    averages the metric over them.

    Args:
        one: Bootstrap replicates of the metric of each of the S runs of the
            first group, shape (S, REPLICATES).
        other: Bootstrap replicates of the metric of each of the T runs of the
            second group, shape (T, REPLICATES).
        paired: Whether run i of the first group and run i of the second group
            are drawn together. S and T must then be equal.

    Returns:
        Mean of the first group minus mean of the second group in each
        replicate, shape (REPLICATES,).
    """
    generator = np.random.default_rng(RUN_SEED)
    if paired:
        return _mean_of_drawn_runs(one - other, generator)
    mean_of_one = _mean_of_drawn_runs(one, generator)
    mean_of_other = _mean_of_drawn_runs(other, generator)
    return mean_of_one - mean_of_other


def _mean_of_drawn_runs(values: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Resample training runs in each bootstrap replicate, and average a metric over them.

    Args:
        values: Metric of each of S runs in each replicate, shape
            (S, REPLICATES).
        generator: Random number generator, which draws S runs with replacement
            for each replicate.

    Returns:
        Mean over the drawn runs in each replicate, shape (REPLICATES,).
    """
    drawn_runs = generator.integers(len(values), size=values.shape)
    return np.take_along_axis(values, drawn_runs, axis=0).mean(axis=0)


def auc_and_recalls(
    positives: np.ndarray,
    negatives: np.ndarray,
    positive_counts: np.ndarray | None = None,
    negative_counts: np.ndarray | None = None,
) -> np.ndarray:
    """Compute the AUC, and the recall at each false-positive rate in `RATES`.

    The AUC is the probability that a random positive has a higher score than a
    random negative. A tie counts half (Mann and Whitney 1947). The recall is the
    fraction of the positives that score above the threshold for a
    false-positive rate. A positive at the threshold counts as missed.

    Args:
        positives: Scores of the positives, shape (n,).
        negatives: Scores of the negatives, shape (m,).
        positive_counts: How often each positive counts, shape (..., n). None
            counts each once.
        negative_counts: How often each negative counts, shape (..., m). None
            counts each once.

    Returns:
        AUC and three recalls, shape (4, ...).
    """
    if positive_counts is None:
        positive_counts = np.ones(len(positives), int)
    if negative_counts is None:
        negative_counts = np.ones(len(negatives), int)
    positive_total = positive_counts.sum(axis=-1)

    order = negatives.argsort()
    sorted_negatives = negatives[order]
    # Entry i of `counts_below` is the sum of the counts of the i negatives with the
    # lowest scores, for i from 0 to m, shape (..., m + 1).
    counts_below = np.insert(negative_counts[..., order].cumsum(axis=-1), 0, 0, axis=-1)
    negative_total = counts_below[..., -1]
    # Number of negatives with a lower score than each positive, shape (..., n).
    lower = counts_below[..., sorted_negatives.searchsorted(positives, "left")]
    # Number of negatives whose score is lower than that of each positive, or equal to it.
    lower_or_equal = counts_below[..., sorted_negatives.searchsorted(positives, "right")]
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
    negatives: np.ndarray,
    counts: np.ndarray,
    rates: Sequence[str] = RATES,
) -> list[np.ndarray]:
    """Find the score threshold for each false-positive rate.

    The threshold is the score of a negative. It is the lowest such score that
    at most the given fraction of the negatives exceed. With the rate 0.10 and
    20 negatives, at most 2 negatives exceed the threshold.

    Args:
        negatives: Scores of the negatives, shape (m,).
        counts: How often each negative counts, shape (..., m).
        rates: False-positive rates as decimal strings, which are exact.

    Returns:
        For each rate, an array of thresholds of shape (...).
    """
    order = negatives.argsort()
    sorted_negatives = negatives[order]
    # Entry i is the sum of the counts of the i + 1 negatives with the lowest scores,
    # shape (..., m).
    counts_up_to = counts[..., order].cumsum(axis=-1)
    total = counts_up_to[..., -1]
    thresholds_by_rate = []
    for rate in rates:
        # A float would be inexact: 0.29 * 100 is less than 29 and would become 28.
        exact_rate = fractions.Fraction(rate)
        allowed_above = exact_rate.numerator * total // exact_rate.denominator
        needed_up_to = total - allowed_above
        # The index is the number of scores that too many negatives exceed.
        index = (counts_up_to < needed_up_to[..., None]).sum(axis=-1)
        thresholds_by_rate.append(sorted_negatives[index])
    return thresholds_by_rate


def roc_curve(
    positives: np.ndarray,
    negatives: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the points of the ROC curve, from (0, 0) to (1, 1).

    An image counts as detected if its score exceeds a threshold. Each distinct
    score is the threshold of one point of the curve. The last point has the
    threshold minus infinity, which all scores exceed.

    Args:
        positives: Scores of the positives, shape (n,).
        negatives: Scores of the negatives, shape (m,).

    Returns:
        Three arrays with an entry for each point of the curve:
        - the false-positive rate, in ascending order;
        - the recall, in ascending order;
        - the threshold, in descending order.
    """
    distinct_scores = np.unique([*positives, *negatives])
    descending_thresholds = np.append(distinct_scores[::-1], -np.inf)
    false_positive_rate = _fraction_above(negatives, descending_thresholds)
    recall = _fraction_above(positives, descending_thresholds)
    return false_positive_rate, recall, descending_thresholds


def _fraction_above(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Compute the fraction of the scores that exceed each threshold.

    Args:
        scores: Scores, shape (n,).
        thresholds: Thresholds, shape (k,).

    Returns:
        Fraction for each threshold, in [0, 1], shape (k,).
    """
    count_at_or_below = np.sort(scores).searchsorted(thresholds, "right")
    return (len(scores) - count_at_or_below) / len(scores)


def _find_entry(summary: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Find the entry of a metric in the content of a JSON file.

    The metric "recall_at/0.05" is summary["recall_at"]["0.05"] in summary.json,
    and summary["recall_at/0.05"] in the file of a published network.

    Args:
        summary: Content of the file.
        name: Name of the metric.

    Returns:
        Entry of the metric. An empty dictionary if the file lacks the metric.
    """
    if name in summary:
        return summary[name] or {}
    entry: Any = summary
    for key in name.split("/"):
        entry = entry.get(key, {})
    return entry


def read_metric(summary: Mapping[str, Any], name: str) -> Estimate | None:
    """Read a metric from the content of summary.json.

    Args:
        summary: Content of the file, or an entry of its dictionaries
            "by_label", "by_source" and "by_mesh".
        name: Name of the metric in `METRICS`, such as "auc" or
            "recall_at/0.05", or "top5".

    Returns:
        Metric with its interval, and with the numbers of images if the file has
        them. None if the file lacks the metric.

    Raises:
        KeyError, TypeError, ValueError: If the entry of the metric is damaged.
    """
    entry = _find_entry(summary, name)
    if not entry:
        return None
    numbers: dict[str, float | None] = dict.fromkeys(("value", "low", "high"))
    if entry.get("value") is not None:
        numbers = {key: float(entry[key]) for key in numbers}
    if "hits" in entry:
        return Proportion(**numbers, hits=entry["hits"], n=entry["n"])
    if "positives" in entry:
        positives = entry["positives"]
        negatives = entry["negatives"]
        # Older versions of the library did not write the numbers of objects.
        return AreaUnderCurve(
            **numbers,
            positives=positives,
            positive_objects=entry.get("positive_objects", positives),
            negatives=negatives,
            negative_objects=entry.get("negative_objects", negatives),
        )
    return Estimate(**numbers)


def metric_title(name: str) -> str:
    """Return the title of a metric in tables.

    Args:
        name: Name of the metric in `METRICS`, such as "auc" or
            "recall_at/0.10", or "top5".

    Returns:
        Title such as "AUC" or "recall at 10% FPR".
    """
    if name in TITLES:
        return TITLES[name]
    # All other names have the form "recall_at/RATE".
    _, _, rate = name.partition("/")
    return f"recall at {float(rate):.0%} FPR"
