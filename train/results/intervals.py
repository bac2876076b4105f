"""95% intervals of metrics by leaving out objects, and the statistics that they are of.

The statistics are the AUC, the recall at a given false-positive rate, and means over classes.
"""

import fractions
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Num, Shaped

from train.results.tables import NORMAL_QUANTILE, Estimate, Proportion, fraction, wilson

# False-positive rates at which the recall is reported. Decimal strings are exact,
# while a float such as 0.1 is not.
RATES = ("0.05", "0.10", "0.20")
# Largest number of parts into which the units, such as objects, are divided. Each part is left out
# once. More parts would hardly change most intervals. A recall at a false-positive rate depends on
# a quantile: the jackknife gets its variance right only if parts have several images.
MAX_PARTS = 30
# Smallest ratio of the errors without a part to all errors. It keeps the logit finite if all
# errors are in one part.
MIN_RATIO = 0.2
# Start of `Jackknife.over` if the last group of units is that of several training runs.
SEEDS = "seeds and "


class Units(NamedTuple):
    """Units over which an interval is taken: objects, or images.

    Attributes:
        groups: For each group of images, the number of the unit that each image
            belongs to, shape (n,). Groups that have the same number share the unit.
        over: What the units are: OBJECTS, IMAGES or THESE_OBJECTS.
    """

    groups: Sequence[np.ndarray]
    over: str


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
            # The second group, the negatives, only moves the threshold. `at_ends` has its effect.
            positives, _, *seeds = self.without
            fixed = replace(self, without=[positives, *seeds], at_ends=None).interval
            down, up = np.hypot(fixed - value, self.at_ends - value)
            return np.clip([value - down, value + up], 0, 1)
        # With a single unit, no variance is known, so the interval is [0, 1].
        if min((item.shape[-1] for item in self.without), default=0) < 2:
            return np.stack([np.zeros_like(value), np.ones_like(value)])
        # The logit of 0 or 1 is infinite, so 0.5 stands for such a value until the last line.
        is_inner = (value > 0) & (value < 1)
        inner = np.where(is_inner, value, 0.5)
        # Without a unit, a value keeps at least MIN_RATIO of its distance from 0 and from 1.
        lowest, highest = MIN_RATIO * inner[..., None], 1 - MIN_RATIO * (1 - inner[..., None])
        errors = [item.clip(lowest, highest) for item in self.without]
        logits = [np.where(is_inner[..., None], _logit(item), 0.0) for item in errors]
        variance, quantile = _spread(logits)
        half_width = quantile * variance**0.5
        # The logistic function turns logit(value) ∓ half width back into fractions.
        ends = 1 / (1 + np.exp(np.stack([half_width, -half_width]) - _logit(inner)))
        return np.where(variance > 0, ends, wilson(value, self.unit_count, quantile))

    @property
    def is_open(self) -> np.ndarray:
        """Whether no positive exceeds the high end of the threshold, shape (...)."""
        return np.zeros_like(self.value, bool) if self.at_ends is None else self.at_ends[0] == 0

    @property
    def estimate(self) -> Estimate:
        """Value with its 95% interval."""
        low, high = map(float, self.interval)
        return Estimate(float(self.value), low, high, self.over)

    def proportion(self, hits: Shaped[np.ndarray, " n"]) -> Proportion:
        """Count the hits of which this is the mean.

        If no unit occurs twice, the interval is Wilson's.
        """
        proportion = fraction(int(hits.sum()), len(hits))
        if self.unit_count == proportion.n:
            return replace(proportion, over=self.over)
        return replace(proportion, **asdict(self.estimate))


