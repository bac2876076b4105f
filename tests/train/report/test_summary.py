from dataclasses import asdict

import pytest

from renderer.errors import InputError
from tests.train.helpers import read_markdown
from train.evaluation.tables import format_interval, fraction
from train.report.comparison import format_table
from train.report.summary import summarize


@pytest.mark.parametrize("lines", [None, "", '{"epoch": 1}\n', '{"epoch": 1}\n{"test/accuracy": 1'])
def test_a_run_that_is_not_finished_is_an_error(tmp_path, lines):
    if lines is not None:
        (tmp_path / "metrics.jsonl").write_text(lines)
    with pytest.raises(InputError, match=r"holds no finished run: let it finish, or resume it"):
        summarize(tmp_path)


def test_tables_show_in_which_settings_runs_differ_and_how_far_seeds_spread(tmp_path, made_up_run):
    """0.2, 0.4 and 0.9 have the mean 0.5 and, by hand, the standard deviation √((0.09 + 0.01 + 0.16) / 2) = 0.361."""
    settings = {2: ["seed=0"], 4: ["seed=1"], 9: ["seed=2"], 5: ["seed=0", "train.epochs=9"]}
    runs = []
    for hits, overrides in settings.items():
        scores = {"recall": asdict(fraction(hits, 10)), "false_positive_rate": asdict(fraction(1, 10))}
        summary = {"images": "same", "label": "orange", **scores}
        runs.append(summarize(made_up_run(tmp_path / str(hits), "random", {"lab": summary}, *overrides)))
    tables = read_markdown(format_table(runs))
    first, second = "random, epochs=3", "random, epochs=9"
    assert [row[:3] for row in tables["lab"][1:]] == [
        *([first, str(seed), format_interval(fraction(hits, 10))] for seed, hits in enumerate((2, 4, 9))),
        [first, "3 seeds", "0.500 ± 0.361"],
        [second, "0", format_interval(fraction(5, 10))],
    ]
    assert tables[""][4][:3] == [first, "3 seeds", "0.765 ± 0.000"]
    assert tables["lab"][4][3:] == ["0.100 ± 0.000"]  # without the columns of which nothing is known
    assert tables["settings in which the arms differ"][1:] == [[first, "3"], [second, "9"]]
