"""Environment maps: read them, write them, and compute them from SH coefficients.

An environment map is a tensor (H, W, 3) of linear RGB radiance in the layout of
`harmonics.equirectangular`. Row 0 faces up (+z), the middle column faces +x, and
azimuth grows to the left, as seen from inside the sphere.

Blender's Environment Texture has the same layout and needs no rotation. Mitsuba
3's `envmap` has y up and the middle column towards +z, as OpenEXR defines such
maps. A `to_world` matrix with the rows (0, 0, 1), (1, 0, 0) and (0, 1, 0)
rotates it to our layout. Blender and Mitsuba shade with albedo / π, while this
project leaves out the π, so a strength of π gives the same image there.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from renderer.errors import MAX_MAGNITUDE, InputError, require_file
from renderer.io.arrays import read_numbers, write_numbers
from renderer.io.files import replacing
from renderer.light.harmonics import basis, equirectangular

SUFFIXES = (".npy", ".hdr", ".exr")
# `read_panorama` refuses maps with fewer rows. The midpoint rule of `project`
# would give a map of uniform radiance a direction: an error of 16 % at 4 rows.
FEWEST_ROWS = 8
# `light_radiance` evaluates as many directions at a time, which fit into the
# CPU cache.
BLOCK = 2**12
# `read_panorama` accepts negative radiance up to this fraction of the maximum.
# Filters that scale maps leave such values.
NEGATIVE = 1e-4
# Largest image in MB that OpenImageIO reads. A damaged header may claim more.
LARGEST_MAP = 4096
# RGBE stores the channels of a texel as bytes with a common exponent.
_RGBE_BITS = 8
_CHANNEL_NAMES_BY_COUNT = {1: "Y", 3: "RGB", 4: "RGBA"}
_ALPHA_NAMES = ("a", "alpha")
_COLOR_NAMES = (("r", "g", "b"), ("red", "green", "blue"))


def to_map(coefficients: Tensor, height: int) -> Tensor:
    """Compute the environment map of a light.

    The radiance is negative in places where the SH series rings. The function
    `harmonics.project` inverts this one up to the error of its midpoint rule
    along z. At degree 6, this error is at most 22.2 / height² of the L2 norm of
    the coefficients (3.4e-4 at a height of 256).

    Args:
        coefficients: SH coefficients, shape ((degree + 1)², 3).
        height: Number of rows. The map has twice as many columns.

    Returns:
        Radiance at the centers of the texels, shape (height, 2 height, 3),
        float64.
    """
    directions, _ = equirectangular(height, 2 * height)
    return light_radiance(coefficients, directions)


def light_radiance(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Evaluate the radiance of a light from some directions.

    Args:
        coefficients: SH coefficients, shape ((degree + 1)², 3).
        directions: Directions of any length, shape (..., 3).

    Returns:
        Radiance, shape (..., 3), in the dtype of the directions.
    """
    degree = math.isqrt(len(coefficients)) - 1
    blocks = directions.flatten(0, -2).split(BLOCK)
    radiance = torch.cat([basis(block, degree) @ coefficients.to(block) for block in blocks])
    return radiance.unflatten(0, directions.shape[:-1])


def negative_fraction(radiance: Tensor) -> float:
    """Return the share of negative radiance in an environment map.

    This is the integral over the sphere of max(-radiance, 0), divided by the
    integral of |radiance|, over all channels.

    Args:
        radiance: Environment map, shape (H, W, 3).

    Returns:
        Fraction in [0, 1]. It is 0 for a black map.
    """
    _, solid_angles = equirectangular(*radiance.shape[:2])
    power = radiance * solid_angles[..., None]
    magnitude = power.abs().sum().clamp(min=torch.finfo(power.dtype).tiny)
    return float((-power).clamp(min=0).sum() / magnitude)


def read_map(path: str | Path) -> Tensor:
    """Read an environment map from a file.

    Values are taken as linear RGB in the unit of the file. An alpha channel is
    dropped, and a single gray channel becomes all three. If an .exr file has
    layers, the layer without a name is read, or else the first layer that has
    red, green and blue.

    Args:
        path: An .npy, .hdr or .exr file. The array of an .npy file has the
            shape (H, W, C) with 1, 3 or 4 channels.

    Returns:
        Radiance, shape (H, W, 3), float32.

    Raises:
        InputError: If the file does not exist, cannot be read or is not such a
            map, or if its radiance is NaN, infinite or above 1e12. (The sun has
            1.6e9 cd/m².)
    """
    path = Path(path)
    require_file(path, "give the path of an .npy, .hdr or .exr file")
    try:
        texels, names = _read_array(path) if path.suffix.lower() == ".npy" else _read_image(path)
        radiance = texels[..., _color_channels(names)]
    except Exception as error:
        # NumPy and OpenImageIO raise many kinds of errors for a damaged file.
        message = str(error).partition("\n")[0]
        raise InputError(f"environment map {path} cannot be read: {message}") from error
    # NaN fails the comparison.
    if not (np.abs(radiance) <= MAX_MAGNITUDE).all():
        raise InputError(
            f"environment map {path} holds NaN, infinity or radiance beyond {MAX_MAGNITUDE:g}: "
            "replace these values and save it again"
        )
    return torch.from_numpy(radiance)


