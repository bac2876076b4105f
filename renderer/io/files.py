"""Files that are replaced as a whole: a reader, or a crash, meets the old content or the new one, never a part."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

TEMPORARY = ".pnb-*.tmp"  # the names of unfinished files, in the folder of the file that they will replace


@contextmanager
def replacing(path: str | Path, durable: bool = False, previous: Path | None = None) -> Iterator[Path]:
    """Give a temporary path to write to, and move the file from there to `path` when the block ends without an error.

    Otherwise the temporary file is removed, and the old file stays as it was.

    Args:
        path: The file to replace or to make. Its folder exists. A link stays one: the file that it names is replaced.
        durable: Whether to wait until the disk has the file, so that it outlives a loss of power: some 20 ms.
        previous: Where the old file is kept, or None.

    Yields:
        The path to write to, in the folder of the file.

    Raises:
        OSError: The disk refuses the file, which may not be written, or is a folder. The error names `path`.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(TEMPORARY.replace("*", uuid4().hex))
    try:
        _require_replaceable(target)
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        if durable:
            _flush(temporary)
        if previous and target.exists():
            os.replace(target, previous)
        os.replace(temporary, target)
        if durable and os.name == "posix":  # the renaming is an entry of the folder
            _flush(target.parent)
    except OSError as error:
        if error.errno is None:  # a library's error, in its own words
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_whole(
    path: str | Path, content: bytes | memoryview | str, durable: bool = False, previous: Path | None = None
) -> None:
    """Write a file as a whole. Arguments and errors are those of `replacing`.

    Text becomes UTF-8. Characters that it lacks, as file names in another encoding have, are written as escapes.
    """
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    with replacing(path, durable, previous) as temporary:
        temporary.write_bytes(data)


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files that a killed process left in a folder which no other process writes to."""
    for left in folder.glob(TEMPORARY):
        left.unlink(missing_ok=True)


def _require_replaceable(target: Path) -> None:
    """Raise OSError for a folder, a device or a file that may not be written, which a renaming would replace."""
    if target.exists() and not target.is_file():
        number = errno.EISDIR if target.is_dir() else errno.EINVAL
        raise OSError(number, os.strerror(number))
    if target.exists():
        with target.open("ab"):
            pass


def _flush(path: Path) -> None:
    """Wait until the disk has a file, or the entries of a folder."""
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
