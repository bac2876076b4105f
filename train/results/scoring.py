"""Scores of a model on a folder of photographs, as files and as text.

`evaluate_photographs` has three steps: `Predictor.predict` classifies the
photographs, `score` computes metrics, and `write` writes them to files.

A label is the name of a positive class. The operating point of a label is a
threshold on its log-odds. An image above the threshold counts as detected.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from augment.network import Label, OperatingPoint
from augment.progress import progress
from renderer.errors import InputError, require_choice
from renderer.io.files import atomic_write, remove_unfinished
from renderer.io.images import write_image
from renderer.short_repr import ShortRepr
from renderer.validation import as_folder
from train.data.photographs import TABLE, require_outside
from train.results.metrics import (
    FRACTION_METRICS,
    ROC_METRICS,
    TOP_RANKS,
    Metrics,
    Outcome,
    Pool,
    Pooled,
    metric_title,
    thresholds,
    within_rank,
)
from train.results.predictions import (
    PREDICTIONS,
    FolderPredictions,
    Prediction,
    Predictor,
    write_predictions,
)
from train.results.sheet import contact_sheet, write_roc
from train.results.tables import (
    Estimate,
    Proportion,
    Table,
    describe_intervals,
    format_fraction,
    format_interval,
)
from train.settings import GROUPS

SUMMARY = "summary.json"
CONTACT_SHEET = "contact_sheet.png"
# Number of wrong predictions that are listed for the images of each class: the 5 most
# common ones.
WRONG_CLASSES = 5
# Words after the number of negatives, if there are several positive classes.
COUNTED_EACH = ", once for each of these classes"
# Metrics that `format_overall` leaves out, because they matter less.
DETAILS = ("top5", "recall_at/0.05", "recall_at/0.20")


@dataclass(frozen=True)
class ClassScores:
    """Scores of the photographs of one class, in the order of summary.json.

    Attributes:
        n: Number of photographs of the class.
        recall: Fraction of the photographs whose predicted class is right. It
            is unknown if the model lacks the class.
        top5: Fraction of the photographs whose class is among the five most
            probable classes. It is unknown if the model lacks the class.
        predicted_label: Fraction of the photographs whose predicted class is a
            positive class.
        most_common_wrong: For each of the most common wrong predictions, the
            number of photographs with this prediction.
    """

    n: int
    recall: Proportion
    top5: Proportion
    predicted_label: Proportion
    most_common_wrong: Mapping[str, int]


@dataclass(frozen=True, repr=False)
class Scores(ShortRepr):
    """Scores of a model on a folder of photographs.

    Attributes:
        predicted: Predictions for the photographs.
        pooled: The same predictions, grouped by label, source, mesh and class.
        points: Operating point of each label. May be empty.
        overall: Metrics of all photographs. With several labels, a photograph
            counts once for each label.
        by_label: Metrics of each label. Empty with a single label.
        by_source: Metrics of the photographs of each source.
        by_mesh: Metrics of the photographs of each mesh. None if `score` was
            not called with by="mesh".
        by_class: Recall and wrong predictions for the photographs of each
            class.
        class_metrics: Metrics of the photographs of each class. None if `score`
            was not called with by="class".
    """

    predicted: FolderPredictions
    pooled: Pooled
    points: Sequence[OperatingPoint]
    overall: Metrics
    by_label: Mapping[str, Metrics]
    by_source: Mapping[str, Metrics]
    by_mesh: Mapping[str, Metrics] | None
    by_class: Mapping[str, ClassScores]
    class_metrics: Mapping[str, Metrics] | None = None

    def __str__(self) -> str:
        """Return the lines that pnb-evaluate prints."""
        return format_overall(self)

    @property
    def label(self) -> str:
        """Positive classes in words, such as "orange" or "orange or lemon"."""
        return " or ".join(self.predicted.labels)

    @property
    def point_entries(self) -> list[dict[str, Any]]:
        """Operating points as entries of summary.json.

        The value "in_sample" tells whether an operating point was chosen on the
        same images that are scored.
        """
        images_hash = self.predicted.images_hash
        return [asdict(point) | {"in_sample": point.images == images_hash} for point in self.points]

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        predicted = self.predicted
        has_several_labels = len(predicted.labels) > 1
        summary: dict[str, Any] = {
            "label": predicted.labels if has_several_labels else predicted.labels[0],
            "size": predicted.size,
            "images": predicted.images_hash,
        }
        summary |= self.overall.to_summary()
        summary["n"] = {
            "photographs": len(predicted.photographs),
            "positives": len(self.pooled.all.positives),
            "negatives": len(self.pooled.all.negatives),
            "unreadable": len(predicted.unreadable),
            "left_out": len(predicted.left_out),
        }
        if self.points:
            entries = self.point_entries
            summary["operating_point"] = entries if has_several_labels else entries[0]
        if has_several_labels:
            summary["by_label"] = _entries(self.by_label)
        summary["by_source"] = _entries(self.by_source)
        if self.by_mesh is not None:
            summary["by_mesh"] = _entries(self.by_mesh)
        summary["by_class"] = {name: asdict(scores) for name, scores in self.by_class.items()}
        if self.class_metrics is not None:
            summary["class_metrics"] = _entries(self.class_metrics)
        summary["unreadable"] = predicted.unreadable
        summary["left_out"] = predicted.left_out
        return summary


def _entries(metrics_by_name: Mapping[str, Metrics]) -> dict[str, dict[str, Any]]:
    """Convert the metrics of several groups to entries of summary.json."""
    return {name: metrics.to_summary() for name, metrics in metrics_by_name.items()}


def evaluate_photographs(
    predictor: Predictor,
    folder: Path,
    label: Label,
    out: Path,
    skip_unreadable: bool = False,
) -> Scores:
    """Score a model on all photographs of a folder, and write the scores to files."""
    folder = as_folder("folder", folder)
    out = as_folder("out", out)
    require_outside(out, folder)
    predicted = predictor.predict(folder, label, skip_unreadable)
    scores = score(predicted)
    write(scores, out)
    return scores


def score(
    predicted: FolderPredictions,
    by: str = "source",
    points: Sequence[OperatingPoint] = (),
) -> Scores:
    """Score predictions for photographs.

    All metrics have 95% intervals. They are over objects if photos.csv names at
    least MIN_OBJECTS of each kind, and otherwise over images, for these objects.
    Intervals of fractions of different objects are Wilson's. All others come
    from a jackknife. `by` is "mesh", "class" or "source"; "source" adds no groups.
    """
    require_choice("by", by, GROUPS)
    if by == "mesh" and not any(item.photograph.mesh for item in predicted.predictions):
        raise InputError(
            f"by=mesh needs the meshes of the photographs, but {predicted.folder} has no "
            f"{TABLE} with a column mesh: add this table, or remove by=mesh",
        )
    thresholds_by_label = {point.label: point.threshold for point in points}
    pooled = Pooled(predicted.predictions, thresholds=thresholds_by_label)
    has_several_labels = len(predicted.labels) > 1
    return Scores(
        predicted=predicted,
        pooled=pooled,
        points=points,
        overall=pooled.all.metrics,
        by_label=_metrics_of(pooled.by_label) if has_several_labels else {},
        by_source=_metrics_of(pooled.by_source),
        by_mesh=_metrics_of(pooled.by_mesh) if by == "mesh" else None,
        by_class=_score_classes(predicted),
        class_metrics=_metrics_of(pooled.by_class) if by == "class" else None,
    )


def _metrics_of(pools: Mapping[str, Pool]) -> dict[str, Metrics]:
    """Compute the metrics of several groups of predictions, and show the progress."""
    return {name: pool.metrics for name, pool in progress(pools.items(), "intervals")}


def _score_classes(predicted: FolderPredictions) -> dict[str, ClassScores]:
    """Score the photographs of each class in a folder separately."""
    predictions_by_class: dict[str, list[Prediction]] = {}
    for prediction in predicted.photographs:
        predictions_by_class.setdefault(prediction.photograph.label, []).append(prediction)
    scores = {}
    for name in sorted(predictions_by_class):
        scores[name] = _score_class(predictions_by_class[name], predicted.labels)
    return scores


def _score_class(predictions: Sequence[Prediction], labels: Sequence[str]) -> ClassScores:
    """Score the photographs of one class."""
    # `true_rank` is None for all photographs if the model lacks the class.
    known = [item for item in predictions if item.true_rank is not None]
    wrong_classes = Counter(sorted(item.predicted for item in predictions if item.true_rank != 1))
    is_predicted_label = [item.predicted in labels for item in predictions]
    return ClassScores(
        n=len(predictions),
        recall=within_rank(known, 1).proportion,
        top5=within_rank(known, 5).proportion,
        predicted_label=Outcome(predictions, is_predicted_label).proportion,
        most_common_wrong=dict(wrong_classes.most_common(WRONG_CLASSES)),
    )


def write(scores: Scores, out: Path) -> None:
    """Write scores to the files of a folder.

    - summary.json: all metrics;
    - predictions.csv: a row for each photograph;
    - contact_sheet.png: photographs with right and wrong predictions;
    - roc.csv and roc.png: ROC curves of all images and of each label. With a
      single label, of each source instead.
    """
    predicted = scores.predicted
    out.mkdir(parents=True, exist_ok=True)
    remove_unfinished(out)
    # Without a summary, no folder counts as scored.
    (out / SUMMARY).unlink(missing_ok=True)
    write_predictions(out / PREDICTIONS, predicted.predictions)
    write_image(out / CONTACT_SHEET, contact_sheet(predicted.predictions, predicted.images))
    pooled = scores.pooled
    groups = pooled.by_label if len(predicted.labels) > 1 else pooled.by_source
    curves = {name: pool.scores for name, pool in groups.items()}
    write_roc(out, pooled.all.scores, curves, scores.label)
    text = json.dumps(scores.to_summary(), indent=2, ensure_ascii=False, allow_nan=False)
    atomic_write(out / SUMMARY, text + "\n")


def choose_operating_points(
    predictor: Predictor,
    folder: Path,
    label: Label,
    rate: float,
    skip_unreadable: bool = False,
) -> list[OperatingPoint]:
    """Choose a threshold on the log-odds of each label for a given false-positive rate.

    The threshold is the log-odds of a negative. It is the lowest of these
    values at which the false-positive rate is at most `rate`. With rate 0.1 and
    20 negatives, at most 2 negatives score above the threshold. Fewer than 1 / `rate` negatives
    raise InputError.
    """
    predicted = predictor.predict(folder, label, skip_unreadable)
    exact_rate = Fraction(str(rate))
    points = []
    for name in predicted.labels:
        predictions = [item for item in predicted.predictions if item.label == name]
        log_odds = np.array([item.log_odds for item in predictions if not item.positive])
        count = len(log_odds)
        if count * exact_rate < 1:
            min_count = math.ceil(1 / exact_rate)
            raise InputError(
                f"folder={folder} has {count} negatives for {name}: "
                f"give at least {min_count} for false_positive_rate={rate}",
                "folder",
            )
        (threshold,) = thresholds(log_odds, np.ones(count, int), [str(rate)])
        points.append(
            OperatingPoint(
                label=name,
                threshold=float(threshold),
                false_positive_rate=rate,
                folder=folder.resolve().name,
                images=predicted.images_hash,
                negatives=count,
            )
        )
    return points


def operating_points(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Read the operating points in the content of summary.json."""
    entry = summary.get("operating_point", [])
    return entry if isinstance(entry, list) else [entry]


