"""Coverage of the 95% intervals in simulations with few objects.

    python -m benchmarks.coverage

A score is the sum of the mean of its class, an effect of its object and noise of its image. The
second network adds a gain to the positives, an effect of each object and noise. The table has the
fraction of intervals that contain the true metric and, in brackets, their mean width:

- *objects*: the intervals of the library over objects, and the truth for all objects.
- *images*: the intervals of the library over images, and the truth for the drawn objects.

The truth is the metric of a population whose effects and noise are equally spaced quantiles.

    python -m benchmarks.coverage --like out/predictions.csv --label orange

tells how large and how skewed effects and noise are in a table of predictions with a column `mesh`.

    python -m benchmarks.coverage --bootstrap --draws 200

measures the coverage of the bootstrap intervals of `benchmarks.real_light`.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import ndtr, ndtri, stdtrit
from scipy.stats import skew

from benchmarks import real_light
from train.data.photo import Photograph
from train.results.intervals import (
    Jackknife,
    Units,
    auc_and_recalls,
    average,
    change_ends,
    class_means,
    leave_out,
    leave_out_of_roc,
    weighted_means,
)
from train.results.metrics import ROC_METRICS
from train.results.predictions import read_predictions
from train.results.scoring import rank_classes
from train.results.tables import Table

METRICS = (*ROC_METRICS, "recall", "FPR", "top-1")
# Number of classes of the positive objects, for top-1.
CLASSES = 3
# Equally likely standard normal values, for populations.
QUANTILES = ndtri((np.arange(200) + 0.5) / 200)
# Number of simulated test sets that are scored at once, which bounds the memory.
BLOCK = 100


def heavy_tails(normal: np.ndarray) -> np.ndarray:
    """Transform standard normal values to Student's t with 3 degrees of freedom, times 0.77."""
    return stdtrit(3, ndtr(normal)) / 1.3


def two_modes(normal: np.ndarray) -> np.ndarray:
    """Transform standard normal values to a distribution with modes at -1 and 1."""
    return np.sign(normal) + 0.4 * normal


def skewed(normal: np.ndarray) -> np.ndarray:
    """Transform standard normal values to a log-normal distribution of skewness 4.7."""
    return np.exp(0.9 * normal) - 1.5


class Setup(NamedTuple):
    """Simulated test set and networks.

    Attributes:
        name: Name in the table.
        objects: Numbers of positive and of negative objects.
        images: Images of each object.
        means: Means of the scores of positives and of negatives. An image is
            recognized as the positive class if its score is above 0.
        object_spread: Scale of the effects of objects. That of the noise is 1.
        gain: Mean gain of the second network on positives.
        gain_spread: Standard deviations of the gain over objects, images and seeds.
        seeds: Number of training runs of the second network.
        shape: Transform of standard normal values to effects and noise.
        limit: Largest absolute score. Scores beyond it tie.
    """

    name: str
    objects: tuple[int, int]
    images: int = 20
    means: tuple[float, float] = (1.2, -0.8)
    object_spread: float = 0.8
    gain: float = 0.8
    gain_spread: tuple[float, float, float] = (0.4, 0.6, 0.0)
    seeds: int = 1
    shape: Callable[[np.ndarray], np.ndarray] = np.asarray
    limit: float = np.inf

    def means_of_objects(self, group: int, normal: np.ndarray, is_second: int) -> np.ndarray:
        """Transform standard normal values to the means of positives (group 0) or negatives (1)."""
        gain = self.gain if group == 0 and is_second else 0
        spread = np.hypot(self.object_spread, self.gain_spread[0] * is_second)
        return self.means[group] + gain + spread * self.shape(normal)

    def scores(self, means: np.ndarray, normal: np.ndarray, is_second: int) -> np.ndarray:
        """Add standard normal noise of images to means: (...) and (..., n) to (..., n)."""
        spread = np.hypot(1, self.gain_spread[1] * is_second)
        scores = means[..., None] + spread * self.shape(normal)
        return scores.clip(-self.limit, self.limit)


