"""Coverage of the 95% intervals in simulations with few objects.

    python -m benchmarks.coverage

A score is the sum of the mean of its class, a normal effect of its object and normal noise of
its image. The second network adds a gain to the positives, an effect of each object and noise.
The true metrics are closed forms. The table has the fraction of intervals that contain the
true metric and, in brackets, their mean width:

- *jackknife*: the intervals of the library over objects, and the truth for all objects.
- *bootstrap*: percentiles of resampled objects, which the library used before.
- *images*: the intervals of the library over images, and the truth for the drawn objects.
"""

import argparse
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from train.results.metrics import (
    RATES,
    ROC_METRICS,
    Jackknife,
    Units,
    auc_and_recalls,
    change,
    class_means,
    leave_out,
    weighted_means,
)
from train.results.tables import Estimate, Table

METRICS = (*ROC_METRICS, "recall", "FPR", "top-1")
METHODS = ("jackknife", "bootstrap", "images")
DRAWS = 200
# Number of classes of the positive objects, for top-1.
CLASSES = 3


class Setup(NamedTuple):
    """Simulated test set and networks.

    Attributes:
        name: Name in the table.
        objects: Numbers of positive and of negative objects.
        images: Images of each object.
        means: Means of the scores of positives and of negatives. An image is
            recognized as the positive class if its score is above 0.
        object_spread: Standard deviation between objects. That within is 1.
        gain: Mean gain of the second network on positives.
        gain_spread: Standard deviations of the gain over objects, images and seeds.
        seeds: Number of training runs of the second network.
    """

    name: str
    objects: tuple[int, int]
    images: int = 20
    means: tuple[float, float] = (1.2, -0.8)
    object_spread: float = 0.8
    gain: float = 0.8
    gain_spread: tuple[float, float, float] = (0.4, 0.6, 0.0)
    seeds: int = 1


SHY = Setup("recall of 0.2", (9, 9), means=(-1.2, -2.3), gain=1.0)
SURE = Setup("near 0 and 1", (9, 9), means=(2.5, -2.5), object_spread=1.0, gain=0.3)
VARIED = Setup("varied objects", (9, 9), means=(1.7, -1.7), object_spread=2.0)
NO_GAIN = Setup("no gain", (9, 9), means=(0.5, -1.0), gain=0.0)
SETUPS = (
    Setup("typical", (5, 5)),
    Setup("typical", (5, 10)),
    Setup("typical", (7, 9)),
    Setup("typical", (9, 9)),
    Setup("typical", (20, 20)),
    *(setup._replace(objects=(5, 5)) for setup in (SHY, SURE, VARIED, NO_GAIN)),
    *(setup._replace(objects=(7, 9)) for setup in (SHY, SURE, VARIED, NO_GAIN)),
    *(setup._replace(objects=(20, 20)) for setup in (SHY, SURE, VARIED)),
    Setup("three seeds", (7, 9), gain_spread=(0.4, 0.6, 0.4), seeds=3),
    Setup("two objects", (2, 7)),
    Setup("photographs", (55, 55), images=1),
    Setup("photographs", (226, 400), images=1),
)


def true_metrics(
    positives: np.ndarray, negatives: np.ndarray, spreads: Sequence[float | np.floating]
) -> np.ndarray:
    """Compute METRICS for scores that are mixtures of normal distributions.

    Args:
        positives: Mean of the scores of each positive object. The objects are
            equally frequent.
        negatives: Mean of the scores of each negative object.
        spreads: Standard deviations of positives and negatives around these means.
    """
    recalls = []
    for rate in RATES:
        low, high = -50.0, 50.0
        while high - low > 1e-9:
            middle = (low + high) / 2
            is_low = ndtr((negatives - middle) / spreads[1]).mean() > float(rate)
            low, high = (middle, high) if is_low else (low, middle)
        recalls.append(ndtr((positives - low) / spreads[0]).mean())
    auc = ndtr((positives[:, None] - negatives) / np.hypot(spreads[0], spreads[1])).mean()
    found = ndtr(positives / spreads[0])
    by_class = [found[first::CLASSES].mean() for first in range(min(CLASSES, len(found)))]
    false_positive_rate = ndtr(negatives / spreads[1]).mean()
    return np.array([auc, *recalls, found.mean(), false_positive_rate, np.mean(by_class)])


def true_values(setup: Setup) -> np.ndarray:
    """Compute METRICS of both networks for all objects, shape (2, len(METRICS))."""
    of_object, of_image, of_seed = setup.gain_spread
    positive, negative = np.array(setup.means)[:, None]
    first = np.hypot(1, setup.object_spread)
    second = np.linalg.norm([first, of_object, of_image])
    after = true_metrics(positive + setup.gain, negative, (np.hypot(second, of_seed), second))
    return np.stack([true_metrics(positive, negative, (first, first)), after])


def simulate(
    setup: Setup, generator: np.random.Generator
) -> tuple[list[list[np.ndarray]], np.ndarray]:
    """Draw the scores of both networks.

    Returns:
        Scores of positives and of negatives for each run, the first network
        first. METRICS of both networks for the drawn objects, shape
        (2, len(METRICS)).
    """
    of_object, of_image, of_seed = setup.gain_spread
    shifts = generator.normal(0, of_seed, setup.seeds)
    scores = []
    means = []
    for count, mean, gain in zip(setup.objects, setup.means, (1, 0), strict=True):
        before = mean + generator.normal(0, setup.object_spread, (count, 1))
        after = before + gain * setup.gain + generator.normal(0, of_object, (count, 1))
        noise = generator.normal(size=(count, setup.images))
        runs = [before + noise]
        for shift in shifts:
            own_noise = generator.normal(0, of_image, noise.shape)
            runs.append(after + gain * shift + noise + own_noise)
        scores.append([run.ravel() for run in runs])
        means.append((before[:, 0], after[:, 0]))
    spread = np.hypot(1, of_image)
    (positives, positives_after), (negatives, negatives_after) = means
    spreads = (np.hypot(spread, of_seed), spread)
    truth = [
        true_metrics(positives, negatives, (1, 1)),
        true_metrics(positives_after, negatives_after, spreads),
    ]
    return [list(run) for run in zip(*scores, strict=True)], np.stack(truth)


