"""Projectors and lamps as files: .json with what they are and every coefficient, and a projector's pattern as .png."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from renderer.errors import FACTOR, InputError, require_file
from renderer.image import to_bytes
from renderer.lamps import Lamps
from renderer.projector import Projector

BASES: dict[str, Any] = {basis.name: basis for basis in (Projector, Lamps)}


def save_placed(path: Path, coefficients: Tensor, basis: Any) -> None:
    """Write the .json file of a projector or of lamps, which `load_placed` reads back to the bit, and a projector's
    pattern as a .png of eight bits beside it, in which white is its power."""
    description = {"basis": basis.name, **asdict(basis), "coefficients": coefficients.tolist()}
    path.write_text(json.dumps(description, allow_nan=False) + "\n", encoding="utf-8")
    if isinstance(basis, Projector):
        pattern = to_bytes(coefficients.view(basis.pixels, basis.pixels, 3) / basis.power)
        Image.fromarray(pattern.numpy()).save(path.with_suffix(".png"))


def load_placed(path: Path) -> tuple[Projector | Lamps, Tensor]:
    """(the basis, coefficients (size, 3) float32). InputError: there is no such file, or it describes none."""
    require_file(path, "give a projector's or lamps' .json")
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
        make = BASES[description.pop("basis")]
        coefficients = torch.tensor(description.pop("coefficients"), dtype=torch.float32)
        if make is Lamps:
            description["places"] = tuple(tuple(place) for place in description["places"])
        basis = make(**description)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError, OverflowError) as error:
        raise InputError(f"{path} does not describe a projector or lamps ({error}): write it again") from error
    if coefficients.shape != (basis.size, 3) or not (coefficients.abs() <= FACTOR).all():
        raise InputError(f"{path} has coefficients {tuple(coefficients.shape)}: give {basis.size} of [r, g, b]")
    return basis, coefficients
