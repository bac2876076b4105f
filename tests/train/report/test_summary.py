import json
import math
from shutil import copytree

import pytest
from omegaconf import OmegaConf
from scipy.stats import binomtest

from renderer.errors import InputError
from train.photographs import share
from train.report.summary import format_spread, format_table, publish_run, summarise
from train.run_folder import checkpoint
from train.run_folder.checkpoint import BEST
from train.run_folder.classifier import PUBLISHED, load_run

FIGURES = [
    "orange recognised", "others called orange", "AUC",
    "recall at 5% false alarms", "recall at 10% false alarms", "recall at 20% false alarms",
]  # fmt: skip


def scored(hits: int, n: int, auc: float | None = None) -> dict:
    """A summary of photographs; without `auc` as versions before the ranking wrote it."""
    summary = {"recall": share(hits, n), "false_alarms": share(1, 10)}
    if auc is not None:
        figure = {"value": auc, "low": auc - 0.125, "high": auc + 0.125}
        summary |= {"auc": figure, "recall_at": {"0.05": figure, "0.10": figure, "0.20": {"value": None}}}
    return summary


def interval(hits: int, n: int) -> str:
    low, high = binomtest(hits, n).proportion_ci(method="wilson")
    return f"{hits / n:.3f} [{low:.3f}, {high:.3f}]"


def test_a_summary_has_the_mean_seconds_of_the_epochs_and_the_final_scores(tmp_path, made_up_run):
    run = summarise(made_up_run(tmp_path / "run", "random", None, "seed=3"))
    assert (run.arm, run.config.seed, run.photographs) == ("random", 3, {})
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


def test_the_headline_tables_have_a_row_per_run_and_name_the_images(tmp_path, made_up_run, read_markdown):
    photographs = {"photographs": scored(3, 4, 0.75), "lab": scored(1, 4)}
    with_photographs = made_up_run(tmp_path / "a", "adversarial", photographs)
    text = format_table([summarise(made_up_run(tmp_path / "b")), summarise(with_photographs)])
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
            ["adversarial", "0", interval(1, 4), interval(1, 10), *"----"],
        ],
        "photographs": [
            ["augment", "seed", *FIGURES],
            ["none", "0", *"------"],
            ["adversarial", "0", interval(3, 4), interval(1, 10), ranked, ranked, ranked, "-"],
        ],
    }
    images = [line for line in text.splitlines() if line.startswith("image")]
    assert images == [f"image: {with_photographs}/{name}/contact_sheet.png" for name in ("lab", "photographs")]


def test_a_run_without_photographs_has_one_table(tmp_path, made_up_run, read_markdown):
    assert list(read_markdown(format_table([summarise(made_up_run(tmp_path / "a"))]))) == [""]


def test_tables_show_in_which_settings_runs_differ_and_how_far_seeds_spread(tmp_path, made_up_run, read_markdown):
    """0.2, 0.4 and 0.9 have the mean 0.5 and, by hand, the standard deviation √((0.09 + 0.01 + 0.16) / 2) = 0.361."""
    recalled = {"a": 2, "b": 4, "c": 9, "d": 5}
    settings = {"a": ["seed=0"], "b": ["seed=1"], "c": ["seed=2"], "d": ["seed=0", "train.epochs=9"]}
    runs = [
        summarise(made_up_run(tmp_path / name, "random", {"lab": scored(hits, 10, hits / 10)}, *settings[name]))
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
        summarise(made_up_run(tmp_path / f"{seed}", "none", {"lab": {"recall": recall}}, f"seed={seed}"))
        for seed, recall in enumerate(recalled)
    ]
    assert "nan ± nan" in format_spread(runs[:2]) and "inf ± nan" in format_spread([runs[0], runs[2]])


