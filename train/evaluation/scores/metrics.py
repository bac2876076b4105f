"""Metrics of an evaluation with 95% intervals: recall, false-positive rate, AUC and top-1.

A `Pool` holds predictions that are scored together and computes their
`Metrics`. `Pooled` holds all pools of one evaluation: the pool of all images,
and those of each label, source, mesh and class. Below them are the statistics
that they use: the bootstrap, the AUC, the recall at a given false-positive rate,
and the means over classes.

A label is the name of a positive class. For a prediction about a label, an
image is positive if it shows this class, and negative otherwise.
"""

import fractions
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from train.evaluation.scores.predictions import Prediction
from train.evaluation.tables import Estimate, Proportion, fraction

# False-positive rates at which recall is reported. They are decimal strings,
# because `thresholds` needs exact numbers.
RATES = ("0.05", "0.10", "0.20")
# Names of the metrics that `auc_and_recalls` computes, in its order.
RANKED = ("auc", *(f"recall_at/{rate}" for rate in RATES))
# Names of the metrics that `Pool` computes only if it has thresholds: the
# recall and the false-positive rate at these thresholds.
AT_THRESHOLD: tuple[str, ...] = ("recall_at_threshold", "false_positive_rate_at_threshold")
# Names of the metrics among all classes of the network, and the highest rank of
# the true class that counts. They are means over the classes of the images.
TOP_RANKS = {"class_top1": 1, "class_top5": 5}
# Names of the metrics that `Pool.outcomes` computes as fractions of images. The
# table of an evaluation shows them in this order.
COUNTED: tuple[str, ...] = ("recall", "top5", "false_positive_rate", *AT_THRESHOLD)
# Names of the metrics that the tables of reports show, in this order. A slash
# separates the keys of nested entries of summary.json.
METRICS: tuple[str, ...] = ("recall", "false_positive_rate", *RANKED, *AT_THRESHOLD, *TOP_RANKS)
# Titles by which `metric_title` replaces these names in tables.
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

# Operating points: for each label, the log-odds above which an image counts as
# a detection.
Thresholds = Mapping[str, float]


# Number of replicates that `bootstrap` draws for an interval.
REPLICATES = 2000
# Number of replicates that `bootstrap` computes at a time, which limits the
# memory.
BLOCK = 250
# Random seeds: `bootstrap` draws images with IMAGES, `replicate_difference`
# draws runs with RUNS. The seeds differ, so that both are drawn independently.
IMAGES = 0
RUNS = 1


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
        """Whether an object has several images, so that its interval is over objects, too."""
        positives_repeat = self.positive_objects != self.positives
        negatives_repeat = self.negative_objects != self.negatives
        return positives_repeat or negatives_repeat


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Metrics of a `Pool`, in the order of summary.json.

    Attributes:
        n: Number of images, positives and negatives together.
        recall: Fraction of the positives that are predicted as the class under
            study.
        top5: Fraction of the positives whose class is among the five most
            probable classes.
        false_positive_rate: Fraction of the negatives that are predicted as the
            positive class.
        recall_at_threshold: Fraction of the positives whose log-odds exceed the
            threshold. None without a threshold.
        false_positive_rate_at_threshold: Fraction of the negatives whose
            log-odds exceed the threshold. None without a threshold.
        auc: Area under the ROC curve.
        recall_at: Recall at each false-positive rate in `RATES`.
        class_top1: Fraction of the images whose class is the most probable of
            all classes of the network, as a mean over the classes. Images of
            classes that the network lacks do not count. None if there are no
            others.
        class_top5: The same for the five most probable classes.
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
        """Return the metric with a name.

        Args:
            name: Name in `METRICS`, or "top5".

        Returns:
            Metric with this name. None if it needs a threshold and there is
            none.
        """
        # The name of a recall ends with a rate, as in "recall_at/0.05". Other
        # names are names of fields.
        field_name, _, rate = name.partition("/")
        if rate:
            return self.recall_at[rate]
        return getattr(self, field_name)

    def to_summary(self) -> dict[str, Any]:
        """Convert the metrics to entries of summary.json. Metrics that are None are left out."""
        entries = asdict(self)
        return {name: entry for name, entry in entries.items() if entry is not None}


class Ranked(NamedTuple):
    """Positive and negative predictions that a ROC curve separates by their log-odds."""

    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]


