import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from renderer.errors import InputError
from train.report.summary import format_spread, format_table, read_attack, summarize
from train.tables import format_interval, fraction

METRICS = ["recall", "FPR", "AUC", "recall at 5% FPR", "recall at 10% FPR", "recall at 20% FPR"]


@pytest.mark.parametrize("lines", [None, "", '{"epoch": 1}\n', '{"epoch": 1}\n{"test/accuracy": 1'])
def test_a_run_that_is_not_finished_is_an_error(tmp_path, lines):
    if lines is not None:
        (tmp_path / "metrics.jsonl").write_text(lines)
    with pytest.raises(InputError, match=r"holds no finished run: let it finish, or resume it with train.resume=true"):
        summarize(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("config.yaml", "arm: none", "arm: [none]", r"augment\.arm is \['none'\]"),
        ("metrics.jsonl", '"test/accuracy": ', '"test/accuracy": 7e300, "x": ', r"test/accuracy is 7e\+300"),
    ],
)
def test_entries_of_no_run_are_refused(made_up_run, tmp_path, file, old, new, reason):
    folder = made_up_run(tmp_path / "run")
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=rf"{folder}: .* is not as `python -m train` wrote it \(.*{reason}"):
        summarize(folder)


# ------------------------------------------------------------------------------------- tables


def interval(hits: int, n: int) -> str:
    return format_interval(fraction(hits, n))


def scored(hits: int, n: int, auc: float | None = None) -> dict:
    """A summary of photographs, with or without ROC metrics."""
    summary = {"recall": fraction(hits, n), "false_positive_rate": fraction(1, 10)}
    if auc is not None:
        metric = {"value": auc, "low": auc - 0.125, "high": auc + 0.125}
        summary |= {"auc": metric, "recall_at": {"0.05": metric, "0.10": metric, "0.20": {"value": None}}}
    return summary


def test_the_headline_tables_have_a_row_per_run_and_name_the_images(tmp_path, made_up_run, read_markdown):
    photographs = {"photographs": scored(3, 4, 0.75), "lab": scored(1, 4)}
    with_photographs = made_up_run(tmp_path / "a", "adversarial", photographs)
    text = format_table([summarize(made_up_run(tmp_path / "b")), summarize(with_photographs)])
    ranked = "0.750 [0.625, 0.875]"
    assert read_markdown(text) == {
        "": [
            ["augment", "seed", "test accuracy", "seconds per epoch"],
            ["none", "0", "0.765", "7.5"],
            ["adversarial", "0", "0.765", "7.5"],
        ],
        "lab": [
            ["augment", "seed", *METRICS],
            ["none", "0", *"------"],
            ["adversarial", "0", interval(1, 4), interval(1, 10), *"----"],
        ],
        "photographs": [
            ["augment", "seed", *METRICS],
            ["none", "0", *"------"],
            ["adversarial", "0", interval(3, 4), interval(1, 10), ranked, ranked, ranked, "-"],
        ],
    }
    images = [line for line in text.splitlines() if line.startswith("image")]
    assert images == [f"image: {with_photographs}/{name}/contact_sheet.png" for name in ("lab", "photographs")]


def test_tables_show_in_which_settings_runs_differ_and_how_far_seeds_spread(tmp_path, made_up_run, read_markdown):
    """0.2, 0.4 and 0.9 have the mean 0.5 and, by hand, the standard deviation √((0.09 + 0.01 + 0.16) / 2) = 0.361."""
    recalled = {"a": 2, "b": 4, "c": 9, "d": 5}
    settings = {"a": ["seed=0"], "b": ["seed=1"], "c": ["seed=2"], "d": ["seed=0", "train.epochs=9"]}
    runs = [
        summarize(made_up_run(tmp_path / name, "random", {"lab": scored(hits, 10, hits / 10)}, *settings[name]))
        for name, hits in recalled.items()
    ]
    for table in read_markdown(format_table(runs)).values():
        assert [row[:3] for row in table] == [
            ["augment", "train.epochs", "seed"],
            ["random", "3", "0"],
            ["random", "3", "1"],
            ["random", "3", "2"],
            ["random", "9", "0"],
        ]
    spread = "0.500 ± 0.361"
    assert read_markdown(format_spread(runs)) == {
        "": [
            ["augment", "train.epochs", "seeds", "test accuracy"],
            ["random", "3", "3", "0.765 ± 0.000"],
        ],
        "lab": [
            ["augment", "train.epochs", "seeds", *METRICS],
            ["random", "3", "3", spread, "0.100 ± 0.000", spread, spread, spread, "-"],
        ],
    }
    assert format_spread(runs[2:]) == ""


# ------------------------------------------------------------------------------------- attacks

LINE = {
    "example": 0, "label": ["orange", "orange"], "predicted_before": ["orange", "plum"],
    "confidence_before": [0.875, 0.5], "predicted": ["plum", "plum"], "confidence": [0.75, 0.625], "success": True,
    "success_before": False, "steps": 7,
}  # fmt: skip
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=3), lambda inner: st.lists(inner, max_size=3)
)


def write(folder: Path, *lines: dict) -> None:
    (folder / "attack.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_an_attack_counts_successes_on_examples_that_were_correct_before(tmp_path):
    lines = [LINE, {**LINE, "example": 1, "success_before": True}, {**LINE, "example": 2, "success": False}]
    write(tmp_path, *lines, {"checks": {"random_search": 0.5}})
    attack = read_attack(tmp_path)
    assert (attack.successes, attack.correct, attack.checks) == (1, 2, {"random_search": 0.5})
    cells = ("orange", "87.5% orange, 50.0% plum", "75.0% plum, 62.5% plum")
    outcomes = ["success in 7 steps", "wrong before any step", "no success in 7 steps"]
    assert attack.rows == [(number, *cells, outcome) for number, outcome in enumerate(outcomes)]


@given(st.sampled_from([*LINE]), ANYTHING)
def test_a_line_with_any_value_is_read_or_refused_in_one_sentence(tmp_path_factory, key, value):
    folder = tmp_path_factory.mktemp("attack")
    write(folder, LINE | {key: value})
    try:
        read_attack(folder)
    except InputError as error:
        assert str(error).startswith(f"{folder / 'attack.jsonl'} is damaged or was written by no attack (")
