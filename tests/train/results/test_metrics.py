from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, mannwhitneyu, sem, ttest_1samp
from scipy.stats import t as student_t

from benchmarks.coverage import Setup, heavy_tails, measure
from tests.train.helpers import ranked
from train.results import intervals
from train.results.metrics import AT_THRESHOLD, Pool
from train.results.tables import OBJECTS, THESE_OBJECTS

# The scores have few values, so that ties are common.
SCORES = st.lists(st.integers(-4, 4).map(float), min_size=1, max_size=30)


@given(positives=SCORES, negatives=SCORES)
def test_auc_is_the_mann_whitney_statistic_in_which_ties_count_half(positives, negatives):
    statistic = mannwhitneyu(positives, negatives, method="asymptotic").statistic
    expected = statistic / (len(positives) * len(negatives))
    auc, *_ = intervals.auc_and_recalls(np.array(positives), np.array(negatives))
    assert auc == pytest.approx(expected, rel=0, abs=1e-12)


def lowest_threshold(positives: list[float], negatives: list[float], rate: str) -> float:
    """Try every score, and return the lowest that at most `rate` of the negatives exceed."""
    allowed = Fraction(rate) * len(negatives)
    for score in sorted(positives + negatives):
        exceeding = sum(negative > score for negative in negatives)
        if exceeding <= allowed:
            return score
    raise AssertionError("no score exceeds the highest one")


@given(positives=SCORES, negatives=SCORES)
def test_recall_at_a_rate_is_that_at_the_lowest_threshold_within_the_rate(positives, negatives):
    _, *recalls = intervals.auc_and_recalls(np.array(positives), np.array(negatives))
    found = intervals.thresholds(np.array(negatives), np.ones(len(negatives), int))
    for rate, recall, threshold in zip(intervals.RATES, recalls, found, strict=True):
        expected = lowest_threshold(positives, negatives, rate)
        assert threshold == expected
        assert recall == sum(score > expected for score in positives) / len(positives)


def mean_of(values: np.ndarray, units: np.ndarray) -> intervals.Jackknife:
    means = partial(intervals.weighted_means, values[None])
    (mean,) = intervals.leave_out(means, intervals.Units([units], "units"))
    return mean


@pytest.mark.parametrize("image_count", [1, 7])
def test_the_interval_of_a_mean_is_students_over_objects(image_count):
    """Compare with scipy's t interval. Near 1/2, the logit is linear up to the third order."""
    values = 0.5 + np.random.default_rng(3).normal(0, 0.004, 12)
    images = np.random.default_rng(4).permutation(12 * image_count)
    objects = np.arange(12).repeat(image_count)[images]
    found = mean_of(values[objects], objects).estimate
    student = ttest_1samp(values, 0).confidence_interval()
    assert (found.low, found.high) == pytest.approx((student.low, student.high), abs=1e-4)


@pytest.mark.parametrize(("spread", "degrees"), [(0.0, 5), (0.004, 5), (0.004 * np.sqrt(2), 5)])
def test_the_degrees_of_freedom_do_not_exceed_those_of_a_group_of_units(spread, degrees):
    """Compare with scipy. A linear statistic, the difference of two means, stands for the AUC."""
    generator = np.random.default_rng(5)
    positives = generator.normal(0.25, 0.004, 6)
    negatives = generator.normal(-0.25, spread, 6)

    def difference(positive_counts, negative_counts):
        first = intervals.weighted_means(positives[None], positive_counts)
        return first - intervals.weighted_means(negatives[None], negative_counts)

    units = intervals.Units([np.arange(6), np.arange(6, 12)], "objects")
    (found,) = intervals.leave_out(difference, units)
    error = np.hypot(sem(positives), sem(negatives))
    ends = found.value + student_t(degrees).ppf(0.975) * error * np.array([-1, 1])
    assert (found.estimate.low, found.estimate.high) == pytest.approx(ends, abs=1e-4)


def runs_of(values: np.ndarray) -> list[intervals.Jackknife]:
    return [intervals.Jackknife(value, [np.full(9, value)], 9, "objects") for value in values]


SCORE_OF_SEED = np.array([0.48, 0.49, 0.51, 0.52])


def test_pairing_cancels_what_both_groups_of_runs_share():
    gain = intervals.change(runs_of(SCORE_OF_SEED + 0.02), runs_of(SCORE_OF_SEED), is_paired=True)
    assert gain.value == pytest.approx(0.02)
    assert gain.high - gain.low < 0.002


