"""Segmentation: a network returns a logit for each class and pixel, and an attack hides an object.

The evidence of a class is the intersection over union (IoU) of the mask of the object with the
pixels of the class within the box of the mask. It is compared as log-odds, as a detector's scores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Self

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.network import plain_outputs, unwrapped
from augment.scene.truth import Truth
from augment.tasks.detection import log_odds_of
from augment.tasks.task import GetTruth, ObjectCriterion, Reader, Task, stored_names
from renderer.errors import InputError, describe, require_number

# Least fraction of an image that shows an object.
LEAST_AREA = 0.01
# Opacity of the colors that are drawn over an image.
OPACITY = 0.5


@dataclass(frozen=True)
class Segmentation(Task):
    """Task of a network that returns logits (N, C, H, W), one for each class and pixel.

    Outputs of torchvision (`out`) and of transformers (`logits`, which are
    enlarged to the size of the images) are read as well.

    Args:
        iou: An attack succeeds if the intersection over union between the mask
            of the object and the pixels of its class, within the box of the
            mask, is below this number.

    Raises:
        InputError: If `iou` is not between 0.01 and 1.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> def find_bright(images):
        ...     mean = images.mean(1)
        ...     return torch.stack([0 * mean + 0.2, mean], dim=1)
        >>> scene = nb.build_scene([("solid:ball", "ball")], size=16, backgrounds=[0.0])
        >>> settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.5), max_steps=20)
        >>> task, classes = nb.Segmentation(iou=0.5), ["dark", "ball"]
        >>> result = nb.attack(find_bright, scene, task=task, settings=settings, classes=classes)
        >>> result.success
        tensor([True])
    """

    name = "segmentation"
    returns = "a tensor of logits (N, C, H, W), or a dictionary with 'out'"
    confidence = "IoU at the object"
    finds = "segments", "still finds"

    iou: float = 0.5

    def __post_init__(self) -> None:
        require_number("iou", self.iou, 0.01, 1)

    def recognizes(self, outputs: Any) -> bool:
        """Return whether outputs are a tensor of four dimensions, or have one as "out"."""
        plain = _logits(outputs)
        return isinstance(plain, Tensor) and plain.ndim == 4

    def class_names(self, network: Any, count: int | None) -> Sequence[str] | None:
        """Return the names that transformers stores. A network of another library has none."""
        return stored_names(unwrapped(network)) or None

    def reader(self, title: str, class_count: int | None = None) -> Reader:
        """Return a function that checks the logits of pixels."""
        return partial(self._read, title, class_count)

    def _read(
        self, title: str, class_count: int | None, outputs: Any, images: Float[Tensor, "N 3 H W"]
    ) -> Float[Tensor, "N C H W"]:
        logits = _logits(outputs)
        is_tensor = isinstance(logits, Tensor) and logits.ndim == 4
        # Whether the network returns logits of the size of the images, as torchvision does.
        is_full = logits is outputs or (isinstance(outputs, Mapping) and "out" in outputs)
        if is_tensor and not is_full:
            # Segmenters of transformers return smaller logits, which its own reader enlarges.
            logits = F.interpolate(logits, images.shape[2:], mode="bilinear", align_corners=False)
        if is_tensor and hasattr(outputs, "masks_queries_logits"):
            logits = logits.clamp_min(torch.finfo(logits.dtype).tiny).log()
        # The largest of a single logit would be at each pixel.
        count = class_count or (max(2, logits.shape[1]) if is_tensor else "C")
        shape = (len(images), count, *images.shape[2:])
        if not is_tensor or logits.shape != shape:
            raise InputError(f"{title} returned {describe(logits)}: it must return logits {shape}")
        return logits

    def criterion(self, source: Tensor, truth: GetTruth, class_count: int) -> SegmentationCriterion:
        """Return the criterion of an untargeted attack on the first object of each example."""
        positions = truth()
        # This raises InputError if a view does not show its object.
        positions.first_boxes()
        return SegmentationCriterion(source, task=self, masks=positions.masks[..., 0, :, :])

    def as_found(
        self, outputs: Float[Tensor, "N C H W"], classes: Sequence[str]
    ) -> tuple[Int[Tensor, " E"], SegmentationCriterion]:
        """Return the criterion of an attack on each class in an image, except a background.

        The class must have the fraction LEAST_AREA of the pixels.
        """
        label = outputs.argmax(1)
        area = F.one_hot(label, outputs.shape[1]).float().mean((1, 2))
        area[:, self.are_background(classes)] = 0
        # One example for each pair of an image and a class that it shows.
        image, source = (area >= LEAST_AREA).nonzero(as_tuple=True)
        masks = label[image] == source[:, None, None]
        return image.cpu(), SegmentationCriterion(source[:, None], task=self, masks=masks[:, None])

    def require_target(self, target: Any) -> None:
        """Refuse a target, because an attack on a segmenter hides an object."""
        raise InputError(f"target is {describe(target)}, and {self} hides objects: leave it out")

    def draw(self, image: Tensor, output: Tensor, classes: Sequence[str]) -> Tensor:
        """Draw the classes of the pixels as colors, except the first, over the image."""
        label = output.argmax(0)
        # Channels are cosines of the hue, shifted by 0°, 120° and 240°, and scaled to [0, 1].
        # Hues that follow each other by the golden ratio are far from each other.
        angle = 2 * torch.pi * 0.618 * label
        colors = torch.stack([(angle + shift).cos() for shift in (0.0, 2.1, 4.2)]) / 2 + 0.5
        return torch.where(label > 0, (1 - OPACITY) * image + OPACITY * colors.to(image), image)


@dataclass(frozen=True)
class SegmentationCriterion(ObjectCriterion):
    """Criterion of an attack on a segmenter.

    Attributes:
        task: The IoU that is the limit.
        masks: Mask of the object in each view. An empty one is outside, which counts as found.
    """

    task: Segmentation = field(kw_only=True)
    masks: Bool[Tensor, "*E V H W"] = field(kw_only=True)

    def at(self, truth: Truth) -> Self:
        """Return a copy for other masks."""
        return replace(self, masks=truth.masks[..., 0, :, :])

    def evidence(self, outputs: Float[Tensor, "N C H W"]) -> Float[Tensor, "N K"]:
        """Return the log-odds of the IoU of each class, and of the limit."""
        masks = self.masks.to(outputs.device)
        # Pixels whose row and column contain pixels of the mask, shape (N, H, W).
        in_box = masks.any(1)[:, None] & masks.any(2)[:, :, None]
        # Pixels at which each class has the largest logit, shape (N, C, H, W).
        shown = F.one_hot(outputs.detach().argmax(1), outputs.shape[1]).movedim(-1, 1).bool()
        shown = shown & in_box[:, None]
        # The IoU is the area of the intersection over that of the union.
        common = (shown & masks[:, None]).sum((2, 3)).double()
        ratio = common / (shown | masks[:, None]).sum((2, 3)).clamp(min=1)
        is_outside = ~masks.flatten(1).any(1)
        ratio[is_outside, self.source[is_outside]] = 1.0
        limit = torch.full_like(ratio[:, :1], self.task.iou)
        return log_odds_of(torch.cat([ratio, limit], dim=1))

    def cost(self, outputs: Float[Tensor, "N C H W"]) -> Float[Tensor, " N"]:
        """Return the mean softplus of the log-odds of the true class over the object's pixels."""
        # Index of the true class at each pixel, shape (N, 1, H, W).
        source = self.source[:, None, None, None].expand(-1, 1, *outputs.shape[2:])
        odds = outputs.gather(1, source)[:, 0] - outputs.scatter(1, source, -torch.inf).logsumexp(1)
        masks = self.masks.to(odds)
        # Pixels that are lost already count little, so that the attack goes on to the others.
        return (F.softplus(odds) * masks).sum((1, 2)) / masks.sum((1, 2)).clamp(min=1)


def _logits(outputs: Any) -> Any:
    """Return the logits (N, C, H, W) of the pixels, which torchvision names "out".

    Mask2Former and similar networks return a mask and class probabilities for each of Q queries.
    Their result is not a logit but Σ_q P(class of q) · P(pixel in the mask of q).
    """
    if hasattr(outputs, "masks_queries_logits"):
        # The last class of a query is "no object", which no pixel shows.
        classes = outputs.class_queries_logits.softmax(-1)[..., :-1]
        return torch.einsum("nqc,nqhw->nchw", classes, outputs.masks_queries_logits.sigmoid())
    out = outputs.get("out") if isinstance(outputs, Mapping) else getattr(outputs, "out", None)
    return plain_outputs(outputs) if out is None else out