TYPICAL = {
    "typical": {},
    "recall of 0.2": {"means": (-1.2, -2.3), "gain": 1.0},
    "near 0 and 1": {"means": (2.5, -2.5), "object_spread": 1.0, "gain": 0.3},
    "varied objects": {"means": (1.7, -1.7), "object_spread": 2.0},
    "no gain": {"means": (0.5, -1.0), "gain": 0.0},
}
# No choice in the library was made with these numbers of objects and distributions, except for
# the degrees of freedom, and the treatment of a threshold that may be above all scores.
OTHER = {
    "heavy tails": {"shape": heavy_tails},
    "two modes": {"shape": two_modes},
    "skewed": {"shape": skewed},
    "saturated": {"limit": 1.5},
    "small effects": {"object_spread": 0.23},
    "large effects": {"object_spread": 2.0},
}
SETUPS = [
    *(Setup("typical", objects) for objects in ((5, 10), (9, 9))),
    *(
        Setup(name, objects, **changes)
        for objects in ((5, 5), (7, 9), (20, 20))
        for name, changes in TYPICAL.items()
    ),
    Setup("three seeds", (7, 9), gain_spread=(0.4, 0.6, 0.4), seeds=3),
    Setup("two objects", (2, 7)),
    *(
        Setup(name, objects, **changes)
        for objects in ((5, 5), (6, 9), (7, 12), (10, 10))
        for name, changes in OTHER.items()
    ),
    *(
        Setup(f"photographs, {name}", objects, 1, **changes)
        for objects in ((55, 55), (54, 40), (200, 200))
        for name, changes in {"typical": {}, **OTHER}.items()
    ),
]

# Sets like those of `benchmarks.real_light`. A photograph has crops of both kinds.
BETWEEN = (0.0, -1.0)
BOOTSTRAPPED = [
    Setup("15 photographs", (15, 15), 4, BETWEEN),
    Setup("15 photographs, three runs", (15, 15), 4, BETWEEN, gain_spread=(0.4, 0.6, 0.4), seeds=3),
    Setup("25 photographs", (25, 25), 4, BETWEEN),
    Setup("5 and 5 objects, 3 views", (5, 5), 3, BETWEEN),
    Setup("10 and 10 objects, 4 views", (10, 10), 4, BETWEEN),
]


def population_metrics(positives: np.ndarray, negatives: np.ndarray) -> np.ndarray:
    """Compute METRICS of populations of objects and images: (..., k, n) to (METRICS, ...)."""
    groups = [scores.reshape(*scores.shape[:-2], -1) for scores in (positives, negatives)]
    recall, false_positive_rate = ((scores > 0).mean(axis=-1) for scores in groups)
    found = (positives > 0).mean(axis=-1)
    class_count = min(CLASSES, found.shape[-1])
    by_class = [found[..., first::CLASSES].mean(axis=-1) for first in range(class_count)]
    top1 = np.mean(by_class, axis=0)
    of_roc = np.vectorize(auc_and_recalls, signature="(n),(m)->(k)")(*groups)
    return np.stack([*np.moveaxis(of_roc, -1, 0), recall, false_positive_rate, top1])


def true_values(setup: Setup) -> np.ndarray:
    """Compute METRICS of both networks for all objects, shape (2, METRICS, 1)."""
    values = []
    for is_second in (0, 1):
        positives, negatives = (
            setup.means_of_objects(group, QUANTILES, is_second) for group in (0, 1)
        )
        shifts = setup.gain_spread[2] * is_second * QUANTILES[5::10]
        positives = np.add.outer(shifts, positives).ravel() if shifts.any() else positives
        scores = (setup.scores(item, QUANTILES, is_second) for item in (positives, negatives))
        values.append(population_metrics(*scores)[:, None])
    return np.stack(values)


def correlated(first: np.ndarray, second: np.ndarray, spread: float, added: float) -> np.ndarray:
    """Return the normal values whose product with hypot(spread, added) is the sum of both parts."""
    return (spread * first + added * second) / np.hypot(spread, added)


class Simulated(NamedTuple):
    """Test sets that are drawn at random.

    Attributes:
        runs: Scores of positives and of negatives for each run, the first
            network first, shape (draws, images).
        here: METRICS of both networks for the drawn objects, shape
            (2, METRICS, draws). Empty if each object has one image.
    """

    runs: list[tuple[np.ndarray, np.ndarray]]
    here: np.ndarray


