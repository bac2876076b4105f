"""Score networks on photographs of the same kinds of objects in several lights.

Run it as a module in the root of the repository:

    python -m benchmarks.real_light score FOLDER pretrained/none pretrained/best --label orange

FOLDER has a folder of photographs for each class, named LIGHT__NAME.jpg, and may have photos.csv
with the columns path, source_tag and mesh (the object). A folder other_CLASS stands for a CLASS
that some networks lack. With --crops, LIGHT__NAME_K.jpg is crop K of a photograph NAME, which may
have crops in several folders. A network is a published name, the folder of a run, or a name that
`pnb-evaluate` takes as network=. After "normalized:" it sees normalized light, and after "mean:"
its probabilities for dim images are means of those for two exposures. TITLE=A,B,C is a training
with three seeds. The first network and the first light are what others are compared with.

    python -m benchmarks.real_light simulate PHOTOS FOLDER --lights low_light --classes orange apple

writes such a folder with the photographs of PHOTOS as they are ("plain") and in simulated light. It
has no photos.csv, so intervals are over photographs, for these objects.

    python -m benchmarks.real_light rank real=REAL.csv simulated=SIMULATED.csv --label orange

ranks the networks of files that `score --out` wrote, and says how similarly two lights rank them.
A row of another network may stand in a further file of the same title.
"""

import argparse
import csv
import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr

import norm_balls as nb
from augment.classifier import Classifier
from augment.exposure import IsDim
from augment.network import say_once
from augment.switch import SWITCHES
from augment.tasks.classification import nearest
from renderer.errors import InputError, composed, require_whole
from renderer.image import to_unit
from renderer.io.images import write_image
from renderer.settings import MAX_SIZE
from train.checkpoints import RUN, is_classifier, load_network, load_run
from train.class_names import class_name
from train.data.photo import Photograph
from train.data.photographs import (
    find_photographs,
    find_unlabeled,
    folder_names,
    load_photographs,
    unsupported_files,
)
from train.results.intervals import auc_and_recalls, class_means, weighted_means
from train.results.metrics import MIN_OBJECTS
from train.results.predictions import Predictions
from train.results.scoring import compute_logits, rank_classes
from train.results.tables import (
    NORMAL_QUANTILE,
    Estimate,
    Table,
    format_interval,
    wilson,
    write_csv,
)
from train.settings import OTHER_PREFIX

DRAWS = 2000
MIN_NETWORKS = 6  # Smallest number of networks whose rank correlation has an interval.
METRICS = ("top-1", "recall", "recall at 5% FPR", "FPR", "AUC")
HEADER = ["network", "light", *METRICS]
NORMALIZED = "normalized:"
MEAN = "mean:"
MEAN_OF_LIGHTS = {"percentile": 98.0, "level": 0.1, "gamma": 1.0, "average": True}
PLAIN = "plain"
# Statistics of a network in a light, shape (5, 1 + DRAWS): of all photographs, then of each draw.
Statistics = np.ndarray


def load(name: str) -> Classifier:
    """Load a network by its name on the command line."""
    if name.startswith(NORMALIZED):
        return load(name.removeprefix(NORMALIZED)).normalizing_light()
    if name.startswith(MEAN):
        return load(name.removeprefix(MEAN)).normalizing_light(MEAN_OF_LIGHTS)
    is_known = is_classifier(name) or name.startswith(SWITCHES)
    return load_network(name) if is_known else load_run(name.removeprefix(RUN))


def light_of(photograph: Photograph) -> str:
    """Return the light of a photograph, which its name states, or photos.csv."""
    light, separator, _ = photograph.path.name.partition("__")
    return composed(light if separator else photograph.source or PLAIN)


class Stratum(NamedTuple):
    """Units that are drawn together: their objects or classes, lights, and indices."""

    kind: frozenset[str]
    lights: frozenset[str]
    members: list[int]


def joined(strata: Iterable[Stratum]) -> list[Stratum]:
    """Join strata of the same kind that share a light, directly or through other strata."""
    found: list[Stratum] = []
    for kind, lights, members in strata:
        near = [other for other in found if other.kind == kind and other.lights & lights]
        found = [other for other in found if other not in near]
        every = [index for stratum in near for index in stratum.members] + members
        found.append(Stratum(kind, lights.union(*(other.lights for other in near)), every))
    return found


