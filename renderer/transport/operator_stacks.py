"""Many views in one call: stacked transfer operators, whose images and gradients are one batched product."""

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

STACKED = 2**16  # pixels of the images in one stack; larger stacks are no faster
FEWEST = 8  # operators in a stack of `TransferOperators`; smaller stacks take longer than a loop
Rows = slice | Tensor


class TransferOperators(Sequence[TransferOperator]):
    """The transfer operators of V views: a sequence of them that also renders all views in one call.

    The first call of `image` copies the operators of small images into stacks, which take about as much memory again.

    >>> cameras = renderer.orbit_cameras(5, 2.2)
    >>> operators = renderer.precompute_transfer(renderer.solid("pear"), cameras, size=16)
    >>> lights = torch.stack([renderer.load_light("grace"), renderer.load_light("st_peters")]).requires_grad_()
    >>> images = operators.image(lights, background=0.2)
    >>> images.shape, torch.autograd.grad(images.mean(), lights)[0].shape
    (torch.Size([5, 2, 3, 16, 16]), torch.Size([2, 49, 3]))
    >>> len(operators), operators[0].image(lights).shape
    (5, torch.Size([2, 3, 16, 16]))
    """

    def __init__(self, operators: Iterable[TransferOperator]):
        """Collect operators.

        Args:
            operators: At least one, of the same image settings, basis of light and dtype.

        Raises:
            InputError: If there is none, or one differs from the first.
        """
        self._operators = list(operators)
        if not self._operators:
            raise InputError("operators is empty: give one operator or several")
        first = self._operators[0]
        for operator in self._operators:
            is_same = operator.settings == first.settings and operator.basis == first.basis
            if not is_same or operator.transfer.dtype != first.transfer.dtype:
                raise InputError("operators differ in image settings, basis of light or dtype: give equal ones")

    @overload
    def __getitem__(self, index: int) -> TransferOperator: ...

    @overload
    def __getitem__(self, index: slice) -> TransferOperators: ...

    def __getitem__(self, index: int | slice) -> TransferOperator | TransferOperators:
        """Return the operator of one view, or those of several."""
        chosen = self._operators[index]
        return TransferOperators(chosen) if isinstance(chosen, list) else chosen

    def __len__(self) -> int:
        """Return the number of views, V."""
        return len(self._operators)

    def __add__(self, others: Iterable[TransferOperator]) -> list[TransferOperator]:
        """Return a list of these operators and of others, which may differ."""
        return [*self, *others]

    def to(self, device: torch.device | str) -> TransferOperators:
        """Return the same operators on another device."""
        return TransferOperators(operator.to(device) for operator in self)

    def image(
        self,
        lights: Float[Tensor, "*lights coefficients 3"],
        background: float | Tensor = 0.5,
        *,
        light_per_view: bool = False,
    ) -> Float[Tensor, "V *lights 3 size size"]:
        """Render all views under B lights, differentiable in the lights and in the background.

        The images equal those of the single operators to rounding.

        Args:
            lights: Coefficients, shape (*B, coefficients, 3). All views show each of these lights.
            background: Gray value, color, or images in [0, 1] that broadcast to (V, *B, 3, size, size).
            light_per_view: Whether the lights have the shape (V, *B, coefficients, 3) instead: each view has its own.

        Returns:
            Images in [0, 1], shape (V, *B, 3, size, size).

        Raises:
            InputError: If the lights hold NaN or are of another basis, their number is not that of the views, or the
                background has another shape.
        """
        first = self._operators[0]
        lights = as_tensor("lights", lights)
        first.require_lights(lights)
        if light_per_view and (lights.ndim < 3 or len(lights) != len(self)):
            shape, wanted = tuple(lights.shape), f"({len(self)}, ..., {first.basis.size}, 3)"
            raise InputError(f"lights of shape {shape} are not one per view: give {wanted}")
        of_views = lights if light_per_view else lights.expand(len(self), *lights.shape)
        size = first.settings.size
        shape = (*of_views.shape[:-2], 3, size, size)
        behind = as_background(background, size, lights)
        if behind.ndim > 3:
            behind = _broadcast_background(behind, shape)
        if min(len(self), self._per_stack) < FEWEST or behind.requires_grad:
            backgrounds = behind if behind.ndim > 3 else behind.expand(len(self), 3, size, size)
            views = zip(self, of_views, backgrounds, strict=True)
            return torch.stack([operator.image(light, image) for operator, light, image in views])
        return self._stacked_images(of_views, behind, shape)

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
            loss_gradient: Function of the images (V, *B, 3, size, size) that returns the gradient of the loss by them,
                of the same shape. `torch.func.grad(loss)` makes one from a loss.
            background: As for `image`.
            light_per_view: As for `image`.

        Returns:
            The images, and the gradient of the loss by the lights, of the shape of the lights.

        Raises:
            InputError: As `image`, or if the gradient of the loss has another shape.
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
        """How many operators one stack holds."""
        return max(1, STACKED // self._operators[0].settings.size ** 2)

    @cached_property
    def _stacks(self) -> list[OperatorStack]:
        """All operators in stacks, on their device."""
        device = self._operators[0].transfer.device
        stacks = []
        for start in range(0, len(self), self._per_stack):
            operators = self._operators[start : start + self._per_stack]
            stacks.append(OperatorStack(operators, torch.arange(len(operators)), device))
        return stacks

    def _stacked_images(self, of_views: Tensor, behind: Tensor, shape: Sequence[int]) -> Tensor:
        """Render lights (V, *B, coefficients, 3) before a background, (3, size, size) or of the images' shape."""
        encoding = self._operators[0].settings.encoding
        lights = of_views.flatten(0, -3).to(self._operators[0].transfer.dtype)
        of_each_view = len(lights) // len(self)
        everywhere = behind.reshape(-1, 3, shape[-1] ** 2)
        first, targets, covered = 0, [], []
        for stack in self._stacks:
            images = torch.arange(len(stack.shown)).repeat_interleave(of_each_view)
            rows = slice(first, first + len(images))
            first = rows.stop
            # From two axes, torch selects ten times as fast as from three.
            some = everywhere if len(everywhere) == 1 else everywhere[rows]
            at_pixels = some.flatten(0, 1).index_select(1, stack.pixels).unflatten(0, (-1, 3))
            term = background_term(stack.coverage[images.to(behind.device)].to(behind), at_pixels, encoding)
            radiance = stack.radiance(lights[rows], images).to(behind.dtype)
            targets.append((rows, stack.pixels))
            covered.append(encode(clamp(radiance + term), encoding))
        canvas = everywhere.expand(len(lights), -1, -1).clone(memory_format=torch.contiguous_format)
        return InPlace.apply(canvas, targets, *covered).view(shape)


def _broadcast_background(behind: Tensor, shape: Sequence[int]) -> Tensor:
    """Broadcast images to (V, *B, 3, size, size), or raise InputError."""
    try:
        return behind.expand(shape)
    except RuntimeError as error:
        shapes = f"{tuple(behind.shape)} does not broadcast to {tuple(shape)}"
        raise InputError(f"background of shape {shapes}: give one image, or one per view and light") from error


class InPlace(torch.autograd.Function):
    """Canvases (N, 3, size²), overwritten where layers are by their values (B, 3, P); differentiable in these."""

    @staticmethod
    def forward(ctx: Any, canvas: Tensor, targets: Sequence[tuple[Rows, Tensor]], *covered: Tensor) -> Tensor:
        ctx.targets = targets
        for (rows, pixels), values in zip(targets, covered, strict=True):
            # On a CPU, index_copy_ takes twice as long.
            images = canvas[rows].scatter_(2, pixels.expand(values.shape), values)
            if isinstance(rows, Tensor):  # of which canvas[rows] is a copy
                canvas.index_copy_(0, rows, images)
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        # Of two axes, torch selects ten times as fast as of three.
        covered = (upstream[rows].flatten(0, 1).index_select(1, pixels) for rows, pixels in ctx.targets)
        return None, None, *(values.unflatten(0, (-1, 3)) for values in covered)


class OperatorStack:
    """O transfer operators over a common set of pixels, and N images that show one of them each, in their own light.

    pixels: (P,) int64, covered by any of the operators. transfer: (O, 1 to 3, K, P), of the K coefficients that are
    nonzero in any of them, with a row of zeros if K is odd: with 32 rows instead of 31 the gradient's product is twice
    as fast. albedo: (O, 3, P). coverage: (O, 1, P). Which image shows which operator is known to the host.
    """

    def __init__(self, operators: Sequence[TransferOperator], shown: Tensor, device: torch.device | str = "cpu"):
        """shown: (N,) int64, the operator of each image. The operators are of one dtype and basis, on the CPU."""
        pixels = torch.cat([operator.pixels for operator in operators]).unique()
        nonzero = torch.cat([operator.nonzero for operator in operators]).unique()
        coefficients = F.pad(nonzero, (0, len(nonzero) % 2))  # with any coefficient
        channels, like = max(len(operator.transfer) for operator in operators), operators[0].transfer
        transfer = like.new_zeros(len(operators), channels, len(coefficients), len(pixels))
        albedo = like.new_ones(len(operators), 3, len(pixels))
        coverage = like.new_zeros(len(operators), 1, len(pixels))
        first, parts = [0], list[SparseTransfer]()
        for index, operator in enumerate(operators):
            rows, columns = torch.searchsorted(nonzero, operator.nonzero), torch.searchsorted(pixels, operator.pixels)
            if channels < 3:
                transfer[index][: len(operator.transfer), rows[:, None], columns] = operator.transfer
                albedo[index][:, columns] = operator.albedo
            else:
                transfer[index][:, rows[:, None], columns] = operator.by_channel
            coverage[index, 0, columns] = operator.coverage
            if operator.sparse is not None:
                parts.append(operator.sparse._replace(pixel=columns[operator.sparse.pixel]))
            first.append(sum(len(part.function) for part in parts))
        sparse = joined(parts)
        self._sparse = sparse and sparse.to(device)
        self.shown, self._first = shown, torch.tensor(first)
        tensors = (tensor.to(device) for tensor in (pixels, transfer, albedo, coverage, coefficients))
        self.pixels, self.transfer, self.albedo, self.coverage, self._coefficients = tensors

    def radiance(self, lights: Tensor, images: Tensor) -> Tensor:
        """Linear radiance (A, 3, P), differentiable in the lights (A, size, 3), of images (A,), which are on the host.

        Lights are laid out on a grid of operators × their images, with gaps where an operator has fewer than another.
        Operators that none of the images shows are left out.
        """
        used, row, counts = torch.unique(self.shown[images], return_inverse=True, return_counts=True)
        slots, order = max(counts.tolist(), default=0), row.argsort(stable=True)
        rank = torch.arange(len(row)) - (counts.cumsum(0) - counts)[row[order]]
        cell = row * slots + torch.empty_like(row).index_copy_(0, order, rank)
        no_gaps = len(cell) == len(used) * slots and bool((cell.diff() == 1).all())
        used, cell = (indices.to(lights.device, non_blocking=True) for indices in (used, cell))
        nonzero = lights.index_select(1, self._coefficients)
        grid = nonzero.new_zeros(len(used) * slots, *nonzero.shape[1:]).index_copy(0, cell, nonzero)
        everything = len(used) == len(self.transfer)
        transfer, albedo = (part if everything else part[used] for part in (self.transfer, self.albedo))
        radiance = apply_transfer(grid.unflatten(0, (len(used), slots)), transfer, albedo).flatten(0, 1)
        radiance = radiance if no_gaps else radiance.index_select(0, cell)
        if self._sparse is None:
            return radiance
        entries, image = self._entries(self._sparse, self.shown[images])
        return radiance + entries.radiance(lights, image, len(self.pixels))

    def _entries(self, sparse: SparseTransfer, shown: Tensor) -> tuple[SparseTransfer, Tensor]:
        """(the sparse entries of operators (A,), one after the other; (N,) the row in A of each entry)."""
        first, count = self._first[shown], self._first[shown + 1] - self._first[shown]
        image = torch.arange(len(shown)).repeat_interleave(count)
        entry = torch.arange(len(image)) + (first - count.cumsum(0) + count)[image]
        entry, image = (indices.to(self.pixels.device, non_blocking=True) for indices in (entry, image))
        return SparseTransfer(*(field[entry] for field in sparse)), image
