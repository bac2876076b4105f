"""Score a model on a folder of photographs: recall and false positives of one class, in files and as text."""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.classifiers.adapter import Label, OperatingPoint, as_class_names, label_names
from augment.progress import progress
from renderer.errors import InputError, require_choice, require_range
from renderer.image import LARGEST_SIZE
from renderer.io.files import remove_unfinished, write_whole
from renderer.io.images import write_image
from renderer.validation import as_folder, require_kind, require_whole
from train.photographs.folder import TABLE, find_photographs, left_out, load_photographs, require_outside
from train.photographs.metrics import OVERALL, RANKED, find_metric, metric_title, pool_by, resampled, thresholds
from train.photographs.predictions import PREDICTIONS, Model, Prediction, compute_logits, predict, write_predictions
from train.photographs.sheet import contact_sheet, write_roc
from train.tables import Table, format_fraction, format_interval, fraction

SUMMARY, CONTACT_SHEET = "summary.json", "contact_sheet.png"
WRONG_CLASSES = 5  # the most common ones, which are named
COUNTED = ("recall", "top5", "false_positive_rate", "recall_at_threshold", "false_positive_rate_at_threshold")
BY_CLASS = ("recall", "top5", "predicted_label")
COUNTED_EACH = ", once for each of these classes"  # after the number of other things, with several labels
Device = str | torch.device


def predict_folder(
    model: Model,
    classes: Sequence[str],
    folder: Path,
    label: Label,
    size: int,
    skip: bool = False,
    device: Device = "cpu",
) -> tuple[list[Prediction], torch.Tensor, list[str], str]:
    """A folder's predictions, its images (N, 3, size, size), the paths of unreadable ones, and a hash of it all.
    Arguments and InputError: see `evaluate_photographs`."""
    require_kind("model", model, Callable, "a torch.nn.Module, or a function from images to logits")
    folder, classes = as_folder("folder", folder), as_class_names("classes", classes)
    require_whole("size", size)
    require_range("size", size, 1, LARGEST_SIZE)
    found = find_photographs(folder, classes, label)
    photographs, images, unreadable = load_photographs(folder, found, size, skip)
    logits = compute_logits(model, images, len(classes), device)
    labels = label_names(label)
    digest = hashlib.sha256("\n".join(labels).encode())
    for photograph in photographs:
        content = (folder / photograph.path).read_bytes()
        digest.update(f"{photograph}{photograph.mesh or ''}".encode() + content)
    return predict(photographs, logits, classes, labels), images, unreadable, digest.hexdigest()


