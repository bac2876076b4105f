"""Scores of a model on a folder of photographs, in files and as text.

`evaluate_photographs` goes through the three steps: `Predictor.predict`,
`score` and `write`.
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

from augment.classifiers.adapter import Label, OperatingPoint
from augment.progress import progress
from renderer.errors import InputError, require_choice
from renderer.io.files import atomic_write, remove_unfinished
from renderer.io.images import write_image
from renderer.validation import as_folder
from train.data.photographs import TABLE, require_outside
from train.evaluation.scores.metrics import (
    COUNTED,
    RANKED,
    TOP_RANKS,
    Metrics,
    Pool,
    Pooled,
    metric_title,
    thresholds,
)
from train.evaluation.scores.predictions import (
    PREDICTIONS,
    FolderPredictions,
    Prediction,
    Predictor,
    write_predictions,
)
from train.evaluation.scores.sheet import contact_sheet, write_roc
from train.evaluation.tables import Proportion, Table, format_fraction, format_interval, fraction
from train.settings import GROUPS

SUMMARY = "summary.json"
CONTACT_SHEET = "contact_sheet.png"
# Number of wrong classes that are named for each class, the most common ones.
WRONG_CLASSES = 5
# Words after the number of negatives, if there are several labels.
COUNTED_EACH = ", once for each of these classes"
# Metrics that the table of all images leaves out. `format_scores` shows them.
DETAILS = ("top5", "recall_at/0.05", "recall_at/0.20")


@dataclass(frozen=True)
class ClassScores:
    """Scores of the photographs of one class, in the order of summary.json.

    Attributes:
        n: Number of photographs.
        recall: Fraction of them that are predicted as their class. It is
            unknown if the model lacks the class.
        top5: Fraction whose class is among the five most probable classes.
        predicted_label: Fraction that is predicted as a positive class.
        most_common_wrong: Number of photographs by the wrong class that they
            are predicted as, for the most common of these classes.
    """

    n: int
    recall: Proportion
    top5: Proportion
    predicted_label: Proportion
    most_common_wrong: Mapping[str, int]


@dataclass(frozen=True)
class Scores:
    """Scores of a model on a folder of photographs.

    Attributes:
        predicted: Predictions that are scored.
        pooled: Pools of these predictions.
        points: Operating point of each label, or none.
        overall: Metrics of all photographs. With several labels, a photograph
            counts once for each of them.
        by_label: Metrics of each label. Empty with a single label.
        by_source: Metrics of each source.
        by_mesh: Metrics of each mesh. None if they were not asked for.
        by_class: Scores of the photographs of each class.
        class_metrics: Metrics of each class. None if they were not asked for.
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

    @property
    def label(self) -> str:
        """Positive classes in words, such as "orange" or "orange or lemon"."""
        return " or ".join(self.predicted.labels)

    @property
    def point_entries(self) -> list[dict[str, Any]]:
        """Convert the operating points to entries of summary.json.

        The entry "in_sample" says whether a point was chosen on the very images
        that are scored.
        """
        images_hash = self.predicted.images_hash
        return [asdict(point) | {"in_sample": point.images == images_hash} for point in self.points]

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json.

        Returns:
            Dictionary with these keys:
            - label, size, images: positive classes, pixels per side, and
              hash of the photographs;
            - n: numbers of photographs, positives, negatives, unreadable files
              and files that were left out;
            - the fields of `Metrics` for all photographs;
            - operating_point: the operating point, if there is one. It is a
              list if there are several labels;
            - by_label, by_source, by_mesh: fields of `Metrics` by name. The
              first is there with several labels, the last if it was asked for;
            - by_class: fields of `ClassScores` by class;
            - class_metrics: fields of `Metrics` by class, if they were asked for;
            - unreadable, left_out: paths of these files.
        """
        predicted = self.predicted
        has_several = len(predicted.labels) > 1
        summary: dict[str, Any] = {
            "label": predicted.labels if has_several else predicted.labels[0],
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
            summary["operating_point"] = entries if has_several else entries[0]
        if has_several:
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
    """Convert metrics to entries of summary.json.

    Args:
        metrics_by_name: Metrics by the name of a label, source, mesh or class.

    Returns:
        Entries by the same names.
    """
    return {name: metrics.to_summary() for name, metrics in metrics_by_name.items()}


def evaluate_photographs(
    predictor: Predictor,
    folder: Path,
    label: Label,
    out: Path,
    skip_unreadable: bool = False,
) -> Scores:
    """Score a model on every photograph of a folder, and write the scores.

    Args:
        predictor: Model that is scored.
        folder: Folder of photographs, as `find_photographs` takes it.
        label: Positive class, or several.
        out: Folder that `write` writes to. It must lie outside `folder`.
        skip_unreadable: Whether to leave out photographs that cannot be read.
            Otherwise they are an error.

    Returns:
        Scores, with intervals.

    Raises:
        InputError: See `Predictor.predict`. Also if `out` is inside `folder`.
    """
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

    Fractions have 95% Wilson intervals. The AUC, the recall at a
    false-positive rate and the means over classes have bootstrap intervals over
    images and, where photos.csv names them, over objects.

    Args:
        predicted: Predictions for the photographs of a folder.
        by: "mesh" to score each mesh, too, "class" to score each class in the
            same metrics. Otherwise "source".
        points: Operating point of each label, or none.

    Returns:
        Scores of all photographs, and of each label, source, mesh and class.

    Raises:
        InputError: If `by` is none of these, or if it is "mesh" and no mesh is known.
    """
    require_choice("by", by, GROUPS)
    if by == "mesh" and not any(item.photograph.mesh for item in predicted.predictions):
        raise InputError(
            f"by=mesh: {predicted.folder} has no {TABLE} with a column mesh: leave it out",
        )
    limits = {point.label: point.threshold for point in points}
    pooled = Pooled(predicted.predictions, thresholds=limits)
    has_several = len(predicted.labels) > 1
    return Scores(
        predicted=predicted,
        pooled=pooled,
        points=points,
        overall=pooled.all.metrics,
        by_label=_metrics_of(pooled.by_label) if has_several else {},
        by_source=_metrics_of(pooled.by_source),
        by_mesh=_metrics_of(pooled.by_mesh) if by == "mesh" else None,
        by_class=_score_classes(predicted),
        class_metrics=_metrics_of(pooled.by_class) if by == "class" else None,
    )


