"""Training processes interrupted at random moments: the resumed run ends as the uninterrupted one, bit for bit.

By default one killed run; `-m slow` tries every signal, full disks and damaged files.
"""

import resource
import shutil
import signal
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from train import checkpoint
from train.run_folder import METRICS, read_metrics

from .conftest import PATIENCE, TRAINING, Process, end, run_here, start_command

EPOCHS = 8
EPOCH = 0.1  # seconds: about as long as one takes
COMMAND = ("train.resume=true", f"train.epochs={EPOCHS}", *TRAINING)


def start(inputs: Path, run: Path) -> Process:
    """A process that begins the run or goes on with it."""
    return start_command("-m", "train", f"run={run}", *COMMAND, folder=inputs)


def epochs_done(run: Path) -> int:
    return (run / METRICS).read_bytes().count(b"\n") if (run / METRICS).exists() else 0


def wait_for_epoch(process: Process, run: Path, epoch: int) -> None:
    deadline = time.monotonic() + PATIENCE
    while epochs_done(run) < epoch and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)


def without_seconds(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: without_seconds(part) for key, part in value.items() if not str(key).startswith("seconds/")}
    return [without_seconds(part) for part in value] if isinstance(value, list | tuple) else value


def contents(run: Path) -> dict[str, Any]:
    """What a run leaves behind, without the seconds: checkpoints by their hashes, metrics, images and predictions."""
    states = {name: checkpoint.load(run / name) for name in (checkpoint.LAST, checkpoint.BEST)}
    found: dict[str, Any] = {
        f"{name}: {part}": checkpoint.content_hash(without_seconds(value))
        for name, state in states.items()
        for part, value in state.items()
    }
    found[METRICS] = without_seconds(read_metrics(run))
    found["half-written"] = sorted(path.name for path in run.glob("**/*.tmp"))
    for folder in ("renders", "photographs"):
        found |= {path.relative_to(run).as_posix(): path.read_bytes() for path in (run / folder).glob("*")}
    return found


@pytest.fixture(scope="module")
def uninterrupted(data, tmp_path_factory) -> dict[str, Any]:
    run = tmp_path_factory.mktemp("runs") / "uninterrupted"
    assert run_here("train", f"run={run}", *COMMAND, folder=data) == 0
    found = contents(run)
    assert len(found[METRICS]) == EPOCHS + 1 and found["half-written"] == []
    return found


def assert_as_uninterrupted(data: Path, run: Path, uninterrupted: dict[str, Any]) -> str:
    """Resume without further interruption; the output."""
    status, output, errors = end(start(data, run))
    assert status == 0, errors
    found = contents(run)
    assert [name for name in found.keys() | uninterrupted.keys() if found.get(name) != uninterrupted.get(name)] == []
    return output


# ---------------------------------------------------------------------------------------- signals


@pytest.mark.parametrize(
    "number, seed",
    [
        (signal.SIGKILL, 0),
        *(pytest.param(signal.SIGKILL, seed, marks=pytest.mark.slow) for seed in range(1, 11)),
        *(
            pytest.param(number, seed, marks=pytest.mark.slow)
            for number in (signal.SIGTERM, signal.SIGINT)
            for seed in range(5)
        ),
    ],
)
def test_a_run_ended_by_signals_at_random_moments_is_resumed_to_the_same_end(
    data, tmp_path, uninterrupted, number, seed
):
    run, rng = tmp_path / "run", np.random.default_rng(seed)
    for _ in range(3 if seed else 1):
        before = epochs_done(run)
        if before >= EPOCHS:
            break
        process = start(data, run)
        wait_for_epoch(process, run, rng.integers(before + 1, EPOCHS + 1))
        time.sleep(rng.uniform(0, EPOCH))
        training = before < epochs_done(run) < EPOCHS - 1
        process.send_signal(number)
        status, output, errors = end(process)
        if number == signal.SIGKILL:
            assert status in (-number, 0)
        elif training:
            assert (status, errors) == (128 + number, "") and "train.resume=true" in output
        else:
            assert status in (128 + number, -number, 0), errors
    assert_as_uninterrupted(data, run, uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_process_killed_while_it_writes_its_last_checkpoint_is_resumed_to_the_same_end(
    data, tmp_path, uninterrupted, seed
):
    """SIGTERM and soon after SIGKILL, as batch systems send them."""
    run, rng = tmp_path / "run", np.random.default_rng(seed)
    process = start(data, run)
    wait_for_epoch(process, run, rng.integers(1, EPOCHS))
    process.terminate()
    time.sleep(rng.uniform(0, EPOCH))
    process.kill()
    end(process)
    assert_as_uninterrupted(data, run, uninterrupted)


# ---------------------------------------------------------------------------------------- disks and files


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="limits of another process are Linux's")
@pytest.mark.parametrize("epoch", [1, 3, 6])
def test_a_disk_without_room_is_one_sentence_and_the_run_goes_on_later(data, tmp_path, uninterrupted, epoch):
    run = tmp_path / "run"
    process = start(data, run)
    wait_for_epoch(process, run, epoch)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (10_000, 10_000))
    status, _, errors = end(process)
    assert status == 2 and errors.startswith("error: ") and errors.count("\n") == 1 and "make room" in errors
    assert_as_uninterrupted(data, run, uninterrupted)


@pytest.fixture(scope="module")
def half(data, tmp_path_factory) -> Path:
    """A run that ended in its middle."""
    run = tmp_path_factory.mktemp("runs") / "half"
    process = start(data, run)
    wait_for_epoch(process, run, EPOCHS // 2)
    process.terminate()
    assert end(process)[0] == 128 + signal.SIGTERM
    return run


def rewrite(change: Callable[[bytes], bytes], path: Path) -> None:
    path.write_bytes(change(path.read_bytes()))


def flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes(255 - value for value in content[middle : middle + 16]) + content[middle + 16 :]


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, damage, reported",
    [
        pytest.param(checkpoint.LAST, partial(rewrite, flip), "going on from the one before", id="last flipped"),
        pytest.param(
            checkpoint.LAST, partial(rewrite, lambda c: c[:-9]), "going on from the one before", id="last cut"
        ),
        pytest.param(checkpoint.LAST, partial(rewrite, lambda c: b""), "going on from the one before", id="last empty"),
        pytest.param(checkpoint.LAST, Path.unlink, "going on from the one before", id="last deleted"),
        pytest.param(checkpoint.PREVIOUS, partial(rewrite, flip), "resumed", id="previous flipped"),
        pytest.param(METRICS, partial(rewrite, lambda c: c[:-9]), "resumed", id="metrics cut"),
        pytest.param(METRICS, Path.unlink, "resumed", id="metrics deleted"),
    ],
)
def test_a_run_with_a_damaged_file_reports_it_and_ends_the_same(
    data, half, tmp_path, uninterrupted, file, damage, reported
):
    run = shutil.copytree(half, tmp_path / "run")
    damage(run / file)
    assert reported in assert_as_uninterrupted(data, run, uninterrupted)
