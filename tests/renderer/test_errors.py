"""Each check of arguments refuses every kind of wrong value by the name of the argument."""

import math

import numpy as np
import pytest
import torch
from oracles import square

from renderer import errors

MESH = square(1)
COMPLEX = torch.ones(2, 3) * 1j
NO_NUMBERS = ("x", None, 1j, {}, MESH, [None], ["a"], [[1], [1, 2]], COMPLEX, COMPLEX.numpy())
NO_NUMBERS += (np.full(3, None), torch.ones(3) > 0, True)
NO_SCALARS = ("2", None, True, 1j, [1.0, 2.0], (5,), torch.ones(2), MESH)
OUT_OF_RANGE = (-1, 10, math.nan, math.inf)
NOT_FINITE = (torch.tensor([math.nan, 0, 1]), torch.tensor([[1], [-math.inf]]))
# Checks of an argument x, from 0 to 9 if it is a number, and wrong values of each kind.
CHECKS = [
    (lambda x: errors.require_finite(x=x), NOT_FINITE),
    (lambda x: errors.require_bounded(x=x), (*NOT_FINITE, torch.full((2,), 1.01e12))),
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
    errors.require_bounded(x=torch.tensor([float(value), 0.99e12]))


def test_late_checks_raise_the_error_of_the_first_that_failed_and_then_begin_anew():
    checks = []
    with errors.late_checks(checks):
        errors.require_bounded(first=torch.ones(2))
        errors.require_finite(second=torch.tensor([1, math.nan]))
        errors.require_bounded(third=torch.tensor(-2e12))
    with pytest.raises(errors.InputError, match="second holds NaN"):
        errors.raise_first(checks)
    errors.raise_first(checks)
    with pytest.raises(errors.InputError, match="third"):
        errors.require_bounded(third=torch.tensor(-2e12))
