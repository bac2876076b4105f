"""Learning-rate schedules: functions of training progress in [0, 1) that scale the peak rate."""

import math


def step(progress: float) -> float:
    """×0.2 at 30, 60 and 80 % of the epochs (Zagoruyko and Komodakis 2016: 60, 120 and 160 of 200)."""
    return 0.2 ** sum(progress >= milestone for milestone in (0.3, 0.6, 0.8))


def cosine(progress: float) -> float:
    """Half a cosine from 1 to 0."""
    return (1 + math.cos(math.pi * progress)) / 2


def one_cycle(progress: float) -> float:
    """Linear from 0.1 to 1 over the first fifth, then linear to 0: the most from a few epochs."""
    return 0.1 + 0.9 * progress / 0.2 if progress < 0.2 else (1 - progress) / 0.8


SCHEDULES = {"step": step, "cosine": cosine, "one_cycle": one_cycle}
