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
# Number of characters of a key with its value.
KEY_WIDTH = 44
# Number of characters of an explanation in a line.
TEXT_WIDTH = 80
VERBOSE_HELP = "Print details. Without it, a command prints its result in at most 15 lines."


@dataclass(frozen=True)
class HelpText:
    """Texts of a command in --help, besides its settings.

    Args:
        about: What the command does.
        examples: Command lines.
        common: Keys of the settings that are changed most often.
        groups: Groups of choices, as they are named on the command line. A group is a folder of
            conf/, or folder@key.
    """

    about: str
    examples: Sequence[str] = ()
    common: Sequence[str] = ()
    groups: Sequence[str] = ()

    def format(self, config: DictConfig) -> str:
        """Return the text for a composed configuration, whose values it shows."""
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
    """Return the annotation of each setting and each group of settings by its dotted key.

    Args:
        kind: Class of settings.
        prefix: Text before each key, such as "train.".

    Returns:
        Annotations, such as `int | None` for "epochs".
    """
    found: dict[str, Any] = {}
    for name, hint in field_types(kind).items():
        found[f"{prefix}{name}"] = str if facts_of(kind, name).is_text else hint
        part = without_none(hint)
        if is_dataclass(part):
            found |= types_below(cast(type, part), f"{prefix}{name}.")
    return found


def without_none(hint: Any) -> Any:
    """Return A for an annotation A or A | None, and any other annotation as it is."""
    options = [part for part in get_args(hint) if part is not NoneType]
    return options[0] if isinstance(hint, UnionType) and len(options) == 1 else hint


def _choice_lines(groups: Sequence[str]) -> Iterator[str]:
    """Yield a line for each choice of each group, such as "attack=lighting" with its comment."""
    for group in groups:
        folder = CONF / group.partition("@")[0]
        for path in sorted(folder.glob("*.yaml")):
            yield _format_line(f"{group}={path.stem}", _first_comment(path))


def _first_comment(path: Path) -> str:
    """Return the first sentence of the comment that begins a file of conf/."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line.removeprefix("# ") for line in lines if line.startswith("# ")]
    text = " ".join(line for line in comments if not line.startswith("@package"))
    return text.partition(". ")[0].removesuffix(".")


def _setting_lines(node: DictConfig, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the line of --help about each setting below a node.

    Args:
        node: Settings with their values.
        prefix: Text before each key, such as "train.".

    Yields:
        Dotted key of a setting or a group of settings, and its line.
    """
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
    """Format a value as it is given on the command line."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def format_facts(kind: type, name: str) -> str:
    """Format the explanation, the choices, the unit and the range of a field."""
    facts = facts_of(kind, name)
    limits = [f"{limit.sign} {limit.end:g}" for limit in facts.limits]
    notes = [" | ".join(facts.choices), facts.unit, ", ".join(limits)]
    given = "; ".join(note for note in notes if note)
    return f"{facts.about} [{given}]" if given else facts.about


def _format_line(left: str, right: str) -> str:
    """Put an explanation beside a key, or below it if the key is long."""
    indent = " " * (KEY_WIDTH + 2)
    wrapped = textwrap.wrap(right, TEXT_WIDTH, break_long_words=False, break_on_hyphens=False)
    lines = [indent + line for line in wrapped]
    key = f"  {left}"
    if lines and len(key) <= KEY_WIDTH:
        lines[0] = key.ljust(len(indent)) + wrapped[0]
    else:
        lines.insert(0, key)
    return "\n".join(lines)
