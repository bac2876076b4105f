"""Training processes interrupted at random moments: the resumed run ends as the uninterrupted one, bit for bit.

By default one killed run; `-m slow` tries every signal, full disks and damaged files.
"""

import resource
import shutil
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from train.runs import checkpoint
from train.runs.run_log import METRICS, read_metrics
from train.system.hashing import content_hash

from .conftest import PATIENCE, TRAINING, Process, end, run_here, start_command

EPOCHS = 8
EPOCH = 0.1  # seconds: about as long as one takes
COMMAND = ("train.resume=true", f"train.epochs={EPOCHS}", *TRAINING)
ENDED = {(signal.SIGTERM,), (signal.SIGINT,)}  # that the run itself answers


def start(data: Path, run: Path, epoch: int) -> Process:
    """A process that begins the run or goes on with it, at that epoch."""
    process = start_command("-m", "train", f"run={run}", *COMMAND, folder=data)
    deadline = time.monotonic() + PATIENCE
    while epochs_done(run) < epoch and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    return process


def epochs_done(run: Path) -> int:
    return (run / METRICS).read_bytes().count(b"\n") if (run / METRICS).exists() else 0


def without_seconds(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: without_seconds(part) for key, part in value.items() if not str(key).startswith("seconds/")}
    return [without_seconds(part) for part in value] if isinstance(value, list | tuple) else value


def contents(run: Path) -> dict[str, Any]:
    """A run's files, without the seconds: checkpoints by their hashes, metrics, images and predictions."""
    result: dict[str, Any] = {METRICS: without_seconds(read_metrics(run))}
    for name in (checkpoint.LAST, checkpoint.BEST):
        for part, value in checkpoint.load(run / name).items():
            result[f"{name}: {part}"] = content_hash(without_seconds(value))
    result["half-written"] = sorted(path.name for path in run.glob("**/*.tmp"))
    for folder in ("renders", "photographs"):
        result |= {path.relative_to(run).as_posix(): path.read_bytes() for path in (run / folder).glob("*")}
    return result


@pytest.fixture(scope="module")
def uninterrupted(data, tmp_path_factory) -> dict[str, Any]:
    run = tmp_path_factory.mktemp("runs") / "uninterrupted"
    assert run_here("train", f"run={run}", *COMMAND, folder=data) == 0
    result = contents(run)
    assert len(result[METRICS]) == EPOCHS + 1 and result["half-written"] == []
    return result


@pytest.fixture
def assert_resumed(data, uninterrupted, capfd):
    """Resumes a run without further interruption, compares its files, and returns its output."""

    def resumed(run: Path) -> str:
        capfd.readouterr()
        assert run_here("train", f"run={run}", *COMMAND, folder=data) == 0
        result = contents(run)
        assert [name for name in result | uninterrupted if result.get(name) != uninterrupted.get(name)] == []
        return capfd.readouterr().out

    return resumed


@pytest.mark.parametrize(
    "signals, seed",
    [
        ((signal.SIGKILL,), 0),
        *(pytest.param((signal.SIGKILL,), seed, marks=pytest.mark.slow) for seed in range(1, 11)),
        *(pytest.param(signals, seed, marks=pytest.mark.slow) for signals in ENDED for seed in range(1, 6)),
        *(pytest.param((signal.SIGTERM, signal.SIGKILL), seed, marks=pytest.mark.slow) for seed in range(1, 6)),
    ],
)
def test_a_run_ended_by_signals_at_random_moments_is_resumed_to_the_same_end(
    data, tmp_path, assert_resumed, signals, seed
):
    """Batch systems send SIGTERM and soon after SIGKILL."""
    run, rng = tmp_path / "run", np.random.default_rng(seed)
    for _ in range(3 if seed else 1):
        before = epochs_done(run)
        if before >= EPOCHS:
            break
        process = start(data, run, rng.integers(before + 1, EPOCHS + 1))
        training = before < epochs_done(run) < EPOCHS - 1
        for number in signals:
            time.sleep(rng.uniform(0, EPOCH))
            process.send_signal(number)
        status, output, errors = end(process)
        assert errors == "" or not training
        if training and signals in ENDED and status:
            assert status == 128 + number and "train.resume=true" in output
    assert_resumed(run)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="limits of another process are Linux's")
@pytest.mark.parametrize("epoch", [1, 3, 6])
def test_a_disk_without_room_is_one_sentence_and_the_run_goes_on_later(data, tmp_path, assert_resumed, epoch):
    process = start(data, tmp_path / "run", epoch)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (10_000, 10_000))
    status, _, errors = end(process)
    assert status == 2 and errors.startswith("error: ") and errors.count("\n") == 1 and "make room" in errors
    assert_resumed(tmp_path / "run")


@pytest.fixture(scope="module")
def half(data, tmp_path_factory) -> Path:
    """A run that ended in its middle."""
    run = tmp_path_factory.mktemp("runs") / "half"
    process = start(data, run, EPOCHS // 2)
    process.terminate()
    assert end(process)[0] == 128 + signal.SIGTERM
    return run


def flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes(255 - value for value in content[middle : middle + 16]) + content[middle + 16 :]


def cut(content: bytes) -> bytes:
    return content[:-9]


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, damage",
    [
        *((checkpoint.LAST, damage) for damage in (flip, cut, lambda content: b"", None)),
        *((checkpoint.PREVIOUS, flip), (METRICS, cut), (METRICS, None)),
    ],
)
def test_a_run_with_a_damaged_file_reports_it_and_ends_the_same(half, tmp_path, assert_resumed, file, damage):
    run = shutil.copytree(half, tmp_path / "run")
    content = (run / file).read_bytes()
    (run / file).unlink()
    if damage:
        (run / file).write_bytes(damage(content))
    reported = "going on from the one before" if file == checkpoint.LAST else "resumed"
    assert reported in assert_resumed(run)
