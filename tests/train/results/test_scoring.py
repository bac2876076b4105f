import csv
import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import logsumexp, softmax
from torch import Tensor

from renderer.errors import InputError
from tests.helpers import save_plain
from train.data.photo import Photograph
from train.results import scoring
from train.results.metrics import AT_THRESHOLD, METRICS
from train.results.pictures import FRAME_WIDTH, IMAGE_SIZE
from train.results.predictions import read_predictions, write_predictions
from train.results.tables import THESE_OBJECTS, fraction


@pytest.fixture
def known_model(tmp_path) -> Callable[..., tuple[Callable[[Tensor], Tensor], list[str], Path]]:
    """Return a function that makes a model, its classes, and images with the given logits."""

    def make(names, logits, classes) -> tuple[Callable[[Tensor], Tensor], list[str], Path]:
        table = torch.as_tensor(logits, dtype=torch.float32)

        def model(images: Tensor) -> Tensor:
            assert images.dtype == torch.float32 and images.shape[1] == 3
            red = 255 * images[:, 0].mean(dim=(1, 2))
            return table[red.round().long()]

        folder = tmp_path / "photos"
        for red, name in enumerate(names):
            save_plain(folder / name, (red, 0, 0), (32, 32))
        return model, classes, folder

    return make


FRUIT_CLASSES = ["apple", "fig", "lime", "orange", "pear", "plum"]


@dataclass(frozen=True)
class Fruit:
    name: str
    source: str
    order: str

    @property
    def ranking(self) -> list[str]:
        return self.order.split()

    @property
    def letter(self) -> str:
        return Path(self.name).stem

    def is_of(self, label: str) -> bool:
        return self.name.startswith(f"{label}/")

    def place(self, label: str) -> int:
        return self.ranking.index(label)

    def log_odds(self, label: str) -> float:
        """Compute the log-odds of a class with logits 0, -1, … in the order of the ranking."""
        others = [-place for place, name in enumerate(self.ranking) if name != label]
        return -self.place(label) - logsumexp(others)


FRUIT = [
    Fruit("orange/a.png", "lab", "orange pear plum fig lime apple"),
    Fruit("orange/b.png", "lab", "pear orange plum fig lime apple"),
    Fruit("orange/c.png", "street", "apple pear plum fig lime orange"),
    Fruit("orange/d.png", "", "plum pear apple fig orange lime"),
    Fruit("orange/e.png", "street", "pear orange plum fig lime apple"),
    Fruit("other_lemon/f.png", "street", "orange pear plum fig lime apple"),
    Fruit("other_lemon/g.png", "street", "lime pear plum fig orange apple"),
    Fruit("pear/h.png", "shop", "pear orange plum fig lime apple"),
    Fruit("pear/i.png", "shop", "orange apple plum fig lime pear"),
    Fruit("pear/j.png", "", "apple orange plum fig pear lime"),
]
COUNTS = {"photographs": 10, "positives": 5, "negatives": 5}


def write_table(folder: Path, **columns: list[str]) -> None:
    facts = {"path": [item.name for item in FRUIT], "source_tag": [item.source for item in FRUIT]}
    facts |= columns
    with open(folder / "photos.csv", "w", newline="") as file:
        csv.writer(file).writerows([[*facts], *zip(*facts.values(), strict=True)])


@pytest.fixture
def fruit(known_model) -> tuple[Callable[[Tensor], Tensor], list[str], Path]:
    logits = [[-item.place(name) for name in FRUIT_CLASSES] for item in FRUIT]
    model, classes, folder = known_model([item.name for item in FRUIT], logits, FRUIT_CLASSES)
    write_table(folder)
    return model, classes, folder


@pytest.fixture(autouse=True)
def no_figure(monkeypatch) -> None:
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_: None)


def scored(model, classes, folder, label, out, skip_unreadable=False, **options) -> scoring.Scores:
    """Write scores into a folder, as pnb-evaluate does with options, or as pnb-train without."""
    predictor = scoring.Predictor(model, classes)
    if not options:
        return scoring.evaluate_photographs(predictor, folder, label, out, skip_unreadable)
    scores = scoring.score(predictor.predict(folder, label, skip_unreadable), **options)
    scoring.write(scores, out)
    return scores


