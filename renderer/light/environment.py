"""Environment maps: read and write files, and compute maps from SH coefficients.

An environment map is a tensor of linear RGB radiance, shape (H, W, 3) for H rows
and W columns of texels, in the layout of `harmonics.equirectangular`. Row 0 faces
up (+z), the middle column faces +x, and azimuth grows to the left, as seen from
inside the sphere.

Blender's Environment Texture has the same layout and needs no rotation. Mitsuba
3's `envmap` has y up and the middle column toward +z, as OpenEXR defines such
maps. A `to_world` matrix with the rows (0, 0, 1), (1, 0, 0) and (0, 1, 0)
rotates such a map to our layout. Blender and Mitsuba shade with albedo / π, but
this project shades with the albedo. A map of strength π gives the same image in
Blender and Mitsuba.
"""

import errno
import math
import warnings
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from renderer.errors import MAX_MAGNITUDE, InputError, reading, require_file
from renderer.image import to_rec709
from renderer.io.files import atomic_write, read_numbers, write_numbers
from renderer.light.harmonics import basis, equirectangular
from renderer.settings import REC_709

# Suffixes of the files that `write_map` writes.
SUFFIXES = (".npy", ".hdr", ".exr")
# `read_panorama` raises an error for maps with fewer rows. `harmonics.project` would
# integrate such a map too coarsely. With 4 rows and degree 6, the coefficients of a
# uniform map that should be 0 would have 21% of the norm of the first coefficient.
FEWEST_ROWS = 8
# Number of directions that `light_radiance` evaluates at once. Their harmonics fit into
# the cache of the processor.
BLOCK = 2**12
# `read_panorama` sets negative radiance to 0 if its magnitude is at most this
# fraction of the largest radiance. Filters that scale maps leave such values.
NEGATIVE = 1e-4
# Size in MB of the largest image that OpenImageIO reads. The limit is for damaged
# files whose header claims a huge image.
LARGEST_MAP = 4096
# Number of bits of a color channel in an .hdr file. Its format RGBE stores three channels
# of a texel with one common exponent.
_RGBE_BITS = 8
# Names of the channels of an .npy array for each possible number of channels. Y is gray.
_CHANNEL_NAMES_BY_COUNT = {1: "Y", 3: "RGB", 4: "RGBA"}
# Possible names of a channel that is no light, or of its layer, in lower case: alpha, depth
# (OpenEXR reserves Z and ZBack for it) and numbers of objects.
_OTHER_NAMES = {"a", "alpha", "z", "zback", "depth", "mist", "id", "indexob", "indexma"}


def to_map(coefficients: Tensor, height: int) -> Float[Tensor, "height _ _"]:
    """Compute the environment map of a light that is given by SH coefficients.

    The radiance may be negative, because a sum of few harmonics oscillates around
    bright places. `harmonics.project` computes the coefficients from the map
    again. At degree 6, the L2 norm of its error is at most 22.2 / height² times
    the norm of the coefficients (3.4e-4 at a height of 256). The map has twice as many
    columns as rows.
    """
    directions, _ = equirectangular(height, 2 * height)
    return light_radiance(coefficients, directions)


def light_radiance(coefficients: Tensor, directions: Float[Tensor, "... 3"]) -> Tensor:
    """Compute the radiance of environment light from directions (toward the light, any length)."""
    degree = math.isqrt(len(coefficients)) - 1
    # Each block is a list of directions, shape (N, 3). The leading axes are restored at the end.
    blocks = directions.flatten(0, -2).split(BLOCK)
    radiance = torch.cat([basis(block, degree) @ coefficients.to(block) for block in blocks])
    return radiance.unflatten(0, directions.shape[:-1])


def negative_fraction(radiance: Float[Tensor, "H W 3"]) -> float:
    """Compute which fraction of the light of an environment map is negative.

    This is the integral of max(-radiance, 0) over the sphere and the channels,
    divided by the integral of |radiance|. A black map has 0.
    """
    _, solid_angles = equirectangular(*radiance.shape[:2])
    power = radiance * solid_angles[..., None]
    magnitude = power.abs().sum().clamp(min=torch.finfo(power.dtype).tiny)
    return float((-power).clamp(min=0).sum() / magnitude)