def read_panorama(path: str | Path) -> Tensor:
    """Read an environment map that covers the whole sphere and has no negative radiance.

    Args:
        path: An .npy, .hdr or .exr file, as for `read_map`.

    Returns:
        Radiance of at least 0, shape (H, W, 3), float32. Negative radiance of at
        most `NEGATIVE` times the maximum becomes zero.

    Raises:
        InputError: See `read_map`. Also if the map has fewer than
            `FEWEST_ROWS` rows, is not about twice as wide as high (such as a
            mirror ball), or has more negative radiance.
    """
    radiance = read_map(path)
    height, width = radiance.shape[:2]
    if height < FEWEST_ROWS or abs(width - 2 * height) > height // 8:
        raise InputError(
            f"environment map {path} has {width} × {height} texels: "
            f"give an equirectangular one, twice as wide as high, of {FEWEST_ROWS} rows or more"
        )
    minimum = radiance.min()
    if minimum < -NEGATIVE * radiance.max():
        raise InputError(
            f"environment map {path} has negative radiance, down to {minimum:.3g}: "
            "clip the map at 0 and save it again"
        )
    return radiance.clamp(min=0)


def write_map(path: str | Path, radiance: Tensor) -> None:
    """Write an environment map to a file.

    An .npy or .exr file stores float32 and keeps negative radiance. An .hdr file
    stores RGBE, which has no sign and one exponent for three channels. There,
    negative radiance becomes zero (`negative_fraction` returns how much that
    is), and the error is at most 2⁻⁸ of the largest channel of the texel.

    Args:
        path: An .npy, .hdr or .exr file. Its folder is created.
        radiance: Environment map, shape (H, W, 3).

    Raises:
        InputError: If the suffix is another one or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path} must end in one of {', '.join(SUFFIXES)} for an environment map")
    radiance = radiance.detach().cpu().float()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".npy":
            write_numbers(path, radiance.numpy())
        elif suffix == ".hdr":
            _write_image(path, _to_rgbe_precision(radiance), "hdr")
        else:
            _write_image(path, radiance, "openexr")
    except (OSError, ValueError) as error:
        # OpenImageIO raises ValueError for a name that is not UTF-8.
        raise InputError(f"environment map {path} cannot be written: {error}") from error


def _write_image(path: Path, texels: Tensor, file_format: str) -> None:
    """Write texels (H, W, 3) in a format of OpenImageIO, replacing the file at once."""
    image = _openimageio().ImageBuf(texels.contiguous().numpy())
    with replacing(path) as temporary:
        if not image.write(str(temporary), "unknown", file_format):
            raise OSError(image.geterror())


def _read_array(path: Path) -> tuple[np.ndarray, Sequence[str]]:
    """Read the texels (H, W, C) of an .npy file and the names of their channels."""
    array = read_numbers(path)
    names = _CHANNEL_NAMES_BY_COUNT.get(array.shape[-1]) if array.ndim == 3 else None
    if names is None:
        raise InputError(
            f"its shape is {array.shape}, give (height, width, channels) with 1, 3 or 4 channels"
        )
    return array, names


def _read_image(path: Path) -> tuple[np.ndarray, Sequence[str]]:
    """Read the texels (H, W, C) of an .hdr or .exr file and the names of their channels."""
    image = _openimageio().ImageBuf(str(path))
    # `get_pixels` would end the process if the file could not be read.
    if not image.read():
        raise InputError(image.geterror())
    texels = image.get_pixels("float")
    spec = image.spec()
    if image.file_format_name not in ("hdr", "openexr"):
        raise InputError(f"it is a {image.file_format_name} image, give an .hdr or .exr file")
    is_cropped = spec.roi != spec.roi_full
    is_turned = image.orientation != 1
    if is_cropped or is_turned:
        raise InputError("it is stored cropped or turned, save it whole, its top row first")
    return texels, spec.channelnames


def _to_rgbe_precision(radiance: Tensor) -> Tensor:
    """Round radiance (H, W, 3) to values that RGBE holds exactly.

    OpenImageIO truncates instead, which would darken and tint the light.
    """
    radiance = radiance.clamp(min=0)
    _, exponent = torch.frexp(radiance.amax(dim=-1, keepdim=True))
    unit = torch.ldexp(torch.ones_like(radiance[..., :1]), exponent - _RGBE_BITS)
    return (radiance / unit).round().clamp(max=2**_RGBE_BITS - 1) * unit


def _color_channels(names: Sequence[str]) -> list[int]:
    """Return the indices of the red, green and blue channel, which are equal for a gray image.

    The name of a channel is "CHANNEL" or "LAYER.CHANNEL", in any case.
    """
    layers = []
    channels = []
    for name in names:
        layer, _, channel = name.casefold().rpartition(".")
        layers.append(layer)
        channels.append(channel)
    layers_and_channels = list(zip(layers, channels, strict=True))
    # The library puts the layer without a name first.
    for layer in layers:
        for colors in _COLOR_NAMES:
            wanted = [(layer, color) for color in colors]
            if set(wanted) <= set(layers_and_channels):
                return [layers_and_channels.index(channel) for channel in wanted]
    gray = [index for index, channel in enumerate(channels) if channel not in _ALPHA_NAMES]
    if len(gray) == 1:
        return gray * 3
    raise InputError(f"its channels are {', '.join(names)}, give R, G and B, or one gray channel")


def _openimageio() -> ModuleType:
    """Import OpenImageIO, which takes long, and limit its threads and its memory."""
    import OpenImageIO

    # A pool of threads beside torch's own would slow both down.
    OpenImageIO.attribute("threads", 1)
    OpenImageIO.attribute("exr_threads", -1)
    OpenImageIO.attribute("limits:imagesize_MB", LARGEST_MAP)
    return OpenImageIO
