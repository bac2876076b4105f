"""Scores of detections and of segmentations: recall, AP50, false detections and mIoU.

Everything is computed on plain arrays. Boxes have the columns left, top, right and bottom, in any
unit. Detections are matched as the evaluation of COCO does.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from augment.settings import NO_CLASS_PIXEL
from train.results.intervals import Units, leave_out
from train.results.tables import Estimate

# An interval over fewer units says nothing. With two, its t distribution has one degree of freedom.
MIN_UNITS = 3
# Index of the object of a detection: it is of no object, or of a crowd, which does not count.
NO_OBJECT, CROWD = -1, -2
# Classes of the pixels of an image.
ClassMap = Int[np.ndarray, "H W"]
# How often each of n images counts, in k rows.
Counts = Float[np.ndarray, "k n"]
# Recalls at which the average precision averages the precision, as COCO does.
RECALLS = np.linspace(0, 1, 101)


@dataclass(frozen=True)
class Found:
    """Detections of a network in one image."""

    boxes: Float[np.ndarray, "N 4"]
    labels: Int[np.ndarray, " N"]
    scores: Float[np.ndarray, " N"]


@dataclass(frozen=True)
class Marked:
    """Objects of one image. A detection of a crowd is neither right nor false."""

    boxes: Float[np.ndarray, "M 4"]
    labels: Int[np.ndarray, " M"]
    is_crowd: Bool[np.ndarray, " M"]


def match(found: Found, marked: Marked, iou: float) -> Int[np.ndarray, " N"]:
    """Return the index of the object of each detection, NO_OBJECT or CROWD.

    The detections choose in descending order of their scores. Each takes the object of its class
    with the largest overlap, of those that no other has taken and whose overlap is at least `iou`.
    """
    low = np.maximum(found.boxes[:, None, :2], marked.boxes[None, :, :2])
    high = np.minimum(found.boxes[:, None, 2:], marked.boxes[None, :, 2:])
    shared = (high - low).clip(0).prod(-1)
    areas, others = ((of.boxes[:, 2:] - of.boxes[:, :2]).prod(-1) for of in (found, marked))
    # An overlap is intersection over union or, of crowds, over the area of the detection.
    whole = np.where(marked.is_crowd, areas[:, None], areas[:, None] + others - shared)
    overlaps = np.divide(shared, whole, out=np.zeros_like(shared), where=whole > 0)
    # Whether each detection (row) may take each object (column).
    is_free = (overlaps >= iou) & (found.labels[:, None] == marked.labels)
    objects = np.full(len(found.scores), NO_OBJECT)
    for row in np.argsort(-found.scores, kind="stable"):
        # -1 stands for objects that the detection may not take.
        candidates = np.where(is_free[row] & ~marked.is_crowd, overlaps[row], -1)
        if candidates.max(initial=-1) >= 0:
            objects[row] = candidates.argmax()
            is_free[:, objects[row]] = False
        # A crowd can have any number of detections, which then count neither as right nor as false.
        elif (is_free[row] & marked.is_crowd).any():
            objects[row] = CROWD
    return objects


@dataclass(frozen=True)
class Matches:
    """Detections and objects in a number of images, as records.

    Attributes:
        image_count: Number of images.
        detections: Records of the detections in descending order of their scores: the class
            `label`, the index of the `image`, the `score`, and `is_right`, whether the detection
            is of an object.
        objects: Records of the objects: the class `label`, the index of the `image`, and the
            `score` of the detection of the object. −inf without one.
    """

    image_count: int
    detections: np.recarray
    objects: np.recarray

    def of(self, labels: Sequence[int]) -> "Matches":
        """Return the matches of some classes."""
        kinds: tuple[Any, ...] = (self.detections, self.objects)
        return Matches(self.image_count, *(kind[np.isin(kind.label, labels)] for kind in kinds))

    def recall(self, threshold: float, counts: Counts) -> Float[np.ndarray, " k"]:
        """Compute the fraction of the objects that are detected with at least a score.

        `counts` says how often each image counts. The recall of no object is NaN.
        """
        weights = counts[:, self.objects.image]
        with np.errstate(invalid="ignore"):
            return (weights * (self.objects.score >= threshold)).sum(-1) / weights.sum(-1)

    def false_per_image(self, threshold: float, counts: Counts) -> Float[np.ndarray, " k"]:
        """Compute the number of detections per image that have a score, but no object."""
        return counts[:, self.images_of_false(threshold)].sum(-1) / counts.sum(-1)

    def images_of_false(self, threshold: float) -> Int[np.ndarray, " false"]:
        """Return the index of the image of each detection that has a score, but no object."""
        found = self.detections
        return found.image[(found.score >= threshold) & ~found.is_right]

    def average_precision(self, counts: Float[np.ndarray, " n"]) -> float:
        """Compute the average precision of one class, as COCO does. That of no object is NaN.

        Image i counts `counts[i]` times.
        """
        object_count = counts[self.objects.image].sum()
        if not object_count:
            return np.nan
        weights = counts[self.detections.image]
        # Correct detections among those with at least each score.
        right = np.cumsum(weights * self.detections.is_right)
        # A detection in an image that counts 0 times may come first.
        precision = right / np.maximum(np.cumsum(weights), np.spacing(1))
        # The precision at a recall is the highest one at this recall or a higher one.
        highest = np.maximum.accumulate(precision[::-1])[::-1]
        # The first detection that reaches each recall. Without one, the precision is 0.
        places = np.searchsorted(right / object_count, RECALLS, side="left")
        return float(np.append(highest, 0)[places].mean())


def join(parts: Sequence[Matches]) -> Matches:
    """Join the matches in several images, each of one image."""
    joined: list[Any] = []
    for of_images in zip(*((part.detections, part.objects) for part in parts), strict=True):
        records = np.concatenate(of_images).view(np.recarray)
        # The index of the image in each part is 0.
        records.image = np.arange(len(parts)).repeat([*map(len, of_images)])
        joined.append(records)
    found, objects = joined
    # In descending order of the scores, as `Matches` says.
    return Matches(len(parts), found[np.argsort(-found.score, kind="stable")], objects)


def match_image(found: Found, marked: Marked, iou: float = 0.5) -> Matches:
    """Match the detections in an image, without crowds and what is of them."""
    index = match(found, marked, iou)
    is_right = index >= 0
    # Objects without a detection have the score -inf.
    score_of_object = np.full(len(marked.labels), -np.inf)
    score_of_object[index[is_right]] = found.scores[is_right]
    image, image_of_object = (np.zeros(len(of.labels), int) for of in (found, marked))
    detections = _records(label=found.labels, image=image, score=found.scores, is_right=is_right)
    objects = _records(label=marked.labels, image=image_of_object, score=score_of_object)
    return Matches(1, detections[index != CROWD], objects[~marked.is_crowd])


def _records(**columns: np.ndarray) -> np.recarray:
    """Make records of columns."""
    kinds = [(name, column.dtype) for name, column in columns.items()]
    return np.rec.fromarrays([*columns.values()], kinds)


@dataclass(frozen=True)
class DetectionMetrics:
    """Metrics of the detections of a class, or of all classes, with 95% intervals.

    Attributes:
        n: Number of objects.
        recall: Fraction of the objects that are detected with a score of at least the threshold.
        ap50: Average precision at an IoU of 0.5. For all classes, the mean of the classes that
            have objects.
        false_per_image: Detections per image that have such a score, but no object.
    """

    n: int
    recall: Estimate
    ap50: Estimate
    false_per_image: Estimate


def score(
    matches: Matches,
    labels: Sequence[int],
    threshold: float,
    at_half: Matches | None = None,
    units: Units | None = None,
) -> DetectionMetrics:
    """Score the detections of one class, or of several, with intervals over images.

    `at_half` are the matches of the same detections at an IoU of 0.5, if others are at another.
    The intervals can be over units that have several images: `units` has that of each image.
    """
    # A score of 32 bits reaches the threshold that rounds to it.
    threshold = min(threshold, float(np.float32(threshold)))
    joined = matches.of(labels)
    by_label = [(at_half or matches).of([label]) for label in labels]
    # Classes without objects have no average precision.
    shown = [item for item in by_label if len(item.objects)]

    def mean_precision(counts: np.ndarray) -> np.ndarray:
        values = np.array([[item.average_precision(row) for row in counts] for item in shown])
        is_known = np.isfinite(values)
        with np.errstate(invalid="ignore"):
            return np.where(is_known, values, 0).sum(0) / is_known.sum(0)

    def false_odds(counts: np.ndarray) -> np.ndarray:
        # As odds, a number per image is in [0, 1). Its interval is then one of the logarithm.
        number = joined.false_per_image(threshold, counts)
        return number / (1 + number)

    recall, precision = Estimate(), Estimate()
    if shown:
        groups = _groups(joined)
        recall = estimate(partial(joined.recall, threshold), groups, units)
        precision = estimate(mean_precision, groups, units)
    # The estimate of odds is then turned back into a number per image.
    odds = estimate(false_odds, [np.arange(joined.image_count)], units)
    ends = (odds.value, odds.low, odds.high)
    value, low, high = (None if end is None else end / (1 - end) for end in ends)
    numbers = np.bincount(joined.images_of_false(threshold), minlength=joined.image_count)
    if low is not None and numbers.any() and not np.ptp(numbers):
        from scipy.special import gammaincinv

        # No variance is known, so the interval is that of Poisson for the total number.
        total = numbers.sum()
        low, high = gammaincinv([total, total + 1], [0.025, 0.975]) / joined.image_count
    false_detections = Estimate(value, low, high, odds.over)
    return DetectionMetrics(len(joined.objects), recall, precision, false_detections)


def _groups(matches: Matches) -> list[np.ndarray]:
    """Return the indices of the images with objects, and those of the images without.

    Images of each group are left out by themselves. A rare class then has an interval over the few
    images that show it. With fewer than two images without objects, all images are one group.
    """
    images = np.arange(matches.image_count)
    others = np.setdiff1d(images, matches.objects.image)
    return [images] if len(others) < 2 else [np.unique(matches.objects.image), others]


def estimate(
    statistic: Callable[[np.ndarray], np.ndarray], groups: Sequence[np.ndarray], units: Units | None
) -> Estimate:
    """Compute a statistic in [0, 1] with its 95% interval over units of images, or over images.

    The groups have the indices of all images. The interval is unknown if the first group has
    fewer than MIN_UNITS units, if another has one, or if the statistic is unknown without some.
    """

    image_count = sum(map(len, groups))

    def of_groups(*counts: np.ndarray) -> np.ndarray:
        # How often each image counts, shape (k, n). Groups without left-out units count once.
        weights = np.ones((max(map(len, counts)), image_count))
        for images, of_images in zip(groups, counts, strict=True):
            weights[:, images] = of_images
        return statistic(weights)[None]

    units = units or Units([np.arange(image_count)], "photographs")
    (every_unit,) = units.groups
    unit_of_image = [every_unit[images] for images in groups]
    (result,) = leave_out(of_groups, Units(unit_of_image, units.over))
    # Images without objects do not change the recall, and without detections no precision either.
    # Such a group says nothing about the interval.
    if all((item == result.value).all() for item in result.without[1:]):
        count = len({*unit_of_image[0].tolist()})
        result = replace(result, without=result.without[:1], unit_count=count)
    is_known = all(np.isfinite(item).all() for item in result.without)
    if result.unit_count < 2 or result.without[0].shape[-1] < MIN_UNITS or not is_known:
        return Estimate(float(result.value))
    return result.estimate


def mean_iou(
    images: Iterable[tuple[ClassMap, ClassMap]], class_count: int, units: Units | None = None
) -> tuple[Estimate, list[float]]:
    """Compute the mean IoU over classes, with its interval over images, and that of each class.

    An image has the predicted classes of its pixels and the true ones. The IoU of a class is
    computed from the pixels of all images. It is NaN, and does not count, if no pixel has or is
    given the class. Pixels of the class NO_CLASS_PIXEL are left out.
    """
    counted = []
    for image, mask in images:
        is_scored = mask != NO_CLASS_PIXEL
        guess, truth = image[is_scored], mask[is_scored]
        # Classes of correct pixels, of predicted pixels and of true pixels.
        kinds = truth[guess == truth], guess, truth
        counted.append([np.bincount(values, minlength=class_count) for values in kinds])
    # Numbers of pixels, each of the shape (images, classes).
    both, guesses, truths = np.array(counted, float).transpose(1, 0, 2)

    def by_class(counts: np.ndarray) -> np.ndarray:
        shared = counts @ both
        with np.errstate(invalid="ignore"):
            # IoU = intersection / (predicted + true - intersection).
            return shared / (counts @ (guesses + truths) - shared)

    groups = [np.arange(len(counted))]
    miou = estimate(lambda counts: np.nanmean(by_class(counts), axis=-1), groups, units)
    return miou, by_class(np.ones((1, len(counted))))[0].tolist()
