"""Lights as files: .json with their basis and every coefficient, and a projector's pattern as .png."""

import json
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from renderer.errors import FACTOR, InputError, require_bounded, require_file
from renderer.image import to_bytes
from renderer.light.basis import HARMONICS, Harmonics, LocalBasis
from renderer.light.local import Projector


def save_light(path: Path, coefficients: Tensor, basis: Harmonics | LocalBasis = HARMONICS) -> None:
    """Write a basis and coefficients (size, 3), a row [r, g, b] each, as JSON; and a projector's pattern as a .png of
    eight bits beside it, in which white is its power.

    `read_light` reads float32 back to the bit. InputError: another shape, NaN, or a file that cannot be written.

    >>> light = renderer.load_light("grace")
    >>> save_light(Path("light.json"), light)
    >>> torch.equal(renderer.load_light("light.json"), light)
    True
    """
    require_bounded(coefficients=coefficients)
    if coefficients.shape != (basis.size, 3):
        raise InputError(f"coefficients {tuple(coefficients.shape)} are not of {basis}: give {(basis.size, 3)}")
    description = {"basis": basis.name, **vars(basis), "coefficients": coefficients.tolist()}
    try:
        path.write_text(json.dumps(description, allow_nan=False) + "\n", encoding="utf-8")
        if isinstance(basis, Projector):
            pattern = to_bytes(coefficients.view(basis.pixels, basis.pixels, 3) / basis.power)
            Image.fromarray(pattern.numpy()).save(path.with_suffix(".png"))
    except OSError as error:
        raise InputError(f"light {path} cannot be written: {error}") from error


def read_light(path: Path, *kinds: type[Any]) -> tuple[Any, Tensor]:
    """(the basis, of one of these kinds, and coefficients (size, 3) float32) of a .json file; rows alone are of
    harmonics. InputError: a file that is missing or describes another light."""
    require_file(path, "give the path of a .json file of coefficients")
    try:
        description = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(description, dict):
            description = {"basis": HARMONICS.name, "coefficients": description}
        coefficients = torch.tensor(description.pop("coefficients"), dtype=torch.float32)
        name, named = description.pop("basis"), {kind.name: kind for kind in kinds}
        if name not in named:
            raise InputError(f"its basis is {name!r}, give one of {' or '.join(named)}")
        if "positions" in description:
            description["positions"] = tuple(map(tuple, description["positions"]))
        basis = named[name](**description)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, ValueError, TypeError, RuntimeError, OverflowError, RecursionError, OSError) as error:
        raise InputError(f"{path} does not describe a light ({error}): write it again") from error
    if coefficients.shape != (basis.size, 3) or not (coefficients.abs() <= FACTOR).all():  # NaN is not
        raise InputError(
            f"{path} has coefficients {tuple(coefficients.shape)}: give {basis.size} rows [r, g, b] of finite numbers, "
            f"no larger than {FACTOR:g}"
        )
    return basis, coefficients
