import re
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from PIL import Image

import norm_balls as nb
from tests.train.helpers import evaluation_of, ranked, read_markdown
from train.results import compare as comparison
from train.results.metrics import Pool
from train.results.page import write_report
from train.results.predictions import Predictions, write_predictions
from train.results.store import ScoredRun, summarize

# Scores of oranges and scores of other things, by source.
Scores = dict[str | None, tuple[Sequence[float], Sequence[float]]]

STUDIO_AND_WEB: Scores = {
    "studio": ([1, 1, 1, 1], []),
    "web": ([1, -1, -1, -1, -1], [-2, 3]),
    None: ([1, -1], []),
}


# Rows of predictions: the class that is shown, the source, and the score of orange.
Rows = list[tuple[str, str | None, float]]


def rows_of(scores: Scores) -> Rows:
    rows = []
    for source, groups in scores.items():
        for label, group in zip(("orange", "other_lime"), groups, strict=True):
            rows += [(label, source, score) for score in group]
    return rows


def predictions_of(rows: Rows, other: str = "pear") -> Predictions:
    """Make the predictions of a network that knows two fruits, by the sign of the score."""
    labels, sources, scores = zip(*rows, strict=True)
    return ranked(labels, [[score, 0.0] for score in scores], ["orange", other], sources=sources)


@pytest.fixture
def scored_run(tmp_path, made_up_run, monkeypatch) -> Callable[..., Path]:
    # Tests do not look at figures, and saving them is slow.
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **options: None)

    def make(method: str, scores: Scores, *overrides: str, name: str = "photographs") -> Path:
        predictions = predictions_of(rows_of(scores))
        summary = Pool(predictions).metrics.to_summary()
        summary["images"] = str([*predictions.photograph])
        summary["label"] = "orange"
        run_count = len(list(tmp_path.iterdir()))
        folder = made_up_run(tmp_path / str(run_count), method, {name: summary}, *overrides)
        write_predictions(folder / name / "predictions.csv", predictions)
        return folder

    return make


def test_agreement_with_the_original_is_no_test_accuracy(scored_run):
    labeled = scored_run("none", STUDIO_AND_WEB)
    other = scored_run("random", STUDIO_AND_WEB, "data=unlabeled", f"unlabeled={labeled}")
    for folders, accuracies in (([labeled, other], 1), ([labeled], 1), ([other], 1)):
        text = comparison.format_short_comparison([summarize(folder) for folder in folders])
        title = "test accuracy" if labeled in folders else "agreement with the original"
        (rows,) = read_markdown(text).values()
        column = rows[0].index(title)
        assert sum(row[column] != "-" for row in rows[1:]) == accuracies


def compare(folders: list[Path]) -> dict[str, list[list[str]]]:
    """Read the tables that compare the runs in some folders, by the title before the intervals."""
    tables = read_markdown(comparison.format_comparison([summarize(folder) for folder in folders]))
    return {title.partition(", 95%")[0]: rows for title, rows in tables.items()}


def differences(folders: list[Path], name: str = "photographs") -> dict[str, list[list[str]]]:
    """Read the differences on a folder of photographs by the pair of methods, without the pair."""
    _, *rows = compare(folders)[f"{name}: differences on the same images"]
    return {pair: [row[1:] for row in rows if row[0] == pair] for pair, *_ in rows}


def test_a_report_has_top_1_by_class_of_each_network(scored_run):
    def with_pears(correct: int) -> Predictions:
        pears = [("pear", "web", -1 if number < correct else 1) for number in range(10)]
        return predictions_of(rows_of(STUDIO_AND_WEB) + pears)

    group = {}
    for method, correct in (("none", 3), ("random", 7)):
        folder = scored_run(method, STUDIO_AND_WEB)
        write_predictions(folder / "photographs" / "predictions.csv", with_pears(correct))
        group[method] = [ScoredRun(summarize(folder), "photographs")]
    table = comparison.group_table(comparison.read_evaluations(group), "class")
    column = table.header.index("top-1, mean over classes")
    shown = {(row[0], row[1]): row[column].partition(" ")[0] for row in table.rows}
    expected = {"orange": ("0.545", "0.545"), "pear": ("0.300", "0.700"), "other_lime": ("-", "-")}
    assert len(shown) == 2 * (len(expected) + 1)
    for name, values in expected.items():
        assert (shown[name, "none"], shown[name, "random"]) == values


def test_a_comparison_shows_every_source_and_the_total(scored_run, made_up_run, tmp_path):
    better_on_web = STUDIO_AND_WEB | {"web": ([4, 4, 4, -1, -1], [-2, 3])}
    first = scored_run("none", STUDIO_AND_WEB)
    second = scored_run("adversarial", better_on_web, "seed=1")
    tables = compare([first, second, made_up_run(tmp_path / "without_scores", "random")])
    _, first, *_ = tables["photographs: differences on the same images"]
    assert first[0] == "adversarial minus none (1 and 1 seeds)"  # The seeds make no pairs.
    _, *rows = tables["photographs: by source"]
    groups = product(("all", "studio", "web"), ("none", "adversarial"))
    assert [tuple(row[:2]) for row in rows] == [*groups]
    recalls = [row[2].partition(" ")[0] for row in rows]
    assert recalls == ["0.545", "0.727", "1.000", "1.000", "0.200", "0.600"]
    # The studio has nothing to rank oranges against.
    aucs = [row[4].partition(" ")[0] for row in rows]
    assert aucs == ["0.500", "0.636", "-", "-", "0.500", "0.800"]


