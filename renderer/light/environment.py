"""Environment maps: files (.npy, .hdr, .exr) in and out, and the map that a light's coefficients stand for.

Maps are tensors (H, W, 3) of linear RGB radiance in the layout of `harmonics.equirectangular`: row 0 is up (+z), the
middle column faces +x and azimuth grows to the left, as seen from inside.

Blender's Environment Texture lies so too and needs no rotation. Mitsuba 3's `envmap` has y up and the middle column
towards +z, as OpenEXR defines such maps: a `to_world` of the rows (0, 0, 1), (1, 0, 0), (0, 1, 0) brings it here. Both
shade with albedo / π where this project leaves out the π: a strength of π gives the same image.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from renderer.errors import LARGEST, InputError, require_file
from renderer.io.files import replacing
from renderer.io.images import read_numbers, write_numbers
from renderer.light.harmonics import basis, equirectangular

SUFFIXES = (".npy", ".hdr", ".exr")
FEWEST_ROWS = 8  # fewer give even radiance from everywhere a direction, by 16 % at 4: see `to_map`
BLOCK = 2**12  # directions at a time: they stay in the cache
NEGATIVE = 1e-4  # of the brightest radiance: what filters that scale maps leave
LARGEST_MAP = 4096  # MB, which a damaged header may exceed


def to_map(coefficients: Tensor, height: int) -> Tensor:
    """Radiance (height, 2 · height, 3) float64 of a light's coefficients ((degree + 1)², 3), at the texels' centers.

    Negative where the series rings. `renderer.light.harmonics.project` takes it back, off by its midpoint rule along z:
    at degree 6 by up to 22.2 / height² of the coefficients' L2 norm (3.4e-4 at a height of 256).
    """
    return light_radiance(coefficients, equirectangular(height, 2 * height)[0])


def light_radiance(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Radiance (..., 3) of a light's coefficients ((degree + 1)², 3) from directions (..., 3), in their dtype."""
    degree = math.isqrt(len(coefficients)) - 1
    blocks = directions.flatten(0, -2).split(BLOCK)
    radiance = torch.cat([basis(block, degree) @ coefficients.to(block) for block in blocks])
    return radiance.unflatten(0, directions.shape[:-1])


def negative_fraction(radiance: Tensor) -> float:
    """The negative part of a map's radiance (H, W, 3), integrated over the sphere, as a fraction of its magnitude."""
    power = radiance * equirectangular(*radiance.shape[:2])[1][..., None]
    return float((-power).clamp(min=0).sum() / power.abs().sum().clamp(min=torch.finfo(power.dtype).tiny))


def read_map(path: str | Path) -> Tensor:
    """Radiance (H, W, 3) float32 of an .npy, .hdr or .exr file, taken as linear and in the file's own unit.

    Alpha is dropped and gray repeated; an .npy array is (H, W, C) with 1, 3 or 4 channels. Of an .exr file with
    layers, the unnamed one counts, or else the first that has red, green and blue.
    InputError: missing, unreadable, no such map, NaN, infinity or radiance beyond 1e12 (the sun has 1.6e9 cd/m²).
    """
    path = Path(path)
    require_file(path, "give the path of an .npy, .hdr or .exr file")
    try:
        texels, names = _read_array(path) if path.suffix.lower() == ".npy" else _read_image(path)
        radiance = texels[..., _color_channels(names)]
    except Exception as error:  # both libraries raise many kinds for a damaged header
        message = str(error).partition("\n")[0]
        raise InputError(f"environment map {path} cannot be read: {message}") from error
    if not (np.abs(radiance) <= LARGEST).all():  # NaN is not
        raise InputError(f"environment map {path} holds NaN, infinity or radiance beyond {LARGEST:g}: mend its texels")
    return torch.from_numpy(radiance)


