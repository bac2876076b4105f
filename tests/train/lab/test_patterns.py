import math

import numpy as np
import pytest

from train.lab.patterns import FAMILIES, TWO_COLORED, checkers, draw_pattern, stripes

SEEDS = range(8)
each_seed = pytest.mark.parametrize("seed", SEEDS)


def lattice(width: float, count: int) -> np.ndarray:
    """Points (count, count, 2) at the middles of the cells of a square of that width."""
    middles = (np.arange(count) + 0.5) / count * width
    return np.stack(np.meshgrid(middles, middles), axis=-1)


@pytest.mark.parametrize("family", FAMILIES)
@each_seed
def test_an_image_is_linear_light_in_the_unit_range_and_follows_from_its_seed(family, seed):
    image, again = (draw_pattern(family, np.random.default_rng(seed), 64) for _ in range(2))
    assert image.shape == (64, 64, 3) and image.dtype == np.float32
    assert image.min() >= 0 and image.max() <= 1
    np.testing.assert_array_equal(image, again)
    assert not np.array_equal(image, draw_pattern(family, np.random.default_rng(seed + 100), 64))


@pytest.mark.parametrize("family", FAMILIES)
@each_seed
def test_a_family_mixes_two_colors_one_of_which_is_darkness_in_some(family, seed):
    image = draw_pattern(family, np.random.default_rng(seed), 64).reshape(-1, 3)
    if family == "gradient":
        assert np.linalg.matrix_rank(image - image[0], tol=1e-3) == 1
    else:
        colors = np.unique(image, axis=0)
        assert len(colors) == (1 if family == "solid" else 2)
        assert (colors.min(axis=0).max() == 0) == (family not in (*TWO_COLORED, "solid"))


@each_seed
def test_stripes_light_their_duty_cycle(seed):
    twin = np.random.default_rng(seed)
    period, _, duty = twin.uniform(0.12, 0.5), twin.uniform(), twin.uniform(0.3, 0.7)
    lit = stripes(lattice(7 * period, 700), np.random.default_rng(seed))
    assert lit.mean() == pytest.approx(duty, abs=1 / 100)  # an edge falls into one of a period's hundred cells
    np.testing.assert_array_equal(lit, lit[:1].repeat(700, axis=0))


@each_seed
def test_checkers_light_one_half_and_change_at_every_edge_in_either_direction(seed):
    cell = np.random.default_rng(seed).uniform(0.12, 0.5) / 2
    points = lattice(8 * cell, 400)
    lit, beside, above = (checkers(points + shift, np.random.default_rng(seed)) for shift in (0, [cell, 0], [0, cell]))
    assert lit.mean() == pytest.approx(0.5, abs=0.01)
    for moved in (beside, above):
        assert (lit + moved == 1).mean() > 0.99  # but for rounding at the edges


def test_half_divides_the_image_by_a_straight_line_through_the_object():
    fractions = [draw_pattern("half", np.random.default_rng(seed), 64).any(axis=-1).mean() for seed in range(50)]
    # A line at a distance of 0.12 from the middle of the square cuts off 0.5 - 0.06 √2 of it at least.
    assert 0.5 - 0.06 * math.sqrt(2) - 0.02 < min(fractions) < 0.5 < max(fractions) < 0.5 + 0.06 * math.sqrt(2) + 0.02