def simulate(setup: Setup, draws: int, generator: np.random.Generator) -> Simulated:
    """Draw the scores of both networks."""
    of_object, of_image, of_seed = setup.gain_spread
    shifts = generator.normal(0, of_seed, (setup.seeds, draws, 1))
    runs = []
    populations = []
    for group, count in enumerate(setup.objects):
        own, other = generator.normal(size=(2, draws, count))
        before = setup.means_of_objects(group, own, 0)
        both = correlated(own, other, setup.object_spread, of_object)
        after = setup.means_of_objects(group, both, 1)
        noise = generator.normal(size=(draws, count, setup.images))
        scores = [setup.scores(before, noise, 0)]
        for shift in shifts:
            own_noise = generator.normal(size=noise.shape)
            run_means = after + shift if group == 0 else after
            scores.append(setup.scores(run_means, correlated(noise, own_noise, 1, of_image), 1))
        runs.append([run.reshape(draws, -1) for run in scores])
        populations.append([setup.scores(before, QUANTILES, 0), setup.scores(after, QUANTILES, 1)])
    here = np.empty(0)
    if setup.images > 1:
        here = np.stack([population_metrics(*pair) for pair in zip(*populations, strict=True)])
    return Simulated(list(zip(*runs, strict=True)), here)


def jackknives(
    scores: Sequence[np.ndarray], classes: Sequence[str], units: Sequence[np.ndarray]
) -> list[Jackknife]:
    """Leave out each unit of positives and negatives for each of METRICS."""
    positives, negatives = scores
    is_found, is_false = positives[None] > 0, negatives[None] > 0
    of_positives, of_negatives = Units(units[:1], ""), Units(units[1:], "")
    # The jackknives of one draw after the other.
    of_draws = [leave_out_of_roc(*pair, Units(units, "")) for pair in zip(*scores, strict=True)]
    return [
        *map(stack, zip(*of_draws, strict=True)),
        *leave_out(partial(weighted_means, is_found.astype(float)), of_positives),
        *leave_out(partial(weighted_means, is_false.astype(float)), of_negatives),
        *leave_out(partial(class_means, is_found, classes), of_positives),
    ]


def stack(of_draws: Sequence[Jackknife]) -> Jackknife:
    """Join the jackknives of a metric, which each draw has."""
    first = of_draws[0]
    without = [np.stack(group) for group in zip(*(one.without for one in of_draws), strict=True)]
    ends = [one.at_ends for one in of_draws if one.at_ends is not None]
    at_ends = np.stack(ends, axis=-1) if ends else None
    values = np.stack([one.value for one in of_draws])
    return Jackknife(values, without, first.unit_count, first.over, at_ends)


def intervals(
    runs: Sequence[Sequence[np.ndarray]], classes: Sequence[str], units: Sequence[np.ndarray]
) -> np.ndarray:
    """Compute the library's intervals of values, and of gains, shape (2, 2 · METRICS, draws)."""
    first, *second = (jackknives(scores, classes, units) for scores in runs)
    means = [average(metric) for metric in zip(*second, strict=True)]
    gains = [
        change_ends(after, average([before])) for after, before in zip(means, first, strict=True)
    ]
    return np.stack([*(item.interval for item in first), *gains], axis=1)


