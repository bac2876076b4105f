"""Read and write .json files of lights. A file has a basis and its coefficients."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

import torch
from PIL import Image
from torch import Tensor

from renderer.errors import (
    MAX_SCALE,
    InputError,
    as_path,
    as_tensor,
    require_bounded,
    require_file,
    require_kind,
    require_whole,
)
from renderer.image import to_bytes
from renderer.io.files import atomic_write
from renderer.io.images import write_image
from renderer.light.basis import HARMONICS, Harmonics, LocalBasis
from renderer.light.environment import SUFFIXES, to_map, write_map
from renderer.light.harmonics import irradiance_error

# Exceptions that are raised if a .json file is damaged, or does not describe a light.
_DAMAGED_FILE_ERRORS = (
    KeyError,
    ValueError,
    TypeError,
    RuntimeError,
    OverflowError,
    RecursionError,
    OSError,
)
# Largest number of rows of a written map, which needs 3 GB of memory.
MAX_MAP_HEIGHT = 8192
# Type of the basis that `read_light` returns.
LightBasis = TypeVar("LightBasis", bound=Harmonics | LocalBasis)


def save_light(
    path: str | Path,
    coefficients: Tensor,
    basis: Harmonics | LocalBasis = HARMONICS,
    height: int = 256,
) -> float:
    """Write a light to a .json file, or environment lighting as a map for other software.

    From a .json file, `load_light` reads exactly the same float32 numbers. For a
    projector, its pattern is also written to an 8-bit .png file with the same
    name. White in this image is the largest coefficient, the attribute `power` of
    the projector. A map (.hdr, .exr or .npy) has no negative radiance and the same
    mean, so its irradiance can differ from that of the light.

    Args:
        path: Path of a .json file or, for spherical harmonics, of a map.
        coefficients: RGB coefficients of the light, shape (size, 3) with the
            number `basis.size` of functions of the basis.
        basis: Basis of the light. The default is spherical harmonics of degree 6.
        height: Number of rows of a map, which has twice as many columns.

    Returns:
        Relative error of the irradiance of the written light, root mean square over
        all normals. It is 0 for a .json file.

    Raises:
        InputError: If the suffix is of no such file, if the file cannot be written,
            or if the coefficients have another shape or hold NaN.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> light = nb.load_light("grace")
        >>> nb.save_light("light.json", light)
        0.0
        >>> torch.equal(nb.load_light("light.json"), light)
        True
        >>> nb.save_light("light.hdr", light) < 0.01
        True
    """
    path = as_path("path", path)
    is_map = path.suffix.lower() in SUFFIXES and isinstance(basis, Harmonics)
    if path.suffix != ".json" and not is_map:
        raise InputError(
            f"path={path} is neither a .json file nor, for spherical harmonics, a map: "
            f"use one of the suffixes .json, {', '.join(SUFFIXES)}"
        )
    expected = "Harmonics(degree), or lamps or a projector"
    require_kind("basis", basis, Harmonics | LocalBasis, expected)
    coefficients = as_tensor("coefficients", coefficients)
    require_bounded(coefficients=coefficients)
    if coefficients.shape != (basis.size, 3):
        shape = tuple(coefficients.shape)
        raise InputError(
            f"coefficients has shape {shape}, but {basis} needs the shape {(basis.size, 3)}: "
            "give coefficients of this shape"
        )
    if isinstance(basis, Harmonics) and is_map:
        require_whole("height", height, 1, MAX_MAP_HEIGHT)
        physical = basis.project_nonnegative(coefficients)
        write_map(path, to_map(physical, height).clamp(min=0))
        return float(irradiance_error(physical, coefficients))
    description = {"basis": basis.name, **vars(basis), "coefficients": coefficients.tolist()}
    picture = basis.picture(coefficients)
    try:
        atomic_write(path, json.dumps(description, allow_nan=False) + "\n")
        if picture is not None:
            image = Image.fromarray(to_bytes(picture.clamp(0, 1)).numpy())
            write_image(path.with_suffix(".png"), image)
    except OSError as error:
        raise InputError(f"light {path} cannot be written: {error}") from error
    return 0.0


def read_light(path: str | Path, *kinds: type[LightBasis]) -> tuple[LightBasis, Tensor]:
    """Read a light from a .json file.

    A plain list of rows [r, g, b] holds SH coefficients. `kinds` are accepted classes, such
    as `Lamps`.
    """
    path = Path(path)
    require_file(path, "give the path of a .json file of coefficients")
    kind_of_name = {kind.name: kind for kind in kinds}
    try:
        description = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(description, dict):
            description = {"basis": HARMONICS.name, "coefficients": description}
        coefficients = torch.tensor(description.pop("coefficients"), dtype=torch.float32)
        name = description.pop("basis")
        if name not in kind_of_name:
            known = " or ".join(kind_of_name)
            raise InputError(f"basis is {name!r}: give a light with the basis {known}")
        basis = kind_of_name[name](**description)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(
            f"{path} does not describe a light ({error}): write the file again"
        ) from error
    # The comparison is False for NaN, so NaN counts as too large.
    is_bounded = bool((coefficients.abs() <= MAX_SCALE).all())
    if coefficients.shape != (basis.size, 3) or not is_bounded:
        shape = tuple(coefficients.shape)
        raise InputError(
            f"{path} has coefficients of shape {shape}, or values that are not finite: "
            f"give {basis.size} rows [r, g, b] of numbers with magnitudes up to {MAX_SCALE:g}"
        )
    return basis, coefficients