def evaluate(*arguments, **options) -> dict:
    return json.loads(json.dumps(scored(*arguments, **options).to_summary()))


def wilson(hits: int, n: int) -> dict[str, float | None]:
    return asdict(fraction(hits, n))


def counts(proportion: dict[str, float]) -> tuple[float, float, float]:
    return proportion["value"], proportion["hits"], proportion["n"]


def count_metrics(fruits: list[Fruit]) -> dict[str, object]:
    """Count the metrics; a lower place of orange in the ranking means a higher score."""
    oranges = [item.place("orange") for item in fruits if item.is_of("orange")]
    others = [item.place("orange") for item in fruits if not item.is_of("orange")]
    wins = [(own < other) + (own == other) / 2 for own in oranges for other in others]
    return {
        "recall": wilson(oranges.count(0), len(oranges)),
        "top5": wilson(sum(place < 5 for place in oranges), len(oranges)),
        "false_positive_rate": wilson(others.count(0), len(others)),
        "auc": sum(wins) / len(wins) if wins else None,
    }


def test_metrics_are_those_of_counting_and_of_all_pairs_and_are_written_to_a_file(fruit, tmp_path):
    summary = evaluate(*fruit, "orange", tmp_path / "new" / "out")
    text = (tmp_path / "new" / "out" / "summary.json").read_text(encoding="utf-8")
    assert json.loads(text) == summary
    assert summary["n"] == COUNTS | {"unreadable": 0, "left_out": 0}
    for source, n in (None, summary["n"]), ("lab", 2), ("shop", 2), ("street", 4):
        metrics = summary if source is None else summary["by_source"][source]
        assert metrics["n"] == n
        expected = count_metrics([item for item in FRUIT if source in (None, item.source)])
        auc = metrics["auc"]
        assert auc["value"] == pytest.approx(expected.pop("auc"), abs=1e-12)
        assert auc["value"] is None or auc["low"] <= auc["value"] <= auc["high"]
        assert {name: metrics[name] for name in expected} == expected
    assert summary["by_class"]["pear"]["recall"] == wilson(1, 3)
    wrong = summary["by_class"]["orange"]["most_common_wrong"]
    assert wrong == {"pear": 2, "apple": 1, "plum": 1}
    others = {"n": 2, "recall": wilson(0, 0), "most_common_wrong": {"lime": 1, "orange": 1}}
    assert summary["by_class"]["other_lemon"] == others


def test_a_source_is_ranked_against_the_hard_negatives_that_it_names(fruit, tmp_path):
    """Oranges of ranks 1 and 2 win one pair and lose one with pears of ranks 2 and 1."""
    *_, folder = fruit
    # A source that is named by its own images is counted once.
    named = {"a": "shop", "c": "street"}
    negatives = [named.get(item.letter, "") for item in FRUIT]
    write_table(folder, hard_negatives=negatives)
    summary = evaluate(*fruit, "orange", tmp_path / "out")
    lab = summary["by_source"]["lab"]
    assert lab["auc"]["value"] == 0.5
    assert lab["auc"]["positives"] == 2
    assert lab["auc"]["negatives"] == 2
    assert lab["false_positive_rate"]["n"] == 0  # The lab has no negative of its own.
    assert summary["auc"]["value"] == 0.34
    street = summary["by_source"]["street"]["auc"]
    assert (street["value"], street["negatives"]) == (0.25, 2)


def test_meshes_are_objects_and_ranked_against_all_images_of_the_other_kind(fruit, tmp_path):
    """Meshes m and n are oranges, and mesh k is another thing. Images without one do not count."""
    mesh_of_letter = {"a": "m", "c": "m", "b": "n", "h": "k", "i": "k"}
    *_, folder = fruit
    write_table(folder, mesh=[mesh_of_letter.get(item.letter, "") for item in FRUIT])
    scores = scored(*fruit, "orange", tmp_path / "out", by="mesh")
    summary = scores.to_summary()
    assert summary["auc"]["positive_objects"] == 2  # m, n
    assert summary["auc"]["negative_objects"] == 1  # k
    assert summary["auc"]["over"] == THESE_OBJECTS
    assert THESE_OBJECTS in scoring.format_scores(scores)
    for mesh, is_orange in (("k", False), ("m", True)):
        metrics = summary["by_mesh"][mesh]
        shown = [item for item in FRUIT if mesh_of_letter.get(item.letter) == mesh]
        others = [item for item in FRUIT if item.is_of("orange") != is_orange]
        expected = count_metrics(shown + others)["auc"]
        assert metrics["auc"]["value"] == pytest.approx(expected, abs=1e-12)
        assert counts(metrics["recall"]) == counts(count_metrics(shown)["recall"])


