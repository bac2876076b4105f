import re

import pytest

from tests.helpers import save_plain
from tests.train.helpers import evaluation_of, ranked
from train.results.first_screen import FirstScreen, choose_disagreements, compare_networks
from train.results.predictions import Predictions

# Classes of the images, and the classes that two networks predict.
SHOWN = ("banana", "mug", "mug", "other_cup", "other_cup", "banana")
BEFORE = ("mug", "mug", "spoon", "mug", "spoon", "banana")
AFTER = ("banana", "banana", "spoon", "spoon", "banana", "banana")
LABELS = ("banana", "mug")


def predictions_of(predicted: tuple[str, ...], labels: tuple[str, ...] = LABELS) -> Predictions:
    classes = ("banana", "mug", "spoon")
    logits = [[float(name == other) for other in classes] for name in predicted]
    return ranked(SHOWN, logits, classes, labels, [f"source {number}" for number in range(6)])


def test_an_image_of_one_of_several_classes_is_right_if_its_own_class_is_predicted(tmp_path):
    for number, name in enumerate(SHOWN):
        save_plain(tmp_path / name / f"{number:03}.png", 20 * number)
    before, after = predictions_of(BEFORE), predictions_of(AFTER)
    rows = choose_disagreements(before, after, tmp_path)
    gained, lost = rows.values()
    # The third image is wrong twice, and the last one is right twice.
    assert {item.subject for item in gained} == {"banana, source 0", "cup, source 3"}
    assert {item.subject for item in lost} == {"mug, source 1", "cup, source 4"}
    assert [re.findall(r"\d+", title) for title in rows] == [["2", "6"], ["2", "6"]]
    (tmp_path / "banana" / "000.png").unlink()
    gained, lost = choose_disagreements(before, after, tmp_path).values()
    assert [[item.subject for item in gained], len(lost)] == [["cup, source 3"], 2]


def screen_of(labels: tuple[str, ...]) -> FirstScreen:
    before, after = (
        [evaluation_of(predictions_of(predicted, labels))] for predicted in (BEFORE, AFTER)
    )
    return compare_networks(before, after, ("before", "after"))


@pytest.mark.parametrize("labels", [LABELS, LABELS[:1]])
def test_top_1_is_shown_if_several_classes_are_under_study(labels):
    screen = screen_of(labels)
    shown = [number for number in screen.numbers if number.title.startswith("Top-1")]
    # Both networks lack the class of the cups.
    expected = [((1 / 2 + 1 / 2) / 2, (2 / 2 + 0 / 2) / 2)] if len(labels) > 1 else []
    assert [(number.before.value, number.after.value) for number in shown] == expected


def test_an_image_of_no_class_under_study_is_counted_once_for_all_classes():
    counts = re.findall(r"\d+", screen_of(LABELS).images)
    others = [shown for shown in SHOWN if shown not in LABELS]
    assert int(counts[0]) == len(SHOWN) - len(others)
    assert int(counts[1]) == len(others)


def test_false_calls_of_several_classes_are_means_over_the_classes():
    """Without the last image, 4 images show no banana, and 3 no mug."""
    before, after = (
        [evaluation_of(predictions[predictions.source != "source 5"])]
        for predictions in map(predictions_of, (BEFORE, AFTER))
    )
    screen = compare_networks(before, after, ("before", "after"))
    means = [(0 / 4 + 2 / 3) / 2, (2 / 4 + 0 / 3) / 2]
    shown = screen.numbers[1]
    assert [shown.before.value, shown.after.value] == pytest.approx(means)
    assert re.findall(r"\d+%", screen.sentences[1]) == [f"{mean:.0%}" for mean in means]
