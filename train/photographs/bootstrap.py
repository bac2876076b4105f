"""Bootstrap replicates: samples of images drawn again from those at hand, the same ones at each call."""

from collections.abc import Iterator

import numpy as np

REPLICATES = 2000
BLOCK = 250  # replicates at a time, which bounds the memory
IMAGES, RUNS = 0, 1  # seeds for what is drawn, so that images and runs are drawn independently


def draw_samples(*sizes: int, seed: int = IMAGES) -> Iterator[tuple[np.ndarray, ...]]:
    """Blocks of replicates: how often each image, or run, is drawn, (BLOCK, size) counts for each of the sizes.

    As many are drawn, with replacement, as there are; groups of different kind are drawn apart (stratified).
    Equal sizes give equal draws, so that figures of two networks on the same images are replicated in pairs.
    """
    generator = np.random.default_rng(seed)
    for _ in range(REPLICATES // BLOCK):
        yield tuple(_draw_counts(generator, size) for size in sizes)


def _draw_counts(generator: np.random.Generator, size: int) -> np.ndarray:
    drawn = generator.integers(size, size=(BLOCK, size)) + size * np.arange(BLOCK)[:, None]
    return np.bincount(drawn.ravel(), minlength=BLOCK * size).reshape(BLOCK, size)


def replicate_share(outcomes: np.ndarray) -> np.ndarray:
    """The share of true outcomes, (n,) with n at least 1, in each replicate: (REPLICATES,)."""
    return np.concatenate([counts @ outcomes / len(outcomes) for (counts,) in draw_samples(len(outcomes))])


def interval(replicates: np.ndarray) -> dict[str, float]:
    """low and high of the 95 % percentile interval (Efron and Tibshirani 1993, ch. 13) over (REPLICATES,) figures.

    Percentiles, as pROC takes them for ROC curves (Robin et al. 2011), stay within the figure's range and move with any
    monotone transform of it; BCa's correction is undefined where all replicates agree, as those of a recall of 1 do.
    """
    low, high = np.quantile(replicates, (0.025, 0.975))
    return {"low": float(low), "high": float(high)}


def replicate_difference(one: np.ndarray, other: np.ndarray, paired: bool) -> np.ndarray:
    """The difference in mean of two groups of runs in each replicate, (REPLICATES,), with runs drawn again, too.

    The groups are their runs' replicates, (S, REPLICATES) and (T, REPLICATES). paired: S = T, and the s-th runs of both
    are drawn together.
    """
    groups = [one - other] if paired else [one, -other]
    blocks = zip(*draw_samples(*map(len, groups), seed=RUNS), strict=True)
    drawn = [np.concatenate(counts) for counts in blocks]  # a row's counts sum to the group's size
    return sum((counts.T * group).mean(axis=0) for counts, group in zip(drawn, groups, strict=True))
