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

SCORES = st.lists(st.integers(-4, 4).map(float), min_size=1, max_size=30)  # of few values, so that ties are common


def brute_force_recall(positives: list[float], negatives: list[float], rate: str) -> tuple[float, float]:
    """Recall and threshold by trying every score: the lowest that at most the fraction `rate` of negatives exceeds."""
    allowed = Fraction(rate) * len(negatives)
    scores = positives + negatives
    threshold = min(score for score in scores if sum(negative > score for negative in negatives) <= allowed)
    return sum(score > threshold for score in positives) / len(positives), threshold


@settings(deadline=None)
@given(positives=SCORES, negatives=SCORES)
def test_auc_is_the_mann_whitney_statistic_and_recall_that_at_the_lowest_threshold_within_a_rate(positives, negatives):
    """Ties count half in the AUC."""
    statistic = mannwhitneyu(positives, negatives, method="asymptotic").statistic
    auc, *recalls = auc_and_recalls(np.array(positives), np.array(negatives))
    assert auc == pytest.approx(statistic / (len(positives) * len(negatives)), rel=0, abs=1e-12)
    bars = thresholds(np.array(negatives), np.ones(len(negatives), int))
    for rate, recall, threshold in zip(RATES, recalls, bars, strict=True):
        assert (recall, threshold) == brute_force_recall(positives, negatives, rate)


@pytest.fixture(scope="module")
def scores() -> tuple[np.ndarray, np.ndarray]:
    """Positives and negatives of a mediocre network, with ties."""
    generator = np.random.default_rng(3)
    return generator.normal(1, 1, 80).round(1), generator.normal(0, 1.5, 120).round(1)


@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("name", ["auc", "recall_at/0.10"])
def test_intervals_are_those_of_scipys_bootstrap_over_objects_however_often_an_image_repeats(scores, name, images):
    """Up to the replicates' chance: an end's own standard error is below 0.006 here, and a recall's step is 1/80."""
    reference = scipy_bootstrap(
        scores,
        lambda positives, negatives: auc_and_recalls(positives, negatives)[RANKED.index(name)],
        vectorized=False, method="percentile", n_resamples=2000, rng=np.random.default_rng(8),
    ).confidence_interval  # fmt: skip
    statistic = partial(auc_and_recalls, *(group.repeat(images) for group in scores))
    objects = [np.arange(len(group)).repeat(images) for group in scores]
    first, again = (bootstrap(statistic, *objects)[RANKED.index(name)] for _ in range(2))
    ends = estimate(0.5, first)
    assert (ends.low, ends.high) == pytest.approx(tuple(reference), rel=0, abs=0.02)
    np.testing.assert_array_equal(first, again)


def test_the_spread_over_objects_and_their_images_is_that_of_a_two_level_bootstrap_in_closed_form():
    """For the mean of k objects of m images: (variance of objects' means + mean variance of an object / m) / k."""
    generator = np.random.default_rng(2)
    values = generator.normal(0, 1, (8, 5)) + generator.normal(0, 0.5, 5)  # a column per object; both parts matter
    means = bootstrap(lambda counts: counts @ values.ravel() / 40, np.arange(40) % 5)
    variance = (values.mean(axis=0).var() + values.var(axis=0).mean() / 8) / 5
    assert means.mean() == pytest.approx(values.mean(), abs=4 * (variance / REPLICATES) ** 0.5)
    assert means.var() == pytest.approx(variance, rel=0.13)  # four standard errors of 2,000 replicates


def test_pairing_cancels_what_both_runs_share():
    """The luck of four seeds, 0 to 3: unpaired, the difference of two means of four has the variance 2 · 1.25 / 4."""
    luck = np.arange(4.0)[:, None] + np.zeros(REPLICATES)
    paired, unpaired = (replicate_difference(luck + 0.5, luck, paired) for paired in (True, False))
    np.testing.assert_array_equal(paired, 0.5)
    assert unpaired.mean() == pytest.approx(0.5, abs=0.1) and unpaired.std() == pytest.approx(np.sqrt(0.625), rel=0.1)
    for paired in (True, False):  # a single run adds no spread of its own
        np.testing.assert_array_equal(replicate_difference(luck[:1] + 0.5, luck[:1], paired), 0.5)
