"""What every section of docs/paper.md is measured with, and what it is.

A section is a module with a TITLE, Settings, a function `measure`, and the Markdown beside it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from augment.objects import ObjectSettings, SceneObject
from renderer.errors import require_range
from train.attacks.settings import AttackExperimentSettings
from train.command_line.configuration import composed, read_settings
from train.fit.recipe import MOST
from train.studies.paper.subjects import load_subject

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
    def subjects(self) -> list[SceneObject]:
        """The meshes, loaded."""
        return [load_subject(item) for item in self.items]

    @property
    def meshes(self) -> str:
        """Their names, as words."""
        return " and ".join(subject.name for subject in self.subjects)

    def command(self, item: ObjectSettings, overrides: Sequence[str]) -> AttackExperimentSettings:
        """What scripts/attack.py is told: its own configuration under overrides, but for the mesh and the light."""
        config = composed("attack", overrides)
        config.scene.meshes, config.scene.light = [asdict(item)], self.light
        return read_settings(AttackExperimentSettings, config)


@dataclass(frozen=True)
class Section:
    """values: of the section's Markdown, beside the study and its settings. records: what was measured, a line each.
    figures: by file name, what draws each."""

    values: Mapping[str, object]
    records: Iterable[Mapping[str, Any]]
    figures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)
