"""Loss and validation of a detector in training.

The label of an image is a table of boxes with the columns class, left, top, right and bottom. On
photographs, whose objects are unknown, the network before the training is the teacher: its own
detections in the unchanged photograph are the boxes that the network shall find, also in other
light.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from augment import distributed
from augment.classifier import TaskNetwork
from augment.network import device_of, eval_mode
from augment.scene.truth import NO_OBJECT
from augment.tasks.detection import Detection
from renderer.errors import InputError, describe, single_line
from renderer.image import to_unit
from renderer.settings import height_and_width
from train.data.sets import Split
from train.device import all_reduce_sum
from train.results.detections import Found, Marked, match
from train.train_settings import TrainSettings

# Number of photographs in a pass of the validation.
BATCH = 32
# What a detector takes and returns in training: "boxes" and "labels" of each image.
Target = dict[str, Tensor]


def box_tables(targets: Sequence[Target]) -> Float[Tensor, "E O 5"]:
    """Return the tables of boxes of images. Rows of the class NO_OBJECT fill short tables."""
    tables = [torch.cat([item["labels"][:, None], item["boxes"]], dim=1) for item in targets]
    return nn.utils.rnn.pad_sequence(tables, batch_first=True, padding_value=NO_OBJECT)


def target_of(table: Float[Tensor, "O 5"]) -> Target:
    """Return the boxes in the table of an image."""
    shown = table[table[:, 0] != NO_OBJECT]
    return {"boxes": shown[:, 1:], "labels": shown[:, 0].long()}


def losses_of(network: nn.Module, images: Tensor, targets: Sequence[Target]) -> Float[Tensor, ""]:
    """Return the sum of the losses that a detector of torchvision returns in training mode."""
    losses = network(images, targets)
    if not isinstance(losses, Mapping) or not losses:
        raise InputError(
            f"network returned {describe(losses)} in training mode: it must take images and "
            "targets and return its losses by name, as the detectors of torchvision do"
        )
    return torch.stack([*losses.values()]).sum()


def require_losses(network: TaskNetwork) -> None:
    """Check that a detector returns losses in training mode, for one gray image without objects."""
    copy = deepcopy(network.network).train()
    image = torch.full((1, 3, *height_and_width(network.size)), 0.5, device=device_of(copy))
    empty = {"boxes": image.new_zeros(0, 4), "labels": image.new_zeros(0, dtype=torch.int64)}
    try:
        losses_of(copy, image, [empty])
    except InputError:
        raise
    except Exception as error:  # Networks of users raise errors of many kinds.
        raise InputError(
            f"network fails on images and targets in training mode ({single_line(error)}): it must "
            "return its losses by name, as the detectors of torchvision do"
        ) from error


@dataclass
class DetectionLoss:
    """Loss of a detector on a batch of training images, some of which are renders.

    Each image has the losses that the detector itself computes in training mode. They count
    `distillation_weight` times on photographs with the boxes of the teacher, and
    `consistency_weight` times on the augmented photographs with the same boxes.
    """

    model: nn.Module
    settings: TrainSettings
    teacher: nn.Module | None
    task: Detection

    def compute(
        self,
        images: UInt8[Tensor, "B 3 H W"],
        labels: Tensor,
        rendered: Bool[Tensor, " B"],
        augmented: UInt8[Tensor, "B 3 H W"] | None = None,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Compute the loss of a batch.

        `labels` are tables if there are renders. Return the loss and, in place of the number of
        correct predictions, NaN: a detector in training mode predicts nothing.
        """
        is_photograph = ~rendered
        terms: list[tuple[float, Tensor, list[Target]]] = []
        if rendered.any():
            terms.append((1.0, images[rendered], [*map(target_of, labels[rendered])]))
        if self.teacher is not None and is_photograph.any():
            photographs = images[is_photograph]
            boxes = detected(self.teacher, photographs, self.task)
            terms.append((self.settings.distillation_weight, photographs, boxes))
            if augmented is not None:
                weight = self.settings.consistency_weight
                terms.append((weight, augmented[is_photograph], boxes))
        loss = sum(
            weight * len(shown) / len(images) * losses_of(self.model, to_unit(shown), targets)
            for weight, shown, targets in terms
            if weight
        )
        loss = torch.as_tensor(loss, device=images.device)
        return loss, torch.full_like(loss, torch.nan).detach()


@torch.no_grad()
def detected(network: nn.Module, images: UInt8[Tensor, "N 3 H W"], task: Detection) -> list[Target]:
    """Return the boxes in images that a network finds with a score of at least the threshold."""
    unit = to_unit(images)
    with eval_mode(network):
        outputs = task.reader("network")(network(unit), unit)
    targets = []
    for item in outputs:
        width, height = (item["boxes"][:, 2:] - item["boxes"][:, :2]).unbind(1)
        is_kept = (item["scores"] >= task.threshold) & (width > 0) & (height > 0)
        targets.append({key: item[key][is_kept] for key in ("boxes", "labels")})
    return targets


def validate(
    network: nn.Module, teacher: nn.Module, task: Detection, split: Split, rows: Int[Tensor, " N"]
) -> dict[str, float]:
    """Measure which fraction of the boxes of the teacher in photographs a network finds, too.

    Return it as "accuracy", and its complement as "loss".
    """
    device = split.labels.device
    own_rows = rows.to(device)[distributed.rank() :: distributed.world_size()]
    counts = torch.zeros(2, device=device)
    for images in split.squares(own_rows.split(BATCH)):
        pair = (detected(one, images.to(device), task) for one in (teacher, network))
        for expected, found in zip(*pair, strict=True):
            truth, boxes = (
                {key: value.cpu().numpy() for key, value in item.items()}
                for item in (expected, found)
            )
            marked = Marked(**truth, is_crowd=truth["labels"] < 0)
            objects = match(Found(**boxes, scores=boxes["labels"] * 0.0), marked, task.iou)
            counts += torch.tensor([(objects >= 0).sum(), len(truth["labels"])], device=device)
    kept, total = all_reduce_sum(counts).tolist()
    accuracy = kept / total if total else 1.0
    return {"loss": 1 - accuracy, "accuracy": accuracy}
