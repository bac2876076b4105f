"""A command: a settings class, a function of the library, and `main`.

    main = Command(
        name="compare",
        settings=CompareSettings,
        body="train.report.comparison:print_comparison",
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
from train.former_keys import replace_former_key
from train.help import CONF, HelpText, types_below, without_none
from train.system.memory import reuse_freed_memory
from train.system.verbosity import take_flag

# Exit status after an error of the user.
USER_ERROR = 2
# Exit status of a process that SIGPIPE ends. Windows does not have that signal.
BROKEN_PIPE = 141
INTERRUPTED = "ended by SIGINT"
# Start of the names of the installed commands.
PREFIX = "pnb-"
SWEEP_FLAGS = {"--multirun", "-m"}
HELP_FLAGS = {"--help", "-h"}
# If an import takes more seconds than this, `import_function` prints a line about it.
IMPORT_DELAY = 5.0
# Words for the types of settings in error messages.
NOUNS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    list: "a list, such as [a,b]",
}
# For some mistakes of the user, Hydra and OmegaConf raise these errors, which do not
# name the setting.
INTERNAL_ERRORS = (AssertionError, AttributeError, OverflowError)
# A float cannot hold whole numbers of more digits than this.
MAX_DIGITS = 300
# Hydra reads text between these as it is.
QUOTES = "'\""
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Command:
    """A command of the command line. Call it to start it.

    Args:
        name: Name of the command without pnb-. If there is a file conf/NAME.yaml, it says what
            the settings are composed of.
        settings: Class of the settings.
        body: "module:function". The function gets the settings.
        help: What --help says besides the settings.
        rewrite: Changes the words of the command line before Hydra reads them.
        sweeps: Whether the command takes --multirun.
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
        """Whether a file of conf/ says what the settings are composed of."""
        return (CONF / f"{self.name}.yaml").exists()

    @property
    def keys(self) -> dict[str, Any]:
        """Annotations of the keys of the command line. Groups of choices alone have None."""
        return dict.fromkeys(self.help.groups) | types_below(self.settings)

    def __call__(self) -> None:
        """Start the command with the words of the command line."""
        with exits_on_sigterm(), self.one_line():
            set_up_process()
            sys.argv[1:] = take_flag(sys.argv[1:])
            if not HELP_FLAGS.isdisjoint(sys.argv):
                print(self.format_help([word for word in sys.argv[1:] if word not in HELP_FLAGS]))
                skip_last_collection()
                return
            sys.argv[1:] = self.words(sys.argv[1:])
            start = hydra.main(version_base="1.3", config_path="pkg://conf", config_name=self.name)
            start(self.run)()

    def words(self, arguments: Sequence[str]) -> list[str]:
        """Put the words of the command line into the form that Hydra reads."""
        for argument in arguments:
            if argument in SWEEP_FLAGS and not self.sweeps:
                raise InputError(
                    f"{argument} is not an option of this command: "
                    "give settings as key=value; --help shows them",
                )
        # Hydra's parser of options wants --multirun before the settings.
        words = sorted(arguments, key=lambda word: word not in SWEEP_FLAGS)
        keys = self.keys
        present = [replace_former_key(word) for word in self.rewrite(words)]
        return [as_override(word, keys) for word in present]

    def run(self, config: DictConfig) -> None:
        """Run the command for a composed configuration. Hydra calls this method."""
        # Hydra would add a line to the message of an error.
        with self.one_line():
            self.work(config)

    def work(self, config: DictConfig) -> None:
        """Read the settings, and call the function of the command."""
        settings = read_settings(self.settings, config)
        import_function(self.body)(settings)

    def compose(self, overrides: Sequence[str] = ()) -> DictConfig:
        """Compose the configuration of the command without starting it.

        Args:
            overrides: Words of a command line.

        Returns:
            The configuration.

        Raises:
            InputError: If a word is wrong.
        """
        words = self.words(overrides)
        try:
            return compose(self.name, words)
        except (HydraException, OmegaConfBaseException, *INTERNAL_ERRORS) as error:
            sentence = explain(error, self.keys, words)
            if sentence is None:
                raise
            raise InputError(sentence) from error

    def read(self, overrides: Sequence[str] = ()) -> Any:
        """Return the settings that words of a command line give to the command."""
        return read_settings(self.settings, self.compose(overrides))

    @contextmanager
    def one_line(self) -> Iterator[None]:
        """Print an error of the user in one line, and exit with status 2.

        Ctrl-C ends in one line and status 130. If the reader of the output has gone, the command
        ends in silence with status 141.
        """
        try:
            yield
            # If the output is a closed pipe, this raises BrokenPipeError.
            print(end="", flush=True)
        except BrokenPipeError:
            # Python flushes the output once more at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(BROKEN_PIPE)
        except (Exception, KeyboardInterrupt) as error:
            # Some libraries turn KeyboardInterrupt into another error.
            if any(isinstance(cause, KeyboardInterrupt) for cause in causes(error)):
                print(INTERRUPTED, file=sys.stderr)
                sys.exit(128 + signal.SIGINT)
            from train.system.user_errors import user_message  # --help does not need it

            sentence = explain(error, self.keys, sys.argv[1:]) or user_message(error)
            if sentence is None:
                raise
            print(f"error: {sentence}", file=sys.stderr)
            sys.exit(USER_ERROR)

    def format_help(self, overrides: Sequence[str] = ()) -> str:
        """Return the text of --help, with the values that overrides give to the settings."""
        if not overrides and not self.has_file:
            # To compose the defaults takes twice as long as all else.
            return self.help.format(OmegaConf.structured(self.settings))
        # Hydra's own --help lists all groups, which takes longer than to compose the settings.
        return self.help.format(self.compose(overrides))


def compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose a configuration from the files of conf/.

    Args:
        name: Name of a command without pnb-.
        overrides: Overrides in the form that Hydra reads.

    Returns:
        The configuration.
    """
    # Hydra is initialized already while a command runs.
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(name, list(overrides))
    with initialize_config_module("conf", version_base="1.3"):
        return hydra.compose(name, list(overrides))


def set_up_process() -> None:
    """Set what all commands need, before torch is imported."""
    # Hydra then raises errors instead of printing them.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Waiting threads of torch then sleep, so that they do not slow down others.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    reuse_freed_memory()
    if Path(sys.argv[0]).stem.startswith(PREFIX):
        # Child processes must not import a train.py of the current folder.
        os.environ["PYTHONSAFEPATH"] = "1"
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    warnings.simplefilter("once", UserWarning, append=True)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # A terminal may lack some characters.
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def exits_on_sigterm() -> Iterator[None]:
    """Raise SystemExit on SIGTERM, so that launchers end their processes."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def import_function(path: str) -> Callable[..., Any]:
    """Import a function, given as "module:function".

    Ctrl-C ends the process at once meanwhile, since some modules swallow KeyboardInterrupt while
    they are imported.
    """
    module, _, name = path.partition(":")
    report = "loading PyTorch and other libraries ..."
    timer = threading.Timer(IMPORT_DELAY, print, [report], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    is_first = "torch" not in sys.modules
    before = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and before is signal.default_int_handler:  # background jobs ignore SIGINT
        signal.signal(signal.SIGINT, _end_at_once)
    try:
        function = getattr(import_module(module), name)
    finally:
        timer.cancel()
        if is_main:
            signal.signal(signal.SIGINT, before)
    if is_first:
        skip_last_collection()
    return cast(Callable[..., Any], function)


def skip_last_collection() -> None:
    """Keep Python from looking for cycles among all present objects at its end.

    That takes seconds after PyTorch is imported, and a fifth of the time of --help.
    """
    gc.freeze()


def _end_at_once(number: int, frame: object) -> None:
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(128 + number)


def read_settings(kind: type[Kind], config: DictConfig) -> Kind:
    """Convert a configuration to settings.

    Args:
        kind: Class of the settings.
        config: Values of its fields. Missing ones get their defaults.

    Returns:
        The settings.

    Raises:
        InputError: If a key is unknown or not set, or a value is wrong. The sentence begins with
            the key.
    """
    try:
        # The values of a saved configuration have no types yet.
        if OmegaConf.get_type(config) is not kind:
            config = cast(DictConfig, OmegaConf.merge(OmegaConf.structured(kind), config))
        return cast(Kind, _read_node(config, ""))
    except (OmegaConfBaseException, *INTERNAL_ERRORS) as error:
        sentence = explain(error, types_below(kind), ())
        if sentence is None:
            raise
        raise InputError(sentence) from error


def _read_node(node: DictConfig, key: str) -> Any:
    """Convert a node of a configuration to settings.

    Args:
        node: Node with the type of a settings class.
        key: Dotted key of the node. Empty for the whole configuration.

    Returns:
        Settings of this class. Groups inside of it are converted, too.

    Raises:
        InputError: If a value is missing or wrong.
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
    """Put a word of the command line into Hydra's form.

    Names and paths are quoted if Hydra would read 1.10 as 1.1, or refuse an umlaut. A single value
    for a list becomes a list of one. A + before a key is dropped, since every setting has a key.

    Args:
        argument: The word.
        keys: The annotation of each key.

    Returns:
        The word, as Hydra reads it.

    Raises:
        InputError: If a setting is to be removed.
    """
    if argument.startswith("~"):
        raise InputError(f"{argument}: a setting cannot be removed: set another value")
    key, equals, value = argument.partition("=")
    if key.startswith("+") and not key.lstrip("+").startswith("hydra"):
        key = key.lstrip("+")
        argument = f"{key}{equals}{value}"
    # The key is a part of a mapping, such as scene.projector.
    if keys.get(key.rpartition(".")[0]) is Any:
        return f"++{argument}"
    kind = without_none(keys.get(key))
    if get_origin(kind) is list:
        return _as_list(key, value, is_text=get_args(kind) == (str,))
    if kind is not str:
        return argument
    if not value or value[0] in "'\"~":  # quoted already, or a home folder, which Hydra refuses
        return argument
    try:
        parsed = OverridesParser.create().parse_override(argument).value()
        # Otherwise it is null, a list, a sweep ...
        is_kept = parsed == value or not isinstance(parsed, str | int | float)
    except HydraException:
        is_kept = False
    return argument if is_kept else f"{key}={quoted(value)}"


def _as_list(key: str, value: str, is_text: bool) -> str:
    """Write the override of a setting that is a list.

    Args:
        key: Key of the setting.
        value: Value in the words of the user. A list, null and a sweep stay the
            same. Any other value becomes a list of one member.
        is_text: Whether the members of the list are texts.

    Returns:
        Override such as "label=['orange']".
    """
    if not value or value.startswith("["):
        return f"{key}={value}"
    try:
        parsed = OverridesParser.create().parse_override(f"{key}={value}").value()
    except HydraException:  # Hydra refuses some paths.
        return f"{key}=[{quoted(value)}]"
    if isinstance(parsed, str) or (is_text and isinstance(parsed, int | float)):
        # A name in quotes keeps them.
        member = value if value[0] in QUOTES else quoted(value)
    elif isinstance(parsed, dict | int | float):
        member = value
    else:  # It is null or a sweep.
        return f"{key}={value}"
    return f"{key}=[{member}]"


def quoted(text: str) -> str:
    """Quote a text, so that Hydra reads it as it is.

    A backslash before a quote, or at the end, is doubled.
    """
    parts = text.split("'")
    escaped = [part + "\\" * (len(part) - len(part.rstrip("\\"))) for part in parts]
    return "'" + "\\'".join(escaped) + "'"


def causes(error: BaseException) -> Iterator[BaseException]:
    """Yield an error, and then the chain of errors that caused it."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def explain(error: BaseException, keys: Mapping[str, Any], words: Sequence[str]) -> str | None:
    """Say what is wrong with a configuration, in one sentence that begins with the key.

    Args:
        error: What Hydra or OmegaConf raised.
        keys: The annotation of each key.
        words: The words of the command line.

    Returns:
        The sentence. None if the error is of another kind.
    """
    # OmegaConf's error, which knows the key, is a cause of Hydra's.
    chain = list(causes(error))
    wrong = next((cause for cause in chain if getattr(cause, "full_key", None)), error)
    key = str(getattr(wrong, "full_key", None) or "")
    place = _file_of(error)
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


def _file_of(error: BaseException) -> str:
    """Name the file of conf/ that an error of Hydra is about.

    Returns:
        Text such as " (In 'attack')". Empty if the error names no file.
    """
    first = _first_line(error).partition(":")[0]
    return f" ({first})" if first.startswith("In ") else ""


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0].strip()


