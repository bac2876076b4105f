import re
from pathlib import Path, PurePosixPath
from shutil import copytree

import numpy as np
import pytest

from renderer.errors import InputError
from train.data.photographs import Photograph
from train.evaluation.scores.metrics import pool
from train.evaluation.scores.predictions import Prediction, write_predictions
from train.report.comparison import format_comparison, format_table
from train.report.report_page import write_report
from train.report.summary import summarize


def prediction(index: int, label: str, source: str | None, score: float) -> Prediction:
    """Of a network that predicts orange above a score of 0."""
    orange = score > 0
    photograph = Photograph(PurePosixPath(f"{label}/{index:03}.png"), label, source)
    right = orange == (label == "orange")
    rank = (1 if right else 2) if label == "orange" else None
    return Prediction(
        photograph, "orange", "orange" if orange else "pear", 0.5, None, rank, 0.5, 1 if orange else 2, score
    )


@pytest.fixture
def scored_run(tmp_path, made_up_run, monkeypatch):
    """Makes a finished run with scores: by source, those of oranges and of other things."""

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **options: None)  # no test looks at figures

    def make(arm: str, scores: dict[str | None, tuple], *overrides: str, name: str = "photographs") -> Path:
        kinds = [
            (label, source, score)
            for source, pair in scores.items()
            for label, group in zip(("orange", "other_lime"), pair, strict=True)
            for score in group
        ]
        predictions = [prediction(index, *kind) for index, kind in enumerate(kinds)]
        images = {"images": str([item.photograph for item in predictions]), "label": "orange"}
        summaries = {name: pool(predictions).metrics.to_summary() | images}
        folder = made_up_run(tmp_path / f"{len(list(tmp_path.iterdir()))}", arm, summaries, *overrides)
        write_predictions(folder / name / "predictions.csv", predictions)
        return folder

    return make


def compare(read_markdown, folders: list[Path], exclude=(), **keys) -> dict[str, list[list[str]]]:
    return read_markdown(format_comparison([summarize(folder) for folder in folders], exclude, **keys))


ARMS = ["random", "adversarial"]
STUDIO_AND_WEB = {"studio": ([1, 1, 1, 1], []), "web": ([1, -1, -1, -1, -1], [-2, 3]), None: ([1, -1], [])}


def test_a_comparison_shows_every_source_and_pools_all_but_some(scored_run, made_up_run, tmp_path, read_markdown):
    other = {**STUDIO_AND_WEB, "web": ([4, 4, 4, -1, -1], [-2, 3])}
    folders = [scored_run("none", STUDIO_AND_WEB), scored_run("adversarial", other, "seed=1")]
    tables = compare(read_markdown, [*folders, made_up_run(tmp_path / "c", "random")], ["studio"])
    assert [row[:2] for row in tables["by source"][1:]] == [
        [source, arm] for source in ("all but studio", "studio", "web") for arm in ("none", "adversarial")
    ]
    values = [[cell.partition(" ")[0] for cell in row[2:]] for row in tables["by source"][1:]]
    assert [row[0] for row in values] == ["0.286", "0.571", "1.000", "1.000", "0.200", "0.600"]
    # the studio has nothing to rank oranges against
    assert [row[2] for row in values] == ["0.500", "0.714", "-", "-", "0.500", "0.800"]
    assert "adversarial minus none (1 and 1 seeds)" in tables
    seconds = tables["seconds per epoch"]
    assert seconds[1] == ["none", "7.50", "0.75", "4.50", "1.50", "0.75", "0.38", "7.00"]


def test_another_folder_of_photographs_is_compared_by_its_name(scored_run, read_markdown):
    folders = [scored_run(arm, STUDIO_AND_WEB, name="lab") for arm in ("none", "random")]
    assert "random minus none (1 and 1 seeds, paired)" not in compare(read_markdown, folders)
    assert "random minus none (1 and 1 seeds, paired)" in compare(read_markdown, folders, photographs="lab")
    with pytest.raises(InputError, match=r"^photographs=lib: no run has a sub-folder of that name"):
        compare(read_markdown, folders, photographs="lib")
    with pytest.raises(InputError, match="exclude: no photograph is of source 'stdio'; the sources are studio, web"):
        compare(read_markdown, folders, ["stdio"], photographs="lab")


def test_only_scores_on_the_same_images_share_a_table_or_plot(scored_run, tmp_path, read_markdown):
    """Two arms on four images, and a third network on two others in a sub-folder of the same name."""
    runs = [scored_run(arm, {"web": ([1, -1], scores)}) for arm, scores in [("none", [0, 2]), ("random", [0, -2])]]
    runs.append(scored_run("adversarial", {"web": ([1], [0])}))
    text = write_report(runs, tmp_path / "out").read_text()
    assert re.findall(r'alt="ROC; AUC: ([^"]*)"', text) == ["none 0.250, random 0.750", "adversarial 1.000"]
    assert re.findall(r"(\w+) minus (\w+)", text) == [("random", "none")]
    assert text.count("<p>photographs, 2 of orange and 2 of other things, none and random: ") == 1
    tables = read_markdown(format_table([summarize(folder) for folder in runs]))
    arms = {title: [row[0] for row in table[1:]] for title, table in tables.items() if title.startswith("photographs")}
    assert list(arms.values()) == [["none", "random"], ["adversarial"]]


