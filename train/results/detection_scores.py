"""Scores of a detector on photographs with boxes, as tables and as files."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.classifier import TaskNetwork
from augment.network import compute_outputs
from augment.tasks.detection import Detection, Detections
from renderer.errors import InputError, ShortRepr
from renderer.image import to_unit
from renderer.io.files import atomic_write, remove_unfinished
from renderer.io.images import draw_grid, tiles_of, write_image
from renderer.settings import height_and_width
from train import console
from train.class_names import class_of_name
from train.data.annotations import FITS, Annotated, Annotations, Fitted, fit_batches
from train.results import detections, tables
from train.results.detections import DetectionMetrics, Found, Marked
from train.results.pictures import evenly_spaced
from train.results.predictions import CONTACT_SHEET, SUMMARY
from train.results.segmentation_scores import SegmentationScores
from train.results.tables import Table

# Number of photographs that a detector sees at a time.
BATCH = 16
# Photographs with boxes on the contact sheet, and in each of its rows.
SHOWN, COLUMNS = 24, 4
# Name of the metrics of all classes.
ALL = "all"
# File of all detections, in the form of COCO's results.
DETECTIONS = "detections.json"


@dataclass(frozen=True, repr=False)
class DetectionScores(ShortRepr):
    """Scores of a detector on photographs with boxes.

    Attributes:
        file: File or folder of the annotations.
        task: Detection with its threshold and IoU.
        size: Height and width of the images of the network.
        fit: How photographs are brought to this size, "letterbox" or "stretch".
        labels: Names of the scored classes. All their objects are marked.
        photograph_count: Number of scored photographs.
        missing: Names of photographs in the annotations whose files are missing.
        overall: Metrics of all classes.
        by_label: Metrics of each class.
        by_source: Metrics of each class, and of all as "all", in each folder of
            photographs. Empty with one folder.
        detections: Each detection with its photograph, class, box (x, y, width,
            height, in pixels of the photograph) and score.
        pictures: Some photographs with boxes, by name.
    """

    file: Path
    task: Detection
    size: tuple[int, int]
    fit: str
    labels: Sequence[str]
    photograph_count: int
    missing: Sequence[str]
    overall: DetectionMetrics
    by_label: Mapping[str, DetectionMetrics]
    by_source: Mapping[str, Mapping[str, DetectionMetrics]]
    detections: Sequence[Mapping[str, Any]]
    pictures: Mapping[str, Tensor]

    @property
    def about(self) -> str:
        """Sentence that says what is scored, and how."""
        height, width = self.size
        missing = f" ({len(self.missing)} files are missing)" if self.missing else ""
        return (
            f"{self.photograph_count} photographs{missing} with {self.overall.n} objects, "
            f"{FITS[self.fit].format(f'{width} × {height}')}"
        )

    def table(self) -> Table:
        """Make a table with a row for all classes, and one for each class in each folder."""
        groups = {"": {ALL: self.overall, **self.by_label}, **self.by_source}
        rows: list[tuple[str, DetectionMetrics]] = []
        for source, of_group in groups.items():
            rows += [
                (f"{source}: {name}" if source else name, metrics)
                for name, metrics in of_group.items()
                if name != ALL or len(self.labels) > 1
            ]
        threshold, iou = self.task.threshold, self.task.iou
        cells: list[list[object]] = []
        shown: list[tables.Estimate] = []
        for title, metrics in rows:
            estimates = (metrics.recall, metrics.ap50, metrics.false_per_image)
            shown += estimates
            cells.append([title, metrics.n, *map(tables.format_interval, estimates)])
        recall, false_count = f"recall at {threshold:g}", f"false per image at {threshold:g}"
        title = f"IoU {iou:g}; {tables.describe_intervals(shown)}"
        return Table(title, ["", "objects", recall, "AP50", false_count], cells)

    def __str__(self) -> str:
        """Return the lines that pnb-evaluate prints."""
        return f"{self.about}\n{self.table()}"

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        return {
            "task": self.task.name,
            "threshold": self.task.threshold,
            "iou": self.task.iou,
            "size": self.size,
            "fit": self.fit,
            "label": self.labels,
            "n": {"photographs": self.photograph_count, "objects": self.overall.n},
            **asdict(self.overall),
            "by_label": {name: asdict(metrics) for name, metrics in self.by_label.items()},
            "by_source": {
                source: {name: asdict(metrics) for name, metrics in of_source.items()}
                for source, of_source in self.by_source.items()
            },
            "missing": self.missing,
        }


def evaluate_detector(
    network: TaskNetwork,
    annotations: Annotations,
    labels: Sequence[str] | None,
    how: str,
    skip_unreadable: bool,
    device: torch.device,
) -> DetectionScores:
    """Detect objects in photographs, and score the detections of some classes, or of all."""
    label_of_class = _choose_labels(annotations, network.classes, labels)
    height, width = height_and_width(network.size)
    shown = {id(item) for item in evenly_spaced(annotations.photographs, SHOWN)}
    read: list[tuple[Annotated, Fitted]] = []

    def batches() -> Iterator[Tensor]:
        options = ((height, width), how, BATCH, skip_unreadable)
        for batch in fit_batches(annotations.photographs, *options):
            # Only the pixels of pictures are kept.
            none = np.empty((3, 0, 0), np.uint8)
            for item, fitted in batch:
                kept = fitted if id(item) in shown else fitted._replace(pixels=none)
                read.append((item, kept))
            yield torch.from_numpy(np.stack([fitted.pixels for _, fitted in batch]))

    outputs: Any = compute_outputs(network, batches(), BATCH, device)
    found: list[Found] = []
    marked: list[Marked] = []
    listed: list[dict[str, Any]] = []
    pictures = {}
    for (item, fitted), output in zip(read, outputs, strict=True):
        if fitted.pixels.size:
            image = to_unit(torch.from_numpy(fitted.pixels))
            pictures[item.name] = network.task.draw(image, output, network.classes)
        found.append(_found(output, fitted))
        names = [annotations.classes[label] for label in item.labels[fitted.is_kept]]
        # Classes that are not scored have a label that no detection has.
        own = np.array([label_of_class.get(name, -1) for name in names], int)
        marked.append(Marked(fitted.boxes, own, item.is_crowd[fitted.is_kept]))
        listed += _list(item.name, found[-1], network.classes)
        if not fitted.is_kept.all():
            console.warning("%s: a box without an area in the photograph is left out", item.name)
    sources = [item.source for item, _ in read]
    task = network.task
    assert isinstance(task, Detection)
    metrics = _score(found, marked, label_of_class, sources, task)
    return DetectionScores(
        annotations.file,
        task,
        (height, width),
        how,
        [*label_of_class],
        len(read),
        annotations.missing,
        *metrics,
        listed,
        pictures,
    )


def _choose_labels(
    annotations: Annotations, classes: Sequence[str], labels: Sequence[str] | None
) -> dict[str, int]:
    """Return the index in a network of each scored class of annotations, by its name there."""
    known = {name: class_of_name(name, classes) for name in annotations.classes}
    chosen = [*known] if labels is None else [*labels]
    unmarked = [name for name in chosen if name not in known]
    if unmarked:
        names = ", ".join(annotations.classes[:10])
        raise InputError(f"{annotations.file} marks no {unmarked[0]}, but {names}", "label")
    lacking = [name for name in chosen if known[name] is None]
    if len(lacking) == len(chosen) or (labels and lacking):
        raise InputError(
            f"{annotations.file} marks {', '.join(lacking[:10])}, which are no classes of the "
            f"network (such as {', '.join(classes[:3])}): give classes"
        )
    if lacking:
        console.warning("not scored, because the network lacks them: %s", ", ".join(lacking))
    return {name: classes.index(own) for name in chosen if (own := known[name]) is not None}


def _found(output: Detections, fitted: Fitted) -> Found:
    """Convert detections in pixels of the network to arrays, in pixels of the photograph."""
    boxes, labels, scores = (output[key].cpu().numpy() for key in ("boxes", "labels", "scores"))
    return Found(fitted.to_photograph(boxes.astype(float)), labels, scores.astype(float))


def _list(name: str, found: Found, classes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the detections in a photograph as entries of a file."""
    for box, label, score in zip(found.boxes, found.labels, found.scores, strict=True):
        left, top, right, bottom = box.round(2).tolist()
        sides = [left, top, round(right - left, 2), round(bottom - top, 2)]
        entry = {"file_name": name, "category": classes[label], "bbox": sides}
        yield entry | {"score": round(float(score), 4)}


