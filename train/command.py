"""A command: a settings class, a function of the library, and `main`.

    main = Command(
        name="compare",
        settings=CompareSettings,
        body="train.results.compare:print_comparison",
        help=HelpText("Print Markdown tables of finished runs.", ["pnb-compare runs=[a,b]"]),
    )

Hydra reads the command line and the files of conf/. It puts them into the settings class, which
is typed and checks its values. A mistake of the user is printed in one line that begins with the
key, and the exit status is 2. The module of the function is imported after that, since it takes
seconds to import.

Only this layer knows keys of the command line. The library raises an InputError that names a
Python argument, and `InputError.within` puts the key in front.
"""

from __future__ import annotations

import gc
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, get_origin

import hydra
from hydra import initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from renderer.errors import InputError
from renderer.settings import Settings
from train.help import CONF, HelpText, types_below, without_none
from train.system.memory import reuse_freed_memory
from train.system.verbosity import take_flag

# Exit status after an error of the user.
USER_ERROR = 2
# Exit status of a process that SIGPIPE ends: 128 plus the number of the signal.
# Windows does not have that signal.
BROKEN_PIPE = 141
INTERRUPTED = "ended by SIGINT"
# The names of all installed commands begin with this text.
PREFIX = "pnb-"
SWEEP_FLAGS = {"--multirun", "-m"}
HELP_FLAGS = {"--help", "-h"}
# If an import takes more seconds than this, `import_function` prints a line about it.
IMPORT_DELAY = 5.0
# Words of error messages for the types of settings.
NOUNS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    list: "a list, such as [a,b]",
}
# Hydra and OmegaConf raise these errors for some mistakes of the user. The errors do not
# name the setting.
INTERNAL_ERRORS = (AssertionError, AttributeError, OverflowError)
# The largest float has 309 digits before the decimal point. A whole number with more
# digits than MAX_DIGITS is reported as too large.
MAX_DIGITS = 300
# Quotation marks. Hydra does not parse the text between two of them.
QUOTES = "'\""
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Command:
    """A command of the command line. Calling the object starts the command.

    Args:
        name: Name of the command without "pnb-". If there is a file conf/NAME.yaml, Hydra
            composes the settings as this file says.
        settings: Class of the settings.
        body: Function that does the work, as "module:function". Its only argument is the settings.
        help: Texts that --help shows in addition to the settings.
        rewrite: Function that changes the arguments of the command line before Hydra reads them.
        sweeps: Whether the command accepts --multirun.
    """

    name: str
    settings: type[Settings]
    body: str
    help: HelpText
    rewrite: Callable[[list[str]], list[str]] = list
    sweeps: bool = False

    def __post_init__(self) -> None:
        store = ConfigStore.instance()
        store.store(f"{self.name}_settings", self.settings)
        if not self.has_file:
            store.store(self.name, {"defaults": [f"{self.name}_settings", "command"]})

    @property
    def has_file(self) -> bool:
        """Whether a file conf/NAME.yaml says how Hydra composes the settings of this command."""
        return (CONF / f"{self.name}.yaml").exists()

    @property
    def keys(self) -> dict[str, Any]:
        """Type annotation of each key of the command line.

        The annotation is None for a key that is no setting, such as "experiment", which selects
        a file of conf/.
        """
        return dict.fromkeys(self.help.groups) | types_below(self.settings)

    def __call__(self) -> None:
        """Start the command with the arguments of this process."""
        with exits_on_sigterm(), self.handle_errors():
            set_up_process()
            sys.argv[1:] = take_flag(sys.argv[1:])
            if not HELP_FLAGS.isdisjoint(sys.argv):
                print(self.format_help([word for word in sys.argv[1:] if word not in HELP_FLAGS]))
                skip_last_collection()
                return
            sys.argv[1:] = self.to_overrides(sys.argv[1:])
            # Hydra reads the overrides from sys.argv, composes the configuration, and calls
            # `self.run` with it.
            decorate = hydra.main(
                version_base="1.3", config_path="pkg://conf", config_name=self.name
            )
            start = decorate(self.run)
            start()

    def to_overrides(self, arguments: Sequence[str]) -> list[str]:
        """Convert the arguments of the command line to overrides that Hydra reads."""
        for argument in arguments:
            if argument in SWEEP_FLAGS and not self.sweeps:
                raise InputError(
                    f"{argument} is not an option of this command: "
                    "give settings as key=value; --help shows them",
                )
        # Hydra's parser of options wants --multirun before the settings.
        ordered = sorted(arguments, key=lambda argument: argument not in SWEEP_FLAGS)
        keys = self.keys
        return [as_override(argument, keys) for argument in self.rewrite(ordered)]

    def run(self, config: DictConfig) -> None:
        """Run the command, and report errors. Hydra calls this method."""
        # An error that reached Hydra would get another line in its message.
        with self.handle_errors():
            self.work(config)

    def work(self, config: DictConfig) -> None:
        """Do the work of the command: call the function `self.body` with the settings."""
        settings = read_settings(self.settings, config)
        import_function(self.body)(settings)

    def compose(self, overrides: Sequence[str] = ()) -> DictConfig:
        """Compose the configuration of the command without starting it."""
        words = self.to_overrides(overrides)
        try:
            return compose(self.name, words)
        except (HydraException, OmegaConfBaseException, *INTERNAL_ERRORS) as error:
            sentence = explain(error, self.keys, words)
            if sentence is None:
                raise
            raise InputError(sentence) from error

    def read(self, overrides: Sequence[str] = ()) -> Any:
        """Return the settings that the command would have with the given arguments."""
        return read_settings(self.settings, self.compose(overrides))

    @contextmanager
    def handle_errors(self) -> Iterator[None]:
        """Print an error of the user in one line, and exit with status 2.

        Ctrl-C prints one line, too, and exits with status 130. If the program that reads the
        output has ended, as in `pnb-compare ... | head`, the command exits with status 141 and
        prints nothing. All other errors are raised.
        """
        try:
            require_current_folder()
            yield
            # If the output is a closed pipe, this raises BrokenPipeError.
            print(end="", flush=True)
        except BrokenPipeError:
            # Python flushes the output again when it exits. That must not raise the
            # same error once more.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(BROKEN_PIPE)
        except (Exception, KeyboardInterrupt) as error:
            # Some libraries turn KeyboardInterrupt into another error.
            if any(isinstance(cause, KeyboardInterrupt) for cause in causes(error)):
                print(INTERRUPTED, file=sys.stderr)
                sys.exit(128 + signal.SIGINT)
            # This import takes time, and only errors need it.
            from train.system.user_errors import user_message

            sentence = explain(error, self.keys, sys.argv[1:]) or user_message(error)
            if sentence is None:
                raise
            print(f"error: {sentence}", file=sys.stderr)
            sys.exit(USER_ERROR)

    def format_help(self, overrides: Sequence[str] = ()) -> str:
        """Return the text of --help, which shows the value of each setting."""
        if not overrides and not self.has_file:
            # Hydra is not needed for the default values, and is slow.
            return self.help.format(OmegaConf.structured(self.settings))
        # Hydra's own --help lists the files of all groups of conf/, which is slower.
        return self.help.format(self.compose(overrides))


