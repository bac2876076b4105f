"""What the images of a scene show: the class, mask, box and visible fraction of each object."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderer.errors import InputError

# Label of an entry of `Truth` without an object, in images with fewer objects than others.
NO_OBJECT = -1
# A pixel belongs to an object that covers at least this fraction of it.
COVERED = 0.5
# An object is left out of the truth of a view that shows less than this fraction of it.
LEAST_VISIBLE = 0.1


@dataclass(frozen=True)
class Rows:
    """Base of data classes whose tensors have one row for each example."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return a copy with changed tensors."""
        tensors = {name: item for name, item in vars(self).items() if isinstance(item, Tensor)}
        return replace(self, **{name: change(tensor) for name, tensor in tensors.items()})

    def select(self, rows: Tensor | slice) -> Self:
        """Return some of the rows."""
        return self.map(lambda tensor: tensor[rows])

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of several parts, one after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*map(torch.cat, columns))


@dataclass(frozen=True)
class Truth(Rows):
    """Labels, boxes and masks of the O objects in each of the V views of E examples.

    The first object of an example is the one that an attack is about. Sizes are in pixels, and the
    origin is the upper left corner of the image.

    Attributes:
        labels: Indices of classes. NO_OBJECT stands for no object, or one of which less
            than LEAST_VISIBLE is visible.
        boxes: Left, top, right and bottom side of the box of the visible part. 0 without one.
        masks: Pixels of which the object covers at least half.
        visible: Fraction of the object that no other object hides, in [0, 1]. It is 0
            outside of the view.
    """

    labels: Int[Tensor, "E V O"]
    boxes: Float[Tensor, "E V O 4"]
    masks: Bool[Tensor, "E V O H W"]
    visible: Float[Tensor, "E V O"]

    @property
    def is_shown(self) -> Bool[Tensor, "E V O"]:
        """Mask of the objects that cover a pixel."""
        return self.boxes.any(-1)

    def targets(self) -> list[dict[str, Tensor]]:
        """Return the objects with a class in each of the E · V images, as torchvision takes them.

        They have "boxes" (n, 4) float32, "labels" (n,) int64 and "masks" (n, H, W) uint8, on the
        CPU.
        """
        is_used = (self.is_shown & (self.labels != NO_OBJECT)).flatten(0, 1).cpu()
        parts = (self.boxes.float(), self.labels.long(), self.masks.byte())
        images = zip(is_used, *(part.flatten(0, 1).cpu() for part in parts), strict=True)
        return [
            {"boxes": boxes[used], "labels": labels[used], "masks": masks[used]}
            for used, boxes, labels, masks in images
        ]

    def first_boxes(self) -> Float[Tensor, "E V 4"]:
        """Return the box of the first object of each example, which must be in each view."""
        boxes = self.boxes[..., 0, :]
        for example, view in (~boxes.any(-1)).nonzero().tolist():
            reason = f"the object of example {example} is not visible in its view {view}"
            raise InputError(f"{reason}: turn the camera to it, or remove the view")
        return boxes


def unlabeled(label: str | int) -> int:
    """Return a label for a truth of which only positions are used. Hidden objects still lose it."""
    return 0


def boxes_of(masks: Bool[Tensor, "... H W"]) -> Float[Tensor, "... 4"]:
    """Return the smallest boxes that contain masks: left, top, right and bottom, in pixels.

    The box of an empty mask is 0.
    """
    sides = []
    # Columns and then rows that contain a pixel of the mask.
    for is_used in (masks.any(-2), masks.any(-1)):
        # `argmax` of a mask is the index of its first true entry.
        count = is_used.shape[-1]
        first = is_used.int().argmax(-1)
        sides.append((first, count - is_used.flip(-1).int().argmax(-1)))
    (left, right), (top, bottom) = sides
    boxes = torch.stack([left, top, right, bottom], dim=-1).float()
    return boxes * masks.any(-1).any(-1, keepdim=True)
