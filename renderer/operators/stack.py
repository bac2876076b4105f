"""Transfer operators of many views, stacked so that one batched product gives all images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, overload

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError, as_tensor
from renderer.image import as_background, background_term, clamp, encode
from renderer.operators.apply import TransferOperator, apply_transfer, require_image_gradient
from renderer.operators.sparse import SparseTransfer, concatenate_entries

# Operators of small images are copied into common tensors (a stack) until their images have
# this many pixels in total. Larger stacks are not faster.
PIXELS_PER_STACK = 2**16
# Views are rendered one by one if a stack would hold fewer operators than this. A loop over
# the operators is then faster than a batched product.
FEWEST_STACKED = 8
# Type of an index that selects some images of a batch.
Rows = slice | Tensor
# Number of color channels.
COLORS = 3


class TransferOperators(Sequence[TransferOperator]):
    """Sequence of the transfer operators of V views, which can render all views in one call.

    For small images, the first call of `image` copies the operators into
    common tensors (stacks), so that one batched product renders many views. The
    stacks take about as much memory as the operators.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> cameras = nb.orbit_cameras(5, 2.2)
        >>> operators = nb.precompute_transfer(nb.solid("pear"), cameras, size=16)
        >>> probes = [nb.load_light("grace"), nb.load_light("st_peters")]
        >>> lights = torch.stack(probes).requires_grad_()
        >>> images = operators.image(lights, background=0.2)
        >>> [gradient] = torch.autograd.grad(images.mean(), lights)
        >>> images.shape, gradient.shape
        (torch.Size([5, 2, 3, 16, 16]), torch.Size([2, 49, 3]))
        >>> len(operators), operators[0].image(lights).shape
        (5, torch.Size([2, 3, 16, 16]))
    """

    def __init__(self, operators: Iterable[TransferOperator]):
        """Create a sequence of operators, and check that they fit together.

        Args:
            operators: One or more operators. All operators must have the same
                image settings, basis of light and dtype.

        Raises:
            InputError: If there is no operator, or if an operator differs from
                the first one in settings, basis or dtype.
        """
        self._operators = list(operators)
        if not self._operators:
            raise InputError("operators is empty: give at least one TransferOperator")
        first = self._operators[0]
        for operator in self._operators:
            is_same = operator.settings == first.settings and operator.basis == first.basis
            if not is_same or operator.transfer.dtype != first.transfer.dtype:
                raise InputError(
                    "operators differ in image settings, basis of light or dtype: compute all "
                    "operators with the same settings, basis and dtype"
                )

    @overload
    def __getitem__(self, index: int) -> TransferOperator: ...

    @overload
    def __getitem__(self, index: slice) -> TransferOperators: ...

    def __getitem__(self, index: int | slice) -> TransferOperator | TransferOperators:
        """Return the operator of one view for an integer, or a `TransferOperators` for a slice."""
        selected = self._operators[index]
        return TransferOperators(selected) if isinstance(selected, list) else selected

    def __len__(self) -> int:
        """Return the number of views, V."""
        return len(self._operators)

    def __add__(self, others: Iterable[TransferOperator]) -> list[TransferOperator]:
        """Concatenate these operators and other operators to a list.

        The result is a list, because the other operators may have other
        settings.
        """
        return [*self, *others]

    def to(self, device: torch.device | str) -> TransferOperators:
        """Return a copy of the operators on another device.

        Args:
            device: Device of the copy, such as "cuda".
        """
        return TransferOperators(operator.to(device) for operator in self)

    def image(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        background: float | Tensor = 0.5,
        *,
        light_per_view: bool = False,
    ) -> Float[Tensor, "... 3 size size"]:
        """Render all V views under one or more lights.

        The result is differentiable with respect to the lights and the
        background. The images equal those of `TransferOperator.image` up to
        rounding.

        Args:
            lights: Coefficients of the lights, shape (..., coefficients, 3).
                Every view is rendered under every light.
            background: Gray value, color, or images in [0, 1] that broadcast to
                (V, ..., 3, size, size).
            light_per_view: True if each view has its own lights. The lights then
                have the shape (V, ..., coefficients, 3).

        Returns:
            Images in [0, 1], shape (V, ..., 3, size, size).

        Raises:
            InputError: If `lights` has NaN, or another number of coefficients
                than the basis. If `light_per_view` is true and the first axis of
                `lights` is not V. If `background` does not broadcast to the
                images.
        """
        first = self._operators[0]
        lights = as_tensor("lights", lights)
        first.require_lights(lights)
        if light_per_view and (lights.ndim < 3 or len(lights) != len(self)):
            raise InputError(
                f"lights has shape {tuple(lights.shape)}, but light_per_view=True needs the shape "
                f"({len(self)}, ..., {first.basis.size}, 3) for {len(self)} views"
            )
        # One entry along the first axis for each view.
        view_lights = lights if light_per_view else lights.expand(len(self), *lights.shape)
        size = first.settings.size
        image_shape = (*view_lights.shape[:-2], COLORS, size, size)
        background_images = as_background(background, size, lights)
        if background_images.ndim > 3:
            background_images = _broadcast_background(background_images, image_shape)
        operators_in_stack = min(len(self), self._operators_per_stack)
        # Only `_image_by_image` gives a gradient with respect to the background.
        if operators_in_stack < FEWEST_STACKED or background_images.requires_grad:
            return self._image_by_image(view_lights, background_images)
        return self._stacked_images(view_lights, background_images, image_shape)

    def image_and_gradient(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        loss_gradient: Callable[[Tensor], Tensor],
        background: float | Tensor = 0.5,
        *,
        light_per_view: bool = False,
    ) -> tuple[Float[Tensor, "... 3 size size"], Float[Tensor, "*lights coefficients 3"]]:
        """Render all V views, and compute the gradient of a loss with respect to the lights.

        Args:
            lights: Coefficients of the lights, shape (..., coefficients, 3), or
                (V, ..., coefficients, 3) with `light_per_view`.
            loss_gradient: Function that takes the images, shape
                (V, ..., 3, size, size), and returns the gradient of the loss
                with respect to the images, in the same shape.
                `torch.func.grad(loss)` makes such a function from a loss.
            background: Gray value, color, or images in [0, 1] that broadcast to
                (V, ..., 3, size, size).
            light_per_view: True if each view has its own lights. False renders
                every view under every light.

        Returns:
            A tuple of

            - the images in [0, 1], shape (V, ..., 3, size, size);
            - the gradient of the loss with respect to the lights, in the shape
              of `lights`.

        Raises:
            InputError: If `image` raises it, or if the result of
                `loss_gradient` has another shape than the images.
        """
        lights = as_tensor("lights", lights)
        self._operators[0].require_lights(lights)
        variable_lights = lights.detach().requires_grad_()
        with torch.enable_grad():
            images = self.image(variable_lights, background, light_per_view=light_per_view)
        detached_images = images.detach()
        image_gradient = loss_gradient(detached_images)
        require_image_gradient(image_gradient, detached_images)
        [gradient] = torch.autograd.grad(images, variable_lights, image_gradient.detach())
        return detached_images, gradient

    @property
    def _operators_per_stack(self) -> int:
        """Number of operators in a full stack. The last stack may hold fewer."""
        pixels_per_image = self._operators[0].settings.size ** 2
        return max(1, PIXELS_PER_STACK // pixels_per_image)

    @cached_property
    def _stacks(self) -> list[OperatorStack]:
        """Stacks of at most `_operators_per_stack` operators, which hold all operators."""
        device = self._operators[0].transfer.device
        stacks = []
        # The stacks are kept, and later calls may need gradients.
        with torch.inference_mode(False):
            for start in range(0, len(self), self._operators_per_stack):
                operators = self._operators[start : start + self._operators_per_stack]
                # Image i of a stack shows operator i.
                operator_of_image = torch.arange(len(operators))
                stacks.append(OperatorStack(operators, operator_of_image, device))
        return stacks

    def _image_by_image(
        self, lights: Float[Tensor, "V ... coefficients 3"], background: Tensor
    ) -> Float[Tensor, "V ... 3 size size"]:
        """Render all V views in a loop over the operators.

        A background has the shape (3, size, size), or that of the result.
        """
        size = self._operators[0].settings.size
        if background.ndim == 3:
            background = background.expand(len(self), COLORS, size, size)
        images_by_view = []
        for operator, view_lights, view_background in zip(self, lights, background, strict=True):
            images_by_view.append(operator.image(view_lights, view_background))
        return torch.stack(images_by_view)

    def _stacked_images(
        self,
        view_lights: Float[Tensor, "V ... coefficients 3"],
        background: Tensor,
        image_shape: Sequence[int],
    ) -> Float[Tensor, "V ... 3 size size"]:
        """Render all V views, with one batched matrix product for each stack of operators."""
        encoding = self._operators[0].settings.encoding
        # One light for each image. All images of the first view come first.
        lights = view_lights.flatten(0, -3).to(self._operators[0].transfer.dtype)
        lights_per_view = len(lights) // len(self)
        # One background for each image, or a single one. The last axis has all pixels.
        backgrounds = background.reshape(-1, COLORS, image_shape[-1] ** 2)
        first_image = 0
        targets = []
        covered_values = []
        for stack in self._stacks:
            operator_count = len(stack.shown)
            # Index of the operator that each image shows: 0, 0, ..., 1, 1, ...
            operator_of_image = torch.arange(operator_count).repeat_interleave(lights_per_view)
            rows = slice(first_image, first_image + len(operator_of_image))
            first_image = rows.stop
            stack_backgrounds = backgrounds if len(backgrounds) == 1 else backgrounds[rows]
            # Merge the axes of images and colors, because torch selects from two axes ten
            # times as fast as from three.
            at_pixels = stack_backgrounds.flatten(0, 1).index_select(1, stack.pixels)
            at_pixels = at_pixels.unflatten(0, (-1, COLORS))
            coverage = stack.coverage[operator_of_image.to(background.device)].to(background)
            # Linear background, times the fraction of each pixel that shows no mesh.
            behind = background_term(coverage, at_pixels, encoding)
            radiance = stack.radiance(lights[rows], operator_of_image).to(background.dtype)
            targets.append((rows, stack.pixels))
            covered_values.append(encode(clamp(radiance + behind), encoding))
        canvas = backgrounds.expand(len(lights), -1, -1)
        canvas = canvas.clone(memory_format=torch.contiguous_format)
        # All other pixels keep the background.
        return ScatterLayers.apply(canvas, targets, *covered_values).view(image_shape)


def _broadcast_background(images: Float[Tensor, "... 3 size size"], shape: Sequence[int]) -> Tensor:
    """Broadcast background images to the shape of the rendered images."""
    try:
        return images.expand(shape)
    except RuntimeError as error:
        given = tuple(images.shape)
        raise InputError(
            f"background has the shape {given}, which does not broadcast to the shape "
            f"{tuple(shape)} of the rendered images: give one background image, or one per view "
            "and light"
        ) from error


class ScatterLayers(torch.autograd.Function):
    """Overwrite pixels of a batch of images in place, differentiable in the new values.

    A layer is a set of new pixel values for some of the N images. Its target is
    a pair: the images (rows of the batch), and the pixels that are overwritten.
    """

    @staticmethod
    def forward(
        ctx: Any,
        canvas: Float[Tensor, "N 3 pixels"],
        targets: Sequence[tuple[Rows, Tensor]],
        *layers: Tensor,
    ) -> Tensor:
        """Write the values of all layers, shape (B, 3, P) each, into the images in place.

        A target selects B images by a slice or by indices, and P pixels by row-major
        indices.
        """
        ctx.targets = targets
        for (rows, pixels), values in zip(targets, layers, strict=True):
            # `scatter_` takes half the time of `index_copy_` on a CPU.
            images = canvas[rows].scatter_(2, pixels.expand(values.shape), values)
            if isinstance(rows, Tensor):
                # Indices give a copy of the images, not a view. Write the copy back.
                canvas.index_copy_(0, rows, images)
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "N 3 pixels"]) -> tuple[Tensor | None, ...]:
        """Compute the gradients with respect to the new values of the overwritten pixels."""
        gradients = []
        for rows, pixels in ctx.targets:
            # Merge the axes of images and colors, because torch selects from two axes ten
            # times as fast as from three.
            layer_gradient = upstream[rows].flatten(0, 1).index_select(1, pixels)
            gradients.append(layer_gradient.unflatten(0, (-1, COLORS)))
        return None, None, *gradients


class OperatorStack:
    """Copies of O transfer operators in common tensors, for products in one batch.

    The tensors have the P pixels that any of the operators covers, and the K
    coefficients that any of the operators uses. N images are rendered with the
    stack. Each image shows one of the operators under a light of its own.

    Attributes:
        shown: Index of the operator that each image shows, int64, shape (N,), on
            the CPU.
        pixels: Row-major indices of the P pixels, ascending, int64, shape (P,).
        transfer: Radiance per unit of each coefficient, in C = 1 to 3 channels,
            shape (O, C, K, P). A row of zeros is appended if K would be odd,
            because the gradient is computed in half the time with K = 32 instead
            of 31.
        albedo: Albedo of each operator, shape (O, 3, P). It is 1 in pixels that
            the operator does not cover.
        coverage: Fraction of each pixel that the mesh covers, shape (O, 1, P).
    """

    def __init__(
        self,
        operators: Sequence[TransferOperator],
        shown: Int[Tensor, " N"],
        device: torch.device | str = "cpu",
    ):
        """Copy operators into common tensors.

        `shown` is the index of the operator of each image.
        """
        pixels = torch.cat([operator.pixels for operator in operators]).unique()
        nonzero = torch.cat([operator.nonzero for operator in operators]).unique()
        # If the number of coefficients is odd, append coefficient 0 once more. Its additional
        # row in `transfer` stays zero.
        coefficients = F.pad(nonzero, (0, len(nonzero) % 2))
        channel_count = max(len(operator.transfer) for operator in operators)
        like = operators[0].transfer
        shape = (len(operators), channel_count, len(coefficients), len(pixels))
        transfer = like.new_zeros(shape)
        albedo = like.new_ones(len(operators), COLORS, len(pixels))
        coverage = like.new_zeros(len(operators), 1, len(pixels))
        sparse_parts: list[SparseTransfer] = []
        entry_counts = []
        for index, operator in enumerate(operators):
            # Rows and columns of the common tensors for the coefficients and the pixels of
            # this operator.
            rows = torch.searchsorted(nonzero, operator.nonzero)
            columns = torch.searchsorted(pixels, operator.pixels)
            if channel_count < COLORS:
                channels = transfer[index][: len(operator.transfer)]
                channels[:, rows[:, None], columns] = operator.transfer
                albedo[index][:, columns] = operator.albedo
            else:
                # Three color channels, which include the albedo. The factors `albedo` stay 1.
                transfer[index][:, rows[:, None], columns] = operator.by_channel
            coverage[index, 0, columns] = operator.coverage
            if operator.sparse is not None:
                stack_pixel = columns[operator.sparse.pixel]
                sparse_parts.append(operator.sparse._replace(pixel=stack_pixel))
            entry_counts.append(0 if operator.sparse is None else len(operator.sparse.function))
        sparse = concatenate_entries(sparse_parts)
        self._sparse = sparse and sparse.to(device)
        # Operator i has the sparse entries from `_first_entry[i]` to
        # `_first_entry[i + 1]` - 1.
        self._first_entry = F.pad(torch.tensor(entry_counts).cumsum(0), (1, 0))
        self.shown = shown
        self.pixels = pixels.to(device)
        self.transfer = transfer.to(device)
        self.albedo = albedo.to(device)
        self.coverage = coverage.to(device)
        self._coefficients = coefficients.to(device)

    def radiance(
        self, lights: Float[Tensor, "A coefficients 3"], images: Int[Tensor, " A"]
    ) -> Float[Tensor, "A 3 P"]:
        """Compute the linear radiance of A of the N images, differentiable in their lights.

        A batched product needs the same number of lights for each operator. The
        lights are therefore written to a table with one row for each operator that
        the images show, and one column (slot) for each of its images. Slots stay
        empty if an operator has fewer images than another operator. `images` are indices on
        the CPU.
        """
        operator_of_image = self.shown[images]
        operators, image_to_row, images_per_row = torch.unique(
            operator_of_image, return_inverse=True, return_counts=True
        )
        slot_count = max(images_per_row.tolist(), default=0)
        slot_of_image = _rank_in_row(image_to_row, images_per_row)
        # Cell of each image in the table. The cells are numbered row by row.
        cell = image_to_row * slot_count + slot_of_image
        has_gaps = len(cell) != len(operators) * slot_count
        is_ordered = not has_gaps and bool((cell.diff() == 1).all())
        operators = operators.to(lights.device, non_blocking=True)
        cell = cell.to(lights.device, non_blocking=True)
        # Axes: image, coefficient that changes a pixel, color.
        used_lights = lights.index_select(1, self._coefficients)
        light_table = used_lights.new_zeros(len(operators) * slot_count, *used_lights.shape[1:])
        light_table = light_table.index_copy(0, cell, used_lights)
        # Axes: operator, slot for one of its images, coefficient, color.
        light_table = light_table.unflatten(0, (len(operators), slot_count))
        shows_all_operators = len(operators) == len(self.transfer)
        transfer = self.transfer if shows_all_operators else self.transfer[operators]
        albedo = self.albedo if shows_all_operators else self.albedo[operators]
        # Axes: cell of the table, color, pixel.
        radiance = apply_transfer(light_table, transfer, albedo).flatten(0, 1)
        if not is_ordered:
            radiance = radiance.index_select(0, cell)
        if self._sparse is None:
            return radiance
        entries, image_of_entry = self._select_entries(self._sparse, operator_of_image)
        return radiance + entries.radiance(lights, image_of_entry, len(self.pixels))

    def _select_entries(
        self, sparse: SparseTransfer, operator_of_image: Int[Tensor, " A"]
    ) -> tuple[SparseTransfer, Tensor]:
        """Select the nonzero matrix entries of the operators that A images show.

        The entries of the first image come first. The second result is the index of the
        image of each entry, from 0 to A - 1.
        """
        first_in_stack = self._first_entry[operator_of_image]
        entry_count = self._first_entry[operator_of_image + 1] - first_in_stack
        image_of_entry = torch.arange(len(operator_of_image)).repeat_interleave(entry_count)
        # All entries of an image follow each other, in `sparse` and in the result. The two
        # positions of an entry therefore differ by the same number for all entries.
        first_in_result = entry_count.cumsum(0) - entry_count
        offset_of_image = first_in_stack - first_in_result
        position_in_stack = torch.arange(len(image_of_entry)) + offset_of_image[image_of_entry]
        position_in_stack = position_in_stack.to(self.pixels.device, non_blocking=True)
        image_of_entry = image_of_entry.to(self.pixels.device, non_blocking=True)
        selected = SparseTransfer(*(field[position_in_stack] for field in sparse))
        return selected, image_of_entry


def _rank_in_row(
    item_to_row: Int[Tensor, " A"], items_per_row: Int[Tensor, " rows"]
) -> Int[Tensor, " A"]:
    """For each of A items, count the earlier items in the same row of a table.

    For example, items in the rows 1, 0, 1 have the ranks 0, 0, 1.
    """
    # Sort the items by row. The items of a row keep their order.
    sorted_items = item_to_row.argsort(stable=True)
    first_of_row = items_per_row.cumsum(0) - items_per_row
    sorted_ranks = torch.arange(len(item_to_row)) - first_of_row[item_to_row[sorted_items]]
    # Write the ranks back in the original order of the items.
    return torch.empty_like(item_to_row).index_copy_(0, sorted_items, sorted_ranks)
