import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig

from train.experiment import load_data, run
from train.run_folder import checkpoint
from train.run_folder.checkpoint import BEST, LAST, PREVIOUS
from train.run_folder.logs import METRICS, RunLog, read_metrics
from train.studies.interruptions.bench import Bench, Outcome
from train.studies.interruptions.comparison import compare, differences
from train.studies.interruptions.disturbances import interrupted, kill
from train.studies.interruptions.observed import NAMES, PHASES, observe
from train.studies.interruptions.page import CONCERNS, failures, merged, page
from train.studies.interruptions.small_run import SmallRun, write_inputs

ROOT = Path(__file__).parents[3]
EPOCHS = 3


def state(epoch: int) -> dict:
    weights = torch.arange(4.0) + epoch
    history = [{"epoch": number, "train/loss": 1 / number, "seconds/attack": 0.5} for number in range(1, epoch + 1)]
    return {"model": {"w": weights}, "architecture": {}, "optimizer": {0: [weights / 2]}, "history": history}


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    """The folder of something like a run."""
    folder = tmp_path_factory.mktemp("runs") / "reference"
    folder.mkdir()
    log = RunLog(folder)
    for epoch in range(1, EPOCHS + 1):
        log.renders(torch.full((2, 3, 4, 4), epoch / EPOCHS), epoch)
        log.scalars({"train/loss": 1 / epoch, "seconds/attack": 0.5}, epoch)
        checkpoint.save(folder / LAST, state(epoch), folder / PREVIOUS)
    checkpoint.save(folder / BEST, state(2))
    log.scalars({"test/accuracy": 0.5})
    return folder


def rewrite(path: Path, change) -> None:
    path.write_bytes(change(path.read_bytes()))


def edit_line(number: int, change):
    """What makes of one line of metrics.jsonl those that `change` returns."""

    def edit(run: Path) -> None:
        lines = (run / METRICS).read_text().splitlines(keepends=True)
        lines[number : number + 1] = change(lines[number])
        (run / METRICS).write_text("".join(lines))

    return edit


def edit_state(name: str, change):
    def edit(run: Path) -> None:
        content = checkpoint.load(run / name)
        change(content)
        checkpoint.save(run / name, content)

    return edit


def next_float(values: torch.Tensor) -> None:
    values[3] = torch.nextafter(values[3], torch.tensor(torch.inf))


def show_again(run: Path) -> None:
    """An epoch's event in a second event file that does not say where it goes on."""
    text = (run / METRICS).read_text()
    log = RunLog(run, [{}] * EPOCHS)
    log.scalars({"train/loss": 1 / EPOCHS}, EPOCHS)
    (run / METRICS).write_text(text)


def configured(small: SmallRun, folder: Path) -> DictConfig:
    with initialize_config_module("conf", version_base="1.3"):
        return compose("train", small.overrides(folder))


# ---------------------------------------------------------------------------------------- the comparison


@pytest.mark.parametrize(
    "disturb, concern, fault",
    [
        pytest.param(lambda run: None, None, "", id="nothing"),
        pytest.param(
            edit_state(LAST, lambda state: next_float(state["model"]["w"])),
            "checkpoints", r"last.pt: model: w", id="one bit of a weight",
        ),
        pytest.param(
            edit_state(LAST, lambda state: next_float(state["optimizer"][0][0])),
            "checkpoints", r"last.pt: optimizer: 0\[0\]", id="one bit of the optimiser",
        ),
        pytest.param(
            edit_state(BEST, lambda state: next_float(state["model"]["w"])),
            "checkpoints", r"best.pt: model: w", id="one bit of the best weights",
        ),
        pytest.param(
            edit_state(LAST, lambda state: state["history"][1].update({"train/loss": 0.25})),
            "checkpoints", r"last.pt: history\[1\]: train/loss", id="the history",
        ),
        pytest.param(
            edit_state(LAST, lambda state: state["history"][1].update({"seconds/attack": 0.25})),
            None, "", id="the history's seconds",
        ),
        pytest.param(
            lambda run: rewrite(run / PREVIOUS, lambda content: content[:-100]),
            "checkpoints", "previous.pt is damaged", id="a damaged previous checkpoint",
        ),
        pytest.param(
            lambda run: (run / BEST).unlink(), "checkpoints", "best.pt does not exist", id="a lost checkpoint"
        ),
        pytest.param(
            lambda run: (run / "last.tmp").touch(), "checkpoints", "last.tmp is left over", id="a half-written file"
        ),
        pytest.param(edit_line(1, lambda line: []), "metrics", "epoch 2 is lost", id="a lost line"),
        pytest.param(edit_line(1, lambda line: [line, line]), "metrics", "epoch 2 is doubled", id="a doubled line"),
        pytest.param(edit_line(EPOCHS, lambda line: []), "metrics", "epoch scores is lost", id="lost scores"),
        pytest.param(
            edit_line(EPOCHS, lambda line: [line, line]), "metrics", "epoch scores is doubled", id="doubled scores"
        ),
        pytest.param(
            edit_line(EPOCHS, lambda line: [line, '{"epoch": 4']), "metrics", "cut short", id="a line cut short"
        ),
        pytest.param(
            edit_line(1, lambda line: [line.replace("0.5", "0.25", 1)]),
            "metrics", r"metrics.jsonl\[1\]: train/loss", id="another loss",
        ),
        pytest.param(
            edit_line(1, lambda line: [re.sub(r"attack.: 0.5", 'attack": 0.25', line)]), None, "", id="other seconds"
        ),
        pytest.param(
            lambda run: next(run.glob("events*")).unlink(),
            "TensorBoard", r"train/loss at steps \[\]", id="lost events",
        ),
        pytest.param(show_again, "TensorBoard", r"train/loss at steps \[1, 2, 3, 3\]", id="a doubled event"),
        pytest.param(
            lambda run: rewrite(run / "renders" / "epoch_002.png", lambda content: content + b"0"),
            "images", "renders/epoch_002.png", id="another image",
        ),
        pytest.param(
            lambda run: (run / "renders" / "epoch_002.png").unlink(),
            "images", "renders/epoch_002.png", id="a lost image",
        ),
    ],
)  # fmt: skip
def test_the_comparison_finds_what_differs_and_nothing_else(reference, tmp_path, disturb, concern, fault):
    run = shutil.copytree(reference, tmp_path / "run")
    disturb(run)
    found = {name: faults for name, faults in compare(run, reference).items() if faults}
    assert list(found) == ([concern] if concern else [])
    assert re.search(fault, "\n".join(found.get(concern, [])))


