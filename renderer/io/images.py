"""Read image files as square images for a classifier, and write image files."""

import io
import math
import re
import reprlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageOps, features
from PIL.TiffImagePlugin import BITSPERSAMPLE, PHOTOMETRIC_INTERPRETATION, TiffImageFile
from torch import Tensor

from renderer.errors import InputError, require_file
from renderer.io.color_profiles import conversion_to_srgb
from renderer.io.files import atomic_write

# Suffixes of the files in a folder that count as images.
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
# Formats of Pillow that are read, whatever the name of the file. Others can run programs:
# Pillow passes an EPS file to Ghostscript. "TGA" is last, because it has no signature.
FORMATS = [
    *("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "JPEG2000", "PPM"),
    *(["AVIF"] if "avif" in features.modules else []),
    "TGA",
]
# A large JPEG file is decoded at a reduced size before it is
# resized to a small square. The sides of the decoded image
# are at least this many times as long as those of the square.
MIN_DECODED_RATIO = 16
# Largest change of an sRGB value from the level 0 to 1 of 255 at which 8 bits keep what 16 show.
MAX_STEP = 4


def read_image(path: str | Path, size: int) -> Float[Tensor, "3 size size"]:
    """Read the central square of an image file as RGB values in [0, 1]."""
    require_file(path, "give an image file")
    # Pillow can raise almost any exception for a damaged file.
    try:
        square = read_square(path, size)
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as an image ({error}): give an image file"
        ) from error
    return torch.from_numpy(np.array(square)).permute(2, 0, 1) / 255


def gray_or_image(name: str, choice: float | str | Path, size: int) -> Float[Tensor, "_ size size"]:
    """Create a gray image from a value in [0, 1] or its text, or read the square of an image."""
    advice = "give gray values in [0, 1] or image files"
    # `float` would accept True as 1.
    if isinstance(choice, bool):
        raise InputError(f"{name}={choice} is no image: {advice}")
    try:
        gray = float(choice)  # type: ignore[arg-type]
    except (ValueError, TypeError, OverflowError):
        # NaN means that the choice is not a
        # number. It may be the path of a file.
        gray = math.nan
    if math.isnan(gray) and isinstance(choice, str | Path):
        try:
            return read_image(Path(choice), size)
        except InputError as error:
            raise InputError(f"{name}: {error} or a gray value") from error
    if not 0 <= gray <= 1:
        raise InputError(f"{name}={reprlib.repr(choice)} is no image: {advice}")
    return torch.full((1, size, size), gray)


def read_square(path: str | Path, size: int) -> UInt8[np.ndarray, "size size 3"]:
    """Read the central square of an image file with 8 bits per channel."""
    image = read_rgb(path, MIN_DECODED_RATIO * size)
    return np.asarray(central_square(image, size))


@contextmanager
def open_image(path: str | Path) -> Iterator[Image.Image]:
    """Open a regular image file of one of `FORMATS`, without decoding its pixels."""
    require_file(path, "give an image file")
    # From a path, Pillow would map a TIFF file to memory, and scramble it if it is rotated.
    with Path(path).open("rb") as file, identify(file) as image:
        yield image


def identify(file: BinaryIO) -> Image.Image:
    """Return the image in a stream of bytes, without decoding its pixels."""
    image = Image.open(file, formats=FORMATS)
    key = image.info.get("transparency")
    if image.format == "PNG" and key is not None:
        # Pillow expands gray pixels of 2 and 4 bits, and keeps the upper 8 of 16 bits
        # of colors, but does not do the same with the transparent color.
        layout = image.tile[0][3]
        if layout in ("L;2", "L;4"):
            image.info["transparency"] = key * {"L;2": 85, "L;4": 17}[layout]
        elif layout == "RGB;16B":
            image.info["transparency"] = tuple(value >> 8 for value in key)
    return image