def measure(setup: Setup, draws: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Measure the coverage and the mean width of the intervals over objects, and over images.

    Args:
        setup: What is simulated.
        draws: Number of simulated test sets.
        seed: Seed of the random draws.

    Returns:
        Coverage and width of the values and gains of METRICS by method, shape
        (2, 2 · METRICS). There is no method "images" if an object has one image.
    """
    generator = np.random.default_rng(seed)
    numbers = np.arange(sum(setup.objects) * setup.images)
    images = np.split(numbers, [setup.objects[0] * setup.images])
    objects = [number_of_image // setup.images for number_of_image in images]
    classes = [str(number % CLASSES) for number in objects[0]]
    overall = true_values(setup)
    rows: dict[str, list[np.ndarray]] = {}
    for start in range(0, draws, BLOCK):
        simulated = simulate(setup, min(BLOCK, draws - start), generator)
        methods = {"objects": (objects, overall)}
        if setup.images > 1:
            methods["images"] = (images, simulated.here)
        for method, (units, (before, after)) in methods.items():
            low, high = intervals(simulated.runs, classes, units)
            true = np.concatenate([before, after - before])
            is_covered = (low - 1e-12 <= true) & (true <= high + 1e-12)
            rows.setdefault(method, []).append(np.stack([is_covered, high - low]))
    return {name: np.concatenate(item, axis=-1).mean(axis=-1) for name, item in rows.items()}


def measure_bootstrap(setup: Setup, draws: int) -> np.ndarray:
    """Measure the coverage of `real_light.METRICS` but top-1, and of gains in them."""
    has_objects = "objects" in setup.name
    meshes = [str(unit) if has_objects else None for unit in range(max(setup.objects))]
    photographs = [
        Photograph(PurePosixPath(label, f"{unit}_{image}.png"), label, None, mesh=meshes[unit])
        for label, count in zip(("orange", "pear"), setup.objects, strict=True)
        for unit, image in np.ndindex(count, setup.images)
    ]
    folder = real_light.Folder(Path(), photographs, not has_objects)
    counts, units = folder.draw("orange"), folder.units("orange")
    rows = np.ones(len(photographs), bool)
    order = [METRICS.index(name) for name in ("recall", ROC_METRICS[1], "FPR", "auc")]
    before, after = true_values(setup)[:, order, 0]
    covered = []
    for index in range(draws):
        runs = []
        for groups in simulate(setup, 1, np.random.default_rng(index)).runs:
            logits = torch.tensor([[score, 0.0] for score in np.concatenate(groups, axis=1)[0]])
            chosen = rank_classes(photographs, logits, ("orange", "pear"), ["orange"])
            runs.append(real_light.measure(chosen, folder.objects, counts, rows))
        unit_counts = real_light.count_units(chosen, units, rows)[1:]
        second = real_light.over_seeds(runs[1:])
        found = [*map(real_light.estimate, second[1:], unit_counts)]
        changes = zip((second - runs[0])[1:], unit_counts, strict=True)
        found += [real_light.estimate(*change, is_change=True) for change in changes]
        true = np.concatenate([after, after - before])
        low, high = np.array([(one.low, one.high) for one in found]).T
        covered.append((low - 1e-12 <= true) & (true <= high + 1e-12))
    return np.mean(covered, axis=0)


def describe(path: Path, label: str) -> Table:
    """Measure the effects of objects and the noise of images on the log-odds of a label."""
    objects: dict[tuple[bool, str | None], list[float]] = {}
    predictions = read_predictions(path, label)
    columns = (predictions.positive, predictions.photograph, predictions.log_odds)
    for is_positive, photograph, log_odds in zip(*columns, strict=True):
        objects.setdefault((is_positive, photograph.mesh), []).append(log_odds)
    rows = []
    for is_positive, kind in ((True, label), (False, "other")):
        scores = [values for (group, _), values in objects.items() if group == is_positive]
        means = np.array([np.mean(values) for values in scores])
        noise = np.concatenate([values - np.mean(values) for values in scores])
        numbers = (means.std(ddof=1) / noise.std(), skew(means, bias=False), skew(noise))
        rows.append([kind, str(len(scores)), *(f"{number:.2f}" for number in numbers)])
    header = ["kind", "objects", "effect / noise", "skewness of effects", "of noise"]
    return Table("effects", header, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure each setup, and print a table.

    Args:
        arguments: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=2000, help="test sets of each setup")
    parser.add_argument("--only", default="", help="text in the titles of the setups to measure")
    parser.add_argument("--like", type=Path, help="describe the effects in this predictions.csv")
    parser.add_argument("--label", default="orange", help="positive class in this table")
    parser.add_argument("--bootstrap", action="store_true", help="measure those of real_light")
    options = parser.parse_args(arguments)
    if options.like:
        print(describe(options.like, options.label))
        return
    rows = []
    if options.bootstrap:
        for setup in BOOTSTRAPPED:
            coverage = measure_bootstrap(setup, options.draws)
            rows.append([setup.name, *(f"{value:.3f}" for value in coverage)])
        names = real_light.METRICS[1:]
        print(Table("coverage", ["units", *names, *(f"gain in {name}" for name in names)], rows))
        return
    for seed, setup in enumerate(SETUPS):
        title = f"{setup.name}, {setup.objects[0]} and {setup.objects[1]}"
        if options.only not in title:
            continue
        for method, (coverage, width) in measure(setup, options.draws, seed).items():
            cells = [f"{a:.3f} ({b:.2f})" for a, b in zip(coverage, width, strict=True)]
            rows.append([title, method, *cells])
    header = [*METRICS, *(f"gain in {name}" for name in METRICS)]
    print(Table("coverage (mean width)", ["objects", "method", *header], rows))


if __name__ == "__main__":
    main()
