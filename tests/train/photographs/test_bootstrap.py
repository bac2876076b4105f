import numpy as np
import pytest

from train.photographs.bootstrap import REPLICATES, draw_samples, replicate_difference, replicate_share


def test_samples_are_as_large_as_what_they_are_drawn_from_and_draw_all_alike():
    """A multinomial count has the variance 1 - 1/n."""
    counts = [np.concatenate(blocks) for blocks in zip(*draw_samples(7, 30), strict=True)]
    for drawn, size in zip(counts, (7, 30), strict=True):
        assert drawn.shape == (REPLICATES, size) and (drawn.sum(axis=1) == size).all()
        np.testing.assert_allclose(drawn.mean(axis=0), 1, atol=5 / np.sqrt(REPLICATES))
        np.testing.assert_allclose(drawn.var(), 1 - 1 / size, atol=0.05)
    assert abs(np.corrcoef(counts[0][:, 0], counts[1][:, 0])[0, 1]) < 5 / np.sqrt(REPLICATES)


def test_a_share_spreads_as_the_binomial():
    outcomes = np.arange(50) < 20
    replicates = replicate_share(outcomes)
    assert replicates.mean() == pytest.approx(0.4, abs=0.01)
    assert replicates.std() == pytest.approx(np.sqrt(0.4 * 0.6 / 50), rel=0.1)


def test_what_pairs_share_cancels_and_what_strangers_share_does_not():
    """The luck of four seeds, 0 to 3: apart, the difference of two means of four has the variance 2 · 1.25 / 4."""
    luck = np.arange(4.0)[:, None] + np.zeros(REPLICATES)
    paired, apart = (replicate_difference(luck + 0.5, luck, paired) for paired in (True, False))
    np.testing.assert_array_equal(paired, 0.5)
    assert apart.mean() == pytest.approx(0.5, abs=0.1) and apart.std() == pytest.approx(np.sqrt(0.625), rel=0.1)


def test_a_single_run_adds_no_spread_of_its_own():
    one, other = np.random.default_rng(0).normal(size=(2, 1, REPLICATES))
    for paired in (True, False):
        np.testing.assert_array_equal(replicate_difference(one, other, paired), (one - other)[0])


def test_seeds_are_drawn_independently_of_images():
    """Were both drawn from the same numbers, a seed's count would follow that of the images of the same place."""
    (images,), (runs,) = (next(draw_samples(4, seed=seed)) for seed in (0, 1))
    assert abs(np.corrcoef(images.ravel(), runs.ravel())[0, 1]) < 0.2