def leave_out(statistic: Callable[..., np.ndarray], units: Units) -> list[Jackknife]:
    """Evaluate M statistics without each unit, or without each of MAX_PARTS parts of them.

    Images of the same object are not independent, so an object is left out with
    all its images, of all groups. The parts depend only on `units`. Metrics of two
    networks on the same images are therefore paired. `statistic` takes, for each group, how often
    each of its n images counts, shape (k, n), and returns an array of shape (M, ..., k).
    """
    # Each image counts once at first. The axis of length 1 is for what is left out (`is_kept`).
    counts = [np.ones((1, len(unit_of_image)), int) for unit_of_image in units.groups]
    values = statistic(*counts)
    unit_counts = [len({*unit_of_image.tolist()}) for unit_of_image in units.groups]
    without: list[np.ndarray] = []
    for group, unit_of_image in enumerate(units.groups):
        # Units that earlier groups have, too, have been left out.
        own = np.setdiff1d(unit_of_image, np.concatenate([[], *units.groups[:group]]))
        if len(own) < 2:  # The only unit cannot be left out.
            is_single = unit_counts[group] == 1
            without.append(values if is_single else np.broadcast_to(values, without[0].shape))
            continue
        part_count = min(len(own), MAX_PARTS)
        # A random order divides the units into parts of about equal size.
        order = np.random.default_rng(0).permutation(len(own))
        part_of_unit = np.full(1 + max(map(np.max, units.groups)), -1)
        part_of_unit[own] = order * part_count // len(own)
        # Row p leaves out the images of part p, shape (k, n). The images of other units remain.
        parts = np.arange(part_count)[:, None]
        is_kept = ((part_of_unit[units_of] != parts).astype(int) for units_of in units.groups)
        without.append(statistic(*is_kept))
    # One row for each of the M statistics.
    rows = zip(values[..., 0], *without, strict=True)
    return [Jackknife(value, others, min(unit_counts), units.over) for value, *others in rows]


def leave_out_of_mean(values: Shaped[np.ndarray, " n"], units: Units) -> Jackknife:
    """Evaluate the mean of values of images, such as 1 for each hit, without each unit."""
    (mean,) = leave_out(partial(weighted_means, values[None].astype(float)), units)
    return mean


def leave_out_of_roc(
    positives: Num[np.ndarray, " n"], negatives: Num[np.ndarray, " m"], units: Units
) -> list[Jackknife]:
    """Evaluate ROC_METRICS without each unit, and the recalls at the ends of their thresholds.

    The false-positive rate at the estimated threshold has an interval around the nominal rate. The
    ends of the interval of the threshold are the scores that these fractions of the negatives
    exceed (Woodruff 1952). If less than half a negative exceeds an end, it may be above all scores.
    """
    auc, *recalls = leave_out(partial(auc_and_recalls, positives, negatives), units)
    count = len(negatives)
    # Exactly i negatives score above entry i, if no scores are equal.
    descending = -np.sort(-negatives)
    results = [auc]
    levels = thresholds(negatives, np.ones(count, int))
    for rate, recall, threshold in zip(RATES, recalls, levels, strict=True):
        is_above = negatives > threshold
        is_tied = negatives == threshold
        # Negatives at the threshold count in part, so that the rate is the nominal one.
        missing = float(rate) * count - is_above.sum()
        # `hits` says which part of each negative counts as above the threshold.
        hits = is_above + is_tied * missing / is_tied.sum()
        # Numbers of negatives above both ends of the interval of the threshold, shape (2,).
        exceeding = leave_out_of_mean(hits, Units(units.groups[1:], "")).interval * count
        places = exceeding.astype(int).clip(max=count - 1)
        is_detected = positives > descending[places, None]
        # Nothing is detected if the threshold may be above all scores.
        at_ends = np.where(exceeding < 0.5, 0.0, is_detected.mean(axis=-1))
        results.append(replace(recall, at_ends=at_ends))
    return results


def average(runs: Sequence[Jackknife]) -> Jackknife:
    """Average a metric over training runs. Several runs are a further group of units."""
    values = np.stack([run.value for run in runs])
    # The values (..., k) without each unit of a group, of all runs.
    groups = zip(*(run.without for run in runs), strict=True)
    without = [np.mean(group, axis=0) for group in groups]
    over = runs[0].over
    if len(runs) > 1:  # The means of the other runs, without each run.
        without.append(np.moveaxis((values.sum(axis=0) - values) / (len(runs) - 1), 0, -1))
        over = f"{SEEDS}{over}"
    all_ends = [run.at_ends for run in runs if run.at_ends is not None]
    at_ends = np.mean(all_ends, axis=0) if all_ends else None  # Shape (2, ...).
    return Jackknife(values.mean(axis=0), without, runs[0].unit_count, over, at_ends)


