"""Reports of many runs, in which each is shown or named."""

import time
from pathlib import Path

import pytest

from train.photographs.shares import share
from train.report.write import write_report

SCORES = {"photographs": {"recall": share(4, 10), "false_alarms": share(1, 10)}}


@pytest.mark.parametrize(
    "count, seconds", [(70, 20), pytest.param(1000, 120, marks=pytest.mark.slow)], ids=["70", "1000"]
)
def test_each_of_many_runs_is_shown_or_named_in_bounded_time_and_size(made_up_run, tmp_path, count, seconds):
    """Half of them failed; of the others, five seeds share their settings."""
    one = made_up_run(tmp_path / "one", "adversarial", SCORES)
    files = {path.relative_to(one): path.read_text() for path in one.rglob("*") if path.is_file()}
    config = files[Path("config.yaml")]
    for number in range(count):
        folder = tmp_path / "runs" / f"run{number:04d}"
        (folder / "photographs").mkdir(parents=True)
        if number % 2:
            (folder / "failed.txt").write_text("no room")
            continue
        rate, seed = 0.001 * (1 + number // 10), number // 2 % 5
        files[Path("config.yaml")] = config.replace("seed: 0", f"seed: {seed}").replace(": 0.05\n", f": {rate}\n")
        for path, text in files.items():
            (folder / path).write_text(text)
    start = time.process_time()
    page = write_report([tmp_path / "runs"], tmp_path / "out")
    assert time.process_time() - start < seconds
    text = page.read_text()
    assert len(text) < 10 * 2**20 and f"{count // 2} of {count} runs finished" in text
    missing = [number for number in range(count) if f"/run{number:04d}" not in text]
    assert not missing