def _suggest(key: str, keys: Collection[str]) -> str:
    """Suggest the key that is most similar to an unknown one, or --help if none is similar."""
    close = get_close_matches(key, keys, 1, 0.5)
    return f"did you mean {close[0]}?" if close else "--help shows all settings"


def _explain_value(
    error: OmegaConfBaseException,
    key: str,
    keys: Mapping[str, Any],
    place: str,
) -> str:
    """Explain a value that does not have the type of its setting.

    Args:
        error: Error of OmegaConf.
        key: Key of the setting.
        keys: Annotation of each key.
        place: Text with the file of conf/ that has the value, or an empty text.
    """
    hint = without_none(keys.get(key))
    value = getattr(error, "value", None)
    noun = NOUNS.get(get_origin(hint) or hint)
    if noun:
        return f"{key}={'null' if value is None else value} must be {noun}{place}"
    if is_dataclass(hint):
        example = f"{key}.{fields(cast(Any, hint))[0].name}=..."
        return f"{key} is a group of settings{place}: set one of them, such as {example}"
    text = _first_line(error)
    return f"{key}: {text}{place}" if key and key not in text else f"{text}{place}"


def _explain_choice(file: str) -> str:
    """Explain a file of conf/ that does not exist."""
    group, _, choice = file.removesuffix(".yaml").rpartition("/")
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    return f"{group}={choice} is not a choice: choose one of {', '.join(options)}"


