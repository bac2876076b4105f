"""Every trial: a door, what is hostile about it, and what may come of it."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from train.command_line.configuration import as_dict, composed, dotted
from train.studies.commands import Ending
from train.studies.reliability.damages import damages
from train.studies.reliability.doors import DOORS, Door, given
from train.studies.reliability.edits import Edit
from train.studies.reliability.process import USUAL, Surroundings

NAMES = [
    *("2024", "1e3", "true", "null", "2024-01-01", "1.10", "0x10", "a b", " a", "a,b", "[a]", "{a}", "(a)", "-a", "~a"),
    *("a=b", "=1+1", "$a", "${oc.env:HOME}", "a'b", 'a"b', "a\\b", "a:b", "a;b", "#a", "%s", "*", "\x1b[31m", "a\nb"),
    *("a" * 200, "a" * 300, "ünï", "日本", "a\udcffb"),
]
VALUES = ["-1", "0", "0.5", "nan", "inf", "1e+30", "1000000000000", "abc", "[]", "{a: 1}", "null", "''"]
CROWDED = {"no room": Surroundings(largest=1000), "output to a full disk": Surroundings(output="/dev/full")}
NOWHERE = ("background.png", "background.png/a", "/proc/none", "/dev/full", "a" * 300)  # where no folder can be made


@dataclass(frozen=True)
class Trial:
    """prepare: what makes a copy of the corpus hostile. named: words, one of which a refusal must have.

    refused: whether no other outcome is right.
    """

    door: Door
    kind: str
    name: str
    command: Sequence[str]
    named: tuple[str, ...] = ()
    refused: bool = False
    prepare: Callable[[Path], object] = lambda folder: None
    around: Surroundings = USUAL

    def fault(self, ending: Ending) -> str | None:
        """What is wrong with an outcome; None for a success and for a refusal as it should be."""
        match ending.status, ending.refusal:
            case None, _:
                return "hung"
            case 0, _:
                return "taken" if self.refused else None
            case status, None:
                return f"status {status}: {' | '.join(ending.errors.splitlines()[-2:])}"
            case _, refusal if self.named and not any(word in refusal for word in self.named):
                return f"neither {' nor '.join(self.named)} is named: {refusal}"
        return None


def all_trials(door: Door) -> Iterator[Trial]:
    yield from file_trials(door)
    yield from name_trials(door)
    if door is next(each for each in DOORS if each.config == door.config):
        yield from setting_trials(door)
    yield from place_trials(door)


def file_trials(door: Door) -> Iterator[Trial]:
    """Every damage of every file that it reads."""
    for key, files in door.inputs.items():
        for file in files:
            command = door.command(key.replace("{}", given(file)))
            named = (file.rpartition("/")[2], given(file), key.partition("=")[0])
            for damage in damages(file):
                words = (*named, "label") if "classes" in damage.name else named  # that lack it are told by the key
                refused = damage.refused and file != door.renewed and damage.name not in door.meant
                prepare = partial(_damage, damage.edit, file)
                yield Trial(door, damage.kind, f"{file}: {damage.name}", command, words, refused, prepare)


def _damage(edit: Edit, file: str, folder: Path) -> None:
    edit(folder / file)


def name_trials(door: Door) -> Iterator[Trial]:
    """Odd names of good files."""
    for key, files in door.inputs.items():
        good = given(files[0])
        for name in NAMES:
            odd = name + Path(good).suffix
            command = door.command(key.replace("{}", odd))
            yield Trial(door, "odd names", f"{key}: {name!r}", command, prepare=partial(_rename, good, odd))


def _rename(good: str, odd: str, folder: Path) -> None:
    if len(odd) < 256:  # which file systems take
        os.rename(folder / good, folder / odd)


def setting_trials(door: Door) -> Iterator[Trial]:
    """Values that each setting may not have been meant for."""
    groups = [override for override in door.arguments if override.startswith(("data=", "attack=", "augment="))]
    keys = [key for key, _ in dotted(as_dict(composed(door.config, groups)))]
    for key in [*keys, "unknown"]:
        for value in VALUES:
            setting, named = f"{key}={value}", (key, key.rpartition(".")[2], value.strip("'") or key)
            yield Trial(door, "settings", setting, door.command(setting), named)


def place_trials(door: Door) -> Iterator[Trial]:
    """Outputs without a place, and disks without room."""
    for name, around in CROWDED.items():
        yield Trial(door, "outputs", name, door.command(), around=around)
    if door.out:
        key = next(override.partition("=")[0] for override in door.arguments if f"={door.out}" in override)
        for place in NOWHERE:
            yield Trial(door, "outputs", f"{key}={place}", door.command(f"{key}={place}"), (key,), refused=True)