class Outcome(NamedTuple):
    """Predictions of which a fraction is reported as a metric.

    Attributes:
        predictions: Predictions in the denominator of the fraction.
        hits: Whether each of them also counts in the numerator.
    """

    predictions: Sequence[Prediction]
    hits: Sequence[bool]


@dataclass(frozen=True)
class Pool:
    """Predictions that are scored together.

    With several labels, a photograph has one prediction about each of them. All
    of these predictions count.

    Attributes:
        positives: Predictions for photographs that show the positive class.
        negatives: Predictions for all other photographs.
        ranked: Predictions for the ROC curve. They may include other sources or
            meshes than `positives` and `negatives`.
        thresholds: Operating point of each label. If it is empty, the metrics
            in `AT_THRESHOLD` are None.
    """

    positives: Sequence[Prediction]
    negatives: Sequence[Prediction]
    ranked: Ranked
    thresholds: Thresholds = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Labels of the predictions, such as "orange" or "orange or lemon"."""
        predictions = [*self.positives, *self.negatives]
        # A dictionary keeps each label once, in order of first appearance.
        return " or ".join(dict.fromkeys(prediction.label for prediction in predictions))

    @property
    def scores(self) -> tuple[np.ndarray, np.ndarray]:
        """Log-odds of the positives (n,) and of the negatives (m,) of the ROC curve."""
        positives = np.array([prediction.log_odds for prediction in self.ranked.positives])
        negatives = np.array([prediction.log_odds for prediction in self.ranked.negatives])
        return positives, negatives

    @property
    def outcomes(self) -> dict[str, Outcome]:
        """Outcomes of the metrics that are fractions of images, by the name of the metric."""
        # The rank is None if the model does not have the class. It then counts
        # as worse than any rank.
        ranks = [prediction.true_rank or np.inf for prediction in self.positives]
        false_positives = [item.predicted == item.label for item in self.negatives]
        outcomes = {
            "recall": Outcome(self.positives, [rank == 1 for rank in ranks]),
            "top5": Outcome(self.positives, [rank <= 5 for rank in ranks]),
            "false_positive_rate": Outcome(self.negatives, false_positives),
        }
        if self.thresholds:
            recall, false_positive_rate = AT_THRESHOLD
            outcomes[recall] = self._above_threshold(self.positives)
            outcomes[false_positive_rate] = self._above_threshold(self.negatives)
        return outcomes

    def _above_threshold(self, predictions: Sequence[Prediction]) -> Outcome:
        """Test which predictions are above their threshold.

        Args:
            predictions: Predictions about labels that have a threshold.

        Returns:
            The predictions. A hit is a prediction whose log-odds exceed the
            threshold of its label.
        """
        hits = [item.log_odds > self.thresholds[item.label] for item in predictions]
        return Outcome(predictions, hits)

    @cached_property
    def metrics(self) -> Metrics:
        """Metrics of the pool with their intervals."""
        proportions = {}
        for name, outcome in self.outcomes.items():
            proportions[name] = fraction(sum(outcome.hits), len(outcome.hits))
        auc, *recalls = self._ranked_estimates()
        tops = self._top_estimates()
        auc_with_counts = AreaUnderCurve(
            value=auc.value,
            low=auc.low,
            high=auc.high,
            positives=len(self.ranked.positives),
            positive_objects=len(np.unique(_object_indices(self.ranked.positives))),
            negatives=len(self.ranked.negatives),
            negative_objects=len(np.unique(_object_indices(self.ranked.negatives))),
        )
        return Metrics(
            n=len(self.positives) + len(self.negatives),
            auc=auc_with_counts,
            recall_at=dict(zip(RATES, recalls, strict=True)),
            **proportions,
            class_top1=tops.get("class_top1"),
            class_top5=tops.get("class_top5"),
        )

    @cached_property
    def classified(self) -> list[Prediction]:
        """One prediction for each photograph of a class that the network has."""
        by_path: dict[PurePosixPath, Prediction] = {}
        for prediction in (*self.positives, *self.negatives):
            if prediction.true_rank is not None:
                by_path.setdefault(prediction.photograph.path, prediction)
        return list(by_path.values())

    def _top_estimates(self) -> dict[str, Estimate]:
        """Compute the metrics in `TOP_RANKS` with their bootstrap intervals.

        Returns:
            Each metric by name. Empty if no image has a class of the network.
        """
        if not self.classified:
            return {}
        values = self._top_statistic(np.ones(len(self.classified)))
        object_count = len(np.unique(_object_indices(self.classified)))
        estimates = {}
        for name, value, replicates in zip(TOP_RANKS, values, self._top_replicates, strict=True):
            estimates[name] = _estimate_or_wilson(float(value), replicates, object_count)
        return estimates

    @property
    def _top_statistic(self) -> Callable[[np.ndarray], np.ndarray]:
        """Function that computes the metrics in `TOP_RANKS` of drawn images.

        Its argument says how often each of the n images in `classified` is
        drawn, shape (..., n). It returns both metrics, shape (2, ...).
        """
        names = [prediction.photograph.label for prediction in self.classified]
        ranks = np.array([prediction.true_rank for prediction in self.classified])
        # Whether the true class is among the 1 or the 5 most probable classes,
        # shape (2, n).
        hits = np.stack([ranks <= rank for rank in TOP_RANKS.values()])
        return partial(class_means, hits, names)

    @cached_property
    def _top_replicates(self) -> np.ndarray:
        """Bootstrap replicates of the metrics in `TOP_RANKS`, shape (2, REPLICATES)."""
        return bootstrap(self._top_statistic, _object_indices(self.classified))

    def _ranked_estimates(self) -> list[Estimate]:
        """Compute the metrics in `RANKED` with their bootstrap intervals.

        Returns:
            The AUC, and the recall at each rate in `RATES`, in this order. All
            are unknown without positives or without negatives.
        """
        if not self._can_rank:
            return [Estimate() for _ in RANKED]
        estimates = []
        values = auc_and_recalls(*self.scores)
        groups = (self.ranked.positives, self.ranked.negatives)
        object_count = min(len(np.unique(_object_indices(group))) for group in groups)
        for value, replicates in zip(values, self._ranked_replicates, strict=True):
            estimates.append(_estimate_or_wilson(float(value), replicates, object_count))
        return estimates

    @property
    def _can_rank(self) -> bool:
        """Whether the ROC curve has both positives and negatives."""
        return bool(self.ranked.positives) and bool(self.ranked.negatives)

    @cached_property
    def _ranked_replicates(self) -> np.ndarray:
        """Bootstrap replicates of the four metrics in `RANKED`, shape (4, REPLICATES)."""
        statistic = partial(auc_and_recalls, *self.scores)
        positive_objects = _object_indices(self.ranked.positives)
        negative_objects = _object_indices(self.ranked.negatives)
        return bootstrap(statistic, positive_objects, negative_objects)

    @cached_property
    def replicates(self) -> dict[str, np.ndarray]:
        """Bootstrap replicates of each metric that is known, by name, shape (REPLICATES,) each."""
        replicates = {}
        for name, outcome in self.outcomes.items():
            if outcome.hits:
                statistic = partial(weighted_mean, np.array(outcome.hits))
                replicates[name] = bootstrap(statistic, _object_indices(outcome.predictions))
        if self._can_rank:
            replicates.update(zip(RANKED, self._ranked_replicates, strict=True))
        if self.classified:
            replicates.update(zip(TOP_RANKS, self._top_replicates, strict=True))
        return replicates


def _estimate_or_wilson(value: float, replicates: np.ndarray, object_count: int) -> Estimate:
    """Add a 95% interval to the value of a metric.

    The interval is the percentile interval of the bootstrap. If all replicates
    are equal, the percentile interval has no width. Wilson's interval for a
    fraction of the objects then replaces it, as if each object had one image.

    Args:
        value: Value of the metric, in [0, 1].
        replicates: Bootstrap replicates of the metric, shape (REPLICATES,).
        object_count: Number of different objects in the images.

    Returns:
        The value with its interval.
    """
    metric = estimate(value, replicates)
    if metric.low != metric.high:
        return metric
    wilson = fraction(round(value * object_count), object_count)
    assert wilson.low is not None and wilson.high is not None
    return Estimate(value=value, low=min(wilson.low, value), high=max(wilson.high, value))


def _object_indices(predictions: Sequence[Prediction]) -> np.ndarray:
    """Number the objects that the images show, in order of first appearance.

    An object is known by its mesh. An image without a known mesh counts as an
    object of its own.

    Returns:
        Index of the object that each image shows, shape (n,).
    """
    object_index_by_name: dict[str | PurePosixPath, int] = {}
    object_indices = []
    for prediction in predictions:
        name = prediction.photograph.mesh or prediction.photograph.path
        next_index = len(object_index_by_name)
        object_indices.append(object_index_by_name.setdefault(name, next_index))
    return np.array(object_indices)


def pool(predictions: Sequence[Prediction], thresholds: Thresholds | None = None) -> Pool:
    """Create the pool of predictions, in which all positives are ranked against all negatives.

    Args:
        predictions: Predictions about one or several labels.
        thresholds: Operating point of each label. None omits the metrics in
            `AT_THRESHOLD`.

    Returns:
        Pool of these predictions.
    """
    positives = [prediction for prediction in predictions if prediction.positive]
    negatives = [prediction for prediction in predictions if not prediction.positive]
    return Pool(
        positives=positives,
        negatives=negatives,
        ranked=Ranked(positives, negatives),
        thresholds=thresholds or {},
    )


@dataclass(frozen=True)
class Pooled:
    """All pools of one evaluation: of all images, and of each label, source, mesh and class.

    Attributes:
        predictions: Predictions about one or several labels.
        exclude: Sources whose images count only in `by_source`.
        thresholds: Operating point of each label. If it is empty, the metrics
            in `AT_THRESHOLD` are None.
    """

    predictions: Sequence[Prediction]
    exclude: Sequence[str] = ()
    thresholds: Thresholds = field(default_factory=dict)

    @cached_property
    def all(self) -> Pool:
        """Pool of the images of all sources that are not excluded."""
        return pool(self._included, self.thresholds)

    @cached_property
    def by_label(self) -> dict[str, Pool]:
        """Pool of the predictions about each label."""
        groups = _group(self._included, lambda prediction: prediction.label)
        return {label: pool(group, self.thresholds) for label, group in groups.items()}

    @cached_property
    def by_source(self) -> dict[str, Pool]:
        """Pool of the images of each source, excluded sources included.

        The positives of a source are ranked against its negatives. A photograph
        can also name other sources as hard negatives. The positives are ranked
        against the negatives of these sources as well.
        """
        groups = _group(self.predictions, lambda prediction: prediction.photograph.source)
        pools = {}
        for source, group in groups.items():
            source_pool = pool(group, self.thresholds)
            hard_negatives = self._hard_negatives(source_pool.positives, source)
            ranked = Ranked(
                positives=source_pool.positives,
                negatives=[*source_pool.negatives, *hard_negatives],
            )
            pools[source] = replace(source_pool, ranked=ranked)
        return pools

    def _hard_negatives(self, positives: Sequence[Prediction], source: str) -> list[Prediction]:
        """Find the negatives of all other sources that positives name as hard negatives.

        A positive is ranked only against predictions about its own label.

        Args:
            positives: Positives of one source.
            source: Name of this source. Its own negatives are not returned.
        """
        named_labels_and_sources = set()
        for prediction in positives:
            for other_source in prediction.photograph.hard_negatives:
                if other_source != source:
                    named_labels_and_sources.add((prediction.label, other_source))
        hard_negatives = []
        for prediction in self.predictions:
            label_and_source = (prediction.label, prediction.photograph.source)
            if not prediction.positive and label_and_source in named_labels_and_sources:
                hard_negatives.append(prediction)
        return hard_negatives

    @cached_property
    def by_mesh(self) -> dict[str, Pool]:
        """Pool of the images of each mesh, see `_by_content`."""
        return self._by_content(lambda prediction: prediction.photograph.mesh)

    @cached_property
    def by_class(self) -> dict[str, Pool]:
        """Pool of the images of each class, see `_by_content`."""
        return self._by_content(lambda prediction: prediction.photograph.label)

    def _by_content(self, name_of: Callable[[Prediction], str | None]) -> dict[str, Pool]:
        """Make a pool of the images of each mesh, or of each class.

        For the ROC curve, the images of a positive class are ranked against the
        negatives of all meshes and classes. Images of other things are ranked
        against the positives of all meshes and classes.

        Args:
            name_of: Function that returns the name of the mesh or class that
                the image of a prediction shows. None if it is unknown.

        Returns:
            Pools by the name of the mesh or class.
        """
        labels = {prediction.label for prediction in self.predictions}
        pools = {}
        for name, group in _group(self._included, name_of).items():
            own_pool = pool(group, self.thresholds)
            # With the labels orange and lemon, an image of an orange has two
            # predictions: a positive about orange, and a negative about lemon.
            # The negative about lemon is left out here. Otherwise the oranges
            # would be ranked only against predictions for the same oranges.
            negatives = []
            for prediction in own_pool.negatives:
                if prediction.photograph.label not in labels:
                    negatives.append(prediction)
            ranked = Ranked(
                positives=own_pool.positives or self.all.positives,
                negatives=negatives or self.all.negatives,
            )
            pools[name] = replace(own_pool, ranked=ranked)
        return pools

    @cached_property
    def _included(self) -> list[Prediction]:
        """Predictions for images of sources that are not excluded."""
        return [item for item in self.predictions if item.photograph.source not in self.exclude]


def _group(
    predictions: Sequence[Prediction], name_of: Callable[[Prediction], str | None]
) -> dict[str, list[Prediction]]:
    """Group predictions by a name, such as that of their source.

    Args:
        predictions: Predictions to group.
        name_of: Function that returns the name of the group of a prediction. If
            it returns None, the prediction is left out.

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
    """Evaluate a statistic on bootstrap replicates of objects and images.

    A group is a sequence of images, such as the positives. For each replicate,
    as many objects are drawn as the group shows, with replacement. For each
    drawn object, as many of its images are drawn as it has, again with
    replacement (Davison and Hinkley 1997, section 3.8). With one image per
    object, this is the ordinary bootstrap over images. Equal groups get equal
    draws in every call, so metrics of networks on the same images are paired.

    The variance of a mean over k objects is too small by a factor of
    (k - 1) / k. With several objects, the variance over images is counted about
    twice.

    Args:
        statistic: Function that is evaluated for BLOCK replicates at a time.
            For each group, it takes how often each replicate draws each image,
            shape (BLOCK, n). It returns an array of shape (..., BLOCK).
        *groups: For each group of n ≥ 1 images, the index of the object that
            each image shows, shape (n,). Objects are numbered from 0 in order
            of first appearance.

    Returns:
        Statistic of each replicate, shape (..., REPLICATES).
    """
    generator = np.random.default_rng(IMAGES)
    blocks = []
    for _ in range(REPLICATES // BLOCK):
        draw_counts = [_draw(object_indices, generator) for object_indices in groups]
        blocks.append(statistic(*draw_counts))
    return np.concatenate(blocks, axis=-1)


def _draw(object_of_image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw the images of BLOCK replicates.

    Args:
        object_of_image: Index of the object that each image shows, shape (n,),
            as in `bootstrap`.
        generator: Source of the random numbers.

    Returns:
        How often each replicate draws each image, shape (BLOCK, n).
    """
    image_count = len(object_of_image)
    # Number of images of each object, shape (objects,).
    object_sizes = np.bincount(object_of_image)
    object_count = len(object_sizes)
    # The drawn objects of all replicates, one replicate after the other, and
    # the replicate that draws each, shape (BLOCK · objects,).
    drawn_objects = generator.integers(object_count, size=(BLOCK, object_count)).ravel()
    replicates = np.arange(BLOCK).repeat(object_count)
    if object_count == image_count:
        # Each object has one image, and image i shows object i.
        drawn_images = drawn_objects
    else:
        drawn_sizes = object_sizes[drawn_objects]
        # The images in the order of their objects, and the position at which
        # the images of each object start.
        images_by_object = object_of_image.argsort(kind="stable")
        first_position = object_sizes.cumsum() - object_sizes
        # The following arrays have one entry for each drawn image.
        position_in_object = generator.integers(drawn_sizes.repeat(drawn_sizes))
        object_start = first_position[drawn_objects].repeat(drawn_sizes)
        drawn_images = images_by_object[object_start + position_in_object]
        replicates = replicates.repeat(drawn_sizes)
    # Each pair of a replicate and an image has an index of its own.
    pairs = replicates * image_count + drawn_images
    draw_counts = np.bincount(pairs, minlength=BLOCK * image_count)
    return draw_counts.reshape(BLOCK, image_count)


def weighted_mean(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Compute the mean of values of which each counts several times.

    With fixed `values`, this is a statistic for `bootstrap`.

    Args:
        values: Values, shape (n,).
        counts: How often each value counts, shape (..., n).

    Returns:
        Weighted mean, shape (...).
    """
    return counts @ values / counts.sum(axis=-1)


def class_means(hits: np.ndarray, names: Sequence[str], counts: np.ndarray) -> np.ndarray:
    """Compute the mean over classes of the fraction of hits in each class.

    An image weighs 1 / n if its class has n images. The mean of all images with
    these weights is the mean over classes. With fixed `hits` and `names`, this
    is a statistic for `bootstrap`, whose replicates vary with the classes of
    the drawn objects, too.

    Args:
        hits: Whether each image is a hit in each of K ways, shape (K, n).
        names: Name of the class of each image.
        counts: How often each image counts, shape (..., n).

    Returns:
        Mean over classes, shape (K, ...).
    """
    _, class_of_image, class_sizes = np.unique(names, return_inverse=True, return_counts=True)
    weights = 1 / class_sizes[class_of_image]
    total = counts @ weights
    return np.stack([counts @ (weights * row) / total for row in hits])


def estimate(value: float, replicates: np.ndarray) -> Estimate:
    """Add the 95% percentile interval to the value of a metric.

    This is the interval of Efron and Tibshirani (1993), chapter 13. It stays
    within the range of the metric. Their BCa interval would be undefined if all
    replicates are equal, as at a recall of 1.

    Args:
        value: Value of the metric for all images.
        replicates: Bootstrap replicates of the metric, shape (REPLICATES,).

    Returns:
        Value with its interval.
    """
    low, high = np.quantile(replicates, (0.025, 0.975))
    return Estimate(value=value, low=float(low), high=float(high))


def replicate_difference(one: np.ndarray, other: np.ndarray, paired: bool) -> np.ndarray:
    """Compute how much the mean metric of two groups of runs differs in each replicate.

    In each replicate, as many runs are drawn as a group has, with replacement.

    Args:
        one: Replicates of the metric for each run of the first group, shape
            (S, REPLICATES).
        other: Replicates of the metric for each run of the second group, shape
            (T, REPLICATES).
        paired: If True, S and T are equal, and run s of the first group is
            drawn together with run s of the second group.

    Returns:
        Mean of the first group minus mean of the second group, shape
        (REPLICATES,).
    """
    generator = np.random.default_rng(RUNS)
    if paired:
        return _mean_of_drawn_runs(one - other, generator)
    mean_of_one = _mean_of_drawn_runs(one, generator)
    mean_of_other = _mean_of_drawn_runs(other, generator)
    return mean_of_one - mean_of_other


def _mean_of_drawn_runs(runs: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw S runs in each replicate, with replacement, and average them.

    Args:
        runs: Replicates for each run, shape (S, REPLICATES).
        generator: Source of the random numbers.

    Returns:
        Mean of the drawn runs in each replicate, shape (REPLICATES,).
    """
    drawn_runs = generator.integers(len(runs), size=runs.shape)
    return np.take_along_axis(runs, drawn_runs, axis=0).mean(axis=0)


def auc_and_recalls(
    positives: np.ndarray,
    negatives: np.ndarray,
    drawn: np.ndarray | None = None,
    others: np.ndarray | None = None,
) -> np.ndarray:
    """Compute the metrics in `RANKED`: the AUC, and the recall at each rate in `RATES`.

    The AUC is the probability that a positive scores above a negative, with
    ties counted half (Mann and Whitney 1947). The recall is the fraction of the
    positives that score above the threshold of `thresholds`. A positive at the
    threshold is missed.

    Args:
        positives: Scores of the positives, shape (n,).
        negatives: Scores of the negatives, shape (m,).
        drawn: How often each positive counts, shape (..., n). None counts each
            once.
        others: How often each negative counts, shape (..., m). None counts each
            once.

    Returns:
        AUC and recalls, shape (4, ...).
    """
    positive_counts = np.ones(len(positives), int) if drawn is None else drawn
    negative_counts = np.ones(len(negatives), int) if others is None else others
    positive_total = positive_counts.sum(axis=-1)

    order = negatives.argsort()
    sorted_negatives = negatives[order]
    # Entry i is the number of negatives among the i lowest scores, for i from 0
    # to m, shape (..., m + 1).
    cumulative = np.insert(negative_counts[..., order].cumsum(axis=-1), 0, 0, axis=-1)
    negative_total = cumulative[..., -1]
    # Number of negatives that score below each positive, without and with ties,
    # shape (..., n).
    below = cumulative[..., sorted_negatives.searchsorted(positives, "left")]
    below_or_tied = cumulative[..., sorted_negatives.searchsorted(positives, "right")]
    # A negative below the positive counts in both sums, a tie in one of them.
    wins = (positive_counts * below).sum(axis=-1)
    wins_and_ties = (positive_counts * below_or_tied).sum(axis=-1)
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

    The threshold is the lowest of the scores of the negatives that is high
    enough: at most the given fraction of the negatives score above it. With the
    rate 0.10 and 20 negatives, at most 2 score above the threshold.

    Args:
        negatives: Scores of the negatives, shape (m,).
        counts: How often each negative counts, shape (..., m).
        rates: False-positive rates as decimal strings, which keeps them exact.

    Returns:
        An array of thresholds for each rate, shape (...) each.
    """
    order = negatives.argsort()
    sorted_negatives = negatives[order]
    # Entry i is the number of negatives among the i + 1 lowest scores, shape
    # (..., m).
    cumulative = counts[..., order].cumsum(axis=-1)
    total = cumulative[..., -1]
    thresholds_by_rate = []
    for rate in rates:
        # Floating-point products such as 0.29 * 100 can fall below the whole
        # number.
        exact_rate = fractions.Fraction(rate)
        may_exceed = exact_rate.numerator * total // exact_rate.denominator
        must_not_exceed = total - may_exceed
        # Index of the lowest score that at most `may_exceed` negatives exceed.
        index = (cumulative < must_not_exceed[..., None]).sum(axis=-1)
        thresholds_by_rate.append(sorted_negatives[index])
    return thresholds_by_rate


def roc_curve(
    positives: np.ndarray,
    negatives: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the ROC curve, from (0, 0) to (1, 1).

    An image is predicted as positive if its score exceeds the threshold. The
    curve has one point per distinct score, and a last one at minus infinity,
    which all scores exceed.

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
    cutoffs = np.append(distinct_scores[::-1], -np.inf)
    false_positive_rate = _fraction_above(negatives, cutoffs)
    recall = _fraction_above(positives, cutoffs)
    return false_positive_rate, recall, cutoffs


def _fraction_above(scores: np.ndarray, cutoffs: np.ndarray) -> np.ndarray:
    """Compute the fraction of the scores that exceed each cutoff.

    Args:
        scores: Scores, shape (n,).
        cutoffs: Cutoffs, shape (c,).

    Returns:
        Fraction for each cutoff, in [0, 1], shape (c,).
    """
    at_or_below = np.sort(scores).searchsorted(cutoffs, "right")
    return (len(scores) - at_or_below) / len(scores)


def _find_entry(summary: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the entry of a metric, or an empty dictionary if there is none.

    The metric "recall_at/0.05" is summary["recall_at"]["0.05"] in summary.json,
    and summary["recall_at/0.05"] in the file of a published network.
    """
    entry: Any = summary
    for key in name.split("/"):
        # An entry that is missing is empty, and so are all entries below it.
        entry = entry.get(key, {})
    return entry or summary.get(name, {})


def read_metric(summary: Mapping[str, Any], name: str) -> Estimate | None:
    """Read a metric from summary.json.

    Args:
        summary: Contents of summary.json, or the entry of one label, source or
            mesh below "by_label", "by_source" or "by_mesh".
        name: Name in `METRICS`, or "top5".

    Returns:
        Metric with its counts, if the file has them. None if the file lacks the
        metric.

    Raises:
        KeyError, TypeError, ValueError: If the entry is damaged.
    """
    entry = _find_entry(summary, name)
    if not entry:
        return None
    ends: dict[str, float | None] = dict.fromkeys(("value", "low", "high"))
    if entry.get("value") is not None:
        ends = {end: float(entry[end]) for end in ends}
    if "hits" in entry:
        return Proportion(**ends, hits=entry["hits"], n=entry["n"])
    if "positives" in entry:
        positives = entry["positives"]
        negatives = entry["negatives"]
        # Files of older versions lack the numbers of objects.
        return AreaUnderCurve(
            **ends,
            positives=positives,
            positive_objects=entry.get("positive_objects", positives),
            negatives=negatives,
            negative_objects=entry.get("negative_objects", negatives),
        )
    return Estimate(**ends)


def metric_title(name: str) -> str:
    """Return the title of a metric in tables.

    Args:
        name: Name in `METRICS`, or "top5".

    Returns:
        Title such as "AUC" or "recall at 10% FPR".
    """
    if name in TITLES:
        return TITLES[name]
    # The name is one of a recall, such as "recall_at/0.10".
    _, _, rate = name.partition("/")
    return f"recall at {float(rate):.0%} FPR"
