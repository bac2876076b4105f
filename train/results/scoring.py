"""Scores of a model on a folder of photographs, as files and as text.

`evaluate_photographs` has three steps: `Predictor.predict` classifies the
photographs, `score` computes metrics, and `write` writes them to files.

A label is the name of a positive class. The operating point of a label is a
threshold on its log-odds. An image above the threshold counts as detected.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.classifier import CheckedNetwork, Label, OperatingPoint
from augment.network import compute_outputs
from augment.tasks.classification import Classification, log_odds
from renderer.errors import InputError, ShortRepr, require_choice
from renderer.io.images import write_image
from renderer.settings import Size, as_size
from train.data import photographs as folders
from train.data.photo import TABLE, Photograph
from train.results import metrics, predictions, tables
from train.results.intervals import thresholds
from train.results.metrics import TITLES, Metrics, Outcome, Pool
from train.results.pictures import contact_sheet, write_roc
from train.results.predictions import Predictions
from train.results.tables import Estimate, Proportion, Table
from train.settings import GROUPS, label_names, published_folder

# Number of images for which the model computes logits in one call.
BATCH = 256
# A PyTorch module, or a function, that maps images to logits.
Model = Callable[[Tensor], Tensor]
# Number of wrong predictions that are listed for the images of each class: the 5 most
# common ones.
WRONG_CLASSES = 5
# Keys of the groups of photographs in summary.json.
SUMMARY_KEYS = {"source": "by_source", "mesh": "by_mesh", "class": "class_metrics"}
# Metrics that depend on a ranking of images or classes.
RANKING_METRICS = (*metrics.ROC_METRICS, *metrics.TOP_RANKS)
# Metrics that the lines of `Scores` leave out, because they matter less.
DETAILS = ("top5", "recall_at/0.05", "recall_at/0.20")


@dataclass(frozen=True, repr=False)
class FolderPredictions(ShortRepr):
    """Predictions of a model for all photographs of a folder.

    Attributes:
        folder: Folder of the photographs.
        predictions: Predictions of all photographs. Those for one positive class are in the
            order of `images`.
        images: Pixels of the photographs, uint8 sRGB, shape
            (N, 3, size, size).
        labels: Names of the positive classes.
        unreadable: Paths of the photographs that could not be read.
        left_out: Paths of the files whose type is not supported.
        hashes: Hashes of the photographs with each label alone, by label, and with all
            labels, by "". If the last is equal for two networks, their metrics can be
            compared.
    """

    folder: Path
    predictions: Predictions
    images: Tensor
    labels: list[str]
    unreadable: list[str]
    left_out: list[str]
    hashes: dict[str, str]


@dataclass
class Predictor:
    """Model that predicts the classes of photographs.

    Attributes:
        model: Module or function that maps images to logits. The images are
            float32 sRGB in [0, 1], shape (N, 3, size, size). The logits have
            the shape (N, len(classes)). A module is called in eval mode. Its
            mode is restored afterwards.
        classes: Names of the classes of the model.
        size: Pixels per side of the images, or height and width.
        device: Device of the model.
    """

    model: Model
    classes: Sequence[str]
    size: Size = 32
    device: str | torch.device = "cpu"

    def predict(self, folder: Path, label: Label, skip_unreadable: bool) -> FolderPredictions:
        """Predict the classes of all photographs of a folder."""
        labels = label_names(label)
        found = folders.find_photographs(folder, self.classes, label)
        photographs, images, unreadable = folders.load_photographs(
            folder, found, self.size, skip_unreadable
        )
        logits = compute_logits(self.model, images, len(self.classes), self.device)
        ranked = rank_classes(photographs, logits, self.classes, labels)
        # Files that are no images.
        left_out = [str(path) for path in folders.unsupported_files(folder)]
        facts = labels, unreadable, left_out, _hashes(folder, photographs, labels)
        return FolderPredictions(folder, ranked, images, *facts)


def _hashes(folder: Path, photographs: Sequence[Photograph], labels: list[str]) -> dict[str, str]:
    """Hash photographs with SHA-256, together with each label alone and, by "", with all labels."""
    # The order of the labels makes no difference.
    parts = {"": sorted(labels)} | {label: [label] for label in labels}
    digests = {key: hashlib.sha256("\n".join(part).encode()) for key, part in parts.items()}
    for photograph in photographs:
        row = f"{photograph}{photograph.mesh or ''}".encode()
        for digest in digests.values():
            digest.update(row + (folder / photograph.path).read_bytes())
    return {key: digest.hexdigest() for key, digest in digests.items()}


def compute_logits(
    model: Model, images: Tensor, classes: int, device: str | torch.device
) -> Tensor:
    """Compute the logits of a model for images.

    A module is called in eval mode. Its mode is restored afterwards. The images are 8-bit sRGB,
    and the model gets them in [0, 1]. The logits are on the CPU, and raise InputError if they are
    not finite.
    """
    checked = CheckedNetwork(model, "model", Classification(), classes)
    logits = compute_outputs(checked, images, BATCH, device).cpu()
    if not logits.isfinite().all():
        fault = "the model returned NaN or infinite logits"
        raise InputError(f"{fault}: evaluate a checkpoint of a run that converged")
    return logits


def rank_classes(
    photographs: Sequence[Photograph], logits: Tensor, classes: Sequence[str], labels: Sequence[str]
) -> Predictions:
    """Convert logits to predicted classes with their probabilities, ranks and log-odds."""
    logits = logits.double()
    probabilities = logits.softmax(dim=1).numpy()
    # Classes are sorted by logits, because small probabilities may all round to 0.
    # Column k of `class_at_rank` has the index of the class with rank k + 1.
    class_at_rank = logits.argsort(dim=1, descending=True, stable=True)
    # The inverse permutation has the rank of each class, from 1, shape (N, C).
    ranks = class_at_rank.argsort(dim=1).numpy() + 1
    predicted = class_at_rank[:, 0].numpy()
    rows = np.arange(len(photographs))
    index_of_class = {name: index for index, name in enumerate(classes)}
    shown = np.array([index_of_class.get(item.label, -1) for item in photographs])
    shared = {
        "photograph": photographs,
        "predicted": [classes[index] for index in predicted],
        "probability": probabilities[rows, predicted],
        "true_probability": np.where(shown < 0, np.nan, probabilities[rows, shown]),
        "true_rank": np.where(shown < 0, np.inf, ranks[rows, shown]),
    }
    by_label = {}
    for label in labels:
        index = index_of_class[label]
        by_label[label] = {
            "label_probability": probabilities[:, index],
            "label_rank": ranks[:, index],
            "log_odds": log_odds(logits, index).numpy(),
        }
    return Predictions.of_labels(shared, by_label)


@dataclass(frozen=True)
class ClassScores:
    """Scores of the photographs of one class, in the order of summary.json.

    Attributes:
        n: Number of photographs of the class.
        recall: Fraction of the photographs whose predicted class is right. It
            is unknown if the model lacks the class.
        most_common_wrong: For each of the most common wrong predictions, the
            number of photographs with this prediction.
    """

    n: int
    recall: Proportion
    most_common_wrong: Mapping[str, int]


@dataclass(frozen=True, repr=False)
class Scores(ShortRepr):
    """Scores of a model on a folder of photographs.

    Attributes:
        predicted: Predictions for the photographs.
        pooled: The same predictions, grouped by label, source, mesh and class.
        points: Operating point of each label. May be empty.
        by: Groups of photographs that are scored in addition: "source", "mesh" or "class".
    """

    predicted: FolderPredictions
    pooled: Pool
    points: Sequence[OperatingPoint]
    by: str

    def __str__(self) -> str:
        """Return the lines that pnb-evaluate prints.

        A Markdown table has a row for each metric of all images, with its 95% interval. The metrics
        in `DETAILS` are left out.
        """
        names = [*_fraction_metrics(self), *RANKING_METRICS]
        shown_names = [name for name in names if name not in DETAILS]
        rows = [(TITLES[name], _format_metric(self.overall.find(name))) for name in shown_names]
        shown = (self.overall.recall, self.overall.false_positive_rate, self.overall.auc)
        title = f"{_count_images(self)}; {tables.describe_intervals(shown)}"
        return "\n".join([str(Table(title, ["metric", self.label], rows)), *_notes(self)])

    @property
    def label(self) -> str:
        """Positive classes in words, such as "orange" or "orange or lemon"."""
        return " or ".join(self.predicted.labels)

    @property
    def overall(self) -> Metrics:
        """Metrics of all photographs. With several labels, one counts once for each label."""
        return self.pooled.metrics

    @cached_property
    def by_label(self) -> dict[str, Metrics]:
        """Metrics of each label. Empty with a single label."""
        return self._metrics_by("label") if len(self.predicted.labels) > 1 else {}

    @cached_property
    def by_source(self) -> dict[str, Metrics]:
        """Metrics of the photographs of each source."""
        return self._metrics_by("source")

    @cached_property
    def groups(self) -> dict[str, Metrics]:
        """Metrics of the photographs of each source, mesh or class, as `by` says."""
        return self._metrics_by(self.by)

    def _metrics_by(self, by: str) -> dict[str, Metrics]:
        """Compute the metrics of groups of photographs."""
        return {name: pool.metrics for name, pool in self.pooled.groups(by).items()}

    @cached_property
    def by_class(self) -> dict[str, ClassScores]:
        """Recall and wrong predictions for the photographs of each class."""
        # The predictions for the first label come first, one for each photograph.
        photographs = self.predicted.predictions[: len(self.predicted.images)]
        scores = {}
        for name, rows in metrics.group_rows(photographs, photographs.shown).items():
            # The rank is infinite for all photographs if the model lacks the class.
            known = rows[np.isfinite(rows.true_rank)]
            wrong_classes = Counter(sorted(rows.predicted[rows.true_rank != 1]))
            most_common_wrong = dict(wrong_classes.most_common(WRONG_CLASSES))
            recall = Outcome(known, known.true_rank <= 1).proportion
            scores[name] = ClassScores(len(rows), recall, most_common_wrong)
        return scores

    @property
    def point_entries(self) -> list[dict[str, Any]]:
        """Operating points as entries of summary.json.

        The value "in_sample" tells whether an operating point was chosen on the
        same images that are scored.
        """
        hashes = self.predicted.hashes
        return [
            asdict(point) | {"in_sample": point.images == hashes.get(point.label)}
            for point in self.points
        ]

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        predicted = self.predicted
        # `by_label` is empty if there is a single label. The file then has no lists for it.
        has_labels = bool(self.by_label)
        groups = {"by_label": self.by_label, "by_source": self.by_source}
        groups[SUMMARY_KEYS[self.by]] = self.groups
        summary: dict[str, Any] = {
            "label": predicted.labels if has_labels else predicted.labels[0],
            "size": as_size("size", predicted.images.shape[-2:]),
            "images": predicted.hashes[""],
            **self.overall.to_summary(),
            "n": {
                "photographs": len(predicted.images),
                "positives": len(self.pooled.positives),
                "negatives": len(self.pooled.negatives),
                "unreadable": len(predicted.unreadable),
                "left_out": len(predicted.left_out),
            },
        }
        if self.points:
            summary["operating_point"] = self.point_entries if has_labels else self.point_entries[0]
        for key, found in groups.items():
            summary[key] = {name: item.to_summary() for name, item in found.items()}
        summary["by_class"] = {name: asdict(scores) for name, scores in self.by_class.items()}
        return summary | {"unreadable": predicted.unreadable, "left_out": predicted.left_out}


def evaluate_photographs(
    predictor: Predictor, folder: Path, label: Label, out: Path, skip_unreadable: bool = False
) -> Scores:
    """Score a model on all photographs of a folder, and write the scores to files."""
    folders.require_outside(out, folder)
    scores = score(predictor.predict(folder, label, skip_unreadable))
    write(scores, out)
    return scores


def score(
    predicted: FolderPredictions, by: str = "source", points: Sequence[OperatingPoint] = ()
) -> Scores:
    """Score predictions for photographs.

    All metrics have 95% intervals. They are over objects if photos.csv names at
    least MIN_OBJECTS of each kind, and otherwise over images, for these objects.
    Intervals of fractions of different objects are Wilson's. All others come
    from a jackknife. `by` is "mesh", "class" or "source"; "source" adds no groups.
    """
    require_choice("by", by, GROUPS)
    if by == "mesh" and not any(item.mesh for item in predicted.predictions.photograph):
        fault = f"by=mesh, but {predicted.folder} has no {TABLE} with a column mesh"
        raise InputError(f"{fault}: add this table, or remove by=mesh")
    pooled = Pool(predicted.predictions, {point.label: point.threshold for point in points})
    return Scores(predicted, pooled, points, by)


def write(scores: Scores, out: Path) -> None:
    """Write scores to the files of a folder.

    - summary.json: all metrics;
    - predictions.csv: a row for each photograph;
    - contact_sheet.png: photographs with right and wrong predictions;
    - roc.csv and roc.png: ROC curves of all images and of each label. With a
      single label, of each source instead.
    """
    predicted = scores.predicted
    predictions.begin_scores(out)
    predictions.write_predictions(out / predictions.PREDICTIONS, predicted.predictions)
    sheet = contact_sheet(predicted.predictions, predicted.images.numpy())
    write_image(out / predictions.CONTACT_SHEET, sheet)
    groups = scores.pooled.groups("label" if len(predicted.labels) > 1 else "source")
    # The log-odds of positives and negatives of all photographs, and of each group.
    pools = {"": scores.pooled, **groups}
    write_roc(out, {name: pool.scores for name, pool in pools.items()}, scores.label)
    predictions.write_summary(out, scores.to_summary())


def choose_operating_points(
    predictor: Predictor, calibrate: Path, label: Label, rate: float, skip_unreadable: bool = False
) -> list[OperatingPoint]:
    """Choose a threshold on the log-odds of each label for a given false-positive rate.

    The threshold is the log-odds of a negative. It is the lowest of these
    values at which the false-positive rate is at most `rate`. With rate 0.1 and
    20 negatives, at most 2 negatives score above the threshold. Fewer than 1 / `rate` negatives
    raise InputError.
    """
    folder = published_folder(calibrate)
    predicted = predictor.predict(folder, label, skip_unreadable)
    exact_rate = Fraction(str(rate))
    points = []
    for name, rows in predicted.predictions.by_label.items():
        log_odds = rows.log_odds[~rows.positive]
        count = len(log_odds)
        # With fewer than 1 / rate negatives, not even one may score above the threshold.
        if count * exact_rate < 1:
            advice = f"give at least {math.ceil(1 / exact_rate)} for false_positive_rate={rate}"
            fault = f"calibrate={folder} has {count} negatives for {name}"
            raise InputError(f"{fault}: {advice}", "calibrate")
        (threshold,) = thresholds(log_odds, np.ones(count, int), [str(rate)])
        # Half-way to the next score, rounding in another precision does not exceed the threshold.
        higher = rows.log_odds[rows.log_odds > threshold]
        if len(higher):
            threshold = (threshold + higher.min()) / 2
        chosen_on = (folder.resolve().name, predicted.hashes[name], count)
        points.append(OperatingPoint(name, float(threshold), rate, *chosen_on))
    return points


def format_scores(scores: Scores) -> str:
    """Format scores as Markdown tables, with a row for each label and each source or mesh."""
    names = [*_fraction_metrics(scores), *RANKING_METRICS]
    groups = [("all", scores.overall), *scores.by_label.items(), *scores.groups.items()]
    rows = [[title, *map(of_group.find, names)] for title, of_group in groups]
    table = tables.table_of("", ["", *(TITLES[name] for name in names)], rows, _format_metric)
    parts = [_count_images(scores), table, _class_table(scores), *_notes(scores)]
    return "\n\n".join(map(str, parts))


def _count_images(scores: Scores) -> str:
    """Say how many positive and negative images were scored."""
    positives, negatives = len(scores.pooled.positives), len(scores.pooled.negatives)
    each = metrics.COUNTED_EACH if scores.by_label else ""
    return f"{positives} images of {scores.label}, {negatives} negatives{each}"


def _fraction_metrics(scores: Scores) -> list[str]:
    """Return the known metrics that are fractions of images, such as recall."""
    return [name for name in metrics.FRACTION_METRICS if scores.overall.find(name) is not None]


def _format_metric(metric: Estimate | None) -> str:
    """Write a fraction of images with its counts, and any other metric with its interval."""
    if isinstance(metric, Proportion):
        return tables.format_fraction(metric)
    return tables.format_interval(metric)


def _class_table(scores: Scores) -> Table:
    """Make a table of recall and wrong predictions with a row for each class of photographs."""
    rows = []
    for name, item in scores.by_class.items():
        wrong = ", ".join(f"{wrong} {count}" for wrong, count in item.most_common_wrong.items())
        rows.append([name, tables.format_fraction(item.recall), wrong])
    return Table("", ["class", "recall", "most common wrong classes"], rows)


def _notes(scores: Scores) -> Iterator[str]:
    """Yield a sentence for each threshold, and sentences about files that were not scored."""
    for point in scores.point_entries:
        label = f" of {point['label']}" if scores.by_label else ""
        threshold = f"threshold {point['threshold']:.3f} on the log-odds{label}"
        yield f"{threshold}, chosen for {metrics.describe_point(point)}"
    if unreadable := scores.predicted.unreadable:
        yield f"{len(unreadable)} unreadable: {', '.join(unreadable)}"
    if files := scores.predicted.left_out:
        yield f"{len(files)} left out, of kinds that are not read, like {files[0]}"
