"""Render images of unchanged objects in changing light with stacked transfer operators.

A transfer operator is a matrix that maps the coefficients of the light to the pixels of one view.
The objects are rasterized once. After that, a change of the light costs a matrix product.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.progress import progress
from augment.scene.objects import SceneObject
from renderer.camera import Camera
from renderer.image import background_term
from renderer.memory import require_memory
from renderer.operators.apply import TransferOperator
from renderer.operators.stack import PIXELS_PER_STACK, OperatorStack, Rows
from renderer.settings import ImageSettings


class Layer(NamedTuple):
    """Radiance of B images of a batch at the P pixels that their objects may cover.

    Attributes:
        rows: Indices of the B images in the batch: a slice, or a tensor (B,) on
            the device of the radiance.
        pixels: Row-major index of each of the P pixels in an image, shape (P,).
        composite: Linear radiance of the objects in front of the backgrounds,
            shape (B, 3, P).
    """

    rows: Rows
    pixels: Int[Tensor, " P"]
    composite: Float[Tensor, "B 3 P"]


class _BuiltStack(NamedTuple):
    """A stack of transfer operators, and the backgrounds of the M images that it renders.

    A transfer operator is a matrix from light to the pixels of one view.

    Attributes:
        operators: The stack, which covers P pixels of an image.
        image_to_stack_image: For each of the N images of the scene, its index
            among the M images of this stack, shape (N,). Images of other stacks
            have arbitrary values.
        background_terms: Linear radiance that the backgrounds add to the M
            images at the P pixels, in C = 1 or 3 channels, shape (M, C, P).
    """

    operators: OperatorStack
    image_to_stack_image: Int[Tensor, " N"]
    background_terms: Float[Tensor, "M C P"]


@dataclass(eq=False, repr=False)
class Relighting:
    """Render N images with transfer operators, which are matrices from light to image.

    Each image shows one object from one camera in front of one background.
    Images of the same object from the same camera share an operator. Operators
    are combined to stacks, which are built when they are first needed.

    Attributes:
        objects: The objects.
        views: Index of the object, and the camera, for each of the N images.
        image_to_background: Index of the background of each image, shape (N,).
        backgrounds: Image values of B backgrounds, shape (B, 3 or 1, size²).
        settings: Settings of the images.
        build: Function that builds the operators of several cameras. Its
            arguments are a mesh, cameras and `albedo_scale`.
        attack_bytes: Bytes that an attack needs in addition to the operators.
    """

    objects: Sequence[SceneObject]
    views: Sequence[tuple[int, Camera]]
    image_to_background: Int[Tensor, " N"]
    backgrounds: Float[Tensor, "B _ size²"]
    settings: ImageSettings
    build: Callable[..., Sequence[TransferOperator]]
    attack_bytes: int = 0

    def __post_init__(self) -> None:
        """Assign a transfer operator to each image, and a stack to each operator.

        Images of the same object from the same camera share an operator. A
        stack has as many operators as fit into `PIXELS_PER_STACK`.
        """
        # Object and camera of each operator. Sort them by the object, so that the operators of
        # one object are in few stacks.
        self._views_of_operators = sorted(dict.fromkeys(self.views), key=itemgetter(0))
        operator_of_view = {view: index for index, view in enumerate(self._views_of_operators)}
        # Index of the transfer operator that renders each image, shape (N,).
        self._operator_of_image = torch.tensor([operator_of_view[view] for view in self.views])
        self._operators_per_stack = max(1, PIXELS_PER_STACK // self.settings.size**2)
        # Index of the stack of operators that renders each image, shape (N,).
        self._stack_of_image = self._operator_of_image // self._operators_per_stack
        self._stack_count = math.ceil(len(self._views_of_operators) / self._operators_per_stack)
        # Stacks of transfer operators that were built so far, by their indices.
        self._built: dict[int, _BuiltStack] = {}

    @property
    def stacks(self) -> list[OperatorStack]:
        """Return all stacks of transfer operators. Build those that were not needed so far."""
        self._build_missing(range(self._stack_count))
        return [self._built[index].operators for index in range(self._stack_count)]

    def layers(self, light: Float[Tensor, "A _ 3"], images: Int[Tensor, " A"]) -> Iterator[Layer]:
        """Compute the radiance of a batch of images, differentiable in the light."""
        # Copying waits until the GPU is idle. This happens once for all stacks.
        images = images.cpu()
        # Index of the stack of each image of the batch, shape (A,).
        row_to_stack = self._stack_of_image[images]
        needed_stacks = row_to_stack.unique().tolist()
        self._build_missing(needed_stacks)
        for index in needed_stacks:
            built = self._built[index]
            row_indices = torch.nonzero(row_to_stack == index).squeeze(1)
            rows = _as_rows(row_indices, light.device)
            # Indices of these images of the batch among the images of the stack.
            stack_images = built.image_to_stack_image[images[row_indices]]
            stack_images_on_device = stack_images.to(light.device, non_blocking=True)
            radiance = built.operators.radiance(light[rows], stack_images)
            composite = radiance + built.background_terms[stack_images_on_device]
            yield Layer(rows, built.operators.pixels, composite)

    def _build_missing(self, indices: Iterable[int]) -> None:
        """Build the stacks of transfer operators with the given indices that do not exist yet."""
        missing = [index for index in indices if index not in self._built]
        if not missing:
            return
        for index in progress(missing, "rendering views"):
            self._built[index] = self._build_stack(index)
            # The first stack tells how much memory all stacks will need.
            if len(self._built) == 1:
                self._require_memory_for_others(self._built[index])

    def _require_memory_for_others(self, first: _BuiltStack) -> None:
        """Check that all other stacks fit in memory, if each is as large as the first one."""
        operators = first.operators
        stack_bytes = (
            operators.transfer.nbytes + operators.albedo.nbytes + first.background_terms.nbytes
        )
        needed = (self._stack_count - 1) * stack_bytes + self.attack_bytes
        view_count = len(self._views_of_operators)
        name = f"{view_count} views of {self.settings.size} pixels per side (views)"
        require_memory(name, needed, self.backgrounds.device)

    def _build_stack(self, index: int) -> _BuiltStack:
        """Build a stack of transfer operators, and the backgrounds of its images."""
        first_operator = index * self._operators_per_stack
        end = first_operator + self._operators_per_stack
        views = self._views_of_operators[first_operator:end]
        operators: list[TransferOperator] = []
        for object_index, views_of_object in groupby(views, key=itemgetter(0)):
            item = self.objects[object_index]
            cameras = [camera for _, camera in views_of_object]
            operators += self.build(item.mesh, cameras, albedo_scale=item.albedo_scale)
        # Mask of the images whose operators are in this stack, shape (N,). M of them are True.
        is_in_stack = self._stack_of_image == index
        # Index of the operator of each of these images in the stack, shape (M,).
        operator_of_image = (self._operator_of_image[is_in_stack] - first_operator).cpu()
        stack = OperatorStack(operators, operator_of_image, self.backgrounds.device)
        background_pixels = self.backgrounds.index_select(2, stack.pixels)
        background_terms = background_term(
            stack.coverage[stack.shown],
            background_pixels[self.image_to_background[is_in_stack]],
            self.settings.encoding,
        )
        # Number the images of the stack in their order: 0 for the first True of the mask, and so
        # on.
        image_to_stack_image = is_in_stack.cumsum(0) - 1
        return _BuiltStack(stack, image_to_stack_image, background_terms)


def _as_rows(indices: Int[Tensor, " B"], device: torch.device) -> Rows:
    """Convert row indices to a slice if they are consecutive, because a slice is faster."""
    first = int(indices[0])
    end = int(indices[-1]) + 1
    if end - first == len(indices):
        return slice(first, end)
    return indices.to(device, non_blocking=True)
