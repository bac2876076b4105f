import csv
from collections import defaultdict

import numpy as np
import pytest
from matplotlib.colors import to_hex
from PIL import Image

from train.photographs.ranking import Ranking
from train.photographs.roc import draw_roc
from train.photographs.scoring import evaluate_photographs


def read_curves(path) -> dict[str, list[tuple[float, float, float]]]:
    curves = defaultdict(list)
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            curves[row["source"]].append(
                (float(row["false_alarm_rate"]), float(row["recall"]), float(row["threshold"]))
            )
    return curves


def test_the_table_has_the_curve_of_all_and_of_each_source_with_both_kinds(story, tmp_path):
    """Of the ranks of orange, 1, 2, 6, 5, 2 and of the others 1, 5, 2, 1, 2; of the street 6, 2 and 1, 5."""
    evaluate_photographs(*story, "orange", tmp_path)
    curves = read_curves(tmp_path / "roc.csv")
    assert [(alarms, recall) for alarms, recall, _ in curves[""]] == [(0, 0), (0.4, 0.2), (0.8, 0.6), (1, 0.8), (1, 1)]
    assert [(alarms, recall) for alarms, recall, _ in curves["street"]] == [
        (0, 0), (0.5, 0), (0.5, 0.5), (1, 0.5), (1, 1),
    ]  # fmt: skip
    assert list(curves) == ["", "street"]
    for curve in curves.values():
        thresholds = [threshold for _, _, threshold in curve]
        assert thresholds == sorted(thresholds, reverse=True) and thresholds[-1] == -np.inf


def test_the_figure_has_a_line_per_source_with_its_auc_and_the_three_rates():
    rankings = {"": Ranking([1.0, 2.0], [0.0, 1.5]), "lab": Ranking([1.0], [0.0])}
    figure = draw_roc(rankings, "orange")
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("other things called orange", "orange recognized")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["all: AUC 0.750", "lab: AUC 1.000"]
    assert [text.get_text() for text in axes.texts] == ["5%", "10%", "20%"]
    for line, ranking in zip(axes.lines[-2:], rankings.values(), strict=True):
        alarms, recall, _ = ranking.curve()
        np.testing.assert_array_equal(line.get_xydata(), np.stack([alarms, recall], axis=1))
    assert to_hex(axes.lines[-2].get_color()) == "#000000"


@pytest.mark.parametrize("name", ["a.png", "other_lemon/a.png"])
def test_a_folder_of_one_kind_has_an_empty_table_and_figure(known_model, tmp_path, name):
    evaluate_photographs(*known_model([name], [[1, 0]], ["orange", "pear"]), "orange", tmp_path)
    assert (tmp_path / "roc.csv").read_text() == "source,false_alarm_rate,recall,threshold\n"
    with Image.open(tmp_path / "roc.png") as image:
        image.load()
