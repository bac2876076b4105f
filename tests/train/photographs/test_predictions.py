from pathlib import PurePosixPath

import pytest

from renderer.errors import InputError
from train.photographs.folder import Photograph
from train.photographs.predictions import Prediction, read_predictions, write_predictions

PREDICTIONS = [
    Prediction(
        Photograph(PurePosixPath("orange/a, b.png"), "orange", "web", ("lab", "studio")),
        *("orange", 1 / 3, 1 / 3, 1, 1 / 3, 1, -0.1),
    ),
    Prediction(Photograph(PurePosixPath("other_x/ü.png"), "other_x", None), "pear", 1.0, None, None, 1e-300, 2, -690.0),
]


def test_written_predictions_are_read_bit_by_bit(tmp_path):
    write_predictions(tmp_path / "a.csv", PREDICTIONS, "orange")
    assert read_predictions(tmp_path / "a.csv", "orange") == PREDICTIONS


def test_a_table_of_another_class_is_refused_by_name(tmp_path):
    write_predictions(tmp_path / "a.csv", PREDICTIONS, "pear")
    with pytest.raises(InputError, match=r"a\.csv cannot be used .* with label=orange"):
        read_predictions(tmp_path / "a.csv", "orange")
