import math

from train.photographs.shares import share
from train.report.overview import format_spread, format_table
from train.report.summary import summarize

FIGURES = [
    "orange recognized", "others called orange", "AUC",
    "recall at 5% false alarms", "recall at 10% false alarms", "recall at 20% false alarms",
]  # fmt: skip


def scored(hits: int, n: int, auc: float | None = None) -> dict:
    """A summary of photographs; without `auc` as versions before the ranking wrote it."""
    summary = {"recall": share(hits, n), "false_alarms": share(1, 10)}
    if auc is not None:
        figure = {"value": auc, "low": auc - 0.125, "high": auc + 0.125}
        summary |= {"auc": figure, "recall_at": {"0.05": figure, "0.10": figure, "0.20": {"value": None}}}
    return summary


def test_the_headline_tables_have_a_row_per_run_and_name_the_images(tmp_path, made_up_run, read_markdown, wilson):
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
            ["augment", "seed", *FIGURES],
            ["none", "0", *"------"],
            ["adversarial", "0", wilson(1, 4), wilson(1, 10), *"----"],
        ],
        "photographs": [
            ["augment", "seed", *FIGURES],
            ["none", "0", *"------"],
            ["adversarial", "0", wilson(3, 4), wilson(1, 10), ranked, ranked, ranked, "-"],
        ],
    }
    images = [line for line in text.splitlines() if line.startswith("image")]
    assert images == [f"image: {with_photographs}/{name}/contact_sheet.png" for name in ("lab", "photographs")]


def test_a_run_without_photographs_has_one_table(tmp_path, made_up_run, read_markdown):
    assert list(read_markdown(format_table([summarize(made_up_run(tmp_path / "a"))]))) == [""]


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
            ["augment", "train.epochs", "seeds", *FIGURES],
            ["random", "3", "3", spread, "0.100 ± 0.000", spread, spread, spread, "-"],
        ],
    }
    assert format_spread(runs[2:]) == ""


def test_a_number_that_is_none_in_a_file_spreads_to_none(tmp_path, made_up_run):
    """JSON has no NaN and no infinity, but Python reads them."""
    recalled = [share(2, 10), share(2, 10) | {"value": math.nan}, share(2, 10) | {"value": math.inf}]
    runs = [
        summarize(made_up_run(tmp_path / f"{seed}", "none", {"lab": {"recall": recall}}, f"seed={seed}"))
        for seed, recall in enumerate(recalled)
    ]
    assert "nan ± nan" in format_spread(runs[:2]) and "inf ± nan" in format_spread([runs[0], runs[2]])
