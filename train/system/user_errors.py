"""Say in one sentence what the user can do about an error, and check that a folder can be written to."""

import errno
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from renderer.errors import InputError, is_out_of_memory
from renderer.settings import Settings

# Errors of a full disk, a full quota and a file that is too large.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Characters of a text that an error message shows at most.
MAX_NAME_LENGTH = 200
# Bytes of the file that tests whether a folder can be written to.
TEST_SIZE = 2**16


@contextmanager
def keyed(key: str, names: Collection[str] = ()) -> Iterator[None]:
    """Add the key of the settings to the error messages of the library.

    The library does not know the keys of the command line. A message about
    `radius` becomes a message about `attack.lighting.radius`, for example.

    Args:
        key: Key of the settings that the library was given, such as "attack".
        names: Names of the fields of these settings.

    Raises:
        InputError: If the block raises it. The message then starts with the key.
    """
    try:
        yield
    except InputError as error:
        if str(error).startswith(key):
            raise
        raise error.within(key, names) from error


@contextmanager
def renamed(**keys: str) -> Iterator[None]:
    """Put keys of the settings in the place of Python arguments in error messages.

    A function of the library names its own argument. A caller that took the
    value of this argument from a setting says which setting it was. Messages
    about other arguments stay as they are.

    Args:
        **keys: The key for each argument, such as `name="train.init_from"`.

    Raises:
        InputError: If the block raises it. The message starts with the key if
            it started with one of the arguments.
    """
    try:
        yield
    except InputError as error:
        key = keys.get(error.argument)
        if key is None:
            raise
        raise InputError(key + str(error).removeprefix(error.argument), key) from error


def keys_of(key: str, settings: Settings) -> dict[str, str]:
    """Return the key of each field of settings, for `renamed`.

    Args:
        key: Key of the settings, such as "train".
        settings: The settings.

    Returns:
        The keys by field, such as "train.epochs" for "epochs".
    """
    return {name: f"{key}.{name}" for name in vars(settings)}


def one_sentence(error: BaseException) -> str | None:
    """Say what the user can do about an error.

    Args:
        error: The error.

    Returns:
        One sentence. None if the error is a fault of the program.
    """
    match error:
        case InputError():
            return str(error)
        case UnicodeEncodeError():
            name = ascii(error.object[:MAX_NAME_LENGTH])
            fault = f"{name} has characters that this system or library cannot write"
            return f"{fault}: rename it, or set PYTHONUTF8=1"
        case OSError() if error.errno in NO_ROOM:
            fault = f"{error.filename or 'the output'} cannot be written ({error.strerror})"
            return f"{fault}: make room and start again"
        case OSError() if error.filename is not None:
            return f"{error.filename} cannot be read or written: {error.strerror}"
        case RuntimeError() if _is_of_another_process(error):
            fault = "another process of this run has ended"
            return f"{fault}: fix what ended it, and go on with train.resume=true"
        case RuntimeError() | MemoryError() if is_out_of_memory(error):
            advice = "ask for fewer or smaller images, views or meshes, or for a smaller batch_size"
            return f"memory ran out: {advice}"
    return None


def _is_of_another_process(error: RuntimeError) -> bool:
    """Return whether NCCL or gloo lost the connection to another process."""
    from torch.distributed import DistError

    # Gloo has no error class. Its messages name its source file.
    return isinstance(error, DistError) or "/gloo/" in str(error)


def writable_folder(folder: str | Path, key: str) -> Path:
    """Check that files can be written to a folder.

    The check writes a temporary file. If the folder does not exist, the file
    goes to the nearest parent folder that exists.

    Args:
        folder: The folder.
        key: Setting that names the folder, for the error message.

    Returns:
        The folder as a path.

    Raises:
        InputError: If the file cannot be written.
    """
    path = Path(folder)
    try:
        existing = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(bytes(TEST_SIZE))
    except OSError as error:
        fault = f"{key}={path} cannot be written to ({error.strerror})"
        raise InputError(f"{fault}: choose another folder") from error
    return path
