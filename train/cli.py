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

import json
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, cast, get_args, get_origin

import hydra
from hydra import initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

import conf
from renderer.errors import InputError
from renderer.settings import Settings, facts_of, field_types
from train.system import (
    INTERRUPTED,
    exits_on_sigterm,
    import_function,
    require_current_folder,
    set_up_process,
    skip_last_collection,
    take_flag,
)

# Exit status after an error of the user.
USER_ERROR = 2
# Exit status of a process that SIGPIPE ends: 128 plus the number of the signal.
# Windows does not have that signal.
BROKEN_PIPE = 141
SWEEP_FLAGS = {"--multirun", "-m"}
HELP_FLAGS = {"--help", "-h"}
# Hydra and OmegaConf raise these errors for some mistakes of the user. The errors do not
# name the setting.
INTERNAL_ERRORS = (AssertionError, AttributeError)
# Quotation marks. Hydra does not parse the text between two of them.
QUOTES = "'\""
CONF = Path(conf.__path__[0])
# Width of the left column of --help, which has "key=value", in characters.
KEY_WIDTH = 44
# Width of the right column of --help, which explains the setting, in characters.
TEXT_WIDTH = 80
VERBOSE_HELP = "Print details. Without it, a command prints its result in at most 15 lines."
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class HelpText:
    """Texts that --help of a command shows before the list of its settings.

    Args:
        about: Sentence that says what the command does.
        examples: Command lines.
        common: Keys of the settings that are changed most often.
        groups: Groups of choices, such as "experiment" for experiment=NAME. A group is a folder
            of conf/ with a file for each choice. "attack@augment.attack" is the folder conf/attack,
            whose files set augment.attack.
    """

    about: str
    examples: Sequence[str] = ()
    common: Sequence[str] = ()
    groups: Sequence[str] = ()

    def format(self, config: DictConfig) -> str:
        """Return the whole text of --help."""
        lines = dict(_setting_lines(config))
        sections = [
            self.about,
            "\n".join(["Examples:", *(f"  {example}" for example in self.examples)]),
        ]
        if self.common:
            common = (lines[key] for key in self.common)
            sections.append("\n".join(["Changed most often:", *common]))
        if self.groups:
            sections.append("\n".join(["Choices:", *_choice_lines(self.groups)]))
        sections.append("\n".join(["Options:", _format_line("-v, --verbose", VERBOSE_HELP)]))
        sections.append("\n".join(["Settings:", *lines.values()]))
        return "\n\n".join(sections)


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
            from train.user_errors import user_message

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


def compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration of a command from the files of conf/ and from overrides."""
    # While a command runs, Hydra is initialized, and must not be initialized again.
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(name, list(overrides))
    with initialize_config_module("conf", version_base="1.3"):
        return hydra.compose(name, list(overrides))


def types_below(kind: type, prefix: str = "") -> dict[str, Any]:
    """Return the type annotation of each setting in a settings class and in its groups.

    Keys are dotted, and groups have entries, too. Settings of any type that are shown as text have
    the type `str`.
    """
    found: dict[str, Any] = {}
    for name, hint in field_types(kind).items():
        found[f"{prefix}{name}"] = str if facts_of(kind, name).is_text else hint
        field_type = without_none(hint)
        if is_dataclass(field_type):
            found |= types_below(cast(type, field_type), f"{prefix}{name}.")
    return found


def without_none(hint: Any) -> Any:
    """Remove None from a type annotation: `int | None` becomes `int`.

    A union of several types with None stays as it is.
    """
    options = [option for option in get_args(hint) if option is not NoneType]
    return options[0] if isinstance(hint, UnionType) and len(options) == 1 else hint


def _choice_lines(groups: Sequence[str]) -> Iterator[str]:
    """Yield the lines of --help about choices, such as "attack=lighting" and its explanation."""
    for group in groups:
        folder = CONF / group.partition("@")[0]
        for path in sorted(folder.glob("*.yaml")):
            yield _format_line(f"{group}={path.stem}", _first_comment(path))


def _first_comment(path: Path) -> str:
    """Return the first sentence of the comment at the start of a file of conf/.

    The sentence explains the choice that the file stands for.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line.removeprefix("# ") for line in lines if line.startswith("# ")]
    text = " ".join(line for line in comments if not line.startswith("@package"))
    return text.partition(". ")[0].removesuffix(".")


