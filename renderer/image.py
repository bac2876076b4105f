"""Radiance to image: background, clamp and encoding, in one place and last, since clamping is not linear."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError, require_bounded, require_choice
from renderer.settings import ENCODINGS
from renderer.validation import as_tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, Int, UInt8

SRGB_KNEE = 0.0031308  # linear value at which the curve of sRGB changes from a line to a power


def tonemap(
    radiance: Float[Tensor, "*batch 3 P"],
    coverage: Float[Tensor, "*#batch 1 P"],
    background: Float[Tensor, "*#batch channels #P"],
    encoding: str = "linear",
) -> Float[Tensor, "*batch 3 P"]:
    """Image values in [0, 1] as a classifier sees them.

    radiance: linear, already weighted with coverage. coverage: in [0, 1].
    background: image values behind the surface, of three channels or one. InputError: NaN.
    """
    require_bounded(radiance=radiance)
    return encode(clamp(radiance + background_term(coverage, background, encoding)), encoding)


def composite(
    radiance: Float[Tensor, "*batch 3 P"],
    coverage: Float[Tensor, " P"],
    pixels: Int[Tensor, " P"],
    background: Float[Tensor, "*#batch 3 size size"],
    encoding: str = "linear",
) -> Float[Tensor, "*batch 3 size size"]:
    """Whole images: `tonemap` at the covered pixels, the background elsewhere. pixels: row-major."""
    behind_all = background.expand(*radiance.shape[:-2], *background.shape[-3:]).flatten(-2)
    covered = tonemap(radiance, coverage[None], behind_all.index_select(-1, pixels), encoding)
    return behind_all.scatter(-1, pixels.expand(covered.shape), covered).unflatten(-1, background.shape[-2:])


def as_background(background: float | Tensor, size: int, like: Tensor) -> Tensor:
    """A gray value, a color (3,) or images (..., 3, size, size), in [0, 1], as images of the dtype and device of
    `like`. InputError: another shape, values beyond [0, 1]."""
    values = as_tensor("background", background).to(like)
    if values.ndim < 2:
        values = values.view(-1, 1, 1).expand(-1, size, size)
    advice = f"give a gray value, a color (3,) or images (3, {size}, {size}), in [0, 1]"
    if values.ndim < 3 or values.shape[-3:] not in ((1, size, size), (3, size, size)):
        raise InputError(f"background of shape {tuple(values.shape)} is none: {advice}")
    if not (values.min() >= 0 and values.max() <= 1):
        raise InputError(f"background holds values beyond [0, 1]: {advice}")
    return values.expand(*values.shape[:-3], 3, size, size)


def background_term(coverage: Tensor, background: Tensor, encoding: str = "linear") -> Tensor:
    """What a background adds to the radiance in front of it, linear (..., 3 or 1, P); shapes as in `tonemap`.
    InputError: NaN."""
    require_bounded(coverage=coverage, background=background)
    return (1 - coverage) * decode(background, encoding)


def clamp(values: Tensor, ceiling: Tensor | float = 1.0) -> Tensor:
    """To [0, ceiling]; differentiable in the values.

    At the bounds themselves the gradient passes, so that a light of zero on black can grow, unlike that of
    `torch.clamp`, whose versions differ there.
    """
    return _Clamp.apply(values, ceiling)


class _Clamp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, ceiling: Tensor | float) -> Tensor:
        clamped = values.clamp(min=0).clamp_(max=ceiling)
        # As numbers: with booleans, comparison and product take several times as long.
        ctx.save_for_backward(torch.eq(values, clamped, out=torch.empty_like(values)))
        return clamped

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        (passing,) = ctx.saved_tensors
        return upstream * passing, None


def encode(linear: Tensor, encoding: str) -> Tensor:
    """Linear values in [0, 1] to image values: unchanged, or the sRGB transfer function (IEC 61966-2-1)."""
    require_choice("encoding", encoding, ENCODINGS)
    if encoding == "linear":
        return linear
    # The power's derivative is infinite at 0, in the branch that is not taken; the floor keeps it finite.
    curve = 1.055 * linear.clamp(min=SRGB_KNEE) ** (1 / 2.4) - 0.055
    return torch.where(linear <= SRGB_KNEE, 12.92 * linear, curve)


def encode_gradient(linear: Tensor, upstream: Tensor, encoding: str) -> Tensor:
    """Compute the gradient by the linear values from that by the encoded values, without a graph.

    The operations and their order are those of the gradient of `encode` by autograd, so the bits are equal, too.
    """
    if encoding == "linear":
        return upstream
    power_slope = (1 / 2.4) * linear.clamp(min=SRGB_KNEE) ** (1 / 2.4 - 1)
    return torch.where(linear <= SRGB_KNEE, upstream * 12.92, upstream * 1.055 * power_slope)


def decode(image: Tensor, encoding: str) -> Tensor:
    """Inverse of `encode`. Under "linear" a texture's values are taken as the albedo as they stand."""
    require_choice("encoding", encoding, ENCODINGS)
    if encoding == "linear":
        return image
    curve = ((image.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(image <= 0.04045, image / 12.92, curve)


def to_bytes(image: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """Image values in [0, 1] to 8 bits, rounded."""
    return (image * 255).round_().to(torch.uint8)  # in place: of many renders, a copy less


def to_unit(images: UInt8[Tensor, "*shape"]) -> Float32[Tensor, "*shape"]:
    """8-bit images to RGB in [0, 1]."""
    return images.float() / 255
