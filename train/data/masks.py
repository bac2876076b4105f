"""Read masks, which tell the pixels of an object in a photograph from the others."""

import numpy as np
from jaxtyping import UInt8
from numpy.lib.stride_tricks import sliding_window_view
from PIL import ImageOps

from renderer.errors import InputError, require_file, single_line
from renderer.io.images import eight_bits, open_image

# Gray values from this one on count as white, because JPEG files change white a little.
WHITE = 250
# Channels that differ by at most this are of a gray image, which JPEG files tint a little.
TINT = 8
# Advice at the end of errors.
ADVICE = "save white where the object is and black elsewhere"


def read_mask(path: str, height: int, width: int) -> UInt8[np.ndarray, "height width"]:
    """Read the mask of the object in a photograph.

    The opaque part of an image with transparency is the object. In an image of two
    values or colors, of which one is black, the other one is the object. Otherwise,
    white is the object. What is not plain white on black is printed. The mask is 255 where the
    object is, and less where it covers a part of a pixel.
    """
    require_file(path, "give an image file as mask")
    try:
        levels = _levels(path)
    # Pillow raises errors of almost any type for a damaged file.
    except Exception as error:
        raise InputError(f"mask={path} cannot be read ({single_line(error)}): {ADVICE}") from error
    if levels.shape != (height, width):
        raise InputError(
            f"mask={path} has {levels.shape[1]} × {levels.shape[0]} pixels, but the photograph has "
            f"{width} × {height}: give a mask of the same size",
        )
    return levels


def _levels(path: str) -> np.ndarray:
    """Read the coverage of each pixel by the object, uint8. Raises ValueError if it is unknown."""
    with open_image(path) as image:
        ImageOps.exif_transpose(image, in_place=True)
        if image.has_transparency_data:
            rgba = np.asarray(eight_bits(image).convert("RGBA"))
            alpha = rgba[..., 3]
            if alpha.min() < alpha.max():
                opaque = rgba[..., :3][alpha >= WHITE]
                if {*np.unique(opaque).tolist()} == {0, 255}:
                    raise ValueError("it is black and white, and a part is transparent")
                print(f"mask={path}: the opaque part is the object")
                return _white_on_black(path, alpha)
            return _of_colors(path, rgba[..., :3])
        if image.mode in ("1", "L", "I", "F") or image.mode.startswith("I;16"):
            values = np.asarray(image)
            is_of_two_values = len(np.unique(values)) <= 2
            return _white_on_black(
                path, values if is_of_two_values else np.asarray(eight_bits(image))
            )
        return _of_colors(path, np.asarray(image.convert("RGB")))


def _of_colors(path: str, rgb: np.ndarray) -> np.ndarray:
    """Convert a mask with colors, shape (H, W, 3), to coverage."""
    if np.ptp(rgb, axis=-1).max() <= TINT:
        return _white_on_black(path, rgb[..., 0])
    colors = np.unique(rgb.reshape(-1, 3), axis=0)
    # The colors are sorted, so black is the first.
    if len(colors) != 2 or colors[0].any():
        raise ValueError(f"it has {len(colors)} colors")
    print(f"mask={path}: the color {tuple(colors[1].tolist())} is the object")
    return np.where(rgb.any(axis=-1), 255, 0).astype(np.uint8)


def _white_on_black(path: str, values: np.ndarray) -> np.ndarray:
    """Convert a mask of one channel, shape (H, W), to coverage."""
    levels = np.unique(values)
    if len(levels) == 1:
        raise ValueError(f"all of its pixels have the value {levels[0]}")
    if len(levels) == 2 and levels[0] == 0 and levels[1] > 0:
        if levels[1] not in (1, 255):
            print(f"mask={path}: the value {levels[1]} is the object")
        return np.where(values > 0, 255, 0).astype(np.uint8)
    # NaN, which sorts last, is not white.
    if not levels[-1] >= WHITE or levels[0] > 255 - WHITE:
        raise ValueError(f"its values are from {levels[0]} to {levels[-1]} of 255")
    # A pixel at the edge of the object has a neighbor of another value.
    neighbors = sliding_window_view(values, (3, 3))
    is_flat = neighbors.min(axis=(2, 3)) == neighbors.max(axis=(2, 3))
    areas = np.unique(values[1:-1, 1:-1][is_flat])
    gray = areas[(areas > 255 - WHITE) & (areas < WHITE)]
    if len(gray):
        raise ValueError(f"areas of it have the gray value {gray[0]}")
    return values.astype(np.uint8)