def _score(
    found: Sequence[Found],
    marked: Sequence[Marked],
    labels: Mapping[str, int],
    sources: Sequence[str],
    task: Detection,
) -> tuple[DetectionMetrics, dict[str, DetectionMetrics], dict[str, dict[str, DetectionMetrics]]]:
    """Score all classes, each class, and both for the photographs of each source."""
    arguments = (found, marked, [*labels.values()])
    at_iou = detections.match_images(*arguments, task.iou)
    at_half = detections.match_images(*arguments, 0.5)
    is_chosen = np.ones(len(found), bool)

    def score(labels: Sequence[int]) -> DetectionMetrics:
        one, other = (
            [by_label[label].select(is_chosen) for label in labels]
            for by_label in (at_iou, at_half)
        )
        return detections.score(one, task.threshold, other)

    def score_each() -> dict[str, DetectionMetrics]:
        return {name: score([label]) for name, label in labels.items()}

    overall, by_label = score([*labels.values()]), score_each()
    by_source = {}
    names = sorted({*sources})
    for source in names if len(names) > 1 else []:
        is_chosen = np.array([item == source for item in sources])
        by_source[source or "."] = {ALL: score([*labels.values()]), **score_each()}
    return overall, by_label, by_source


def write(scores: DetectionScores | SegmentationScores, out: Path) -> None:
    """Write scores, all detections, and photographs with what is found to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    remove_unfinished(out)
    # Without a summary, no folder counts as scored.
    (out / SUMMARY).unlink(missing_ok=True)
    if isinstance(scores, DetectionScores):
        lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in scores.detections)
        atomic_write(out / DETECTIONS, f"[\n{lines}\n]\n")
    captions = [(name,) for name in scores.pictures]
    tiles = tiles_of(scores.pictures.values(), captions)
    rows = [tiles[start : start + COLUMNS] for start in range(0, len(tiles), COLUMNS)]
    write_image(out / CONTACT_SHEET, draw_grid(rows, heading=scores.about.replace("×", "x")))
    text = json.dumps(scores.to_summary(), indent=2, ensure_ascii=False, allow_nan=False)
    atomic_write(out / SUMMARY, text + "\n")
