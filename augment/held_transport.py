"""Shadows and bounces while a mesh is deformed or painted: held as they were for its own shape and colours."""

import torch
from torch import Tensor

from renderer.fragments import Fragments
from renderer.transfer import Operator


class HeldTransport:
    """What transport adds to the images of one view, per unit of each coefficient of light.

    It stays where it is in the image, as the outline does for derivatives, and goes with the albedo of its pixel.
    """

    def __init__(self, shaped: Operator, direct: Operator, fragments: Fragments, albedo: Tensor):
        """shaped, direct: the view's operators with transport and without. fragments, albedo (S, 3): of the view."""
        size = shaped.basis.size
        change = _rows(shaped, size) - _rows(direct, size)
        canvas = change.new_zeros(*change.shape[:2], shaped.settings.size**2)
        self._change = canvas.index_copy(2, shaped.pixels, change)
        self._albedo = _by_pixel(fragments, albedo)

    def radiance(self, fragments: Fragments, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) of a view's fragments with albedo (S, 3) in a light (size, 3); differentiable in both."""
        added = torch.einsum("ckp,kc->cp", self._change[..., fragments.pixels].to(light), light)
        before = self._albedo[:, fragments.pixels]
        now = _by_pixel(fragments, albedo)[:, fragments.pixels]
        return added * torch.where(before > 0, now / before.masked_fill(before == 0, 1), 1).to(light)


def _rows(operator: Operator, size: int) -> Tensor:
    """(3, size, P) the whole transfer."""
    transfer = operator.transfer * operator.albedo[:, None]
    return transfer.new_zeros(3, size, transfer.shape[2]).index_copy(1, operator.kept, transfer)


def _by_pixel(fragments: Fragments, albedo: Tensor) -> Tensor:
    """(3, size²) the sum of the samples' albedo (S, 3) over each pixel."""
    pixel = fragments.pixels[fragments.pixel]
    return albedo.new_zeros(3, fragments.size**2).index_add(1, pixel, albedo.T)
