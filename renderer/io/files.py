"""Write files, also of arrays (.npy), so that a reader never sees a part of the new content.

A reader finds either the old content or the new content, also after a crash. The
new content is written to a temporary file, which then replaces the old file.
"""

import errno
import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

import numpy as np

# Pattern for the names of temporary files. The new
# content of a file is first written to a temporary file
# in the same folder, which then replaces the old file.
TEMPORARY = ".pnb-*.tmp"


@contextmanager
def replacing(
    path: str | Path, durable: bool = False, previous: Path | None = None
) -> Iterator[Path]:
    """Replace a file by a temporary file that is written in a `with` block.

    At the end of the block, the temporary file is moved to `path`. If the block
    raises an error, the temporary file is removed and the old file stays. If `path` is a symbolic
    link, the file it points to is replaced. A folder, a device or a read-only file raises
    `OSError`. `durable` waits about 20 ms until the file is on the disk. The old file is moved to
    `previous`, or deleted.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(TEMPORARY.replace("*", uuid4().hex))
    try:
        if target.exists():
            if not (target.is_file() or target.is_dir()):
                raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
            # `os.replace` would replace a read-only file. Opening the file for appending raises an
            # error if it is a folder or read-only, and changes nothing.
            with target.open("ab"):
                pass
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        if durable:
            _flush(temporary)
        if previous and target.exists():
            os.replace(target, previous)
        os.replace(temporary, target)
        # The folder stores the name of the file, so the folder must
        # be flushed, too. Only POSIX systems can flush folders.
        if durable and os.name == "posix":
            _flush(target.parent)
    except OSError as error:
        # An error of a library has no error number, and is raised as it is.
        if error.errno is None:
            raise
        # An error of the system names the temporary
        # file. The new error names `path`.
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
    """Write a file so that a reader sees either the old content or all of the new content.

    The content is written to a temporary file, which then replaces the old file
    (see `replacing`). Characters of names of files that UTF-8 cannot encode are written as
    escapes.
    """
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    with replacing(path, durable, previous) as temporary:
        temporary.write_bytes(data)


def remove(*paths: Path) -> None:
    """Remove files and folders in this order, if they exist."""
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of a killed process, if no other process writes to the folder."""
    remove(*folder.glob(TEMPORARY))


def _flush(path: Path) -> None:
    """Wait until a file is stored on the disk, or, for a folder, its list of files."""
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def file_below(folder: Path, name: str) -> Path:
    """Find the regular file that another file names by a relative path.

    A file from a stranger must not read the user's other files. Its folder is
    therefore never left, also not by a symbolic link.
    """
    relative_path = name.replace("\\", "/")
    root = folder.resolve()
    path = Path(root, relative_path).resolve()
    # A colon begins with a drive of Windows or with a scheme, such as "http:".
    if not path.is_relative_to(root) or ":" in relative_path.partition("/")[0]:
        raise ValueError(f"it refers to {name}, not below its folder: put the file into {folder}")
    # `is_file` is False for a named pipe. Reading a pipe might never end.
    if not path.is_file():
        raise ValueError(f"it refers to {name}, which does not exist in {folder}")
    return path


def write_numbers(path: Path, numbers: np.ndarray) -> None:
    """Write an array to an .npy file.

    A reader never sees a part of the new file: see `atomic_write`.
    """
    content = io.BytesIO()
    np.save(content, numbers)
    atomic_write(path, content.getbuffer())


def read_numbers(path: Path) -> np.ndarray:
    """Read an array of real numbers from an .npy file.

    The file is mapped into memory. A damaged header that claims a huge array
    therefore raises an error instead of allocating memory. Numbers that are too large for float32
    become infinite.
    """
    array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.kind not in "fiu" or not array.size:
        raise ValueError(f"it is {array.dtype} of shape {array.shape}: save real numbers")
    with np.errstate(over="ignore"):
        return array.astype(np.float32)
