"""Does a light or a shape found in a few views fool a network in others (Table 4)?"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.parameters import AttackProblem
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.scene import Scene
from augment.utils import generator, stream_seed
from renderer.camera import Camera
from train.report.tables import markdown
from train.studies.figures import panels_beside, save
from train.studies.paper.adversaries import ATTACKS, FURTHER, STEPS, with_random_signs
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import draw_shares, percent, share_of
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
BINS = (0, 15, 30, 60, FAR, 180)


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
        "views": settings.sets * settings.views * len(study.subjects),
        "further": FURTHER,
        "steps": STEPS,
    }
    return Section(values, records, {"unseen_views.png": partial(draw, records, study.label)})


@dataclass(frozen=True)
class Together:
    """All examples of a problem, of one view each, as the views of a single one: one light or shape for all of them."""

    problem: AttackProblem

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
    """A record per attack on one set of views of a subject: what unseen views are called under all that it found, and
    their degrees from the nearest attacked view."""
    draws = generator(seed, subject.name, "unseen views", index)
    attacked = {
        views: recognised_scene(subject, classifier, light, views, stream_seed(seed, "attacked", views, index))
        for views in ATTACKED
    }
    found = {
        (kind, views): attack_views(scene, kind, classifier, subject.label, draws)
        for kind in ATTACKS
        for views, scene in attacked.items()
    }
    scenes = list(recognised_parts(subject, classifier, light, count, draws))
    for (kind, views), by_state in found.items():
        near = [cameras[0] for cameras in attacked[views].cameras]
        angles = [min(degrees_apart(seen[0], each) for each in near) for scene in scenes for seen in scene.cameras]
        problems = [ATTACKS[kind].problem(scene) for scene in scenes]
        said = {
            state: [
                name for each in problems for name in answers(classifier, each.images(values.expand_as(each.start)))
            ]
            for state, values in by_state.items()
        }
        yield {"mesh": subject.name, "set": index, "kind": kind, "attacked": views, "angle": angles, "answers": said}


def degrees_apart(one: Camera, other: Camera) -> float:
    """About the vertical."""
    return round(math.degrees(abs(math.remainder(one.azimuth - other.azimuth, 2 * math.pi))), 2)


def results(records: Sequence[Mapping[str, Any]], label: str) -> str:
    """A row per kind of attack and number of views, the paper's share last."""
    rows = []
    for kind, by_views in PAPER.items():
        for views, paper in by_views.items():
            here = [record for record in records if (record["kind"], record["attacked"]) == (kind, views)]
            cells = (cell([record["answers"][state] for record in here], label) for state in STATES)
            rows.append([kind, str(views), *cells, f"{paper} %"])
    return markdown(["", "views attacked", *STATES.values(), "the paper's"], rows)


def cell(sets: Sequence[Sequence[str]], label: str) -> str:
    """The share of all views fooled, and the lowest and highest of the sets."""
    success = [[answer != label for answer in answers] for answers in sets]
    shares = [100 * sum(some) / len(some) for some in success]
    return f"{percent(list(chain(*success)))}; {min(shares):.0f} to {max(shares):.0f} %"


def by_angle(
    records: Sequence[Mapping[str, Any]], kind: str, views: int, low: float, high: float, label: str
) -> list[bool]:
    """Whether the strongest adversaries fool each unseen view at low to high degrees from the nearest attacked one."""
    return [
        answer != label
        for record in records
        if (record["kind"], record["attacked"]) == (kind, views)
        for angle, answer in zip(record["angle"], record["answers"]["further"], strict=True)
        if low < angle <= high or angle == low == 0
    ]


def far(records: Sequence[Mapping[str, Any]], label: str) -> str:
    """How the strongest adversaries of one view do near it and behind it."""
    parts = []
    for kind in ATTACKS:
        near, beyond = (percent(by_angle(records, kind, 1, low, low + FAR, label)) for low in (0, FAR))
        parts.append(f"{near} within {FAR}° of the one attacked view and {beyond} beyond ({kind})")
    return "; ".join(parts)


def draw(records: Sequence[Mapping[str, Any]], label: str, path: Path) -> None:
    """A panel per kind of attack: success by angle, a line per number of attacked views."""
    figure, panels = panels_beside(len(ATTACKS), (4.2, 3.2))
    for panel, kind in zip(panels, ATTACKS, strict=True):
        for views, color in zip(ATTACKED, ("#4269d0", "#ef7a34"), strict=True):
            shares = [share_of(by_angle(records, kind, views, low, high, label)) for low, high in pairwise(BINS)]
            places = [(low + high) / 2 for low, high in pairwise(BINS)]
            draw_shares(panel, places, shares, 100, marker="o", color=color, label=f"{views} attacked", capsize=2)
        panel.set(title=kind, xlabel="degrees to the nearest attacked view", xlim=(0, 180))
    panels[0].set(ylabel="unseen views fooled, %", ylim=(-2, 102))
    panels[-1].legend(frameon=False)
    save(figure, path)
