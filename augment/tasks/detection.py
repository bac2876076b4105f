"""Detection: a network returns boxes with classes and scores, and an attack hides an object.

Scores are compared as log-odds log(s / (1 − s)), which have no bounds. The cost of an image is a
smooth maximum of the log-odds of the true class over the candidates near the object:

    cost = log Σ exp(log-odds)

Candidates are the boxes before non-maximum suppression, if the network returns them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.network import unwrapped
from augment.scene.truth import Truth
from augment.tasks.task import NO_CLASS, GetTruth, ObjectCriterion, Task, stored_names, unique_names
from renderer import errors
from renderer.errors import InputError
from renderer.image import to_bytes, to_unit

# What an attack on a detector reaches: no box of the true class, or a box of another class.
HIDE, MISLABEL = "hide", "mislabel"
# Candidates are near an object if their IoU with its box is at least this fraction of `iou`.
NEAR = 0.5
# Scores closer to 0 or 1 than this have the log-odds of this score.
SMALLEST_SCORE = 1e-6
# Boxes that `decode` returns are removed if a better box of their class has a larger IoU.
MAX_OVERLAP = 0.5
# Keys of the candidates in an output: boxes (K, 4), and scores of all classes (K, C) or, with
# labels (K,), of one class (K,).
CANDIDATE_BOXES, CANDIDATE_SCORES = "candidate_boxes", "candidate_scores"
CANDIDATE_LABELS = "candidate_labels"
CANDIDATES_OF = CANDIDATE_BOXES, CANDIDATE_SCORES, CANDIDATE_LABELS
# Keys of the final boxes in an output.
FINAL = "boxes", "scores", "labels"
# Candidates of a detector of torchvision are so many boxes with the highest scores above this one.
MAX_CANDIDATES, CANDIDATE_SCORE = 5000, 1e-4
# Boxes of one image: "boxes" (n, 4) in pixels, "labels" (n,) and "scores" (n,), and candidates.
Detections = dict[str, Tensor]


@dataclass(frozen=True)
class Detection(Task):
    """Task of a network that returns boxes with classes and scores.

    A network takes images (N, 3, H, W) in [0, 1]. It returns a list of a
    dictionary for each image: "boxes" (left, top, right, bottom, in pixels),
    "labels" and "scores". Detection models of torchvision do so, and the object
    detectors of transformers and models of Ultralytics are read as well.
    Labels are indices of the argument `classes` of `nb.attack`. Detectors of
    torchvision for COCO and those of the other two name their classes
    themselves.

    Args:
        threshold: Boxes with a lower score do not count.
        iou: Boxes with a lower intersection over union with the box of the
            object do not count.
        goal: "hide" succeeds if no box of the true class counts. "mislabel"
            succeeds if a box of another class counts, and has a higher score
            than every such box of the true class.
        decode: Function from the outputs of a raw network to such a list.
            Instead of "labels", a dictionary may have scores (K, C) of all
            classes, and each box is of its best class. Boxes that overlap a
            better box of their class with an IoU above 0.5 are removed. The
            attack lowers the scores of all boxes. None if the network needs no
            function.

    Raises:
        InputError: If an argument is out of its range.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> def find_bright(images):
        ...     box = torch.tensor([[0.0, 0.0, 16.0, 16.0]])
        ...     label = torch.tensor([0])
        ...     scores = images.mean((1, 2, 3))[:, None]
        ...     return [{"boxes": box, "labels": label, "scores": score} for score in scores]
        >>> scene = nb.build_scene([("solid:ball", "ball")], size=16, width=2)
        >>> task = nb.Detection(threshold=0.2, iou=0.2)
        >>> light = nb.StepSettings(step_size=0.5)
        >>> settings = nb.AttackSettings(lighting=light, max_steps=20, allow_negative=True)
        >>> result = nb.attack(find_bright, scene, task=task, settings=settings, classes=["ball"])
        >>> result.success
        tensor([True])
    """

    name = "detection"
    returns = "a list of a dictionary for each image (boxes, labels, scores)"
    confidence = "score at the object"
    finds = "detections", "still detects"

    threshold: float = 0.4
    iou: float = 0.5
    goal: str = HIDE
    decode: Callable[[Any], Any] | None = None

    def __post_init__(self) -> None:
        errors.require_number("threshold", self.threshold, SMALLEST_SCORE, 1 - SMALLEST_SCORE)
        errors.require_number("iou", self.iou, 0.01, 1)
        errors.require_choice("goal", self.goal, (HIDE, MISLABEL))

    def recognizes(self, outputs: Any) -> bool:
        """Return whether outputs are dictionaries of boxes, or those of a library of detectors."""
        if _has_final_boxes(outputs) or _is_ultralytics(outputs):
            return True
        is_list = isinstance(outputs, list | tuple) and len(outputs) > 0
        return is_list and all(isinstance(item, Mapping) and "boxes" in item for item in outputs)

    def class_names(self, network: Any, count: int | None) -> Sequence[str] | None:
        """Return the names of COCO for torchvision, or those that transformers stores."""
        names = stored_names(unwrapped(network))
        # Detectors of torchvision for COCO have this many classes, with background and gaps.
        if not names and _torchvision_count(network) == 91:
            from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights as Weights

            # The names of COCO by the numbers that torchvision's detectors return.
            names = Weights.COCO_V1.meta["categories"]
        return unique_names(names) or None

    def output_count(self, network: Any, outputs: Any) -> int | None:
        """Return the number of classes of the network, which may have a background as class 0."""
        return len(stored_names(unwrapped(network))) or _torchvision_count(network)

    def outputs(self, network: Any, images: Tensor) -> Any:
        """Return the outputs of a network. Those of torchvision get candidates, too.

        The boxes before non-maximum suppression have the smallest scores, too, so that an attack
        can raise those of another class. The network runs once.
        """
        raw = unwrapped(network)
        # Module that computes the final boxes. In networks of two stages, it is `roi_heads`.
        owner = getattr(raw, "roi_heads", raw)
        original: Any = getattr(owner, "postprocess_detections", None)
        # A subclass may suppress boxes in another way.
        module = getattr(original, "__module__", "")
        if not (_is_of_torchvision(raw) and module.startswith("torchvision.")):
            return network(images)
        from torchvision.ops import boxes as box_ops  # torchvision takes half a second.

        suppress, threshold = box_ops.batched_nms, owner.score_thresh
        # Candidates of each image, and the (height, width) to which the network resized it.
        candidates: list[list[Tensor]] = []
        sizes: list[Any] = []

        # Suppression gets all boxes, and passes on those above the threshold of the network.
        def keep_candidates(boxes: Tensor, scores: Tensor, labels: Tensor, limit: float) -> Tensor:
            best = scores.argsort(descending=True, stable=True)[:MAX_CANDIDATES]
            candidates.append([boxes[best], scores[best], labels[best]])
            sure = (scores > threshold).nonzero()[:, 0]
            return sure[suppress(boxes[sure], scores[sure], labels[sure], limit)]

        # This replaces `postprocess_detections`. It returns the same boxes.
        def postprocess(*args: Any) -> Any:
            sizes.extend(args[-1])
            try:
                owner.score_thresh = min(threshold, CANDIDATE_SCORE)
                box_ops.batched_nms = keep_candidates
                return original(*args)
            finally:
                owner.score_thresh, box_ops.batched_nms = threshold, suppress

        owner.postprocess_detections = postprocess
        try:
            outputs = network(images)
        finally:
            # The method of the class counts again.
            del owner.postprocess_detections
        for item, found, (height, width) in zip(outputs, candidates, sizes, strict=True):
            # The network resizes images. The final boxes are in the pixels of the given images.
            scale = torch.tensor([images.shape[3] / width, images.shape[2] / height] * 2)
            item |= zip(CANDIDATES_OF, (found[0] * scale.to(found[0]), *found[1:]), strict=True)
        return outputs

    def reader(self, title: str, class_count: int | None = None) -> _Reader:
        """Return a function that brings outputs into the form of torchvision, and checks them."""
        return _Reader(self, title, class_count)

    def criterion(self, source: Tensor, truth: GetTruth, class_count: int) -> DetectionCriterion:
        """Return the criterion of an untargeted attack on the first object of each example."""
        if self.goal == MISLABEL and class_count < 2:
            raise InputError("goal='mislabel' needs a second class: name it, or leave the goal out")
        boxes = truth().first_boxes()
        return DetectionCriterion(source, task=self, class_count=class_count, boxes=boxes)

    def as_found(
        self, outputs: list[Detections], classes: Sequence[str]
    ) -> tuple[Int[Tensor, " E"], DetectionCriterion]:
        """Return the criterion of an attack on each sure box, except those of a background."""
        # The boxes of all images in one list, and the index of the image of each box.
        boxes, scores, labels = (torch.cat([item[key] for item in outputs]) for key in FINAL)
        image = torch.repeat_interleave(torch.tensor([len(item["scores"]) for item in outputs]))
        options: dict[str, Any] = {"task": self, "class_count": len(classes)}
        criterion = DetectionCriterion(labels[:, None], boxes=boxes[:, None], **options)
        is_background = torch.tensor(self.are_background(classes), device=labels.device)
        is_found = (scores >= self.threshold) & ~is_background[labels]
        image, criterion = image[is_found.cpu()], criterion.select(is_found)
        # Each example has one view, so its single image can be judged without the axis of views.
        flat = criterion.map(lambda rows: rows[:, 0])
        evidence = flat.evidence([outputs[index] for index in image.tolist()])
        # A box at which another class is surer is mislabeled already.
        kept = flat.predicted(evidence) == flat.source
        return image[kept.cpu()], criterion.select(kept)

    def require_target(self, target: Any) -> None:
        """Check that boxes of another class are the goal of the attack."""
        if self.goal != MISLABEL or target == "least_likely":
            advice = "leave it out, or set goal='mislabel' and name a class"
            raise InputError(f"target is {errors.describe(target)} for {self}: {advice}")

    def draw(self, image: Tensor, output: Detections, classes: Sequence[str]) -> Tensor:
        """Draw the boxes whose scores reach the threshold, with their classes and scores."""
        from torchvision.utils import draw_bounding_boxes  # torchvision takes half a second.

        is_drawn = output["scores"] >= self.threshold
        scores, labels = output["scores"][is_drawn].tolist(), output["labels"][is_drawn].tolist()
        if not scores:
            return image
        pairs = zip(labels, scores, strict=True)
        names = [f"{classes[label]} {score:.0%}" for label, score in pairs]
        boxes = output["boxes"][is_drawn].detach()
        return to_unit(draw_bounding_boxes(to_bytes(image), boxes, names, colors="lime")).to(image)


@dataclass(frozen=True)
class DetectionCriterion(ObjectCriterion):
    """Criterion of an attack on a detector: boxes near the true box of an object.

    The evidence of a class is the log-odds of its best box whose IoU with the true box is at least
    `task.iou`. The limit is the log-odds of the threshold.

    Attributes:
        task: Threshold, IoU and goal.
        class_count: Number C of classes.
        boxes: True box of each view, in pixels. 0 outside of the view, which counts as found.
    """

    task: Detection = field(kw_only=True)
    class_count: int = field(kw_only=True)
    boxes: Float[Tensor, "*E V 4"] = field(kw_only=True)

    def at(self, truth: Truth) -> Self:
        """Return a copy for other boxes."""
        return replace(self, boxes=truth.boxes[..., 0, :])

    def evidence(self, outputs: list[Detections]) -> Float[Tensor, "N K"]:
        """Return the log-odds of each class at the object, and of the threshold."""
        rows = []
        for item, box, source in zip(outputs, self.boxes, self.source.tolist(), strict=True):
            scores = item["scores"].detach()
            # Largest score of each class near the object, and then the threshold.
            best_scores = scores.new_full((self.class_count + 1,), SMALLEST_SCORE)
            is_near = _iou(item["boxes"], box) >= self.task.iou
            best_scores.scatter_reduce_(0, item["labels"][is_near], scores[is_near], "amax")
            best_scores[-1] = self.task.threshold
            # An object outside of the view counts as found.
            if not box.any():
                best_scores[source] = 1.0
            # In float64, log-odds differ where scores differ in their last digit.
            rows.append(log_odds_of(best_scores.double()))
        empty = self.boxes.new_zeros(0, self.class_count + 1, dtype=torch.float64)
        return torch.stack(rows) if rows else empty

    def cost(self, outputs: list[Detections]) -> Float[Tensor, " N"]:
        """Return the smooth maximum of the true class, minus that of the others to mislabel."""
        columns = torch.arange(self.class_count, device=self.source.device)
        costs = []
        rows = zip(outputs, self.boxes, self.source, self.targets, strict=True)
        for item, box, source, target in rows:
            # Without candidates, the final boxes stand for them.
            boxes = item.get(CANDIDATE_BOXES, item["boxes"])
            scores = item.get(CANDIDATE_SCORES, item["scores"])
            is_near = _iou(boxes, box) >= NEAR * self.task.iou
            near = scores[is_near]
            if scores.ndim == 1:
                labels = item.get(CANDIDATE_LABELS, item["labels"])[is_near]
                # Scores of all classes, which are 0 for those that are not the label.
                zeros = near.new_zeros(len(near), self.class_count)
                near = zeros.scatter(1, labels[:, None], near[:, None])
            # The first row is the smallest score, so that an image without candidates has a cost.
            smallest = scores.new_full((1, self.class_count), SMALLEST_SCORE)
            odds = log_odds_of(torch.cat([smallest, near]))
            # The smooth maximum log Σ exp gives all boxes near the object a gradient.
            cost = odds[:, source].logsumexp(0)
            if self.task.goal == MISLABEL:
                is_other = columns != source if target == NO_CLASS else columns == target
                cost = cost - odds[:, is_other].flatten().logsumexp(0)
            costs.append(cost)
        return torch.stack(costs)

    def gap(self, evidence: Float[Tensor, "... K"]) -> Float[Tensor, " ..."]:
        """Return the limit minus the true class or, to mislabel, another class minus both."""
        if self.task.goal == HIDE:
            return super().gap(evidence)
        own, limit, others = self.split(evidence)
        # Without a target, any other class must exceed both the true class and the limit.
        if self.target is None:
            return others.amax(-1) - own.maximum(limit)
        target = self.target[..., None]
        # The target must exceed all other classes and the limit, which is the last column.
        rest = evidence.scatter(-1, target, -torch.inf).amax(-1)
        return evidence.gather(-1, target)[..., 0] - rest

    def predicted(self, evidence: Float[Tensor, "... K"]) -> Int[Tensor, " ..."]:
        """Return the true class while it is found or, to mislabel, while no other is better."""
        predicted = super().predicted(evidence)
        if self.task.goal == HIDE:
            return predicted
        own, limit, others = self.split(evidence)
        best, index = others.max(-1)
        return torch.where((best > own) & (best >= limit), index, predicted)

    def reached_in_views(self, predicted: Int[Tensor, " ..."]) -> Tensor:
        """Return a mask of the views that reach the criterion. Nothing is no other class."""
        reached = super().reached_in_views(predicted)
        return reached & (predicted != self.class_count) if self.task.goal == MISLABEL else reached


@dataclass(frozen=True)
class _Reader:
    """Function that brings outputs of a detector into the form of torchvision, and checks them."""

    task: Detection
    title: str
    class_count: int | None

    def __call__(self, outputs: Any, images: Float[Tensor, "N 3 H W"]) -> list[Detections]:
        title, task = self.title, self.task
        # Whether boxes have not passed non-maximum suppression yet.
        is_raw = task.decode is not None
        if task.decode is not None:
            given, title = outputs, f"decode of {title}"
            with errors.explained(f"{title} fails on {errors.describe(given)}"):
                outputs = task.decode(given)
        elif _has_final_boxes(outputs):
            outputs = _of_transformer(outputs, images, title, self.class_count)
        if _is_ultralytics(outputs):
            outputs, is_raw = _of_ultralytics(outputs[0]), True
            title += " (read as of Ultralytics; others need nb.Detection(decode=...))"
        if not len(images):
            return []
        if not task.recognizes(outputs) or len(outputs) != len(images):
            reason = f"{title} returned {errors.describe(outputs)} for {len(images)} images"
            raise InputError(f"{reason}: it must return {task.returns}")
        reader = replace(self, title=title)
        return [reader.detections(item, images, is_raw) for item in outputs]

    def detections(self, item: Mapping[str, Any], images: Tensor, is_raw: bool) -> Detections:
        """Check the boxes of one image. Raw boxes become candidates, and lose their duplicates."""
        found: Detections = {}
        for keys in FINAL, CANDIDATES_OF:
            if keys[0] in item:
                tensors = {key: errors.as_tensor(key, item[key]) for key in keys if key in item}
                found |= self.checked(keys, tensors, images)
        if "labels" not in found:
            # Scores (n, C) of all classes: each final box gets its best class.
            found[CANDIDATE_BOXES], found[CANDIDATE_SCORES] = found["boxes"], found["scores"]
            found["scores"], found["labels"] = found["scores"].max(1)
        self.require_possible(found, *images.shape[2:])
        if is_raw:
            from torchvision.ops import batched_nms  # torchvision takes half a second.

            boxes, scores, labels = (found[key] for key in FINAL)
            if CANDIDATE_BOXES not in found:
                found |= zip(CANDIDATES_OF, (boxes, scores, labels), strict=True)
            kept = batched_nms(boxes.detach(), scores.detach(), labels, MAX_OVERLAP)
            found |= {key: found[key][kept] for key in FINAL}
        return found

    def checked(self, keys: Sequence[str], found: Detections, images: Tensor) -> Detections:
        """Return the boxes, scores and labels of an output, after checks of shapes and ranges."""
        title, class_count = self.title, self.class_count
        # Labels keep their digits, which half precision cannot hold.
        found = {key: found[key].to(images if key in keys[:2] else images.device) for key in found}
        boxes = found[keys[0]]
        if not boxes.numel():
            boxes = found[keys[0]] = boxes.reshape(0, 4)
        # A scalar in place of missing scores has the wrong shape, which raises the error below.
        scores = found.setdefault(keys[1], boxes.new_zeros(()))
        labels = found.get(keys[2])
        # Without labels, there is a score for each class.
        columns = () if labels is not None else (class_count or scores.shape[-1:].numel(),)
        is_labeled = labels is None or labels.shape == boxes.shape[:1]
        if boxes.shape[1:] != (4,) or scores.shape != (len(boxes), *columns) or not is_labeled:
            shapes = ", ".join(f"{key} {tuple(value.shape)}" for key, value in found.items())
            advice = f"labels (n,) and scores (n,), or scores (n, {class_count or 'classes'})"
            raise InputError(f"{title} returned {shapes}: give boxes (n, 4), and {advice}")
        scores = scores.detach()
        if not scores.isfinite().all() or not boxes.isfinite().all():
            raise InputError(f"{title} returned NaN or infinite scores or boxes: check them")
        if scores.numel() and not (scores.min() >= 0 and scores.max() <= 1):
            span = f"from {float(scores.min()):g} to {float(scores.max()):g}"
            raise InputError(f"{title} returned scores {span}: give probabilities from 0 to 1")
        if labels is None:
            return found
        if not torch.equal(labels, labels.round()):
            raise InputError(f"{title} returned labels with fractions: give indices of classes")
        last = (class_count or int(1e9)) - 1
        if len(labels) and not (labels.min() >= 0 and labels.max() <= last):
            span = f"from {int(labels.min())} to {int(labels.max())}"
            advice = "give indices of classes, from 0" + f" to {last}" * bool(class_count)
            raise InputError(f"{title} returned labels {span}: {advice}")
        return found | {keys[2]: labels.detach().long()}

    def require_possible(self, found: Detections, height: int, width: int) -> None:
        """Check the boxes whose scores reach the threshold."""
        is_sure = found["scores"] >= self.task.threshold
        left, top, right, bottom = found["boxes"].detach()[is_sure].unbind(1)
        if (right < left).any() or (bottom < top).any():
            advice = "give left, top, right, bottom, and not width and height"
            raise InputError(f"{self.title} returned boxes that end before they begin: {advice}")
        # A box outside of the image that a detector has clipped lies on the border.
        is_outside = (left > width) | (right < 0) | (top > height) | (bottom < 0)
        # Boxes that all end within the first pixel are probably in units of the image size.
        is_fraction = len(right) > 0 and bool((right <= 1).all() & (bottom <= 1).all())
        if is_outside.any() or (is_fraction and min(height, width) > 1):
            reason = "fractions of the image" if is_fraction else "outside of the image"
            advice = f"give pixels, up to {width} across and {height} down"
            raise InputError(f"{self.title} returned boxes that are {reason}: {advice}")


def _iou(boxes: Float[Tensor, "K 4"], box: Float[Tensor, " 4"]) -> Float[Tensor, " K"]:
    """Compute the intersection over union of boxes with a box. It is NaN without an area."""
    from torchvision.ops import box_iou  # torchvision takes half a second.

    return box_iou(boxes.detach(), box.to(boxes)[None])[:, 0]


def log_odds_of(scores: Tensor) -> Tensor:
    """Return log(s / (1 − s)) of scores, whose gradient does not vanish at scores of 0 and 1."""
    limited = scores.clamp(SMALLEST_SCORE, 1 - SMALLEST_SCORE)
    # The sum has the value of the limited scores, but the gradient of the scores.
    return torch.logit(scores + (limited - scores).detach())


def _has_final_boxes(outputs: Any) -> bool:
    """Return whether outputs are boxes that need no suppression, as those of transformers.

    RT-DETR of Ultralytics returns such boxes and five parts.
    """
    keys = {*outputs} if isinstance(outputs, Mapping) else set()
    if hasattr(outputs, "pred_boxes") or {"logits", "pred_boxes"} <= keys:
        return True
    return _is_ultralytics(outputs) and isinstance(outputs[1], tuple) and len(outputs[1]) == 5


def _of_transformer(
    outputs: Any, images: Tensor, title: str, class_count: int | None
) -> list[dict[str, Tensor]]:
    """Read logits, and boxes as center and size in fractions of the image.

    With a logit more than classes, the last is "no object", and each box has its best class.
    Otherwise, logits of classes are independent, and the best pairs of box and class are returned.
    A single logit is that of a class.
    """
    if isinstance(outputs, tuple):
        # RT-DETR of Ultralytics returns those of each layer of its decoder.
        fractions, logits = (layers[-1] for layers in outputs[1][:2])
    else:
        given = outputs if isinstance(outputs, Mapping) else vars(outputs)
        logits, fractions = given["logits"], given["pred_boxes"]
    # Number of classes, maybe with "no object".
    columns = logits.shape[-1]
    if class_count not in (None, columns, columns - 1):
        advice = f"give {columns} names, or one less if the last logit is for no object"
        raise InputError(f"{title} returned {columns} logits for {class_count} classes: {advice}")
    center, size = fractions[..., :2], fractions[..., 2:]
    # Width, height, width and height of the images, for left, top, right and bottom.
    scale = fractions.new_tensor([images.shape[3], images.shape[2]] * 2)
    boxes = torch.cat([center - size / 2, center + size / 2], dim=-1) * scale
    if columns not in (1, class_count):
        pairs = zip(boxes, logits.softmax(-1)[..., :-1], strict=True)
        return [{"boxes": one, "scores": scores} for one, scores in pairs]
    found = []
    for one, scores in zip(boxes, logits.sigmoid(), strict=True):
        # As many pairs as boxes. The flat index of a pair is box · columns + class.
        best = scores.flatten().topk(len(one))
        row = best.indices.div(columns, rounding_mode="floor")
        chosen = {"boxes": one[row], "labels": best.indices % columns, "scores": best.values}
        found.append(chosen | {CANDIDATE_BOXES: one, CANDIDATE_SCORES: scores})
    return found


def _is_ultralytics(outputs: Any) -> bool:
    """Return whether outputs are a tensor of boxes, and what Ultralytics computes it from."""
    is_pair = isinstance(outputs, tuple) and len(outputs) == 2
    is_batch = is_pair and isinstance(outputs[0], Tensor) and outputs[0].ndim == 3
    return is_batch and (outputs[0].shape[1] > 4 or outputs[0].shape[2] == 6)


def _of_ultralytics(outputs: Tensor) -> list[dict[str, Tensor]]:
    """Read rows (N, n, 6) of box, score and label, or columns (N, 4 + C, K) of box and scores.

    Rows begin with left, top, right and bottom, and columns with center and size, in pixels.
    """
    if outputs.shape[2] == 6:
        columns = outputs[..., :4], outputs[..., 4], outputs[..., 5].detach()
        return [dict(zip(FINAL, of_image, strict=True)) for of_image in zip(*columns, strict=True)]
    # The transpose has a row for each box, shape (N, K, 4 + C).
    center, size = outputs.mT[..., :2], outputs.mT[..., 2:4]
    boxes = torch.cat([center - size / 2, center + size / 2], dim=-1)
    pairs = zip(boxes, outputs.mT[..., 4:], strict=True)
    return [{"boxes": one, "scores": scores} for one, scores in pairs]


def _is_of_torchvision(raw: Any) -> bool:
    """Return whether a network is a detector of torchvision, or of a subclass."""
    names = [kind.__module__ for kind in type(raw).__mro__]
    return any(name.startswith("torchvision.models.detection") for name in names)


def _torchvision_count(network: Any) -> int | None:
    """Return the number of classes of a detector of torchvision, with the background as class 0."""
    raw = unwrapped(network)
    if not _is_of_torchvision(raw):
        return None
    # Heads of one stage store the number. Heads of two stages have a layer `cls_score` of so many
    # outputs. A backbone may store its own number.
    heads = (child for name, child in raw.named_children() if name != "backbone")
    for module in (module for head in heads for module in head.modules()):
        for name in ("num_classes", "num_columns"):
            if isinstance(getattr(module, name, None), int):
                return int(getattr(module, name))
        if hasattr(module, "cls_score"):
            return int(module.cls_score.out_features)
    return None