def require_current_folder() -> None:
    """Raise InputError if the current folder was deleted, so that relative paths mean nothing."""
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"the current folder cannot be used ({error.strerror}): change to another folder"
        ) from error


def compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration of a command from the files of conf/ and from overrides."""
    # While a command runs, Hydra is initialized, and must not be initialized again.
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(name, list(overrides))
    with initialize_config_module("conf", version_base="1.3"):
        return hydra.compose(name, list(overrides))


def set_up_process() -> None:
    """Set environment variables, warnings and output streams as all commands need them.

    This must happen before torch is imported.
    """
    # Hydra raises errors instead of printing them if this variable is set.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Threads of torch sleep while they wait if this variable is set. Otherwise they
    # slow down other processes.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    reuse_freed_memory()
    if Path(sys.argv[0]).stem.startswith(PREFIX):
        # Child processes would import a file train.py of the current folder instead
        # of this package if this variable were not set.
        os.environ["PYTHONSAFEPATH"] = "1"
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    warnings.simplefilter("once", UserWarning, append=True)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # Characters that the terminal cannot show are printed as escapes.
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def exits_on_sigterm() -> Iterator[None]:
    """Raise SystemExit if the signal SIGTERM comes during the block.

    Python's cleanup then runs, in which launchers end their child processes.
    """
    previous_handler = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


def import_function(path: str) -> Callable[..., Any]:
    """Import a function by its path "module:function"."""
    module, _, name = path.partition(":")
    is_torch_imported = "torch" in sys.modules
    with _announced_if_slow(), _ended_by_ctrl_c():
        function = getattr(import_module(module), name)
    if not is_torch_imported:
        skip_last_collection()
    return cast(Callable[..., Any], function)


@contextmanager
def _announced_if_slow() -> Iterator[None]:
    """Print that libraries are being loaded if the block takes longer than IMPORT_DELAY."""
    line = "loading PyTorch and other libraries ..."
    timer = threading.Timer(IMPORT_DELAY, print, [line], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def _ended_by_ctrl_c() -> Iterator[None]:
    """End the process at once if Ctrl-C is pressed during the block.

    Some modules catch KeyboardInterrupt while they are imported, and would continue.
    """
    # Python lets only the main thread set a handler.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_handler = signal.getsignal(signal.SIGINT)
    # A job in the background of a shell ignores SIGINT, and must still do so.
    if previous_handler is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous_handler)


def _end_at_once(number: int, frame: object) -> None:
    """Handle a signal: print a line and end the process without cleanup."""
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(128 + number)


def skip_last_collection() -> None:
    """Exclude all present objects from garbage collection, so that Python exits faster.

    At its exit, Python looks for reference cycles among all objects. This takes seconds after
    PyTorch is imported, and a fifth of the time of --help.
    """
    gc.freeze()


def read_settings(kind: type[Kind], config: DictConfig) -> Kind:
    """Convert a configuration of Hydra to an object of a settings class.

    Missing fields get their defaults. Messages of InputError begin with the key.
    """
    try:
        # A configuration that was read from a file does not know the types of its
        # values. Merging it into the class checks them.
        if OmegaConf.get_type(config) is not kind:
            config = cast(DictConfig, OmegaConf.merge(OmegaConf.structured(kind), config))
        return cast(Kind, _read_node(config, ""))
    except (OmegaConfBaseException, *INTERNAL_ERRORS) as error:
        sentence = explain(error, types_below(kind), ())
        if sentence is None:
            raise
        raise InputError(sentence) from error


def _read_node(node: DictConfig, key: str) -> Any:
    """Convert a configuration, or a group of settings in it, to an object of its settings class.

    `key` is dotted, and empty for the whole configuration.
    """
    kind = cast(type, OmegaConf.get_type(node))
    values: dict[str, Any] = {}
    for item in fields(cast(Any, kind)):
        name = item.name
        inner = f"{key}.{name}" if key else name
        if OmegaConf.is_missing(node, name):
            raise InputError(f"{inner} is not set: give {inner}=...", inner)
        child = node[name]
        if not OmegaConf.is_config(child):
            values[name] = child
        elif is_dataclass(OmegaConf.get_type(child)):
            values[name] = _read_node(child, inner)
        else:
            values[name] = OmegaConf.to_container(child, resolve=True)
    try:
        return kind(**values)
    except InputError as error:
        raise error.within(key, values) from None


def as_override(argument: str, keys: Mapping[str, Any]) -> str:
    """Convert an argument of the command line to an override that Hydra reads as the user means it.

    The value of a text setting is quoted if Hydra would change or refuse it: Hydra reads 1.10 as
    1.1, and refuses an umlaut. A single value of a list setting becomes a list with one member. A
    plus sign before a key is removed, because it would add a setting, and all settings exist. A "~"
    at the beginning, with which Hydra removes a setting, raises InputError. `keys` has the type of
    each dotted key.
    """
    if argument.startswith("~"):
        raise InputError(f"{argument}: a setting cannot be removed: set another value")
    key, equals, value = argument.partition("=")
    if key.startswith("+") and not key.lstrip("+").startswith("hydra"):
        key = key.lstrip("+")
        argument = f"{key}{equals}{value}"
    group = key.rpartition(".")[0]
    # A setting of type Any can hold a mapping, such as scene.projector. Hydra sets a
    # key of a mapping, which may be absent, only if the override begins with "++".
    if keys.get(group) is Any:
        return f"++{argument}"
    kind = without_none(keys.get(key))
    if get_origin(kind) is list:
        return _as_list(key, value, is_text=get_args(kind) == (str,))
    if kind is str:
        return _as_text(key, value)
    return argument


def _as_text(key: str, value: str) -> str:
    """Write the override of a text, with quotes if Hydra would change or refuse the value."""
    override = f"{key}={value}"
    # A value that begins with "~" is a path in the home folder. The error of Hydra
    # about it is better than a quoted path that does not exist.
    if not value or value[0] in (*QUOTES, "~"):
        return override
    try:
        parsed_override = OverridesParser.create().parse_override(override)
    except HydraException:
        return f"{key}={quoted(value)}"
    if parsed_override.is_sweep_override() and not set("[](){}" + QUOTES) & set(value):
        # The values of a sweep are texts, too: label=true,false.
        values = [_as_text(key, item.strip()) for item in value.split(",")]
        return f"{key}={','.join(item.partition('=')[2] for item in values)}"
    parsed = parsed_override.value()
    if isinstance(parsed, list) and not set("[]{}" + QUOTES) & set(value[1:-1]):
        # Classes can be named true, null or 1.5. Hydra would read them as values.
        members = zip(value[1:-1].split(","), parsed, strict=False)
        texts = [
            quoted(text.strip()) if member is None or isinstance(member, bool | float) else text
            for text, member in members
        ]
        return f"{key}=[{','.join(texts)}]"
    is_changed = isinstance(parsed, str | int | float) and parsed != value
    return f"{key}={quoted(value)}" if is_changed else override


def _as_list(key: str, value: str, is_text: bool) -> str:
    """Write the override of a list setting.

    A list, null and a sweep of Hydra stay the same. Any other value becomes the only member.
    """
    if not value or value.startswith("["):
        return f"{key}={value}"
    try:
        parsed = OverridesParser.create().parse_override(f"{key}={value}").value()
    except HydraException:  # Hydra refuses some paths.
        return f"{key}=[{quoted(value)}]"
    if isinstance(parsed, str) or (is_text and isinstance(parsed, int | float)):
        is_quoted = value[0] in QUOTES
        member = value if is_quoted else quoted(value)
        return f"{key}=[{member}]"
    if isinstance(parsed, dict | int | float):
        return f"{key}=[{value}]"
    # The value is null or a sweep of Hydra.
    return f"{key}={value}"


def quoted(text: str) -> str:
    """Put a text between single quotes, so that Hydra reads it unchanged.

    A single quote inside the text gets a backslash before it. Backslashes of the text that stand
    before a single quote or at the end are doubled.
    """
    escaped_parts = []
    for part in text.split("'"):
        backslash_count = len(part) - len(part.rstrip("\\"))
        escaped_parts.append(part + "\\" * backslash_count)
    escaped = "\\'".join(escaped_parts)
    return f"'{escaped}'"


def causes(error: BaseException) -> Iterator[BaseException]:
    """Yield an error, then the error that caused it, then the cause of that error, and so on."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def explain(error: BaseException, keys: Mapping[str, Any], words: Sequence[str]) -> str | None:
    """Explain an error of Hydra or OmegaConf in one sentence that begins with the key.

    None if neither Hydra nor OmegaConf raised the error.
    """
    # An error of Hydra is often caused by an error of OmegaConf. Only the error of
    # OmegaConf has the attribute `full_key`, the key of the wrong setting.
    with_key = [cause for cause in causes(error) if getattr(cause, "full_key", None)]
    wrong = with_key[0] if with_key else error
    key = str(getattr(wrong, "full_key", None) or "")
    place = _name_conf_file(error)
    match wrong:
        case InputError():
            return str(wrong)
        case ConfigKeyError() | ConfigAttributeError():
            return f"{key} is not a setting{place}: {_suggest(key, keys)}"
        case OmegaConfBaseException():
            return _explain_value(wrong, key, keys, place)
        case OverrideParseException():
            advice = "quote the value for Hydra, and the quotes for the shell"
            return f"{wrong.override} cannot be read: {advice}"
        case MissingConfigException() if wrong.missing_cfg_file:
            return _explain_choice(str(wrong.missing_cfg_file))
        case HydraException():
            return _first_line(wrong)
        case OverflowError():
            return _explain_overflow(words)
        case AssertionError() | AttributeError():
            return _explain_null_group(keys, words)
    return None