def _explain_overflow(words: Sequence[str]) -> str | None:
    """Explain the error of a whole number that is too large for a float.

    Args:
        words: Words of the command line.

    Returns:
        Sentence about the first such number. None if no word has one.
    """
    for word in words:
        key, _, value = word.partition("=")
        if value.lstrip("-").isdigit() and len(value) > MAX_DIGITS:
            return f"{key} is too large: give a smaller number"
    return None


def _explain_null_group(keys: Mapping[str, Any], words: Sequence[str]) -> str | None:
    """Explain the error of a setting inside a group that is null.

    For example, attack.geometry.radius cannot be set while attack.geometry is
    null.

    Args:
        keys: Annotation of each key.
        words: Words of the command line.

    Returns:
        Sentence about the first such setting. None if no word has one.
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
    """Return the words that start a command as this process was started.

    Args:
        name: Name of the command without pnb-.
        as_called: Use the path of this machine's interpreter or installed command.

    Returns:
        `pnb-NAME`, or `python -m` with a module of the clone; for several processes, by torchrun.
    """
    called = Path(sys.argv[0])
    count = int(os.environ.get("WORLD_SIZE", "1"))
    installed_name = f"{PREFIX}{name}"
    is_installed = bool(sys.flags.safe_path) or called.stem.startswith(PREFIX)
    python = [sys.executable] if as_called else ["python"]
    if is_installed:
        words = [str(called) if as_called and called.stem == installed_name else installed_name]
    else:
        words = ["-m", "train" if name == "train" else f"scripts.{name}"]
    if count > 1:
        torchrun = [*python, "-m", "torch.distributed.run"] if as_called else ["torchrun"]
        no_python = ["--no-python"] if is_installed else []
        return [*torchrun, f"--nproc_per_node={count}", *no_python, *words]
    return words if is_installed else [*python, *words]


def command_line(name: str) -> str:
    """Return the command line of this process, as a user can repeat it."""
    return shlex.join([*program(name), *sys.argv[1:]])