@dataclass(frozen=True)
class Folder:
    """Photographs of class folders, and the units of the bootstrap.

    Attributes:
        path: The folder.
        photographs: Its photographs.
        has_crops: Whether the number after the last "_" of a name is that of a crop.
    """

    path: Path
    photographs: Sequence[Photograph]
    has_crops: bool = False

    @cached_property
    def lights(self) -> np.ndarray:
        """Light of each photograph."""
        return np.array([light_of(item) for item in self.photographs])

    @cached_property
    def objects(self) -> np.ndarray:
        """Object of each photograph, or its class if photos.csv does not name all objects of it."""
        named = [(item.label, item.mesh) for item in self.photographs]
        unnamed = {label for label, mesh in named if not mesh}
        return np.array(
            [label if label in unnamed else f"{label}: {mesh}" for label, mesh in named]
        )

    def has_objects(self, label: str) -> bool:
        """Return whether each light shows MIN_OBJECTS objects of a class, and of other classes.

        All photographs must name their object.
        """
        named: dict[tuple[str, bool], set[str | None]] = {}
        for item, light in zip(self.photographs, self.lights, strict=True):
            side = str(light), item.label.removeprefix(OTHER_PREFIX) == label
            named.setdefault(side, set()).add(item.mesh)
        return all(None not in of and len(of) >= MIN_OBJECTS for of in named.values())

    @cached_property
    def names(self) -> np.ndarray:
        """Name of the photograph without its light, so that it is the same in each light."""
        names = []
        for item, light in zip(self.photographs, self.lights, strict=True):
            stem = composed(item.path.stem)
            name = stem.partition("__")[2] or stem
            # Crops of a photograph may lie in folders of several classes.
            photograph = re.sub(r"_\d+$", "", name) if self.has_crops else f"{item.label}/{name}"
            folders = [part for part in map(composed, item.path.parts[1:-1]) if part != light]
            names.append("/".join([*folders, photograph]))
        return np.array(names)

    def units(self, label: str) -> np.ndarray:
        """Return the unit of each photograph: its object, or else the photograph with its crops."""
        return self.objects if self.has_objects(label) else self.names

    def draw(self, label: str) -> np.ndarray:
        """Draw how often each photograph counts, shape (1 + DRAWS, N); first, each counts once.

        Units of the same objects that share a light are drawn together. So lights that share none
        keep their numbers of photographs of each object. Objects with a single photograph are drawn
        with others of their class. Objects as units differ in the lights alone.
        """
        unit_of_photograph = self.units(label)
        units = np.unique(unit_of_photograph)
        has_objects = self.has_objects(label)
        single = []
        for index, unit in enumerate(units):
            is_unit = unit_of_photograph == unit
            objects = frozenset(() if has_objects else self.objects[is_unit])
            single.append(Stratum(objects, frozenset(self.lights[is_unit]), [index]))
        strata = []
        for objects, lights, members in joined(single):
            classes = frozenset(name.partition(": ")[0] for name in objects)
            strata.append(Stratum(classes if len(members) == 1 else objects, lights, members))
        counts = np.zeros((DRAWS, len(units)), int)
        generator = np.random.default_rng(0)
        for _, _, members in joined(strata):
            share = np.full(len(members), 1 / len(members))
            counts[:, members] = generator.multinomial(len(members), share, size=DRAWS)
        return np.insert(counts, 0, 1, axis=0)[:, np.searchsorted(units, unit_of_photograph)]


def predict(network: Classifier, folder: Folder, labels: Sequence[str]) -> Predictions:
    """Predict the classes of all photographs, of which other_CLASS may show a CLASS."""
    labels = [class_name(network.classes, label, f"{network.title}: --label") for label in labels]
    photographs, images, _ = load_photographs(folder.path, folder.photographs, network.size, None)
    shown = []
    for item in photographs:
        name = item.label.removeprefix(OTHER_PREFIX)
        known = name if name in network.classes else item.label
        if known != item.label:
            say_once(f"{network.title}: photographs of {item.label} count as {known}")
        shown.append(Photograph(item.path, known, item.source, mesh=item.mesh))
    logits = compute_logits(network, images, len(network.classes), "cpu")
    return rank_classes(shown, logits, network.classes, labels)


