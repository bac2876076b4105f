"""Conversion of linear radiance to image values: background, clamping and encoding.

Clamping is not linear. The conversion therefore comes after all sums of radiance.
Linear RGB has the primaries of Rec. 709 with D65; `to_rec709` converts others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from renderer.errors import InputError, as_tensor, require, require_bounded, require_choice
from renderer.modes import once_differentiable
from renderer.settings import ENCODINGS, REC_709, Size, height_and_width

# Linear value at which the sRGB curve changes
# from a straight line to a power function.
SRGB_KNEE = 0.0031308
# Encoded value at which the sRGB curve changes
# from a straight line to a power function.
SRGB_ENCODED_KNEE = 0.04045
# Weights of the linear red, green and blue
# in the luminance (Rec. 709, IEC 61966-2-1).
LUMINANCE = (0.2126, 0.7152, 0.0722)
# Image values may exceed the range [0, 1] by at most this much, because of interpolation and noise.
OVERSHOOT = 0.1


def tonemap(
    radiance: Float[Tensor, "*#batch #channels #P"],
    coverage: Float[Tensor, "*#batch 1 #P"],
    background: Float[Tensor, "*#batch #channels #P"],
    encoding: str = "linear",
) -> Float[Tensor, "*#batch #channels #P"]:
    """Convert the radiance of pixels to image values in front of a background.

    The radiance is already multiplied by the coverage, the covered fraction of a pixel.
    Backgrounds are encoded image values.
    """
    require_bounded(radiance=radiance)
    return encode(clamp(radiance + background_term(coverage, background, encoding)), encoding)


def composite(
    radiance: Float[Tensor, "*batch 3 P"],
    coverage: Float[Tensor, " P"],
    pixels: Int[Tensor, " P"],
    background: Float[Tensor, "*#batch 3 height width"],
    encoding: str = "linear",
) -> Float[Tensor, "*batch 3 height width"]:
    """Put the radiance of covered pixels in front of a background.

    The radiance is already multiplied by the coverage. `pixels` are row-major, and the
    background has encoded values.
    """
    backgrounds = background.expand(*radiance.shape[:-2], *background.shape[-3:])
    # The last axis is over the pixels of an image
    # in row-major order, shape (..., 3, height · width).
    background_pixels = backgrounds.flatten(-2)
    behind_mesh = background_pixels.index_select(-1, pixels)
    covered = tonemap(radiance, coverage[None], behind_mesh, encoding)
    images = background_pixels.scatter(-1, pixels.expand(covered.shape), covered)
    return images.unflatten(-1, background.shape[-2:])


def as_background(
    background: float | Tensor, size: Size, like: Tensor
) -> Float[Tensor, "... 3 height width"]:
    """Convert a gray value, a color or images to background images.

    Values outside [0, 1] raise `InputError`. The result gets the dtype and device of
    `like`.
    """
    shape = height_and_width(size)
    # If values from the CPU were checked on a GPU, the CPU would wait for it.
    values = as_tensor("background", background).to(like.dtype)
    expected = f"a gray value, a color (3,) or images {(3, *shape)}, in [0, 1]"
    fault = f"background has values outside [0, 1]: give {expected}"
    if values.numel():
        require((values.min() >= 0) & (values.max() <= 1), lambda: InputError(fault))
    values = values.to(like.device)
    if values.ndim < 2:
        # A gray value or a color becomes an image of equal pixels.
        values = values.view(-1, 1, 1).expand(-1, *shape)
    if values.ndim < 3 or values.shape[-3:] not in ((1, *shape), (3, *shape)):
        raise InputError(f"background has shape {tuple(values.shape)}: give {expected}")
    return values.expand(*values.shape[:-3], 3, *shape)


def background_term(
    coverage: Float[Tensor, " ..."], background: Float[Tensor, "... _ _"], encoding: str = "linear"
) -> Float[Tensor, "... _ P"]:
    """Compute the linear values that the background adds to pixels that a mesh partly covers."""
    require_bounded(coverage=coverage, background=background)
    return (1 - coverage) * decode(background, encoding)


def clamp(values: Float[Tensor, " ..."], ceiling: Tensor | float = 1.0) -> Tensor:
    """Clamp values to [0, ceiling], with a gradient of 1 at the limits themselves.

    With a gradient of 0 at the limit 0, an optimization could not increase a
    light of 0 in front of a black background. The gradient of `torch.clamp` at
    its limits differs between versions of torch. The ceiling gets no gradient.
    """
    return _Clamp.apply(values, ceiling)


class _Clamp(torch.autograd.Function):
    """Clamping to [0, ceiling], with a gradient of 1 at the limits themselves."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, ceiling: Tensor | float) -> Tensor:
        """Clamp values to [0, ceiling]."""
        clamped = values.clamp(min=0).clamp_(max=ceiling)
        # 1.0 for values that clamping did not change, and 0.0
        # for other values. A product with booleans would be
        # several times slower than a product with numbers.
        ctx.save_for_backward(torch.eq(values, clamped, out=torch.empty_like(values)))
        return clamped

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        """Compute the gradient of the loss, which is 0 for values that clamping changed."""
        (unclamped_mask,) = ctx.saved_tensors
        return upstream * unclamped_mask, None


