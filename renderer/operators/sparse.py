"""Transfer matrices of local lights, of which few entries are nonzero."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

# A matrix with a smaller fraction of nonzero entries is faster to multiply entry by entry
# than as a dense matrix.
SPARSE_FRACTION = 1 / 16
# A matrix with at most this many entries is always faster to multiply as a dense matrix.
SMALL_MATRIX_SIZE = 2**16


class SparseTransfer(NamedTuple):
    """The N nonzero entries of a matrix from light coefficients to pixel radiance.

    Attributes:
        function: Index of the basis function (lamp, or pixel of a projector) whose
            light each entry describes, int64, shape (N,).
        pixel: Index of the covered pixel of each entry, int64, shape (N,).
        weight: Radiance of the pixel per unit of the function's coefficient, in
            C = 1 or 3 color channels, shape (N, C).
    """

    function: Int[Tensor, " N"]
    pixel: Int[Tensor, " N"]
    weight: Float[Tensor, "N C"]

    def dense(self, pixel_count: int) -> tuple[Tensor, Tensor]:
        """Write the entries into a dense matrix, without rows that would only have zeros.

        The matrix has one row for each basis function with an entry, in C color channels.
        The second result has the ascending indices of these functions.
        """
        functions, row_of_entry = self.function.unique(return_inverse=True)
        # One row for each channel, which has all rows of the matrix after each other.
        zeros = self.weight.new_zeros(self.weight.shape[1], len(functions) * pixel_count)
        flat_position = row_of_entry * pixel_count + self.pixel
        flat_matrix = zeros.index_copy_(1, flat_position, self.weight.T)
        return flat_matrix.unflatten(1, (len(functions), pixel_count)), functions

    def is_sparse(self, pixel_count: int) -> bool:
        """Tell whether multiplying entry by entry is faster than a product with a dense matrix.

        The dense matrix has one column for each covered pixel, and one row for each
        basis function that has a nonzero entry.
        """
        row_count = len(self.function.unique())
        dense_size = row_count * pixel_count
        if dense_size <= SMALL_MATRIX_SIZE:
            return False
        entry_count = len(self.weight)
        return entry_count < SPARSE_FRACTION * dense_size

    def to(self, device: torch.device | str) -> SparseTransfer:
        """Return a copy of the entries on another device."""
        return SparseTransfer(*(field.to(device) for field in self))

    def radiance(
        self, lights: Float[Tensor, "B K 3"], image: Int[Tensor, " N"], pixel_count: int
    ) -> Float[Tensor, "B 3 P"]:
        """Compute the radiance of B images, each with its own light.

        The entries must have three channels. They may belong to several views.
        The result is differentiable with respect to the lights. `image` is the index of the
        image to which each entry belongs.
        """
        # Row of the coefficient of each entry, if the coefficients of all images are
        # written below each other.
        light_row = image * lights.shape[1] + self.function
        contributions = lights.flatten(0, 1).index_select(0, light_row) * self.weight
        radiance_row = image * pixel_count + self.pixel
        # One row for each pixel of each image, one column for each color.
        zeros = contributions.new_zeros(len(lights) * pixel_count, 3)
        radiance = zeros.index_add(0, radiance_row, contributions)
        return radiance.unflatten(0, (len(lights), pixel_count)).mT


def concatenate_entries(parts: Sequence[SparseTransfer]) -> SparseTransfer | None:
    """Concatenate the nonzero entries of several transfer matrices, in their order."""
    if not parts:
        return None
    return SparseTransfer(
        function=torch.cat([part.function for part in parts]),
        pixel=torch.cat([part.pixel for part in parts]),
        weight=torch.cat([part.weight for part in parts]),
    )