def measure(
    predictions: Predictions, objects: np.ndarray, counts: np.ndarray, rows: np.ndarray
) -> Statistics:
    """Compute METRICS of some photographs for each draw. Unknown ones are NaN.

    Top-1 is the mean over objects, of classes that the network has.
    """
    chosen = predictions[rows]
    counts, objects = counts[:, rows], objects[rows]
    hits = (chosen.predicted == chosen.label).astype(float)
    is_positive, is_known = chosen.positive, np.isfinite(chosen.true_rank)
    top1, recall, at_5, rate, auc = values = np.full((len(METRICS), len(counts)), np.nan)
    with np.errstate(invalid="ignore"):
        if is_known.any():
            first = chosen.true_rank[is_known] <= 1
            top1[:] = class_means(first, objects[is_known].tolist(), counts[:, is_known])
        if is_positive.any():
            recall[:] = weighted_means(hits[is_positive], counts[:, is_positive])
        if not is_positive.all():
            rate[:] = weighted_means(hits[~is_positive], counts[:, ~is_positive])
        if is_positive.any() and not is_positive.all():
            sides = [chosen.log_odds[side] for side in (is_positive, ~is_positive)]
            drawn = [counts[:, side] for side in (is_positive, ~is_positive)]
            auc[:], at_5[:], *_ = auc_and_recalls(*sides, *drawn)
    return values


def over_seeds(seeds: Sequence[Statistics]) -> Statistics:
    """Average statistics over seeds, which are drawn anew with each draw of photographs."""
    count = len(seeds)
    drawn = np.random.default_rng(1).integers(count, size=(DRAWS, count))
    drawn = np.insert(drawn, 0, np.arange(count), axis=0)
    columns = np.arange(1 + DRAWS)[:, None]
    return np.stack(seeds)[drawn, :, columns].mean(axis=1).T


def count_units(predictions: Predictions, units: np.ndarray, rows: np.ndarray) -> list[int]:
    """Count the units that decide each of METRICS. Both sides decide the AUC."""
    is_known, is_positive = np.isfinite(predictions.true_rank), predictions.positive
    known, positives, negatives = (
        len({*units[rows & side]}) for side in (is_known, is_positive, ~is_positive)
    )
    return [known, positives, positives, negatives, min(positives, negatives)]


def estimate(draws: np.ndarray, units: int, is_change: bool = False) -> Estimate:
    """Return the first value with the 95% interval of the other values, which may be NaN.

    If hardly a draw differs, the interval is Wilson's for so many units, or that of no change. At
    0 and 1, the interval of a value also contains Wilson's. Intervals over few units are too
    narrow. `python -m benchmarks.coverage --bootstrap` measures their coverage.
    """
    value = float(draws[0])
    if np.isnan(value):
        return Estimate()
    low, high = np.nanquantile(draws[1:], [0.025, 0.975])
    is_same = high - low < 1e-9
    if is_change and is_same:
        margin = wilson(0.0, units, NORMAL_QUANTILE)[1]
        low, high = np.clip([value - margin, value + margin], -1, 1)
    elif is_same or (not is_change and min(value, 1 - value) < 1e-9):
        ends = wilson(value, units, NORMAL_QUANTILE)
        low, high = min(low, ends[0]), max(high, ends[1])
    return Estimate(value, float(low), float(high))


def score(options: argparse.Namespace) -> None:
    """Print the tables of each label, and write one file of the scores."""
    networks = dict(map(split_title, options.networks))
    if len(networks) < len(options.networks):
        raise InputError("two networks have the same title: give each its own, TITLE=NETWORK")
    loaded = {name: load(name) for names in networks.values() for name in names}
    classes = next(iter(loaded.values())).classes
    labels = [class_name(classes, label, "--label") for label in options.label]
    found = find_photographs(options.folder, classes, labels[0])
    if others := unsupported_files(options.folder):
        print(f"{len(others)} files are left out, of kinds that are not read, such as {others[0]}")
    groups = choose_lights(Folder(options.folder, found), options.lights)
    is_chosen = np.any([*groups.values()], axis=0)
    groups = {title: rows[is_chosen] for title, rows in groups.items()}
    folder = Folder(options.folder, [*compress(found, is_chosen)], options.crops)
    predictions = {
        title: [predict(loaded[name], folder, labels).by_label for name in names]
        for title, names in networks.items()
    }
    scores = [["label", *HEADER]]
    for label in labels:
        of_label = {title: [one[label] for one in each] for title, each in predictions.items()}
        scores += [[label, *row] for row in print_tables(label, of_label, folder, groups)]
    if options.out:
        write_csv(options.out, scores)


