"""The overrides on a command line: names stay text, and what Hydra refuses is said with the nearest valid key."""

import difflib
import os
import re
import traceback
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from renderer.errors import InputError
from train.command_line.configuration import as_dict

TEXTS = {  # keys of names and folders
    *("run", "sweep", "init_from", "out", "keep", "photos", "photographs", "path", "images", "cache"),
    *("weights", "light", "label", "target", "classifier", "name", "reload"),
}
NUMBER = re.compile(r"[+-]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(e[+-]?\d+)?|[+-]?(inf|nan)|true|false", re.IGNORECASE)
HYDRAS_ADVICE = re.compile(r"\n(?:To append|See https:|Config search path:)")  # begins what serves nobody here


def quoted(text: str) -> str:
    """A value of an override that is this text, whatever it looks like to Hydra."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"


def as_text(argument: str) -> str:
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


def is_hydras(error: Exception) -> bool:
    """Whether Hydra refused an override, in an error of its own or another that it raised."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return isinstance(error, HydraException) or innermost.f_globals["__name__"].startswith("hydra.")


def refusal(error: Exception, arguments: list[str], config_name: str) -> str:
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


def _suggestions(overrides: list[str], config_name: str) -> Iterator[str]:
    """For each override whose key is neither a key nor a group of the configuration that the groups make."""
    pairs = [override.partition("=") for override in overrides if "=" in override and override[0] != "+"]
    groups = compose(config_name, return_hydra_config=True).hydra.runtime.choices
    chosen = [f"{key}={value.split(',')[0]}" for key, _, value in pairs if key in groups]
    known = [*groups, *_keys(as_dict(compose(config_name, chosen, return_hydra_config=True)))]
    for key, _, _ in pairs:
        nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        if key not in known and nearest:
            yield f"nearest valid key to {key!r}: {nearest[0]}"


def _keys(settings: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """By their dotted names, groups of keys too."""
    for key, value in settings.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _keys(value, f"{prefix}{key}.")
