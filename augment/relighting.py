"""Images of objects in other light: stacked transfer operators, and nothing is rasterized again."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from augment.objects import SceneObject
from augment.utils import progress, require_memory
from renderer.camera import Camera
from renderer.image import ImageSettings, background_term
from renderer.transfer import TransferOperator, apply_transfer
from renderer.transport.local import SparseTransfer, joined

Rows = slice | Tensor


class Layer(NamedTuple):
    """Covered pixels (P,) of B images, which are `rows` of a batch: a part of it or, on its device, indices (B,).

    composite: (B, 3, P) linear radiance and background.
    """

    rows: Rows
    pixels: Tensor
    composite: Tensor


class InPlace(torch.autograd.Function):
    """Canvases (N, 3, size²), overwritten where layers are by their values (B, 3, P); differentiable in these."""

    @staticmethod
    def forward(ctx: Any, canvas: Tensor, targets: Sequence[tuple[Rows, Tensor]], *covered: Tensor) -> Tensor:
        ctx.targets = targets
        for (rows, pixels), values in zip(targets, covered, strict=True):
            images = canvas[rows].index_copy_(2, pixels, values)
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


STACKED = 2**16  # pixels of the images in one stack; larger stacks are no faster


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
