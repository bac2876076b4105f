"""Loss and validation of a detector in training.

The label of a render is a map of its objects, which is shifted and flipped with the image. On
photographs, whose objects are unknown, the network before the training is the teacher: its own
detections in the unchanged photograph are what the network shall find, also in other light. A raw
network, whose outputs the task decodes, has no losses of its own: the scores and boxes of all its
candidates shall stay.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy

from augment import distributed
from augment.classifier import TaskNetwork
from augment.network import device_of, eval_mode
from augment.scene.truth import NO_OBJECT, boxes_of
from augment.tasks import detection
from augment.tasks.detection import SMALLEST_SCORE, Detection
from renderer.errors import InputError, describe, explained
from renderer.image import to_unit
from renderer.settings import height_and_width
from train.data.sets import Split
from train.device import all_reduce_sum
from train.results.detections import Found, Marked, match
from train.settings import TrainSettings
from train.training.augmentations import Images

# Number of photographs in a pass of the validation.
BATCH = 32
# In other light, a network is less sure, and its scores fall below the threshold. So the scores
# that its teacher gives count twice there.
FAVOR = 2.0
# A pixel of a map has the class of its object + MAX_CLASSES · the index of the object.
MAX_CLASSES = 2**16
# What a detector takes in training: "boxes", "labels" and "masks" of the objects of an image.
Target = dict[str, Tensor]
# Which images of a batch are renders.
Mask = Bool[Tensor, " B"]


def object_maps(targets: Sequence[Target]) -> Int[Tensor, "E 1 H W"]:
    """Return the maps of the objects of images, which are NO_OBJECT in front of the background."""
    maps = []
    for item in targets:
        places = torch.arange(len(item["labels"]), dtype=torch.int32)
        numbers = 1 + item["labels"].int() + MAX_CLASSES * places
        layers = item["masks"] * numbers[:, None, None]
        maps.append(torch.cat([layers.new_zeros(1, *layers.shape[1:]), layers]).amax(0) - 1)
    return torch.stack(maps)[:, None]


def target_of(objects: Int[Tensor, "1 H W"]) -> Target:
    """Return the objects in the map of an image, with the boxes of their visible parts."""
    numbers = objects[objects != NO_OBJECT].unique()
    masks = objects == numbers[:, None, None]
    return {"boxes": boxes_of(masks), "labels": numbers.long() % MAX_CLASSES, "masks": masks.byte()}


def losses_of(network: nn.Module, images: Tensor, targets: Sequence[Target]) -> Float[Tensor, ""]:
    """Return the sum of the losses that a detector of torchvision returns in training mode."""
    losses = network(images, targets)
    if not isinstance(losses, Mapping) or not losses:
        fault = f"network returned {describe(losses)} in training mode"
        raise InputError(f"{fault}: return losses by name, as the detectors of torchvision do")
    return torch.stack([*losses.values()]).sum()


def require_losses(network: TaskNetwork, needs_boxes: bool) -> None:
    """Check that a detector returns losses in training mode, for gray images without objects.

    A raw network has none: its candidates are compared with those of the teacher, and boxes of
    renders cannot train it.
    """
    if isinstance(network.task, Detection) and network.task.decode is not None:
        if needs_boxes:
            raise InputError("meshes: a raw network returns no losses: give no meshes, or another")
        return
    copy = deepcopy(network.network).train()
    # Batch normalization in training mode needs two images.
    images = torch.full((2, 3, *height_and_width(network.size)), 0.5, device=device_of(copy))
    # Maps without objects, shape (2, 1, H, W).
    nothing = torch.full_like(images[:, :1], NO_OBJECT, dtype=torch.int32)
    fault = "network fails on images and targets in training mode"
    with explained(fault, "return losses as the detectors of torchvision do"):
        losses_of(copy, images, [*map(target_of, nothing)])


@dataclass
class DetectionLoss:
    """Loss of a detector on a batch of training images, some of which are renders.

    Each image has the losses that the detector itself computes in training mode or, if the task
    decodes its outputs, `candidate_loss`. They count `distillation_weight` times on photographs
    with the detections of the teacher, and `consistency_weight` times on the augmented photographs
    with the same detections.
    """

    model: nn.Module
    settings: TrainSettings
    teacher: nn.Module | None
    task: Detection

    def compute(
        self, images: Images, labels: Tensor, rendered: Mask, augmented: Images | None = None
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Compute the loss of a batch.

        `labels` are maps if there are renders. Return the loss and, in place of the number of
        correct predictions, NaN: a detector in training mode predicts nothing.
        """
        is_photograph = ~rendered
        # Weight, images, what they are compared with (targets or the teacher's detections), and
        # how much more a score counts that the teacher gives than one that it does not.
        terms: list[tuple[float, Tensor, Any, float]] = []
        if rendered.any():
            terms.append((1.0, images[rendered], [*map(target_of, labels[rendered])], 1.0))
        if self.teacher is not None and is_photograph.any():
            find = detected if self.task.decode is None else candidates
            with torch.no_grad(), eval_mode(self.teacher):
                found = find(self.teacher, images[is_photograph], self.task)
            terms.append((self.settings.distillation_weight, images[is_photograph], found, 1.0))
            if augmented is not None:
                shown = augmented[is_photograph]
                terms.append((self.settings.consistency_weight, shown, found, FAVOR))
        loss = images.new_zeros((), dtype=torch.float32)
        for weight, shown, found, favor in terms:
            if weight:
                # Each term counts in proportion to its share of the images of the batch.
                loss = loss + weight * len(shown) / len(images) * self._loss(shown, found, favor)
        return loss, torch.full_like(loss, torch.nan).detach()

    def _loss(self, images: Images, targets: Any, favor: float) -> Float[Tensor, ""]:
        if self.task.decode is None:
            return losses_of(self.model, to_unit(images), targets)
        return candidate_loss(candidates(self.model, images, self.task), targets, favor)


