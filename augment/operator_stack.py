"""Operators over a common set of pixels, so that one product renders all images that they are seen in."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.sparse import Sparse, joined
from renderer.transfer import Operator, apply_transfer


class OperatorStack:
    """O operators, and N images that each show one of them in a light of its own.

    Operators share nothing but the index of pixels that any of them covers; the other pixels are neither stored nor
    shaded. pixels: (P,) int64. transfer: (O, 3 or 1, K, P), of the K coefficients that reach a pixel of any of them,
    and a row of zeros where their number is odd: for 32 rows instead of 31 the gradient's product is twice as fast.
    albedo: (O, 3, P). coverage: (O, 1, P).
    """

    def __init__(self, operators: Sequence[Operator], shown: Tensor, device: torch.device | str = "cpu"):
        """shown: (N,) int64, the operator of each image. The operators are of one dtype and basis, on the CPU."""
        pixels = torch.cat([operator.pixels for operator in operators]).unique()
        slots, self._slots = _rank_among_equals(shown)
        kept = torch.cat([operator.kept for operator in operators]).unique()
        padded = F.pad(kept, (0, len(kept) % 2))  # with any coefficient
        parts = (pixels, *_stack(operators, pixels, kept), shown, slots, padded)
        self._sparse, self._first = _joined(operators, pixels, device)
        self.pixels, self.transfer, self.albedo, self.coverage, self.shown, self._slot, self._coefficients = (
            part.to(device) for part in parts
        )

    def radiance(self, lights: Tensor, images: Tensor) -> Tensor:
        """Linear radiance (A, 3, P) of images (A,), each in its light (A, size, 3); differentiable in the lights.

        Lights are laid out on a grid of the operators in use × their images, which leaves gaps where an image is not
        wanted; operators that none of them shows are left alone.
        """
        used, row = torch.unique(self.shown[images], return_inverse=True)
        if (images.diff() > 0).all():
            slot, slots = self._slot[images], self._slots
        else:  # an image may be wanted more than once
            slot, slots = _rank_among_equals(row)
        cell = row * slots + slot
        kept = lights.index_select(1, self._coefficients)
        grid = kept.new_zeros(len(used) * slots, *kept.shape[1:]).index_copy(0, cell, kept)
        everything = len(used) == len(self.transfer)
        transfer, albedo = (part if everything else part[used] for part in (self.transfer, self.albedo))
        radiance = apply_transfer(grid.unflatten(0, (len(used), slots)), transfer, albedo).flatten(0, 1)
        no_gaps = len(cell) == len(grid) and (cell.diff() == 1).all()
        radiance = radiance if no_gaps else radiance.index_select(0, cell)
        if self._sparse is None:
            return radiance
        entries, image = self._entries(self._sparse, self.shown[images])
        return radiance + entries.radiance(lights, image, len(self.pixels))

    def _entries(self, sparse: Sparse, shown: Tensor) -> tuple[Sparse, Tensor]:
        """(the sparse entries of operators (A,), one after the other, (N,) which of the A each is of)."""
        first, count = self._first[shown], self._first[shown + 1] - self._first[shown]
        image = torch.arange(len(shown), device=shown.device).repeat_interleave(count)
        entry = torch.arange(len(image), device=shown.device) + (first - count.cumsum(0) + count)[image]
        return sparse.taken(entry), image


def _rank_among_equals(values: Tensor) -> tuple[Tensor, int]:
    """(for each value (N,) how many equal ones come before it, how often the most frequent one occurs)."""
    order, counts = values.argsort(stable=True), values.bincount()
    first = (counts.cumsum(0) - counts)[values[order]]
    ranks = torch.empty_like(values).index_copy_(0, order, torch.arange(len(values), device=values.device) - first)
    return ranks, int(counts.max())


def _joined(operators: Sequence[Operator], pixels: Tensor, device: torch.device | str) -> tuple[Sparse | None, Tensor]:
    """(the sparse entries of all operators, over common pixels, (O + 1,) where those of each begin)."""
    counts, placed = [0], []
    for operator in operators:
        own = operator.sparse
        counts.append(0 if own is None else len(own.function))
        if own is not None:
            places = torch.searchsorted(pixels, operator.pixels)
            placed.append(own._replace(pixel=places[own.pixel]))
    entries = joined(*placed)
    return entries and entries.to(device), torch.tensor(counts, device=device).cumsum(0)


def _stack(operators: Sequence[Operator], pixels: Tensor, kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Operators over common pixels and coefficients: transfer (O, C, K, P), albedo (O, 3, P), coverage (O, 1, P)."""
    channels, like = max(len(operator.transfer) for operator in operators), operators[0].transfer
    transfer = like.new_zeros(len(operators), channels, len(kept) + len(kept) % 2, len(pixels))
    albedo = like.new_ones(len(operators), 3, len(pixels))
    coverage = like.new_zeros(len(operators), 1, len(pixels))
    for row, operator in enumerate(operators):
        rows, columns = torch.searchsorted(kept, operator.kept)[:, None], torch.searchsorted(pixels, operator.pixels)
        if channels == 1:
            transfer[row][:, rows, columns], albedo[row][:, columns] = operator.transfer, operator.albedo
        else:
            transfer[row][:, rows, columns] = operator.transfer * operator.albedo[:, None]
        coverage[row, 0, columns] = operator.coverage
    return transfer, albedo, coverage
