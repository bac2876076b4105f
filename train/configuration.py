"""Hydra's configurations: composed under overrides, and read into the dataclasses that are their schema."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import hydra
from hydra import initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from renderer.errors import InputError, in_one_line
from train.errors import one_sentence

Settings = TypeVar("Settings")
TEXTS = {  # keys whose values are names or paths, also where they look like numbers
    *("run", "sweep", "init_from", "out", "photos", "path", "images", "cache"),
    *("weights", "light", "label", "target", "classifier", "name", "reload"),
}
PLAIN = re.compile(  # texts that Hydra reads as they are; numbers and true or false are no texts to it
    r"(?!([+-]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(e[+-]?\d+)?|[+-]?(inf|nan)|true|false)$)[\w./:@%+-]+$",
    re.ASCII | re.IGNORECASE,
)
SPECIAL = re.compile(r"[\[{'\"~]|\w+\(|.*[,$]")  # values that are more than one text, or refused


def quoted(text: str) -> str:
    """The text as a value that Hydra reads as it is."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"


def as_override(argument: str) -> str:
    """An argument of a command; names and paths are quoted where Hydra would read 1.10 as 1.1, or refuse an umlaut.

    InputError for an empty name, which would stand for the current folder, and for the removal of a setting.
    """
    if argument.startswith("~"):
        raise InputError(f"{argument}: a setting cannot be removed: set another value")
    key, equals, value = argument.partition("=")
    if not equals or TEXTS.isdisjoint(key.lstrip("+").split(".")):
        return argument
    if not value:
        raise InputError(f"{key} is empty: give a name, or leave it out")
    return argument if PLAIN.match(value) or SPECIAL.match(value) else f"{key}={quoted(value)}"


def compose(command: str, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a command under overrides; InputError with the text of Hydra, which names the override."""
    singleton = GlobalHydra.instance()
    running, singleton.hydra = singleton.hydra, None  # that of `python -m train`
    try:
        with initialize_config_module("conf", version_base="1.3"):
            return hydra.compose(command, [as_override(override) for override in overrides])
    except Exception as error:  # Hydra raises several types for what it cannot read
        raise InputError(one_sentence(error) or in_one_line(error)) from error
    finally:
        singleton.hydra = running


def read_settings(kind: type[Settings], config: DictConfig, key: str = "") -> Settings:
    """The dataclass from its configuration, which stands at a key.

    InputError names the key that is unknown, unset, of the wrong type or, by the dataclass's own check, out of range.
    """
    try:
        merged: Any = OmegaConf.merge(OmegaConf.structured(kind), config)
        if unset := OmegaConf.missing_keys(config) | OmegaConf.missing_keys(merged):
            raise InputError(f"{_join(key, min(unset))} is not set: give {_join(key, min(unset))}=...")
        _check(merged, key)
        return cast(Settings, OmegaConf.to_object(merged))
    except (OmegaConfBaseException, OverflowError) as error:  # the latter for a whole number that no float holds
        raise InputError(_fault(kind, config, key) or _join(key, one_sentence(error) or in_one_line(error))) from error


def _check(node: DictConfig, key: str) -> None:
    """InputError with the key of the innermost dataclass that refuses its values, or of a list of other things."""
    types: dict[Any, Any] = get_type_hints(OmegaConf.get_type(node))
    for name, child in node.items():
        inner = _join(key, str(name))
        if isinstance(child, DictConfig) and OmegaConf.get_type(child) is not dict:
            _check(child, inner)
        elif isinstance(child, ListConfig) and get_origin(types[name]) is list and get_args(types[name]) != (Any,):
            for index, item in enumerate(child):
                if OmegaConf.is_config(item):  # which OmegaConf lets pass
                    raise InputError(f"{inner}[{index}]: give a plain value, not a list or mapping")
    with keyed(key, types):
        OmegaConf.to_object(node)


def _fault(kind: type, config: DictConfig, key: str) -> str | None:
    """The key of the first value that is wrong by itself, with the reason; OmegaConf may name only its group."""
    plain: Any = OmegaConf.to_container(config)
    for name, value in dotted(plain):
        alone = OmegaConf.create()
        OmegaConf.update(alone, name, value, force_add=True)
        try:
            OmegaConf.merge(OmegaConf.structured(kind), alone)
        except (OmegaConfBaseException, OverflowError) as error:
            return f"{_join(key, name)}: {str(getattr(error, 'msg', error)).splitlines()[0]}"
    return None


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


@contextmanager
def keyed(key: str, names: Collection[str] = ()) -> Iterator[None]:
    """Add the key to an InputError, whose message begins with one of a dataclass's names or with another text."""
    try:
        yield
    except InputError as error:
        message = str(error)
        if not key or message.startswith(key):
            raise
        name = re.match(r"\w*", message)[0]  # type: ignore[index]
        if name in names:
            key, message = _join(key, name), message.removeprefix(f"{name}: ")
        raise InputError(f"{key}: {message}") from error


def dotted(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested settings by dotted key."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def is_within(key: str, groups: Collection[str]) -> bool:
    """Whether a dotted key is one of the groups, or within one."""
    return any(key == group or key.startswith(f"{group}.") for group in groups)
