"""Transfer operators of many views, stacked so that one batched product gives all images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, overload

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from renderer.errors import InputError, explained
from renderer.image import as_background, background_term, clamp, encode
from renderer.modes import once_differentiable, without_autocast
from renderer.operators import apply
from renderer.operators.apply import COLORS, SparseTransfer, TransferOperator

# Operators of small images are copied into common tensors (a stack) until their images have
# this many pixels in total. Larger stacks are not faster.
PIXELS_PER_STACK = 2**16
# Views are rendered one by one if a stack would hold fewer operators than this. A loop over
# the operators is then faster than a batched product.
FEWEST_STACKED = 8
# Type of an index that selects some images of a batch.
Rows = slice | Tensor
# N images, whose pixels are in row-major order.
Images = Float[Tensor, "N 3 pixels"]


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
        kinds = {(each.settings, each.basis, each.transfer.dtype) for each in self._operators}
        if not kinds:
            raise InputError("operators is empty: give at least one TransferOperator")
        if len(kinds) > 1:
            fault = "operators differ in image settings, basis of light or dtype"
            advice = "compute all operators with the same settings, basis and dtype"
            raise InputError(f"{fault}: {advice}")

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
    ) -> Float[Tensor, "... 3 height width"]:
        """Render all V views under one or more lights.

        The result is differentiable with respect to the lights and the
        background. The images equal those of `TransferOperator.image` up to
        rounding.

        Args:
            lights: Coefficients of the lights, shape (..., coefficients, 3).
                Every view is rendered under every light.
            background: Gray value, color, or images in [0, 1] that broadcast to
                (V, ..., 3, height, width).
            light_per_view: True if each view has its own lights. The lights then
                have the shape (V, ..., coefficients, 3).

        Returns:
            Images in [0, 1], shape (V, ..., 3, height, width).

        Raises:
            InputError: If `lights` has NaN, or another number of coefficients
                than the basis. If `light_per_view` is true and the first axis of
                `lights` is not V. If `background` does not broadcast to the
                images.
        """
        first = self._operators[0]
        lights = first.require_lights(lights)
        if light_per_view and (lights.ndim < 3 or len(lights) != len(self)):
            given = f"lights has shape {tuple(lights.shape)}, but light_per_view=True"
            shape = f"({len(self)}, ..., {first.basis.size}, 3)"
            raise InputError(f"{given} needs the shape {shape} for {len(self)} views")
        # One entry along the first axis for each view.
        view_lights = lights if light_per_view else lights.expand(len(self), *lights.shape)
        image_shape = (*view_lights.shape[:-2], COLORS, *first.settings.shape)
        backgrounds = as_background(background, first.settings.size, lights)
        if backgrounds.ndim > 3:
            fault = f"background has shape {tuple(backgrounds.shape)}"
            with explained(fault, f"give images that broadcast to {image_shape}"):
                backgrounds = backgrounds.expand(image_shape)
        operators_in_stack = min(len(self), self._operators_per_stack)
        if operators_in_stack >= FEWEST_STACKED and not backgrounds.requires_grad:
            return self._stacked_images(view_lights, backgrounds.flatten(-2))
        # Only single operators give a gradient with respect to the background.
        if backgrounds.ndim == 3:
            backgrounds = backgrounds.expand(len(self), -1, -1, -1)
        views = zip(self, view_lights, backgrounds, strict=True)
        return torch.stack([operator.image(light, behind) for operator, light, behind in views])

    def image_and_gradient(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        loss_gradient: Callable[[Tensor], Tensor],
        background: float | Tensor = 0.5,
        *,
        light_per_view: bool = False,
    ) -> tuple[Float[Tensor, "... 3 height width"], Float[Tensor, "*lights coefficients 3"]]:
        """Render all V views, and compute the gradient of a loss with respect to the lights.

        Args:
            lights: Coefficients of the lights, shape (..., coefficients, 3), or
                (V, ..., coefficients, 3) with `light_per_view`.
            loss_gradient: Function that takes the images, shape
                (V, ..., 3, height, width), and returns the gradient of the loss
                with respect to the images, in the same shape.
                `torch.func.grad(loss)` makes such a function from a loss.
            background: Gray value, color, or images in [0, 1] that broadcast to
                (V, ..., 3, height, width).
            light_per_view: True if each view has its own lights. False renders
                every view under every light.

        Returns:
            A tuple of

            - the images in [0, 1], shape (V, ..., 3, height, width);
            - the gradient of the loss with respect to the lights, in the shape
              of `lights`.

        Raises:
            InputError: If `image` raises it, or if the result of
                `loss_gradient` has another shape than the images.
        """
        variable_lights = self._operators[0].require_lights(lights).detach().requires_grad_()
        with torch.enable_grad():
            images = self.image(variable_lights, background, light_per_view=light_per_view)
        detached_images = images.detach()
        image_gradient = loss_gradient(detached_images)
        apply.require_image_gradient(image_gradient, detached_images)
        [gradient] = torch.autograd.grad(images, variable_lights, image_gradient.detach())
        return detached_images, gradient

    @property
    def _operators_per_stack(self) -> int:
        """Number of operators in a full stack. The last stack may hold fewer."""
        return max(1, PIXELS_PER_STACK // self._operators[0].settings.pixel_count)

    @cached_property
    def _stacks(self) -> list[OperatorStack]:
        """Stacks of at most `_operators_per_stack` operators, which hold all operators."""
        device, size = self._operators[0].transfer.device, self._operators_per_stack
        groups = [self._operators[first : first + size] for first in range(0, len(self), size)]
        # The stacks are kept, and later calls may need gradients. Image i of a stack shows
        # operator i.
        with torch.inference_mode(False):
            return [OperatorStack(each, torch.arange(len(each)), device) for each in groups]

    def _stacked_images(
        self,
        view_lights: Float[Tensor, "V ... coefficients 3"],
        backgrounds: Float[Tensor, "*lights 3 pixels"],
    ) -> Float[Tensor, "V ... 3 height width"]:
        """Render all V views, with one batched matrix product for each stack of operators."""
        settings = self._operators[0].settings
        # One light for each image. All images of the first view come first.
        lights = view_lights.flatten(0, -3).to(self._operators[0].transfer.dtype)
        lights_per_view = len(lights) // len(self)
        # One background for each image, or a single one.
        backgrounds = backgrounds.reshape(-1, *backgrounds.shape[-2:])
        targets = []
        covered_values = []
        first_image = 0
        for stack in self._stacks:
            # Index of the operator that each image shows: 0, 0, ..., 1, 1, ...
            operator_of_image = stack.shown.repeat_interleave(lights_per_view)
            rows = slice(first_image, first_image + len(operator_of_image))
            first_image = rows.stop
            behind_images = backgrounds if len(backgrounds) == 1 else backgrounds[rows]
            at_pixels = _select_pixels(behind_images, stack.pixels)
            coverage = stack.coverage[operator_of_image.to(backgrounds.device)].to(backgrounds)
            # Linear background, times the fraction of each pixel that shows no mesh.
            behind = background_term(coverage, at_pixels, settings.encoding)
            radiance = stack.radiance(lights[rows], operator_of_image).to(backgrounds.dtype)
            targets.append((rows, stack.pixels))
            covered_values.append(encode(clamp(radiance + behind), settings.encoding))
        # All other pixels keep the background.
        canvas = backgrounds.expand(len(lights), -1, -1)
        canvas = canvas.clone(memory_format=torch.contiguous_format)
        images = ScatterLayers.apply(canvas, targets, *covered_values)
        return images.view(*view_lights.shape[:-2], COLORS, *settings.shape)


def _select_pixels(images: Images, pixels: Int[Tensor, " P"]) -> Float[Tensor, "N 3 P"]:
    """Select pixels of N images, on two merged axes, which is ten times as fast as on three."""
    return images.flatten(0, 1).index_select(1, pixels).unflatten(0, (-1, COLORS))


class ScatterLayers(torch.autograd.Function):
    """Overwrite pixels of a batch of images in place, differentiable in the new values.

    A layer is a set of new pixel values for some of the N images. Its target is
    a pair: the images (rows of the batch), and the pixels that are overwritten.
    """

    @staticmethod
    def forward(
        ctx: Any, canvas: Images, targets: Sequence[tuple[Rows, Tensor]], *layers: Tensor
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
    def backward(ctx: Any, upstream: Images) -> tuple[Tensor | None, ...]:
        """Compute the gradients with respect to the new values of the overwritten pixels."""
        gradients = (_select_pixels(upstream[rows], pixels) for rows, pixels in ctx.targets)
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
        self, operators: Sequence[TransferOperator], shown: Int[Tensor, " N"], device: torch.device
    ):
        """Copy operators into common tensors.

        `shown` is the index of the operator of each image.
        """
        # Pixels and coefficients that any of the operators uses, ascending.
        pixels = torch.cat([operator.pixels for operator in operators]).unique()
        nonzero = torch.cat([operator.nonzero for operator in operators]).unique()
        # If the number of coefficients is odd, append coefficient 0 once more. Its additional
        # row in `transfer` stays zero.
        coefficients = F.pad(nonzero, (0, len(nonzero) % 2))
        channel_count = max(len(operator.transfer) for operator in operators)
        like = operators[0].transfer
        transfer = like.new_zeros(len(operators), channel_count, len(coefficients), len(pixels))
        albedo = like.new_ones(len(operators), COLORS, len(pixels))
        coverage = like.new_zeros(len(operators), 1, len(pixels))
        # Nonzero entries of the further rows of each operator.
        self._sparse: list[SparseTransfer] = []
        no_entries = SparseTransfer(pixels[:0], pixels[:0], like.new_empty(0, COLORS))
        for index, operator in enumerate(operators):
            # Rows and columns of the common tensors for the coefficients and the pixels of
            # this operator.
            rows = torch.searchsorted(nonzero, operator.nonzero)
            columns = torch.searchsorted(pixels, operator.pixels)
            # Three color channels include the albedo. The factors `albedo` then stay 1.
            channels = operator.by_channel if channel_count == COLORS else operator.transfer
            transfer[index, : len(channels)][:, rows[:, None], columns] = channels
            if channel_count < COLORS:
                albedo[index][:, columns] = operator.albedo
            coverage[index, 0, columns] = operator.coverage
            entries = operator.sparse or no_entries
            self._sparse.append(entries._replace(pixel=columns[entries.pixel]).to(device))
        self.shown = shown
        self.pixels = pixels.to(device)
        self.transfer = transfer.to(device)
        self.albedo = albedo.to(device)
        self.coverage = coverage.to(device)
        self._coefficients = coefficients.to(device)

    @without_autocast
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
        operators, row = operator_of_image.unique(return_inverse=True)
        # True where a row (image) shows a column (operator).
        is_shown = operator_of_image[:, None] == operators
        # Among the images that show the same operator, the slot is the number of earlier ones.
        slot = (is_shown.cumsum(0) * is_shown).sum(1) - 1
        slot_count = max(slot.tolist(), default=-1) + 1
        # Cell of each image in the table. The cells are numbered row by row.
        cell = row * slot_count + slot
        cell_count = len(operators) * slot_count
        # True if each cell holds one image in order, so that no image has to be moved.
        is_ordered = torch.equal(cell, torch.arange(cell_count))
        operators = operators.to(lights.device, non_blocking=True)
        cell = cell.to(lights.device, non_blocking=True)
        # Axes: image, coefficient that changes a pixel, color.
        used_lights = lights.index_select(1, self._coefficients)
        light_table = used_lights.new_zeros(cell_count, *used_lights.shape[1:])
        # Axes: operator, slot for one of its images, coefficient, color.
        light_table = light_table.index_copy(0, cell, used_lights)
        light_table = light_table.unflatten(0, (len(operators), slot_count))
        shows_all_operators = len(operators) == len(self.transfer)
        transfer = self.transfer if shows_all_operators else self.transfer[operators]
        albedo = self.albedo if shows_all_operators else self.albedo[operators]
        # The lights are the left factor of the matrix product, which is several times faster on a
        # CPU. With three channels, each color has its own, which includes the albedo. A single
        # channel is shared by all colors. A second one is specular reflection, which is added.
        shared, *white = transfer.unbind(1)
        if len(white) == 2:
            # Multiply a matrix (slots, K) and a matrix (K, P) for each color.
            radiance = (light_table.movedim(-1, -3) @ transfer).movedim(-3, -2)
        else:
            # One row for each pair of a light and a color, so that one matrix product computes all.
            light_rows = light_table.mT.flatten(-3, -2)
            radiance = (light_rows @ shared).unflatten(-2, (-1, COLORS)) * albedo.unsqueeze(-3)
            if white:
                radiance = radiance + (light_rows @ white[0]).unflatten(-2, (-1, COLORS))
        # Axes: cell of the table, color, pixel.
        radiance = radiance.flatten(0, 1)
        if not is_ordered:
            radiance = radiance.index_select(0, cell)
        if any(len(entries.pixel) for entries in self._sparse):
            radiance = radiance + self._sparse_radiance(lights, operator_of_image)
        return radiance

    def _sparse_radiance(
        self, lights: Float[Tensor, "A coefficients 3"], operator_of_image: Int[Tensor, " A"]
    ) -> Float[Tensor, "A 3 P"]:
        """Compute the radiance of A images that the nonzero entries of further rows add."""
        parts = [self._sparse[operator] for operator in operator_of_image.tolist()]
        entries = apply.concatenate_entries(parts)
        entry_counts = torch.tensor([len(part.function) for part in parts])
        image_of_entry = torch.arange(len(parts)).repeat_interleave(entry_counts)
        image_of_entry = image_of_entry.to(lights.device, non_blocking=True)
        # Row of the coefficient of each entry, if the coefficients of all images are
        # written below each other.
        light_row = image_of_entry * lights.shape[1] + entries.function
        contributions = lights.flatten(0, 1).index_select(0, light_row) * entries.weight
        pixel_count = len(self.pixels)
        # One row for each pixel of each image, one column for each color.
        zeros = contributions.new_zeros(len(lights) * pixel_count, COLORS)
        radiance = zeros.index_add(0, image_of_entry * pixel_count + entries.pixel, contributions)
        return radiance.unflatten(0, (len(lights), pixel_count)).mT
