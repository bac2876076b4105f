"""Render images of unchanged objects in changing light with stacked transfer operators.

The objects are rasterized once. After that, a change of the light costs a matrix product.
"""

import math
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
from renderer.transport.operator_stacks import PIXELS_PER_STACK, OperatorStack, Rows
from renderer.transport.operators import TransferOperator


class Layer(NamedTuple):
    """Radiance of B images of a batch at P pixels.

    The objects of these images cover no other pixels.

    Attributes:
        rows: Indices of the B images in the batch: a slice, or indices (B,)
            on the device of the radiance.
        pixels: Indices of the pixels in an image, shape (P,).
        composite: Linear radiance of object and background, shape (B, 3, P).
    """

    rows: Rows
    pixels: Tensor
    composite: Tensor


class _BuiltStack(NamedTuple):
    """A stack of operators and the M images of `Relighting` that it renders.

    Attributes:
        operators: The operators.
        image_to_stack_image: For each of all N images, its index among the M
            images of this stack, shape (N,). Values of images that are not in
            this stack have no meaning.
        background_terms: Linear radiance that the backgrounds add to the M
            images at the P pixels of the stack, in C = 1 or 3 channels, shape
            (M, C, P).
    """

    operators: OperatorStack
    image_to_stack_image: Tensor
    background_terms: Tensor


@dataclass(eq=False, repr=False)
class Relighting:
    """Render N images, each of one object from one camera in front of one background.

    Images of the same object from the same camera share an operator. The
    operators are built when they are first needed, one stack at a time. The
    radiance of the backgrounds is computed once.

    Attributes:
        objects: The objects.
        views: Index of the object, and the camera, for each of the N images.
        behind: Index of the background of each image, shape (N,).
        backgrounds: Image values, shape (B, 3 or 1, size²).
        settings: Settings of the images.
        build: Builds one operator for each camera, from a mesh, cameras and
            an albedo_scale.
        beside: Bytes that an attack needs in addition to the operators.
    """

    objects: Sequence[SceneObject]
    views: Sequence[tuple[int, Camera]]
    behind: Tensor
    backgrounds: Tensor
    settings: ImageSettings
    build: Callable[..., Sequence[TransferOperator]]
    beside: int = 0

    def __post_init__(self) -> None:
        """Assign an operator to each image, and a stack to each operator.

        Images of the same view share an operator. Each stack has as many
        operators as fit into `PIXELS_PER_STACK`.
        """
        # The view of each operator: index of the object, and camera. Sorting by the object puts
        # the operators of one object into few stacks.
        self._views_of_operators = sorted(dict.fromkeys(self.views), key=itemgetter(0))
        operator_of_view = {view: index for index, view in enumerate(self._views_of_operators)}
        # Index in `_views_of_operators` of the operator of each image, shape (N,).
        self._operator_of_image = torch.tensor([operator_of_view[view] for view in self.views])
        self._operators_per_stack = max(1, PIXELS_PER_STACK // self.settings.size**2)
        # Index of the stack of each image, shape (N,).
        self._stack_of_image = self._operator_of_image // self._operators_per_stack
        self._stack_count = math.ceil(len(self._views_of_operators) / self._operators_per_stack)
        # The keys are indices of stacks.
        self._built: dict[int, _BuiltStack] = {}

    @property
    def stacks(self) -> list[OperatorStack]:
        """Return all stacks of operators, and build those that do not exist yet."""
        self._build_missing(range(self._stack_count))
        return [self._built[index].operators for index in range(self._stack_count)]

    def layers(self, light: Tensor, images: Tensor) -> Iterator[Layer]:
        """Compute the radiance of a batch of images, differentiable in the light.

        Args:
            light: Coefficients of the light of each image of the batch, shape
                (A, size, 3).
            images: Indices of the images of the batch among all N, shape (A,).

        Yields:
            The radiance of those images of the batch that share a stack.
        """
        # The CPU waits here for a GPU. It waits once for all stacks.
        images = images.cpu()
        # A row is the position of an image in the batch. Shape (A,).
        row_to_stack = self._stack_of_image[images]
        needed_stacks = row_to_stack.unique().tolist()
        self._build_missing(needed_stacks)
        for index in needed_stacks:
            built = self._built[index]
            row_indices = torch.nonzero(row_to_stack == index).squeeze(1)
            rows = _as_rows(row_indices, light.device)
            # Where these images of the batch are among the images of the stack.
            stack_images = built.image_to_stack_image[images[row_indices]]
            stack_images_on_device = stack_images.to(light.device, non_blocking=True)
            radiance = built.operators.radiance(light[rows], stack_images)
            composite = radiance + built.background_terms[stack_images_on_device]
            yield Layer(rows, built.operators.pixels, composite)

    def _build_missing(self, indices: Iterable[int]) -> None:
        """Build those of the stacks with the given indices that do not exist yet."""
        missing = [index for index in indices if index not in self._built]
        if not missing:
            return
        for index in progress(missing, "rendering views"):
            self._built[index] = self._build_stack(index)
            # After the first stack, the memory of all others is known.
            if len(self._built) == 1:
                self._require_memory_for_others(self._built[index])

    def _require_memory_for_others(self, first: _BuiltStack) -> None:
        """Raise InputError unless there is memory for all stacks that are not built yet.

        All stacks are taken to be as large as the first one.
        """
        operators = first.operators
        stack_bytes = (
            operators.transfer.nbytes + operators.albedo.nbytes + first.background_terms.nbytes
        )
        needed = (self._stack_count - 1) * stack_bytes + self.beside
        view_count = len(self._views_of_operators)
        name = f"{view_count} views of {self.settings.size} pixels per side (views)"
        require_memory(name, needed, self.backgrounds.device)

    def _build_stack(self, index: int) -> _BuiltStack:
        """Build the stack of operators with an index, and the background terms of its images."""
        first_operator = index * self._operators_per_stack
        end = first_operator + self._operators_per_stack
        views = self._views_of_operators[first_operator:end]
        operators: list[TransferOperator] = []
        for object_index, views_of_object in groupby(views, key=itemgetter(0)):
            item = self.objects[object_index]
            cameras = [camera for _, camera in views_of_object]
            operators += self.build(item.mesh, cameras, albedo_scale=item.albedo_scale)
        # Mask of the M images whose operators are in the stack, shape (N,).
        is_in_stack = self._stack_of_image == index
        # Index in the stack of the operator of each of the M images, shape (M,).
        operator_of_image = (self._operator_of_image[is_in_stack] - first_operator).cpu()
        stack = OperatorStack(operators, operator_of_image, self.backgrounds.device)
        background_pixels = self.backgrounds.index_select(2, stack.pixels)
        background_terms = background_term(
            stack.coverage[stack.shown],
            background_pixels[self.behind[is_in_stack]],
            self.settings.encoding,
        )
        # The images of the stack are numbered in the order of all N images. The cumulative sum
        # of the mask counts them.
        image_to_stack_image = is_in_stack.cumsum(0) - 1
        return _BuiltStack(stack, image_to_stack_image, background_terms)


def _as_rows(indices: Tensor, device: torch.device) -> Rows:
    """Convert increasing row indices to a faster form.

    Args:
        indices: Row indices in increasing order, shape (B,), on the CPU.
        device: Device of the tensor whose rows are selected.

    Returns:
        A slice if the indices are consecutive numbers, or else the indices on the device.
    """
    first = int(indices[0])
    end = int(indices[-1]) + 1
    if end - first == len(indices):
        return slice(first, end)
    return indices.to(device, non_blocking=True)