def _name_conf_file(error: BaseException) -> str:
    """Name the file of conf/ in which Hydra found an error.

    Such an error begins with a text like "In 'attack': ". The result is such as " (In 'attack')",
    or empty if the error names no file.
    """
    start = _first_line(error).partition(":")[0]
    return f" ({start})" if start.startswith("In ") else ""


def _first_line(error: BaseException) -> str:
    """Return the first line of the message of an error."""
    return str(error).partition("\n")[0].strip()


def _suggest(key: str, keys: Collection[str]) -> str:
    """Suggest the key that is most similar to a wrong key, or --help if no key is similar."""
    close = get_close_matches(key, keys, 1, 0.5)
    return f"did you mean {close[0]}?" if close else "--help shows all settings"


def _explain_value(
    error: OmegaConfBaseException,
    key: str,
    keys: Mapping[str, Any],
    place: str,
) -> str:
    """Explain the error of a value that does not have the type of its setting."""
    hint = without_none(keys.get(key))
    # The origin of list[str] is list.
    kind = get_origin(hint) or hint
    if kind in NOUNS:
        value = getattr(error, "value", None)
        shown = "null" if value is None else value
        return f"{key}={shown} must be {NOUNS[kind]}{place}"
    if is_dataclass(hint):
        first_field = fields(cast(Any, hint))[0].name
        example = f"{key}.{first_field}=..."
        return f"{key} is a group of settings{place}: set one of them, such as {example}"
    text = _first_line(error)
    if key and key not in text:
        text = f"{key}: {text}"
    return f"{text}{place}"


