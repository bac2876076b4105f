"""Scores of a detector or a segmenter on photographs with boxes or masks, as tables and files."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from augment.classifier import TaskNetwork
from augment.network import compute_outputs
from augment.settings import NO_CLASS_PIXEL
from augment.tasks.detection import Detection
from renderer.errors import InputError, ShortRepr
from renderer.image import to_unit
from renderer.io.files import atomic_write
from renderer.io.images import draw_grid, tiles_of, write_image
from renderer.settings import height_and_width
from train import console
from train.class_names import class_name, class_of_name
from train.data import annotations as annotated
from train.data.annotations import Annotated, Annotations, Fitted, fit_batches
from train.results import detections, tables
from train.results.detections import ClassMap, DetectionMetrics, Found, Marked, Matches, mean_iou
from train.results.pictures import evenly_spaced
from train.results.predictions import CONTACT_SHEET, begin_scores, write_summary
from train.results.tables import Estimate, Table

# Photographs with what is found on the contact sheet, and in each of its rows.
SHOWN, COLUMNS = 24, 4
# Name of the metrics of all classes.
ALL = "all"


class Showing(NamedTuple):
    """How photographs are shown to a network.

    Attributes:
        fit: How they are brought to its size, "letterbox" or "stretch".
        skip_unreadable: Whether to leave out photographs that cannot be read.
        device: Device of the images.
    """

    fit: str
    skip_unreadable: bool
    device: torch.device


@dataclass(frozen=True, repr=False, kw_only=True)
class AnnotatedScores(ShortRepr):
    """Scores of a network on photographs with boxes or masks.

    Attributes:
        size: Height and width of the images of the network.
        fit: How photographs are brought to this size, "letterbox" or "stretch".
        photograph_count: Number of scored photographs.
        missing: Names of photographs whose file or mask is missing.
        contents: What the photographs have and lack, in words.
        pictures: Some photographs with what is found in them, by name.
    """

    size: tuple[int, int]
    fit: str
    photograph_count: int
    missing: Sequence[str]
    contents: str
    pictures: Mapping[str, Tensor]

    @property
    def about(self) -> str:
        """Sentence that says what is scored, and how."""
        height, width = self.size
        size = annotated.FITS[self.fit].format(f"{width} × {height}")
        return f"{self.photograph_count} photographs{self.contents}, {size}"

    def table(self) -> Table:
        """Make the table that pnb-evaluate prints."""
        raise NotImplementedError

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        return {
            "size": self.size,
            "fit": self.fit,
            "n": {"photographs": self.photograph_count},
            "missing": self.missing,
        }

    def __str__(self) -> str:
        """Return the lines that pnb-evaluate prints."""
        return f"{self.about}\n{self.table()}"


@dataclass(frozen=True, repr=False, kw_only=True)
class DetectionScores(AnnotatedScores):
    """Scores of a detector on photographs with boxes.

    Attributes:
        task: Detection with its threshold and IoU.
        labels: Names of the scored classes. All their objects are marked.
        overall: Metrics of all classes.
        by_label: Metrics of each class.
        by_source: Metrics of each class, and of all as "all", in each folder of
            photographs. Empty with one folder.
        detections: Each detection with its photograph, class, box (x, y, width,
            height, in pixels of the photograph) and score.
    """

    task: Detection
    labels: Sequence[str]
    overall: DetectionMetrics
    by_label: Mapping[str, DetectionMetrics]
    by_source: Mapping[str, Mapping[str, DetectionMetrics]]
    detections: Sequence[Mapping[str, Any]]

    def table(self) -> Table:
        """Make a table with a row for all classes, and one for each class in each folder."""
        groups = {"": {ALL: self.overall, **self.by_label}, **self.by_source}
        cells: list[list[object]] = []
        for source, of_group in groups.items():
            for name, metrics in of_group.items():
                # With a single class, its row would repeat that of all classes.
                if name != ALL or len(self.labels) > 1:
                    estimates = (metrics.recall, metrics.ap50, metrics.false_per_image)
                    cells.append([f"{source}: {name}" if source else name, metrics.n, *estimates])
        threshold, iou = self.task.threshold, self.task.iou
        recall, false_count = f"recall at {threshold:g}", f"false per image at {threshold:g}"
        header = ["", "objects", recall, "AP50", false_count]
        return tables.table_of(f"IoU {iou:g}; ", header, cells)

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        return {
            "task": self.task.name,
            "threshold": self.task.threshold,
            "iou": self.task.iou,
            "label": self.labels,
            **asdict(self.overall),
            "by_label": self.by_label,
            "by_source": self.by_source,
            **super().to_summary(),
            "n": {"photographs": self.photograph_count, "objects": self.overall.n},
        }


@dataclass(frozen=True, repr=False, kw_only=True)
class SegmentationScores(AnnotatedScores):
    """Scores of a segmenter on photographs with masks.

    Attributes:
        miou: Mean IoU of the classes that occur, with its interval over photographs.
        by_class: IoU of each of these classes, from the pixels of all photographs, which count
            at the size of the network.
    """

    miou: Estimate
    by_class: Mapping[str, float]

    def table(self) -> Table:
        """Make a table of the mean IoU and that of each class."""
        of_classes = [(name, f"{iou:.3f}") for name, iou in self.by_class.items()]
        return tables.table_of("", ["class", "IoU"], [("mean", self.miou), *of_classes])

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        scores = {"miou": self.miou, "by_class": self.by_class}
        return {"task": "segmentation", **scores, **super().to_summary()}


def _outputs(
    network: TaskNetwork, photographs: Sequence[Annotated], how: Showing, drawn: dict[str, Tensor]
) -> Iterator[tuple[Annotated, Fitted, Any]]:
    """Yield photographs with the outputs of a network, and put drawings of some into `drawn`."""
    size = height_and_width(network.size)
    # Names of SHOWN photographs, whose pictures are drawn.
    shown = {item.name for item in evenly_spaced(photographs, SHOWN)}
    outputs: Any = None
    # Skipped photographs can leave a batch empty.
    for batch in filter(None, fit_batches(photographs, size, how.fit, how.skip_unreadable)):
        images = torch.from_numpy(np.stack([fitted.pixels for _, fitted in batch])).to(how.device)
        outputs = compute_outputs(network, images)
        for (item, fitted), image, output in zip(batch, images, outputs, strict=True):
            if item.name in shown:
                drawn[item.name] = network.task.draw(to_unit(image), output, network.classes).cpu()
            yield item, fitted, output
    if outputs is None:
        raise InputError("photos has no photograph that can be read: give others", "photos")


def evaluate_detector(
    network: TaskNetwork, annotations: Annotations, labels: Sequence[str] | None, how: Showing
) -> DetectionScores:
    """Detect objects in photographs, and score the detections of some classes, or of all."""
    label_of_class = _choose_labels(annotations, network.classes, labels)
    task = network.task
    assert isinstance(task, Detection)
    # Matches of each photograph: those for recall, and those for AP50, whose IoU is always 0.5.
    # Equal scores are ranked in their order. `listed` has all detections.
    matches: list[list[Matches]] = []
    sources: dict[str, list[int]] = {}
    listed: list[dict[str, Any]] = []
    pictures: dict[str, Tensor] = {}
    for item, fitted, output in _outputs(network, annotations.photographs, how, pictures):
        boxes, own, scores = (output[key].cpu().numpy() for key in ("boxes", "labels", "scores"))
        # From pixels of the network's image to those of the photograph.
        boxes, scores = fitted.to_photograph(boxes.astype(float)), scores.astype(float)
        names = [annotations.classes[label] for label in item.labels[fitted.is_kept]]
        # Classes that are not scored have a label that no detection has.
        true = np.array([label_of_class.get(name, -1) for name in names], int)
        pair = Found(boxes, own, scores), Marked(fitted.boxes, true, item.is_crowd[fitted.is_kept])
        sources.setdefault(item.name.rpartition("/")[0] or ".", []).append(len(matches))
        matches.append([detections.match_image(*pair, iou) for iou in (task.iou, 0.5)])
        for box, label, score in zip(boxes, own, scores, strict=True):
            left, top, right, bottom = box.round(2).tolist()
            # COCO's form of a box is left, top, width and height.
            sides = [left, top, round(right - left, 2), round(bottom - top, 2)]
            entry = {"file_name": item.name, "category": network.classes[label], "bbox": sides}
            listed.append(entry | {"score": round(float(score), 4)})
        if not fitted.is_kept.all():
            console.warning("%s: a box without an area in the photograph is left out", item.name)
    by_label = _score(matches, label_of_class, task)
    by_source = {
        source: _score([matches[index] for index in sources[source]], label_of_class, task)
        for source in (sorted(sources) if len(sources) > 1 else ())
    }
    overall = by_label.pop(ALL)
    missing = f" ({len(annotations.missing)} files are missing)" if annotations.missing else ""
    return DetectionScores(
        size=height_and_width(network.size),
        fit=how.fit,
        photograph_count=len(matches),
        missing=annotations.missing,
        contents=f"{missing} with {overall.n} objects",
        pictures=pictures,
        task=task,
        labels=[*by_label],
        overall=overall,
        by_label=by_label,
        by_source=by_source,
        detections=listed,
    )


def _choose_labels(
    annotations: Annotations, classes: Sequence[str], labels: Sequence[str] | None
) -> dict[str, int]:
    """Return the index in the network of each scored class, by its names in the annotations."""
    # None for a class that the network lacks.
    known = {name: class_of_name(name, classes) for name in annotations.classes}
    # A class is named as in the annotations, as in the network, or by its index in the network.
    marked = {own: name for name, own in known.items()}
    chosen = [
        name if name in known else marked.get(class_name(classes, name, "label"), name)
        for name in (known if labels is None else labels)
    ]
    unmarked = [name for name in chosen if name not in known]
    if unmarked:
        names = ", ".join(annotations.classes[:10])
        raise InputError(f"{annotations.file} marks no {unmarked[0]}, but {names}", "label")
    lacking = [name for name in chosen if known[name] is None]
    # A class that the caller names must be known. Of all classes, unknown ones are left out.
    if len(lacking) == len(chosen) or (labels and lacking):
        fault = f"{annotations.file} marks {', '.join(lacking[:10])}, which are no classes of the"
        raise InputError(f"{fault} network (such as {', '.join(classes[:3])}): give classes")
    if lacking:
        console.warning("not scored, because the network lacks them: %s", ", ".join(lacking))
    # Names may differ in their case alone. Tables show the first name of a class.
    wanted = {known[name] for name in chosen} - {None}
    return {name: classes.index(known[name]) for name in (*chosen, *known) if known[name] in wanted}


def _score(
    matches: Sequence[Sequence[Matches]], labels: Mapping[str, int], task: Detection
) -> dict[str, DetectionMetrics]:
    """Return the metrics of all classes, and of each class, in some photographs."""
    at_iou, at_half = map(detections.join, zip(*matches, strict=True))
    names: dict[int, str] = {}
    for name, own in labels.items():
        names.setdefault(own, name)
    kinds = {ALL: [*names], **{name: [label] for label, name in names.items()}}
    return {key: detections.score(at_iou, of, task.threshold, at_half) for key, of in kinds.items()}


def evaluate_segmenter(network: TaskNetwork, folder: Path, how: Showing) -> SegmentationScores:
    """Segment photographs, and compare the classes of the pixels with those of masks."""
    photographs, masks, missing = annotated.read_masks(folder)
    pictures: dict[str, Tensor] = {}
    # Names of the photographs that can be read, and values of their masks.
    names: list[str] = []
    seen: set[int] = set()

    # Pairs are read one after the other, so that not all masks are in memory.
    def pairs() -> Iterator[tuple[ClassMap, ClassMap]]:
        for item, fitted, output in _outputs(network, photographs, how, pictures):
            names.append(item.name)
            mask = annotated.fit_mask(masks[item.name], fitted, len(network.classes), seen)
            yield output.argmax(0).cpu().numpy(), mask

    miou, by_class = mean_iou(pairs(), len(network.classes))
    # A mask of 0 and 255 marks its object as pixels that do not count.
    if NO_CLASS_PIXEL in seen and seen <= {0, NO_CLASS_PIXEL}:
        fault = f"the masks of {folder} have only the values {sorted(seen)}, and 255 does not count"
        raise InputError(f"{fault}: write 1 for the object, or the index of its class", "photos")
    named = zip(network.classes, by_class, strict=True)
    return SegmentationScores(
        size=height_and_width(network.size),
        fit=how.fit,
        photograph_count=len(names),
        missing=missing,
        contents=f" ({len(missing)} others have no mask)" if missing else "",
        pictures=pictures,
        miou=miou,
        # The IoU of a class that no pixel has is NaN.
        by_class={name: iou for name, iou in named if np.isfinite(iou)},
    )


def write(scores: AnnotatedScores, out: Path) -> None:
    """Write scores, all detections, and photographs with what is found to a folder."""
    begin_scores(out)
    if isinstance(scores, DetectionScores):
        lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in scores.detections)
        atomic_write(out / "detections.json", f"[\n{lines}\n]\n")
    tiles = tiles_of(scores.pictures.values(), [(name,) for name in scores.pictures])
    rows = [tiles[start : start + COLUMNS] for start in range(0, len(tiles), COLUMNS)]
    write_image(out / CONTACT_SHEET, draw_grid(rows, heading=scores.about.replace("×", "x")))
    write_summary(out, scores.to_summary())