def describe_point(point: Mapping[str, Any]) -> str:
    """Describe for which false-positive rate and on which images an operating point was chosen."""
    images = f"{point['folder']}, {point['negatives']} negatives"
    if point.get("in_sample"):
        images = "these very images, in-sample"
    return f"{point['false_positive_rate']:.1%} FPR on {images}"


def format_scores(scores: Scores) -> str:
    """Format scores as Markdown tables, with a row for each label and each source or mesh."""
    paragraphs = [
        _count_images(scores),
        str(_fraction_table(scores)),
        str(_ranking_table(scores)),
        str(_class_table(scores)),
        *_notes(scores),
    ]
    return "\n\n".join(paragraphs)


def _count_images(scores: Scores) -> str:
    """Say how many positive and negative images were scored."""
    positives = len(scores.pooled.all.positives)
    negatives = len(scores.pooled.all.negatives)
    each = COUNTED_EACH if scores.by_label else ""
    return f"{positives} images of {scores.label}, {negatives} negatives{each}"


def format_overall(scores: Scores) -> str:
    """Format the metrics of all images as one Markdown table, with 95% intervals.

    The table has a row for each metric. The metrics in `DETAILS` are left out.
    """
    details = {metric_title(name) for name in DETAILS}
    rows = []
    for table in (_fraction_table(scores), _ranking_table(scores)):
        # The first row is about all images. Its first cell is the title of the row.
        metric_titles = table.header[1:]
        cells = table.rows[0][1:]
        for metric, cell in zip(metric_titles, cells, strict=True):
            if metric not in details:
                rows.append((metric, cell))
    overall = scores.overall
    intervals = describe_intervals([overall.recall, overall.false_positive_rate, overall.auc])
    overall_table = Table(f"{_count_images(scores)}; {intervals}", ["metric", scores.label], rows)
    return "\n".join([str(overall_table), *_notes(scores)])