def _explain_choice(file: str) -> str:
    """Explain the error of a choice, such as attack=light, for which conf/ has no file."""
    group, _, choice = file.removesuffix(".yaml").rpartition("/")
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    return f"{group}={choice} is not a choice: choose one of {', '.join(options)}"


def _explain_overflow(words: Sequence[str]) -> str | None:
    """Explain the error of the first whole number too large for a float. None if there is none."""
    for word in words:
        key, _, value = word.partition("=")
        if value.lstrip("-").isdigit() and len(value) > MAX_DIGITS:
            return f"{key} is too large: give a smaller number"
    return None


def _explain_null_group(keys: Mapping[str, Any], words: Sequence[str]) -> str | None:
    """Explain the error of a setting inside a group that is null.

    For example, attack.geometry.radius cannot be set while attack.geometry is
    null.
    """
    for word in words:
        key = word.partition("=")[0]
        group = key.rpartition(".")[0]
        for name in (key, group):
            hint = keys.get(name)
            if is_dataclass(without_none(hint)) and get_args(hint):
                return f"{name} is null: choose it first, as --help shows"
    return None


def program(name: str, as_called: bool = False) -> list[str]:
    """Return the start of a command line that runs a command in the way of this process.

    It is "pnb-NAME", or "python -m MODULE" if the package is not installed, after torchrun and its
    options if that started this process. `as_called` gives full paths.
    """
    called = Path(sys.argv[0])
    process_count = int(os.environ.get("WORLD_SIZE", "1"))
    installed_name = f"{PREFIX}{name}"
    is_installed = bool(sys.flags.safe_path) or called.stem.startswith(PREFIX)
    python = sys.executable if as_called else "python"
    if is_installed:
        has_path = as_called and called.stem == installed_name
        words = [str(called) if has_path else installed_name]
    else:
        words = ["-m", "train" if name == "train" else f"scripts.{name}"]
    if process_count > 1:
        torchrun = [python, "-m", "torch.distributed.run"] if as_called else ["torchrun"]
        no_python = ["--no-python"] if is_installed else []
        return [*torchrun, f"--nproc_per_node={process_count}", *no_python, *words]
    return words if is_installed else [python, *words]


def command_line(name: str) -> str:
    """Return the command line of this process, as a user can type it again."""
    return shlex.join([*program(name), *sys.argv[1:]])
