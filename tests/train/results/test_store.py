import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from renderer.errors import InputError
from tests.train.helpers import read_markdown
from train.results.compare import format_comparison
from train.results.store import finished_runs, group_by_method, summarize
from train.results.tables import format_interval, fraction


@pytest.mark.parametrize("lines", [None, "", '{"epoch": 1}\n{"test/accuracy": 1'])
def test_a_run_that_is_not_finished_is_an_error(tmp_path, lines):
    if lines is not None:
        (tmp_path / "metrics.jsonl").write_text(lines)
    with pytest.raises(InputError, match="holds no finished run"):
        summarize(tmp_path)


@pytest.mark.parametrize("task", ["detection", "segmentation"])
def test_scores_of_other_tasks_are_not_compared_as_those_of_classifiers(tmp_path, task):
    (tmp_path / "summary.json").write_text(json.dumps({"task": task, "label": ["dog"]}))
    with pytest.raises(InputError, match=f"^runs: {tmp_path} has scores of {task}"):
        finished_runs([tmp_path])


@pytest.fixture(scope="module")
def parent(made_up_run, tmp_path_factory) -> Path:
    """Make up two sweeps, one inside the other, with an unfinished run, and an evaluation."""
    parent = tmp_path_factory.mktemp("runs")
    for name in ("sweep/a", "sweep/inner/b", "sweep/inner/c", "d"):
        made_up_run(parent / name, "random", {}, f"seed={ord(name[-1])}")
    (parent / "sweep/unfinished").mkdir()
    (parent / "sweep/unfinished/metrics.jsonl").write_text('{"epoch": 1}\n')
    (parent / "sweep/photographs").mkdir()
    return parent


@pytest.mark.parametrize(
    ("given", "expected"),
    [("sweep", "abc"), ("sweep/inner/c sweep", "cab"), ("sweep sweep/../d d", "abcd")],
)
def test_runs_below_folders_are_found_once_and_in_the_order_of_the_folders(parent, given, expected):
    runs = finished_runs([parent / name for name in given.split()])
    assert [run.folder.name for run in runs] == [*expected]


@pytest.mark.parametrize("given", [["sweep/unfinished"], ["d", "sweep/photographs"], ["no"]])
def test_runs_are_missed_if_there_are_none_in_one_of_the_folders(parent, given):
    with pytest.raises(InputError, match=f"^runs: {parent / given[-1]} "):
        finished_runs([parent / name for name in given])


@pytest.fixture(scope="module")
def folder(tmp_path_factory, made_up_run) -> Path:
    """Make up runs with recalls 0.2, 0.4 and 0.9 of 3 epochs, and of 0.5 of 9 epochs."""
    folder = tmp_path_factory.mktemp("seeds")
    for hits, *overrides in (2, "seed=0"), (4, "seed=1"), (9, "seed=2"), (5, "train.epochs=9"):
        summary = {"images": "same", "label": "orange", "recall": asdict(fraction(hits, 10))}
        summary["false_positive_rate"] = asdict(fraction(1, 10))
        made_up_run(folder / str(hits), "random", {"lab": summary}, *overrides)
    return folder


def test_seeds_are_rows_above_their_mean_and_columns_have_a_known_value(folder):
    """The deviation of 0.2, 0.4 and 0.9 is √((0.09 + 0.01 + 0.16) / 2) = 0.361."""
    tables = read_markdown(format_comparison(finished_runs([folder])))
    short = "random, epochs=3"
    assert [row[:3] for row in tables["lab"][1:]] == [
        [short, "0", format_interval(fraction(2, 10))],
        [short, "1", format_interval(fraction(4, 10))],
        [short, "2", format_interval(fraction(9, 10))],
        [short, "3 seeds", "0.500 ± 0.361"],
        ["random, epochs=9", "0", format_interval(fraction(5, 10))],
    ]
    assert tables["lab"][4][3:] == ["0.100 ± 0.000"]
    assert tables[""][4][:3] == [short, "3 seeds", "0.765 ± 0.000"]
    _, *rows = tables["settings in which the methods differ"]
    assert rows == [["random, epochs=3", "3"], ["random, epochs=9", "9"]]


def test_copies_of_a_run_count_once_and_a_repetition_with_other_scores_is_kept(
    made_up_run, tmp_path
):
    for name, seed in ("first", 0), ("second", 1), ("copy of first", 0), ("again", 0):
        made_up_run(tmp_path / name, "random", {}, f"seed={seed}")
    (tmp_path / "again/metrics.jsonl").write_text('{"epoch": 1}\n{"test/accuracy": 0.5}\n')
    [runs] = group_by_method(finished_runs([tmp_path])).values()
    assert [(run.folder.name, run.seed) for run in runs] == [
        ("again", 0),
        ("copy of first", 0),
        ("second", 1),
    ]
    folders = [tmp_path / "first", tmp_path / "copy of first"]
    assert [run.folder for run in finished_runs(folders)] == folders[:1]


def test_scores_of_a_run_are_read_and_compared_without_torch(folder):
    program = (
        "import sys; from pathlib import Path\n"
        "from train.results.compare import format_comparison, format_short_comparison\n"
        "from train.results.store import finished_runs\n"
        "runs = finished_runs([Path(sys.argv[1])])\n"
        "assert len(format_short_comparison(runs)) < len(format_comparison(runs))\n"
        "assert not {'torch', 'augment.attacks'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", program, folder], check=True)
