"""Image files, as a classifier sees them, and arrays of numbers as .npy files."""

import io
import math
import reprlib
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from renderer.errors import InputError, require_file
from renderer.io.files import write_whole

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
DECODED_SIZES = 16  # a JPEG is decoded no smaller than this multiple of the final size


def read_image(path: str | Path, size: int) -> Tensor:
    """`read_square` as (3, size, size) float32 in [0, 1]. InputError where the file cannot be read."""
    require_file(path, "give an image file")
    try:
        square = read_square(path, size)
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        raise InputError(f"{path} cannot be read ({error}): give an image file") from error
    return torch.from_numpy(np.array(square)).permute(2, 0, 1) / 255


def gray_or_image(name: str, choice: float | str | Path, size: int) -> Tensor:
    """Make a gray image, or read the center square of an image file.

    Args:
        name: Name of the argument that holds the choice, for messages.
        choice: Gray value in [0, 1], also as text, or the path of an image file.
        size: Pixels per side.

    Returns:
        Values in [0, 1], shape (1, size, size) for gray and (3, size, size) for a
        file.

    Raises:
        InputError: If the choice is neither, or the file cannot be read.

    Example:
        >>> gray_or_image("background", 0.5, 2).tolist()
        [[[0.5, 0.5], [0.5, 0.5]]]
    """
    expected = "give gray values in [0, 1] or image files"
    if isinstance(choice, bool):
        raise InputError(f"{name}={choice}: {expected}")
    try:
        gray = float(choice)  # type: ignore[arg-type]  # Of a path it raises.
    except (ValueError, TypeError, OverflowError):
        gray = math.nan
    if math.isnan(gray) and isinstance(choice, str | Path):
        try:
            return read_image(Path(choice), size)
        except InputError as error:
            raise InputError(f"{name}: {error} or a gray value") from error
    if not 0 <= gray <= 1:
        raise InputError(f"{name}={reprlib.repr(choice)}: {expected}")
    return torch.full((1, size, size), gray)


def read_square(path: str | Path, size: int) -> np.ndarray:
    """The center square of an image as (size, size, 3) uint8. Raises whatever Pillow does at a broken file."""
    return np.asarray(central_square(read_rgb(path, DECODED_SIZES * size), size))


def read_rgb(path: str | Path, least: int) -> Image.Image:
    """An image, upright, alpha over white. least: a large JPEG is decoded at 1/2, 1/4 or 1/8 of its size, several times
    faster, but to no fewer pixels per side. Raises whatever Pillow does at a broken file."""
    with Image.open(path) as image:
        image.draft(None, (least, least))
        upright = eight_bits(ImageOps.exif_transpose(image))
    if upright.has_transparency_data:
        upright = upright.convert("RGBA")
        upright = Image.alpha_composite(Image.new("RGBA", upright.size, "white"), upright)
    return upright.convert("RGB")


def central_square(image: Image.Image, size: int) -> Image.Image:
    """The center square of an image, size × size."""
    return ImageOps.fit(image, (size, size), Image.Resampling.LANCZOS)


def eight_bits(image: Image.Image) -> Image.Image:
    """The image with channels of 8 bits. ValueError where its white is unknown; whatever Pillow raises at damage."""
    if image.mode == "F":
        raise ValueError("floating-point pixels have no agreed white")
    if image.mode.startswith("I"):  # 16 bits per pixel, which Pillow would clip rather than scale
        return Image.fromarray(np.clip(np.asarray(image) // 256, 0, 255).astype(np.uint8))
    image.load()
    return image


def write_image(path: Path, image: Image.Image, **options: object) -> None:
    """Write an image as a whole, in the format of the path's suffix.

    Args:
        path: The file to replace or to make.
        image: The image.
        **options: Those of Pillow's `Image.save`.

    Raises:
        OSError: The file cannot be written.
    """
    content = io.BytesIO()
    image.save(content, Image.registered_extensions()[path.suffix.lower()], **options)
    write_whole(path, content.getbuffer())


def write_numbers(path: Path, numbers: np.ndarray) -> None:
    """Write an array as an .npy file, as a whole.

    Args:
        path: The file to replace or to make.
        numbers: The array.

    Raises:
        OSError: The file cannot be written.
    """
    content = io.BytesIO()
    np.save(content, numbers)
    write_whole(path, content.getbuffer())


def read_numbers(path: Path) -> np.ndarray:
    """The real numbers of an .npy file as float32; larger ones become infinite. Reads no more than the file holds,
    whatever its header says. ValueError: no numbers; whatever NumPy raises at a damaged header."""
    array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.kind not in "fiu" or not array.size:
        raise ValueError(f"it holds {array.dtype} of shape {array.shape}, not real numbers")
    with np.errstate(over="ignore"):
        return array.astype(np.float32)