def test_objects_of_different_classes_may_have_the_same_name(fruit, tmp_path):
    *_, folder = fruit
    write_table(folder, mesh=[f"object {number % 3}" for number in range(len(FRUIT))])
    summary = scored(*fruit, "orange", tmp_path / "out", by="mesh").to_summary()
    shown = {(item.name.split("/")[0], number % 3) for number, item in enumerate(FRUIT)}
    oranges = sum(label == "orange" for label, _ in shown)
    assert summary["auc"]["positive_objects"] == oranges
    assert summary["auc"]["negative_objects"] == len(shown) - oranges
    assert len(summary["by_mesh"]) == len(shown)


class TestAnOperatingPoint:
    """The ranks of orange are 1, 2, 6, 5, 2 for oranges and 1, 5, 2, 1, 2 for others."""

    @pytest.mark.parametrize(
        ("rate", "recall", "false_positives", "is_in_sample"),
        [(0.4, 1, 2, True), (0.39, 0, 0, False), (0.8, 3, 4, True), (0.6, 1, 2, False)],
    )
    def test_is_the_lowest_threshold_within_its_rate(
        self, fruit, tmp_path, rate, recall, false_positives, is_in_sample
    ):
        *network, folder = fruit
        predictor = scoring.Predictor(*network)
        (point,) = scoring.choose_operating_points(predictor, folder, "orange", rate)
        if not is_in_sample:
            # Another image that has the same predictions takes the place of an orange.
            save_plain(folder / "orange" / "b.png", (1, 1, 0), (32, 32))
        summary = evaluate(*fruit, "orange", tmp_path / "out", points=[point])
        assert summary["recall_at_threshold"] == wilson(recall, 5)
        assert summary["false_positive_rate_at_threshold"] == wilson(false_positives, 5)
        assert summary["operating_point"] == vars(point) | {"in_sample": is_in_sample}

    def test_needs_a_negative_per_step_of_its_rate(self, fruit):
        *network, folder = fruit
        with pytest.raises(InputError, match=r"5 negatives .* at least 10 .*=0\.1$"):
            scoring.choose_operating_points(scoring.Predictor(*network), folder, "orange", 0.1)


def pooled_auc(labels: list[str], own_letters: str, source: str | None = None) -> float:
    """Compare all pairs, where each photograph has a score for each label."""
    positives = []
    negatives = []
    for item in FRUIT:
        for label in labels:
            is_shown = source in (None, item.source)
            if is_shown and not item.is_of(label):
                negatives.append(item.log_odds(label))
            elif is_shown and item.letter in own_letters:
                positives.append(item.log_odds(label))
    wins = [(own > other) + (own == other) / 2 for own in positives for other in negatives]
    return sum(wins) / len(wins)


def test_several_classes_are_each_scored_as_alone_and_pooled(fruit, tmp_path):
    """Pears and oranges are scored. The oranges a and c are a mesh."""
    labels = ["pear", "orange"]
    model, classes, folder = fruit
    write_table(folder, mesh=["m" if item.letter in "ac" else "" for item in FRUIT])
    predictor = scoring.Predictor(model, classes)
    points = scoring.choose_operating_points(predictor, folder, labels, 0.4)
    summary = evaluate(*fruit, labels, tmp_path / "both", by="mesh", points=points)
    for point in points:
        alone = evaluate(*fruit, point.label, tmp_path / point.label, points=[point])
        part = summary["by_label"][point.label] | {"n": alone["n"]}
        assert summary["by_label"][point.label]["n"] == 10
        assert part == {name: alone[name] for name in part}
        assert {*METRICS[:2], "auc"} < {*part}

    everything = pooled_auc(labels, "abcdehij")
    shop = pooled_auc(labels, "hi", source="shop")
    assert summary["auc"]["value"] == pytest.approx(everything, abs=1e-12)
    assert summary["by_mesh"]["m"]["auc"]["value"] == pytest.approx(pooled_auc(labels, "ac"))
    assert summary["by_source"]["shop"]["auc"]["value"] == pytest.approx(shop, abs=1e-12)

    # An image counts once for each class.
    best = [(item, item.ranking[0]) for item in FRUIT]
    false_positives = sum(name in labels and not item.is_of(name) for item, name in best)
    assert counts(summary["recall"]) == counts(wilson(2, 8))
    assert counts(summary["false_positive_rate"]) == counts(wilson(false_positives, 12))
    expected = {"photographs": 10, "positives": 8, "negatives": 12}
    assert summary["n"].items() >= expected.items()
    # Hits at the thresholds of the classes add up, too.
    for name in AT_THRESHOLD:
        hits = [part[name]["hits"] for part in summary["by_label"].values()]
        assert summary[name]["hits"] == sum(hits)