def _metrics_of(pools: Mapping[str, Pool]) -> dict[str, Metrics]:
    """Compute the metrics of each pool by its name. The bootstrap intervals take a while."""
    return {name: pool.metrics for name, pool in progress(pools.items(), "intervals")}


def _score_classes(predicted: FolderPredictions) -> dict[str, ClassScores]:
    """Score the photographs of each class that the folder has.

    Returns:
        Scores by the name of the class, in alphabetical order.
    """
    by_class: dict[str, list[Prediction]] = {}
    for prediction in predicted.photographs:
        by_class.setdefault(prediction.photograph.label, []).append(prediction)
    return {name: _score_class(by_class[name], predicted.labels) for name in sorted(by_class)}


def _score_class(predictions: Sequence[Prediction], labels: Sequence[str]) -> ClassScores:
    """Score the photographs of one class.

    Args:
        predictions: One prediction for each photograph of the class.
        labels: Positive classes.
    """
    # The rank is None if the model lacks the class.
    ranks = [item.true_rank for item in predictions if item.true_rank is not None]
    wrong = Counter(sorted(item.predicted for item in predictions if item.true_rank != 1))
    predicted_label = [item.predicted in labels for item in predictions]
    return ClassScores(
        n=len(predictions),
        recall=fraction(ranks.count(1), len(ranks)),
        top5=fraction(sum(rank <= 5 for rank in ranks), len(ranks)),
        predicted_label=fraction(sum(predicted_label), len(predictions)),
        most_common_wrong=dict(wrong.most_common(WRONG_CLASSES)),
    )


def write(scores: Scores, out: Path) -> None:
    """Write scores into a folder.

    The files are summary.json; predictions.csv, with a row per photograph;
    contact_sheet.png; and roc.csv and roc.png with the ROC curves of all images
    and of each label or, with one label, each source.

    Args:
        scores: Scores of a model on photographs.
        out: Folder, which is made if it does not exist.
    """
    predicted = scores.predicted
    out.mkdir(parents=True, exist_ok=True)
    remove_unfinished(out)
    write_predictions(out / PREDICTIONS, predicted.predictions)
    text = json.dumps(scores.to_summary(), indent=2, ensure_ascii=False, allow_nan=False)
    atomic_write(out / SUMMARY, text + "\n")
    write_image(out / CONTACT_SHEET, contact_sheet(predicted.predictions, predicted.images))
    pooled = scores.pooled
    groups = pooled.by_label if len(predicted.labels) > 1 else pooled.by_source
    curves = {name: pool.scores for name, pool in groups.items()}
    write_roc(out, pooled.all.scores, curves, scores.label)


