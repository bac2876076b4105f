"""Convert the pixels of image files to sRGB, as their color profiles say.

The first of these that a file has counts (PNG, third edition, section 4.3): the chunk
cICP of a PNG file, an ICC profile, the chunk sRGB, the chunks gAMA and cHRM, or the mark
of Adobe RGB in the EXIF data of a camera (DCF 2.0). Without any of them, pixels are sRGB.
"""

import io
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image, ImageCms

from renderer.image import REC_709, decode, encode, to_bytes, to_rec709

# Gamma and primaries of Adobe RGB (1998).
ADOBE_GAMMA = 2 + 51 / 256
ADOBE_PRIMARIES = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329)
# Gammas in this range stand for the curve of sRGB (PNG, section 11.3.2.2).
SRGB_GAMMAS = (2.1, 2.3)
# Primaries and gammas by their codes in the chunk cICP (ITU-T H.273). A gamma of None is
# the curve of sRGB. Files of high dynamic range have other codes.
CODED_PRIMARIES = {
    1: REC_709,
    9: (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329),
    12: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),
}
CODED_GAMMAS = {4: 2.2, 8: 1.0, 13: None}
# Color spaces of ICC profiles by the modes of Pillow for the same channels.
SPACE_OF_MODE = {"L": "GRAY", "RGB": "RGB", "CMYK": "CMYK"}
# A profile is that of sRGB if it changes no 8-bit value by more than this. Different
# makers of the sRGB profile round its numbers.
SRGB_TOLERANCE = 2

Conversion = Callable[[Image.Image], Image.Image]


def conversion_to_srgb(image: Image.Image, path: str | Path) -> Conversion | None:
    """Find how colors (L, RGB or CMYK) of an image file become sRGB. None if they already are."""
    codes = _coded_colors(Path(path)) if image.format == "PNG" else None
    if codes is not None:
        primaries_code, curve_code = codes
        if primaries_code not in CODED_PRIMARIES or curve_code not in CODED_GAMMAS:
            raise ValueError(
                f"its chunk cICP has the colors {primaries_code} and the curve {curve_code}, "
                "such as HDR: save it in sRGB"
            )
        return _conversion(CODED_GAMMAS[curve_code], CODED_PRIMARIES[primaries_code])
    if profile := image.info.get("icc_profile"):
        return partial(_apply_profile, profile)
    if "srgb" in image.info:
        return None
    if "gamma" in image.info or "chromaticity" in image.info:
        gamma = 1 / (image.info.get("gamma") or 1 / 2.2)
        x_and_y = image.info.get("chromaticity", (*REC_709[6:], *REC_709[:6]))
        # A PNG file lists the white first.
        is_srgb_curve = SRGB_GAMMAS[0] < gamma < SRGB_GAMMAS[1]
        return _conversion(None if is_srgb_curve else gamma, (*x_and_y[2:], *x_and_y[:2]))
    # Damaged EXIF data raises errors of many types, and does not change the pixels.
    with suppress(Exception):
        if image.getexif().get_ifd(ExifTags.IFD.Interop).get(1) == "R03":
            return _conversion(ADOBE_GAMMA, ADOBE_PRIMARIES)
    return None


def _coded_colors(path: Path) -> tuple[int, int] | None:
    """Read the codes of the primaries and of the curve from the chunk cICP of a PNG file."""
    with path.open("rb") as file:
        file.seek(8)
        while len(header := file.read(8)) == 8 and header[4:] != b"IDAT":
            length = int.from_bytes(header[:4], "big")
            if header[4:] == b"cICP":
                codes = file.read(2)
                return codes[0], codes[1]
            # A checksum of 4 bytes follows the data of the chunk.
            file.seek(length + 4, io.SEEK_CUR)
    return None


def _conversion(gamma: float | None, primaries: Sequence[float]) -> Conversion | None:
    """Return the conversion from a gamma, or the curve of sRGB (None), and from primaries."""
    try:
        matrix = to_rec709(primaries, adapt=True)
    except ValueError as error:
        _warn_of_profile(str(error))
        return None
    if gamma is None and matrix is None:
        return None

    def convert(image: Image.Image) -> Image.Image:
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
    if profile[16:20] == b"RGB " and image.mode == "L":
        image = image.convert("RGB")
    transform = _transform(profile, image.mode)
    return image if transform is None else transform.apply(image)


# The limit is for folders in which each file has a profile of its own.
@lru_cache(maxsize=32)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Build the transform from an ICC profile to sRGB. It is None for sRGB or a damaged profile.

    A warning tells of a damaged profile. Because of the cache, it does so once.
    """
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
    warnings.warn(
        f"a color profile cannot be used ({reason}): photographs with it are read as sRGB",
        stacklevel=2,
    )
