"""What every entry point shares: one-sentence errors, also of what Hydra refuses, with the nearest valid key."""

import difflib
import errno
import functools
import io
import os
import re
import shlex
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
from hydra import compose, initialize_config_module
from hydra._internal.hydra import Hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import InterpolationResolutionError, MissingMandatoryValue

from renderer.errors import InputError, is_out_of_memory
from train.command_line import INTERRUPTED
from train.command_line.configuration import read_settings
from train.distributed import is_process_lost

USER_ERROR = 2
LONGEST_NAME = 200  # characters
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
TEXTS = {  # keys of names and folders
    *("run", "sweep", "init_from", "out", "keep", "photos", "photographs", "path", "images", "cache"),
    *("weights", "light", "label", "target", "classifier", "name", "reload"),
}
NUMBER = re.compile(r"[+-]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(e[+-]?\d+)?|[+-]?(inf|nan)|true|false", re.IGNORECASE)
HYDRAS_ADVICE = re.compile(r"\n(?:To append|See https:|Config search path:)")  # begins what serves nobody here
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
    sys.argv[1:] = map(_as_text, sys.argv[1:])
    try:
        main()
    except Exception as error:
        if not _is_hydras(error):
            raise
        raise InputError(_refusal(error, sys.argv[1:], config_name)) from error


def _is_hydras(error: Exception) -> bool:
    """Whether Hydra refused an override, in an error of its own or another that it raised."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return isinstance(error, HydraException) or innermost.f_globals["__name__"].startswith("hydra.")


def _refusal(error: Exception, arguments: list[str], config_name: str) -> str:
    """What Hydra says, the override that it says it of, and what else to try."""
    said = " ".join(HYDRAS_ADVICE.split(str(error))[0].split())
    overrides, nearest = [argument for argument in arguments if not argument.startswith("-")], []
    with initialize_config_module("conf", version_base="1.3"):
        culprit = None if _names_one(said, overrides) else _culprit(config_name, overrides)
        with suppress(HydraException, ValueError):  # of a group without such a choice, whose choices Hydra lists
            nearest = list(_suggestions(overrides, config_name))
    named = ": ".join(filter(None, [culprit, said]))
    return "; ".join([named.removesuffix("."), *nearest])


def _names_one(said: str, overrides: list[str]) -> bool:
    """Whether the key of one of the overrides is said, as a word of its own."""
    keys = (override.partition("=")[0] for override in overrides)
    return any(re.search(rf"(?<![\w.]){re.escape(key)}(?![\w.])", said) for key in keys)


def _culprit(config_name: str, overrides: list[str]) -> str | None:
    """The first override without which the others compose."""
    others = (overrides[:place] + overrides[place + 1 :] for place in range(len(overrides)))
    return next((left for left, rest in zip(overrides, others, strict=True) if _composes(config_name, rest)), None)


def _composes(config_name: str, overrides: list[str]) -> bool:
    try:
        compose(config_name, overrides, return_hydra_config=True)
    except Exception:  # a HydraException, or one of Python's for a value that Hydra has no rule for
        return False
    return True


def quoted(text: str) -> str:
    """A value of an override that is this text, whatever it looks like to Hydra."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"


def _as_text(argument: str) -> str:
    """The override, quoted where its value is text that Hydra would take for something else, or not at all.

    Such are numbers (1.10), the names of what is there (a,b) and what its grammar has no rule for (schäl).
    InputError for a name that is empty, which would stand for the current folder, and for a setting taken away.
    """
    if argument.startswith("~"):
        raise InputError(f"{argument}: no setting can be taken away: leave this out, or set it to another value")
    key, _, value = argument.partition("=")
    is_text = not TEXTS.isdisjoint(key.lstrip("+").split("."))
    if is_text and value in ("", "''", '""'):
        raise InputError(f"{key} is empty: give a name, or leave it out")
    if is_text and (NUMBER.fullmatch(value) or _is_misread(argument, value, os.path.lexists(value))):
        return f"{key}={quoted(value)}"
    return argument


def _is_misread(override: str, value: str, exists: bool) -> bool:
    """Whether Hydra's grammar has no rule for a value, or reads the name of what is there as something else."""
    try:
        read = OverridesParser.create().parse_override(override)
    except HydraException:
        return True
    return exists and (read.is_sweep_override() or read.value() != value)


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


def _suggestions(overrides: list[str], config_name: str) -> Iterator[str]:
    """For each override whose key is neither a key nor a group of the configuration that the groups make."""
    pairs = [override.partition("=") for override in overrides if "=" in override and override[0] != "+"]
    groups = compose(config_name, return_hydra_config=True).hydra.runtime.choices
    chosen = [f"{key}={value.split(',')[0]}" for key, _, value in pairs if key in groups]
    known = [*groups, *_keys(compose(config_name, chosen, return_hydra_config=True))]
    for key, _, _ in pairs:
        nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        if key not in known and nearest:
            yield f"nearest valid key to {key!r}: {nearest[0]}"


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in node:
        name = prefix + str(key)
        yield name
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            yield from _keys(child, f"{name}.")