def test_the_score_is_the_log_odds_also_if_the_probability_rounds_to_0_or_1(known_model, tmp_path):
    logits = [[0, 100, 3], [0, -900, 3], [1, 2, 3], [0, -4000, -5000]]
    names = [f"{index}.png" for index in range(4)]
    evaluate(*known_model(names, logits, ["a", "b", "c"]), "b", tmp_path)
    predictions = read_predictions(tmp_path / "predictions.csv", "b")
    expected = [100 - logsumexp([0, 3]), -900 - logsumexp([0, 3]), 2 - logsumexp([1, 3]), -4000]
    assert predictions.log_odds == pytest.approx(expected, rel=1e-15)
    assert predictions.label_rank.tolist() == [1, 3, 2, 2]


def test_predictions_have_the_probabilities_and_ranks_of_a_sorted_softmax(known_model, tmp_path):
    names = []
    for label in ("orange", "other_x", "plum"):
        names += [f"{label}/{index}.png" for index in range(4)]
    logits = np.random.default_rng(0).normal(0, 3, (12, 6)).astype(np.float32)
    evaluate(*known_model(names, logits, FRUIT_CLASSES), "orange", tmp_path)

    predictions = read_predictions(tmp_path / "predictions.csv", "orange")
    for index, (name, row) in enumerate(zip(names, logits.astype(float), strict=True)):
        prediction = predictions[index]
        label, _ = name.split("/")
        probabilities = dict(zip(FRUIT_CLASSES, softmax(row), strict=True))
        ranking = sorted(FRUIT_CLASSES, key=probabilities.get, reverse=True)
        is_known = label in FRUIT_CLASSES
        best = ranking[0]
        assert str(prediction.photograph.path) == name
        assert prediction.photograph.label == label
        assert prediction.predicted == best
        assert prediction.label_rank == ranking.index("orange") + 1
        assert prediction.true_rank == (ranking.index(label) + 1 if is_known else np.inf)
        assert prediction.probability == pytest.approx(probabilities[best], rel=1e-12)
        assert prediction.label_probability == pytest.approx(probabilities["orange"], rel=1e-12)
        if is_known:
            assert prediction.true_probability == pytest.approx(probabilities[label], rel=1e-12)
        else:
            assert np.isnan(prediction.true_probability)


@pytest.mark.parametrize("place", [0, 4, 5])
def test_a_tie_of_all_classes_goes_to_the_first_class(known_model, tmp_path, place):
    # A sort that is not stable changes the order of so many classes.
    classes = [f"class {index}" for index in range(300)]
    undecided = known_model(["a.png"], np.zeros((1, 300)), classes)
    summary = evaluate(*undecided, classes[place], tmp_path)
    assert summary["recall"]["value"] == (place == 0)
    assert summary["top5"]["value"] == (place < 5)


def test_photographs_that_cannot_be_read_are_counted_and_named_if_they_are_skipped(fruit, tmp_path):
    *_, folder = fruit
    (folder / "orange" / "broken.jpg").touch()
    (folder / "orange" / "photo.HEIC").touch()
    scores = scored(*fruit, "orange", tmp_path, skip_unreadable=True)
    summary = scores.to_summary()
    assert summary["unreadable"] == ["orange/broken.jpg"]
    assert summary["n"] == COUNTS | {"unreadable": 1, "left_out": 1}
    for text in (scoring.format_scores(scores), str(scores)):
        assert "orange/broken.jpg" in text
        assert "orange/photo.HEIC" in text


