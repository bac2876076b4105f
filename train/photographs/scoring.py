"""Score a model on a folder of photographs: recall and false positives of one class, in files and as text."""

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from train.photographs.folder import find_photographs, left_out, load_photographs, require_outside
from train.photographs.metrics import (
    OVERALL,
    RANKED,
    Roc,
    compute_metrics,
    find_metric,
    metric_title,
    pool_by_source,
    true_fraction,
)
from train.photographs.predictions import PREDICTIONS, Prediction, compute_logits, predict, write_predictions
from train.photographs.sheet import contact_sheet, write_roc
from train.tables import aligned, format_interval

SUMMARY = "summary.json"
WRONG_CLASSES = 5  # the most common ones, which are named
FILES_NAMED = 10  # of those left out


def evaluate_photographs(
    model: Callable[[torch.Tensor], torch.Tensor],
    classes: Sequence[str],
    folder: Path,
    label: str,
    out: Path,
    size: int = 32,
    skip_unreadable: bool = False,
    batch_size: int = 256,
    device: str | torch.device = "cpu",
) -> dict[str, Any]:
    """Evaluate the model on every photograph of a folder; write the results, and return the summary.

    model, on `device`, takes (N, 3, size, size) float32 sRGB in [0, 1] and returns logits (N, len(classes)); a module
    is called in eval mode and left in its own. folder, label: see `find_photographs`.

    Written into `out`: predictions.csv, a row per photograph; contact_sheet.png; roc.csv and roc.png, the ROC curves
    overall and of each source that has positives and negatives; and summary.json, which is also returned:

    - n: photographs, positives, negatives, unreadable, left_out; label; size; unreadable, left_out: their paths (see
      `left_out`);
    - recall, top5: of the photographs of class `label`, and their most common wrong classes, most_common_wrong;
    - false_positive_rate: the fraction of all others that are predicted as `label`;
    - auc, recall_at: how well the log-odds of `label` separate its photographs from all others (`roc_metrics`);
    - by_class: n, recall, top5, predicted_label (the fraction predicted as `label`) and most_common_wrong;
    - by_source: n, and the metrics above of the photographs of each known source, ranked against the negatives of their
      source and of the sources that they name as hard negatives.

    Fractions have 95 % Wilson intervals, `auc` and `recall_at` bootstrap intervals over images.

    InputError as of `find_photographs` and `load_photographs`, for `out` inside `folder`, and for logits of another
    shape, NaN or infinite.
    """
    require_outside(out, folder)
    found = find_photographs(folder, classes, label)
    photographs, images, unreadable = load_photographs(folder, found, size, skip_unreadable)
    logits = compute_logits(model, images, len(classes), batch_size, device)
    predictions = predict(photographs, logits, classes, label)
    pools = pool_by_source(predictions, label)
    others = [str(path) for path in left_out(folder)]

    by_class = defaultdict(list)
    for item in predictions:
        by_class[item.photograph.label].append(item)
    whole = pools[OVERALL]
    summary = {
        "label": label,
        "size": size,
        "n": {
            "photographs": len(predictions),
            "positives": len(whole.positives),
            "negatives": len(whole.negatives),
            "unreadable": len(unreadable),
            "left_out": len(others),
        },
        **compute_metrics(whole, label),
        "most_common_wrong": _most_common_wrong(whole.positives),
        "by_source": {
            source: {"n": len(group.positives) + len(group.negatives), **compute_metrics(group, label)}
            for source, group in pools.items()
            if source != OVERALL
        },
        "by_class": {name: _class_metrics(group, label) for name, group in sorted(by_class.items())},
        "unreadable": unreadable,
        "left_out": others,
    }

    out.mkdir(parents=True, exist_ok=True)
    write_predictions(out / PREDICTIONS, predictions, label)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    (out / SUMMARY).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
    contact_sheet(predictions, images, label).save(out / "contact_sheet.png")
    write_roc(out, {source: Roc(*group.scores) for source, group in pools.items() if all(group.scores)}, label)
    return summary


def _class_metrics(predictions: Sequence[Prediction], label: str) -> dict[str, Any]:
    ranks = [item.true_rank for item in predictions if item.true_rank is not None]
    return {
        "n": len(predictions),
        "recall": true_fraction(rank == 1 for rank in ranks),
        "top5": true_fraction(rank <= 5 for rank in ranks),
        "predicted_label": true_fraction(item.predicted == label for item in predictions),
        "most_common_wrong": _most_common_wrong(predictions),
    }


def _most_common_wrong(predictions: Sequence[Prediction]) -> dict[str, int]:
    counts = Counter(item.predicted for item in predictions if item.true_rank != 1)
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return dict(ordered[:WRONG_CLASSES])


def format_summary(summary: dict[str, Any]) -> str:
    """The summary of `evaluate_photographs` as Markdown tables, without a newline at the end."""
    label, n = summary["label"], summary["n"]
    pools = {"overall": summary, **summary["by_source"]}
    counted = ("recall", "top5", "false_positive_rate")
    counts = [[name, *(_format_count(metrics[key]) for key in counted)] for name, metrics in pools.items()]
    ranked = [
        [name, *(format_interval(find_metric(metrics, key)) for key in RANKED)] for name, metrics in pools.items()
    ]
    by_class = [[name, *_class_cells(metrics)] for name, metrics in summary["by_class"].items()]
    paragraphs = [
        f"{n['positives']} images of {label}, {n['negatives']} of other things",
        aligned(["", "recall", "top-5", "FPR"], counts),
        aligned(["", *map(metric_title, RANKED)], ranked),
        aligned(["class", "n", "recall", "top-5", f"predicted {label}", "most common wrong classes"], by_class),
    ]
    if summary["unreadable"]:
        paragraphs.append(f"{n['unreadable']} unreadable: {', '.join(summary['unreadable'])}")
    if summary["left_out"]:
        more = ", ..." if n["left_out"] > FILES_NAMED else ""
        names = ", ".join(summary["left_out"][:FILES_NAMED])
        paragraphs.append(f"{n['left_out']} left out, of kinds that are not read: {names}{more}")
    return "\n\n".join(paragraphs)


def _class_cells(metrics: dict[str, Any]) -> list[object]:
    values = [metrics[key]["value"] for key in ("recall", "top5", "predicted_label")]
    wrong = ", ".join(f"{name} {count}" for name, count in metrics["most_common_wrong"].items())
    return [metrics["n"], *("-" if value is None else f"{value:.3f}" for value in values), wrong]


def _format_count(result: dict[str, Any]) -> str:
    return "{hits}/{n} = ".format(**result) + format_interval(result) if result["n"] else "-"