def evaluate_photographs(
    model: Model,
    classes: Sequence[str],
    folder: Path,
    label: Label,
    out: Path,
    size: int = 32,
    skip_unreadable: bool = False,
    device: Device = "cpu",
    by: str = "source",
    points: Sequence[OperatingPoint] = (),
) -> dict[str, Any]:
    """Evaluate the model on every photograph of a folder; write the results, and return the summary.

    model, on `device`, takes (N, 3, size, size) float32 sRGB in [0, 1] and returns logits (N, len(classes)); a module
    is called in eval mode and left in its own. folder, label: see `find_photographs`. points: of every label, or none.

    Written into `out`: predictions.csv, a row per photograph; contact_sheet.png; roc.csv and roc.png, the ROC curves
    overall and of each source that has positives and negatives; and summary.json, which is also returned:

    - images: a hash of `label` and the photographs, equal where the metrics of two networks can be compared;
    - n: photographs, positives, negatives, unreadable, left_out; label; size; unreadable, left_out: their paths;
    - recall, top5: of the photographs of class `label`;
    - false_positive_rate: the fraction of all others that are predicted as `label`;
    - auc, recall_at: how well the log-odds of `label` separate its photographs from all others (`Pool.metrics`);
    - recall_at_threshold, false_positive_rate_at_threshold: at an operating point of `label`, where one is given; and
      operating_point, its fields, and in_sample: whether it was chosen on these very images;
    - by_label, where `label` names several classes: these metrics of each. The others are then pooled (see `Pool`), and
      operating_point is a list of one for each;
    - by_source, and by_mesh with by="mesh": n, and the metrics above of each known source or mesh (`pool_by`);
    - by_class: n, recall, top5, predicted_label (the fraction predicted as `label`) and most_common_wrong.

    Fractions have 95 % Wilson intervals, `auc` and `recall_at` bootstrap intervals over images and, where photos.csv
    names them, over objects (`bootstrap`). InputError as of `find_photographs`, `load_photographs` and
    `compute_logits`, for `out` inside `folder`, and for by="mesh" where no mesh is known.
    """
    folder, out = as_folder("folder", folder), as_folder("out", out)
    require_choice("by", by, ("source", "mesh"))
    require_outside(out, folder)
    labels = label_names(label)
    scored = predict_folder(model, classes, folder, labels, size, skip_unreadable, device)
    predictions, images, unreadable, images_hash = scored
    if by == "mesh" and not any(item.photograph.mesh for item in predictions):
        raise InputError(f"by=mesh: {folder} has no {TABLE} with a column mesh: leave it out")
    limits = {point.label: point.threshold for point in points}
    several = len(labels) > 1
    keys = dict.fromkeys([*(["label"] if several else []), "source", by])
    pools = {key: pool_by(predictions, key, thresholds=limits) for key in keys}
    whole = pools["source"][OVERALL]
    metrics = {
        f"by_{key}": {name: group.metrics for name, group in progress(groups.items(), "intervals") if name != OVERALL}
        for key, groups in pools.items()
    }
    others = [str(path) for path in left_out(folder)]
    chosen = [asdict(point) | {"in_sample": point.images == images_hash} for point in points]
    photographs = predictions[: len(images)]  # by the predictions about one label
    found = sorted({item.photograph.label for item in photographs})
    by_class = {name: [item for item in photographs if item.photograph.label == name] for name in found}
    counts = {"positives": len(whole.positives), "negatives": len(whole.negatives)}
    summary = {
        "label": labels if several else labels[0],
        "size": size,
        "images": images_hash,
        **whole.metrics,
        **({"operating_point": chosen if several else chosen[0]} if chosen else {}),
        "n": {"photographs": len(photographs), **counts, "unreadable": len(unreadable), "left_out": len(others)},
        **metrics,
        "by_class": {name: _class_metrics(group, labels) for name, group in by_class.items()},
        "unreadable": unreadable,
        "left_out": others,
    }

    out.mkdir(parents=True, exist_ok=True)
    remove_unfinished(out)
    write_predictions(out / PREDICTIONS, predictions)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(out / SUMMARY, text + "\n")
    write_image(out / CONTACT_SHEET, contact_sheet(predictions, images))
    curves = {name: group.scores for name, group in next(iter(pools.values())).items()}
    write_roc(out, {name: scores for name, scores in curves.items() if all(map(len, scores))}, " or ".join(labels))
    return summary


def choose_operating_points(
    model: Model, classes: Sequence[str], folder: Path, label: Label, rate: float, size: int, skip: bool, device: Device
) -> list[OperatingPoint]:
    """The lowest of the log-odds of each label that at most the fraction `rate` of a folder's other images exceed.

    An image that ties with it does not exceed it. Arguments and InputError as of `evaluate_photographs`, and InputError
    for fewer than 1 / rate images of other things.
    """
    predictions, _, _, images_hash = predict_folder(model, classes, folder, label, size, skip, device)
    points = []
    for name in label_names(label):
        negatives = np.array([item.log_odds for item in predictions if item.label == name and not item.positive])
        if len(negatives) * (exact := Fraction(str(rate))) < 1:
            fault = f"calibrate={folder} has {len(negatives)} images of other things than {name}"
            raise InputError(f"{fault}: give at least {math.ceil(1 / exact)} for false_positive_rate={rate}")
        threshold = float(thresholds(negatives, np.ones(len(negatives), int), [str(rate)])[0])
        points.append(OperatingPoint(name, threshold, rate, folder.resolve().name, images_hash, len(negatives)))
    return points


