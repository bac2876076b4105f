"""A command: a settings class, a function of the library, and `main`.

    examples = ["pnb-compare runs=[a,b]"]
    main = Command("compare", "train.command_settings:CompareSettings", __doc__, examples)

Hydra reads the command line and the files of conf/. It puts them into the settings class, which
is typed and checks its values. A mistake of the user is printed in one line that begins with the
key, and the exit status is 2. After that, `run` of the module train.commands.NAME does the work:
that module takes seconds to import.

Only this layer knows keys of the command line. The library raises an InputError that names a
Python argument, and `InputError.within` puts the key in front.
"""

import json
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Any, TypeVar, cast, get_args, get_origin

import hydra
import yaml
from hydra import initialize_config_module
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString, Sweep
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

import conf
from renderer.errors import InputError, explained, keyed
from renderer.settings import Settings, facts_of, field_types
from train import system

# Exit status after an error of the user.
USER_ERROR = 2
# Exit status of a process that SIGPIPE ends: 128 plus the number of the signal.
# Windows does not have that signal.
BROKEN_PIPE = 141
SWEEP_FLAGS = {"--multirun", "-m"}
HELP_FLAGS = {"--help", "-h"}
# Quotation marks. Hydra does not parse the text between two of them.
QUOTES = "'\""
CONF = Path(conf.__path__[0])
# Width of the left column of --help, which has "key=value", in characters.
KEY_WIDTH = 46
# Width of the right column of --help, which explains the setting, in characters.
TEXT_WIDTH = 80
VERBOSE_HELP = "Print details. Without it, a command prints its result in at most 15 lines."
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Command:
    """A command of the command line. Calling the object starts the command.

    Args:
        name: Name of the command without "pnb-". If there is a file conf/NAME.yaml, Hydra
            composes the settings as this file says.
        settings: Class of the settings, as "module:class".
        about: What the command does, for --help.
        examples: Command lines, for --help.
        common: Keys of the settings that are changed most often, for --help.
        groups: Groups of choices, such as "experiment" for experiment=NAME. A group is a folder
            of conf/ with a file for each choice. "attack@augment.attack" is the folder conf/attack,
            whose files set augment.attack.
        rewrite: Function that changes the arguments of the command line before Hydra reads them.
        sweep: Function that starts several runs for --multirun, as "module:function". It takes
            the function that starts Hydra, the list of `expand` and the first configuration. If
            it is empty, Hydra starts the runs. A command without the group "launcher" has no
            --multirun.
    """

    name: str
    settings: str
    about: str
    examples: Sequence[str] = ()
    common: Sequence[str] = ()
    groups: Sequence[str] = ()
    rewrite: Callable[[list[str]], list[str]] = list
    sweep: str = ""

    @cached_property
    def kind(self) -> type[Settings]:
        """Class of the settings."""
        return cast(type[Settings], resolve_name(self.settings))

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
        return dict.fromkeys(self.groups) | types_below(self.kind)

    def register(self) -> None:
        """Tell Hydra the settings class, which is converted once, since that takes long."""
        store = ConfigStore.instance()
        if f"{self.name}_settings.yaml" in store.repo:
            return
        store.store(f"{self.name}_settings", self.kind)
        if not self.has_file:
            store.store(self.name, {"defaults": [f"{self.name}_settings", "command"]})

    def __call__(self) -> None:
        """Start the command with the arguments of this process."""
        with self.handle_errors():
            system.set_up_process()
            # `take_flag` removes --verbose, which no settings class has.
            words = system.take_flag(sys.argv[1:])
            # Settings that are given beside --help appear in its text.
            if not HELP_FLAGS.isdisjoint(words):
                print(self.format_help([word for word in words if word not in HELP_FLAGS]))
                system.skip_last_collection()
                return
            self.register()
            # Hydra reads the overrides from sys.argv, composes the configuration, and calls
            # `self.run` with it.
            sys.argv[1:] = self.to_overrides(words)
            start = hydra.main("pkg://conf", self.name, version_base="1.3")(self.run)
            # With --multirun, the function `sweep` of this command starts several runs.
            if SWEEP_FLAGS.isdisjoint(words) or not self.sweep:
                start()
            else:
                runs = expand(sys.argv[1:])
                # A mistyped key is answered before the import of torch.
                first_config = self.compose(runs[0], as_typed=False)
                system.import_function(self.sweep)(start, runs, first_config)

    def to_overrides(self, arguments: Sequence[str]) -> list[str]:
        """Convert the arguments of the command line to overrides that Hydra reads."""
        for flag in SWEEP_FLAGS.intersection(arguments):
            if "launcher" not in self.groups:
                raise InputError(f"{flag} is not an option of this command: see --help")
        # Hydra's parser of options wants --multirun before the settings.
        words = self.rewrite(sorted(arguments, key=lambda argument: argument not in SWEEP_FLAGS))
        keys = self.keys
        return [as_override(word, keys) for word in words]

    def run(self, config: DictConfig) -> None:
        """Run the command, and report errors. Hydra calls this method."""
        # An error that reached Hydra would get another line in its message.
        with self.handle_errors():
            settings = read_settings(self.kind, config)
            system.import_function(f"train.commands.{self.name}:run")(settings)

    def compose(self, overrides: Sequence[str] = (), as_typed: bool = True) -> DictConfig:
        """Compose the configuration of the command without starting it.

        The overrides are arguments `as_typed` by a user, or are in the form that Hydra reads.
        """
        self.register()
        words = self.to_overrides(overrides) if as_typed else list(overrides)
        # While a command runs, Hydra is initialized, and must not be initialized again.
        if GlobalHydra.instance().is_initialized():
            return hydra.compose(self.name, words)
        with initialize_config_module("conf", version_base="1.3"):
            return hydra.compose(self.name, words)

    def read(self, overrides: Sequence[str] = (), as_typed: bool = True) -> Any:
        """Return the settings that the command would have with the arguments of `compose`."""
        return read_settings(self.kind, self.compose(overrides, as_typed))

    @contextmanager
    def handle_errors(self) -> Iterator[None]:
        """Print an error of the user in one line, and exit with status 2.

        Ctrl-C prints one line, too, and exits with status 130. If the program that reads the
        output has ended, as in `pnb-compare ... | head`, the command exits with status 141 and
        prints nothing. All other errors are raised.
        """
        try:
            # Relative paths mean nothing in a folder that was deleted.
            with explained("the current folder is gone", "change to another folder", "", OSError):
                os.getcwd()
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
                print(system.INTERRUPTED, file=sys.stderr)
                sys.exit(128 + signal.SIGINT)
            sentence = system.user_message(error) or explain(error, self.keys, sys.argv[1:])
            if sentence is None:
                raise
            print(f"error: {sentence}", file=sys.stderr)
            sys.exit(USER_ERROR)

    def format_help(self, overrides: Sequence[str] = ()) -> str:
        """Return the text of --help, which shows the value of each setting."""
        if overrides:
            config = self.compose(overrides)
        else:
            # Without Hydra, --help takes two thirds of the time.
            config = OmegaConf.structured(self.kind)
            files = [*_default_files(self.name, "", {})] if self.has_file else []
            for package, values in reversed(files):
                OmegaConf.select(config, package).merge_with(values)
        # The line about each setting, by its dotted key.
        lines = dict(_setting_lines(config))
        sections = {
            "Examples:": [f"  {example}" for example in self.examples],
            "Changed most often:": [lines[key] for key in self.common],
            "Choices:": [line for group in self.groups for line in _choice_lines(group)],
            "Options:": [_format_line("-v, --verbose", VERBOSE_HELP)],
            "Settings:": lines.values(),
        }
        texts = ["\n".join([title, *rows]) for title, rows in sections.items() if rows]
        return "\n\n".join([self.about.strip(), *texts])


