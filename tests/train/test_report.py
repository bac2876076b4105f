import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from scipy.stats import binomtest

from renderer.errors import InputError
from train.checkpoint import PUBLISHED, load_network
from train.photographs import share
from train.report import format_comparison, format_spread, format_table, publish_run, summarise

VERSIONS = {"python": "3.11", "torch": "2.6"}


def made_up_run(folder: Path, tiny, arm: str = "none", photographs: dict | None = None, *overrides: str) -> Path:
    """What a finished run of two epochs writes, but for its checkpoints."""
    folder.mkdir()
    config = OmegaConf.to_container(tiny(f"augment={arm}", "seed=0", *overrides), resolve=True)
    OmegaConf.save(OmegaConf.create({**config, "versions": VERSIONS}), folder / "config.yaml")
    seconds = {"attack": 0.5, "attack_classifier": 0.25, "training": 3.0, "evaluation": 1.0, "input_output": 0.5}
    lines = [
        {"epoch": epoch, **{f"seconds/{phase}": epoch * value for phase, value in seconds.items()}} for epoch in (1, 2)
    ]
    lines[0]["seconds/operators"] = 7.0
    lines.append({"test/accuracy": 0.76543, "test/accuracy_last": 0.75, "test/epoch": 2})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if photographs:
        (folder / "photographs").mkdir()
        (folder / "photographs" / "summary.json").write_text(json.dumps(photographs))
    return folder


def scored(by_source: dict[str, tuple[int, int]], untold: tuple[int, int] = (0, 0)) -> dict:
    """A summary of photographs: recall (hits, n) by source and of those whose source is not known."""
    parts = [*by_source.values(), untold]
    return {
        "recall": share(sum(hits for hits, _ in parts), sum(n for _, n in parts)),
        "false_alarms": share(1, 10),
        "by_source": {
            source: {"recall": share(*counts), "false_alarms": share(0, 0)} for source, counts in by_source.items()
        },
    }


def cells(markdown: str) -> list[list[str]]:
    """The rows of a Markdown table, its header first."""
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len({len(line) for line in lines}) == 1 and set(lines[1]) == {"|", "-", " "}
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in [lines[0], *lines[2:]]]


def sections(text: str) -> dict[str, list[list[str]]]:
    """The tables of a comparison by their headings."""
    parts = [part.partition("\n\n") for part in text.removeprefix("### ").split("\n\n### ")]
    return {title: cells(table) for title, _, table in parts}


def interval(hits: int, n: int) -> str:
    low, high = binomtest(hits, n).proportion_ci(method="wilson")
    return f"{hits / n:.3f} [{low:.3f}, {high:.3f}]"


def test_a_summary_has_the_mean_seconds_of_the_epochs_and_the_final_scores(tmp_path, tiny):
    run = summarise(made_up_run(tmp_path / "run", tiny, "random", None, "seed=3"))
    assert (run.arm, run.config.seed, run.photographs) == ("random", 3, None)
    assert run.scores == {"test/accuracy": 0.76543, "test/accuracy_last": 0.75, "test/epoch": 2}
    assert run.seconds == {
        "attack": 0.75, "attack_classifier": 0.375, "training": 4.5, "evaluation": 1.5, "input_output": 0.75,
        "operators": 7.0,
    }  # fmt: skip


@pytest.mark.parametrize("lines", [None, "", '{"epoch": 1}\n', '{"epoch": 1}\n{"test/accuracy": 1'])
def test_a_run_that_is_not_finished_is_an_error(tmp_path, lines):
    if lines is not None:
        (tmp_path / "metrics.jsonl").write_text(lines)
    with pytest.raises(InputError, match=r"holds no finished run: let it finish, or resume it with train.resume=true"):
        summarise(tmp_path)


def test_the_headline_table_has_a_row_per_run_and_names_the_pictures(tmp_path, tiny):
    with_photographs = made_up_run(tmp_path / "a", tiny, "adversarial", scored({"web": (3, 4)}))
    text = format_table([summarise(made_up_run(tmp_path / "b", tiny)), summarise(with_photographs)])
    assert cells(text) == [
        ["augment", "seed", "test accuracy", "orange recognised", "others called orange", "seconds per epoch"],
        ["none", "0", "0.765", "-", "-", "7.5"],
        ["adversarial", "0", "0.765", interval(3, 4), interval(1, 10), "7.5"],
    ]
    pictures = [line for line in text.splitlines() if line.startswith("picture")]
    assert pictures == [f"picture: {with_photographs}/photographs/contact_sheet.png"]


