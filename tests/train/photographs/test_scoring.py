import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import logsumexp, softmax

from renderer.errors import InputError
from train.photographs.scoring import evaluate_photographs, format_summary
from train.tables import fraction

from .conftest import FRUIT


def score(rows: list[tuple[str, str]]) -> dict[str, object]:
    """The metrics of photographs from their names and their classes in order, by counting and by comparing all pairs.

    The log-odds of orange depend on its place alone.
    """
    oranges, others = (
        [order.split().index("orange") for name, order in rows if name.startswith("orange/") == orange]
        for orange in (True, False)
    )
    pairs = [(place < other) + (place == other) / 2 for place in oranges for other in others]
    return {
        "recall": fraction(oranges.count(0), len(oranges)),
        "top5": fraction(sum(place < 5 for place in oranges), len(oranges)),
        "false_positive_rate": fraction(others.count(0), len(others)),
        "auc": sum(pairs) / len(pairs) if pairs else None,
    }


def test_every_metric_of_a_known_model_is_right(fruit, tmp_path):
    summary = evaluate_photographs(*fruit, "orange", tmp_path / "new" / "out")
    assert json.loads((tmp_path / "new" / "out" / "summary.json").read_text(encoding="utf-8")) == summary
    assert summary["n"] == {"photographs": 10, "positives": 5, "negatives": 5, "unreadable": 0, "left_out": 0}
    assert {source: metrics["n"] for source, metrics in summary["by_source"].items()} == {
        "lab": 2,
        "shop": 2,
        "street": 4,
    }
    for source, metrics in {None: summary, **summary["by_source"]}.items():
        expected = score([(name, order) for name, other, order in FRUIT if source in (None, other)])
        auc = metrics["auc"]
        assert auc["value"] == pytest.approx(expected.pop("auc"), abs=1e-12)
        assert auc["value"] is None or auc["low"] <= auc["value"] <= auc["high"]
        assert {name: metrics[name] for name in expected} == expected
    wrong = {"pear": 2, "apple": 1, "plum": 1}
    assert summary["by_class"]["orange"]["most_common_wrong"] == summary["most_common_wrong"] == wrong
    assert summary["by_class"]["other_lemon"] == {
        "n": 2, "recall": fraction(0, 0), "top5": fraction(0, 0), "predicted_label": fraction(1, 2),
        "most_common_wrong": {"lime": 1, "orange": 1},
    }  # fmt: skip
    assert summary["by_class"]["pear"]["recall"] == fraction(1, 3)


def test_a_source_is_ranked_against_the_hard_negatives_that_it_names(fruit, tmp_path):
    """The oranges of the lab, of rank 1 and 2, against the pears of the shop, of rank 2 and 1: one win and two ties."""
    _, _, folder = fruit
    header, *rows = (folder / "photos.csv").read_text().splitlines()
    paired = [f"{row},{'shop' if row.startswith('orange/a') else ''}" for row in rows]
    (folder / "photos.csv").write_text("\n".join([f"{header},hard_negatives", *paired]))
    summary = evaluate_photographs(*fruit, "orange", tmp_path / "out")
    lab = summary["by_source"]["lab"]
    assert (lab["auc"]["value"], lab["auc"]["positives"], lab["auc"]["negatives"]) == (0.5, 2, 2)
    assert lab["false_positive_rate"]["n"] == 0  # its own
    assert summary["auc"]["value"] == 0.34 and summary["by_source"]["street"]["auc"]["value"] == 0.25
    table = {row["path"]: row["hard_negatives"] for row in read_csv(tmp_path / "out" / "predictions.csv")}
    assert {path: names for path, names in table.items() if names} == {"orange/a.png": "shop"}