def statistics(
    scores: Sequence[np.ndarray], classes: Sequence[str]
) -> list[tuple[Callable[..., np.ndarray], list[int]]]:
    """Return the functions of image counts that compute METRICS, with the groups they take."""
    positives, negatives = scores
    is_found = positives[None] > 0
    return [
        (partial(auc_and_recalls, positives, negatives), [0, 1]),
        (partial(weighted_means, is_found.astype(float)), [0]),
        (partial(weighted_means, (negatives[None] > 0).astype(float)), [1]),
        (partial(class_means, is_found, classes), [0]),
    ]


def jackknives(
    scores: Sequence[np.ndarray], classes: Sequence[str], units: Sequence[np.ndarray]
) -> list[Jackknife]:
    """Leave out each unit of positives and negatives for each of METRICS."""
    results = []
    for statistic, groups in statistics(scores, classes):
        results += leave_out(statistic, Units([units[group] for group in groups], ""))
    return results


def intervals(
    runs: Sequence[Sequence[np.ndarray]], classes: Sequence[str], units: Sequence[np.ndarray]
) -> list[Estimate]:
    """Return the library's intervals of the first network, and of the gain of the second."""
    first, *second = (jackknives(scores, classes, units) for scores in runs)
    values = [jackknife.estimate for jackknife in first]
    gains = [change(after, [before]) for before, *after in zip(first, *second, strict=True)]
    return values + gains


def resampled(
    runs: Sequence[Sequence[np.ndarray]],
    classes: Sequence[str],
    objects: Sequence[np.ndarray],
    generator: np.random.Generator,
) -> list[Estimate]:
    """Return the percentile intervals of the first network, and of the gain of the second."""
    counts = []
    for object_of_image in objects:
        number = object_of_image.max() + 1
        drawn = generator.multinomial(number, np.full(number, 1 / number), DRAWS)
        counts.append(drawn[:, object_of_image])
    draws = []
    for scores in runs:
        rows = []
        for statistic, groups in statistics(scores, classes):
            rows += list(statistic(*(counts[group] for group in groups)))
        draws.append(rows)
    first, second = np.array(draws[0]), np.mean(draws[1:], axis=0)
    ends = np.quantile(np.concatenate([first, second - first]), [0.025, 0.975], axis=1).T
    return [Estimate(None, low, high) for low, high in ends]


def measure(
    setup: Setup, repetitions: int, methods: Collection[str] = METHODS
) -> dict[str, np.ndarray]:
    """Measure the coverage and the mean width of each method.

    Args:
        setup: What is simulated.
        repetitions: Number of simulated test sets.
        methods: Methods that are measured, of METHODS. There is no interval over
            the images of objects that have a single image.

    Returns:
        Coverage and width of the values and gains of METRICS by method, shape
        (2, 2 * len(METRICS)).
    """
    generator = np.random.default_rng(0)
    objects = [np.arange(count).repeat(setup.images) for count in setup.objects]
    images = [np.arange(len(object_of_image)) for object_of_image in objects]
    classes = [str(number % CLASSES) for number in objects[0]]
    truth = true_values(setup)
    found: dict[str, list[np.ndarray]] = {}
    for _ in range(repetitions):
        runs, truth_here = simulate(setup, generator)
        of_method: dict[str, tuple[list[Estimate], np.ndarray]] = {}
        if "jackknife" in methods:
            of_method["jackknife"] = intervals(runs, classes, objects), truth
        if "bootstrap" in methods:
            of_method["bootstrap"] = resampled(runs, classes, objects, generator), truth
        if "images" in methods and setup.images > 1:
            of_method["images"] = intervals(runs, classes, images), truth_here
        for name, (estimates, (before, after)) in of_method.items():
            low, high = np.array([(item.low, item.high) for item in estimates], float).T
            true = np.concatenate([before, after - before])
            is_covered = (low - 1e-12 <= true) & (true <= high + 1e-12)
            found.setdefault(name, []).append(np.stack([is_covered, high - low]))
    return {name: np.mean(rows, axis=0) for name, rows in found.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure each setup, and print a table.

    Args:
        arguments: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repetitions", type=int, default=400, help="test sets of each setup")
    parser.add_argument("--setups", type=int, default=len(SETUPS), help="first setups only")
    options = parser.parse_args(arguments)
    rows = []
    for setup in SETUPS[: options.setups]:
        title = f"{setup.name}, {setup.objects[0]} and {setup.objects[1]}"
        for method, (coverage, width) in measure(setup, options.repetitions).items():
            cells = [f"{a:.3f} ({b:.2f})" for a, b in zip(coverage, width, strict=True)]
            rows.append([title, method, *cells])
    header = [*METRICS, *(f"gain in {name}" for name in METRICS)]
    print(Table("coverage (mean width)", ["objects", "method", *header], rows))


if __name__ == "__main__":
    main()
