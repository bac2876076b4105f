"""Scores of a segmenter on photographs with masks: mIoU, and the IoU of each class."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from augment.classifier import TaskNetwork
from augment.network import compute_outputs
from renderer.errors import InputError, ShortRepr
from renderer.image import to_unit
from renderer.settings import height_and_width
from train.data.annotations import FITS, fit_batches, fit_mask, read_masks
from train.results import tables
from train.results.detections import UNSCORED, mean_iou
from train.results.pictures import evenly_spaced
from train.results.tables import Estimate, Table

# Number of photographs that a segmenter sees at a time.
BATCH = 16
# Photographs with predicted classes on the contact sheet.
SHOWN = 24


@dataclass(frozen=True, repr=False)
class SegmentationScores(ShortRepr):
    """Scores of a segmenter on photographs with masks.

    Attributes:
        folder: Folder with photographs and masks.
        size: Height and width of the images of the network, at which pixels count.
        fit: How photographs are brought to this size, "letterbox" or "stretch".
        photograph_count: Number of scored photographs.
        missing: Paths of photographs without a mask.
        miou: Mean IoU of the classes that occur, with its interval over photographs.
        by_class: IoU of each of these classes, from the pixels of all photographs.
        pictures: Some photographs with their predicted classes, by name.
    """

    folder: Path
    size: tuple[int, int]
    fit: str
    photograph_count: int
    missing: Sequence[str]
    miou: Estimate
    by_class: Mapping[str, float]
    pictures: Mapping[str, Tensor]

    @property
    def about(self) -> str:
        """Sentence that says what is scored, and how."""
        height, width = self.size
        missing = f" ({len(self.missing)} others have no mask)" if self.missing else ""
        size = FITS[self.fit].format(f"{width} × {height}")
        return f"{self.photograph_count} photographs{missing}, {size}"

    def __str__(self) -> str:
        """Return the lines that pnb-evaluate prints."""
        rows = [["mean", tables.format_interval(self.miou)]]
        rows += [[name, f"{iou:.3f}"] for name, iou in self.by_class.items()]
        title = tables.describe_intervals([self.miou])
        return f"{self.about}\n{Table(title, ['class', 'IoU'], rows)}"

    def to_summary(self) -> dict[str, Any]:
        """Convert the scores to the content of summary.json."""
        return {
            "task": "segmentation",
            "size": self.size,
            "fit": self.fit,
            "n": {"photographs": self.photograph_count},
            "miou": asdict(self.miou),
            "by_class": self.by_class,
            "missing": self.missing,
        }


def evaluate_segmenter(
    network: TaskNetwork, folder: Path, how: str, skip_unreadable: bool, device: torch.device
) -> SegmentationScores:
    """Segment photographs, and compare the classes of the pixels with those of masks."""
    if len(network.classes) > UNSCORED:
        reason = f"{network.title} has {len(network.classes)} classes"
        raise InputError(f"{reason}: masks can have at most {UNSCORED}, as {UNSCORED} is no class")
    photographs, masks, missing = read_masks(folder)
    size = height_and_width(network.size)
    shown = {item.name for item in evenly_spaced(photographs, SHOWN)}
    pictures: dict[str, Tensor] = {}
    count = 0

    def pairs() -> Iterator[tuple[Int[np.ndarray, "H W"], Int[np.ndarray, "H W"]]]:
        nonlocal count
        for batch in fit_batches(photographs, size, how, BATCH, skip_unreadable):
            if not batch:
                continue
            images = torch.from_numpy(np.stack([fitted.pixels for _, fitted in batch]))
            outputs = compute_outputs(network, images.to(device), BATCH)
            for (item, fitted), image, output in zip(batch, images, outputs, strict=True):
                count += 1
                if item.name in shown:
                    drawn = network.task.draw(to_unit(image), output.cpu(), network.classes)
                    pictures[item.name] = drawn
                mask = fit_mask(masks[item.name], fitted, len(network.classes))
                yield output.argmax(0).cpu().numpy(), mask

    miou, by_class = mean_iou(pairs(), len(network.classes))
    named = zip(network.classes, by_class, strict=True)
    known = {name: iou for name, iou in named if np.isfinite(iou)}
    return SegmentationScores(folder, size, how, count, missing, miou, known, pictures)
