"""Images of objects in other light: stacked transfer operators, and nothing is rasterized again."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import torch
from torch import Tensor

from augment.memory import require_memory
from augment.progress import progress
from augment.scene.objects import SceneObject
from renderer.camera import Camera
from renderer.image import background_term
from renderer.settings import ImageSettings
from renderer.transport.operator_stacks import STACKED, OperatorStack, Rows
from renderer.transport.operators import TransferOperator


class Layer(NamedTuple):
    """Covered pixels (P,) of B images, which are `rows` of a batch: a part of it or, on its device, indices (B,).

    composite: (B, 3, P) linear radiance and background.
    """

    rows: Rows
    pixels: Tensor
    composite: Tensor


@dataclass(eq=False, repr=False)
class Relighting:
    """N images, each of an object from a camera over one of the backgrounds (B, 3 or 1, size²).

    Equal views share an operator, and background terms are cached. Operators are built when they are first needed, a
    stack at a time. views: (object's number, camera) of each image. behind: (N,) the background of each. build: the
    operators of a mesh from cameras, for an albedo_scale. beside: bytes that an attack needs beside the operators.
    """

    objects: Sequence[SceneObject]
    views: Sequence[tuple[int, Camera]]
    behind: Tensor
    backgrounds: Tensor
    settings: ImageSettings
    build: Callable[..., Sequence[TransferOperator]]
    beside: int = 0

    def __post_init__(self) -> None:
        self._distinct = sorted(dict.fromkeys(self.views), key=itemgetter(0))  # (object, camera) of each operator
        number = {view: index for index, view in enumerate(self._distinct)}
        self._operator = torch.tensor([number[view] for view in self.views])
        self._per_stack = max(1, STACKED // self.settings.size**2)
        self._count = -(-len(self._distinct) // self._per_stack)
        self._stacks: dict[int, tuple[OperatorStack, Tensor, Tensor]] = {}

    @property
    def stacks(self) -> list[OperatorStack]:
        """All stacks, built where they are missing."""
        self._require(range(self._count))
        return [self._stacks[index][0] for index in range(self._count)]

    def layers(self, light: Tensor, images: Tensor) -> Iterator[Layer]:
        """The layers of images (A,), each in its light (A, size, 3); differentiable in the light."""
        images = images.cpu()  # once, since the host waits here for a GPU
        number = self._operator[images] // self._per_stack
        indices = number.unique().tolist()
        self._require(indices)
        for index in indices:
            within, (stack, rank, behind) = torch.nonzero(number == index).squeeze(1), self._stacks[index]
            ranks, first, end = rank[images[within]], int(within[0]), int(within[-1]) + 1
            rows = slice(first, end) if end - first == len(within) else within.to(light.device, non_blocking=True)
            on_device = ranks.to(light.device, non_blocking=True)
            yield Layer(rows, stack.pixels, stack.radiance(light[rows], ranks) + behind[on_device])

    def _require(self, indices: Iterable[int]) -> None:
        missing = [index for index in indices if index not in self._stacks]
        for index in progress(missing, "rendering views") if missing else ():
            self._stacks[index] = stack, _, behind = self._build_stack(index)
            if len(self._stacks) == 1:  # the others are as large
                rest = (self._count - 1) * (stack.transfer.nbytes + stack.albedo.nbytes + behind.nbytes)
                views = f"{len(self._distinct)} views of {self.settings.size} pixels per side (views)"
                require_memory(views, rest + self.beside, self.backgrounds.device)

    def _build_stack(self, index: int) -> tuple[OperatorStack, Tensor, Tensor]:
        """(a stack; (N,) each image's rank among the A images of the stack; their background terms (A, C, P))."""
        first = index * self._per_stack
        views, operators = self._distinct[first : first + self._per_stack], list[TransferOperator]()
        for number, group in groupby(views, key=itemgetter(0)):
            item, cameras = self.objects[number], [camera for _, camera in group]
            operators += self.build(item.mesh, cameras, albedo_scale=item.albedo_scale)
        here = self._operator // self._per_stack == index
        stack = OperatorStack(operators, (self._operator[here] - first).cpu(), self.backgrounds.device)
        backgrounds = self.backgrounds.index_select(2, stack.pixels)
        behind = background_term(stack.coverage[stack.shown], backgrounds[self.behind[here]], self.settings.encoding)
        return stack, here.cumsum(0) - 1, behind