def require_calibration(rate: float | None, calibrate: str | None) -> None:
    """InputError for one of the keys false_positive_rate and calibrate without the other, or a rate beyond (0, 1)."""
    if (rate is None) != (calibrate is None):
        raise InputError("give false_positive_rate=RATE and calibrate=FOLDER together, or neither")
    require_range("false_positive_rate", rate, 1e-6, 1 - 1e-6)


def operating_points(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Those of a summary: one, or one of each of several labels, or none."""
    chosen = summary.get("operating_point", [])
    return chosen if isinstance(chosen, list) else [chosen]


def describe_point(point: Mapping[str, Any]) -> str:
    """How the `operating_point` of a summary was chosen."""
    others = f"{point['folder']}, {point['negatives']} others"
    where = "these very images, in-sample" if point.get("in_sample") else others
    return f"{point['false_positive_rate']:.1%} FPR on {where}"


def _class_metrics(predictions: Sequence[Prediction], labels: Sequence[str]) -> dict[str, Any]:
    ranks = [item.true_rank for item in predictions if item.true_rank is not None]
    wrong = Counter(sorted(item.predicted for item in predictions if item.true_rank != 1))
    return {
        "n": len(predictions),
        "recall": fraction(ranks.count(1), len(ranks)),
        "top5": fraction(sum(rank <= 5 for rank in ranks), len(ranks)),
        "predicted_label": fraction(sum(item.predicted in labels for item in predictions), len(predictions)),
        "most_common_wrong": dict(wrong.most_common(WRONG_CLASSES)),
    }


def format_summary(summary: dict[str, Any]) -> str:
    """The summary of `evaluate_photographs` as Markdown tables, by mesh or source, without a newline at the end."""
    label, n, files = " or ".join(label_names(summary["label"])), summary["n"], summary["left_out"]
    parts, groups = summary.get("by_label", {}), summary.get("by_mesh", summary["by_source"])
    pools = [("all", summary), *parts.items(), *groups.items()]
    over = resampled(auc := summary["auc"])
    if over != "images":
        over += f" ({auc['positive_objects']} of {label} and {auc['negative_objects']} others)"
    counted = [key for key in COUNTED if key in summary]
    counts = [[name, *(format_fraction(metrics[key]) for key in counted)] for name, metrics in pools]
    ranked = [[name, *(format_interval(find_metric(metrics, k)) for k in RANKED)] for name, metrics in pools]
    by_class = []
    for name, metrics in summary["by_class"].items():
        wrong = ", ".join(f"{other} {count}" for other, count in metrics["most_common_wrong"].items())
        by_class.append([name, *(format_fraction(metrics[key]) for key in BY_CLASS), wrong])
    paragraphs: list[object] = [
        f"{n['positives']} images of {label}, {n['negatives']} of other things{COUNTED_EACH if parts else ''}",
        Table("95 % intervals over images", ["", *map(metric_title, counted)], counts),
        Table(f"95 % intervals over {over}", ["", *map(metric_title, RANKED)], ranked),
        Table("", ["class", "recall", "top-5", f"predicted {label}", "most common wrong classes"], by_class),
    ]
    for point in operating_points(summary):
        studied = f" of {point['label']}" if parts else ""
        threshold = f"threshold {point['threshold']:.3f} on the log-odds{studied}"
        paragraphs.append(f"{threshold}, chosen for {describe_point(point)}")
    if summary["unreadable"]:
        paragraphs.append(f"{n['unreadable']} unreadable: {', '.join(summary['unreadable'])}")
    if files:
        paragraphs.append(f"{len(files)} left out, of kinds that are not read, like {files[0]}")
    return "\n\n".join(map(str, paragraphs))