def read_map(path: Path) -> Float[Tensor, "H W 3"]:
    """Read an environment map from a file.

    The values of the file are taken as linear RGB radiance. Other primaries than
    those of Rec. 709 (`chromaticities` of .exr, PRIMARIES of .hdr) are converted.
    The chromaticity of the light stays the same, without adaptation to another
    white. Colors beyond Rec. 709 get channels of 0. The EXPOSURE and COLORCORR of
    an .hdr file are divided out. An alpha channel is dropped. A single gray
    channel is used for red, green and blue. Of the layers of an .exr file, the one
    without a name is read, or "Combined", or the only one with red, green and
    blue. Radiance that is NaN, infinite or above 1e12 raises
    `InputError`. (The sun has 1.6e9 cd/m².)
    """
    require_file(path, "give the path of an .npy, .hdr or .exr file")
    with reading(path, "cannot be read as an environment map", "export it again"):
        chromaticities: Sequence[float] = REC_709
        if path.suffix.lower() == ".npy":
            texels = read_numbers(path)
            channel_count = texels.shape[-1] if texels.ndim == 3 else 0
            names: Sequence[str] = _CHANNEL_NAMES_BY_COUNT.get(channel_count, "")
            if not names:
                raise InputError(f"the array has the shape {texels.shape}: save (height, width, 3)")
        else:
            texels, names, chromaticities = _read_image(path)
        radiance = _in_rec709(texels[..., _color_channels(names)], chromaticities)
    # NaN is refused, too, because a comparison with NaN is False.
    if not (np.abs(radiance) <= MAX_MAGNITUDE).all():
        fault = f"environment map {path} has NaN, infinity or radiance above {MAX_MAGNITUDE:g}"
        raise InputError(f"{fault}: replace these values and save the map again")
    return torch.from_numpy(radiance)


def read_panorama(path: Path) -> Float[Tensor, "H W 3"]:
    """Read an environment map that covers the whole sphere and has no negative radiance.

    Negative radiance becomes 0 if its magnitude is at most `NEGATIVE` times the largest
    radiance. A map with more, with fewer than `FEWEST_ROWS` rows, or not about twice as
    wide as high raises `InputError`.
    """
    radiance = read_map(path)
    height, width = radiance.shape[:2]
    if height < FEWEST_ROWS or abs(width - 2 * height) > height // 8:
        fault = f"environment map {path} has {width} × {height} texels"
        shape = f"which is about twice as wide as high, with at least {FEWEST_ROWS} rows"
        raise InputError(f"{fault}: give an equirectangular map, {shape}")
    minimum = radiance.min()
    if minimum < -NEGATIVE * radiance.max():
        fault = f"environment map {path} has negative radiance, down to {minimum:.3g}"
        raise InputError(f"{fault}: clip the map at 0 and save it again")
    return radiance.clamp(min=0)


def write_map(path: Path, radiance: Float[Tensor, "H W 3"]) -> None:
    """Write an environment map to a file.

    An .npy or .exr file stores float32 and keeps negative radiance. An .hdr file
    stores RGBE, which has no sign and one exponent for three channels. In an .hdr
    file, negative radiance becomes 0 (see `negative_fraction`), and the rounding
    error is at most 2⁻⁸ of the largest channel of a texel.
    """
    suffix = path.suffix.lower()
    radiance = radiance.detach().cpu().float()
    path.parent.mkdir(parents=True, exist_ok=True)
    if suffix == ".npy":
        write_numbers(path, radiance.numpy())
        return
    if suffix == ".hdr":
        radiance = _to_rgbe_precision(radiance)
    image = _openimageio().ImageBuf(radiance.contiguous().numpy())
    # OpenImageIO writes to no folder whose name UTF-8 cannot encode.
    with TemporaryDirectory() as folder:
        temporary = Path(folder, f"map{suffix}")
        # The data type "unknown" keeps the float32 values of the image.
        if not image.write(str(temporary), "unknown", suffix[1:]):
            raise OSError(errno.EIO, " ".join(image.geterror().split()), str(path))
        # A reader never sees a part of the new file.
        atomic_write(path, temporary.read_bytes())


def _read_image(path: Path) -> tuple[np.ndarray, Sequence[str], Sequence[float]]:
    """Read the texels, the names of the channels, and the 8 chromaticities of an environment map.

    A cropped, mirrored or rotated image raises `InputError`.
    """
    image = _openimageio().ImageBuf(str(path))
    # Call `read` first, because `get_pixels` ends the process if it cannot read the file.
    if not image.read():
        raise OSError(image.geterror())
    # It also ends the process for deep images.
    if image.spec().deep:
        raise ValueError("it is a deep image: save it flat")
    texels = image.get_pixels("float")
    spec = image.spec()
    if image.file_format_name not in ("hdr", "openexr"):
        raise InputError(f"the file is a {image.file_format_name} image: save it as .exr")
    # The orientation 1 of EXIF means that the top row is stored first.
    if spec.roi != spec.roi_full or image.orientation != 1:
        raise InputError("the image is stored cropped or rotated: save the whole, upright image")
    if image.nsubimages > 1:
        specs = [_openimageio().ImageBuf(str(path), i, 0).spec() for i in range(image.nsubimages)]
        colored = [index for index, each in enumerate(specs) if {*"RGB"} <= {*each.channelnames}]
        if colored != [0]:
            raise InputError("the file has several images: save one with R, G and B alone")
    # CIE x and y of red, green, blue and white.
    chromaticities = spec.getattribute("chromaticities") or REC_709
    if image.file_format_name == "hdr":
        factors, chromaticities = _radiance_header(path)
        texels = texels / factors
    return texels, spec.channelnames, chromaticities


