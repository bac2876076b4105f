"""What every entry point shares: errors in one sentence, interrupts in one line, a script's settings."""

import errno
import functools
import io
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
from hydra._internal.hydra import Hydra
from omegaconf import DictConfig
from omegaconf.errors import InterpolationResolutionError, MissingMandatoryValue

from renderer.errors import InputError, is_out_of_memory
from train.command_line import INTERRUPTED
from train.command_line.configuration import read_settings
from train.command_line.overrides import as_text, is_hydras, refusal
from train.runtime import is_process_lost

USER_ERROR = 2
LONGEST_NAME = 200  # characters
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FOLDERS = re.compile(r"(?<!\w)(~|\.{1,2})?/([^\s,:=]*/)?")  # of a path that does not begin in the clone


def one_sentence(error: Exception) -> str | None:
    """What the user can do about an error; None where it is no fault of the user's."""
    match error:
        case InputError():
            return str(error)
        case MissingMandatoryValue():
            return f"{error.full_key} is not set: give {error.full_key}=..."
        case InterpolationResolutionError():
            return f"{error.full_key}: {str(error.msg).splitlines()[0]}"
        case UnicodeEncodeError():
            name = ascii(error.object[:LONGEST_NAME])
            return f"{name} has letters that this system or library cannot write: rename it, or set PYTHONUTF8=1"
        case OSError() if error.filename is not None:
            return f"{error.filename} cannot be read or written: {error.strerror}"
        case OSError() if error.errno in NO_ROOM:
            return f"what was to be written found no room: {error.strerror}"
        case RuntimeError() if is_process_lost(error):
            return "another process of this run has ended: mend what ended it, and go on with train.resume=true"
        case RuntimeError() | MemoryError() if is_out_of_memory(error):
            return "memory ran out: ask for fewer or smaller images, views or meshes, or for a smaller batch_size"
    return None


def one_sentence_errors(function: Callable[..., Any]) -> Callable[..., Any]:
    """Print what the user can mend as one line, without a traceback, and exit with status 2.

    Where nobody reads the output any more, exit in silence, as a shell says it of SIGPIPE: 128 + number.
    """

    @functools.wraps(function)
    def wrapped(*arguments: Any, **keywords: Any) -> Any:
        try:
            result = function(*arguments, **keywords)
            print(end="", flush=True)  # here, where its errors are met
            return result
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python writes at its end
            sys.exit(128 + signal.SIGPIPE)
        except Exception as error:
            message = one_sentence(error)
            if message is None:
                raise
        print(f"error: {message}", file=sys.stderr)
        sys.exit(USER_ERROR)

    return wrapped


def run_command(main: Callable[[], None], config_name: str) -> None:
    """Run a Hydra main; what Hydra refuses is one sentence, with the nearest valid key, and exit status 2.

    Ctrl-C ends it with one line, as a shell says it of SIGINT. A terminal shows what it has no letters for as escapes.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors then; else it prints them, in several lines
    Hydra.get_mode = _no_mode  # type: ignore[method-assign]
    with _one_line_of_interrupts():
        _run(main, config_name)


@contextmanager
def _one_line_of_interrupts() -> Iterator[None]:
    """Also where a library that is being imported makes an error of its own of Ctrl-C."""
    came = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        signal.default_int_handler(number, frame)

    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if not came and not isinstance(error, KeyboardInterrupt):
            raise
        print(INTERRUPTED, file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)


def _no_mode(*_: object, **__: object) -> None:
    """Hydra's own composes the whole configuration once more, to read a hydra.mode that --multirun decides here."""


@one_sentence_errors
def _run(main: Callable[[], None], config_name: str) -> None:
    sys.argv[1:] = map(as_text, sys.argv[1:])
    try:
        main()
    except Exception as error:
        if not is_hydras(error):
            raise
        raise InputError(refusal(error, sys.argv[1:], config_name)) from error


def script(function: Callable[..., Any], settings: type | None = None) -> None:
    """Run a script of scripts/ under the configuration of its own name, read into a dataclass where one is given.

    What the function returns are failures, in words, which the script ends with.
    """
    name = Path(sys.argv[0]).stem

    @hydra.main(version_base="1.3", config_path="pkg://conf", config_name=name)
    @one_sentence_errors
    def main(config: DictConfig) -> None:
        if failed := function(read_settings(settings, config) if settings else config):
            sys.exit("\n".join(failed))

    run_command(main, name)


def command_line() -> str:
    """The command of the running script in scripts/, from the clone's root and without the folders of this machine."""
    name, *arguments = sys.argv
    script = Path(name).resolve().as_posix().rpartition("/scripts/")[2]
    return shlex.join(FOLDERS.sub("", word) for word in ("python", f"scripts/{script}", *arguments))
