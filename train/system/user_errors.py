"""Messages that say what a user can do about an error, and a check that a folder is writable."""

import errno
import tempfile
from collections.abc import Iterator
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
def keyed(whole: str = "", /, **keys: str) -> Iterator[None]:
    """Put keys of the command line into the error messages of the library.

    The library does not know these keys. Its messages begin with the name of a
    Python argument, and a caller that took the argument from a setting says
    which setting it was.

    Args:
        whole: Key that is put before messages about anything but `keys`, such
            as "scene". If it is empty, these messages stay as they are.
        **keys: Key that replaces the name of each argument, such as
            `name="train.init_from"`. A part of an argument, such as
            "lighting.radius", belongs to the key of "lighting".

    Raises:
        InputError: If the block raises it. The message then begins with the key.

    >>> with keyed(name="train.init_from"):
    ...     raise InputError("name=x is unknown", "name")
    Traceback (most recent call last):
    renderer.errors.InputError: train.init_from=x is unknown
    """
    try:
        yield
    except InputError as error:
        argument = error.argument
        if argument not in keys:
            # "light" for an argument such as "light.turbidity" or "light[0]".
            argument = argument.partition(".")[0].partition("[")[0]
        if argument in keys:
            key = keys[argument]
            message = key + str(error).removeprefix(argument)
            raise InputError(message, key + error.argument.removeprefix(argument)) from error
        if whole and not str(error).startswith(whole):
            raise InputError(f"{whole}: {error}", whole) from error
        raise


def keys_of(key: str, settings: Settings) -> dict[str, str]:
    """Return the key of each field of settings, for `keyed`.

    Args:
        key: Key of the settings, such as "train".
        settings: The settings.

    Returns:
        The keys by field, such as "train.epochs" for "epochs".
    """
    return {name: f"{key}.{name}" for name in vars(settings)}


def user_message(error: BaseException) -> str | None:
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
    """Return whether an error says that the connection to another process was lost.

    NCCL or gloo raises such errors.
    """
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
        raise InputError(
            f"{key}={path} cannot be written to ({error.strerror}): choose another folder",
        ) from error
    return path
