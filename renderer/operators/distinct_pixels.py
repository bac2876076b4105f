"""Equal pixels of a view, so that a product is computed for one of them and then copied.

Two pixels that the same face fills may be equal in all lights. In a large image
of few faces, most pixels are equal to another pixel.

Shapes use these letters: a view has P covered pixels. D of them are distinct,
and the other P - D pixels are copies of distinct pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderer.visibility.fragments import Fragments

# Equal pixels are only searched in views with at least this many copies of pixels. With
# fewer copies, copying the results would take more time than it saves.
FEWEST_COPIES = 2**12


@dataclass(frozen=True)
class DistinctPixels:
    """D groups of pixels of a view that are equal in every light.

    One pixel of each group is its distinct pixel. The others are its copies.
    Pixels are given by their indices among the P covered pixels, or, after `at`,
    by other indices such as those in the image.

    Attributes:
        distinct: The D distinct pixels, ascending, shape (D,).
        copies: All other pixels, ascending, shape (P - D,).
        copy_to_distinct: Position in `distinct` of the pixel that equals each
            copy, shape (P - D,).
    """

    distinct: Int[Tensor, " D"]
    copies: Int[Tensor, " copies"]
    copy_to_distinct: Int[Tensor, " copies"]

    def at(self, new_index: Int[Tensor, " P"]) -> DistinctPixels:
        """Return a copy in which pixels have other indices, such as those in the image."""
        distinct = new_index.index_select(0, self.distinct)
        copies = new_index.index_select(0, self.copies)
        return replace(self, distinct=distinct, copies=copies)

    def write(self, values: Float[Tensor, "... D"], canvas: Float[Tensor, "... pixels"]) -> Tensor:
        """Write one value for each group of equal pixels to all pixels of the group.

        `canvas` is changed in place and returned.
        """
        batch_shape = values.shape[:-1]
        distinct = self.distinct.expand(*batch_shape, -1)
        copies = self.copies.expand(*batch_shape, -1)
        copy_to_distinct = self.copy_to_distinct.expand(*batch_shape, -1)
        # `scatter_` and `gather` take half the time of `index_copy_` and `index_select` on
        # a CPU.
        canvas.scatter_(-1, distinct, values)
        return canvas.scatter_(-1, copies, values.gather(-1, copy_to_distinct))

    def add_up(self, values: Float[Tensor, "... pixels"]) -> Float[Tensor, "... D"]:
        """Add up the values of the pixels in each of the D groups of equal pixels."""
        batch_shape = values.shape[:-1]
        distinct = self.distinct.expand(*batch_shape, -1)
        copies = self.copies.expand(*batch_shape, -1)
        copy_to_distinct = self.copy_to_distinct.expand(*batch_shape, -1)
        sums = values.gather(-1, distinct)
        return sums.scatter_add_(-1, copy_to_distinct, values.gather(-1, copies))


def find_distinct_pixels(
    fragments: Fragments, albedo: Float[Tensor, "3 P"]
) -> DistinctPixels | None:
    """Find the covered pixels that are equal because the same face fills them.

    All samples of a face must reflect the same light, up to their albedo. The result is
    None if there are too few copies to save time, or if a copy has another albedo.
    """
    pixel_count = len(fragments.pixels)
    if pixel_count < FEWEST_COPIES:
        return None
    # A group is all samples of one face in a pixel.
    groups = fragments.groups
    filling_groups = indices_of_true(groups.sample_count == fragments.samples**2)
    filled_pixels = groups.group_to_pixel.index_select(0, filling_groups)
    filling_face = groups.group_to_seen_face.index_select(0, filling_groups)
    # Index of the first pixel that each seen face fills.
    face_to_first_pixel = filling_face.new_full((len(fragments.faces),), pixel_count)
    face_to_first_pixel.scatter_reduce_(0, filling_face, filled_pixels, "amin")
    first_pixels = face_to_first_pixel.index_select(0, filling_face)
    # Positions in `filled_pixels` of the pixels that are copies of another pixel. Selecting
    # with indices is faster than with a mask.
    copying = indices_of_true(filled_pixels != first_pixels)
    copies = filled_pixels.index_select(0, copying)
    originals = first_pixels.index_select(0, copying)
    if len(copies) < FEWEST_COPIES or 2 * len(copies) < pixel_count:
        return None
    if not torch.equal(albedo.index_select(1, copies), albedo.index_select(1, originals)):
        return None
    is_distinct = torch.ones(pixel_count, dtype=torch.bool)
    is_distinct.index_fill_(0, copies, False)
    pixel_to_distinct = is_distinct.cumsum(0) - 1
    return DistinctPixels(
        distinct=indices_of_true(is_distinct),
        copies=copies,
        copy_to_distinct=pixel_to_distinct.index_select(0, originals),
    )


def indices_of_true(mask: Bool[Tensor, " N"]) -> Int[Tensor, " _"]:
    """Return the indices of the entries of a mask that are true.

    This takes a quarter of the time of `torch.nonzero`.
    """
    return torch.from_numpy(np.flatnonzero(mask.numpy()))