def test_a_hardened_network_is_compared_with_the_one_it_began_with_and_with_others_from_there(
    scored_run, tmp_path, read_markdown
):
    """The first network is scored by each run that begins with it, and once by pnb-evaluate."""
    base = scored_run("none", {"web": ([1, -1, -1, -1], [0, 2])}) / "photographs"
    oranges = {"random": [1, 1, -1, -1], "adversarial": [1, 1, 1, 1]}
    folders = [scored_run(arm, {"web": (oranges[arm], [0, 2])}, "train.init_from=base") for arm in ARMS]
    for folder in folders:
        copytree(base, folder / "before" / "photographs")
        lines = (folder / "metrics.jsonl").read_text()
        added = lines.replace('"test/epoch"', '"test/accuracy_before": 0.5, "test/epoch"')
        (folder / "metrics.jsonl").write_text(added)
    tables = compare(read_markdown, folders)
    assert [row[:3] for row in tables[""][1:]] == [
        ["the initial network", "", "0.500"],
        *([a, "0", "0.765"] for a in ARMS),
    ]
    differences = [(title.partition(" (")[0], table[1][1][:6]) for title, table in tables.items() if "minus" in title]
    initial = "minus the initial network"
    expected = [(f"random {initial}", "+0.250"), (f"adversarial {initial}", "+0.750")]
    assert differences == [*expected, ("adversarial minus random", "+0.500")]
    text = write_report(folders, tmp_path / "out").read_text()
    assert "from 50.0% to 76.5%" in text and ", the initial network and random: " in text
    copytree(base, alone := tmp_path / "scores" / "base")
    tables = compare(read_markdown, [alone, folders[1]])
    assert tables["adversarial minus scores/base (1 and 1 seeds, paired)"][1][1].startswith("+0.750")


def test_runs_scored_on_different_photographs_are_refused_by_name(scored_run, read_markdown):
    first = scored_run("none", STUDIO_AND_WEB)
    second = scored_run("random", {**STUDIO_AND_WEB, "wob": STUDIO_AND_WEB["web"], "web": ((), ())})
    with pytest.raises(InputError, match=f"{second}/photographs has other photographs or sources than {first}"):
        compare(read_markdown, [first, second])


def read_difference(cell: str) -> tuple[float, float, float]:
    return tuple(map(float, re.fullmatch(r"([+-][\d.]+) \[([+-][\d.]+), ([+-][\d.]+)\]", cell).groups()))


@pytest.fixture
def arms(scored_run) -> tuple[list[Path], list[np.ndarray], list[np.ndarray]]:
    """Three seeds of two arms on 60 oranges and 40 others: scores (arm, seed, image) of either kind."""
    generator = np.random.default_rng(0)
    images = [generator.normal(1, 1, (1, 1, 60)), generator.normal(0, 1, (1, 1, 40))]  # easy and hard images
    shift = np.array([0.0, 0.5])[:, None, None] + generator.normal(0, 0.2, (1, 3, 1))  # arm, and a seed's luck
    oranges, others = (image + shift + generator.normal(0, 0.3, (2, 3, image.shape[2])) for image in images)
    folders = [
        scored_run(arm, {"web": (oranges[row, seed], others[row, seed])}, f"seed={seed}")
        for row, arm in enumerate(("none", "random"))
        for seed in range(3)
    ]
    return folders, oranges, others


def auc(oranges: np.ndarray, others: np.ndarray) -> float:
    return (oranges[:, None] > others).mean()  # no two scores are equal


def test_a_difference_is_that_of_the_means_over_seeds_with_the_interval_of_a_bootstrap_written_out(arms, read_markdown):
    """The loop draws images and seeds one replicate at a time; 0.02 is the chance of 1,000 of them."""
    folders, oranges, others = arms
    tables = compare(read_markdown, folders)
    header, pooled, web = tables["random minus none (3 and 3 seeds, paired)"]
    assert header[:4] == ["source", "recall", "FPR", "AUC"]
    assert web[0] == "web" and pooled == ["all", *web[1:]]

    generator, drawn = np.random.default_rng(1), []
    for _ in range(1000):
        seeds, orange, other = (generator.integers(n, size=n) for n in (3, 60, 40))
        recall = (oranges[:, seeds][:, :, orange] > 0).mean(axis=(1, 2))
        ranked = [[auc(oranges[arm, s, orange], others[arm, s, other]) for s in seeds] for arm in (0, 1)]
        drawn.append((recall[1] - recall[0], np.mean(ranked[1]) - np.mean(ranked[0])))
    intervals = np.quantile(drawn, (0.025, 0.975), axis=0).T
    values = [
        (oranges[1] > 0).mean() - (oranges[0] > 0).mean(),
        np.mean([auc(oranges[1, seed], others[1, seed]) - auc(oranges[0, seed], others[0, seed]) for seed in range(3)]),
    ]
    for cell, value, reference in zip((web[1], web[3]), values, intervals, strict=True):
        difference, low, high = read_difference(cell)
        assert difference == pytest.approx(value, abs=5.1e-4)  # printed to three digits
        assert (low, high) == pytest.approx(tuple(reference), abs=0.02)


def test_groups_of_an_arm_are_named_by_the_settings_in_which_they_differ(scored_run, read_markdown):
    radii = [["augment.random_light.radius=1.5"], []]
    folders = [scored_run("none", STUDIO_AND_WEB), *(scored_run("random", STUDIO_AND_WEB, *radius) for radius in radii)]
    titles = set(compare(read_markdown, folders))
    assert {f"random, random light radius={r} minus none (1 and 1 seeds, paired)" for r in (1.5, None)} <= titles