def _setting_lines(node: DictConfig, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the line of --help about each setting in a configuration or in a group of it."""
    kind = cast(type, OmegaConf.get_type(node))
    values = cast(dict[str, Any], OmegaConf.to_container(node))
    for name in field_types(kind):
        key = f"{prefix}{name}"
        child = node._get_node(name)
        is_group = isinstance(child, DictConfig) and is_dataclass(OmegaConf.get_type(child))
        if is_group and values[name] is not None:
            yield key, _format_line(f"{key}.", facts_of(kind, name).about)
            yield from _setting_lines(cast(DictConfig, child), f"{key}.")
        else:
            shown = f"{key}={_format_value(values[name])}"
            yield key, _format_line(shown, format_facts(kind, name))


def _format_value(value: Any) -> str:
    """Format the value of a setting as a user types it on the command line."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def format_facts(kind: type, name: str) -> str:
    """Format the explanation of a setting with its choices, its unit and its range.

    The text is such as "Weight decay. [≥ 0, ≤ 100000]".
    """
    facts = facts_of(kind, name)
    limits = [f"{limit.sign} {limit.end:g}" for limit in facts.limits]
    notes = [" | ".join(facts.choices), facts.unit, ", ".join(limits)]
    given = "; ".join(note for note in notes if note)
    return f"{facts.about} [{given}]" if given else facts.about


def _format_line(left: str, right: str) -> str:
    """Format two columns. A long text on the left gets a line of its own above the right text."""
    indent = " " * (KEY_WIDTH + 2)
    wrapped = textwrap.wrap(right, TEXT_WIDTH, break_long_words=False, break_on_hyphens=False)
    lines = [indent + line for line in wrapped]
    key = f"  {left}"
    fits = len(key) <= KEY_WIDTH
    if lines and fits:
        lines[0] = key.ljust(len(indent)) + wrapped[0]
    else:
        lines.insert(0, key)
    return "\n".join(lines)


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
    choices = key.partition("@")[0]
    if (CONF / choices).is_dir() and re.fullmatch(r"null|true|false|[-+.\d]+", value):
        # Hydra raises an error of the program for a choice that is no text.
        raise InputError(_explain_choice(f"{choices}/{value}"))
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
        # Classes can be named true, null or 007. Hydra would read them as values.
        members = zip(value[1:-1].split(","), parsed, strict=False)
        texts = [
            text if isinstance(member, str) else quoted(text.strip()) for text, member in members
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
        case OverrideParseException():
            advice = "quote the value for Hydra, and the quotes for the shell"
            return f"{wrong.override} cannot be read: {advice}"
        case MissingConfigException() if wrong.missing_cfg_file:
            return _explain_choice(str(wrong.missing_cfg_file))
        case OmegaConfBaseException() | HydraException():
            text = _first_line(wrong)
            return text if text.startswith(key) else f"{key}: {text}{place}"
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
    """Suggest the key that is most similar to a wrong key, or --help if no key is similar.

    A key of the same name in another group is the most similar one.
    """
    name = key.rpartition(".")[2]
    moved = [known for known in keys if known.rpartition(".")[2] == name]
    close = moved or get_close_matches(key, keys, 1, 0.5)
    return f"did you mean {close[0]}?" if close else "--help shows all settings"


def _explain_choice(file: str) -> str:
    """Explain the error of a choice, such as attack=light, for which conf/ has no file."""
    group, _, choice = file.removesuffix(".yaml").rpartition("/")
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    return f"{group}={choice} is not a choice: choose one of {', '.join(options)}"


def _explain_null_group(keys: Mapping[str, Any], words: Sequence[str]) -> str | None:
    """Explain the error of a setting inside a group that is null.

    For example, attack.geometry.radius cannot be set while attack.geometry is null.
    """
    for word in words:
        key = word.partition("=")[0]
        group = key.rpartition(".")[0]
        for name in (key, group):
            hint = keys.get(name)
            if is_dataclass(without_none(hint)) and get_args(hint):
                return f"{name} is null: choose it first, as --help shows"
    return None