def read_rgb(path: str | Path, min_side: int) -> Image.Image:
    """Read an image file as an upright sRGB image on a white background.

    A large JPEG file is decoded at 1/2, 1/4 or 1/8 of its size, which is several
    times faster. An image is not reduced below `min_side`. Rotation (EXIF), transparency and
    color profile are applied.
    """
    with open_image(path) as image:
        # `draft` makes Pillow decode a JPEG file at a reduced size.
        image.draft(None, (min_side, min_side))
        convert = conversion_to_srgb(image, path)
        has_more_bits = re.search(";1[26]", str(getattr(image, "tile", "")))
        color, alpha = color_and_alpha(image)
    if convert is not None:
        levels = Image.new(color.mode, (2, 1))
        levels.putpixel((1, 0), (1,) * len(color.getbands()))
        darkest, next_level = np.asarray(convert(levels), dtype=int)[0]
        if has_more_bits and np.abs(next_level - darkest).max() > MAX_STEP:
            raise ValueError(
                "it is linear light of 12 or 16 bits, whose dark values are not read: "
                "save it in sRGB"
            )
        color = convert(color)
    color = color.convert("RGB")
    if alpha is None:
        return color
    color.putalpha(alpha)
    white = Image.new("RGBA", color.size, "white")
    return Image.alpha_composite(white, color).convert("RGB")


def color_and_alpha(image: Image.Image) -> tuple[Image.Image, Image.Image | None]:
    """Return upright colors (L, RGB or CMYK) and opacity (L or None) with 8 bits per channel."""
    ImageOps.exif_transpose(image, in_place=True)
    image = eight_bits(image)
    if image.mode == "La":
        image = image.convert("LA")
    is_gray = image.mode in ("1", "L", "LA", "La")
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        color = rgba.getchannel("R") if is_gray else rgba.convert("RGB")
        return color, rgba.getchannel("A")
    if image.mode in ("L", "CMYK"):
        return image, None
    return image.convert("L" if is_gray else "RGB"), None


def central_square(image: Image.Image, size: int) -> Image.Image:
    """Cut out the central square of an image and resize it."""
    return ImageOps.fit(image, (size, size), Image.Resampling.LANCZOS)


def eight_bits(image: Image.Image) -> Image.Image:
    """Convert an image to 8 bits per channel. If white is unknown, this raises a ValueError."""
    if image.format not in (None, "MPO", *FORMATS):
        raise ValueError(f"the format {image.format} of an image is not read: use PNG or JPEG")
    if image.mode == "F" or (image.mode == "I" and image.format == "TIFF"):
        kind = "floating-point numbers" if image.mode == "F" else "signed or 32-bit integers"
        raise ValueError(
            f"the pixels are {kind}, so the value of white is unknown: save 8 or 16 bits"
        )
    if image.mode.startswith("I"):
        # Pixels of the mode "I" have 16 bits, or the 12 bits of a TIFF file. `Image.convert`
        # would clip their values at 255 instead of dividing them.
        pixels = np.asarray(image)
        tags = image.tag_v2 if isinstance(image, TiffImageFile) else {}
        bits = tags.get(BITSPERSAMPLE, (16,))[0]
        values = np.clip(pixels >> (bits - 8), 0, 255).astype(np.uint8)
        # Pillow inverts such a TIFF file only if it has at most 8 bits.
        is_white_zero = tags.get(PHOTOMETRIC_INTERPRETATION) == 0
        scaled = Image.fromarray(255 - values if is_white_zero else values)
        key = image.info.get("transparency")
        if key is not None:
            scaled.putalpha(Image.fromarray(np.where(pixels == key, 0, 255).astype(np.uint8)))
        return scaled
    image.load()
    return image


def write_image(path: Path, image: Image.Image, **options: object) -> None:
    """Write an image file in the format that its suffix names.

    A reader never sees a part of the new file: see `atomic_write`.
    """
    content = io.BytesIO()
    image_format = Image.registered_extensions()[path.suffix.lower()]
    image.save(content, image_format, **options)
    atomic_write(path, content.getbuffer())
