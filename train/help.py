"""The text of --help, from the fields of a command's settings and the files of conf/."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, cast, get_args

from omegaconf import DictConfig, OmegaConf

import conf
from renderer.settings import facts_of, field_types

CONF = Path(conf.__path__[0])
# Width of the left column of --help, which has "key=value", in characters.
KEY_WIDTH = 44
# Width of the right column of --help, which explains the setting, in characters.
TEXT_WIDTH = 80
VERBOSE_HELP = "Print details. Without it, a command prints its result in at most 15 lines."


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
