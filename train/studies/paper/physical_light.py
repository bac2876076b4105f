"""What it costs an attack to find only light that something can emit."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from augment.attacks.attack import logits_of
from augment.attacks.criteria import Goal
from augment.attacks.descent import DescentSettings, descend
from augment.attacks.parameters import AttackProblem, Lighting, StepSettings
from augment.scene import Scene
from augment.utils import Phases
from renderer.harmonics import basis, project
from renderer.transfer import DEGREE
from train.photographs.shares import share
from train.report.tables import markdown
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import interval
from train.studies.paper.subjects import PART, recognised_scene

TITLE = "Light that something can emit"


@dataclass
class Settings(SectionSettings):
    """examples: of each mesh. steps: of a descent at most."""

    examples: int
    steps: int


RADII = (0.02, 0.05, 0.1, 0.3, 1.0, None)
HEADER = ["radius", "any light", "its negative radiance left out", "physical light"]


def measure(study: Study, settings: Settings) -> Section:
    """Both attacks in all balls over the same images."""
    scenes = [
        recognised_scene(subject, study.classifier, study.light, settings.examples, study.seed)
        for subject in study.subjects
    ]
    records = []
    for radius in RADII:
        success = torch.cat([outcome(scene, study, radius, settings.steps) for scene in scenes], dim=1)
        records.append(record(radius, success))
    cells = ([each["radius"] or "none", *map(interval, list(each.values())[1:])] for each in records)
    return Section({"count": success.shape[1], "table": markdown(HEADER, cells)}, records)


def record(radius: float | None, success: Tensor) -> dict[str, Any]:
    names = ("signed", "clipped", "physical")
    return {"radius": radius} | {
        name: share(int(row.sum()), len(row)) for name, row in zip(names, success, strict=True)
    }


def outcome(scene: Scene, study: Study, radius: float | None, steps: int) -> Tensor:
    """(3, E') bool: whether images that are recognised at both starts are fooled by any light, by this without its
    negative radiance, and by physical light."""
    label = study.classifier.label(study.label)
    goal = Goal(torch.full((len(scene), 1), label))
    step = StepSettings("linf", radius, *(("unit", 0.05) if radius is None else ("sign", radius / 4)))
    problems = [AttackProblem(scene, [Lighting(scene, step, physical)]) for physical in (False, True)]
    descent = DescentSettings(steps, batch_size=PART)
    signed, physical = (descend(study.classifier, problem, goal, descent, Phases()) for problem in problems)
    clipped = torch.stack([without_negative(light) for light in signed.values.unflatten(1, (-1, 3))])
    images = problems[0].render(clipped.flatten(1), problems[0].everything)
    predicted = logits_of(study.classifier, images, PART).argmax(2)
    success = torch.stack([signed.success, goal.reached(predicted), physical.success])
    return success[:, ~(signed.success_before | physical.success_before)]


def without_negative(light: Tensor) -> Tensor:
    """A light (49, 3) as an environment map holds it, from which what is negative is left out."""

    def radiance(directions: Tensor) -> Tensor:
        return (basis(directions, DEGREE) @ light.to(directions)).clamp(min=0)

    return project(radiance, DEGREE).to(light)
