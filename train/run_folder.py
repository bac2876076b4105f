"""The folder of a run or of another command: its files' names, their text, and its lock."""

import json
import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from renderer.errors import InputError, as_folder, explained
from renderer.io.files import atomic_write, remove_unfinished

# Name of the file in a folder that a process locks while it writes to the folder.
LOCK = ".lock"
# File with the reason why the last training in the folder failed.
FAILURE = "failed.txt"

# Files in the folder of a run: the last checkpoint, the checkpoint before it, and the
# network with the highest validation accuracy.
LAST = "last.pt"
PREVIOUS = "previous.pt"
BEST = "best.pt"
# File of a published network, with weights in half precision.
PUBLISHED = "model.safetensors"
# File in the folder of a run that hardened a classifier of the user. It has the trained weights
# under the names that they have in the file of the user.
WEIGHTS = "weights.pt"
# Weights before a first training on photographs, in the folder of that training.
ORIGINAL = "before_photographs.pt"
METRICS = "metrics.jsonl"
# Sub-folder of a run with images of the training renders of some epochs.
RENDERS = "renders"
# Sub-folder of a run with the scores of the network before the training.
BEFORE = "before"
# Phases of an epoch. The log has the seconds of each phase. Together, the phases take
# the whole time of the epoch.
PHASES = ("attack", "training", "evaluation", "input_output")
# Size in bytes of the temporary file that is written to test a folder.
TEST_SIZE = 2**16


def find_original(folder: Path, network: str | None) -> Path | None:
    """Find the file of the weights before a first training on photographs, if a run has had one."""
    first = Path(str(network)).name
    files = (of / first / ORIGINAL for of in (folder, folder.absolute().parent))
    return next(filter(Path.is_file, files), None) if first else None


@contextmanager
def opened_text(path: Path) -> Iterator[str]:
    """Read a text file for a `with` block that parses the text. Errors name the file."""
    with explained(f"{path} is damaged or of another kind", "use another run"):
        if not path.is_file():
            raise ValueError("there is no such file")
        yield path.read_text(encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that contains one object."""
    with opened_text(path) as text:
        return _parse_object(text)


def write_json(path: Path, content: object, durable: bool = False, **options: Any) -> None:
    """Write a JSON file. Values may be dataclasses, and `options` are those of `json.dumps`."""
    atomic_write(path, json.dumps(content, default=asdict, **options) + "\n", durable)


def _parse_object(text: str) -> dict[str, Any]:
    """Parse a JSON object. Raise ValueError if it is empty or no object."""
    parsed = json.loads(text)
    if not isinstance(parsed, dict) or not parsed:
        raise ValueError("it holds no object of keys and values")
    return parsed


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Read the metrics of a run from metrics.jsonl.

    The file has a line for each epoch, and then a line with the final scores. An
    incomplete last line, which a crash can leave, is ignored.
    """
    path = folder / METRICS
    if not path.is_file():
        return []
    with opened_text(path) as text:
        # A complete line ends with a line break.
        lines = [_parse_object(line) for line in text.split("\n")[:-1]]
        if any(not isinstance(value, int | float) for line in lines for value in line.values()):
            raise ValueError("a value is not a number")
        epochs = [line.get("epoch", math.inf) for line in lines]
        if epochs != sorted({*epochs}):
            raise ValueError("epochs are repeated, or follow the final scores")
        return lines


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Try to lock a folder until the block ends, so that no other process writes to it.

    The lock holds among all machines that share the file system.
    If this succeeds, temporary files that a stopped process left in the folder
    are removed. Yield False if another process has the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except OSError as error:
        # The system names no file if the file system has no locks.
        if not isinstance(error, Timeout):
            raise OSError(error.errno, error.strerror, str(lock.lock_file)) from error
    if lock.is_locked:
        remove_unfinished(folder)
    try:
        yield lock.is_locked
    finally:
        lock.release()


@contextmanager
def sole_writer(*folders: Path) -> Iterator[None]:
    """Lock folders until the block ends, so that no other process writes to them.

    Folders into which the block has written nothing are removed at the end.
    """
    with ExitStack() as stack:
        for folder in folders:
            if not stack.enter_context(locked(folder)):
                raise InputError(f"out={folder} is in use by another process: choose another")
        try:
            yield
        finally:
            for folder in folders:
                # Only the file of the lock is there. Windows and NFS keep files that are open.
                if [path.name for path in folder.iterdir()] == [LOCK]:
                    with suppress(OSError):
                        (folder / LOCK).unlink()
                        folder.rmdir()


def state(folder: Path) -> str:
    """Describe the state of a run that is not finished.

    It is "not begun", "in training", "interrupted", "failed: " and the reason, or "not finished" in
    a folder that cannot be locked.
    """
    if not folder.exists():
        return "not begun"
    unless_failed = "not finished"
    # The process that trains the run holds its lock. In a read-only folder, OSError is raised.
    with suppress(OSError), locked(folder) as is_ours:
        if not is_ours:
            return "in training"
        unless_failed = "interrupted"
    failure = folder / FAILURE
    if not failure.exists():
        return unless_failed
    return f"failed: {failure.read_text(encoding='utf-8', errors='replace').strip()}"


def attack_success(diagnostics: Mapping[str, float], prefix: str = "") -> float | None:
    """Compute the success rate of an attack on renders that are classified correctly before it.

    With the fraction b of misclassified renders before the attack, and the
    fraction a after it, the rate is (a - b) / (1 - b). It is None without an attack or for b = 1.
    """
    before = diagnostics.get(f"{prefix}attack_success_before", 1.0)
    if before == 1:
        return None
    return (diagnostics[f"{prefix}attack_success"] - before) / (1 - before)


@contextmanager
def folder_or_temporary(out: str | Path | None) -> Iterator[Path]:
    """Yield a folder for files: the folder of the caller, or a temporary folder.

    A temporary folder is removed at the end of the block.
    """
    if out is not None:
        yield as_folder("out", out)
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def writable_folder(folder: str | Path, key: str) -> Path:
    """Check that files can be written to a folder, by writing a temporary file.

    If the folder does not exist, the file is written to the nearest parent
    folder that exists.
    """
    path = Path(folder)
    try:
        existing = next(one for one in (path, *path.absolute().parents) if one.exists())
        with tempfile.TemporaryFile(dir=existing) as file:
            # An empty file could be created on a full disk.
            file.write(bytes(TEST_SIZE))
    except OSError as error:
        fault = f"{key}={path} cannot be written to ({error.strerror})"
        raise InputError(f"{fault}: choose another folder") from error
    return path
