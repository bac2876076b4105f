"""Score a detector or a segmenter on renders: in plain and unusual light, and after attacks.

Only the class of the meshes counts. On renders of hard negatives, each of its detections or pixels
is false.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.classifier import TaskNetwork
from augment.network import compute_outputs, device_of
from augment.progress import progress
from augment.scene.truth import NO_OBJECT, Truth
from augment.tasks.detection import Detection
from renderer.image import to_unit
from renderer.light.files import load_light
from train.auditing import lights
from train.auditing.lights import BATCH, KINDS, NORMALIZED, RANDOM, Views
from train.data.annotations import LETTERBOX, Annotations
from train.results import annotated_scores, detections
from train.results.detections import Found, Marked, Matches
from train.results.intervals import Units
from train.results.pictures import evenly_spaced, plot_curves
from train.results.predictions import SUMMARY
from train.results.tables import Estimate, Table, format_interval
from train.run_folder import read_json

# Result file: metrics in each group of lights, and recall against false detections per image.
DETECTED = "detections.json"
# Folder of the scores on photographs with boxes.
BOXED = "photographs_with_boxes"
# What the intervals are over.
VIEWS = "views"
# Number of points of the curve of recall against false detections.
CURVE_POINTS = 50
# Header of the table of metrics.
HEADER = {
    "recall": "recall",
    "ap50": "AP50",
    "false_per_image": "false detections per image",
    "miou": "mIoU",
}
# What is said about the metrics.
ABOUT = (
    "Recall at the score threshold, average precision at an IoU of 0.5, and detections of {} "
    "without an object."
)
ABOUT_PIXELS = "Mean of the IoU of the pixels of {} and of that of all other pixels."


def _find(
    network: TaskNetwork, label: int, images: Float[Tensor, "E 1 3 H W"], truth: Truth | None
) -> list[tuple[Any, Any]]:
    """Return a pair for each render: what is found, and the truth. None stands for no object."""
    pairs: list[tuple[Any, Any]] = []
    for row, output in enumerate(compute_outputs(network, images[:, 0], BATCH)):
        # The mask of the class in a segmentation, and the true mask: 1 on the object, otherwise 0.
        if not isinstance(network.task, Detection):
            shown = (output.argmax(0) == label).long()
            mask = torch.zeros_like(shown) if truth is None else truth.masks[row, 0, 0].long()
            pairs.append((shown.cpu().numpy(), mask.cpu().numpy()))
            continue
        # The detections, and the true boxes of the view.
        arrays = [output[name].cpu().numpy() for name in ("boxes", "labels", "scores")]
        boxes, labels = np.zeros((0, 4)), np.zeros(0, int)
        if truth is not None:
            is_marked = truth.labels[row, 0] != NO_OBJECT
            boxes = truth.boxes[row, 0][is_marked].cpu().double().numpy()
            labels = truth.labels[row, 0][is_marked].cpu().numpy()
        pairs.append((Found(*arrays), Marked(boxes, labels, np.zeros(len(labels), bool))))
    return pairs


def find_in_lights(
    network: TaskNetwork,
    views: Views,
    attacked_views: Views,
    negatives: Views,
    environments: Sequence[str],
    random_light_count: int,
    out: Path,
) -> dict[str, Any]:
    """Score a network in all lights of an audit, after its attacks have been written to `out`."""
    label = network.label(views.objects[0].label)
    # Pairs of what is found and the truth, with the number of their view, by the title of a group.
    groups: defaultdict[str, list[tuple[int, tuple[Any, Any]]]] = defaultdict(list)
    plain = load_light(views.light).to(views.device) * views.exposure
    unusual = lights.environment_lights(views, environments, random_light_count)
    # The hard negatives have no truth: all that is found in them is false.
    for shown, title in ((views, ""), (negatives, "hard negatives, ")):
        scene = shown.scene(network.size)
        truth = None if title else scene.truth(network.label)
        # Views of hard negatives are other units than those of the class.
        first = views.count if title else 0
        for name, light in progress({"": plain, **unusual}.items(), "objects in other light"):
            pairs = _find(network, label, lights.render_in(scene, light), truth)
            group = "random light" if name.startswith(RANDOM) else "environments"
            groups[group if name else "plain light"] += enumerate(pairs, first)
    truth = attacked_views.scene(network.size).truth(network.label)
    for kind, light_kind in KINDS.items():
        images = to_unit(torch.from_numpy(np.load(out / f"{kind}.npy"))).to(views.device)
        groups[f"attacked: {light_kind.title}"] += enumerate(_find(network, label, images, truth))
    task = network.task
    metrics: dict[str, Any] = {}
    for title, numbered in groups.items():
        # Lights of the same view are no independent units, so the interval is over the views.
        units = Units([np.array([unit for unit, _ in numbered])], VIEWS)
        pairs = [pair for _, pair in numbered]
        if isinstance(task, Detection):
            at_iou, at_half = (_match(pairs, iou) for iou in (task.iou, 0.5))
            measured = at_iou, [label], task.threshold, at_half, units
            metrics[title] = asdict(detections.score(*measured))
        else:
            miou, _ = detections.mean_iou(pairs, 2, units)
            metrics[title] = {"n": len(pairs), "miou": asdict(miou)}
    # Only detections have scores, and so a curve of recall against false detections.
    if not isinstance(task, Detection):
        return {"metrics": metrics, "curve": []}
    not_attacked = ("plain light", "environments", "random light")
    every = [pair for title in not_attacked for _, pair in groups.get(title, [])]
    return {"metrics": metrics, "curve": _curve(_match(every, task.iou).of([label]))}


def _match(pairs: Sequence[tuple[Found, Marked]], iou: float) -> Matches:
    """Return the matches of detections and true boxes in all views."""
    return detections.join([detections.match_image(*pair, iou) for pair in pairs])


def _curve(matches: Matches) -> list[tuple[float, ...]]:
    """Return false detections per image and recall at descending thresholds."""
    every = np.ones((1, matches.image_count))
    # Objects that are never detected have the score -inf, which is no threshold.
    finite = matches.object_score[np.isfinite(matches.object_score)]
    thresholds = np.unique([*finite, *matches.score])[::-1]
    measures = (matches.false_per_image, matches.recall)
    # CURVE_POINTS thresholds are enough for the plot.
    return [
        tuple(float(measure(threshold, every)[0]) for measure in measures)
        for threshold in evenly_spaced(thresholds.tolist(), CURVE_POINTS)
    ]


def score_photographs(network: TaskNetwork, annotations: Annotations, out: Path) -> None:
    """Score a detector on photographs with boxes. Unreadable ones are left out."""
    how = annotated_scores.Showing(LETTERBOX, skip_unreadable=True, device=device_of(network))
    scores = annotated_scores.evaluate_detector(network, annotations, None, how)
    annotated_scores.write(scores, out)


def sections(networks: Mapping[str, Path], label: str) -> list[dict[str, Any]]:
    """Make a section of a report about each network, whose results are in a folder."""
    made = []
    for name, folder in networks.items():
        if not (folder / DETECTED).exists():
            continue
        content = read_json(folder / DETECTED)
        tables = [_table(content["metrics"], f"renders; 95% intervals over {VIEWS}", "light")]
        # The same network with the remedy "normalized light", which may have scores, too.
        normalized = folder.with_name(f"{folder.name}{NORMALIZED}")
        for path, title in ((folder, ""), (normalized, ", with normalized light")):
            if (path / BOXED / SUMMARY).exists():
                by_label = read_json(path / BOXED / SUMMARY)["by_label"]
                tables.append(_table(by_label, f"photographs{title}", "class"))
        points = {name: [[(x, y) for x, y in content["curve"]]]}
        chart = plot_curves(points, "recall", "false detections per image")
        # The curve of a detector that finds nothing is empty, like that of a segmenter.
        about = ABOUT if "recall" in content["metrics"]["plain light"] else ABOUT_PIXELS
        shown = {"tables": tables, "charts": [chart] if chart else []}
        made.append({"name": name, "about": about.format(label), **shown})
    return made


def _table(metrics_of: Mapping[str, Any], title: str, first: str) -> Table:
    """Make a table of metrics from a file, with a row for each light or class."""
    rows, names = [], []
    for name, metrics in metrics_of.items():
        names = [metric for metric in HEADER if metric in metrics]
        estimates = [Estimate(**metrics[metric]) for metric in names]
        rows.append([name, *map(format_interval, estimates)])
    return Table(title, [first, *(HEADER[metric] for metric in names)], rows)
