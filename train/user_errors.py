"""Error messages for users, and a check that a folder is writable."""

import errno
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from renderer.errors import InputError, is_out_of_memory
from renderer.settings import Settings

# Numbers of the system errors of a full disk, of an exceeded quota and of a file that
# is too large.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Largest number of characters of a text that an error message quotes.
MAX_NAME_LENGTH = 200
# Size in bytes of the temporary file that is written to test a folder.
TEST_SIZE = 2**16


@contextmanager
def keyed(group: str = "", /, **keys: str) -> Iterator[None]:
    """Replace the names of Python arguments in error messages by keys of settings.

    A message of the library begins with the name of a Python argument, such as
    "name". The user of a command knows only the setting from which the command
    took the argument, such as "network". The key of "lighting" also holds for
    "lighting.radius" and "lighting[0]", and `group` is put before all other arguments.
    """
    try:
        yield
    except InputError as error:
        argument = error.argument
        if argument not in keys:
            # "light.turbidity" and "light[0]" are parts of the argument "light".
            argument = argument.partition(".")[0].partition("[")[0]
        if argument in keys:
            key = keys[argument]
            message = key + str(error).removeprefix(argument)
            raise InputError(message, key + error.argument.removeprefix(argument)) from error
        message = str(error)
        if group and not message.startswith(group):
            raise InputError(f"{group}: {message}", group) from error
        raise


def keys_of(key: str, settings: Settings) -> dict[str, str]:
    """List the dotted key of each field of a group of settings, as `keyed` takes them."""
    return {name: f"{key}.{name}" for name in vars(settings)}


def user_message(error: BaseException) -> str | None:
    """Write a message for the user about an error that the user can fix.

    None if it is a fault of the program, or unknown.
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
        case RuntimeError() if _is_lost_connection(error):
            fault = "another process of this run has ended"
            return f"{fault}: fix what ended it, and continue with train.resume=true"
        case RuntimeError() | MemoryError() if is_out_of_memory(error):
            advice = "ask for fewer or smaller images, views or meshes, or for a smaller batch_size"
            return f"memory ran out: {advice}"
    return None


def _is_lost_connection(error: RuntimeError) -> bool:
    """Return whether an error says that the connection to another process of a run was lost.

    The libraries NCCL and Gloo, which connect processes, raise such errors.
    """
    from torch.distributed import DistError

    # Gloo has no class of errors. Its messages contain the path of a source file.
    return isinstance(error, DistError) or "/gloo/" in str(error)


def writable_folder(folder: str | Path, key: str) -> Path:
    """Check that files can be written to a folder, by writing a temporary file.

    If the folder does not exist, the file is written to the nearest parent
    folder that exists.
    """
    path = Path(folder)
    try:
        candidates = (path, *path.absolute().parents)
        existing = next(candidate for candidate in candidates if candidate.exists())
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(bytes(TEST_SIZE))
    except OSError as error:
        raise InputError(
            f"{key}={path} cannot be written to ({error.strerror}): choose another folder",
        ) from error
    return path
