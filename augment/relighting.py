"""Images of still objects under other light: one product for a stack of operators, and nothing rasterised anew."""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from augment.layers import Layer, Rows
from augment.memory import require_memory
from augment.objects import SceneObject
from augment.operator_stack import OperatorStack
from augment.progress import progress
from renderer.camera import Camera
from renderer.image import ImageSettings, behind
from renderer.transfer import Operator

STACKED = 2**16  # pixels of the images whose operators are multiplied at once; more would only be copied about


class Relighting:
    """N images, each of an object from a camera over one of the backgrounds (B, 3 or 1, size²).

    Equal views share an operator, and what a background adds to an image is kept. Operators are built when they are
    first needed, a stack at a time.
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        views: Sequence[tuple[int, Camera]],
        behind: Tensor,
        backgrounds: Tensor,
        settings: ImageSettings,
        build: Callable[[SceneObject, Sequence[Camera]], Sequence[Operator]],
    ):
        """views: (object's number, camera) of each image. behind: (N,) the background of each. build: the operators
        of an object from cameras."""
        self._objects, self._behind, self._backgrounds = objects, behind, backgrounds
        self._settings, self._build = settings, build
        self._distinct = sorted(dict.fromkeys(views), key=lambda view: view[0])  # (object, camera) of each operator
        number = {view: index for index, view in enumerate(self._distinct)}
        self._operator = torch.tensor([number[view] for view in views], device=backgrounds.device)
        self._per_stack = max(1, STACKED // settings.size**2)
        self._count = -(-len(self._distinct) // self._per_stack)
        self._stacks: dict[int, tuple[OperatorStack, Tensor, Tensor]] = {}

    @property
    def stacks(self) -> list[OperatorStack]:
        """All of them, of which those that are missing are built now."""
        return [self._stack(index)[0] for index in progress(range(self._count), "views")]

    def layers(self, light: Tensor, images: Tensor) -> Iterator[Layer]:
        """Of images (A,), each in its light (A, size, 3); differentiable in it."""
        if self._count == 1:
            yield self._layer(0, None, light, images)
            return
        stack = self._operator[images] // self._per_stack
        for index in stack.unique().tolist():
            rows = torch.nonzero(stack == index).squeeze(1)
            yield self._layer(index, rows.tolist(), light[rows], images[rows])

    def _layer(self, index: int, rows: Rows, light: Tensor, images: Tensor) -> Layer:
        stack, place, added = self._stack(index)
        images = place[images]
        seen = stack.radiance(light, images)
        return Layer(rows, stack.pixels, seen + added[images], stack.coverage, stack.shown[images])

    def _stack(self, index: int) -> tuple[OperatorStack, Tensor, Tensor]:
        if index not in self._stacks:
            self._stacks[index] = stack, _, added = self._build_stack(index)
            if len(self._stacks) == 1:  # the others are as large
                kept = (self._count - 1) * (stack.transfer.nbytes + stack.albedo.nbytes + added.nbytes)
                views = f"{len(self._distinct)} views of {self._settings.size} pixels per side (scene.views)"
                require_memory(views, kept, self._backgrounds.device)
        return self._stacks[index]

    def _build_stack(self, index: int) -> tuple[OperatorStack, Tensor, Tensor]:
        """(some operators, (N,) each image's place among those that show them, what is behind these (A, C, P))."""
        first = index * self._per_stack
        views, operators = self._distinct[first : first + self._per_stack], list[Operator]()
        for number in dict.fromkeys(number for number, _ in views):
            operators += self._build(self._objects[number], [camera for its, camera in views if its == number])
        here = self._operator // self._per_stack == index
        stack = OperatorStack(operators, (self._operator[here] - first).cpu(), self._backgrounds.device)
        backgrounds = self._backgrounds.index_select(2, stack.pixels)
        added = behind(stack.coverage[stack.shown], backgrounds[self._behind[here]], self._settings.encoding)
        return stack, here.cumsum(0) - 1, added