def choose_operating_points(
    predictor: Predictor,
    folder: Path,
    label: Label,
    rate: float,
    skip_unreadable: bool = False,
) -> list[OperatingPoint]:
    """Choose a threshold on the log-odds of each label for a false-positive rate.

    The threshold is the lowest log-odds of a negative at which the
    false-positive rate is at most `rate`. With rate 0.1 and 20 negatives, at
    most 2 negatives score above the threshold.

    Args:
        predictor: Model whose threshold is chosen.
        folder: Folder of photographs, as `find_photographs` takes it.
        label: Positive class, or several.
        rate: False-positive rate, in (0, 1).
        skip_unreadable: Whether to leave out photographs that cannot be read.

    Returns:
        Operating point of each label.

    Raises:
        InputError: See `Predictor.predict`. Also if the folder has fewer than
            1 / rate negatives.
    """
    predicted = predictor.predict(folder, label, skip_unreadable)
    exact_rate = Fraction(str(rate))
    points = []
    for name in predicted.labels:
        predictions = [item for item in predicted.predictions if item.label == name]
        log_odds = np.array([item.log_odds for item in predictions if not item.positive])
        count = len(log_odds)
        if count * exact_rate < 1:
            fault = f"folder={folder} has {count} negatives for {name}"
            least = math.ceil(1 / exact_rate)
            raise InputError(
                f"{fault}: give at least {least} for false_positive_rate={rate}",
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
    """Return the operating points of a summary as a list, which may be empty.

    Args:
        summary: Content of summary.json, which holds no point, one point or a
            list with a point for each label.
    """
    chosen = summary.get("operating_point", [])
    return chosen if isinstance(chosen, list) else [chosen]


def describe_point(point: Mapping[str, Any]) -> str:
    """Describe the false-positive rate and the images for which an operating point was chosen.

    Args:
        point: Entry `operating_point` of a summary.

    Returns:
        Text such as "5.0% FPR on photographs, 120 negatives".
    """
    images = f"{point['folder']}, {point['negatives']} negatives"
    if point.get("in_sample"):
        images = "these very images, in-sample"
    return f"{point['false_positive_rate']:.1%} FPR on {images}"


def format_scores(scores: Scores) -> str:
    """Write scores as Markdown tables, by mesh or by source.

    Args:
        scores: Scores of a model on photographs.

    Returns:
        Paragraphs without a newline at the end.
    """
    positives = len(scores.pooled.all.positives)
    negatives = len(scores.pooled.all.negatives)
    each = COUNTED_EACH if scores.by_label else ""
    paragraphs = [
        f"{positives} images of {scores.label}, {negatives} negatives{each}",
        str(_counted_table(scores)),
        str(_ranked_table(scores)),
        str(_class_table(scores)),
        *_notes(scores),
    ]
    return "\n\n".join(paragraphs)


def format_overall(scores: Scores) -> str:
    """Write the scores of all images as one Markdown table, with 95 % intervals.

    Args:
        scores: Scores of a model on photographs.

    Returns:
        The table below a line that counts the images, and notes about thresholds and files.
        The metrics in `DETAILS` are left out.
    """
    positives = len(scores.pooled.all.positives)
    negatives = len(scores.pooled.all.negatives)
    title = f"{positives} images of {scores.label}, {negatives} negatives"
    rows = []
    for table in (_counted_table(scores), _ranked_table(scores)):
        rows += list(zip(table.header[1:], table.rows[0][1:], strict=True))
    details = {metric_title(name) for name in DETAILS}
    rows = [row for row in rows if row[0] not in details]
    table = Table(f"{title}; 95 % intervals", ["metric", scores.label], rows)
    return "\n".join([str(table), *_notes(scores)])


def _rows_of(scores: Scores) -> Iterator[tuple[str, Metrics]]:
    """Yield the title and the metrics of each row of a table.

    The rows are all images, each label, and then each mesh, class or source.
    """
    yield "all", scores.overall
    yield from scores.by_label.items()
    groups = scores.by_mesh or scores.class_metrics or scores.by_source
    yield from groups.items()


def _counted_table(scores: Scores) -> Table:
    """Make the table of the metrics that are fractions of images."""
    counted = [name for name in COUNTED if scores.overall.find(name) is not None]
    rows = []
    for title, metrics in _rows_of(scores):
        proportions: list[Proportion] = [getattr(metrics, name) for name in counted]
        rows.append([title, *map(format_fraction, proportions)])
    return Table("95 % intervals over images", ["", *map(metric_title, counted)], rows)


def _ranked_table(scores: Scores) -> Table:
    """Make the table of the metrics with bootstrap intervals.

    The title says whether the bootstrap draws images alone, or objects and
    images.
    """
    auc = scores.overall.auc
    resampled_metrics = (*RANKED, *TOP_RANKS)
    resampled = "images"
    if auc.has_repeated_objects:
        counts = (
            f"{auc.positive_objects} of {scores.label} and {auc.negative_objects} hard negatives"
        )
        resampled = f"objects and images ({counts})"
    rows = []
    for title, metrics in _rows_of(scores):
        rows.append([title, *(format_interval(metrics.find(name)) for name in resampled_metrics)])
    header = ["", *map(metric_title, resampled_metrics)]
    return Table(f"95 % intervals over {resampled}", header, rows)


def _class_table(scores: Scores) -> Table:
    """Make the table of recall, top-5 and wrong predictions, with a row for each class."""
    header = ["class", "recall", "top-5", f"predicted {scores.label}", "most common wrong classes"]
    rows = []
    for name, part in scores.by_class.items():
        proportions = (part.recall, part.top5, part.predicted_label)
        wrong = ", ".join(f"{other} {count}" for other, count in part.most_common_wrong.items())
        rows.append([name, *map(format_fraction, proportions), wrong])
    return Table("", header, rows)


def _notes(scores: Scores) -> Iterator[str]:
    """Yield a sentence for each threshold, and for the files that were not scored."""
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
