import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import nn

from augment.classifier import Classifier
from benchmarks import many_objects
from train.results.tables import Estimate, fraction

CLASSES = ["orange", "lemon", "packet"]


def test_the_splits_share_only_the_objects_of_the_training():
    validation, test = many_objects.OBJECTS.values()
    for group in validation:
        meshes = [{item["mesh"] for item in split[group]} for split in (validation, test)]
        assert meshes[0].isdisjoint(meshes[1]) == (group != many_objects.SAME)
    trained = {item["label"] for item in many_objects.TRAINED}
    for split in (validation, test):
        assert {item["label"] for item in split[many_objects.OTHERS]} <= trained
        assert trained.isdisjoint(item["label"] for item in split[many_objects.UNTRAINED])
    patterns = many_objects.PATTERNS
    assert set(patterns["validation"]).isdisjoint(patterns[many_objects.TEST])


def one_group(values, setups=None, objects=None) -> many_objects.ScoredGroup:
    """Make a group of N images with the hits (S, N), by default of one object in N setups."""
    hits = np.atleast_2d(values)
    count = hits.shape[1]
    setups = np.arange(count) if setups is None else setups
    objects = np.zeros(count) if objects is None else objects
    return many_objects.ScoredGroup({"network": hits}, setups, objects)


def mean_of(*groups) -> Estimate:
    return many_objects.mean_with_interval(groups, "network", None)


def test_the_interval_of_equal_images_is_that_over_seeds():
    # With one degree of freedom, t is 12.7, so nothing is known.
    values = np.array([[0.0] * 9, [1.0] * 9])
    found = mean_of(one_group(values), one_group(values))
    assert (found.low, found.value, found.high) == pytest.approx((0.0, 0.5, 1.0))


def test_the_interval_has_the_variance_of_objects_and_of_setups():
    rng = np.random.default_rng(0)
    of_objects = 0.002 * rng.normal(size=30)
    of_setups = 0.5 + 0.004 * rng.normal(size=40)
    objects, setups = np.divmod(np.arange(30 * 40), 40)
    values = of_objects[objects] + of_setups[setups]
    found = mean_of(one_group(values, setups, objects))
    # The variance of a mean over two crossed random effects.
    error = 1.96 * np.sqrt(of_objects.var() / 30 + of_setups.var() / 40)
    assert found.high - found.low == pytest.approx(2 * error, rel=0.1)


def test_intervals_contain_the_mean_over_all_objects_if_most_are_never_or_always_recognized():
    # In a probit model with normal effects of objects and setups, the mean is known.
    rng = np.random.default_rng(0)
    objects, setups = np.divmod(np.arange(16 * 12), 12)
    mean = norm.cdf(-1.5 / np.sqrt(1 + 3**2 + 0.5**2))
    contained = []
    for _ in range(100):
        of_objects, of_setups = 3 * rng.normal(size=16), 0.5 * rng.normal(size=12)
        effects = of_objects[objects] + of_setups[setups] - 1.5
        hits = (effects > rng.normal(size=16 * 12)).astype(float)
        found = mean_of(one_group(hits, setups, objects))
        contained.append(found.low <= mean <= found.high)
    assert np.mean(contained) >= 0.93


def test_groups_have_the_same_weight_and_draws_of_their_own():
    many = np.random.default_rng(0).integers(0, 2, 400).astype(float)
    few = np.random.default_rng(1).integers(0, 2, 100).astype(float)
    found = mean_of(one_group(many), one_group(few))
    assert found.value == pytest.approx((many.mean() + few.mean()) / 2)
    width = 1.96 * np.sqrt(many.var() / 400 + few.var() / 100)
    assert found.high - found.low == pytest.approx(width, rel=0.15)


def test_a_gain_is_between_the_same_images():
    hits = {"first": np.array([[0.0, 1.0] * 50]), "second": np.array([[0.0, 1.0] * 50] * 2)}
    group = many_objects.ScoredGroup(hits, np.arange(100), np.arange(100) % 5)
    high = fraction(0, 5).high  # Wilson's interval of 0 changes among 5 objects.
    for names in (("second", "first"), ("first", "second")):  # One of them has two seeds.
        gain = many_objects.mean_with_interval([group], *names)
        assert (gain.low, gain.value, gain.high) == (-high, 0.0, high)


def test_weights_between_two_networks_of_one_layer_give_logits_between():
    networks = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        layers = nn.Sequential(nn.Flatten(), nn.Linear(12, 3)).eval()
        networks.append(Classifier(layers, 2, CLASSES))
    images = torch.rand(4, 3, 2, 2)
    between = many_objects.interpolate(*networks, 0.25)
    expected = 0.75 * networks[0](images) + 0.25 * networks[1](images)
    torch.testing.assert_close(between(images), expected)
