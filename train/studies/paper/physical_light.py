"""What it costs an attack to find only light that something can emit."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from augment.attacks.run import logits_of
from augment.descent import DescentSettings, descend
from augment.goal import Goal
from augment.parameters import Lighting, StepSettings
from augment.perturbation import Perturbation
from augment.phases import Phases
from augment.scene import Scene
from renderer.harmonics import basis, project, quadrature
from renderer.transfer import DEGREE
from train.photographs.shares import share
from train.report.tables import markdown
from train.studies.page import filled
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import interval
from train.studies.paper.subjects import recognised_scene

BATCH = 10  # examples in a pass through the classifier
RADII = (0.02, 0.05, 0.1, 0.3, 1.0, None)
HEADER = ["radius", "any light", "its negative radiance left out", "physical light"]


@dataclass
class PhysicalLightSettings(SectionSettings):
    """examples: of each mesh. steps: of a descent at most."""

    examples: int
    steps: int


def measure(study: Study, settings: PhysicalLightSettings) -> Section:
    """Both attacks in all balls over the same images."""
    fooled: dict[float | None, list[Tensor]] = {radius: [] for radius in RADII}
    dips = []
    for subject in study.subjects:
        scene = recognised_scene(subject, study.classifier, study.light, settings.examples, study.seed)
        for radius in RADII:
            row, dip = _outcome(scene, study, radius, settings.steps)
            fooled[radius].append(row)
            dips.append(dip)
    records = [_record(radius, torch.cat(rows, dim=1)) for radius, rows in fooled.items()]
    cells = ([record["radius"] or "none", *map(interval, list(record.values())[1:])] for record in records)
    text = filled(
        __file__,
        count=sum(rows.shape[1] for rows in fooled[None]),
        meshes=study.meshes,
        classifier=study.classifier.name,
        label=study.label,
        probe=study.light,
        steps=settings.steps,
        table=markdown(HEADER, cells),
        dip=float(torch.cat(dips).median()),
    )
    return Section(text, records, {})


def _record(radius: float | None, fooled: Tensor) -> dict[str, Any]:
    return {"radius": radius} | {
        name: share(int(row.sum()), len(row))
        for name, row in zip(("signed", "clipped", "physical"), fooled, strict=True)
    }


def _outcome(scene: Scene, study: Study, radius: float | None, steps: int) -> tuple[Tensor, Tensor]:
    """((3, E') whether images that are recognised at both starts are fooled by light of either kind and by the first
    without its negative radiance, (E', 3) the least radiance of the first over its largest)."""
    label = study.classifier.label(study.label)
    goal = Goal(torch.full((len(scene), 1), label))
    step = StepSettings("linf", radius, *(("unit", 0.05) if radius is None else ("sign", radius / 4)))
    problems = [Perturbation(scene, [Lighting(scene, step, physical)]) for physical in (False, True)]
    descent = DescentSettings(steps, batch_size=BATCH)
    signed, physical = (
        descend(study.classifier, problem, goal, descent, Phases(scene.lights.device)) for problem in problems
    )
    recognised = ~(signed.fooled_before | physical.fooled_before)
    lights = signed.values.unflatten(1, (-1, 3))
    images = problems[0].render(_without_negative(lights).flatten(1), problems[0].everything)
    clipped = (logits_of(study.classifier, images, BATCH).argmax(2) != label).any(1)
    radiance = torch.stack([_radiance(quadrature(4 * DEGREE)[0], light) for light in lights[recognised]])
    fooled = torch.stack([signed.fooled, clipped, physical.fooled])
    return fooled[:, recognised], radiance.amin(1) / radiance.amax(1)


def _without_negative(lights: Tensor) -> Tensor:
    """Lights (E, 49, 3) as environment maps hold them, from which what is negative is left out."""
    clipped = [project(partial(_positive_radiance, light), DEGREE) for light in lights]
    return torch.stack(clipped).to(lights)


def _positive_radiance(light: Tensor, directions: Tensor) -> Tensor:
    return _radiance(directions, light).clamp(min=0)


def _radiance(directions: Tensor, light: Tensor) -> Tensor:
    return basis(directions, DEGREE) @ light.to(directions)
