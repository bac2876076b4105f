from pathlib import PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from renderer.errors import InputError
from train.photographs.answers import Answer, as_cell, as_written, read_answers, write_answers
from train.photographs.folder import Photograph

ANSWERS = [
    Answer(
        Photograph(PurePosixPath("orange/a, b.png"), "orange", "web", ("lab", "studio")),
        *("orange", 1 / 3, 1 / 3, 1, 1 / 3, 1, -0.1),
    ),
    Answer(Photograph(PurePosixPath("other_x/ü.png"), "other_x", None), "pear", 1.0, None, None, 1e-300, 2, -690.0),
]


def test_what_was_written_is_read_bit_by_bit(tmp_path):
    write_answers(tmp_path / "a.csv", ANSWERS, "orange")
    assert read_answers(tmp_path / "a.csv", "orange") == ANSWERS


@pytest.mark.parametrize("text", [None, "", "path,label\na.png,orange\n", "\xff\n"])
def test_a_table_of_another_kind_is_refused(tmp_path, text):
    write_answers(tmp_path / "a.csv", ANSWERS, "pear" if text is None else "orange")
    if text is not None:
        (tmp_path / "a.csv").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"a\.csv cannot be used: score the photographs again, with label=orange"):
        read_answers(tmp_path / "a.csv", "orange")


@given(st.text(alphabet="'=+-@\t\ra1", max_size=6))
def test_what_is_written_is_no_formula_and_is_read_as_it_was(text):
    cell = as_cell(text)
    assert cell[:1] not in {"=", "+", "-", "@", "\t", "\r"} and as_written(cell) == text


@pytest.mark.parametrize("value", [-0.5, 1, None, "orange", "", PurePosixPath("a/=b.png")])
def test_numbers_and_other_names_stay_as_they_are(value):
    assert as_cell(value) == value
