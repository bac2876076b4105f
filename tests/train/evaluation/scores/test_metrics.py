from fractions import Fraction
from functools import partial
from pathlib import PurePosixPath

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, mannwhitneyu
from scipy.stats import bootstrap as scipy_bootstrap

from train.data.photographs import Photograph
from train.evaluation.scores.metrics import (
    RATES,
    REPLICATES,
    ROC_METRICS,
    auc_and_recalls,
    bootstrap,
    class_means,
    estimate,
    pool,
    replicate_difference,
    thresholds,
)
from train.evaluation.scores.predictions import rank_classes

# The scores have few values, so that ties are common.
SCORES = st.lists(st.integers(-4, 4).map(float), min_size=1, max_size=30)


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
    column = ROC_METRICS.index(name)
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


def draw_ranks(seed: int) -> tuple[list[str], np.ndarray]:
    """Draw the class and the rank of the true class of 60 images of 5 classes of all sizes."""
    generator = np.random.default_rng(seed)
    names = generator.choice(["a", "b", "c", "d", "e"], 60, p=[0.5, 0.2, 0.15, 0.1, 0.05])
    return names.tolist(), generator.integers(1, 9, 60)


def test_means_over_classes_are_the_mean_of_the_means():
    names, ranks = draw_ranks(0)
    means = []
    for name in sorted({*names}):
        own_ranks = [rank for other, rank in zip(names, ranks, strict=True) if other == name]
        means.append(sum(rank == 1 for rank in own_ranks) / len(own_ranks))
    (value,) = class_means(ranks[None] == 1, names, np.ones(60))
    assert value == pytest.approx(np.mean(means))


def test_means_over_drawn_classes_count_repeated_images():
    names, ranks = draw_ranks(1)
    hits = np.stack([ranks <= 1, ranks <= 5])
    counts = np.random.default_rng(2).integers(0, 3, (4, 60))
    sizes = [names.count(name) for name in names]
    for replicate, row in enumerate(counts):
        drawn = np.arange(60).repeat(row)
        weights = np.array([1 / sizes[image] for image in drawn])
        for way in range(2):
            expected = np.average(hits[way, drawn], weights=weights)
            assert class_means(hits, names, counts)[way, replicate] == pytest.approx(expected)


def photograph(name: str, number: int) -> Photograph:
    """Return the photograph of a class. Each object has two photographs."""
    mesh = f"{name}_{number // 2}.glb"
    return Photograph(PurePosixPath(f"{name}/{number}.png"), name, None, (), mesh)


@pytest.mark.parametrize("labels", [["orange"], ["orange", "lemon"]])
def test_top_k_is_that_of_torch_for_images_of_known_classes(labels):
    classes = ["orange", "lemon", "pear", *map(str, range(9))]
    generator = torch.Generator().manual_seed(0)
    photographs = [
        photograph(name, number)
        for name, count in {"orange": 8, "lemon": 4, "pear": 2, "other_ball": 6}.items()
        for number in range(count)
    ]
    logits = torch.randn(len(photographs), len(classes), generator=generator)
    logits[:, :3] += 1.5
    metrics = pool(rank_classes(photographs, logits, classes, labels)).metrics

    for rank, metric in ((1, metrics.class_top1), (5, metrics.class_top5)):
        best = logits.topk(rank).indices
        by_class = []
        for name in ("orange", "lemon", "pear"):
            rows = [row for row, item in enumerate(photographs) if item.label == name]
            hits = (best[rows] == classes.index(name)).any(1)
            by_class.append(hits.float().mean().item())
        assert metric.value == pytest.approx(np.mean(by_class))
        assert metric.low < metric.value < metric.high


def test_the_interval_of_one_image_per_class_is_that_of_scipys_bootstrap_over_images():
    """Compare up to chance: a step is 1/40, and the standard error of an end is below 0.01."""
    names = [f"class {number}" for number in range(40)]
    ranks = np.random.default_rng(4).integers(1, 4, 40)
    hits = ranks == 1
    reference = scipy_bootstrap(
        (hits.astype(float),), np.mean, method="percentile", n_resamples=5000, rng=5
    ).confidence_interval
    replicates = bootstrap(partial(class_means, hits[None], names), np.arange(40))
    metric = estimate(hits.mean(), replicates[0])
    assert metric.low == pytest.approx(reference.low, abs=0.03)
    assert metric.high == pytest.approx(reference.high, abs=0.03)


@pytest.mark.parametrize(("second_is_found", "low"), [(False, 0.0), (True, 0.342380)])
def test_the_interval_of_a_recall_is_over_objects(second_is_found, low):
    """Compare with closed forms for two objects of 20 images.

    If one object is found, a replicate shows the same object twice with the probability 1/2. If
    both are found, the low end is 2 / (2 + z²), Wilson's for 2 of 2, with z = 1.959964.
    """
    classes = ["orange", "pear"]
    photographs = [
        Photograph(PurePosixPath(f"{number}.png"), "orange", None, (), f"{number // 20}.glb")
        for number in range(40)
    ]
    logits = torch.tensor([[1.0, 0.0]] * 20 + [[float(second_is_found), 0.5]] * 20)
    scored = pool(rank_classes(photographs, logits, classes, ["orange"]))
    metric = scored.metrics.recall
    assert metric.value == (1.0 if second_is_found else 0.5)
    assert (metric.low, metric.high) == pytest.approx((low, 1.0), abs=1e-5)


def test_the_interval_of_a_recall_is_wilsons_if_each_image_shows_another_object():
    photographs = [
        Photograph(PurePosixPath(f"{number}.png"), "orange", None, (), f"{number}.glb")
        for number in range(8)
    ]
    logits = torch.tensor([[1.0, 0.0]] * 3 + [[0.0, 1.0]] * 5)
    scored = pool(rank_classes(photographs, logits, ["orange", "pear"], ["orange"]))
    metric = scored.metrics.recall
    wilson = binomtest(3, 8).proportion_ci(method="wilson")
    assert (metric.low, metric.high) == pytest.approx((wilson.low, wilson.high))