def change(after: Sequence[Jackknife], before: Sequence[Jackknife], is_paired: bool) -> Estimate:
    """Subtract the means of a metric over two groups of runs, with the 95% interval.

    The interval combines those of both means and their correlation (Zou and
    Donner 2008), so it is as asymmetric as they are. If both groups have the
    same values without each unit, it is that of 0 changes in Wilson's sense. `is_paired` says that
    run i of both has the same seed.
    """
    one, other = average(after), average(before)
    low, high = map(float, change_ends(one, other, is_paired))
    return Estimate(float(one.value - other.value), low, high, max(one.over, other.over, key=len))


def change_ends(one: Jackknife, other: Jackknife, is_paired: bool = True) -> np.ndarray:
    """Compute the ends of the interval of `change` from averages over runs, shape (2, ...)."""
    value = one.value - other.value
    # With a single unit, no variance is known, so the interval is all possible changes.
    if min((item.shape[-1] for item in [*one.without, *other.without]), default=0) < 2:
        return np.stack([np.full_like(value, -1), np.full_like(value, 1)])
    # The last group of several runs is that of the runs (`average`). It may not be paired.
    group_count = None if is_paired or not one.over.startswith(SEEDS) else -1
    pairs = list(zip(one.without[:group_count], other.without, strict=False))
    # correlation = covariance / sqrt(variance · other variance). Without variance, it is 0.
    product = _spread(one.without)[0] * _spread(other.without)[0]
    covariance = np.sum([_covariance(*pair) for pair in pairs], axis=0)
    correlation = np.where(product > 0, covariance / np.where(product > 0, product, 1) ** 0.5, 0)
    low, high = one.interval
    other_low, other_high = other.interval
    # The change is lowest if `one` is at its lower end and `other` at its upper end.
    down = _half_width(one.value - low, other_high - other.value, correlation, one.is_open)
    up = _half_width(high - one.value, other.value - other_low, correlation, other.is_open)
    ends = np.clip([value - down, value + up], -1, 1)
    # The values are the same on all images, and also without each unit.
    is_same = (value == 0) & np.all([(a == b).all(axis=-1) for a, b in pairs], axis=0)
    if one.at_ends is not None and other.at_ends is not None:
        is_same &= (one.at_ends == other.at_ends).all(axis=0)
    # The upper end of Wilson's interval for 0 of `unit_count` units.
    _, margin = wilson(0, one.unit_count, NORMAL_QUANTILE)
    return np.where(is_same, np.multiply.outer([-margin, margin], np.ones_like(value)), ends)


def _half_width(
    a: np.ndarray, b: np.ndarray, correlation: np.ndarray, is_open: np.ndarray
) -> np.ndarray:
    """Compute the half width of a difference whose parts have the half widths a and b.

    If the threshold of a recall may be above all scores (`is_open`), the recall has no lower limit.
    Its distance is then no error that partly cancels, and the distances are added.
    """
    squared = np.where(is_open, (a + b) ** 2, a * a + b * b - 2 * correlation * a * b)
    return np.maximum(0.0, squared) ** 0.5


def _covariance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Compute the jackknife covariance of statistics from their values (..., k) without units."""
    # Equal values may differ from their mean by rounding, which is no variance.
    deviations = ((x - x.mean(axis=-1, keepdims=True)).round(12) for x in (one, other))
    return (one.shape[-1] - 1) * np.mean(np.multiply(*deviations), axis=-1)


def _spread(without: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the jackknife variance of a statistic, and the quantile of t for its interval.

    The variances of the groups of units, from the values without each unit, add up.
    """
    # This import is here because it takes a second.
    from scipy.special import stdtrit

    # A group of k units has k - 1 degrees of freedom.
    degrees = np.array([item.shape[-1] - 1 for item in without])
    variances = np.stack([_covariance(values, values) for values in without], axis=-1)
    total = variances.sum(axis=-1)
    terms = (variances / degrees).sum(axis=-1)
    # Harmonic mean of the degrees, weighted by variance. Without variance, the smallest.
    freedom = np.where(total > 0, total / np.where(total > 0, terms, 1), degrees.min())
    return total, stdtrit(freedom, 0.975)


def _logit(values: np.ndarray) -> np.ndarray:
    """Compute the log-odds of values in (0, 1)."""
    return np.log(values) - np.log1p(np.negative(values))