def test_without_pairs_the_interval_over_seeds_adds_the_variances_of_both_means():
    """Compare with t(3 degrees of freedom) · √(2 · variance / 4)."""
    gain = intervals.change(runs_of(SCORE_OF_SEED + 0.02), runs_of(SCORE_OF_SEED), is_paired=False)
    half_width = student_t(3).ppf(0.975) * np.sqrt(2 * SCORE_OF_SEED.var(ddof=1) / 4)
    assert gain.high - gain.low == pytest.approx(2 * half_width, rel=0.01)
    assert gain.over == "seeds and objects"


def test_two_runs_of_other_seeds_are_still_paired_by_their_images():
    draws = np.random.default_rng(0)
    positives, negatives = draws.normal(1, 1, 40), draws.normal(0, 1, 40)
    units = intervals.Units([np.arange(40), np.arange(40, 80)], "images")
    after = intervals.leave_out_of_roc(positives + 0.1 * draws.normal(size=40), negatives, units)
    before = intervals.leave_out_of_roc(positives, negatives, units)
    for one, other in zip(after, before, strict=True):
        gains = [intervals.change([one], [other], is_paired) for is_paired in (False, True)]
        assert gains[0] == gains[1]


def test_intervals_of_few_objects_cover_the_truth():
    """0.9 is 2.5 standard errors of 120 draws below 0.95."""
    for coverage, _ in measure(Setup("typical", (5, 5)), 120).values():
        assert coverage.min() >= 0.9
        assert coverage.mean() >= 0.94


def test_intervals_of_few_photographs_cover_the_recall_at_a_false_positive_rate():
    """0.92 is 3 standard errors of 500 draws below 0.95. The jackknife alone covers 0.85."""
    setup = Setup("photographs", (55, 55), images=1, shape=heavy_tails)
    coverage, _ = measure(setup, 500)["objects"]
    values, gains = coverage.reshape(2, -1)[:, 1:4]
    assert min(*values, *gains) >= 0.92


def roc_of(positives: np.ndarray, negatives: np.ndarray) -> list[intervals.Jackknife]:
    numbers = np.arange(len(positives) + len(negatives))
    units = intervals.Units(np.split(numbers, [len(positives)]), "images")
    return intervals.leave_out_of_roc(positives, negatives, units)


def test_the_threshold_of_a_recall_has_woodruffs_interval():
    """The ends of the threshold have the interval of its rate: 6 of 30 negatives are above it."""
    negatives = np.arange(30.0)
    positives = np.arange(0.5, 30, 0.5)
    recall = roc_of(positives, negatives)[-1]
    is_above = negatives >= 24
    logits = np.array([(is_above.sum() - item) / 29 for item in is_above])
    logits = np.log(logits / (1 - logits))
    error = np.sqrt(29 * logits.var())
    half_width = student_t(29).ppf(0.975) * error
    rates = 1 / (1 + np.exp(np.array([half_width, -half_width]) + np.log(4)))
    thresholds_of_ends = [sorted(negatives, reverse=True)[int(30 * rate)] for rate in rates]
    expected = [(positives > threshold).mean() for threshold in thresholds_of_ends]
    assert recall.value == (positives > 23).mean()
    assert recall.at_ends == pytest.approx(expected)


def test_a_recall_has_no_lower_limit_if_too_few_negatives_set_the_threshold():
    """1 of 20 future negatives may be above all of 20 negatives, with a probability of 0.36."""
    _, at_5, _, at_20 = roc_of(np.arange(10, 40), np.arange(20))
    assert at_5.value == 21 / 30
    assert at_5.interval[0] == 0
    assert at_20.interval[0] > 0.3


def test_equal_networks_have_equal_recalls():
    recall = roc_of(*np.random.default_rng(0).normal(size=(2, 40)))[1]
    gain = intervals.change([recall], [recall], is_paired=True)
    wilson = binomtest(0, 40).proportion_ci(method="wilson")
    assert (gain.low, gain.high) == pytest.approx((-wilson.high, wilson.high))


@pytest.mark.parametrize(
    ("object_count", "unnamed", "over"),
    [(4, 0, THESE_OBJECTS), (5, 0, OBJECTS), (5, 1, THESE_OBJECTS), (1, 39, THESE_OBJECTS)],
)
def test_few_or_unknown_objects_have_an_interval_over_images(object_count, unnamed, over):
    labels = ["orange"] * 40 + ["pear"] * 50
    meshes = [f"{number % object_count}.glb" for number in range(40)]
    meshes += [f"{number % 9}.glb" for number in range(50)]
    meshes[:unnamed] = [None] * unnamed
    logits = torch.randn(90, 2, generator=torch.Generator().manual_seed(1))
    metrics = Pool(ranked(labels, logits, ["orange", "pear"], meshes=meshes)).metrics
    assert (metrics.auc.over, metrics.recall.over) == (over, over)
    assert metrics.false_positive_rate.over == OBJECTS
    assert metrics.auc.positive_objects == object_count
    if over == THESE_OBJECTS:
        recall = metrics.recall
        wilson = binomtest(recall.hits, 40).proportion_ci(method="wilson")
        assert (recall.low, recall.high) == pytest.approx((wilson.low, wilson.high))