def test_the_score_is_the_log_odds_also_where_the_probability_rounds_to_0_or_1(known_model, tmp_path):
    logits = [[0, 100, 3], [0, -900, 3], [1, 2, 3], [0, -4000, -5000]]
    names = [f"{index}.png" for index in range(4)]
    evaluate_photographs(*known_model(names, logits, ["a", "b", "c"]), "b", tmp_path)
    rows = read_csv(tmp_path / "predictions.csv")
    expected = [100 - logsumexp([0, 3]), -900 - logsumexp([0, 3]), 2 - logsumexp([1, 3]), -4000]
    assert [float(row["b_log_odds"]) for row in rows] == pytest.approx(expected, rel=1e-15)
    assert [row["b_rank"] for row in rows] == ["1", "3", "2", "2"]


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_csv_gives_each_photograph_its_probabilities_and_brute_force_ranks(known_model, tmp_path):
    classes = ["apple", "fig", "lime", "orange", "pear", "plum"]
    names = [f"{label}/{index}.png" for label in ("orange", "other_x", "plum") for index in range(4)]
    logits = np.random.default_rng(0).normal(0, 3, (len(names), len(classes))).astype(np.float32)
    evaluate_photographs(*known_model(names, logits, classes), "orange", tmp_path)
    rows = read_csv(tmp_path / "predictions.csv")
    assert [row["path"] for row in rows] == names
    for row, scores in zip(rows, logits.astype(float), strict=True):
        probabilities = dict(zip(classes, softmax(scores), strict=True))
        ranking = sorted(classes, key=probabilities.get, reverse=True)
        label = row["path"].split("/")[0]
        assert (row["label"], row["source"], row["predicted"]) == (label, "", ranking[0])
        assert float(row["probability"]) == pytest.approx(probabilities[ranking[0]], rel=1e-12)
        assert float(row["orange_probability"]) == pytest.approx(probabilities["orange"], rel=1e-12)
        assert int(row["orange_rank"]) == ranking.index("orange") + 1
        if label == "other_x":
            assert (row["true_probability"], row["true_rank"]) == ("", "")
        else:
            assert float(row["true_probability"]) == pytest.approx(probabilities[label], rel=1e-12)
            assert int(row["true_rank"]) == ranking.index(label) + 1


@pytest.mark.parametrize("place", [0, 4, 5])
def test_a_tie_of_all_classes_goes_to_the_first_class(known_model, tmp_path, place):
    classes = [f"class {index}" for index in range(300)]  # sorts that are not stable show it at this size
    undecided = known_model(["a.png"], np.zeros((1, 300)), classes)
    summary = evaluate_photographs(*undecided, classes[place], tmp_path)
    assert summary["recall"]["value"] == (place == 0)
    assert summary["top5"]["value"] == (place < 5)


def test_black_reaches_the_model_as_0_and_white_as_1(tmp_path):
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (32, 32), (0, 255, 51)).save(tmp_path / "photos" / "a.png")

    def check(images):
        assert images.tolist() == torch.tensor([0, 1, 0.2]).view(1, 3, 1, 1).expand(1, 3, 8, 8).tolist()
        return torch.zeros(1, 2)

    evaluate_photographs(check, ["orange", "pear"], tmp_path / "photos", "orange", tmp_path, size=8)


def test_skipped_photographs_are_counted_and_named_but_not_scored(fruit, tmp_path):
    _, _, folder = fruit
    (folder / "orange" / "broken.jpg").touch()
    (folder / "orange" / "photo.HEIC").touch()
    with pytest.raises(InputError, match="1 of 11 "):
        evaluate_photographs(*fruit, "orange", tmp_path)
    summary = evaluate_photographs(*fruit, "orange", tmp_path, skip_unreadable=True)
    assert summary["unreadable"] == ["orange/broken.jpg"]
    assert summary["n"] == {"photographs": 10, "positives": 5, "negatives": 5, "unreadable": 1, "left_out": 1}
    assert all(name in format_summary(summary) for name in ("orange/broken.jpg", "orange/photo.HEIC"))


def test_the_model_runs_in_eval_mode_without_gradients_and_is_left_as_it_was(fruit, tmp_path):
    fruit_model, classes, folder = fruit

    class Network(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.training_norm, self.frozen_norm = torch.nn.BatchNorm2d(3), torch.nn.BatchNorm2d(3).eval()

        def forward(self, images):
            assert not any(module.training for module in self.modules())
            assert not self.training_norm(images).requires_grad
            return fruit_model(images)

    model = Network()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    evaluate_photographs(model, classes, folder, "orange", tmp_path)
    assert (model.training, model.training_norm.training, model.frozen_norm.training) == (True, True, False)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("logits", "message"),
    [(torch.zeros(10), r"shape \(10, 10\), not \(10, 6\)"), (torch.full((6,), torch.nan), "NaN or infinite logits")],
)
def test_a_model_that_does_not_fit_is_refused(fruit, tmp_path, logits, message):
    _, classes, folder = fruit
    with pytest.raises(InputError, match=message):
        evaluate_photographs(lambda x: logits.expand(len(x), -1), classes, folder, "orange", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["photos", "link/out", "new/../photos/out"])
def test_scores_are_never_written_among_the_photographs(fruit, tmp_path, out):
    _, _, folder = fruit
    (tmp_path / "link").symlink_to(folder)
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError, match=r"^out=.* lies inside the photographs' folder: choose another$"):
        evaluate_photographs(*fruit, "orange", tmp_path / out)
    assert sorted(folder.rglob("*")) == before
    evaluate_photographs(*fruit, "orange", tmp_path / "photos_scored")  # beside them is not among them