def test_tables_show_in_which_settings_runs_differ_and_how_far_seeds_spread(tmp_path, tiny):
    """0.2, 0.4 and 0.9 have the mean 0.5 and, by hand, the standard deviation √((0.09 + 0.01 + 0.16) / 2) = 0.361."""
    recalled = {"a": 2, "b": 4, "c": 9, "d": 5}
    settings = {"a": ["seed=0"], "b": ["seed=1"], "c": ["seed=2"], "d": ["seed=0", "train.epochs=9"]}
    runs = [
        summarise(made_up_run(tmp_path / name, tiny, "random", scored({"web": (hits, 10)}), *settings[name]))
        for name, hits in recalled.items()
    ]
    assert [row[:3] for row in cells(format_table(runs))] == [
        ["augment", "train.epochs", "seed"],
        ["random", "3", "0"],
        ["random", "3", "1"],
        ["random", "3", "2"],
        ["random", "9", "0"],
    ]
    assert cells(format_spread(runs)) == [
        ["augment", "train.epochs", "seeds", "test accuracy", "orange recognised", "others called orange"],
        ["random", "3", "3", "0.765 ± 0.000", "0.500 ± 0.361", "0.100 ± 0.000"],
    ]
    assert format_spread(runs[2:]) == ""


def test_a_comparison_shows_every_source_and_the_share_without_some(tmp_path, tiny):
    first = made_up_run(tmp_path / "a", tiny, "none", scored({"studio": (4, 4), "web": (1, 5)}, untold=(1, 2)))
    second = made_up_run(tmp_path / "b", tiny, "adversarial", scored({"web": (3, 5)}), "seed=1")
    third = made_up_run(tmp_path / "c", tiny, "random")
    runs = [summarise(path) for path in (first, second, third)]
    tables = sections(format_comparison(runs, exclude=["studio"]))
    assert list(tables) == [
        "Accuracy on the test set",
        "Photographs of orange recognised",
        "Photographs of other things called orange",
        "Seconds per epoch",
    ]
    assert tables["Accuracy on the test set"][1:] == [
        ["none", "0", "0.7654", "2", "0.7500"],
        ["adversarial", "1", "0.7654", "2", "0.7500"],
        ["random", "0", "0.7654", "2", "0.7500"],
    ]
    assert tables["Photographs of orange recognised"] == [
        ["source", "none, seed 0", "adversarial, seed 1"],
        ["studio", interval(4, 4), "-"],
        ["web", interval(1, 5), interval(3, 5)],
        ["all but studio", interval(2, 7), interval(3, 5)],
    ]
    # no source has a photograph of another thing, so their rows are left out
    assert [row[0] for row in tables["Photographs of other things called orange"]] == ["source", "all but studio"]
    assert tables["Seconds per epoch"][1] == ["none", "0.75", "4.50", "1.50", "0.75", "50.0%", "10.0%", "7.00"]


def test_without_exclusions_a_comparison_pools_all_photographs(tmp_path, tiny):
    run = made_up_run(tmp_path / "a", tiny, "none", scored({"studio": (4, 4), "web": (1, 5)}, untold=(1, 2)))
    table = sections(format_comparison([summarise(run)], exclude=[]))["Photographs of orange recognised"]
    assert table[-1] == ["all", interval(6, 11)]


def test_a_mistyped_source_to_exclude_is_an_error(tmp_path, tiny):
    run = made_up_run(tmp_path / "a", tiny, "none", scored({"studio": (4, 4), "web": (1, 5)}))
    with pytest.raises(InputError, match="exclude: no photograph is of source 'stdio'; the sources are studio, web"):
        format_comparison([summarise(run)], exclude=["stdio"])


def test_runs_without_photographs_are_compared_by_accuracy_and_time(tmp_path, tiny):
    run = summarise(made_up_run(tmp_path / "a", tiny))
    assert list(sections(format_comparison([run], []))) == ["Accuracy on the test set", "Seconds per epoch"]


def test_a_published_run_is_a_network_and_a_card_that_names_no_folder_of_this_machine(finished, tmp_path):
    out = tmp_path / "pretrained" / "tiny-adversarial"
    publish_run(finished, out)
    assert sorted(path.name for path in out.iterdir()) == ["README.md", PUBLISHED]
    network = load_network(out)
    assert network.classes == ("apple", "orange", "pear") and network.module.head.in_features == 64
    card = (out / "README.md").read_text()
    rows = dict(cells(card)[1:])
    run = summarise(finished)
    assert rows["network"] == "WideResNet-10-1, dropout 0.3"
    assert rows["data"] == "tiny.npz, 10% of training for validation"
    assert rows["augmentation"] == "adversarial; renders each epoch: 4 renders of solid:orange:0, solid:orange:1"
    assert rows["test accuracy"] == f"{run.scores['test/accuracy']:.4f}"
    recall = run.photographs["recall"]
    assert rows["recall"] == interval(recall["hits"], recall["n"])
    assert "run=pretrained/tiny-adversarial photos=" in card
    assert str(finished.parent) not in card and str(tmp_path) not in card


def test_a_run_without_its_selected_network_is_not_published(tmp_path, tiny):
    with pytest.raises(InputError, match=r"best.pt does not exist"):
        publish_run(made_up_run(tmp_path / "run", tiny), tmp_path / "out")