def test_only_scores_on_the_same_images_share_a_plot_and_a_table(scored_run, tmp_path):
    scores = {"none": ([1, -1], [0, 2]), "random": ([1, -1], [0, -2]), "adversarial": ([1], [0])}
    folders = [scored_run(method, {"web": values}) for method, values in scores.items()]
    text = write_report(folders, tmp_path / "out")[0].read_text()
    plots = re.findall(r'alt="ROC of [^;]*; AUC: ([^"]*)"', text)
    assert plots == ["none 0.250, random 0.750", "adversarial 1.000"]
    assert re.findall(r"(\w+) minus (\w+)", text) == [("random", "none")]
    assert text.count("the network “none” recognizes") == 1
    text = comparison.format_comparison([summarize(folder) for folder in folders])
    methods = []
    for title, (_, *rows) in read_markdown(text).items():
        if title.startswith("photographs: ") and " images of orange" in title:
            methods.append([row[0] for row in rows])
    assert methods == [["none", "random"], ["adversarial"]]


@pytest.mark.parametrize(
    ("modes", "is_run", "trained"),
    [("none random", True, "random"), ("none random", False, ""), ("none none", True, "")],
)
def test_a_report_tells_what_was_trained_with_renders_and_on_which_images_networks_were_scored(
    scored_run, tmp_path, modes, is_run, trained
):
    folders = []
    for index, mode in enumerate(modes.split()):
        folder = scored_run(mode, STUDIO_AND_WEB, f"train.epochs={index + 2}", name="images")
        folders.append(folder if is_run else folder / "images")
    text = write_report(folders, tmp_path / "out")[0].read_text()
    assert re.findall("renders: ([^<,]*)", re.search("<title>.*", text)[0]) == trained.split()
    assert ("“images”" in text) == is_run


def test_the_short_table_says_how_many_runs_its_scores_are_of(scored_run, made_up_run, tmp_path):
    scored = scored_run("none", STUDIO_AND_WEB)
    other = made_up_run(tmp_path / "unscored", "none", {}, "seed=1")
    text = comparison.format_short_comparison([summarize(scored), summarize(other)])
    ((header, row),) = read_markdown(text).values()
    assert row[header.index("runs")] == "1 scored of 2"


class TestAHardenedNetwork:
    @pytest.fixture
    def initial(self, scored_run) -> Path:
        return scored_run("none", {"web": ([1, -1, -1, -1], [0, 2])}) / "photographs"

    @pytest.fixture
    def hardened(self, scored_run, initial) -> list[Path]:
        """Make two runs that start from the network, with its scores before training."""
        oranges = {"random": [1, 1, -1, -1], "adversarial": [1, 1, 1, 1]}
        folders = []
        for method, scores in oranges.items():
            folder = scored_run(method, {"web": (scores, [0, 2])}, "network=base")
            copytree(initial, folder / "before" / "photographs")
            log = folder / "metrics.jsonl"
            before = '"test/accuracy_before": 0.5, "test/epoch"'
            log.write_text(log.read_text().replace('"test/epoch"', before))
            folders.append(folder)
        return folders

    def test_stands_beside_its_initial_network_in_all_tables(self, initial, hardened, tmp_path):
        _, *rows = compare(hardened)[""]
        accuracies = [["", "0.500"], ["0", "0.765"], ["0", "0.765"]]
        assert [row[0] for row in rows] == ["the initial network", "random", "adversarial"]
        assert [row[1:3] for row in rows] == accuracies
        text = comparison.format_short_comparison([summarize(hardened[0])])
        ((header, *rows),) = read_markdown(text).values()
        assert [row[0] for row in rows] == ["before hardening", "after hardening"]
        assert [row[header.index("recall")] for row in rows] == ["0.250", "0.500"]
        found = differences(hardened)
        assert {pair.partition(" (")[0]: rows[0][1][:6] for pair, rows in found.items()} == {
            "random minus the initial network": "+0.250",
            "adversarial minus the initial network": "+0.750",
            "adversarial minus random": "+0.500",
        }
        # A folder of scores takes the place of a run.
        folder = copytree(initial, tmp_path / "scores" / "base")
        found = differences([folder, hardened[1]])
        ((_, recall, *_), *_) = found["adversarial minus scores/base (1 and 1 seeds, paired)"]
        assert recall.startswith("+0.750")

    def test_began_with_one_network_on_any_folders_unless_the_weights_differ(self, hardened):
        for folder in (hardened[1], hardened[1] / "before"):
            summary = copytree(folder / "photographs", folder / "more") / "summary.json"
            text = summary.read_text()
            summary.write_text(re.sub('"images": ".*?"', '"images": "others"', text))
        assert [row[0] for row in compare(hardened)[""]].count("the initial network") == 1
        more = differences(hardened, "more")
        assert "adversarial minus the initial network (1 and 1 seeds, paired)" in more
        config = hardened[1] / "config.yaml"
        text = config.read_text()
        assert "\nweights: null" in text
        config.write_text(text.replace("\nweights: null", "\nweights: other.pth", 1))
        names = [row[0] for row in compare(hardened)[""] if row[0].startswith("the initial")]
        assert len(names) == 2 and "weights=other.pth" in "".join(names)