@pytest.mark.parametrize(
    "found, expected, names",
    [
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 2}]}, []),
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}, ["x: a[1]: b"]),
        ({"a": [1]}, {"a": [1, 2]}, ["x: a"]),
        ({"a": 1, "b": 2}, {"a": 1}, ["x: b"]),
        ({"a": 1}, {"a": 1.0}, ["x: a"]),
        (torch.zeros(2), torch.zeros(2, dtype=torch.float64), ["x"]),
        (torch.zeros(2), torch.zeros(3), ["x"]),
        (torch.zeros(2), None, ["x"]),
    ],
)
def test_differences_are_named_by_where_they_are(found, expected, names):
    assert list(differences(found, expected, "x")) == names


# ---------------------------------------------------------------------------------------- where a process is


class Record(list):
    """A byte, and all that it has been."""

    def __init__(self):
        super().__init__([0])
        self.past = []

    def __setitem__(self, place, value):
        super().__setitem__(place, value)
        self.past.append(NAMES[value])


def test_a_run_tells_its_innermost_phase(tmp_path, monkeypatch):
    """From its first epoch to its scores, and after each what it was in before."""
    for functions in PHASES.values():
        for owner, name in functions:
            monkeypatch.setattr(owner, name, getattr(owner, name))  # taken back after the test
    record = Record()
    observe(record)
    config = configured(write_inputs(tmp_path, epochs=2), tmp_path / "run")
    run(config, load_data(config), tmp_path / "run")
    epoch = [
        *("training", "attack", "training", "training", "training"),
        *("evaluation", "log", "evaluation", "log", "evaluation", "training"),
        *("checkpoint", "training") * 2,
    ]
    assert record.past[: len(epoch)] == epoch
    assert record.past[-6:] == ["scoring", "", "scoring", "", "log", ""] and record == [0]


def test_a_function_that_fails_leaves_its_phase(tmp_path, monkeypatch):
    for functions in PHASES.values():
        for owner, name in functions:
            monkeypatch.setattr(owner, name, getattr(owner, name))
    memory = bytearray(1)
    observe(memory)
    with pytest.raises(OSError):
        checkpoint.save(tmp_path / "nowhere" / LAST, state(1))
    assert memory[0] == 0


# ---------------------------------------------------------------------------------------- the table


def test_the_table_has_a_row_for_each_case_and_faults_are_failures(tmp_path):
    good = {concern: [] for concern in CONCERNS}
    outcomes = merged(
        [
            Outcome("SIGKILL", 2, Counter({"attack": 3}), good),
            Outcome("SIGKILL", 1, Counter({"start-up": 1, "attack": 1}), good | {"metrics": ["epoch 2 is lost"]}),
            Outcome("SIGINT", 1, Counter({"log": 1}), good | {"said": ["status 1"]}),
            Outcome("disk filled"),
        ]
    )
    bench = Bench(SmallRun(tmp_path, 5), tmp_path, tmp_path, tmp_path, {"start": 9.0, "training": 3.0, "scoring": 1.0})
    rows = [line for line in page(outcomes, bench, "command").splitlines() if line.startswith("|")]
    assert rows[2:] == [
        "| SIGKILL | 3 | 5 | start-up 1, attack 4 | equal | **faults: 1** | equal | equal | as it should |",
        "| SIGINT | 1 | 1 | log 1 | equal | equal | equal | equal | **faults: 1** |",
        "| disk filled | 0 | - | not done: it needs a privilege | - | - | - | - | - |",
    ]
    assert failures(outcomes) == ["SIGKILL: epoch 2 is lost", "SIGINT: status 1"]


# ---------------------------------------------------------------------------------------- real processes


@pytest.mark.slow
def test_a_killed_process_is_resumed_to_the_same_end(tmp_path):
    """As one that was not, in this process."""
    small, reference = write_inputs(tmp_path, epochs=EPOCHS), tmp_path / "reference"
    config = configured(small, reference)
    run(config, load_data(config), reference)
    bench = Bench(small, tmp_path / "runs", reference, tmp_path / "half", {"training": 0.1})
    outcome = interrupted("SIGKILL", kill, 1, bench, np.random.default_rng(0), since=("training",))
    assert (outcome.runs, outcome.stops.total()) == (1, 1) and "start-up" not in outcome.stops
    assert outcome.faults == {concern: [] for concern in CONCERNS}
    assert len(read_metrics(bench.runs / "sigkill_0")) == EPOCHS + 1


@pytest.mark.slow
def test_the_command_writes_a_table_without_faults(tmp_path):
    settings = ["kills=2", "signals=1", "draws=1", "epochs=8", f"out={tmp_path}/table.md", f"keep={tmp_path}/runs"]
    command = [sys.executable, str(ROOT / "scripts" / "check_interruptions.py"), *settings]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "table.md").read_text()
    assert table in done.stdout and "faults" not in table and len(re.findall(r"^\| ", table, re.M)) > 15
