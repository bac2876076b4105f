"""Each check of arguments refuses every kind of wrong value by the name of the argument."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from renderer import errors
from renderer.camera import OrthographicCamera
from renderer.light.harmonics import basis, project, rotate
from renderer.mesh import Mesh
from renderer.operators.build import build_operators
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.visibility import choose
from renderer.visibility.fragments import build_fragments

MESH = Mesh.plain([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
CAMERA = OrthographicCamera(0, 0, 2.0)
SETTINGS = ImageSettings(2, 2)
[FRAGMENTS] = build_fragments(MESH.vertices, MESH.faces, [CAMERA], SETTINGS, choose("numpy"))
[OPERATOR] = build_operators(MESH, [CAMERA], SETTINGS, choose("numpy"))


def corner_albedo(corner_colors: Tensor) -> Tensor:
    return surface_albedo(replace(MESH, corner_colors=corner_colors.numpy()), FRAGMENTS, "srgb")


# Each case has the name of a tensor, valid values and the function that takes
# them. Positions and directions must be finite, but may be of any size.
FINITE = [
    ("directions", torch.ones(2, 3), lambda x: basis(x, 6)),
    ("radiance", torch.ones(4, 8, 3), lambda x: project(x, 2)),
    ("radiance", torch.ones(28, 3), lambda x: project(lambda _: x, 2, quadrature_degree=6)),
    ("coefficients", torch.ones(9, 3), lambda x: rotate(x, torch.eye(3))),
    ("rotation", torch.eye(3), lambda x: rotate(torch.ones(9, 3), x)),
]
# Values that are multiplied by each other must also be of limited size.
BOUNDED = [
    ("corner_colors", torch.ones(2, 3, 3), corner_albedo),
    ("lights", torch.ones(2, 49, 3), OPERATOR.radiance),
    ("radiance_gradient", torch.ones(2, 3, 4), OPERATOR.light_gradient),
]


@pytest.mark.parametrize(("name", "good", "take"), FINITE + BOUNDED)
@pytest.mark.parametrize(("bad", "position"), [(math.nan, 0), (-math.inf, -1)])
def test_nan_and_infinity_are_refused_by_the_name_of_the_tensor(name, good, take, bad, position):
    take(good.clone())
    spoiled = good.clone()
    spoiled.view(-1)[position] = bad
    with pytest.raises(errors.InputError, match=f"^{name} "):
        take(spoiled)


@pytest.mark.parametrize(("name", "good", "take"), BOUNDED)
def test_magnitudes_that_would_overflow_are_refused_by_name(name, good, take):
    take(good * errors.MAX_MAGNITUDE * 0.99)
    with pytest.raises(errors.InputError, match=f"^{name} "):
        take(good * errors.MAX_MAGNITUDE * 1.01)


COMPLEX = torch.ones(2, 3) * 1j
NO_NUMBERS = ("x", None, 1j, {}, MESH, [None], ["a"], [[1], [1, 2]], COMPLEX, COMPLEX.numpy())
NO_NUMBERS += (np.full(3, None), torch.ones(3) > 0, True)
NO_SCALARS = ("2", None, True, 1j, [1.0, 2.0], (5,), torch.ones(2), MESH)
OUT_OF_RANGE = (-1, 10, math.nan, math.inf)
# Checks of an argument x, from 0 to 9 if it is a number, and wrong values of each kind.
CHECKS = [
    (lambda x: errors.as_tensor("x", x), NO_NUMBERS),
    (lambda x: errors.as_tensor("x", x), ([torch.ones(1), torch.ones(2)], [torch.ones(1), "a"])),
    (lambda x: errors.as_integers("x", x), (*NO_NUMBERS, 0.5, [0.5, 1], torch.ones(2))),
    (lambda x: errors.as_array("x", x), NO_NUMBERS),
    (lambda x: errors.as_array("x", x, "iu"), (0.5, [0.5], np.ones(2))),
    (lambda x: errors.as_path("x", x), (None, 3, b"a", ["a"], True, MESH)),
    (
        lambda x: errors.as_list("x", x, int, "numbers"),
        ("ab", b"ab", {}, {1}, 3, None, torch.tensor(1)),
    ),
    (lambda x: errors.as_list("x", x, int, "numbers"), ([None], [1, "a"], torch.ones(2))),
    (lambda x: errors.require_whole("x", x, 0, 9), (*NO_SCALARS, *OUT_OF_RANGE, 0.5, 1.0)),
    (lambda x: errors.require_number("x", x, 0, 9), (*NO_SCALARS, *OUT_OF_RANGE, -1e-9, 9.001)),
    (lambda x: errors.require_range("x", x, 0, 9), (*OUT_OF_RANGE, "2", True, 1j, [1.0])),
    (lambda x: errors.require_choice("x", x, ("a", "b")), ("c", "A", "", None, 3, ["a"], True)),
    (
        lambda x: errors.require_flag("x", x),
        ("no", None, 2, -1, 0.5, 1.0, [True], torch.ones(2) > 0),
    ),
]


@pytest.mark.parametrize(
    ("check", "value"), [(check, value) for check, values in CHECKS for value in values]
)
def test_a_value_of_a_wrong_kind_or_range_is_refused_by_its_name(check, value):
    with pytest.raises(errors.InputError, match=r"^x\b"):
        check(value)


@pytest.mark.parametrize("value", [0, 9, np.int64(3), np.uint8(9)])
def test_the_ends_of_a_range_are_inside(value):
    for check in (errors.require_whole, errors.require_number, errors.require_range):
        check("x", value, 0, 9)
