import csv
import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import logsumexp, softmax

from renderer.errors import InputError
from train.data.photographs import Photograph
from train.evaluation.scores.metrics import AT_THRESHOLD, METRICS
from train.evaluation.scores.predictions import Prediction, Predictor, read_predictions, write_predictions
from train.evaluation.scores.scoring import (
    Scores,
    choose_operating_points,
    evaluate_photographs,
    format_scores,
    score,
    write,
)
from train.evaluation.scores.sheet import FRAME, IMAGE
from train.evaluation.tables import fraction


class TableModel(torch.nn.Module):
    """Predicts row i of a table of logits for an image whose red is i."""

    def __init__(self, table):
        super().__init__()
        self.table = torch.as_tensor(table, dtype=torch.float32)

    def forward(self, images):
        assert images.dtype == torch.float32 and images.ndim == 4 and images.shape[1] == 3
        return self.table[(images[:, 0].mean(dim=(1, 2)) * 255).round().long()]


@pytest.fixture
def known_model(tmp_path) -> Callable[..., tuple[TableModel, list[str], Path]]:
    """Makes a folder of the named images and a model that gives the i-th of them the i-th row of logits.

    Returns the model, its classes and the folder, in the order in which `evaluate` takes them.
    """

    def make(names: Sequence[str], logits: Sequence, classes: list[str]) -> tuple[TableModel, list[str], Path]:
        folder = tmp_path / "photos"
        for red, name in enumerate(names):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (32, 32), (red, 0, 0)).save(folder / name)
        return TableModel(logits), classes, folder

    return make


FRUIT_CLASSES = ["apple", "fig", "lime", "orange", "pear", "plum"]

# Photograph, source, and the model's classes from best to worst.
FRUIT = [
    ("orange/a.png", "lab", "orange pear plum fig lime apple"),
    ("orange/b.png", "lab", "pear orange plum fig lime apple"),
    ("orange/c.png", "street", "apple pear plum fig lime orange"),
    ("orange/d.png", "", "plum pear apple fig orange lime"),
    ("orange/e.png", "street", "pear orange plum fig lime apple"),
    ("other_lemon/f.png", "street", "orange pear plum fig lime apple"),
    ("other_lemon/g.png", "street", "lime pear plum fig orange apple"),
    ("pear/h.png", "shop", "pear orange plum fig lime apple"),
    ("pear/i.png", "shop", "orange apple plum fig lime pear"),
    ("pear/j.png", "", "apple orange plum fig pear lime"),
]


@pytest.fixture
def fruit(known_model):
    """A model whose every prediction is known, its classes and a folder of photographs with sources."""
    logits = [[-order.split().index(name) for name in FRUIT_CLASSES] for _, _, order in FRUIT]
    model, classes, folder = known_model([name for name, _, _ in FRUIT], logits, FRUIT_CLASSES)
    lines = [f"{name},{source}" for name, source, _ in FRUIT]
    (folder / "photos.csv").write_text("\n".join(["path,source_tag", *lines]))
    return model, classes, folder