def _radiance_header(path: Path) -> tuple[np.ndarray, Sequence[float]]:
    """Read what the header of an .hdr file says about its values, which OpenImageIO ignores.

    The manual of Radiance (File Formats, "Picture Files") says that EXPOSURE and COLORCORR are
    cumulative factors of the pixels. Indented lines are of other pictures. Without PRIMARIES, maps
    of others than Radiance are Rec. 709. The results are factors of red, green and blue, and the
    chromaticities of red, green, blue and white, 8 numbers.
    """
    factors = np.ones(3)
    chromaticities: Sequence[float] = REC_709
    with path.open("rb") as file:
        # An empty line ends the header.
        for line in takewhile(bytes.strip, file):
            key, _, value = line.decode("latin-1").partition("=")
            if key in ("EXPOSURE", "COLORCORR"):
                # One number is broadcast to three channels, and two raise an error.
                factors *= np.array(value.split(), dtype=float)
            elif key == "PRIMARIES":
                numbers = [float(number) for number in value.split()]
                # Photoshop writes zeros if it does not know them.
                chromaticities = numbers if any(numbers) else REC_709
            elif key == "GAMMA" and float(value) != 1:
                raise ValueError(f"GAMMA={value.strip()} is not linear: save linear radiance")
    if not ((factors > 0) & (factors <= MAX_MAGNITUDE)).all():
        raise ValueError(f"EXPOSURE and COLORCORR multiply the pixels by {factors.tolist()}")
    return factors.astype(np.float32), chromaticities


def _in_rec709(radiance: Float[np.ndarray, "H W 3"], chromaticities: Sequence[float]) -> np.ndarray:
    """Convert radiance of any primaries to Rec. 709.

    Channels that the conversion makes negative become 0. Chromaticities are CIE x and y of red,
    green, blue and white.
    """
    # The matrix is None if the map has the primaries of Rec. 709 already.
    matrix = to_rec709(chromaticities, adapt=False)
    if matrix is None:
        return radiance
    # Infinite radiance gives NaN, which `read_map` refuses.
    with np.errstate(invalid="ignore", over="ignore"):
        converted: np.ndarray = radiance @ matrix.T.astype(np.float32)
    # True for negative channels of texels that had no negative channel before the conversion.
    is_beyond = (converted < 0) & (radiance >= 0).all(axis=-1, keepdims=True)
    # Fraction of all radiance that setting these channels to 0 changes.
    lost = -converted[is_beyond].sum() / max(np.abs(converted).sum(), np.finfo(np.float32).tiny)
    if lost > NEGATIVE:
        fault = f"{lost:.2%} of the radiance of the environment map is of colors beyond Rec. 709"
        warnings.warn(f"{fault}: their negative channels are set to 0", stacklevel=2)
    return np.where(is_beyond, 0, converted)


def _to_rgbe_precision(radiance: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Round radiance to RGBE; OpenImageIO rounds down, which darkens and tints the light."""
    radiance = radiance.clamp(min=0)
    # RGBE stores all three channels of a texel with the exponent of the largest channel.
    _, exponent = torch.frexp(radiance.amax(dim=-1, keepdim=True))
    # Difference between neighboring values that can be stored with this exponent.
    step = torch.ldexp(torch.ones_like(radiance[..., :1]), exponent - _RGBE_BITS)
    return (radiance / step).round().clamp(max=2**_RGBE_BITS - 1) * step


def _color_channels(names: Sequence[str]) -> list[int]:
    """Find the indices of red, green and blue by names such as "LAYER.R". Gray is used for all."""
    # Pairs (layer, color) in lower case, such as ("layer", "r"). The layer is "" without a dot.
    keys = [name.casefold().rpartition(".")[::2] for name in names]
    colored: dict[str, list[int]] = {}
    for layer, _ in keys:
        for color_names in (("r", "g", "b"), ("red", "green", "blue")):
            channels = [(layer, color_name) for color_name in color_names]
            if set(channels) <= set(keys):
                colored.setdefault(layer, [keys.index(channel) for channel in channels])
    # Blender calls the layer of all light "Combined". Layers are sorted by their names.
    preferred = [layer for layer in colored if layer.rpartition(".")[2] in ("", "combined")]
    layers = [""] if "" in preferred else preferred or [*colored]
    if len(layers) > 1:
        raise InputError(f"the layers {', '.join(layers)} have colors: save the light alone")
    if layers:
        return colored[layers[0]]
    # No layer has three colors. A gray channel is the only one of which no part of the name says
    # that it is no light.
    words = [name.casefold().split(".") for name in names]
    gray_channels = [i for i, parts in enumerate(words) if _OTHER_NAMES.isdisjoint(parts)]
    if len(gray_channels) == 1:
        return gray_channels * 3
    raise InputError(f"the channels are {', '.join(names)}: save R, G and B, or one gray channel")


def _openimageio() -> ModuleType:
    """Import OpenImageIO, which takes long, and limit its threads and the size of images."""
    import OpenImageIO

    # OpenImageIO's threads would compete with torch's threads.
    OpenImageIO.attribute("threads", 1)
    OpenImageIO.attribute("exr_threads", -1)  # OpenEXR starts no threads of its own.
    OpenImageIO.attribute("limits:imagesize_MB", LARGEST_MAP)
    return OpenImageIO