def encode(linear: Float[Tensor, " ..."], encoding: str) -> Tensor:
    """Encode linear values as image values.

    "linear" returns them unchanged, and "srgb" applies the sRGB transfer function (IEC
    61966-2-1).
    """
    require_choice("encoding", encoding, ENCODINGS)
    if encoding == "linear":
        return linear
    # The power function has an infinite derivative at 0.
    # Without the lower limit, its gradient there would be
    # NaN, although `torch.where` selects the straight line.
    curve = 1.055 * linear.clamp(min=SRGB_KNEE) ** (1 / 2.4) - 0.055
    return torch.where(linear <= SRGB_KNEE, 12.92 * linear, curve)


def encode_gradient(linear: Float[Tensor, " ..."], upstream: Tensor, encoding: str) -> Tensor:
    """Compute the gradient with respect to linear values from that for encoded values.

    The bits of the result are the same as those of autograd for `encode`, because
    the operations and their order are the same.
    """
    if encoding == "linear":
        return upstream
    power_slope = (1 / 2.4) * linear.clamp(min=SRGB_KNEE) ** (1 / 2.4 - 1)
    return torch.where(linear <= SRGB_KNEE, upstream * 12.92, upstream * 1.055 * power_slope)


def decode(image: Float[Tensor, " ..."], encoding: str) -> Tensor:
    """Decode image values to linear values. This is the inverse of `encode`."""
    require_choice("encoding", encoding, ENCODINGS)
    if encoding == "linear":
        return image
    curve = ((image.clamp(min=SRGB_ENCODED_KNEE) + 0.055) / 1.055) ** 2.4
    return torch.where(image <= SRGB_ENCODED_KNEE, image / 12.92, curve)


def to_bytes(image: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """Convert image values in [0, 1] to 8-bit values."""
    # `round_` rounds in place, which saves the memory of a copy.
    return (image * 255).round_().to(torch.uint8)


def straight_through(images: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Apply a function, which need not be differentiable, with the gradient of the identity."""
    # The difference is computed from detached images, so it has no gradient.
    detached = images.detach()
    return images + (change(detached) - detached)


def require_unit_range(images: Float[Tensor, " ..."]) -> None:
    """Check that image values are in [0, 1], up to OVERSHOOT."""
    low, high = images.detach().aminmax()
    advice = "use RGB in [0, 1], without normalization (divide bytes by 255)"
    fault = f"images has values from {{:g}} to {{:g}}: {advice}".format
    require((low >= -OVERSHOOT) & (high <= 1 + OVERSHOOT), lambda: InputError(fault(low, high)))


def to_unit(images: UInt8[Tensor, "*shape"]) -> Float32[Tensor, "*shape"]:
    """Convert 8-bit image values to values in [0, 1]."""
    return images.float() / 255


# Chromaticities that differ by at most this are those of Rec. 709, rounded.
ROUNDING = 1e-3
# Primaries of cameras are at most 1.5. Larger numbers may be percentages.
LARGEST = 2
# Matrix from XYZ to the responses of cones in Bradford's chromatic adaptation
# (ICC.1:2022, annex E).
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def to_rec709(chromaticities: Sequence[float], adapt: bool) -> Float[np.ndarray, "3 3"] | None:
    """Compute the matrix from linear RGB of other primaries to Rec. 709.

    The chromaticities are CIE x and y of red, green, blue and white. `adapt` maps white to white,
    as for photographs (Bradford). Otherwise each light keeps its chromaticity, as for radiance.
    None stands for Rec. 709.
    """
    xy = np.asarray(chromaticities, dtype=np.float64)
    # Files round chromaticities, so small differences from Rec. 709 do not count.
    if xy.shape == (8,) and np.abs(xy - REC_709).max() <= ROUNDING:
        return None
    # Matrices from linear RGB to the responses of the eye's cones, for both kinds of primaries.
    ours = BRADFORD @ _to_xyz(np.array(REC_709))
    with suppress(ValueError, np.linalg.LinAlgError):
        theirs = BRADFORD @ _to_xyz(xy)
        if adapt:
            # The sum over the primaries is the response of the cones to white.
            theirs = np.diag(ours.sum(axis=1) / theirs.sum(axis=1)) @ theirs
        matrix: np.ndarray = np.linalg.inv(ours) @ theirs
        # Primaries that nearly lie on a line give huge numbers.
        if np.abs(xy).max() <= LARGEST and (np.abs(matrix) < 100).all():
            return matrix
    raise ValueError(f"the primaries {xy.tolist()} span no colors")


def _to_xyz(chromaticities: np.ndarray) -> np.ndarray:
    """Compute the matrix from linear RGB to XYZ, in which white has Y = 1."""
    x, y = chromaticities.reshape(4, 2).T
    with np.errstate(divide="ignore", invalid="ignore"):
        # Columns are red, green, blue and white, of which only the ratio X : Y : Z is known.
        xyz = np.stack([x, y, 1 - x - y])
        white = xyz[:, 3] / y[3]
    # Scale the primaries, so that they add up to white.
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], white)