def test_without_the_metric_of_one_seed_there_is_no_difference(scored_run):
    def evaluations(method: str, *others: list[int]) -> list[comparison.Evaluation]:
        """Evaluate seeds by their scores of other things. An orange has a score of 1."""
        found = []
        for seed, negatives in enumerate(others):
            scores = {"web": ([1, 1], negatives)}
            run = summarize(scored_run(method, scores, f"seed={seed}"))
            found.append(comparison.Evaluation(run, Pool(predictions_of(rows_of(scores)))))
        return found

    lacking, whole = evaluations("random", [2, 0], []), evaluations("none", [2, 2], [2, 2])
    for pair in ((lacking, whole), (whole, lacking)):
        assert comparison.difference(*pair, comparison.ALL, "auc") is None
    first = comparison.difference(lacking[:1], whole[:1], comparison.ALL, "auc")
    assert (first.before, first.value, first.after) == (0, 0.5, 0.5)


def test_classes_that_are_named_in_another_order_are_compared(tmp_path):
    classes = ["red", "green", "blue"]
    draws = np.random.default_rng(0)
    for name in classes:
        (tmp_path / "photos" / name).mkdir(parents=True)
        for number in range(12):
            pixels = draws.integers(0, 256, (4, 4, 3), np.uint8)
            Image.fromarray(pixels).save(tmp_path / "photos" / name / f"{number}.png")
    runs = []
    for labels in (["red", "blue"], ["blue", "red"]):
        out = tmp_path / labels[0]
        given = {"classes": classes, "size": 4, "out": out}
        nb.evaluate(lambda images: images.mean((2, 3)), tmp_path / "photos", labels, **given)
        runs.append(summarize(out))
    [group] = comparison.group_by_images(comparison.store.group_by_method(runs)).values()
    one, other = comparison.read_evaluations(group).values()
    gain = comparison.difference(one, other, comparison.ALL, "auc")
    assert gain.value == 0 and gain.high < 0.2


@pytest.mark.parametrize("apples", [7, 5])
def test_networks_with_different_classes_have_no_difference_of_top_1_on_different_images(apples):
    rows = [(*shown, 1.0) for shown in [("orange", "web")] * 9 + [("pear", "web")] * 7]
    rows += [("apple", "web", -1.0)] * apples
    one, same, other = (
        [evaluation_of(predictions_of(rows, name))] for name in ("pear", "pear", "apple")
    )
    for metric in ("class_top1", "class_top5"):
        assert comparison.difference(other, one, comparison.ALL, metric) is None
        assert comparison.difference(same, one, comparison.ALL, metric).value == 0
    assert comparison.difference(other, one, comparison.ALL, "recall").value == 0


def test_a_difference_of_three_seeds_is_that_of_their_means_and_paired(scored_run):
    """Score two methods, of which the second one is better, on images of unlike difficulty."""
    generator = np.random.default_rng(0)
    easy_oranges = generator.normal(1, 1, (1, 1, 60))
    easy_others = generator.normal(0, 1, (1, 1, 40))
    method_shift = np.array([0.0, 0.5])[:, None, None]
    shift = method_shift + generator.normal(0, 0.2, (1, 3, 1))  # Each seed has its own shift.
    oranges = easy_oranges + shift + generator.normal(0, 0.3, (2, 3, 60))
    others = easy_others + shift + generator.normal(0, 0.3, (2, 3, 40))
    folders = []
    for row, method in enumerate(("none", "random")):
        for seed in range(3):
            scores = {"web": (oranges[row, seed], others[row, seed])}
            folders.append(scored_run(method, scores, f"seed={seed}"))
    total, web = differences(folders)["random minus none (3 and 3 seeds, paired)"]
    assert web[0] == "web"
    assert total == ["all", *web[1:]]
    # No two scores are equal.
    areas = (oranges[..., :, None] > others[..., None, :]).mean(axis=(1, 2, 3))
    recalls = (oranges > 0).mean(axis=(1, 2))
    found = [float(cell.partition(" ")[0]) for cell in (web[1], web[3])]
    expected = [recalls[1] - recalls[0], areas[1] - areas[0]]
    assert found == pytest.approx(expected, abs=5.1e-4)  # The table has three digits.
