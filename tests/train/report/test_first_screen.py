"""The first screen shows images that only one of two networks gets right."""

from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from train.data.photographs import Photograph
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, write_predictions
from train.report.first_screen import contrasts

# Classes of the images, and the classes that two networks predict.
SHOWN = ("banana", "mug", "mug", "other_cup", "other_cup", "banana")
BEFORE = ("mug", "mug", "spoon", "mug", "spoon", "banana")
AFTER = ("banana", "banana", "spoon", "spoon", "banana", "banana")
LABELS = ("banana", "mug")


def write(folder: Path, predicted: tuple[str, ...]) -> Path:
    """Write the predictions of a network for the images, and return their folder."""
    predictions = []
    for label in LABELS:
        for number, (shown, name) in enumerate(zip(SHOWN, predicted, strict=True)):
            photograph = Photograph(PurePosixPath(f"{number}.png"), shown, f"source {number}")
            predictions.append(Prediction(photograph, label, name, 0.5, None, None, 0.1, 2, -1.0))
    folder.mkdir()
    write_predictions(folder / PREDICTIONS, predictions)
    return folder


def test_an_image_of_one_of_several_classes_is_right_if_its_own_class_is_predicted(tmp_path):
    for number in range(len(SHOWN)):
        pixels = np.full((8, 8, 3), 20 * number, dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{number}.png")
    before = write(tmp_path / "before", BEFORE)
    after = write(tmp_path / "after", AFTER)
    gained, lost = contrasts(before, after, tmp_path, LABELS).values()
    # The third image is wrong twice, and the last one is right twice.
    assert {item.subject for item in gained} == {"banana, source 0", "cup, source 3"}
    assert {item.subject for item in lost} == {"mug, source 1", "cup, source 4"}
