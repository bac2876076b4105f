"""What every section of docs/paper.md is measured with, and what it is."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from augment.objects import ObjectSettings
from renderer.errors import require_range
from train.fit.recipe import MOST
from train.studies.paper.subjects import Subject

MOST_OF_EACH = 10**6


@dataclass
class SectionSettings:
    """A choice of conf/section. threads: of the CPU."""

    name: str
    threads: int

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, int | float):  # whole numbers count something
                require_range(f"section.{name}", value, int(isinstance(value, int)), MOST.get(name, MOST_OF_EACH))


@dataclass(frozen=True)
class Study:
    """The classifier under attack, the meshes to attack and the class that they show, and where attacks begin."""

    classifier: Classifier
    items: Sequence[ObjectSettings]
    light: str
    label: str
    seed: int

    @cached_property
    def subjects(self) -> list[Subject]:
        """The meshes, loaded."""
        return [Subject.load(item) for item in self.items]

    @property
    def meshes(self) -> str:
        """Their names, as words."""
        return " and ".join(subject.name for subject in self.subjects)


@dataclass(frozen=True)
class Section:
    """text: Markdown. records: what was measured, a line each. figures: by file name, what draws each."""

    text: str
    records: Iterable[Mapping[str, Any]]
    figures: Mapping[str, Callable[[Path], None]]
