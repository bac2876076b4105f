"""Files that are replaced as a whole.

A reader finds the old content or the new content, and never a part of it. The
same holds after a crash.
"""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

# Pattern of the names of unfinished files. They lie in the folder of the file
# that they will replace.
TEMPORARY = ".pnb-*.tmp"


@contextmanager
def replacing(
    path: str | Path, durable: bool = False, previous: Path | None = None
) -> Iterator[Path]:
    """Give a temporary path to write to, and move the file to `path` at the end of the block.

    If the block raises an error, the temporary file is removed, and the old
    file stays as it was.

    Args:
        path: File to replace or to create. Its folder exists. A symbolic link
            stays, and the file that it points to is replaced.
        durable: Whether to wait until the disk holds the file, so that it
            survives a loss of power. This takes about 20 ms.
        previous: Path to which the old file is moved. None deletes it.

    Yields:
        Temporary path in the folder of the file.

    Raises:
        OSError: If the file cannot be written, or is a folder or a device. The
            error names `path`.
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
        # The new name is an entry of the folder. Only POSIX can flush folders.
        if durable and os.name == "posix":
            _flush(target.parent)
    except OSError as error:
        # Libraries raise errors without a number. Their texts are kept.
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def atomic_write(
    path: str | Path,
    content: bytes | memoryview | str,
    durable: bool = False,
    previous: Path | None = None,
) -> None:
    """Write a file as a whole, see `replacing`.

    Args:
        path: File to replace or to create.
        content: New content. Text is encoded as UTF-8. Characters that UTF-8
            lacks, which file names in other encodings can have, are written as
            escapes.
        durable: Whether to wait until the disk holds the file.
        previous: Path to which the old file is moved. None deletes it.

    Raises:
        OSError: If the file cannot be written.
    """
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    with replacing(path, durable, previous) as temporary:
        temporary.write_bytes(data)


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files that a killed process left in a folder.

    Args:
        folder: Folder to which no other process writes.
    """
    for unfinished in folder.glob(TEMPORARY):
        unfinished.unlink(missing_ok=True)


def _require_replaceable(target: Path) -> None:
    """Raise OSError for a folder, a device, or a file that is read-only."""
    if not target.exists():
        return
    if not target.is_file():
        number = errno.EISDIR if target.is_dir() else errno.EINVAL
        raise OSError(number, os.strerror(number))
    # The disk would replace even a read-only file. Opening it for writing raises
    # the error.
    with target.open("ab"):
        pass


def _flush(path: Path) -> None:
    """Wait until the disk holds a file, or the entries of a folder."""
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
