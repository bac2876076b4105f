import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import logsumexp, softmax
from scipy.stats import binomtest

from renderer.errors import InputError
from train.photographs.answers import read_answers
from train.photographs.scoring import evaluate_photographs
from train.photographs.text import format_summary


def share(hits: int, n: int) -> dict:
    interval = binomtest(hits, n).proportion_ci(method="wilson")
    return {"value": hits / n, "low": interval.low, "high": interval.high, "hits": hits, "n": n}


NOTHING = {"value": None, "low": None, "high": None, "hits": 0, "n": 0}


def ranked(auc: float | None, label: int, others: int) -> dict:
    """The ranking of the story's photographs, without intervals.

    Their log-odds depend on the rank of orange alone; 1 is the highest. The only thresholds are those of rank 1, which
    no orange exceeds.
    """
    recall = {"value": None, "threshold": None}
    if auc is not None:
        recall = {"value": 0, "threshold": -logsumexp([-1, -2, -3, -4, -5])}
    return {
        "auc": {"value": auc, "label": label, "others": others},
        "recall_at": dict.fromkeys(("0.05", "0.10", "0.20"), recall),
    }


# Orange has the ranks 1, 2, 6, 5, 2 on its own photographs a to e and 1, 5, 2, 1, 2 on the others f to j, so that those
# five beat 3, 1, 0, 0, 1 of the others and tie with 2, 2, 0, 1, 2: an AUC of (5 + 7/2) / 25.
STORY_SUMMARY = {
    "label": "orange",
    "size": 32,
    "n": {"photographs": 10, "label": 5, "others": 5, "unreadable": 0, "left_out": 0},
    "recall": share(1, 5),
    "top5": share(4, 5),
    "false_alarms": share(2, 5),
    **ranked(0.34, 5, 5),
    "most_common_wrong": {"pear": 2, "apple": 1, "plum": 1},
    "by_source": {
        "lab": {"n": 2, "recall": share(1, 2), "top5": share(2, 2), "false_alarms": NOTHING, **ranked(None, 2, 0)},
        "shop": {"n": 2, "recall": NOTHING, "top5": NOTHING, "false_alarms": share(1, 2), **ranked(None, 0, 2)},
        "street": {
            "n": 4,
            "recall": share(0, 2),
            "top5": share(1, 2),
            "false_alarms": share(1, 2),
            **ranked(0.25, 2, 2),
        },
    },
    "by_class": {
        "orange": {
            "n": 5,
            "recall": share(1, 5),
            "top5": share(4, 5),
            "called_label": share(1, 5),
            "most_common_wrong": {"pear": 2, "apple": 1, "plum": 1},
        },
        "other_lemon": {
            "n": 2,
            "recall": NOTHING,
            "top5": NOTHING,
            "called_label": share(1, 2),
            "most_common_wrong": {"lime": 1, "orange": 1},
        },
        "pear": {
            "n": 3,
            "recall": share(1, 3),
            "top5": share(2, 3),
            "called_label": share(1, 3),
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


def take_intervals(figures: dict) -> list[dict]:
    """Remove the intervals of a ranking; what is removed, with the values."""
    ranked = [figures["auc"], *figures["recall_at"].values()]
    return [{"value": figure["value"], "low": figure.pop("low"), "high": figure.pop("high")} for figure in ranked]


@pytest.mark.parametrize("batch_size", [1, 3, 256])
def test_every_figure_of_a_known_model_is_right(story, tmp_path, batch_size):
    summary = evaluate_photographs(*story, "orange", tmp_path / "out", batch_size=batch_size)
    for figures in (summary, *summary["by_source"].values()):
        for figure in take_intervals(figures):
            assert set(figure.values()) == {None} or figure["low"] <= figure["value"] <= figure["high"]
    assert rounded(summary) == rounded(STORY_SUMMARY)
    ordered = summary["by_class"]["orange"]["most_common_wrong"]
    assert list(ordered.items()) == [("pear", 2), ("apple", 1), ("plum", 1)]


def test_the_summary_written_is_the_summary_returned_in_strict_json(story, tmp_path):
    summary = evaluate_photographs(*story, "orange", tmp_path / "new" / "out")
    text = (tmp_path / "new" / "out" / "summary.json").read_text(encoding="utf-8")

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    assert json.loads(text, parse_constant=refuse) == summary


def test_a_source_is_ranked_against_the_look_alikes_that_it_names(story, tmp_path):
    """The oranges of the lab, of rank 1 and 2, against the pears of the shop, of rank 2 and 1: one win and two ties."""
    _, _, folder = story
    header, *rows = (folder / "photos.csv").read_text().splitlines()
    paired = [f"{row},{'shop' if row.startswith('orange/a') else ''}" for row in rows]
    (folder / "photos.csv").write_text("\n".join([f"{header},look_alikes", *paired]))
    summary = evaluate_photographs(*story, "orange", tmp_path / "out")
    lab = summary["by_source"]["lab"]
    assert {key: lab["auc"][key] for key in ("value", "label", "others")} == {"value": 0.5, "label": 2, "others": 2}
    assert lab["false_alarms"] == NOTHING  # its own
    assert summary["auc"]["value"] == 0.34 and summary["by_source"]["street"]["auc"]["value"] == 0.25
    table = {row["path"]: row["look_alikes"] for row in read_csv(tmp_path / "out" / "photographs.csv")}
    assert {path: names for path, names in table.items() if names} == {"orange/a.png": "shop"}


def test_look_alikes_that_cannot_be_read_are_left_out(story, tmp_path):
    _, _, folder = story
    (folder / "pear" / "broken.png").touch()
    rows = ["path,source_tag,look_alikes", "orange/a.png,lab,wreck", "pear/broken.png,wreck,"]
    (folder / "photos.csv").write_text("\n".join(rows))
    summary = evaluate_photographs(*story, "orange", tmp_path / "out", skip_unreadable=True)
    assert summary["by_source"]["lab"]["auc"]["others"] == 0


def test_the_score_is_the_log_odds_also_where_the_probability_rounds_to_0_or_1(known_model, tmp_path):
    logits = [[0, 100, 3], [0, -900, 3], [1, 2, 3]]
    names = [f"{index}.png" for index in range(3)]
    evaluate_photographs(*known_model(names, logits, ["a", "b", "c"]), "b", tmp_path)
    told = [float(row["b_log_odds"]) for row in read_csv(tmp_path / "photographs.csv")]
    expected = [100 - logsumexp([0, 3]), -900 - logsumexp([0, 3]), 2 - logsumexp([1, 3])]
    assert told == pytest.approx(expected, rel=1e-15)


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_csv_gives_each_photograph_its_probabilities_and_brute_force_ranks(known_model, tmp_path):
    classes = ["apple", "fig", "lime", "orange", "pear", "plum"]
    names = [f"{label}/{index}.png" for label in ("orange", "other_x", "plum") for index in range(4)]
    logits = np.random.default_rng(0).normal(0, 3, (len(names), len(classes))).astype(np.float32)
    evaluate_photographs(*known_model(names, logits, classes), "orange", tmp_path)
    rows = read_csv(tmp_path / "photographs.csv")
    assert [row["path"] for row in rows] == names
    for row, scores in zip(rows, logits.astype(float), strict=True):
        probabilities = dict(zip(classes, softmax(scores), strict=True))
        ranking = sorted(classes, key=probabilities.get, reverse=True)
        label = row["path"].split("/")[0]
        assert (row["label"], row["source"], row["prediction"]) == (label, "", ranking[0])
        assert float(row["probability"]) == pytest.approx(probabilities[ranking[0]], rel=1e-12)
        assert float(row["orange_probability"]) == pytest.approx(probabilities["orange"], rel=1e-12)
        assert int(row["orange_rank"]) == ranking.index("orange") + 1
        if label == "other_x":
            assert (row["true_probability"], row["true_rank"]) == ("", "")
        else:
            assert float(row["true_probability"]) == pytest.approx(probabilities[label], rel=1e-12)
            assert int(row["true_rank"]) == ranking.index(label) + 1


def test_ranks_hold_where_probabilities_round_to_zero(known_model, tmp_path):
    evaluate_photographs(*known_model(["a.png"], [[0, -5000, -4000]], ["a", "b", "c"]), "c", tmp_path)
    (row,) = read_csv(tmp_path / "photographs.csv")
    assert (float(row["c_probability"]), row["c_rank"]) == (0, "2")


@pytest.mark.parametrize("place", [0, 1, 4, 5, 299])
def test_a_tie_of_all_classes_goes_to_the_first_alone(known_model, tmp_path, place):
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


def test_a_model_that_calls_everything_orange_has_recall_1_and_false_alarms_1(story, tmp_path):
    _, classes, folder = story
    orange = torch.tensor([float(name == "orange") for name in classes])
    summary = evaluate_photographs(lambda x: orange.expand(len(x), -1), classes, folder, "orange", tmp_path)
    assert summary["recall"]["value"] == summary["false_alarms"]["value"] == 1
    assert summary["most_common_wrong"] == {}
    assert all(figures["called_label"]["value"] == 1 for figures in summary["by_class"].values())


def test_a_class_without_photographs_has_no_recall_rather_than_a_wrong_one(story, tmp_path):
    summary = evaluate_photographs(*story, "fig", tmp_path)
    assert summary["recall"] == summary["top5"] == NOTHING
    assert rounded(summary["false_alarms"]) == rounded(share(0, 10))


def test_skipped_photographs_are_counted_and_named_but_not_scored(story, tmp_path):
    _, _, folder = story
    (folder / "orange" / "broken.jpg").touch()
    with pytest.raises(InputError, match="1 of 11 "):
        evaluate_photographs(*story, "orange", tmp_path)
    summary = evaluate_photographs(*story, "orange", tmp_path, skip_unreadable=True)
    assert summary["unreadable"] == ["orange/broken.jpg"]
    assert summary["n"] == {"photographs": 10, "label": 5, "others": 5, "unreadable": 1, "left_out": 0}
    assert format_summary(summary).endswith("1 unreadable: orange/broken.jpg")


@pytest.mark.parametrize("fails", [False, True])
def test_the_model_is_asked_in_eval_mode_without_gradients_and_left_as_it_was(story, tmp_path, fails):
    oracle, classes, folder = story

    class Spy(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.live, self.frozen = torch.nn.BatchNorm2d(3), torch.nn.BatchNorm2d(3).eval()

        def forward(self, images):
            assert not any(module.training for module in self.modules())
            assert not self.live(images).requires_grad
            if fails:
                raise RuntimeError("out of memory")
            return oracle(images)

    model = Spy()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    try:
        evaluate_photographs(model, classes, folder, "orange", tmp_path)
    except RuntimeError:
        assert fails
    assert (model.training, model.live.training, model.frozen.training) == (True, True, False)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("answer", "message"),
    [(torch.zeros(10), r"shape \(10, 10\), not \(10, 6\)"), (torch.full((6,), torch.nan), "not finite")],
)
def test_a_model_that_does_not_fit_is_refused(story, tmp_path, answer, message):
    _, classes, folder = story
    with pytest.raises(InputError, match=message):
        evaluate_photographs(lambda x: answer.expand(len(x), -1), classes, folder, "orange", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["photos", "photos/out", "photos/orange", "link/out", "new/../photos/out"])
def test_scores_are_never_written_among_the_photographs(story, tmp_path, out):
    _, classes, folder = story
    (tmp_path / "link").symlink_to(folder)
    before = sorted(folder.rglob("*"))

    def refuse(images):
        raise AssertionError("the model was asked")

    with pytest.raises(InputError, match=r"^out=.* lies inside the photographs' folder: choose another$"):
        evaluate_photographs(refuse, classes, folder, "orange", tmp_path / out)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("out", [".", "photos_scored", "photos/../scored"])
def test_scores_may_be_written_beside_or_above_the_photographs(story, tmp_path, out):
    evaluate_photographs(*story, "orange", tmp_path / out)
    assert (tmp_path / out / "summary.json").is_file()


def test_names_that_a_spreadsheet_would_run_are_text_and_numbers_stay_numbers(known_model, tmp_path):
    names = ["other_x/=1+1.png", "=HYPERLINK/a.png", "@b/-2.png"]
    classes = ["=HYPERLINK", "@b", "orange"]
    logits = [[-9.0, 0.0, 1.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0]]
    evaluate_photographs(*known_model(names, logits, classes), "orange", tmp_path / "out")
    with open(tmp_path / "out" / "photographs.csv", newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    assert {row[0] for row in rows} == {"other_x/=1+1.png", "'=HYPERLINK/a.png", "'@b/-2.png"}
    assert {row[4] for row in rows} == {"orange", "'=HYPERLINK", "'@b"}
    names, numbers = ([cell for row in rows for cell in row[part]] for part in (slice(5), slice(5, None)))
    assert all(cell[:1] not in ("=", "+", "-", "@") for cell in names)
    assert all(math.isfinite(float(cell)) for cell in numbers if cell)
    answers = read_answers(tmp_path / "out" / "photographs.csv", "orange")
    assert [answer.photograph.label for answer in answers] == ["=HYPERLINK", "@b", "other_x"]
