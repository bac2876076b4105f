import pytest

from renderer.errors import InputError
from train.report.summary import summarize


def test_a_summary_has_the_mean_seconds_of_the_epochs_and_the_final_scores(tmp_path, made_up_run):
    run = summarize(made_up_run(tmp_path / "run", "random", None, "seed=3"))
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
        summarize(tmp_path)


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
        summarize(folder)
