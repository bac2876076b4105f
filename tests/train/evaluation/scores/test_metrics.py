from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import bootstrap as scipy_bootstrap
from scipy.stats import mannwhitneyu

from train.evaluation.scores.metrics import (
    RANKED,
    RATES,
    REPLICATES,
    auc_and_recalls,
    bootstrap,
    estimate,
    replicate_difference,
    thresholds,
)

# The scores have few values, so that ties are common.
SCORES = st.lists(st.integers(-4, 4).map(float), min_size=1, max_size=30)


@settings(deadline=None)
@given(positives=SCORES, negatives=SCORES)
def test_auc_is_the_mann_whitney_statistic_in_which_ties_count_half(positives, negatives):
    statistic = mannwhitneyu(positives, negatives, method="asymptotic").statistic
    expected = statistic / (len(positives) * len(negatives))
    auc, *_ = auc_and_recalls(np.array(positives), np.array(negatives))
    assert auc == pytest.approx(expected, rel=0, abs=1e-12)


def lowest_threshold(positives: list[float], negatives: list[float], rate: str) -> float:
    """Try every score, and return the lowest that at most `rate` of the negatives exceed."""
    allowed = Fraction(rate) * len(negatives)
    for score in sorted(positives + negatives):
        exceeding = sum(negative > score for negative in negatives)
        if exceeding <= allowed:
            return score
    raise AssertionError("no score exceeds the highest one")


@settings(deadline=None)
@given(positives=SCORES, negatives=SCORES)
def test_recall_at_a_rate_is_that_at_the_lowest_threshold_within_the_rate(positives, negatives):
    _, *recalls = auc_and_recalls(np.array(positives), np.array(negatives))
    found = thresholds(np.array(negatives), np.ones(len(negatives), int))
    for rate, recall, threshold in zip(RATES, recalls, found, strict=True):
        expected = lowest_threshold(positives, negatives, rate)
        assert threshold == expected
        assert recall == sum(score > expected for score in positives) / len(positives)


@pytest.mark.parametrize("image_count", [1, 3])
@pytest.mark.parametrize("name", ["auc", "recall_at/0.10"])
def test_intervals_are_those_of_scipys_bootstrap_over_objects_however_often_an_image_repeats(
    name,
    image_count,
):
    """Compare up to chance.

    The standard error of an end is below 0.006, and a step of the recall is 1/80.
    """
    generator = np.random.default_rng(3)
    positives = generator.normal(1, 1, 80).round(1)
    negatives = generator.normal(0, 1.5, 120).round(1)
    column = RANKED.index(name)
    reference = scipy_bootstrap(
        (positives, negatives),
        lambda positives, negatives: auc_and_recalls(positives, negatives)[column],
        vectorized=False,
        method="percentile",
        n_resamples=2000,
        rng=np.random.default_rng(8),
    ).confidence_interval

    statistic = partial(
        auc_and_recalls,
        positives.repeat(image_count),
        negatives.repeat(image_count),
    )
    objects = [np.arange(count).repeat(image_count) for count in (80, 120)]
    replicates = bootstrap(statistic, *objects)[column]

    ends = estimate(0.5, replicates)
    assert (ends.low, ends.high) == pytest.approx(tuple(reference), rel=0, abs=0.02)
    np.testing.assert_array_equal(bootstrap(statistic, *objects)[column], replicates)


def test_the_spread_over_objects_and_their_images_is_that_of_a_two_level_bootstrap():
    """Compare with the closed form of the variance of the mean.

    For k objects of m images, it is
    (variance of the objects' means + mean variance within an object / m) / k.
    """
    generator = np.random.default_rng(2)
    object_shift = generator.normal(0, 0.5, 5)
    values = generator.normal(0, 1, (8, 5)) + object_shift  # (image, object)
    object_of_image = np.arange(40) % 5

    means = bootstrap(lambda counts: counts @ values.ravel() / 40, object_of_image)

    variance = (values.mean(axis=0).var() + values.var(axis=0).mean() / 8) / 5
    standard_error = (variance / REPLICATES) ** 0.5
    assert means.mean() == pytest.approx(values.mean(), abs=4 * standard_error)
    # 13 % are four standard errors of the variance of 2,000 replicates.
    assert means.var() == pytest.approx(variance, rel=0.13)


# The score of a run depends on its seed, 0 to 3, in all replicates alike: (seed, replicate).
SCORE_OF_SEED = np.arange(4.0)[:, None] + np.zeros(REPLICATES)


def test_pairing_cancels_what_both_runs_share():
    difference = replicate_difference(SCORE_OF_SEED + 0.5, SCORE_OF_SEED, True)
    np.testing.assert_array_equal(difference, 0.5)


def test_without_pairs_the_difference_has_the_variance_of_both_means():
    """Compare with 2 · 1.25 / 4, as 0 to 3 have the variance 1.25."""
    difference = replicate_difference(SCORE_OF_SEED + 0.5, SCORE_OF_SEED, False)
    assert difference.mean() == pytest.approx(0.5, abs=0.1)
    assert difference.std() == pytest.approx(np.sqrt(0.625), rel=0.1)


@pytest.mark.parametrize("is_paired", [True, False])
def test_a_single_seed_adds_no_spread(is_paired):
    single = SCORE_OF_SEED[:1]
    difference = replicate_difference(single + 0.5, single, is_paired)
    np.testing.assert_array_equal(difference, 0.5)