@pytest.fixture(autouse=True)
def no_figure(monkeypatch) -> None:
    """roc.png is drawn for the one test that opens it."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_: None)


def scored(model, classes, folder, label, out: Path, skip_unreadable: bool = False, **options) -> Scores:
    """The scores that a command writes into `out`; with options of `score` as pnb-evaluate, without as pnb-train."""
    predictor = Predictor(model, classes)
    if not options:
        return evaluate_photographs(predictor, folder, label, out, skip_unreadable)
    scores = score(predictor.predict(folder, label, skip_unreadable), **options)
    write(scores, out)
    return scores


def evaluate(*arguments, **options) -> dict:
    """The summary of `scored`, as it is in summary.json."""
    return json.loads(json.dumps(scored(*arguments, **options).to_summary()))


def wilson(hits: int, n: int) -> dict[str, float | None]:
    """A fraction as summary.json has it."""
    return asdict(fraction(hits, n))


def counted(rows: list[tuple[str, str]]) -> dict[str, object]:
    """The metrics of photographs from their names and their classes in order, by counting and by comparing all pairs.

    The log-odds of orange depend on its place alone.
    """
    oranges, others = (
        [order.split().index("orange") for name, order in rows if name.startswith("orange/") == orange]
        for orange in (True, False)
    )
    pairs = [(place < other) + (place == other) / 2 for place in oranges for other in others]
    return {
        "recall": wilson(oranges.count(0), len(oranges)),
        "top5": wilson(sum(place < 5 for place in oranges), len(oranges)),
        "false_positive_rate": wilson(others.count(0), len(others)),
        "auc": sum(pairs) / len(pairs) if pairs else None,
    }


def test_every_metric_of_a_known_model_is_right(fruit, tmp_path):
    summary = evaluate(*fruit, "orange", tmp_path / "new" / "out")
    assert json.loads((tmp_path / "new" / "out" / "summary.json").read_text(encoding="utf-8")) == summary
    assert summary["n"] == {"photographs": 10, "positives": 5, "negatives": 5, "unreadable": 0, "left_out": 0}
    assert {source: row["n"] for source, row in summary["by_source"].items()} == {"lab": 2, "shop": 2, "street": 4}
    for source, metrics in {None: summary, **summary["by_source"]}.items():
        expected = counted([(name, order) for name, other, order in FRUIT if source in (None, other)])
        auc = metrics["auc"]
        assert auc["value"] == pytest.approx(expected.pop("auc"), abs=1e-12)
        assert auc["value"] is None or auc["low"] <= auc["value"] <= auc["high"]
        assert {name: metrics[name] for name in expected} == expected
    assert summary["by_class"]["orange"]["most_common_wrong"] == {"pear": 2, "apple": 1, "plum": 1}
    assert summary["by_class"]["other_lemon"] == {
        "n": 2, "recall": wilson(0, 0), "top5": wilson(0, 0), "predicted_label": wilson(1, 2),
        "most_common_wrong": {"lime": 1, "orange": 1},
    }  # fmt: skip
    assert summary["by_class"]["pear"]["recall"] == wilson(1, 3)


def test_a_source_is_ranked_against_the_hard_negatives_that_it_names(fruit, tmp_path):
    """The oranges of the lab, of rank 1 and 2, against the pears of the shop, of rank 2 and 1: one win and two ties."""
    _, _, folder = fruit
    header, *rows = (folder / "photos.csv").read_text().splitlines()
    paired = [f"{row},{'shop' if row.startswith('orange/a') else ''}" for row in rows]
    (folder / "photos.csv").write_text("\n".join([f"{header},hard_negatives", *paired]))
    summary = evaluate(*fruit, "orange", tmp_path / "out")
    lab = summary["by_source"]["lab"]
    assert (lab["auc"]["value"], lab["auc"]["positives"], lab["auc"]["negatives"]) == (0.5, 2, 2)
    assert lab["false_positive_rate"]["n"] == 0  # its own
    assert summary["auc"]["value"] == 0.34 and summary["by_source"]["street"]["auc"]["value"] == 0.25


def test_a_mesh_is_ranked_against_all_images_of_the_other_kind_and_objects_count_in_intervals(fruit, tmp_path):
    """Meshes m and n of oranges, k of others, by letters of FRUIT; an image without one is an object of its own."""
    _, _, folder = fruit
    meshes = {"a": "m", "c": "m", "b": "n", "f": "k", "h": "k"}
    header, *rows = (folder / "photos.csv").read_text().splitlines()
    rows = [f"{row},{meshes.get(row.split('/')[1][0], '')}" for row in rows]
    (folder / "photos.csv").write_text("\n".join([f"{header},mesh", *rows]))
    scores = scored(*fruit, "orange", tmp_path / "out", by="mesh")
    summary = scores.to_summary()
    assert (summary["auc"]["positive_objects"], summary["auc"]["negative_objects"]) == (4, 4)
    for mesh, metrics in summary["by_mesh"].items():
        of_mesh = [(name, order) for name, _, order in FRUIT if meshes.get(name.split("/")[1][0]) == mesh]
        other = [(name, order) for name, _, order in FRUIT if name.startswith("orange/") == (mesh == "k")]
        assert metrics["auc"]["value"] == pytest.approx(counted(of_mesh + other)["auc"], abs=1e-12)
        assert metrics["recall"] == counted(of_mesh)["recall"]
    assert list(summary["by_mesh"]) == ["k", "m", "n"] and "objects and images" in format_scores(scores)


@pytest.mark.parametrize(("rate", "recall", "false_positives"), [(0.4, 1, 2), (0.39, 0, 0), (0.8, 3, 4), (0.6, 1, 2)])
def test_an_operating_point_is_the_lowest_threshold_within_its_rate(fruit, tmp_path, rate, recall, false_positives):
    """Of the ranks of orange, 1, 2, 6, 5, 2 and of the others 1, 5, 2, 1, 2: those that tie with it lie below."""
    model, classes, folder = fruit
    (point,) = choose_operating_points(Predictor(model, classes), folder, "orange", rate)
    for in_sample in (True, False):
        summary = evaluate(*fruit, "orange", tmp_path / "out", points=[point])
        assert summary["recall_at_threshold"] == wilson(recall, 5)
        assert summary["false_positive_rate_at_threshold"] == wilson(false_positives, 5)
        assert summary["operating_point"] == vars(point) | {"in_sample": in_sample}
        Image.new("RGB", (32, 32), (1, 1, 0)).save(folder / "orange" / "b.png")  # another image of the same prediction
    with pytest.raises(InputError, match=r"has 5 images of other things .* at least 10 for .*=0\.1$"):
        choose_operating_points(Predictor(model, classes), folder, "orange", 0.1)


def test_several_classes_are_scored_each_as_alone_and_pooled_over_all_pairs(fruit, tmp_path):
    """Pooled, an image counts once for each class, with the log-odds of that class. Oranges a and c are a mesh."""
    model, classes, folder = fruit
    header, *rows = (folder / "photos.csv").read_text().splitlines()
    rows = [f"{row},{'m' if row[7] in 'ac' else ''}" for row in rows]
    (folder / "photos.csv").write_text("\n".join([f"{header},mesh", *rows]))
    points = choose_operating_points(Predictor(model, classes), folder, ["pear", "orange"], 0.4)
    both = evaluate(*fruit, ["pear", "orange"], tmp_path / "both", by="mesh", points=points)
    for point in points:
        alone = evaluate(*fruit, point.label, tmp_path / point.label, points=[point])
        (own,) = choose_operating_points(Predictor(model, classes), folder, point.label, 0.4)
        assert (own.threshold, own.negatives) == (point.threshold, point.negatives)
        part = both["by_label"][point.label]
        assert part.pop("n") == 10 and part == {name: alone[name] for name in part} and {*METRICS[:2], "auc"} < {*part}
    assert [item["label"] for item in both["operating_point"]] == both["label"] == ["pear", "orange"]

    def odds(order: str, label: str) -> float:
        logits = {name: -place for place, name in enumerate(order.split())}
        return logits.pop(label) - logsumexp([*logits.values()])

    def auc(ours: Callable[[str, str], bool], others: Callable[[str, str], bool]) -> float:
        """By name and source; of all pairs."""
        asked = [
            (name, source, odds(order, label), name.startswith(label))
            for name, source, order in FRUIT
            for label in both["label"]
        ]
        positives = [score for name, source, score, right in asked if right and ours(name, source)]
        negatives = [score for name, source, score, right in asked if not right and others(name, source)]
        pairs = [(one > other) + (one == other) / 2 for one in positives for other in negatives]
        return sum(pairs) / len(pairs)

    assert both["auc"]["value"] == pytest.approx(auc(lambda *_: True, lambda *_: True), abs=1e-12)
    assert both["by_mesh"]["m"]["auc"]["value"] == pytest.approx(
        auc(lambda name, _: name[7] in "ac" and name[0] == "o", lambda *_: True)
    )
    shop = auc(lambda _, source: source == "shop", lambda _, source: source == "shop")
    assert both["by_source"]["shop"]["auc"]["value"] == pytest.approx(shop, abs=1e-12)
    first = [(name, order.split()[0]) for name, _, order in FRUIT]
    wrong = [best for name, best in first for label in both["label"] if not name.startswith(label) and best == label]
    assert both["recall"] == wilson(2, 8) and both["false_positive_rate"] == wilson(len(wrong), 12)
    assert (both["n"]["photographs"], both["n"]["positives"], both["n"]["negatives"]) == (10, 8, 12)
    hits = [sum(part[name]["hits"] for part in both["by_label"].values()) for name in AT_THRESHOLD]
    assert [both[name]["hits"] for name in AT_THRESHOLD] == hits
    written = read_predictions(tmp_path / "both" / "predictions.csv", ["orange", "pear"])
    files = [tmp_path / label / "predictions.csv" for label in ("orange", "pear")]
    assert written == [item for file in files for item in read_predictions(file, file.parent.name)]
    assert len(read_predictions(tmp_path / "both" / "predictions.csv", "pear")) == 10


def test_the_score_is_the_log_odds_also_where_the_probability_rounds_to_0_or_1(known_model, tmp_path):
    logits = [[0, 100, 3], [0, -900, 3], [1, 2, 3], [0, -4000, -5000]]
    names = [f"{index}.png" for index in range(4)]
    evaluate(*known_model(names, logits, ["a", "b", "c"]), "b", tmp_path)
    predictions = read_predictions(tmp_path / "predictions.csv", "b")
    expected = [100 - logsumexp([0, 3]), -900 - logsumexp([0, 3]), 2 - logsumexp([1, 3]), -4000]
    assert [prediction.log_odds for prediction in predictions] == pytest.approx(expected, rel=1e-15)
    assert [prediction.label_rank for prediction in predictions] == [1, 3, 2, 2]


def test_the_csv_gives_each_photograph_its_probabilities_and_brute_force_ranks(known_model, tmp_path):
    names = [f"{label}/{index}.png" for label in ("orange", "other_x", "plum") for index in range(4)]
    logits = np.random.default_rng(0).normal(0, 3, (len(names), len(FRUIT_CLASSES))).astype(np.float32)
    evaluate(*known_model(names, logits, FRUIT_CLASSES), "orange", tmp_path)
    predictions = read_predictions(tmp_path / "predictions.csv", "orange")
    for name, prediction, scores in zip(names, predictions, logits.astype(float), strict=True):
        probabilities = dict(zip(FRUIT_CLASSES, softmax(scores), strict=True))
        ranking, label = sorted(FRUIT_CLASSES, key=probabilities.get, reverse=True), name.split("/")[0]
        true = None if label == "other_x" else ranking.index(label) + 1
        ranks = prediction.true_rank, prediction.label_rank, prediction.predicted
        assert (str(prediction.photograph.path), prediction.photograph.label) == (name, label)
        assert ranks == (true, ranking.index("orange") + 1, ranking[0])
        found = prediction.probability, prediction.label_probability, prediction.true_probability or 0
        expected = probabilities[ranking[0]], probabilities["orange"], probabilities.get(label, 0)
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("place", [0, 4, 5])
def test_a_tie_of_all_classes_goes_to_the_first_class(known_model, tmp_path, place):
    classes = [f"class {index}" for index in range(300)]  # sorts that are not stable show it at this size
    undecided = known_model(["a.png"], np.zeros((1, 300)), classes)
    summary = evaluate(*undecided, classes[place], tmp_path)
    assert (summary["recall"]["value"], summary["top5"]["value"]) == (place == 0, place < 5)


def test_skipped_photographs_are_counted_and_named_but_not_scored(fruit, tmp_path):
    _, _, folder = fruit
    (folder / "orange" / "broken.jpg").touch()
    (folder / "orange" / "photo.HEIC").touch()
    with pytest.raises(InputError, match="1 of 11 "):
        evaluate(*fruit, "orange", tmp_path)
    scores = scored(*fruit, "orange", tmp_path, skip_unreadable=True)
    summary = scores.to_summary()
    assert summary["unreadable"] == ["orange/broken.jpg"]
    assert summary["n"] == {"photographs": 10, "positives": 5, "negatives": 5, "unreadable": 1, "left_out": 1}
    assert all(name in format_scores(scores) for name in ("orange/broken.jpg", "orange/photo.HEIC"))


def test_the_model_runs_in_eval_mode_without_gradients_and_is_left_as_it_was(fruit, tmp_path):
    fruit_model, classes, folder = fruit
    model = torch.nn.Sequential(torch.nn.BatchNorm2d(3), torch.nn.BatchNorm2d(3).eval())
    model.register_forward_pre_hook(lambda module, _: pytest.fail() if any(part.training for part in model) else None)
    model.register_forward_hook(lambda _, images, result: result.requires_grad or fruit_model(*images))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    evaluate(model, classes, folder, "orange", tmp_path)
    assert [part.training for part in (model, *model)] == [True, True, False]
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("logits", "message"),
    [(torch.zeros(10), r"shape \(10, 10\), not \(10, 6\)"), (torch.full((6,), torch.nan), "NaN or infinite logits")],
)
def test_a_model_that_does_not_fit_is_refused(fruit, tmp_path, logits, message):
    _, classes, folder = fruit
    with pytest.raises(InputError, match=message):
        evaluate(lambda x: logits.expand(len(x), -1), classes, folder, "orange", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["photos", "link/out", "new/../photos/out"])
def test_scores_are_never_written_among_the_photographs(fruit, tmp_path, out):
    _, _, folder = fruit
    (tmp_path / "link").symlink_to(folder)
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError, match=r"^out=.* lies inside the photographs' folder: choose another$"):
        evaluate(*fruit, "orange", tmp_path / out)
    assert sorted(folder.rglob("*")) == before
    evaluate(*fruit, "orange", tmp_path / "photos_scored")  # beside them is not among them


PREDICTIONS = [
    Prediction(
        Photograph(PurePosixPath("orange/a, b.png"), "orange", "web", ("lab", "studio"), "m"),
        *("orange", "orange", 1 / 3, 1 / 3, 1, 1 / 3, 1, -0.1),
    ),
    Prediction(
        Photograph(PurePosixPath("other_x/ü.png"), "other_x", None),
        *("orange", "pear", 1.0, None, None, 1e-300, 2, -690.0),
    ),
]


def test_written_predictions_are_read_bit_by_bit_and_those_of_another_class_are_refused(tmp_path):
    write_predictions(tmp_path / "a.csv", PREDICTIONS)
    assert read_predictions(tmp_path / "a.csv", "orange") == PREDICTIONS
    with pytest.raises(InputError, match=r"a\.csv cannot be used .* with label=pear"):
        read_predictions(tmp_path / "a.csv", "pear")


FRAMES = {"true positives": (46, 158, 91), "false negatives": (208, 59, 59), "false positives": (232, 163, 23)}
FRAMED = IMAGE + 2 * FRAME


def count_tiles(sheet: Image.Image) -> list[int]:
    pixels = np.asarray(sheet)
    areas = [int((pixels == color).all(axis=2).sum()) for color in FRAMES.values()]
    counts = [divmod(area, FRAMED**2 - IMAGE**2) for area in areas]
    assert all(rest == 0 for _, rest in counts)
    return [count for count, _ in counts]


def test_the_contact_sheet_frames_each_hit_miss_and_false_positive(fruit, tmp_path):
    evaluate(*fruit, "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == [1, 4, 2]


def test_the_contact_sheet_shows_at_most_40_images_evenly_by_probability(known_model, tmp_path):
    """Of 101 true positives 40 are shown, image 100 being the surest and image 0 the least."""
    names = [f"{index:03}.png" for index in range(101)]
    table = np.stack([np.arange(1, 102), np.zeros(101)], axis=1) / 20
    evaluate(*known_model(names, table, ["orange", "pear"]), "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == [40, 0, 0]
        red, green, blue = np.moveaxis(np.asarray(sheet).astype(int), 2, 0)
    areas = np.bincount(red[(green == 0) & (blue == 0)])
    shown = np.flatnonzero(areas >= IMAGE**2)
    assert len(shown) == 40 and shown[0] == 0 and shown[-1] == 100 and set(np.diff(shown)) == {2, 3}


def test_the_roc_table_has_the_curve_of_all_photographs_and_of_sources_with_both_classes(fruit, tmp_path):
    """Of the ranks of orange, 1, 2, 6, 5, 2 and of the others 1, 5, 2, 1, 2; of the street 6, 2 and 1, 5."""
    evaluate(*fruit, "orange", tmp_path)
    curves = defaultdict(list)
    with (tmp_path / "roc.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            point = tuple(float(row[name]) for name in ("false_positive_rate", "recall", "threshold"))
            curves[row["source"]].append(point)
    assert list(curves) == ["", "street"]
    assert [point[:2] for point in curves[""]] == [(0, 0), (0.4, 0.2), (0.8, 0.6), (1, 0.8), (1, 1)]
    assert [point[:2] for point in curves["street"]] == [(0, 0), (0.5, 0), (0.5, 0.5), (1, 0.5), (1, 1)]
    for curve in curves.values():
        assert curve == sorted(curve, key=lambda point: -point[2]) and curve[-1][2] == -np.inf


def test_a_folder_without_negatives_has_an_empty_table_and_figure(known_model, tmp_path, monkeypatch):
    monkeypatch.undo()
    evaluate(*known_model(["a.png"], [[1, 0]], ["orange", "pear"]), "orange", tmp_path)
    assert (tmp_path / "roc.csv").read_text() == "source,false_positive_rate,recall,threshold\n"
    with Image.open(tmp_path / "roc.png") as image:
        image.load()