@pytest.mark.parametrize(
    ("logits", "message"),
    [
        (torch.zeros(10), r"must return logits \(10, 6\)"),
        (torch.full((6,), torch.nan), "NaN or infinite logits"),
    ],
)
def test_a_model_with_other_or_infinite_logits_is_refused(fruit, tmp_path, logits, message):
    _, classes, folder = fruit
    with pytest.raises(InputError, match=message):
        evaluate(lambda x: logits.expand(len(x), -1), classes, folder, "orange", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["photos", "link/out", "new/../photos/out"])
def test_scores_are_never_written_among_the_photographs(fruit, tmp_path, out):
    *_, folder = fruit
    (tmp_path / "link").symlink_to(folder)
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError, match=r"^out="):
        evaluate(*fruit, "orange", tmp_path / out)
    assert sorted(folder.rglob("*")) == before


# Each name is, or begins or ends like, a column of predictions.csv, or needs quotes in it.
AWKWARD_CLASSES = [
    *("true", "True", "false", "label", "path", "predicted", "probability", "probability_of"),
    *("rank", "of_true", "a,b", 'say "a"', "two\nlines", "", "true_probability", "null", "nan"),
]


def test_columns_of_any_class_name_are_read_bit_by_bit(tmp_path):
    logits = 300 * torch.randn(5, len(AWKWARD_CLASSES), generator=torch.manual_seed(0))
    facts = [("true", "web", ("lab", "studio"), "m")]
    facts += [(name, None, (), None) for name in ("path", "a,b", "two\nlines", "other_x")]
    paths = [PurePosixPath(f"{number}/a, ü.png") for number in range(len(facts))]
    photographs = [Photograph(path, *row) for path, row in zip(paths, facts, strict=True)]
    predictions = scoring.rank_classes(photographs, logits, AWKWARD_CLASSES, AWKWARD_CLASSES)
    write_predictions(tmp_path / "a.csv", predictions)
    found = read_predictions(tmp_path / "a.csv", AWKWARD_CLASSES)
    for column, values in vars(predictions).items():
        np.testing.assert_array_equal(getattr(found, column), values)


# Colors of the frames of true positives, false negatives and false positives.
FRAMES = [(46, 158, 91), (208, 59, 59), (232, 163, 23)]
FRAME_AREA = (IMAGE_SIZE + 2 * FRAME_WIDTH) ** 2 - IMAGE_SIZE**2


def test_the_contact_sheet_frames_each_hit_miss_and_false_positive(fruit, tmp_path):
    evaluate(*fruit, "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        pixels = np.asarray(sheet)
    areas = np.array([(pixels == color).all(axis=2).sum() for color in FRAMES])
    assert (areas / FRAME_AREA).tolist() == [1, 4, 2]


def test_roc_table_has_the_curve_of_all_photographs_and_of_sources_with_both_kinds(fruit, tmp_path):
    """In the street, the ranks are 6 and 2 for oranges, and 1 and 5 for others."""
    evaluate(*fruit, "orange", tmp_path)
    curves = defaultdict(list)
    thresholds = defaultdict(list)
    with (tmp_path / "roc.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            source = row["source"]
            curves[source].append((float(row["false_positive_rate"]), float(row["recall"])))
            thresholds[source].append(float(row["threshold"]))
    assert curves == {
        "": [(0, 0), (0.4, 0.2), (0.8, 0.6), (1, 0.8), (1, 1)],
        "street": [(0, 0), (0.5, 0), (0.5, 0.5), (1, 0.5), (1, 1)],
    }
    for values in thresholds.values():
        assert values == sorted(values, reverse=True)
        assert values[-1] == -np.inf


def test_without_negatives_the_table_and_the_figure_are_empty(known_model, tmp_path, monkeypatch):
    monkeypatch.undo()
    evaluate(*known_model(["a.png"], [[1, 0]], ["orange", "pear"]), "orange", tmp_path)
    header = "source,false_positive_rate,recall,threshold\n"
    assert (tmp_path / "roc.csv").read_text() == header
    with Image.open(tmp_path / "roc.png") as image:
        image.load()
