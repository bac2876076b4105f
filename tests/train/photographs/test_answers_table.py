from pathlib import PurePosixPath

import pytest

from renderer.errors import InputError
from train.photographs.answers import Answer
from train.photographs.answers_table import read_answers, write_answers
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