def test_means_over_drawn_classes_count_repeated_images():
    generator = np.random.default_rng(1)
    names = generator.choice(["a", "b", "c", "d", "e"], 60, p=[0.5, 0.2, 0.15, 0.1, 0.05]).tolist()
    ranks = generator.integers(1, 9, 60)
    hits = np.stack([ranks <= 1, ranks <= 5])
    counts = np.random.default_rng(2).integers(0, 3, (4, 60))
    sizes = [names.count(name) for name in names]
    for draw, row in enumerate(counts):
        drawn = np.arange(60).repeat(row)
        weights = np.array([1 / sizes[image] for image in drawn])
        for way in range(2):
            expected = np.average(hits[way, drawn], weights=weights)
            assert intervals.class_means(hits, names, counts)[way, draw] == pytest.approx(expected)


@pytest.mark.parametrize("labels", [["orange", "lemon"], ["orange", "lemon", "pear"]])
def test_an_image_that_is_a_positive_and_a_negative_is_left_out_of_both(labels):
    """Compare with the AUC of the other images. Their variance is that of the jackknife."""
    shown = np.repeat(["orange", "lemon", "pear"], [6, 5, 4])
    logits = torch.randn(15, 3, generator=torch.Generator().manual_seed(3))
    logits += 2.0 * torch.eye(3)[np.arange(3).repeat([6, 5, 4])]

    def auc_of(rows: np.ndarray) -> intervals.Jackknife:
        return Pool(
            ranked(shown[rows], logits[rows], ["orange", "lemon", "pear"], labels)
        ).jackknives["auc"]

    found = auc_of(np.arange(15))
    others = [float(auc_of(np.delete(np.arange(15), row)).value) for row in range(15)]
    is_positive = np.isin(shown, labels)
    sides = [side for side in (is_positive, ~is_positive) if side.any()]
    for side, without in zip(sides, found.without, strict=False):
        assert sorted(without) == pytest.approx(sorted(np.array(others)[side]))


@pytest.mark.parametrize("labels", [["orange"], ["orange", "lemon"]])
def test_top_k_is_that_of_torch_for_images_of_known_classes(labels):
    classes = ["orange", "lemon", "pear", *map(str, range(9))]
    generator = torch.Generator().manual_seed(0)
    shown = np.repeat(["orange", "lemon", "pear", "other_ball"], [8, 4, 2, 6])
    meshes = [f"{number // 2}.glb" for number in range(len(shown))]
    logits = torch.randn(len(shown), len(classes), generator=generator)
    logits[:, :3] += 1.5
    metrics = Pool(ranked(shown, logits, classes, labels, meshes=meshes)).metrics

    for rank, metric in ((1, metrics.class_top1), (5, metrics.class_top5)):
        best = logits.topk(rank).indices
        by_class = []
        for name in ("orange", "lemon", "pear"):
            hits = (best[torch.from_numpy(shown == name)] == classes.index(name)).any(1)
            by_class.append(hits.float().mean().item())
        assert metric.value == pytest.approx(np.mean(by_class))
        assert metric.low < metric.value < metric.high


def test_a_prediction_is_held_against_the_threshold_of_its_own_label():
    # The log-odds of pear are those of orange with the opposite sign.
    labels, scores = ["orange", "orange", "pear", "pear"], [1.0, -2.0, -3.0, -6.0]
    fruit = ["orange", "pear"]
    predictions = ranked(labels, [[score, 0.0] for score in scores], fruit, fruit)
    outcomes = Pool(predictions, {"orange": 0.0, "pear": 5.0}).outcomes
    # The first orange exceeds 0, and the last pear 5. No other object exceeds either.
    assert [outcomes[name].hits.sum() for name in AT_THRESHOLD] == [2, 0]


@pytest.mark.parametrize("hits", [[1, 1, 1], [1, 1, 0], [1, 0, 0, 0, 0]])
@pytest.mark.parametrize("count", [7, 30])
def test_equal_objects_have_wilsons_interval_for_their_number_with_students_quantile(hits, count):
    """The ends p of Wilson's interval of a fraction f solve (f - p)² = t² p (1 - p) / n."""
    found = mean_of(np.tile(hits, count), np.arange(count).repeat(len(hits))).estimate
    fraction, square = np.mean(hits), student_t(count - 1).ppf(0.975) ** 2 / count
    ends = sorted(np.roots([1 + square, -2 * fraction - square, fraction**2]))
    assert (found.low, found.high) == pytest.approx(ends)
