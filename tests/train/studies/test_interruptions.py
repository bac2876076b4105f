import re
import shutil
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
import torch

from train.command_line.configuration import composed
from train.experiment import load_data, run
from train.run_folder import checkpoint
from train.run_folder.checkpoint import BEST, LAST, PREVIOUS
from train.run_folder.logs import METRICS, RunLog, read_metrics
from train.studies.commands import finish, start
from train.studies.interruptions.cases import Outcome, interrupted, kill
from train.studies.interruptions.comparison import differences
from train.studies.interruptions.runs import CHANGED, DOOR, Bench
from train.studies.interruptions.study import page
from train.studies.reliability.corpus import write_inputs

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


# ---------------------------------------------------------------------------------------- the comparison


@pytest.mark.parametrize(
    "disturb, fault",
    [
        pytest.param(lambda run: None, None, id="nothing"),
        pytest.param(
            edit_state(LAST, lambda state: next_float(state["model"]["w"])),
            "last.pt: model", id="one bit of a weight",
        ),
        pytest.param(
            edit_state(LAST, lambda state: next_float(state["optimizer"][0][0])),
            "last.pt: optimizer", id="one bit of the optimizer",
        ),
        pytest.param(
            edit_state(BEST, lambda state: next_float(state["model"]["w"])),
            "best.pt: model", id="one bit of the best weights",
        ),
        pytest.param(
            edit_state(LAST, lambda state: state["history"][1].update({"train/loss": 0.25})),
            "last.pt: history", id="the history",
        ),
        pytest.param(
            edit_state(LAST, lambda state: state["history"][1].update({"seconds/attack": 0.25})),
            None, id="the history's seconds",
        ),
        pytest.param(
            lambda run: rewrite(run / PREVIOUS, lambda content: content[:-100]),
            "previous.pt is damaged", id="a damaged previous checkpoint",
        ),
        pytest.param(
            lambda run: (run / BEST).unlink(), "best.pt does not exist", id="a lost checkpoint"
        ),
        pytest.param(
            lambda run: (run / "last.tmp").touch(), "last.tmp is left over", id="a half-written file"
        ),
        pytest.param(edit_line(1, lambda line: []), "epoch 2 is lost", id="a lost line"),
        pytest.param(edit_line(1, lambda line: [line, line]), "epoch 2 is doubled", id="a doubled line"),
        pytest.param(edit_line(EPOCHS, lambda line: []), "epoch scores is lost", id="lost scores"),
        pytest.param(
            edit_line(EPOCHS, lambda line: [line, line]), "epoch scores is doubled", id="doubled scores"
        ),
        pytest.param(
            edit_line(EPOCHS, lambda line: [line, '{"epoch": 4']), "cut short", id="a line cut short"
        ),
        pytest.param(
            edit_line(1, lambda line: [line.replace("0.5", "0.25", 1)]),
            "metrics.jsonl: other values", id="another loss",
        ),
        pytest.param(
            edit_line(1, lambda line: [re.sub(r"attack.: 0.5", 'attack": 0.25', line)]), None, id="other seconds"
        ),
        pytest.param(
            lambda run: next(run.glob("events*")).unlink(),
            r"train/loss at steps \[\]", id="lost events",
        ),
        pytest.param(show_again, r"train/loss at steps \[1, 2, 3, 3\]", id="a doubled event"),
        pytest.param(
            lambda run: rewrite(run / "renders" / "epoch_002.png", lambda content: content + b"0"),
            "renders/epoch_002.png", id="another image",
        ),
        pytest.param(
            lambda run: (run / "renders" / "epoch_002.png").unlink(),
            "renders/epoch_002.png", id="a lost image",
        ),
    ],
)  # fmt: skip
def test_the_comparison_finds_what_differs_and_nothing_else(reference, tmp_path, disturb, fault):
    run = shutil.copytree(reference, tmp_path / "run")
    disturb(run)
    found = list(differences(run, reference))
    assert bool(found) == bool(fault) and len({each.partition(":")[0] for each in found}) <= 1  # in one place alone
    assert not fault or any(re.search(fault, each) for each in found)


# ---------------------------------------------------------------------------------------- the table


def test_the_table_has_a_row_for_each_case_and_faults_are_listed(tmp_path):
    outcomes = [
        Outcome("SIGKILL", 3, 5),
        Outcome("SIGINT", 1, 1, ["SIGINT: sigint_0: status 1"]),
        Outcome("metrics deleted", 3),
        Outcome("disk filled"),
    ]
    bench = Bench(tmp_path, tmp_path, tmp_path, tmp_path, 5, {None: 9.0, 0: 3.0, 5: 1.0})
    written = page(outcomes, bench, "command")
    assert "5 epochs of 400 ms after 6 s" in " ".join(written.split())
    assert written.endswith("\n\n- SIGINT: sigint_0: status 1\n")
    assert [line for line in written.splitlines() if line.startswith("|")][2:] == [
        "| SIGKILL | 3 | 5 | 0 |",
        "| SIGINT | 1 | 1 | 1 |",
        "| metrics deleted | 3 | - | 0 |",
        "| disk filled | 0 | - | not done: it needs a privilege |",
    ]


# ---------------------------------------------------------------------------------------- real processes


@pytest.mark.slow
def test_a_killed_process_is_resumed_to_the_same_end(tmp_path, monkeypatch):
    """As one that was not, in this process."""
    write_inputs(tmp_path)
    monkeypatch.chdir(tmp_path)
    config = composed("train", DOOR.command(f"train.epochs={EPOCHS}", *CHANGED)[2:])
    reference = Path("reference")
    run(config, load_data(config), reference)
    bench = Bench(tmp_path, tmp_path / "runs", reference, tmp_path / "half", EPOCHS, {0: 0.1})
    outcome = interrupted("SIGKILL", kill, 1, bench, np.random.default_rng(0), since=(0,))
    assert outcome == Outcome("SIGKILL", runs=1, stops=1)
    assert len(read_metrics(bench.runs / "sigkill_0")) == EPOCHS + 1


@pytest.mark.slow
def test_the_command_writes_a_table_without_faults(tmp_path):
    settings = ["kills=2", "signals=1", "draws=1", "epochs=8", f"out={tmp_path}/table.md", f"keep={tmp_path}/runs"]
    done = finish(start(["scripts/check_interruptions.py", *settings], tmp_path, stdout=PIPE, stderr=PIPE), 600)
    assert done.status == 0, done.errors
    table = (tmp_path / "table.md").read_text()
    assert table in done.output and len(re.findall(r"^\| ", table, re.M)) == 15
