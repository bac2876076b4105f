import csv
from collections import defaultdict

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from train.photographs.metrics import roc_curve
from train.photographs.scoring import evaluate_photographs
from train.photographs.sheet import FRAME, IMAGE, draw_roc

FRAMES = {"true positives": (46, 158, 91), "false negatives": (208, 59, 59), "false positives": (232, 163, 23)}
FRAMED = IMAGE + 2 * FRAME


def count_tiles(sheet: Image.Image) -> list[int]:
    pixels = np.asarray(sheet)
    areas = [int((pixels == color).all(axis=2).sum()) for color in FRAMES.values()]
    counts = [divmod(area, FRAMED**2 - IMAGE**2) for area in areas]
    assert all(rest == 0 for _, rest in counts)
    return [count for count, _ in counts]


def test_the_contact_sheet_frames_each_hit_miss_and_false_positive(fruit, tmp_path):
    evaluate_photographs(*fruit, "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == [1, 4, 2]


def test_the_contact_sheet_shows_at_most_40_images_from_the_surest_to_the_least_sure(known_model, tmp_path):
    """Of 101 true positives 40 are shown, image 100 being the surest and image 0 the least."""
    names = [f"{index:03}.png" for index in range(101)]
    table = np.stack([np.arange(1, 102), np.zeros(101)], axis=1) / 20
    evaluate_photographs(*known_model(names, table, ["orange", "pear"]), "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == [40, 0, 0]
        red, green, blue = np.moveaxis(np.asarray(sheet).astype(int), 2, 0)
    areas = np.bincount(red[(green == 0) & (blue == 0)])
    shown = np.flatnonzero(areas >= IMAGE**2)
    assert len(shown) == 40 and shown[0] == 0 and shown[-1] == 100
    assert set(np.diff(shown)) == {2, 3}
    lines = np.where((green == 0) & (blue == 0), red, -1)
    assert any(list(dict.fromkeys(line[line >= 0])) == list(shown[::-1][:10]) for line in lines)


# ------------------------------------------------------------------------------------- ROC


def test_the_roc_table_has_the_curve_of_all_photographs_and_of_sources_with_both_classes(fruit, tmp_path):
    """Of the ranks of orange, 1, 2, 6, 5, 2 and of the others 1, 5, 2, 1, 2; of the street 6, 2 and 1, 5."""
    evaluate_photographs(*fruit, "orange", tmp_path)
    curves = defaultdict(list)
    with (tmp_path / "roc.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            point = tuple(float(row[name]) for name in ("false_positive_rate", "recall", "threshold"))
            curves[row["source"]].append(point)
    assert list(curves) == ["", "street"]
    assert [point[:2] for point in curves[""]] == [(0, 0), (0.4, 0.2), (0.8, 0.6), (1, 0.8), (1, 1)]
    assert [point[:2] for point in curves["street"]] == [(0, 0), (0.5, 0), (0.5, 0.5), (1, 0.5), (1, 1)]
    for curve in curves.values():
        thresholds = [threshold for _, _, threshold in curve]
        assert thresholds == sorted(thresholds, reverse=True) and thresholds[-1] == -np.inf


def test_the_figure_has_a_line_per_roc_and_the_mean_auc_of_each_name():
    scores = {"all": [([1.0, 2.0], [0.0, 1.5]), ([1.0], [0.0])], "lab": [([1.0], [0.0])]}
    pairs = {name: [tuple(map(np.array, pair)) for pair in group] for name, group in scores.items()}
    axes = Figure().subplots()
    draw_roc(axes, pairs, "orange", {"lab": {"color": "red"}})
    handles, labels = axes.get_legend_handles_labels()
    assert labels == ["all: AUC 0.875", "lab: AUC 1.000"] and handles[1].get_color() == "red"
    for line, pair in zip(axes.lines[-3:], [*pairs["all"], *pairs["lab"]], strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.stack(roc_curve(*pair)[:2], axis=1))


def test_a_folder_without_negatives_has_an_empty_table_and_figure(known_model, tmp_path):
    evaluate_photographs(*known_model(["a.png"], [[1, 0]], ["orange", "pear"]), "orange", tmp_path)
    assert (tmp_path / "roc.csv").read_text() == "source,false_positive_rate,recall,threshold\n"
    with Image.open(tmp_path / "roc.png") as image:
        image.load()