def compared(
    folder: Folder, rows: np.ndarray, first_rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which photographs are compared between two sides, each of one or several lights.

    These are first the photographs that each light shows, and then all photographs of the objects
    of which both sides have photographs, but none with the same name.
    """
    sides = [rows, first_rows]
    lights = [side & (folder.lights == one) for side in sides for one in {*folder.lights[side]}]
    photographs = np.char.add(folder.names, folder.objects)
    has_pair = np.isin(folder.objects, folder.objects[is_in_each(photographs, sides)])
    return is_in_each(photographs, lights), is_in_each(folder.objects, sides) & ~has_pair


def is_in_each(units: np.ndarray, groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return whether the unit of each photograph occurs in each of several groups of rows."""
    return np.isin(units, reduce(np.intersect1d, [units[group] for group in groups]))


def print_tables(
    label: str,
    predictions: Mapping[str, Sequence[Predictions]],
    folder: Folder,
    groups: Mapping[str, np.ndarray],
) -> list[list[str]]:
    """Print the metrics, the gains over the first network and the changes from the first light.

    Gains in top-1 are those on the classes that both networks have.

    Args:
        label: Positive class.
        predictions: Predictions of each seed by the title of the network.
        folder: The photographs.
        groups: Which photographs are in each light.

    Returns:
        Rows of the first table.
    """
    counts, units = folder.draw(label), folder.units(label)
    first_network, *_ = predictions
    first_light, *_ = groups

    measured: dict[tuple[str, bytes], Statistics] = {}

    def statistics(title: str, rows: np.ndarray) -> Statistics:
        key = title, rows.tobytes()
        if key not in measured:
            seeds = [measure(one, folder.objects, counts, rows) for one in predictions[title]]
            measured[key] = over_seeds(seeds)
        return measured[key]

    results = {
        (title, light): statistics(title, rows)
        for title in predictions
        for light, rows in groups.items()
    }
    gains, changes = {}, {}
    pairs: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    unlike: dict[str, np.ndarray] = {}
    for light, rows in groups.items():
        in_each, unlike[light] = compared(folder, rows, groups[first_light])
        both = in_each | unlike[light]
        pairs[light] = rows & both, groups[first_light] & both
    is_known = {title: np.isfinite(each[0].true_rank) for title, each in predictions.items()}
    for (title, light), values in results.items():
        if title != first_network:
            gain = gains[title, light] = values - results[first_network, light]
            rows = groups[light] & is_known[title] & is_known[first_network]
            gain[0] = statistics(title, rows)[0] - statistics(first_network, rows)[0]
        if light != first_light:
            now, before = (statistics(title, rows) for rows in pairs[light])
            changes[title, light] = now - before
    what = "objects" if folder.has_objects(label) else "photographs, for these objects"
    absolute: list[list[str]] = []
    kinds = {"": results, f" minus {first_network}": gains, f" minus {first_light}": changes}
    for suffix, table in kinds.items():
        lines = []
        for (title, light), values in table.items():
            rows = pairs[light][0] if table is changes else groups[light]
            unit_counts = count_units(predictions[title][0], units, rows)
            if table is gains:
                unit_counts[0] = len({*units[rows & is_known[title] & is_known[first_network]]})
            shown = zip(values, unit_counts, strict=True)
            estimates = [estimate(row, count, bool(suffix)) for row, count in shown]
            cells = [format_interval(item, "+" if suffix else "") for item in estimates]
            lines.append([title, light, *cells])
        if lines:
            heading = f"{label}{suffix}: 95% intervals over {what}"
            print(Table(heading, HEADER, lines), end="\n\n", flush=True)
        absolute = absolute or lines
    for light, rows in groups.items():
        is_positive = rows & predictions[first_network][0].positive
        every, positives = (len({*units[side]}) for side in (rows, is_positive))
        print(f"{light}: {rows.sum()} images, {every} {what}, {positives} of them with {label}")
        left_out = folder.objects[(rows | groups[first_light]) & ~np.any(pairs[light], axis=0)]
        if len(left_out):
            names = ", ".join(sorted({*left_out}))
            left = f"{len(left_out)} images that one of them lacks, of {names}"
            print(f"{light} minus {first_light} leaves out {left}")
        if unlike[light].any():
            names = ", ".join(sorted({*folder.objects[unlike[light]]}))
            print(f"{light} minus {first_light} compares different photographs of {names}")
    return absolute


def split_title(word: str) -> tuple[str, list[str]]:
    """Split "TITLE=A,B" into the title and the names of the networks. One name is a title, too."""
    title, separator, names = word.partition("=")
    return (title, names.split(",")) if separator else (word, word.split(","))


def choose_lights(folder: Folder, words: Sequence[str]) -> Mapping[str, np.ndarray]:
    """Return which photographs are in each light. "TITLE=A+B" is several lights together.

    Without words, these are all lights, of which "plain" is the first.
    """
    known = sorted({*map(str, folder.lights)}, key=lambda name: (name != PLAIN, name))
    groups: dict[str, np.ndarray] = {}
    for word in map(composed, words or known):
        title, separator, joined = word.partition("=")
        lights = joined.split("+") if separator else [title]
        if unknown := {*lights} - {*known}:
            fault = f"no photograph is in the light {min(unknown)}"
            raise InputError(f"{fault}: choose among {', '.join(known)}")
        rows = np.isin(folder.lights, lights)
        if not np.array_equal(groups.setdefault(title, rows), rows):
            raise InputError(f"two lights have the title {title}: give TITLE=LIGHT")
    return groups


def simulate(options: argparse.Namespace) -> None:
    """Write the photographs of some classes as they are, and in simulated light."""
    folders = folder_names(options.photos)
    for name in options.classes:
        if folders and not {name, f"{OTHER_PREFIX}{name}"} & {*folders}:
            choices = nearest(name, folders)
            raise InputError(f"--classes: {options.photos} has no folder {name}: give {choices}")
    found = find_photographs(options.photos, [*options.classes, *folders], options.classes[0])
    names = {*options.classes, *(f"{OTHER_PREFIX}{name}" for name in options.classes)}
    chosen = [item for item in found if item.label in names and item.source not in options.exclude]
    if not chosen:
        raise InputError(f"--exclude leaves no photograph of {options.photos}: exclude fewer")
    require_whole("size", options.size, 1, MAX_SIZE)
    if options.folder.is_dir() and any(options.folder.iterdir()):
        raise InputError(f"{options.folder} is not empty: choose a new folder")
    photographs, images, _ = load_photographs(options.photos, chosen, options.size, None)
    shown = {PLAIN: images}
    for light in options.lights:
        shown[light] = nb.relight_photographs(images, options.seed, lights=[light])
    for light, relit in shown.items():
        for item, image in zip(photographs, relit, strict=True):
            # Without the folder of the class, if there is one. Two underscores end a light.
            parts = item.path.with_suffix("").parts
            name = f"{light}__" + "_".join(parts[1:] or parts).replace("__", "_")
            # Photographs in several folders of a class may share a name.
            path = options.folder / item.label / f"{name}.png"
            while path.exists():
                path = path.with_stem(f"{path.stem}_")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, image.permute(1, 2, 0).numpy())