def weighted_means(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Compute means over images that count several times: (..., n) and (k, n) to (..., k)."""
    return values @ counts.T / counts.sum(axis=-1)


def class_means(
    hits: Bool[np.ndarray, "... n"], names: Sequence[str], counts: Num[np.ndarray, "k n"]
) -> Float[np.ndarray, "... k"]:
    """Compute the fraction of hits in each class, and average it over the classes.

    An image of a class with n images has the weight 1 / n. `functools.partial(class_means, hits,
    names)` is a statistic for `leave_out`. `hits` has a row for each definition of a hit, such as
    top-1, and `counts` says how often each image counts.
    """
    _, class_of_image, class_sizes = np.unique(names, return_inverse=True, return_counts=True)
    # Sums in the same order make a mean of ones exactly 1.
    weight_of_image = 1 / class_sizes[class_of_image] * counts
    return (hits[..., None, :] * weight_of_image).sum(axis=-1) / weight_of_image.sum(axis=-1)


def auc_and_recalls(
    positives: Num[np.ndarray, " n"],
    negatives: Num[np.ndarray, " m"],
    *counts: Int[np.ndarray, "... _"],
) -> Float[np.ndarray, "4 ..."]:
    """Compute the AUC, and the recall at each false-positive rate in `RATES`.

    The AUC is the probability that a random positive has a higher score than a
    random negative. A tie counts half (Mann and Whitney 1947). The recall is the
    fraction of the positives that score above the threshold for a
    false-positive rate. A positive at the threshold counts as missed. `counts` say how often each
    positive and each negative counts, shapes (..., n) and (..., m). Without them, each counts once.
    """
    ones = (np.ones(len(scores), int) for scores in (positives, negatives))
    positive_counts, negative_counts = counts or ones
    positive_total = positive_counts.sum(axis=-1)

    order = negatives.argsort()
    ascending = negatives[order]
    # Entry i of `counts_below` is the sum of the counts of the i negatives with the
    # lowest scores, for i from 0 to m, shape (..., m + 1).
    counts_below = np.insert(negative_counts[..., order].cumsum(axis=-1), 0, 0, axis=-1)
    negative_total = counts_below[..., -1]
    # Number of negatives with a lower score than each positive, shape (..., n).
    lower = counts_below[..., ascending.searchsorted(positives, "left")]
    # Number of negatives whose score is lower than that of each positive, or equal to it.
    lower_or_equal = counts_below[..., ascending.searchsorted(positives, "right")]
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
    negatives: Num[np.ndarray, " m"], counts: Int[np.ndarray, "... m"], rates: Sequence[str] = RATES
) -> list[np.ndarray]:
    """Find the score threshold for each false-positive rate.

    The threshold is the score of a negative. It is the lowest such score that
    at most the given fraction of the negatives exceed. With the rate 0.10 and
    20 negatives, at most 2 negatives exceed the threshold. `rates` are decimal strings, because
    these are exact.
    """
    order = negatives.argsort()
    # Entry i is the sum of the counts of the i + 1 negatives with the lowest scores,
    # shape (..., m).
    counts_up_to = counts[..., order].cumsum(axis=-1)
    total = counts_up_to[..., -1]
    thresholds_by_rate = []
    # A float would be inexact: 0.29 * 100 is less than 29 and would become 28.
    for rate in map(fractions.Fraction, rates):
        needed_up_to = total - rate.numerator * total // rate.denominator
        # The index is the number of scores that too many negatives exceed.
        index = (counts_up_to < needed_up_to[..., None]).sum(axis=-1)
        thresholds_by_rate.append(negatives[order[index]])
    return thresholds_by_rate


def roc_curve(
    positives: Float[np.ndarray, " n"], negatives: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Compute the points of the ROC curve, from (0, 0) to (1, 1).

    An image counts as detected if its score exceeds a threshold. Each distinct
    score is the threshold of one point of the curve. The last point has the
    threshold minus infinity, which all scores exceed. Return the false-positive rates, the recalls
    and the descending thresholds.
    """
    descending_thresholds = np.append(np.unique([*positives, *negatives])[::-1], -np.inf)
    false_positive_rate, recall = (
        (len(scores) - np.sort(scores).searchsorted(descending_thresholds, "right")) / len(scores)
        for scores in (negatives, positives)
    )
    return false_positive_rate, recall, descending_thresholds
