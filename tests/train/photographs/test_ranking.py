from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import bootstrap, mannwhitneyu

from train.photographs.ranking import RATES, Ranking, rank

# Of few kinds, so that ties are common.
SCORES = st.lists(st.integers(-4, 4).map(float), min_size=1, max_size=30)


def brute_force_recall(label: list[float], others: list[float], rate: str) -> tuple[float, float]:
    """Recall and threshold by trying every score: the lowest that at most the share `rate` of the others exceeds."""
    allowed = Fraction(rate) * len(others)
    threshold = min(score for score in label + others if sum(other > score for other in others) <= allowed)
    return sum(score > threshold for score in label) / len(label), threshold


@settings(deadline=None)
@given(label=SCORES, others=SCORES)
def test_auc_is_the_mann_whitney_statistic_with_ties_counted_half(label, others):
    expected = mannwhitneyu(label, others, method="asymptotic").statistic / (len(label) * len(others))
    assert Ranking(label, others).values()["auc"] == pytest.approx(expected, rel=0, abs=1e-12)


@settings(deadline=None)
@given(label=SCORES, others=SCORES)
def test_recall_at_a_rate_is_that_of_the_lowest_threshold_that_keeps_the_rate(label, others):
    ranking = Ranking(label, others)
    values, thresholds = ranking.values(), ranking.thresholds()
    assert tuple(thresholds) == RATES == ("0.05", "0.10", "0.20")
    for rate in RATES:
        assert (values[rate], thresholds[rate]) == brute_force_recall(label, others, rate)


@pytest.mark.parametrize(("m", "allowed"), [(19, 0), (20, 1), (39, 1), (40, 2), (100, 5), (60, 3), (2000, 100)])
def test_a_rate_allows_as_many_false_alarms_as_it_says_and_no_more(m, allowed):
    others = np.arange(m, dtype=float)
    threshold = rank([0.0], others)["recall_at"]["0.05"]["threshold"]
    assert (others > threshold).sum() == allowed


def test_an_image_tied_with_the_threshold_is_not_recalled():
    """Of 10 others one may be called the class at 10 %: all that score more than the second-best of them."""
    others = [3.0, 2.0, *[0.0] * 8]
    assert rank([2.0, 2.0, 2.5, 3.0], others)["recall_at"]["0.10"]["value"] == 0.5
    assert rank([2.0], [2.0] * 10)["recall_at"]["0.20"]["value"] == 0


@settings(deadline=None)
@given(label=SCORES, others=SCORES)
def test_only_the_order_of_the_scores_counts(label, others):
    assert Ranking(label, others).values() == Ranking(np.exp(label) - 7, np.exp(others) - 7).values()


@settings(deadline=None)
@given(label=SCORES, others=SCORES)
def test_with_the_roles_exchanged_auc_is_what_lacks_from_1(label, others):
    total = Ranking(label, others).values()["auc"] + Ranking(others, label).values()["auc"]
    assert total == pytest.approx(1, rel=0, abs=1e-12)


def test_a_perfect_ranking_is_1_and_a_reversed_one_0_without_doubt():
    sure = {"value": 1, "low": 1, "high": 1}
    perfect, reversed_ = rank([2, 3], [0, 1]), rank([0, 1], [2, 3])
    assert perfect["auc"] == {**sure, "label": 2, "others": 2}
    assert perfect["recall_at"] == {rate: {**sure, "threshold": 1} for rate in RATES}
    assert reversed_["auc"]["value"] == reversed_["auc"]["high"] == 0
    assert all(figure["value"] == 0 for figure in reversed_["recall_at"].values())


@pytest.mark.parametrize(("label", "others"), [([], [1.0]), ([1.0, 2.0], []), ([], [])])
def test_without_both_kinds_nothing_is_known(label, others):
    nothing = {"value": None, "low": None, "high": None}
    told = rank(label, others)
    assert told["auc"] == {**nothing, "label": len(label), "others": len(others)}
    assert told["recall_at"] == {rate: {**nothing, "threshold": None} for rate in RATES}


@pytest.fixture(scope="module")
def spread() -> tuple[np.ndarray, np.ndarray]:
    """Scores of a network of middling quality, with ties."""
    generator = np.random.default_rng(3)
    return generator.normal(1, 1, 80).round(1), generator.normal(0, 1.5, 120).round(1)


def statistic_of(name: str, label: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Of samples along the last axis; AUC by comparing all pairs, recall by sorting the others."""
    if name == "auc":
        pairs = label[..., :, None] - others[..., None, :]
        return ((pairs > 0) + (pairs == 0) / 2).mean(axis=(-2, -1))
    threshold = np.sort(others)[..., -1 - int(Fraction(name) * others.shape[-1])]
    return (label > threshold[..., None]).mean(axis=-1)


@pytest.mark.parametrize("name", ["auc", "0.10"])
def test_intervals_are_those_of_scipys_stratified_percentile_bootstrap(spread, name):
    """Up to the replicates' chance: an end's own standard error is below 0.006 here, and a recall's step is 1/80."""
    reference = bootstrap(
        spread,
        lambda label, others, axis: statistic_of(name, label, others),
        vectorized=True, method="percentile", n_resamples=2000, batch=50, rng=np.random.default_rng(8),
    ).confidence_interval  # fmt: skip
    told = rank(*spread)
    told = told["auc"] if name == "auc" else told["recall_at"][name]
    assert (told["low"], told["high"]) == pytest.approx(tuple(reference), rel=0, abs=0.02)


def test_each_replicate_has_the_figures_of_its_sample(spread):
    """Counts are samples: images that are drawn twice or not at all, against scores that are written out so."""
    generator = np.random.default_rng(4)
    counts = [generator.multinomial(len(scores), [1 / len(scores)] * len(scores), size=5) for scores in spread]
    figures = Ranking(*spread).figures(*counts)
    for row in range(5):
        sample = [np.repeat(scores, drawn[row]) for scores, drawn in zip(spread, counts, strict=True)]
        for name, values in figures.items():
            assert values[row] == pytest.approx(statistic_of(name, *sample), rel=0, abs=1e-12)


def test_a_second_call_gives_the_same_intervals(spread):
    assert rank(*spread) == rank(*spread)


@pytest.mark.slow
def test_nineteen_in_twenty_intervals_cover_the_truth():
    """Normal scores one standard deviation apart have an AUC of Φ(1/√2) = 0.760; 3 % is two standard errors of 200."""
    generator = np.random.default_rng(5)
    told = [rank(generator.normal(1, 1, 150), generator.normal(0, 1, 150))["auc"] for _ in range(200)]
    covered = np.mean([figure["low"] <= 0.7602 <= figure["high"] for figure in told])
    assert 0.92 <= covered <= 0.98


def test_the_curve_has_a_point_per_threshold_and_agrees_with_brute_force(spread):
    label, others = spread
    alarms, recall, thresholds = Ranking(label, others).curve()
    assert (alarms[0], recall[0], alarms[-1], recall[-1], thresholds[-1]) == (0, 0, 1, 1, -np.inf)
    assert len(set(zip(alarms, recall, strict=True))) == len(alarms) == len(np.unique([*label, *others])) + 1
    for point, threshold in enumerate(thresholds):
        assert (alarms[point], recall[point]) == ((others > threshold).mean(), (label > threshold).mean())
    # The trapezoids below the curve are the AUC, ties included.
    area = np.trapezoid(recall, alarms)
    assert area == pytest.approx(rank(label, others)["auc"]["value"], rel=0, abs=1e-12)
