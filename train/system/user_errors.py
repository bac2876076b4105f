"""What the user can do about an error, in one sentence, and whether a folder can be written to."""

import errno
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from renderer.errors import InputError, is_out_of_memory

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LONGEST_NAME = 200  # characters


@contextmanager
def keyed(key: str, names: Collection[str] = ()) -> Iterator[None]:
    """Put a key in front of the sentences of the library.

    Args:
        key: Key of the settings that the library was given.
        names: Names of their fields.

    Raises:
        InputError: The error that was raised inside, with the key.
    """
    try:
        yield
    except InputError as error:
        if str(error).startswith(key):
            raise
        raise error.within(key, names) from error


def one_sentence(error: BaseException) -> str | None:
    """What the user can do about an error; None where the error is not the user's."""
    match error:
        case InputError():
            return str(error)
        case UnicodeEncodeError():
            name = ascii(error.object[:LONGEST_NAME])
            return f"{name} has characters that this system or library cannot write: rename it, or set PYTHONUTF8=1"
        case OSError() if error.errno in NO_ROOM:
            return f"{error.filename or 'the output'} cannot be written ({error.strerror}): make room and start again"
        case OSError() if error.filename is not None:
            return f"{error.filename} cannot be read or written: {error.strerror}"
        case RuntimeError() if _is_of_another_process(error):
            return "another process of this run has ended: fix what ended it, and go on with train.resume=true"
        case RuntimeError() | MemoryError() if is_out_of_memory(error):
            return "memory ran out: ask for fewer or smaller images, views or meshes, or for a smaller batch_size"
    return None


def _is_of_another_process(error: RuntimeError) -> bool:
    """Tell whether NCCL or gloo lost another process. gloo names its own source file."""
    from torch.distributed import DistError

    return isinstance(error, DistError) or "/gloo/" in str(error)


def writable_folder(folder: str | Path, key: str) -> Path:
    """The folder, which may be missing yet. InputError naming the key where no file can be written into it.

    A temporary file is written to it or to the nearest folder above that exists.
    """
    path = Path(folder)
    try:
        existing = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(bytes(2**16))
    except OSError as error:
        raise InputError(f"{key}={path} cannot be written to ({error.strerror}): choose another folder") from error
    return path
