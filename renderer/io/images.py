"""Read image files as square images for a classifier, and write image files."""

import io
import math
import reprlib
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from renderer.errors import InputError, require_file
from renderer.io.files import atomic_write

# Suffixes of the files in a folder that count as images.
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
# A large JPEG file is decoded at a reduced size before it is
# resized to a small square. The sides of the decoded image
# are at least this many times as long as those of the square.
MIN_DECODED_RATIO = 16


def read_image(path: str | Path, size: int) -> Tensor:
    """Read the central square of an image file.

    Args:
        path: Image file.
        size: Width and height of the result in pixels.

    Returns:
        RGB values in [0, 1], float32, shape (3, size, size).

    Raises:
        InputError: If the file does not exist or cannot be read.
    """
    require_file(path, "give an image file")
    # Pillow can raise almost any exception for a damaged file.
    try:
        square = read_square(path, size)
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as an image ({error}): give an image file"
        ) from error
    return torch.from_numpy(np.array(square)).permute(2, 0, 1) / 255


def gray_or_image(name: str, choice: float | str | Path, size: int) -> Tensor:
    """Create a gray image, or read the central square of an image file.

    Args:
        name: Name of the argument, for errors.
        choice: Gray value in [0, 1] as a number or as text, or path of an image
            file.
        size: Width and height of the result in pixels.

    Returns:
        Values in [0, 1], shape (1, size, size) for a gray value, and
        (3, size, size) for a file.

    Raises:
        InputError: If `choice` is neither a gray value nor an image file, or if
            the file cannot be read.

    Example:
        >>> gray_or_image("background", 0.5, 2).tolist()
        [[[0.5, 0.5], [0.5, 0.5]]]
    """
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


def read_square(path: str | Path, size: int) -> np.ndarray:
    """Read the central square of an image file with 8 bits per channel.

    Args:
        path: Image file.
        size: Width and height of the result in pixels.

    Returns:
        RGB values, uint8, shape (size, size, 3).

    Raises:
        Exception: If the file is damaged. The class depends on the format.
    """
    image = read_rgb(path, MIN_DECODED_RATIO * size)
    return np.asarray(central_square(image, size))


def read_rgb(path: str | Path, min_side: int) -> Image.Image:
    """Read an image file as an upright RGB image on a white background.

    A large JPEG file is decoded at 1/2, 1/4 or 1/8 of its size, which is several
    times faster.

    Args:
        path: Image file. It may be rotated (EXIF) and have transparent parts.
        min_side: Width and height in pixels below which an image is not reduced
            while it is decoded.

    Returns:
        RGB image with 8 bits per channel.

    Raises:
        Exception: If the file is damaged. The class depends on the format.
    """
    with Image.open(path) as image:
        # `draft` makes Pillow decode a JPEG file at a reduced size.
        image.draft(None, (min_side, min_side))
        upright = eight_bits(ImageOps.exif_transpose(image))
    if upright.has_transparency_data:
        upright = upright.convert("RGBA")
        white = Image.new("RGBA", upright.size, "white")
        upright = Image.alpha_composite(white, upright)
    return upright.convert("RGB")


def central_square(image: Image.Image, size: int) -> Image.Image:
    """Cut out the central square of an image and resize it.

    Args:
        image: Image of any size.
        size: Width and height of the result in pixels.

    Returns:
        Image of size × size pixels.
    """
    return ImageOps.fit(image, (size, size), Image.Resampling.LANCZOS)


def eight_bits(image: Image.Image) -> Image.Image:
    """Convert an image to 8 bits per channel.

    Args:
        image: Image with 8, 16 or 32 bits per channel.

    Returns:
        Image with 8 bits per channel.

    Raises:
        ValueError: If the pixels are floating-point numbers.
        Exception: If the file is damaged. The class depends on the format.
    """
    if image.mode == "F":
        raise ValueError("the pixels are floating-point numbers, so the value of white is unknown")
    if image.mode.startswith("I"):
        # Pixels of the mode "I" have 16 bits. `Image.convert` would
        # clip their values at 255 instead of dividing them by 256.
        scaled = np.clip(np.asarray(image) // 256, 0, 255)
        return Image.fromarray(scaled.astype(np.uint8))
    image.load()
    return image


def write_image(path: Path, image: Image.Image, **options: object) -> None:
    """Write an image file in the format that its suffix names.

    A reader never sees a part of the new file: see `atomic_write`.

    Args:
        path: File to replace or to create, such as "render.png".
        image: Image to write.
        **options: Options of Pillow's `Image.save`.

    Raises:
        OSError: If the file cannot be written.
    """
    content = io.BytesIO()
    image_format = Image.registered_extensions()[path.suffix.lower()]
    image.save(content, image_format, **options)
    atomic_write(path, content.getbuffer())
