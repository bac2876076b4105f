from pathlib import PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from train.photographs.cells import as_cell, as_written


@given(st.text(alphabet="'=+-@\t\ra1", max_size=6))
def test_what_is_written_is_no_formula_and_is_read_as_it_was(text):
    cell = as_cell(text)
    assert cell[:1] not in {"=", "+", "-", "@", "\t", "\r"} and as_written(cell) == text


@pytest.mark.parametrize("value", [-0.5, 1, None, "orange", "", PurePosixPath("a/=b.png")])
def test_numbers_and_other_names_stay_as_they_are(value):
    assert as_cell(value) == value