def test_a_published_run_is_a_network_and_a_card_that_names_no_folder_of_this_machine(
    finished, tmp_path, read_markdown
):
    out = tmp_path / "pretrained" / "tiny-adversarial"
    publish_run(finished, out)
    assert sorted(path.name for path in out.iterdir()) == ["README.md", PUBLISHED]
    network = load_run(out)
    assert network.classes == ("apple", "orange", "pear") and network.function.head.in_features == 64
    card = (out / "README.md").read_text()
    (table,) = read_markdown(card).values()
    rows = dict(table[1:])
    run = summarise(finished)
    assert rows["network"] == "WideResNet-10-1, dropout 0.3"
    assert rows["data"] == "tiny.npz, 10% of training for validation"
    assert rows["augmentation"] == "adversarial; renders each epoch: 4 renders of solid:orange:0, solid:orange:1"
    assert rows["test accuracy"] == f"{run.scores['test/accuracy']:.4f}"
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    assert rows["photographs: orange recognised"] == interval(summary["recall"]["hits"], summary["recall"]["n"])
    auc = summary["auc"]
    assert rows["photographs: AUC"] == f"{auc['value']:.3f} [{auc['low']:.3f}, {auc['high']:.3f}]"
    assert [name for name in rows if name.startswith("photographs: ")] == [f"photographs: {name}" for name in FIGURES]
    assert "run=pretrained/tiny-adversarial photos=" in card
    assert str(finished.parent) not in card and str(tmp_path) not in card


def test_a_card_counts_the_renders_that_the_scene_makes_and_names_the_look_alikes(finished, tmp_path, read_markdown):
    run = copytree(finished, tmp_path / "run")
    config = OmegaConf.load(run / "config.yaml")
    config.scene.look_alikes = ["solid:fruit", {"mesh": "solid:apple", "label": "apple"}, "solid:fruit"]
    config.scene.views, config.scene.backgrounds, config.augment.examples = 3, [0.2, 0.4], None
    OmegaConf.save(config, run / "config.yaml")
    publish_run(run, tmp_path / "published")
    (table,) = read_markdown((tmp_path / "published" / "README.md").read_text()).values()
    shown = "30 renders of solid:orange:0, solid:orange:1 beside 2 × solid:fruit, solid:apple"
    assert dict(table[1:])["augmentation"] == f"adversarial; renders each epoch: {shown}"


def test_the_card_of_a_soup_says_so(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("soup: false", "soup: true"))
    for folder, words in [(finished, "selected on validation"), (run, "of which the mean is kept")]:
        publish_run(folder, tmp_path / "out")
        assert words in (tmp_path / "out" / "README.md").read_text()


def test_a_network_that_cannot_be_built_is_not_published(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    state = checkpoint.load(run / BEST)
    checkpoint.save(run / BEST, state | {"architecture": state["architecture"] | {"width": "wide"}})
    with pytest.raises(InputError, match=r"best\.pt is from another architecture"):
        publish_run(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_without_its_selected_network_is_not_published(tmp_path, made_up_run):
    with pytest.raises(InputError, match=r"best.pt does not exist"):
        publish_run(made_up_run(tmp_path / "run"), tmp_path / "out")


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("config.yaml", "arm: none", "arm: [none]", r"augment\.arm is \['none'\]"),
        ("config.yaml", "\nseed: 0", "\nseed: abc", "seed is abc"),
        ("config.yaml", "\nlabel: orange", "\nlabel: 5", "label is 5"),
        ("metrics.jsonl", '"test/accuracy": ', '"test/accuracy": NaN, "x": ', "test/accuracy is nan"),
        ("metrics.jsonl", '"test/accuracy": ', '"test/accuracy": 7e300, "x": ', r"test/accuracy is 7e\+300"),
    ],
)
def test_what_no_run_wrote_is_refused_before_any_table(made_up_run, tmp_path, file, old, new, reason):
    folder = made_up_run(tmp_path / "run")
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=rf"{folder}: .* is not as `python -m train` wrote it \(.*{reason}"):
        summarise(folder)
