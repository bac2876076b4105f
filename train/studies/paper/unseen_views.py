"""Does a light or a shape found in a few views fool a network in others (Table 4)?"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.perturbation import Perturbation
from augment.scene import Scene
from augment.seeding import generator, stream_seed
from train.report.tables import markdown
from train.studies.paper.adversaries import ATTACKS, FURTHER, STEPS, with_random_signs
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import percent
from train.studies.paper.subjects import answers, finer, recognised_parts, recognised_scene

TITLE = "Unseen views"


@dataclass
class Settings(SectionSettings):
    """sets: of attacked views, of each mesh. views: unseen ones for each set."""

    sets: int
    views: int


ATTACKED = (1, 5)
STATES = {
    "first": "adversary as found",
    "further": f"adversary {FURTHER} steps on",
    "random": "random change as large as the last",
}
PAPER = {"lighting": {1: 29.4, 5: 64.2}, "geometry": {1: 0.6, 5: 3.6}}
FAR = 90  # degrees


def measure(study: Study, settings: Settings) -> Section:
    """All sets of attacked views of every mesh."""
    records = [
        record
        for subject in map(finer, study.subjects)
        for index in range(settings.sets)
        for record in unseen(subject, study.classifier, index, settings.views, study.light, study.seed)
    ]
    values = {
        "table": results(records, study.label),
        "far": far(records, study.label),
        "sets": settings.sets * len(study.subjects),
        "views": len(records),
        "further": FURTHER,
        "steps": STEPS,
    }
    return Section(values, records)


@dataclass(frozen=True)
class Together:
    """All examples of a problem, of one view each, as the views of a single one: one light or shape for all of them."""

    problem: Perturbation

    @property
    def start(self) -> Tensor:
        return self.problem.start[:1]

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        every = self.problem.everything
        return self.problem.render(values.expand(len(every), -1), every).transpose(0, 1)

    def step(self, gradient: Tensor) -> Tensor:
        return self.problem.step(gradient)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.problem.project(values, examples)


def attack_views(
    scene: Scene, kind: str, classifier: Classifier, label: str, draws: torch.Generator
) -> dict[str, Tensor]:
    """What one attack on all of a scene's examples, of one view each, ends with: (1, D) for each of STATES."""
    together = Together(ATTACKS[kind].problem(scene))
    first, further = ATTACKS[kind].adversaries(together, classifier, label, views=len(scene))
    random = with_random_signs(further, together.start, draws)
    return dict(zip(STATES, (first, further, random), strict=True))


def unseen(
    subject: SceneObject, classifier: Classifier, index: int, count: int, light: str, seed: int
) -> Iterator[dict[str, Any]]:
    """A record per unseen view of a subject: what it is called under all that was found in one set of views."""
    draws = generator(seed, subject.name, "unseen views", index)
    scenes = {
        views: recognised_scene(subject, classifier, light, views, stream_seed(seed, "attacked", views, index))
        for views in ATTACKED
    }
    found = {
        (kind, views): attack_views(scene, kind, classifier, subject.label, draws)
        for kind in ATTACKS
        for views, scene in scenes.items()
    }
    for scene in recognised_parts(subject, classifier, light, count, draws):
        said = {
            f"{kind}, {views} attacked": {
                state: answers(classifier, ATTACKS[kind].problem(scene).images(values.expand(len(scene), -1)))
                for state, values in by_state.items()
            }
            for (kind, views), by_state in found.items()
        }
        for row in range(len(scene)):
            named = {attack: {state: names[row] for state, names in by.items()} for attack, by in said.items()}
            angle = degrees_apart(scene, row, scenes[1])
            yield {"mesh": subject.name, "set": index, "angle": angle, "answers": named}


def degrees_apart(scene: Scene, example: int, attacked: Scene) -> float:
    """Between an example's azimuth and that of the one attacked view."""
    ((other,),), (view,) = attacked.cameras, scene.cameras[example]
    return round(math.degrees(abs(math.remainder(view.azimuth - other.azimuth, 2 * math.pi))), 2)


def outcomes(records: Sequence[Mapping[str, Any]], kind: str, views: int, state: str, label: str) -> list[bool]:
    return [record["answers"][f"{kind}, {views} attacked"][state] != label for record in records]


def cell(records: Sequence[Mapping[str, Any]], kind: str, views: int, state: str, label: str) -> str:
    """The share of all views, and the lowest and highest of the sets."""
    sets: dict[tuple[str, int], list[bool]] = {(record["mesh"], record["set"]): [] for record in records}
    found = outcomes(records, kind, views, state, label)
    for record, outcome in zip(records, found, strict=True):
        sets[record["mesh"], record["set"]].append(outcome)
    shares = [100 * sum(some) / len(some) for some in sets.values()]
    return f"{percent(found)}; {min(shares):.0f} to {max(shares):.0f} %"


def results(records: Sequence[Mapping[str, Any]], label: str) -> str:
    """A row per kind of attack and number of views, the paper's share last."""
    rows = [
        [kind, str(views), *(cell(records, kind, views, state, label) for state in STATES), f"{paper} %"]
        for kind, by_views in PAPER.items()
        for views, paper in by_views.items()
    ]
    return markdown(["", "views attacked", *STATES.values(), "the paper's"], rows)


def far(records: Sequence[Mapping[str, Any]], label: str) -> str:
    """How the strongest adversaries of one view do near it and behind it."""
    near = [record for record in records if record["angle"] <= FAR]
    beyond = [record for record in records if record["angle"] > FAR]
    parts = []
    for kind in ATTACKS:
        inside, outside = (percent(outcomes(each, kind, 1, "further", label)) for each in (near, beyond))
        parts.append(f"{inside} within {FAR}° of the one attacked view and {outside} beyond ({kind})")
    return "; ".join(parts)
