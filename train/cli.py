"""What every entry point shares: one-sentence errors, and the nearest valid key for a mistyped override."""

import difflib
import functools
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import hydra
from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, MissingMandatoryValue

from renderer.errors import InputError
from train.settings import read_settings

USER_ERROR = 2
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
    return None


def one_sentence_errors(function: Callable) -> Callable:
    """Print what the user can mend as one line, without a traceback, and exit with status 2."""

    @functools.wraps(function)
    def wrapped(*arguments, **keywords):
        try:
            return function(*arguments, **keywords)
        except Exception as error:
            message = one_sentence(error)
            if message is None:
                raise
        print(f"error: {message}", file=sys.stderr)
        sys.exit(USER_ERROR)

    return wrapped


def with_suggestions(main: Callable[[], None], config_name: str) -> None:
    """Run a Hydra main; where Hydra rejects an override, print the nearest valid key below its error."""
    try:
        main()
    except SystemExit as stop:
        if stop.code == 1:
            for line in _suggestions(sys.argv[1:], config_name):
                print(line, file=sys.stderr)
        raise


def script(function: Callable, settings: type | None = None) -> None:
    """Run a script of scripts/ under the configuration of its own name, read into a dataclass where one is given.

    What the function returns are failures, in words, which the script ends with.
    """
    name = Path(sys.argv[0]).stem

    @hydra.main(version_base="1.3", config_path="pkg://conf", config_name=name)
    @one_sentence_errors
    def main(config: DictConfig) -> None:
        if failed := function(read_settings(settings, config) if settings else config):
            sys.exit("\n".join(failed))

    with_suggestions(main, name)


def command_line() -> str:
    """The command of the running script in scripts/, from the clone's root and without the folders of this machine."""
    name, *arguments = sys.argv
    script = Path(name).resolve().as_posix().rpartition("/scripts/")[2]
    return shlex.join(FOLDERS.sub("", word) for word in ("python", f"scripts/{script}", *arguments))


def _suggestions(arguments: list[str], config_name: str) -> Iterator[str]:
    """A line for each override whose key is neither a key nor a group of the configuration that the groups make."""
    overrides = [argument.partition("=") for argument in arguments if "=" in argument and argument[0] not in "+~-"]
    try:
        with initialize_config_module("conf", version_base="1.3"):
            groups = compose(config_name, return_hydra_config=True).hydra.runtime.choices
            chosen = [f"{key}={value.split(',')[0]}" for key, _, value in overrides if key in groups]
            known = [*groups, *_keys(compose(config_name, chosen, return_hydra_config=True))]
    except HydraException:  # a group has no such choice: Hydra's own error lists those it has
        return
    for key, _, _ in overrides:
        nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        if key not in known and nearest:
            yield f"Nearest valid key to {key!r}: {nearest[0]}"


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in node:
        yield prefix + key
        child = node._get_node(key)
        if OmegaConf.is_dict(child) and not child._is_none():
            yield from _keys(child, f"{prefix}{key}.")
