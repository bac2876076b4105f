"""Runs that are interrupted and resumed end like an uninterrupted run, bit for bit.

Every signal is tried, in processes of their own. Without `-m slow`,
tests/train/training/test_run.py interrupts runs within the process of the tests.
"""

import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from train import checkpoints, run_folder
from train.data.sets import content_hash
from train.run_folder import METRICS, read_metrics

from .conftest import MAX_SECONDS, TRAINING, Process, end, run_here, start_command

pytestmark = pytest.mark.slow

EPOCHS = 8
EPOCH_SECONDS = 0.1  # An epoch takes about as long.
COMMAND = ("train.resume=true", f"train.epochs={EPOCHS}", *TRAINING)
HANDLED = ((signal.SIGTERM,), (signal.SIGINT,))  # A run handles these signals and ends by itself.
KILLED = (signal.SIGKILL,)
TERMINATED_AND_KILLED = (signal.SIGTERM, signal.SIGKILL)  # Batch systems do this.


def start(data: Path, run: Path, epoch: int) -> Process:
    """Start or continue a run in a process, and wait until it has done some epochs."""
    process = start_command("-m", "train", f"out={run}", *COMMAND, folder=data)
    deadline = time.monotonic() + MAX_SECONDS
    while epochs_done(run) < epoch and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    return process


def epochs_done(run: Path) -> int:
    log = run / METRICS
    return log.read_bytes().count(b"\n") if log.exists() else 0


def without_seconds(value: Any) -> Any:
    if isinstance(value, Mapping):
        kept = [key for key in value if not str(key).startswith("seconds/")]
        return {key: without_seconds(value[key]) for key in kept}
    if isinstance(value, list | tuple):
        return [without_seconds(part) for part in value]
    return value


def contents(run: Path) -> dict[str, Any]:
    """Return what the files of a run contain, except for times; checkpoints as hashes."""
    result: dict[str, Any] = {METRICS: without_seconds(read_metrics(run))}
    for name in (run_folder.LAST, run_folder.BEST):
        for part, value in checkpoints.load(run / name).items():
            result[f"{name}: {part}"] = content_hash(without_seconds(value))
    result["half-written"] = sorted(path.name for path in run.glob("**/*.tmp"))
    for folder in ("renders", "photographs"):
        for path in (run / folder).glob("*"):
            result[path.relative_to(run).as_posix()] = path.read_bytes()
    return result


@pytest.fixture(scope="module")
def uninterrupted(data, tmp_path_factory) -> dict[str, Any]:
    run = tmp_path_factory.mktemp("runs") / "uninterrupted"
    assert run_here("train", f"out={run}", *COMMAND, folder=data) == 0
    result = contents(run)
    assert len(result[METRICS]) == EPOCHS + 1
    assert result["half-written"] == []
    return result


def interrupt(data, run, signals, rng) -> None:
    """Continue a run up to a random epoch, send it signals, and check how it ends."""
    done_before = epochs_done(run)
    process = start(data, run, rng.integers(done_before + 1, EPOCHS + 1))
    was_training = True
    for number in signals:
        time.sleep(rng.uniform(0, EPOCH_SECONDS))
        # On a fast machine, the training may have ended during the sleep.
        was_training &= done_before < epochs_done(run) < EPOCHS - 1
        process.send_signal(number)
    status, output, errors = end(process)
    assert "Traceback" not in errors or not was_training
    if was_training and signals in HANDLED and status:
        assert status == 128 + signals[-1]
        assert "train.resume=true" in output


INTERRUPTED_OFTEN = [
    *((KILLED, seed) for seed in range(1, 11)),
    *((signals, seed) for signals in HANDLED for seed in range(1, 6)),
    *((TERMINATED_AND_KILLED, seed) for seed in range(1, 6)),
]


@pytest.mark.parametrize(("signals", "seed"), INTERRUPTED_OFTEN)
def test_a_run_is_resumed_to_the_same_end(data, tmp_path, uninterrupted, signals, seed):
    """The run is interrupted three times."""
    run = tmp_path / "run"
    rng = np.random.default_rng(seed)
    for _ in range(3):
        if epochs_done(run) < EPOCHS:
            interrupt(data, run, signals, rng)
    assert run_here("train", f"out={run}", *COMMAND, folder=data) == 0
    result = contents(run)
    names = result | uninterrupted
    assert [name for name in names if result.get(name) != uninterrupted.get(name)] == []
