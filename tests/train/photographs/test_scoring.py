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

NOTHING = {"value": None, "low": None, "high": None, "hits": 0, "n": 0}


def ranked(auc: float | None, positives: int, negatives: int) -> dict:
    """The ranking of the fruit photographs, without intervals.

    Their log-odds depend on the rank of orange alone; 1 is the highest. The only thresholds are those of rank 1, which
    no orange exceeds.
    """
    recall = {"value": None, "threshold": None}
    if auc is not None:
        recall = {"value": 0, "threshold": -logsumexp([-1, -2, -3, -4, -5])}
    return {
        "auc": {"value": auc, "positives": positives, "negatives": negatives},
        "recall_at": dict.fromkeys(("0.05", "0.10", "0.20"), recall),
    }


def counted(recall: dict, top5: dict, false_positive_rate: dict) -> dict:
    return {"recall": recall, "top5": top5, "false_positive_rate": false_positive_rate}


# Orange has the ranks 1, 2, 6, 5, 2 on its own photographs a to e and 1, 5, 2, 1, 2 on the others f to j, so that those
# five beat 3, 1, 0, 0, 1 of the others and tie with 2, 2, 0, 1, 2: an AUC of (5 + 7/2) / 25.
FRUIT_SUMMARY = {
    "label": "orange",
    "size": 32,
    "n": {"photographs": 10, "positives": 5, "negatives": 5, "unreadable": 0, "left_out": 0},
    "recall": fraction(1, 5),
    "top5": fraction(4, 5),
    "false_positive_rate": fraction(2, 5),
    **ranked(0.34, 5, 5),
    "most_common_wrong": {"pear": 2, "apple": 1, "plum": 1},
    "by_source": {
        "lab": {
            "n": 2,
            "recall": fraction(1, 2),
            "top5": fraction(2, 2),
            "false_positive_rate": NOTHING,
            **ranked(None, 2, 0),
        },
        "shop": {
            "n": 2,
            "recall": NOTHING,
            "top5": NOTHING,
            "false_positive_rate": fraction(1, 2),
            **ranked(None, 0, 2),
        },
        "street": {
            "n": 4,
            "recall": fraction(0, 2),
            "top5": fraction(1, 2),
            "false_positive_rate": fraction(1, 2),
            **ranked(0.25, 2, 2),
        },
    },
    "by_class": {
        "orange": {
            "n": 5,
            "recall": fraction(1, 5),
            "top5": fraction(4, 5),
            "predicted_label": fraction(1, 5),
            "most_common_wrong": {"pear": 2, "apple": 1, "plum": 1},
        },
        "other_lemon": {
            "n": 2,
            "recall": NOTHING,
            "top5": NOTHING,
            "predicted_label": fraction(1, 2),
            "most_common_wrong": {"lime": 1, "orange": 1},
        },
        "pear": {
            "n": 3,
            "recall": fraction(1, 3),
            "top5": fraction(2, 3),
            "predicted_label": fraction(1, 3),
            "most_common_wrong": {"apple": 1, "orange": 1},
        },
    },
    "unreadable": [],
    "left_out": [],
}


def rounded(tree):
    """The same tree with its floats to 12 digits, below which the order of the operations shows."""
    if isinstance(tree, dict):
        return {key: rounded(value) for key, value in tree.items()}
    return round(tree, 12) if isinstance(tree, float) else tree


def take_intervals(metrics: dict) -> list[dict]:
    """Remove the intervals of a ranking; what is removed, with the values."""
    ranked = [metrics["auc"], *metrics["recall_at"].values()]
    return [{"value": metric["value"], "low": metric.pop("low"), "high": metric.pop("high")} for metric in ranked]


@pytest.mark.parametrize("batch_size", [1, 3, 256])
def test_every_metric_of_a_known_model_is_right(fruit, tmp_path, batch_size):
    summary = evaluate_photographs(*fruit, "orange", tmp_path / "new" / "out", batch_size=batch_size)
    assert json.loads((tmp_path / "new" / "out" / "summary.json").read_text(encoding="utf-8")) == summary
    for metrics in (summary, *summary["by_source"].values()):
        for metric in take_intervals(metrics):
            assert set(metric.values()) == {None} or metric["low"] <= metric["value"] <= metric["high"]
    assert rounded(summary) == rounded(FRUIT_SUMMARY)
    ordered = summary["by_class"]["orange"]["most_common_wrong"]
    assert list(ordered.items()) == [("pear", 2), ("apple", 1), ("plum", 1)]


def test_a_source_is_ranked_against_the_hard_negatives_that_it_names(fruit, tmp_path):
    """The oranges of the lab, of rank 1 and 2, against the pears of the shop, of rank 2 and 1: one win and two ties."""
    _, _, folder = fruit
    header, *rows = (folder / "photos.csv").read_text().splitlines()
    paired = [f"{row},{'shop' if row.startswith('orange/a') else ''}" for row in rows]
    (folder / "photos.csv").write_text("\n".join([f"{header},hard_negatives", *paired]))
    summary = evaluate_photographs(*fruit, "orange", tmp_path / "out")
    lab = summary["by_source"]["lab"]
    assert {key: lab["auc"][key] for key in ("value", "positives", "negatives")} == {
        "value": 0.5,
        "positives": 2,
        "negatives": 2,
    }
    assert lab["false_positive_rate"] == NOTHING  # its own
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
    *_, unreadable, left_out = format_summary(summary).split("\n\n")
    assert unreadable == "1 unreadable: orange/broken.jpg" and left_out.endswith("not read: orange/photo.HEIC")


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


def test_the_terminal_shows_counts_with_intervals_the_auc_and_a_row_per_class(fruit, tmp_path, read_markdown):
    first, *tables = format_summary(evaluate_photographs(*fruit, "orange", tmp_path)).split("\n\n")
    assert first == "5 images of orange, 5 of other things"
    counts, ranked, classes = (read_markdown(table)[""] for table in tables)
    assert counts[2] == ["lab", "1/2 = 0.500 [0.095, 0.905]", "2/2 = 1.000 [0.342, 1.000]", "-"]
    assert ranked[1] == ["overall", "0.340 [0.060, 0.680]", *["0.000 [0.000, 0.200]"] * 2, "0.000 [0.000, 0.400]"]
    assert classes[1] == ["orange", "5", "0.200", "0.800", "0.200", "pear 2, apple 1, plum 1"]
