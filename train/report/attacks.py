"""Attacks, read from their folders: what became of each example, its images and lights, and the command."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from PIL import Image

from augment.attacks.figure import read_figure
from augment.attacks.files import LINES
from renderer.errors import InputError, in_one_line
from renderer.io.tiles import Tile
from train.photographs.contact_sheet import evenly
from train.report.blocks import Block, Code, Gallery, Illustration, Section
from train.report.command import attack_command
from train.report.images import encoded, from_file
from train.report.tables import Table
from train.run_folder.files import CONFIG, read_config

LARGEST = 2**24  # bytes of attack.jsonl
MOST_ATTACKS, MOST_ROWS = 12, 30  # with a section of their own, and in its table
EXAMPLES, VIEWS, WIDTH = 4, 2, 176  # with images, and CSS pixels of each: two beside each other on a phone


@dataclass(frozen=True)
class Example:
    """What a line of attack.jsonl says. before: None in one of an older version."""

    number: int
    label: str
    before: str | None
    after: str
    success: bool
    success_before: bool
    steps: int

    @property
    def outcome(self) -> str:
        if self.success_before:
            return "wrong before any step"
        return f"{'fooled' if self.success else 'not fooled'} in {self.steps} steps"


@dataclass(frozen=True)
class Attack:
    """An attack's folder. checks: by name, where they were made."""

    folder: Path
    examples: Sequence[Example]
    checks: dict[str, Any]

    @property
    def success(self) -> int:
        """How many examples, without those that were wrong before any step."""
        return sum(each.success and not each.success_before for each in self.examples)

    @property
    def success_before(self) -> int:
        return sum(each.success_before for each in self.examples)


def read_attack(folder: Path) -> Attack:
    """InputError naming a file that no attack wrote."""
    path = folder / LINES
    try:
        if path.stat().st_size > LARGEST:
            raise ValueError("it is too large")
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        examples = [_read_example(line) for line in lines if "example" in line]
        checks: object = next((line["checks"] for line in lines if "checks" in line), {})
        if not isinstance(checks, dict):
            raise ValueError("the checks are no object")
        return Attack(folder, examples, checks)
    except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} is damaged or no file of an attack ({in_one_line(error)})") from error


def _read_example(line: dict[str, Any]) -> Example:
    before = _answers(line["predicted_before"], line["confidence_before"]) if "predicted_before" in line else None
    return Example(
        number=int(line["example"]),
        label=", ".join(dict.fromkeys(map(str, line["label"]))),
        before=before,
        after=_answers(line["predicted"], line["confidence"]),
        success=bool(line["success"]),
        success_before=bool(line.get("success_before")),
        steps=int(line["steps"]),
    )


def _answers(names: Sequence[object], confidences: Sequence[float]) -> str:
    """Of each view."""
    return ", ".join(f"{share:.1%} {name}" for name, share in zip(names, confidences, strict=True))


def sections(attacks: Sequence[Attack]) -> Iterator[Section]:
    for attack in attacks[:MOST_ATTACKS]:
        yield Section(f"Attack {attack.folder.parent.name}/{attack.folder.name}", [*_blocks(attack)])
    if others := attacks[MOST_ATTACKS:]:
        told = "\n".join(f"{each.folder}: {each.success} of {len(each.examples)} fooled" for each in others)
        yield Section("Further attacks", [Code(f"{len(others)} more", told)])


def _blocks(attack: Attack) -> Iterator[Block]:
    for example in evenly(attack.examples, EXAMPLES):
        yield from _galleries(attack.folder / f"example_{example.number:03d}.png", example)
    header = ["example", "label", "before", "after", "outcome"]
    rows = [[each.number, each.label, each.before, each.after, each.outcome] for each in attack.examples[:MOST_ROWS]]
    yield Table("", header, rows)
    if checks := [[name, value] for name, value in attack.checks.items() if not isinstance(value, dict)]:
        yield Table("Checks", ["what", "value"], checks)
    try:
        config = read_config(attack.folder.parent / CONFIG)
        yield Code("command", attack_command(config))
        yield Code("configuration", OmegaConf.to_yaml(config))
    except (InputError, AttributeError, yaml.YAMLError):  # of another version
        return


def _galleries(path: Path, example: Example) -> Iterator[Gallery]:
    """Before, after, their difference and the lights, for each of up to VIEWS views."""
    title = f"Example {example.number}, {example.label}: {example.outcome}"
    try:
        columns = read_figure(path)
        views = [*enumerate(zip(*(tiles for _, tiles in columns), strict=True), start=1)]
    except ValueError:  # an older version's, which does not tell where its tiles are
        alt = f"{title}; before, after, their difference and the lights; called {example.after} in the end"
        yield Gallery(title, from_file(path, alt, 1100))
        return
    for view, tiles in evenly(views, VIEWS):
        named = title if len(views) == 1 else f"{title}; view {view} of {len(views)}"
        shown = [_illustration(named, name, tile) for (name, _), tile in zip(columns, tiles, strict=True)]
        yield Gallery(named, shown)


def _illustration(title: str, name: str, tile: Tile) -> Illustration:
    text = ": ".join(filter(None, [name, " / ".join(tile.caption)]))
    return encoded(Image.fromarray(tile.image), f"{title}: {text}", WIDTH, text)
