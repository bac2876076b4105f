"""Transfer operators of many views, stacked so that one batched product gives all images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, overload

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError
from renderer.image import as_background, background_term, clamp, encode
from renderer.transport.lamp_paths import SparseTransfer, joined
from renderer.transport.operators import TransferOperator, apply_transfer, require_image_gradient
from renderer.validation import as_tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Total number of pixels of the images in one stack. Larger stacks are not faster.
STACKED = 2**16
# `TransferOperators` uses a loop over operators if a stack would hold fewer,
# which is faster then.
FEWEST = 8
# Rows of a canvas, as a slice or as indices.
Rows = slice | Tensor
COLORS = 3


class TransferOperators(Sequence[TransferOperator]):
    """The transfer operators of V views, which also renders all views in one call.

    The first call of `image` copies the operators of small images into stacks,
    which take about as much memory again.

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
        """Collect operators.

        Args:
            operators: At least one operator. All need the same image settings,
                basis of light and dtype.

        Raises:
            InputError: If there is no operator, or one differs from the first.
        """
        self._operators = list(operators)
        if not self._operators:
            raise InputError("operators is empty: give one operator or several")
        first = self._operators[0]
        for operator in self._operators:
            is_same = operator.settings == first.settings and operator.basis == first.basis
            if not is_same or operator.transfer.dtype != first.transfer.dtype:
                raise InputError(
                    "operators differ in image settings, basis of light or dtype: give equal ones"
                )

    @overload
    def __getitem__(self, index: int) -> TransferOperator: ...

    @overload
    def __getitem__(self, index: slice) -> TransferOperators: ...

    def __getitem__(self, index: int | slice) -> TransferOperator | TransferOperators:
        """Return the operator of one view, or the operators of several views."""
        chosen = self._operators[index]
        return TransferOperators(chosen) if isinstance(chosen, list) else chosen

    def __len__(self) -> int:
        """Return the number of views, V."""
        return len(self._operators)

    def __add__(self, others: Iterable[TransferOperator]) -> list[TransferOperator]:
        """Return a list of these operators and of others, which may have other settings."""
        return [*self, *others]

    def to(self, device: torch.device | str) -> TransferOperators:
        """Return the same operators on another device.

        Args:
            device: The device, such as "cuda".
        """
        return TransferOperators(operator.to(device) for operator in self)

    def image(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        background: float | Tensor = 0.5,
        *,
        light_per_view: bool = False,
    ) -> Float[Tensor, "V *lights 3 size size"]:
        """Render all views under B lights, differentiable in the lights and in the background.

        The images equal those of the single operators up to rounding.

        Args:
            lights: Coefficients, shape (..., coefficients, 3). Every view is
                rendered under every light.
            background: Gray value, color, or images in [0, 1] that broadcast to
                (V, ..., 3, size, size).
            light_per_view: Whether each view has its own lights. Their shape is
                then (V, ..., coefficients, 3).

        Returns:
            Images in [0, 1], shape (V, ..., 3, size, size).

        Raises:
            InputError: If the lights hold NaN, have another basis or are not one
                per view, or if the background has another shape.
        """
        first = self._operators[0]
        lights = as_tensor("lights", lights)
        first.require_lights(lights)
        if light_per_view and (lights.ndim < 3 or len(lights) != len(self)):
            raise InputError(
                f"lights of shape {tuple(lights.shape)} are not one per view: "
                f"give ({len(self)}, ..., {first.basis.size}, 3)"
            )
        of_views = lights if light_per_view else lights.expand(len(self), *lights.shape)
        size = first.settings.size
        image_shape = (*of_views.shape[:-2], COLORS, size, size)
        background_images = as_background(background, size, lights)
        if background_images.ndim > 3:
            background_images = _broadcast_background(background_images, image_shape)
        stack_size = min(len(self), self._per_stack)
        if stack_size < FEWEST or background_images.requires_grad:
            return self._image_by_image(of_views, background_images)
        return self._stacked_images(of_views, background_images, image_shape)

    def image_and_gradient(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        loss_gradient: Callable[[Tensor], Tensor],
        background: float | Tensor = 0.5,
        *,
        light_per_view: bool = False,
    ) -> tuple[Float[Tensor, "V *lights 3 size size"], Float[Tensor, "*lights coefficients 3"]]:
        """Render all views under B lights and compute the gradient of a loss by the lights.

        Args:
            lights: Coefficients, as for `image`.
            loss_gradient: Function of the images, shape (V, ..., 3, size, size).
                It returns the gradient of the loss by the images, of the same
                shape. `torch.func.grad(loss)` makes such a function from a loss.
            background: Background, as for `image`.
            light_per_view: Whether each view has its own lights, as for `image`.

        Returns:
            The images, and the gradient of the loss by the lights, with the
            shape of the lights.

        Raises:
            InputError: See `image`. Also if the gradient of the loss has
                another shape than the images.
        """
        lights = as_tensor("lights", lights)
        self._operators[0].require_lights(lights)
        variable = lights.detach().requires_grad_()
        with torch.enable_grad():
            images = self.image(variable, background, light_per_view=light_per_view)
        shown = images.detach()
        image_gradient = loss_gradient(shown)
        require_image_gradient(image_gradient, shown)
        [gradient] = torch.autograd.grad(images, variable, image_gradient.detach())
        return shown, gradient

    @property
    def _per_stack(self) -> int:
        """Return how many operators one stack holds."""
        return max(1, STACKED // self._operators[0].settings.size ** 2)

    @cached_property
    def _stacks(self) -> list[OperatorStack]:
        """Return all operators in stacks, on the device of the operators."""
        device = self._operators[0].transfer.device
        stacks = []
        for start in range(0, len(self), self._per_stack):
            operators = self._operators[start : start + self._per_stack]
            stacks.append(OperatorStack(operators, torch.arange(len(operators)), device))
        return stacks

    def _image_by_image(self, lights: Tensor, background: Tensor) -> Tensor:
        """Render lights (V, ..., coefficients, 3), one operator after the other.

        The background has the shape (3, size, size) or that of the images.
        """
        size = self._operators[0].settings.size
        if background.ndim == 3:
            background = background.expand(len(self), COLORS, size, size)
        views = zip(self, lights, background, strict=True)
        return torch.stack([operator.image(light, behind) for operator, light, behind in views])

    def _stacked_images(
        self, of_views: Tensor, background: Tensor, image_shape: Sequence[int]
    ) -> Tensor:
        """Render lights (V, ..., coefficients, 3), one stack of operators after the other.

        The background has the shape (3, size, size) or that of the images.
        """
        encoding = self._operators[0].settings.encoding
        lights = of_views.flatten(0, -3).to(self._operators[0].transfer.dtype)
        lights_per_view = len(lights) // len(self)
        # One background, or one for each image: shape (1 or N, 3, size²).
        backgrounds = background.reshape(-1, COLORS, image_shape[-1] ** 2)
        first_row = 0
        targets = []
        covered = []
        for stack in self._stacks:
            # This is the index in the stack of the operator that each image shows.
            shown = torch.arange(len(stack.shown)).repeat_interleave(lights_per_view)
            rows = slice(first_row, first_row + len(shown))
            first_row = rows.stop
            of_stack = backgrounds if len(backgrounds) == 1 else backgrounds[rows]
            # torch selects ten times as fast from two axes as from three.
            at_pixels = of_stack.flatten(0, 1).index_select(1, stack.pixels)
            coverage = stack.coverage[shown.to(background.device)].to(background)
            term = background_term(coverage, at_pixels.unflatten(0, (-1, COLORS)), encoding)
            radiance = stack.radiance(lights[rows], shown).to(background.dtype)
            targets.append((rows, stack.pixels))
            covered.append(encode(clamp(radiance + term), encoding))
        canvas = backgrounds.expand(len(lights), -1, -1)
        canvas = canvas.clone(memory_format=torch.contiguous_format)
        return ScatterLayers.apply(canvas, targets, *covered).view(image_shape)


def _broadcast_background(images: Tensor, shape: Sequence[int]) -> Tensor:
    """Broadcast background images to (V, ..., 3, size, size), or raise `InputError`."""
    try:
        return images.expand(shape)
    except RuntimeError as error:
        given = tuple(images.shape)
        raise InputError(
            f"background of shape {given} does not broadcast to {tuple(shape)}: "
            "give one image, or one per view and light"
        ) from error


class ScatterLayers(torch.autograd.Function):
    """Write layers of pixel values into images, in place.

    Its arguments are a canvas (N, 3, size²), and for each layer its target and
    its values. A target is a pair of the rows of the canvas (B,) and the pixels
    (P,). The values have the shape (B, 3, P). The result is the canvas, and is
    differentiable in the values alone.
    """

    @staticmethod
    def forward(
        ctx: Any, canvas: Tensor, targets: Sequence[tuple[Rows, Tensor]], *covered: Tensor
    ) -> Tensor:
        ctx.targets = targets
        for (rows, pixels), values in zip(targets, covered, strict=True):
            # index_copy_ takes twice as long as scatter_ on a CPU.
            images = canvas[rows].scatter_(2, pixels.expand(values.shape), values)
            if isinstance(rows, Tensor):
                # Indexing with a tensor copies the rows, so write them back.
                canvas.index_copy_(0, rows, images)
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        gradients = []
        for rows, pixels in ctx.targets:
            # torch selects ten times as fast from two axes as from three.
            values = upstream[rows].flatten(0, 1).index_select(1, pixels)
            gradients.append(values.unflatten(0, (-1, COLORS)))
        return None, None, *gradients


class OperatorStack:
    """O transfer operators over a common set of P pixels and K coefficients.

    N images show one of the operators each, under their own light.

    Attributes:
        shown: Index of the operator that each image shows, int64, shape (N,), on
            the CPU.
        pixels: Ascending indices of the pixels that any of the operators covers,
            int64, shape (P,).
        transfer: Dense transfer of the coefficients that are nonzero in any of
            the operators, shape (O, 1 to 3, K, P). If their number is odd, a row
            of zeros follows. With 32 rows instead of 31, the product of the
            gradient takes half the time.
        albedo: Albedo of each operator, shape (O, 3, P). It is 1 in pixels that
            the operator does not cover.
        coverage: Coverage of each operator, shape (O, 1, P).
    """

    def __init__(
        self,
        operators: Sequence[TransferOperator],
        shown: Tensor,
        device: torch.device | str = "cpu",
    ):
        """Copy operators into common tensors.

        Args:
            operators: The O operators, on the CPU. All need the same dtype and
                basis.
            shown: Index of the operator of each image, int64, shape (N,).
            device: Device of the stack.
        """
        pixels = torch.cat([operator.pixels for operator in operators]).unique()
        nonzero = torch.cat([operator.nonzero for operator in operators]).unique()
        # The appended row of zeros multiplies an arbitrary coefficient.
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
            rows = torch.searchsorted(nonzero, operator.nonzero)
            columns = torch.searchsorted(pixels, operator.pixels)
            if channel_count < COLORS:
                channels = transfer[index][: len(operator.transfer)]
                channels[:, rows[:, None], columns] = operator.transfer
                albedo[index][:, columns] = operator.albedo
            else:
                transfer[index][:, rows[:, None], columns] = operator.by_channel
            coverage[index, 0, columns] = operator.coverage
            if operator.sparse is not None:
                in_stack = columns[operator.sparse.pixel]
                sparse_parts.append(operator.sparse._replace(pixel=in_stack))
            entry_counts.append(0 if operator.sparse is None else len(operator.sparse.function))
        sparse = joined(sparse_parts)
        self._sparse = sparse and sparse.to(device)
        # The sparse entries of operator i are those from _first_entry[i] to
        # _first_entry[i + 1].
        self._first_entry = F.pad(torch.tensor(entry_counts).cumsum(0), (1, 0))
        self.shown = shown
        self.pixels = pixels.to(device)
        self.transfer = transfer.to(device)
        self.albedo = albedo.to(device)
        self.coverage = coverage.to(device)
        self._coefficients = coefficients.to(device)

    def radiance(self, lights: Tensor, images: Tensor) -> Tensor:
        """Compute the linear radiance of some images, differentiable in their lights.

        Args:
            lights: Light of each image, shape (A, size, 3).
            images: Indices of the images, int64, shape (A,), on the CPU.

        Returns:
            Radiance, shape (A, 3, P).
        """
        # The lights are laid out on a grid with a row for each operator and a
        # slot for each of its images. Some slots stay empty if one operator is
        # shown by fewer images than another.
        shown = self.shown[images]
        operators, row, counts = torch.unique(shown, return_inverse=True, return_counts=True)
        slot_count = max(counts.tolist(), default=0)
        cell = row * slot_count + _rank_in_row(row, counts)
        has_gaps = len(cell) != len(operators) * slot_count
        is_ordered = not has_gaps and bool((cell.diff() == 1).all())
        operators = operators.to(lights.device, non_blocking=True)
        cell = cell.to(lights.device, non_blocking=True)
        nonzero = lights.index_select(1, self._coefficients)
        grid = nonzero.new_zeros(len(operators) * slot_count, *nonzero.shape[1:])
        grid = grid.index_copy(0, cell, nonzero).unflatten(0, (len(operators), slot_count))
        is_complete = len(operators) == len(self.transfer)
        transfer = self.transfer if is_complete else self.transfer[operators]
        albedo = self.albedo if is_complete else self.albedo[operators]
        radiance = apply_transfer(grid, transfer, albedo).flatten(0, 1)
        if not is_ordered:
            radiance = radiance.index_select(0, cell)
        if self._sparse is None:
            return radiance
        entries, image = self._entries(self._sparse, shown)
        return radiance + entries.radiance(lights, image, len(self.pixels))

    def _entries(self, sparse: SparseTransfer, shown: Tensor) -> tuple[SparseTransfer, Tensor]:
        """Return the sparse entries of operators (A,), one after the other.

        The second result is the position in `shown` of each entry.
        """
        first = self._first_entry[shown]
        count = self._first_entry[shown + 1] - first
        image = torch.arange(len(shown)).repeat_interleave(count)
        # The entries of an image are consecutive in the result and in the stack.
        # The offset leads from their positions in the result to those in the stack.
        first_in_result = count.cumsum(0) - count
        offset = first - first_in_result
        entry = torch.arange(len(image)) + offset[image]
        entry = entry.to(self.pixels.device, non_blocking=True)
        image = image.to(self.pixels.device, non_blocking=True)
        return SparseTransfer(*(field[entry] for field in sparse)), image


def _rank_in_row(row: Tensor, counts: Tensor) -> Tensor:
    """Return for each item how many earlier items have the same row, shape (A,).

    `row` (A,) is the row of each item, and `counts` the number of items of each
    row. For example, the rows 1, 0, 1 give 0, 0, 1.
    """
    # The items of a row are neighbors in this order, earlier items first.
    order = row.argsort(stable=True)
    first_in_order = counts.cumsum(0) - counts
    rank_in_order = torch.arange(len(row)) - first_in_order[row[order]]
    return torch.empty_like(row).index_copy_(0, order, rank_in_order)
