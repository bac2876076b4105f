import ast
import faulthandler
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

ROOT = Path(__file__).parents[2]
EPOCHS = 3

sys.path.append(str(ROOT / "scripts"))
from torture.bench import Bench, Outcome  # noqa: E402
from torture.comparison import compare, differences  # noqa: E402
from torture.interruptions import interrupted, kill  # noqa: E402
from torture.life import PHASES, innermost_phase  # noqa: E402
from torture.page import CONCERNS, failures, merged, page  # noqa: E402
from torture.workshop import Workshop, furnish  # noqa: E402

from train import checkpoint  # noqa: E402
from train.checkpoint import BEST, LAST, PREVIOUS  # noqa: E402
from train.experiment import load_data, run  # noqa: E402
from train.logs import METRICS, RunLog, read_metrics  # noqa: E402


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
            "pictures", "renders/epoch_002.png", id="another picture",
        ),
        pytest.param(
            lambda run: (run / "renders" / "epoch_002.png").unlink(),
            "pictures", "renders/epoch_002.png", id="a lost picture",
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


def test_the_phases_are_told_by_functions_that_exist():
    for file, function in PHASES:
        tree = ast.parse((ROOT / "train" / file).read_text())
        assert function in {None} | {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_a_stack_tells_its_innermost_phase(tmp_path, monkeypatch):
    """Of a real stack: of a checkpoint that is being written."""
    stacks = tmp_path / "stacks"

    def write_stack(descriptor: int) -> None:
        with open(stacks, "w") as file:
            faulthandler.dump_traceback(file)

    monkeypatch.setattr(checkpoint.os, "fsync", write_stack)
    checkpoint.save(tmp_path / LAST, state(1))
    assert innermost_phase(stacks.read_text()) == "checkpoint"


@pytest.mark.parametrize(
    "frames, phase",
    [
        (["fit.py _begin_epoch", "fit.py fit"], "attack"),
        (["fit.py _train", "fit.py fit"], "training"),
        (["evaluation.py evaluate", "fit.py _end_epoch", "fit.py fit"], "evaluation"),
        (["logs.py scalars", "fit.py _report", "fit.py _end_epoch", "fit.py fit"], "log"),
        (["checkpoint.py save", "fit.py _save", "fit.py _end_epoch", "fit.py fit"], "checkpoint"),
        (["evaluation.py evaluate", "experiment.py _test_scores", "experiment.py train_and_score"], "scoring"),
        (["experiment.py prepare", "__main__.py main"], None),
        ([], None),
    ],
)
def test_the_innermost_function_that_is_listed_tells_the_phase(frames, phase):
    lines = [f'  File "/x/train/{frame.split()[0]}", line 7 in {frame.split()[1]}' for frame in ["nn.py f", *frames]]
    assert innermost_phase("\n".join(["Current thread 0x1 (most recent call first):", *lines])) == phase


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
    bench = Bench(Workshop(tmp_path, 5), tmp_path, tmp_path, tmp_path, {"start": 9.0, "training": 3.0, "scoring": 1.0})
    rows = [line for line in page(outcomes, bench, "command").splitlines() if line.startswith("|")]
    assert rows[2:] == [
        "| SIGKILL | 3 | 5 | start-up 1, attack 4 | equal | **faults: 1** | equal | equal | as it should |",
        "| SIGINT | 1 | 1 | log 1 | equal | equal | equal | equal | **faults: 1** |",
        "| disk filled | 0 | - | not done: it needs a privilege | - | - | - | - | - |",
    ]
    assert failures(outcomes) == ["SIGKILL: epoch 2 is lost", "SIGINT: status 1"]


# ---------------------------------------------------------------------------------------- real processes


def test_a_killed_process_is_resumed_to_the_same_end(tmp_path):
    """As one that was not, in this process."""
    workshop, reference = furnish(tmp_path, epochs=EPOCHS), tmp_path / "reference"
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("train", workshop.command(reference)[3:])
    run(config, load_data(config), reference)
    bench = Bench(workshop, tmp_path / "runs", reference, tmp_path / "half", {"training": 0.1})
    outcome = interrupted("SIGKILL", kill, 1, bench, np.random.default_rng(0), since=("training",))
    assert (outcome.runs, outcome.stops.total()) == (1, 1) and "start-up" not in outcome.stops
    assert outcome.faults == {concern: [] for concern in CONCERNS}
    assert len(read_metrics(bench.runs / "sigkill_0")) == EPOCHS + 1


@pytest.mark.slow
def test_the_command_writes_a_table_without_faults(tmp_path):
    settings = ["kills=2", "signals=1", "draws=1", "epochs=8", f"out={tmp_path}/table.md", f"keep={tmp_path}/runs"]
    command = [sys.executable, str(ROOT / "scripts" / "torture.py"), *settings]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "table.md").read_text()
    assert table in done.stdout and "faults" not in table and len(re.findall(r"^\| ", table, re.M)) > 15