# Boxes and scores of the K candidates of each image.
Candidates = list[tuple[Tensor, Tensor]]


def candidates(network: nn.Module, images: Images, task: Detection) -> Candidates:
    """Return boxes (K, 4) in pixels and scores (K, C) of all candidates of a raw network."""
    unit = to_unit(images)
    outputs = task.reader("network")(network(unit), unit)
    if any(detection.CANDIDATE_LABELS in item for item in outputs):
        raise InputError("decode returned labels: training needs the scores (K, C) of all classes")
    return [(item[detection.CANDIDATE_BOXES], item[detection.CANDIDATE_SCORES]) for item in outputs]


def candidate_loss(found: Candidates, expected: Candidates, favor: float) -> Float[Tensor, ""]:
    """Return the mean over images of the change of the candidates since the teacher.

    The change of a score is the Kullback-Leibler divergence of its Bernoulli distribution, whose
    positive part counts `favor` times. The change of a box is 1 - GIoU, and counts as often as the
    best score of the teacher says.
    """
    from torchvision.ops import generalized_box_iou_loss  # torchvision takes half a second.

    changes = []
    for (boxes, scores), (old_boxes, old_scores) in zip(found, expected, strict=True):
        if boxes.shape != old_boxes.shape:
            reason = f"decode returned {len(old_boxes)} and {len(boxes)} boxes for two images"
            raise InputError(f"{reason}: return all candidates, whose number is always the same")
        # The entropy of the teacher is subtracted, so that equal scores have the loss 0.
        old = old_scores.clamp(SMALLEST_SCORE, 1 - SMALLEST_SCORE)
        # The loss has its minimum where the odds are `favor` times those of the teacher.
        weights = 1 + (favor - 1) * old
        target = favor * old / weights
        options: dict[str, Any] = {"weight": weights, "reduction": "sum"}
        entropy = binary_cross_entropy(target, target, **options)
        changes.append(binary_cross_entropy(scores, target, **options) - entropy)
        # The best score of each candidate over the classes is the weight of its box.
        changes.append((old_scores.amax(1) * generalized_box_iou_loss(boxes, old_boxes)).sum())
    return torch.stack(changes).sum() / len(found)


@torch.no_grad()
def detected(network: nn.Module, images: Images, task: Detection) -> list[Target]:
    """Return the objects in images that a network finds with a score of at least the threshold.

    They have masks if the network itself returns masks, as those of torchvision (n, 1, H, W).
    """
    unit = to_unit(images)
    with eval_mode(network):
        raw = network(unit)
    targets = []
    for index, item in enumerate(task.reader("network")(raw, unit)):
        width, height = (item["boxes"][:, 2:] - item["boxes"][:, :2]).unbind(1)
        # A box without an area cannot be learned.
        is_kept = (item["scores"] >= task.threshold) & (width > 0) & (height > 0)
        target = {key: item[key][is_kept] for key in ("boxes", "labels")}
        # A raw network has no masks, since `decode` makes boxes only.
        if task.decode is None and isinstance(raw, list) and "masks" in raw[index]:
            target["masks"] = (raw[index]["masks"][is_kept, 0] >= 0.5).byte()
        targets.append(target)
    return targets


def validate(
    network: nn.Module, teacher: nn.Module, task: Detection, split: Split
) -> dict[str, float]:
    """Measure which fraction of the boxes of the teacher in photographs a network finds, too.

    Return it as "accuracy", and its complement as "loss".
    """
    device = split.labels.device
    rows = torch.arange(len(split), device=device)[distributed.rank() :: distributed.world_size()]
    # Boxes of the teacher that the network finds, too, and all boxes of the teacher.
    counts = torch.zeros(2, device=device)
    # With few photographs, a process has none, and not every network takes an empty batch.
    for images in split.squares(rows.split(BATCH) if len(rows) else ()):
        pair = (detected(one, images.to(device), task) for one in (teacher, network))
        for expected, found in zip(*pair, strict=True):
            boxes, labels = (found[key].cpu().numpy() for key in ("boxes", "labels"))
            old_boxes, old_labels = (expected[key].cpu().numpy() for key in ("boxes", "labels"))
            # The labels of a teacher are never below 0, so no box is a crowd.
            marked = Marked(old_boxes, old_labels, is_crowd=old_labels < 0)
            # The scores are 0 for all, since only the overlap with a box of the teacher decides.
            objects = match(Found(boxes, labels, scores=labels * 0.0), marked, task.iou)
            counts += torch.tensor([(objects >= 0).sum(), len(old_labels)], device=device)
    kept, total = all_reduce_sum(counts).tolist()
    accuracy = kept / total if total else 1.0
    return {"loss": 1 - accuracy, "accuracy": accuracy}