def _metrics_of_rows(scores: Scores) -> Iterator[tuple[str, Metrics]]:
    """Yield the title and the metrics of each row of a table of scores.

    The first row is about all images. Rows about each label follow, and then
    rows about each mesh, each class or each source.
    """
    yield "all", scores.overall
    yield from scores.by_label.items()
    groups = scores.by_mesh or scores.class_metrics or scores.by_source
    yield from groups.items()


def _fraction_table(scores: Scores) -> Table:
    """Make the table of the metrics that are fractions of images, such as recall."""
    names = [name for name in FRACTION_METRICS if scores.overall.find(name) is not None]
    rows = []
    shown: list[Proportion] = []
    for title, metrics in _metrics_of_rows(scores):
        proportions: list[Proportion] = [getattr(metrics, name) for name in names]
        shown += proportions
        rows.append([title, *map(format_fraction, proportions)])
    return Table(describe_intervals(shown), ["", *map(metric_title, names)], rows)


def _ranking_table(scores: Scores) -> Table:
    """Make the table of the metrics that depend on a ranking of images or classes."""
    names = (*ROC_METRICS, *TOP_RANKS)
    rows = []
    shown: list[Estimate | None] = []
    for title, metrics in _metrics_of_rows(scores):
        estimates = [metrics.find(name) for name in names]
        shown += estimates
        rows.append([title, *map(format_interval, estimates)])
    return Table(describe_intervals(shown), ["", *map(metric_title, names)], rows)


def _class_table(scores: Scores) -> Table:
    """Make a table of recall and wrong predictions with a row for each class of photographs."""
    header = ["class", "recall", "top-5", f"predicted {scores.label}", "most common wrong classes"]
    rows = []
    for name, of_class in scores.by_class.items():
        proportions = (of_class.recall, of_class.top5, of_class.predicted_label)
        wrong_counts = of_class.most_common_wrong.items()
        wrong = ", ".join(f"{wrong_class} {count}" for wrong_class, count in wrong_counts)
        rows.append([name, *map(format_fraction, proportions), wrong])
    return Table("", header, rows)


def _notes(scores: Scores) -> Iterator[str]:
    """Yield a sentence for each threshold, and sentences about files that were not scored."""
    for point in scores.point_entries:
        label = f" of {point['label']}" if scores.by_label else ""
        threshold = f"threshold {point['threshold']:.3f} on the log-odds{label}"
        yield f"{threshold}, chosen for {describe_point(point)}"
    unreadable = scores.predicted.unreadable
    if unreadable:
        yield f"{len(unreadable)} unreadable: {', '.join(unreadable)}"
    files = scores.predicted.left_out
    if files:
        yield f"{len(files)} left out, of kinds that are not read, like {files[0]}"
