"""Read image files as square sRGB images for a classifier, write them, and draw sheets of images.

A sheet is a picture with a grid of tiles. A tile is an image with its caption
below.

The first of these that a file has says how its colors become sRGB (PNG, third edition,
section 4.3): the chunk cICP of a PNG file, an ICC profile, the codes of an AVIF file (nclx), the
chunk sRGB, the chunks gAMA and cHRM, or the mark of Adobe RGB in the EXIF data of a camera
(DCF 2.0). Without any of them, pixels are sRGB.
"""

from __future__ import annotations

import io
import math
import re
import reprlib
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from itertools import accumulate, repeat, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import ExifTags, Image, ImageCms, ImageDraw, ImageFont, ImageOps, TiffImagePlugin

from renderer.errors import InputError, keyed, reading, require_file
from renderer.io.files import atomic_write
from renderer.settings import REC_709, Size, height_and_width

if TYPE_CHECKING:
    from torch import Tensor

# Suffixes of the files in a folder that count as images.
SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif"),
    *(".jp2", ".ppm", ".pgm", ".avif"),
)
# Formats of Pillow that are read, whatever the name of the file. Others can run programs:
# Pillow passes an EPS file to Ghostscript. "TGA" is last, because it has no signature.
FORMATS = ["PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "JPEG2000", "PPM", "AVIF", "TGA"]
# A large JPEG file is decoded at a reduced size before it is
# resized to a small square. The sides of the decoded image
# are at least this many times as long as those of the square.
MIN_DECODED_RATIO = 16
# Largest change of an sRGB value from the level 0 to 1 of 255 at which 8 bits keep what 16 show.
MAX_STEP = 4


def is_hidden(name: str) -> bool:
    """Return whether a file or folder is hidden, or was added by macOS, a NAS or Windows."""
    return name.startswith(".") or name in ("__MACOSX", "@eaDir", "$RECYCLE.BIN")


def read_image(path: str | Path, size: Size) -> Float[Tensor, "3 height width"]:
    """Read the center of an image file, in the shape of `size`, as RGB values in [0, 1]."""
    with reading(path, "cannot be read as an image"):
        square = read_center(path, size)
    # Pages of results need no tensors, and do not wait for this import.
    import torch

    return torch.from_numpy(np.array(square)).permute(2, 0, 1) / 255


def gray_or_image(
    name: str, choice: float | str | Path, size: Size
) -> Float[Tensor, "_ height width"]:
    """Create a gray image from a value in [0, 1] or its text, or read the center of an image."""
    try:
        # `float` would accept True as 1.
        gray = math.nan if isinstance(choice, bool) else float(choice)  # type: ignore[arg-type]
    except (ValueError, TypeError, OverflowError):
        # NaN means that the choice is not a number. It may be the path of a file.
        gray = math.nan
    if math.isnan(gray) and isinstance(choice, str | Path):
        with keyed(name):
            return read_image(Path(choice), size)
    if not 0 <= gray <= 1:
        advice = "give gray values in [0, 1] or image files"
        raise InputError(f"{name}={reprlib.repr(choice)} is no image: {advice}")
    import torch

    return torch.full((1, *height_and_width(size)), gray)


def read_center(path: str | Path, size: Size) -> UInt8[np.ndarray, "height width 3"]:
    """Read the center of an image file, in the shape of `size`, with 8 bits per channel."""
    image = read_rgb(path, MIN_DECODED_RATIO * max(height_and_width(size)))
    return np.asarray(crop_center(image, size))


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
    # Pillow reads 16 bits as 8 if the channels of a TIFF file are stored one after the other.
    tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
    is_apart = tags.get(TiffImagePlugin.PLANAR_CONFIGURATION) == 2 and image.tile[0][0] == "raw"
    if is_apart and max(tags.get(TiffImagePlugin.BITSPERSAMPLE, (1,))) > 8:
        raise ValueError("its channels of 16 bits are stored apart: save them interleaved")
    key = image.info.get("transparency")
    if image.format == "PNG" and key is not None:
        # Pillow keeps the upper 8 of 16 bits of colors, and multiplies gray values, but does not do
        # the same with the transparent color.
        if gray_factor(image) > 1:
            image.info["transparency"] = key * gray_factor(image)
        elif image.tile[0][3] == "RGB;16B":
            image.info["transparency"] = tuple(value >> 8 for value in key)
    return image


def gray_factor(image: Image.Image) -> int:
    """Return by what Pillow multiplies gray values of 2 or 4 bits, so that white is 255."""
    tiles = getattr(image, "tile", [])
    return {"L;2": 85, "L;4": 17}.get(str(tiles[0][3]), 1) if tiles else 1


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
        # Two pixels with the levels 0 and 1. If they differ much after the conversion, 8 bits are
        # too few for dark areas.
        levels = Image.new(color.mode, (2, 1))
        levels.putpixel((1, 0), (1,) * len(color.getbands()))
        darkest, next_level = np.asarray(convert(levels), dtype=int)[0]
        if has_more_bits and np.abs(next_level - darkest).max() > MAX_STEP:
            raise ValueError("it is linear light of 12 or 16 bits: save it in sRGB")
        color = convert(color)
    color = color.convert("RGB")
    if alpha is None:
        return color
    color.putalpha(alpha)
    return Image.alpha_composite(Image.new("RGBA", color.size, "white"), color).convert("RGB")


def color_and_alpha(image: Image.Image) -> tuple[Image.Image, Image.Image | None]:
    """Return upright colors (L, RGB or CMYK) and opacity (L or None) with 8 bits per channel."""
    turn_upright(image)
    image = eight_bits(image)
    if image.mode == "La":
        image = image.convert("LA")
    # Pillow names images by channels. "1" has one bit, and "La" is gray multiplied by its opacity.
    is_gray = image.mode in ("1", "L", "LA", "La")
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        color = rgba.getchannel("R") if is_gray else rgba.convert("RGB")
        alpha = rgba.getchannel("A")
        # Some programs leave the opacity of an opaque .bmp file at 0.
        is_unset = image.format == "BMP" and alpha.getextrema() == (0, 0)
        return color, None if is_unset else alpha
    if image.mode in ("L", "CMYK"):
        return image, None
    return image.convert("L" if is_gray else "RGB"), None


def turn_upright(image: Image.Image) -> None:
    """Turn an image in place, as its EXIF orientation says."""
    # Pillow keeps the orientation. It would also write the other EXIF data again, and fail if a
    # camera wrote them against the rules.
    image.getexif()
    image.info.pop("exif", None)
    ImageOps.exif_transpose(image, in_place=True)


def crop_center(image: Image.Image, size: Size) -> Image.Image:
    """Cut out the largest central part of an image that has the shape of `size`, and resize it."""
    return ImageOps.fit(image, height_and_width(size)[::-1], Image.Resampling.LANCZOS)


def eight_bits(image: Image.Image) -> Image.Image:
    """Convert an image to 8 bits per channel. If white is unknown, this raises a ValueError."""
    if image.mode == "F" or (image.mode == "I" and image.format == "TIFF"):
        kind = "floating-point numbers" if image.mode == "F" else "signed or 32-bit integers"
        raise ValueError(f"the pixels are {kind}, so their white is unknown: save 8 or 16 bits")
    if image.mode.startswith("I"):
        # Pixels of the mode "I" have 16 bits, or the 12 bits of a TIFF file. `Image.convert`
        # would clip their values at 255 instead of dividing them.
        pixels = np.asarray(image)
        tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
        bits = tags.get(TiffImagePlugin.BITSPERSAMPLE, (16,))[0]
        values = np.clip(pixels >> (bits - 8), 0, 255).astype(np.uint8)
        # Pillow inverts such a TIFF file only if it has at most 8 bits.
        is_white_zero = tags.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0
        scaled = Image.fromarray(255 - values if is_white_zero else values)
        key = image.info.get("transparency")
        # Pixels of the transparent color of a 16-bit image get an opacity of 0.
        if key is not None:
            scaled.putalpha(Image.fromarray(np.where(pixels == key, 0, 255).astype(np.uint8)))
        return scaled
    image.load()
    return image


def write_image(
    path: Path, image: Image.Image | Tensor | UInt8[np.ndarray, " ..."], **options: object
) -> None:
    """Write an image file in the format that its suffix names.

    A tensor has channels first, and 8 bits or values in [0, 1]. An array has channels last. A
    reader never sees a part of the new file: see `atomic_write`.
    """
    image_format = Image.registered_extensions()[path.suffix.lower()]
    atomic_write(path, encode_image(image, image_format, **options))


def encode_image(
    image: Image.Image | Tensor | np.ndarray, image_format: str, **options: object
) -> bytes:
    """Return the content of an image file, see `write_image`. An array may have 16 bits."""
    if not isinstance(image, Image.Image | np.ndarray):
        from renderer.image import to_bytes

        pixels = image.detach().cpu().permute(1, 2, 0)
        image = (to_bytes(pixels) if pixels.is_floating_point() else pixels).numpy()
    if isinstance(image, np.ndarray):
        image = Image.fromarray(image)
    content = io.BytesIO()
    image.save(content, image_format, **options)
    return content.getvalue()


# Distance in pixels between neighboring tiles of a sheet.
GAP = 12
# Distance in pixels between the tiles and the border of a sheet.
MARGIN = 24
# Distance in pixels between an image and its caption.
CAPTION_GAP = 2
# Font sizes of titles and captions in pixels.
TITLE_SIZE = 20
CAPTION_SIZE = 12
# Heights of a title and of a line of a caption in pixels.
TITLE_HEIGHT = 36
LINE_HEIGHT = 16

# Background color of a sheet of images.
PAPER = "white"
# Color of titles and of the first line of a caption: nearly black.
INK = "#1a1a1a"
# Color of the lines of a caption after the first line: gray.
FAINT = "#6b6b6b"


class Tile(NamedTuple):
    """Image with a caption below it.

    Attributes:
        image: RGB values.
        caption: Lines of text. The first line is nearly black, and the other lines
            are gray.
    """

    image: UInt8[np.ndarray, "H W 3"]
    caption: tuple[str, ...]

    @property
    def width(self) -> int:
        """Width of the image, or of the longest line of the caption, in pixels."""
        line_widths = [_text_width(line, CAPTION_SIZE) for line in self.caption]
        return max([self.image.shape[1], *line_widths])

    @property
    def height(self) -> int:
        """Height of the image with its caption in pixels."""
        return len(self.image) + CAPTION_GAP + LINE_HEIGHT * len(self.caption)


def tiles_of(
    images: Iterable[Tensor], captions: Iterable[tuple[str, ...]] = repeat(()), side: int = 1
) -> list[Tile]:
    """Create a tile for each image.

    Small images are enlarged without smoothing, so that a tile shows the pixels
    that a classifier saw. Images have values in [0, 1]. They are enlarged by the smallest whole
    factor that makes them `side` pixels wide.
    """
    from renderer.image import to_bytes

    tiles = []
    for image, caption in zip(images, captions, strict=False):
        pixels = to_bytes(image.detach().cpu()).permute(1, 2, 0).numpy()
        factor = math.ceil(side / image.shape[2])
        tiles.append(Tile(pixels.repeat(factor, 0).repeat(factor, 1), caption))
    return tiles


def draw_grid(
    rows: Sequence[Sequence[Tile]], titles: Sequence[str] = (), heading: str = ""
) -> Image.Image:
    """Draw rows of tiles on a sheet.

    Each column is as wide as its widest tile or title. Each row is as high as its
    highest tile. The last row may be shorter.
    """
    # Sizes of the grid first, because the sheet is created in its final size.
    row_heights = [max(tile.height for tile in row) for row in rows]
    column_widths = []
    # zip_longest fills up with None: a tile, a column or a title may be missing.
    for column, title in zip_longest(zip_longest(*rows), titles):
        tile_widths = [tile.width for tile in column or () if tile]
        column_widths.append(max([_text_width(title or "", TITLE_SIZE), *tile_widths]))
    first_top = MARGIN + TITLE_HEIGHT * (bool(heading) + bool(titles))
    # Left edges of the columns and top edges of the rows. Each list has one
    # more entry: the position at which another column or row would begin.
    lefts = list(accumulate((width + GAP for width in column_widths), initial=MARGIN))
    tops = list(accumulate((height + GAP for height in row_heights), initial=first_top))

    # Another column would begin at lefts[-1],
    # one GAP after the end of the last column.
    right = max(lefts[-1] - GAP, MARGIN + _text_width(heading, TITLE_SIZE))
    bottom = max(tops[-1] - GAP, first_top)
    sheet = Image.new("RGB", (right + MARGIN, bottom + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = _font(TITLE_SIZE)
    draw.text((MARGIN, MARGIN), heading, INK, font)
    for title, left in zip(titles, lefts, strict=False):
        draw.text((left, first_top - TITLE_HEIGHT), title, INK, font)
    font = _font(CAPTION_SIZE)
    for row, top in zip(rows, tops, strict=False):
        for tile, left in zip(row, lefts, strict=False):
            sheet.paste(Image.fromarray(tile.image), (left, top))
            caption_top = top + len(tile.image) + CAPTION_GAP
            for number, line in enumerate(tile.caption):
                line_top = caption_top + number * LINE_HEIGHT
                draw.text((left, line_top), line, FAINT if number else INK, font)
    return sheet


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Load the font of matplotlib, since that of Pillow has the letters of ASCII alone."""
    import matplotlib as mpl

    return ImageFont.truetype(f"{mpl.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


def _text_width(text: str, size: int) -> int:
    """Compute the width of a line of text in pixels, rounded up. It is 0 without text."""
    return round(_font(size).getlength(text) + 0.5) if text else 0


# Gamma and primaries of Adobe RGB (1998).
ADOBE_GAMMA = 2 + 51 / 256
ADOBE_PRIMARIES = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329)
# Gammas in this range stand for the curve of sRGB (PNG, section 11.3.2.2).
SRGB_GAMMAS = (2.1, 2.3)
# Primaries and gammas by their codes (ITU-T H.273). A gamma of None is the curve of sRGB.
# Files of high dynamic range have other codes.
CODED_PRIMARIES = {
    1: REC_709,
    9: (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329),
    12: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),
}
CODED_GAMMAS = {4: 2.2, 8: 1.0, 13: None}
# Codes of AVIF files that stand for sRGB: unspecified ones, and those of video.
UNCODED_PRIMARIES = {2, 5, 6, 7}
UNCODED_CURVES = {1, 2, 6, 14, 15}
# Color spaces of ICC profiles by the modes of Pillow for the same channels.
SPACE_OF_MODE = {"L": "GRAY", "RGB": "RGB", "CMYK": "CMYK"}
# A profile is that of sRGB if it changes no 8-bit value by more than this. Different
# makers of the sRGB profile round its numbers.
SRGB_TOLERANCE = 2

Conversion = Callable[[Image.Image], Image.Image]


def conversion_to_srgb(image: Image.Image, path: str | Path) -> Conversion | None:
    """Find how colors (L, RGB or CMYK) of an image file become sRGB. None if they already are."""
    profile, codes = image.info.get("icc_profile"), None
    if image.format == "PNG":
        codes = _coded_colors(Path(path))
    elif image.format in ("AVIF", "JPEG2000") and not profile:
        profile, codes = _read_color_box(Path(path))
    if codes is not None:
        primaries_code, curve_code, is_full = codes
        is_known = primaries_code in CODED_PRIMARIES and curve_code in CODED_GAMMAS
        if not (is_known and is_full):
            fault = f"its codes of color (cICP or nclx) are {codes}, such as HDR"
            raise ValueError(f"{fault}: save it in sRGB")
        return _conversion(CODED_GAMMAS[curve_code], CODED_PRIMARIES[primaries_code])
    if profile:
        return partial(_apply_profile, profile)
    if "srgb" in image.info:
        return None
    if "gamma" in image.info or "chromaticity" in image.info:
        # Pillow gives the exponent of the encoding, such as 1 / 2.2.
        gamma = 1 / (image.info.get("gamma") or 1 / 2.2)
        x_and_y = image.info.get("chromaticity", (*REC_709[6:], *REC_709[:6]))
        # A PNG file lists the white first.
        is_srgb_curve = SRGB_GAMMAS[0] < gamma < SRGB_GAMMAS[1]
        return _conversion(None if is_srgb_curve else gamma, (*x_and_y[2:], *x_and_y[:2]))
    # Damaged EXIF data raises errors of many types, and does not change the pixels.
    with suppress(Exception):
        # "R03" is the mark of Adobe RGB.
        if image.getexif().get_ifd(ExifTags.IFD.Interop).get(1) == "R03":
            return _conversion(ADOBE_GAMMA, ADOBE_PRIMARIES)
    return None


def _coded_colors(path: Path) -> tuple[int, int, int] | None:
    """Read the codes of primaries, curve and range of values from the chunk cICP of a PNG file."""
    with path.open("rb") as file:
        # The signature of PNG has 8 bytes. Each chunk begins with its length and its name, 4 bytes
        # each.
        file.seek(8)
        while len(header := file.read(8)) == 8 and header[4:] != b"IDAT":
            if header[4:] == b"cICP":
                primaries, curve, _, is_full = file.read(4)
                return primaries, curve, is_full
            # A checksum of 4 bytes follows the data of the chunk.
            file.seek(int.from_bytes(header[:4], "big") + 4, io.SEEK_CUR)
    return None


def _read_color_box(path: Path) -> tuple[bytes | None, tuple[int, int, int] | None]:
    """Return the profile or the codes in the first box colr of an AVIF or JPEG 2000 file."""
    before, _, after = path.read_bytes().partition(b"colr")
    box = after[: max(int.from_bytes(before[-4:], "big") - 8, 0)]
    # Pillow knows the profiles of AVIF files, and turns other ranges of values to the full one.
    if box[:4] == b"nclx":
        primaries, curve = struct.unpack(">HH", box[4:8])
        primaries = 1 if primaries in UNCODED_PRIMARIES else primaries
        return None, (primaries, 13 if curve in UNCODED_CURVES else curve, 1)
    # Method 2 stores a profile, which follows the precedence and the approximation.
    return (box[3:], None) if box[:1] == b"\2" else (None, None)


def _conversion(gamma: float | None, primaries: Sequence[float]) -> Conversion | None:
    """Return the conversion from a gamma, or the curve of sRGB (None), and from primaries."""
    # Most images need neither this import nor torch.
    from renderer.image import decode, encode, to_bytes, to_rec709

    try:
        matrix = to_rec709(primaries, adapt=True)
    except ValueError as error:
        _warn_of_profile(str(error))
        return None
    if gamma is None and matrix is None:
        return None

    def convert(image: Image.Image) -> Image.Image:
        import torch

        # Linear value of each of the 256 levels, as a table.
        levels = torch.arange(256) / 255
        curve = decode(levels, "srgb") if gamma is None else levels**gamma
        linear = curve.numpy()[np.asarray(image.convert("RGB"))]
        if matrix is not None:
            linear = linear @ matrix.T.astype(np.float32)
        encoded = encode(torch.from_numpy(linear).clamp(0, 1), "srgb")
        return Image.fromarray(to_bytes(encoded).numpy())

    return convert


def _apply_profile(profile: bytes, image: Image.Image) -> Image.Image:
    """Convert an image by an ICC profile. An image whose profile is damaged is in sRGB."""
    # A gray image may have an RGB profile. Bytes 16 to 19 of a profile name its color space.
    if profile[16:20] == b"RGB " and image.mode == "L":
        image = image.convert("RGB")
    transform = _transform(profile, image.mode)
    return image if transform is None else transform.apply(image)


# The limit is for folders in which each file has a profile of its own.
@lru_cache(maxsize=32)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Build the transform to sRGB, None for sRGB or, with one warning, for a damaged profile."""
    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = opened.profile.xcolor_space.strip()
        if space != SPACE_OF_MODE[mode]:
            raise ValueError(f"it is for {space}, but the image is {mode}")
        srgb = ImageCms.createProfile("sRGB")
        # Optimized, a transform of gray values would be off by up to 10 of 255.
        flags = ImageCms.Flags.NOOPTIMIZE if mode == "L" else ImageCms.Flags.NONE
        transform = ImageCms.buildTransform(opened, srgb, mode, "RGB", flags=flags)
        if mode == "CMYK":
            return transform
        # 16³ colors that cover all, to compare the transform with no change.
        levels = np.linspace(0, 255, 16).round().astype(np.uint8)
        grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(64, 64, 3)
        samples = Image.fromarray(grid if mode == "RGB" else grid[..., 0])
        converted = np.asarray(transform.apply(samples), dtype=int)
    except (ImageCms.PyCMSError, ValueError, OSError) as error:
        _warn_of_profile(str(error))
        return None
    difference = np.abs(converted - np.asarray(samples.convert("RGB"))).max()
    return None if difference <= SRGB_TOLERANCE else transform


def _warn_of_profile(reason: str) -> None:
    """Warn of photographs whose colors are described wrongly."""
    fault = f"a color profile cannot be used ({reason})"
    warnings.warn(f"{fault}: photographs with it are read as sRGB", stacklevel=2)
