"""Lock the folder of a run, so that only one process writes to it.

The lock holds among all machines that share the file system.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from renderer.errors import InputError
from renderer.io.files import remove_unfinished

# Name of the file in a folder that a process locks while it writes to the folder.
LOCK = ".lock"
# File with the reason why the last training in the folder failed.
FAILURE = "failed.txt"


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Try to lock a folder until the block ends, so that no other process writes to it.

    If this succeeds, temporary files that a stopped process left in the folder
    are removed. Yield False if another process has the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK)
    with suppress(Timeout):
        lock.acquire(blocking=False)
    if lock.is_locked:
        remove_unfinished(folder)
    try:
        yield lock.is_locked
    finally:
        lock.release()


@contextmanager
def sole_writer(key: str, *folders: Path) -> Iterator[None]:
    """Lock folders until the block ends, so that no other process writes to them.

    Folders into which the block has written nothing are removed at the end.
    """
    with ExitStack() as stack:
        for folder in folders:
            if not stack.enter_context(locked(folder)):
                raise InputError(
                    f"{key}={folder} is being written by another process: "
                    "wait, or choose another folder",
                )
        try:
            yield
        finally:
            for folder in folders:
                _remove_if_empty(folder)


def _remove_if_empty(folder: Path) -> None:
    """Remove a folder if it holds nothing but the lock file."""
    names = [path.name for path in folder.iterdir()]
    if names == [LOCK]:
        (folder / LOCK).unlink()
        folder.rmdir()


def state(folder: Path) -> str:
    """Describe the state of a run that is not finished.

    It is "not begun", "in training", "interrupted" or "failed: " and the reason.
    """
    if not folder.exists():
        return "not begun"
    with locked(folder) as is_ours:
        if not is_ours:
            return "in training"
    failure = folder / FAILURE
    if failure.exists():
        reason = failure.read_text(encoding="utf-8", errors="replace").strip()
        return f"failed: {reason}"
    return "interrupted"