def read_scores(words: Sequence[str], label: str, metric: str) -> dict[str, dict[str, float]]:
    """Read a metric of each network by the light, which has the title of its file before it."""
    scores: dict[str, dict[str, float]] = {}
    for word in words:
        title, separator, path = word.partition("=")
        if not separator:
            raise InputError(f"{word} has no title: give TITLE={word}")
        with Path(path).open(newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            if missing := {"label", "network", "light", metric}.difference(table.fieldnames or ()):
                raise InputError(f"{path} has no column {min(missing)}: give a file of score --out")
            for row in table:
                if row["label"] == label and row[metric] not in {"", "-"}:
                    column = scores.setdefault(f"{title}: {row['light']}", {})
                    # A cell is a value, mostly with an interval behind it.
                    value = float(row[metric].split()[0].replace("−", "-"))
                    if column.setdefault(row["network"], value) != value:
                        fault = f"{row['network']} has two values in {row['light']}"
                        raise InputError(f"files of {title}: {fault}: give them two titles")
    return scores


def rank_correlation(first: Mapping[str, float], second: Mapping[str, float]) -> Estimate:
    """Compute Spearman's correlation over the networks of both, with a 95% interval.

    The interval is that of Bonett and Wright (2000): z = artanh ρ has the standard error
    sqrt((1 + ρ² / 2) / (n − 3)). It treats the networks as independent, and some share weights. In
    z, |ρ| is at most 1 − 12 / (n³ − n), the largest below 1 without ties. Few networks have none.
    """
    shared = sorted(first.keys() & second.keys())
    values = [[scores[name] for name in shared] for scores in (first, second)]
    # Networks that are all equal in a light have no ranks.
    if len(shared) < 4 or min(map(len, map(set, values))) < 2:
        return Estimate()
    value, count = float(spearmanr(*values)[0]), len(shared)
    if count < MIN_NETWORKS:
        return Estimate(value)
    limit = 1 - 12 / (count**3 - count)
    z = np.arctanh(np.clip(value, -limit, limit))
    margin = NORMAL_QUANTILE * np.sqrt((1 + value**2 / 2) / (count - 3))
    low, high = map(float, np.tanh([z - margin, z + margin]))
    return Estimate(value, min(low, value), max(high, value))


def rank(options: argparse.Namespace) -> None:
    """Print the metric of all networks in all lights, best first, and the rank correlations."""
    scores = read_scores(options.scores, options.label, options.metric)
    if not scores:
        raise InputError(f"no file has {options.metric} for the label {options.label}")
    first = next(iter(scores.values()))
    networks = dict.fromkeys(name for column in scores.values() for name in column)
    # Of the metrics, the false-positive rate alone is better if it is lower.
    sign = 1 if options.metric == "FPR" else -1
    ordered = sorted(networks, key=lambda name: sign * first.get(name, sign * math.inf))
    lines = [
        [name, *(f"{column[name]:.3f}" if name in column else "" for column in scores.values())]
        for name in ordered
    ]
    print(Table(f"{options.metric}, {options.label}", ["network", *scores], lines), end="\n\n")
    pairs = []
    for one, other in itertools.combinations(scores, 2):
        count = len(scores[one].keys() & scores[other].keys())
        correlation = rank_correlation(scores[one], scores[other])
        pairs.append([one, other, str(count), format_interval(correlation)])
    header = ["light", "light", "networks", "rank correlation"]
    print(Table("Spearman's rank correlation, 95% intervals over networks", header, pairs))


def count_dim(options: argparse.Namespace) -> None:
    """Count the photographs of folders that `Classifier.with_dim` shows to the network for them."""
    for folder in options.folders:
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder: give folders of photographs")
    counts = [0, 0]
    for folder in options.folders:
        found = find_unlabeled(folder)
        for start in range(0, len(found), 100):
            batch = found[start : start + 100]
            _, images, _ = load_photographs(folder, batch, options.size, None)
            counts[0] += int(IsDim()(to_unit(images)).sum())
            counts[1] += len(images)
    print(f"{counts[0]} of {counts[1]} photographs are dim")


def run(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Run the function `body` of the options. A mistake of the user is one sentence."""
    out = getattr(options, "out", None)
    try:
        if out and not out.parent.is_dir():
            raise InputError(f"--out: {out.parent} is not a folder: make it first")
        options.body(options)
    except (InputError, OSError) as error:
        parser.exit(2, f"error: {error}\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    scoring = commands.add_parser("score", help="score networks on a folder")
    scoring.set_defaults(body=score)
    scoring.add_argument("folder", type=Path)
    scoring.add_argument("networks", nargs="+", help="NETWORK, or TITLE=NETWORK,NETWORK")
    scoring.add_argument("--label", nargs="+", required=True, help="positive classes")
    scoring.add_argument("--lights", nargs="*", default=[], help="LIGHT, or TITLE=LIGHT+LIGHT")
    scoring.add_argument("--crops", action="store_true", help="names end in the number of a crop")
    scoring.add_argument("--out", type=Path, help="CSV file of the scores")
    simulating = commands.add_parser("simulate", help="write photographs in simulated light")
    simulating.set_defaults(body=simulate)
    simulating.add_argument("photos", type=Path, help="folder of class folders")
    simulating.add_argument("folder", type=Path, help="folder to write")
    simulating.add_argument("--lights", nargs="+", required=True, help="names of nb.lights")
    simulating.add_argument("--classes", nargs="+", required=True)
    simulating.add_argument("--exclude", nargs="*", default=[], help="sources of photos.csv")
    simulating.add_argument("--size", type=int, default=160, help="pixels per side")
    simulating.add_argument("--seed", type=int, default=0)
    ranking = commands.add_parser("rank", help="rank networks by their scores in several lights")
    ranking.set_defaults(body=rank)
    ranking.add_argument("scores", nargs="+", help="TITLE=FILE of score --out")
    ranking.add_argument("--label", required=True, help="positive class")
    ranking.add_argument("--metric", default="recall at 5% FPR", choices=METRICS)
    counting = commands.add_parser("dim", help="count the dim photographs of folders")
    counting.set_defaults(body=count_dim)
    counting.add_argument("folders", nargs="+", type=Path)
    counting.add_argument("--size", type=int, default=224, help="pixels per side")
    options = parser.parse_args(arguments)
    run(options, parser)


if __name__ == "__main__":
    main()
