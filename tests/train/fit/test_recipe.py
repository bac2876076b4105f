import math

import numpy as np
import pytest

from train.fit.recipe import SCHEDULES, cosine, one_cycle, step


@pytest.mark.parametrize("epochs", [10, 50, 150, 200])
def test_the_step_schedule_falls_to_a_fifth_at_30_60_and_80_percent_of_the_epochs(epochs):
    rates = [step(epoch / epochs) for epoch in range(epochs)]
    parts = [3, 3, 2, 2]
    expected = [0.2**fall for fall, part in enumerate(parts) for _ in range(part * epochs // 10)]
    assert rates == expected


def test_the_cosine_schedule_is_half_a_cosine():
    progress = np.linspace(0, 1, 101)
    rates = [cosine(value) for value in progress]
    np.testing.assert_allclose(rates, np.cos(math.pi / 2 * progress) ** 2, atol=1e-15)  # by the half-angle formula


def test_one_cycle_rises_from_a_tenth_to_1_in_a_fifth_and_falls_to_0_in_straight_lines():
    progress = np.linspace(0, 1, 1001)
    rates = [one_cycle(value) for value in progress]
    np.testing.assert_allclose(rates, np.interp(progress, [0, 0.2, 1], [0.1, 1, 0]), atol=1e-12)


def test_every_schedule_stays_within_the_peak_rate_and_reaches_it():
    for schedule in SCHEDULES.values():
        rates = [schedule(value) for value in np.linspace(0, 1, 1001)]
        assert min(rates) >= 0 and max(rates) == 1
