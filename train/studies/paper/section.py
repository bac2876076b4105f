"""What every section of docs/paper.md is measured with, and what it is."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from augment.objects import ObjectSettings
from train.studies.paper.subjects import Subject


@dataclass
class SectionSettings:
    """A choice of conf/section. threads: of the CPU."""

    name: str
    threads: int


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
