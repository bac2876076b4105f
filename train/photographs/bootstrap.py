"""Bootstrap replicates: samples of images drawn again from those at hand, the same ones at each call."""

from collections.abc import Iterator

import numpy as np

REPLICATES = 2000
BLOCK = 250  # replicates at a time, which bounds the memory
SEED = 0


def draw_samples(*sizes: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Blocks of replicates; each holds how often every image is drawn, (BLOCK, size) counts for each of the sizes.

    As many images are drawn, with replacement, as there are; groups of different kind are drawn apart (stratified).
    Equal sizes give equal draws, so that figures of two networks on the same images are replicated in pairs.
    """
    generator = np.random.default_rng(SEED)
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
