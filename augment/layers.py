"""What of some images a mesh covers, put in its place before the background."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Rows = list[int] | None


@dataclass(frozen=True)
class Layer:
    """Pixels (P,) that a mesh covers in B images, `rows` of all, None for all of them in order.

    composite: (B, 3, P) linear radiance and what is behind it. coverage: (O, 1, P) of the O views, of which each image
    has the one that `shown` (B,) says.
    """

    rows: Rows
    pixels: Tensor
    composite: Tensor
    coverage: Tensor
    shown: Tensor | list[int]


def in_place(canvas: Tensor, layers: Sequence[Layer], covered: Sequence[Tensor]) -> Tensor:
    """Canvases (N, 3, size²), which are overwritten, with the values (B, 3, P) of each layer where it is; it is
    differentiable in these."""
    return _InPlace.apply(canvas, [(layer.rows, layer.pixels) for layer in layers], *covered)


class _InPlace(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, canvas: Tensor, places: Sequence[tuple[Rows, Tensor]], *covered: Tensor) -> Tensor:
        ctx.places = places
        for (rows, pixels), values in zip(places, covered, strict=True):
            if rows is None:
                canvas.index_copy_(2, pixels, values)
            else:
                for row, value in zip(rows, values, strict=True):
                    canvas[row].index_copy_(1, pixels, value)
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(_taken(upstream, *place) for place in ctx.places)


def _taken(images: Tensor, rows: Rows, pixels: Tensor) -> Tensor:
    if rows is None:  # of two axes, torch selects ten times as fast as of three
        return images.flatten(0, 1).index_select(1, pixels).unflatten(0, (-1, 3))
    return torch.stack([images[row].index_select(1, pixels) for row in rows])