def expand(words: Sequence[str]) -> list[list[str]]:
    """List the settings of each run of a sweep, in the order in which Hydra starts them.

    "seed=0,1" and "train.epochs=3" become a list of overrides for each combination. Options such as
    --multirun are left out.
    """
    overrides = [word for word in words if not word.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(overrides)
    [runs] = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    return runs


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


def _default_files(name: str, package: str, chosen: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield the package and the values of a file of conf/ and of its defaults, the last first.

    `chosen` collects the choices of entries such as "override /data: shapes", by group. Of several
    choices for a group, that of the last file counts, which comes first here.
    """
    text = (CONF / f"{name}.yaml").read_text(encoding="utf-8")
    values = yaml.load(text, system.YAML_LOADER)
    header = re.match(r"# @package (\S+)", text)
    entries = values.pop("defaults", [])
    values.pop("hydra", None)
    yield (header[1] if header else package).removeprefix("_global_"), values
    folder = name.rpartition("/")[0]
    for entry in reversed(entries):
        [(key, choice)] = [(folder, entry)] if isinstance(entry, str) else entry.items()
        group, _, inner = key.partition("@")
        if group.startswith("override /"):
            chosen.setdefault(group.removeprefix("override /"), choice)
        # The entries without a group are the settings class and the settings of Hydra.
        elif group:
            choice = chosen.get(group, choice) or []
            for file in reversed([choice] if isinstance(choice, str) else choice):
                yield from _default_files(f"{group}/{file}", inner or group, chosen)


def _choice_lines(group: str) -> Iterator[str]:
    """Yield the lines of --help about choices, with the first sentence of their files' comment."""
    for path in sorted((CONF / group.partition("@")[0]).glob("*.yaml")):
        lines = path.read_text(encoding="utf-8").splitlines()
        text = " ".join(line[2:] for line in lines if re.match("# (?!@package)", line))
        yield _format_line(f"{group}={path.stem}", text.partition(". ")[0].removesuffix("."))


def _setting_lines(node: DictConfig, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the line of --help about each setting in a configuration or in a group of it."""
    kind = cast(type, OmegaConf.get_type(node))
    for name, value in cast(dict[str, Any], OmegaConf.to_container(node)).items():
        key = f"{prefix}{name}"
        child = node._get_node(name)
        # A group of settings has a line of its own before those of its settings.
        if value is not None and is_dataclass(OmegaConf.get_type(child)):
            yield key, _format_line(f"{key}.", facts_of(kind, name).about)
            yield from _setting_lines(cast(DictConfig, child), f"{key}.")
        else:
            shown = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            yield key, _format_line(f"{key}={shown}", format_facts(kind, name))


def format_facts(kind: type, name: str) -> str:
    """Format the explanation of a setting with its choices, its unit and its range.

    The text is such as "Weight decay. [≥ 0, ≤ 100000]".
    """
    facts = facts_of(kind, name)
    limits = [f"{sign} {end:g}" for _, sign, _, end in facts.limits]
    given = "; ".join(filter(None, [" | ".join(facts.choices), facts.unit, ", ".join(limits)]))
    return f"{facts.about} [{given}]" if given else facts.about


def _format_line(left: str, right: str) -> str:
    """Format two columns. A long text on the left gets a line of its own above the right text."""
    lines = textwrap.wrap(right, TEXT_WIDTH, break_long_words=False, break_on_hyphens=False)
    above = "" if len(left) < KEY_WIDTH - 3 else f"  {left}\n"
    beside = f"  {'' if above else left}".ljust(KEY_WIDTH)
    return (above + beside + f"\n{' ' * KEY_WIDTH}".join(lines)).rstrip()


def read_settings(kind: type[Kind], config: DictConfig, *changes: Mapping[str, Any]) -> Kind:
    """Convert a configuration of Hydra to an object of a settings class, after changes.

    Missing fields get their defaults. Messages of InputError begin with the key.
    """
    try:
        # A configuration that was read from a file does not know the types of its
        # values. Merging it into the class checks them.
        if changes or OmegaConf.get_type(config) is not kind:
            config = cast(DictConfig, OmegaConf.merge(OmegaConf.structured(kind), config, *changes))
        return cast(Kind, _read_node(config, ""))
    except OmegaConfBaseException as error:
        raise InputError(explain(error, types_below(kind), ()) or str(error)) from error


def _read_node(node: DictConfig, key: str) -> Any:
    """Convert the group of settings with a dotted key ("" for all) to its settings class."""
    kind = cast(type, OmegaConf.get_type(node))
    # The values of the settings in this group. Groups inside it become settings classes first.
    values: dict[str, Any] = {}
    for name in [item.name for item in fields(cast(Any, kind))]:
        inner = f"{key}.{name}" if key else name
        if OmegaConf.is_missing(node, name):
            raise InputError(f"{inner} is not set: give {inner}=...", inner)
        value = node[name]
        if is_dataclass(OmegaConf.get_type(value)):
            value = _read_node(value, inner)
        elif OmegaConf.is_config(value):
            value = OmegaConf.to_container(value, resolve=True)
        values[name] = value
    # The class knows only its own names, so the message gets the key of the group.
    with keyed(key, **{name: f"{key}.{name}" if key else name for name in values}):
        return kind(**values)


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
    if not key.lstrip("+").startswith("hydra"):
        key = key.lstrip("+")
    # A shell leaves "~/" as it is between quotes and in lists.
    value = re.sub(r"(?<![^\[{,:\s'\"])~(?=/)", lambda _: os.path.expanduser("~"), value)
    kind = without_none(keys.get(key))
    # A key such as attack@augment.attack chooses a file of the folder conf/attack.
    choices = key.partition("@")[0]
    if (CONF / choices).is_dir() and re.fullmatch(r"null|true|false|[-+.\d]+", value):
        # Hydra raises an error of the program for a choice that is no text.
        raise InputError(_explain_choice(choices, value))
    if keys.get(key.rpartition(".")[0]) is Any:
        # A setting of type Any can hold a mapping, such as scene.projector. Hydra sets a
        # key of a mapping, which may be absent, only if the override begins with "++".
        key = f"++{key}"
    elif kind is str:
        value = _as_text(value)
    elif get_origin(kind) is list and value and not value.startswith("["):
        value = _as_list(value, is_text=get_args(kind) == (str,))
    return f"{key}{equals}{value}"


def _parsed(value: str) -> Any:
    """Return what Hydra reads for a value of the command line, or raise HydraException."""
    return OverridesParser.create().parse_override(f"key={value}").value()


def _as_text(value: str) -> str:
    """Quote a text if Hydra would change or refuse it.

    The members of a list and of a sweep are texts, too: classes can be named true or 007.
    """
    # A value that still begins with "~" names the home folder of a user. The error of
    # Hydra about it is better than a quoted path that does not exist.
    if not value or value[0] in (*QUOTES, "~"):
        return value
    try:
        parsed = _parsed(value)
    except HydraException:
        return quoted(value)
    is_list = isinstance(parsed, list)
    inner = value[1:-1] if is_list else value
    if isinstance(parsed, list | Sweep) and not set("[](){}" + QUOTES) & set(inner):
        members = ",".join(_as_text(item.strip()) for item in inner.split(","))
        return f"[{members}]" if is_list else members
    return quoted(value) if isinstance(parsed, str | int | float) and parsed != value else value


def _as_list(value: str, is_text: bool) -> str:
    """Write the only value of a list setting as a list with this member, except null and sweeps."""
    try:
        parsed = _parsed(value)
    except HydraException:  # Hydra refuses some paths.
        return f"[{quoted(value)}]"
    if parsed is None or isinstance(parsed, Sweep):
        return value
    is_name = isinstance(parsed, str) or (is_text and isinstance(parsed, int | float))
    return f"[{quoted(value)}]" if is_name and value[0] not in QUOTES else f"[{value}]"


def quoted(text: str) -> str:
    """Put a text between single quotes, so that Hydra reads it unchanged."""
    return QuotedString(text, Quote.single).with_quotes()


def causes(error: BaseException) -> Iterator[BaseException]:
    """Yield an error, then the error that caused it, then the cause of that error, and so on."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def explain(error: BaseException, keys: Mapping[str, Any], words: Sequence[str]) -> str | None:
    """Explain an error of Hydra or OmegaConf in one sentence that begins with the key.

    `words` are the overrides. None if neither Hydra nor OmegaConf raised the error.
    """
    # An error of Hydra is often caused by an error of OmegaConf. Only the error of
    # OmegaConf has the attribute `full_key`, the key of the wrong setting.
    wrong = next((cause for cause in causes(error) if getattr(cause, "full_key", None)), error)
    key = str(getattr(wrong, "full_key", None) or "")
    if isinstance(wrong, ConfigKeyError | ConfigAttributeError):
        # The group may be wrong, and the name right or nearly right. Of keys with the same name,
        # the first one in the fewest groups is meant.
        by_depth = sorted(keys, key=lambda known: known.count("."))
        by_name = {known.rpartition(".")[2]: known for known in reversed(by_depth)}
        names = get_close_matches(key.rpartition(".")[2], by_name, 1, 0.8)
        close = get_close_matches(key, keys, 1, 0.9) or [by_name[name] for name in names]
        close = close or get_close_matches(key, keys, 1, 0.75)
        advice = f"did you mean {close[0]}?" if close else "--help shows all settings"
        return f"{key} is not a setting: {advice}"
    if isinstance(wrong, MissingConfigException) and wrong.missing_cfg_file:
        group, _, choice = wrong.missing_cfg_file.partition("/")
        return _explain_choice(group, choice)
    if isinstance(wrong, OverrideParseException):
        advice = "give KEY=VALUE, as --help shows"
        if "=" in str(wrong.override):
            example = "as in meshes=['a b.glb']"
            advice = f"put texts with umlauts, spaces or brackets in quotes, {example}"
        return f"{wrong.override} cannot be read: {advice}"
    if isinstance(wrong, OmegaConfBaseException | HydraException):
        text = re.split(r"\n *(?:full_key|Config search path|See https)", str(wrong))[0]
        sentence = " ".join(text.split())
        return f"{key}: {sentence}" if key else sentence
    if isinstance(wrong, AssertionError) or "full_key" in str(wrong):
        # For a mapping that is merged into a group that is null, such as attack.geometry, OmegaConf
        # names the group. For a setting in such a group, it names nothing.
        named = re.search(r"full_key: (\S+)", str(wrong))
        parents = [word.partition("=")[0].rpartition(".")[0] for word in words]
        types = {group: keys.get(group) for group in ([named[1]] if named else parents)}
        null = [group for group, kind in types.items() if NoneType in get_args(kind)]
        unset = [group for group in null if is_dataclass(without_none(types[group]))]
        return f"{unset[0]} is null: choose it first, as --help shows" if unset else None
    return None


def _explain_choice(group: str, choice: str) -> str:
    """Explain the error of a choice, such as attack=light, for which conf/ has no file."""
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    return f"{group}={choice} is not a choice: choose one of {', '.join(options)}"