def read_panorama(path: str | Path) -> Tensor:
    """`read_map` of a map that can be one of the whole sphere, with zero for radiance from -NEGATIVE of the largest on.
    InputError: less; another shape, such as a mirror ball's; too few texels to be told from its midpoints."""
    radiance = read_map(path)
    height, width = radiance.shape[:2]
    if height < FEWEST_ROWS or abs(width - 2 * height) > height // 8:
        advice = f"give an equirectangular one, twice as wide as high, of {FEWEST_ROWS} rows or more"
        raise InputError(f"environment map {path} has {width} × {height} texels: {advice}")
    if radiance.min() < -NEGATIVE * radiance.max():
        raise InputError(f"environment map {path} has negative radiance, down to {radiance.min():.3g}: mend its texels")
    return radiance.clamp(min=0)


def write_map(path: str | Path, radiance: Tensor) -> None:
    """Write a map's radiance (H, W, 3) as float32 to an .npy or .exr file, or as RGBE to an .hdr file.

    RGBE has no sign and one exponent for three channels: radiance below zero becomes zero (`negative_fraction` says how
    much that is), the rest is off by up to 2⁻⁸ of its texel's largest channel. The other two keep negative radiance.
    InputError where the suffix is another or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} must end in one of {', '.join(SUFFIXES)} for an environment map")
    radiance = radiance.detach().cpu().float()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() == ".npy":
            write_numbers(path, radiance.numpy())
        else:
            file_format = "hdr" if path.suffix.lower() == ".hdr" else "openexr"
            texels = _to_rgbe_precision(radiance) if file_format == "hdr" else radiance
            image = _openimageio().ImageBuf(texels.contiguous().numpy())
            with replacing(path) as temporary:
                if not image.write(str(temporary), "unknown", file_format):
                    raise OSError(image.geterror())
    except (OSError, ValueError) as error:  # OpenImageIO takes no name that is not UTF-8
        raise InputError(f"environment map {path} cannot be written: {error}") from error


def _read_array(path: Path) -> tuple[np.ndarray, Sequence[str]]:
    array = read_numbers(path)
    names = {1: "Y", 3: "RGB", 4: "RGBA"}.get(array.shape[-1]) if array.ndim == 3 else None
    if names is None:
        raise InputError(f"its shape is {array.shape}, give (height, width, channels) with 1, 3 or 4 channels")
    return array, names


def _read_image(path: Path) -> tuple[np.ndarray, Sequence[str]]:
    image = _openimageio().ImageBuf(str(path))
    if not image.read():  # the library's get_pixels would end the process
        raise InputError(image.geterror())
    texels, spec = image.get_pixels("float"), image.spec()
    if image.file_format_name not in ("hdr", "openexr"):
        raise InputError(f"it is a {image.file_format_name} image, give an .hdr or .exr file")
    if spec.roi != spec.roi_full or image.orientation != 1:
        raise InputError("it is stored cropped or turned, save it whole, its top row first")
    return texels, spec.channelnames


def _to_rgbe_precision(radiance: Tensor) -> Tensor:
    """Radiance rounded to what RGBE holds: the library truncates, which darkens and tints the light."""
    radiance = radiance.clamp(min=0)
    _, exponent = torch.frexp(radiance.amax(dim=-1, keepdim=True))
    unit = torch.ldexp(torch.ones_like(radiance[..., :1]), exponent - 8)
    return (radiance / unit).round().clamp(max=255) * unit


def _color_channels(names: Sequence[str]) -> list[int]:
    """Indices of red, green and blue, equal for a gray channel."""
    split = [name.casefold().rpartition(".")[::2] for name in names]  # (layer, channel)
    for layer, _ in split:  # the library puts the unnamed layer first
        for colors in (("r", "g", "b"), ("red", "green", "blue")):
            channels = [(layer, color) for color in colors]
            if set(channels) <= set(split):
                return [split.index(channel) for channel in channels]
    gray = [index for index, (_, channel) in enumerate(split) if channel not in ("a", "alpha")]
    if len(gray) == 1:
        return gray * 3
    raise InputError(f"its channels are {', '.join(names)}, give R, G and B, or one gray channel")


def _openimageio() -> ModuleType:
    import OpenImageIO  # takes long to import

    OpenImageIO.attribute("threads", 1)  # no pool of threads beside torch's own
    OpenImageIO.attribute("exr_threads", -1)
    OpenImageIO.attribute("limits:imagesize_MB", LARGEST_MAP)
    return OpenImageIO
