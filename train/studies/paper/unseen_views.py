"""Does a light or a shape found in a few views fool a network in others (Table 4)?"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from augment.classifiers import Classifier
from augment.perturbation import Perturbation
from augment.scene import Scene
from augment.seeding import generator, stream_seed
from train.photographs.shares import share
from train.report.tables import markdown
from train.studies.figures import panels_beside, save
from train.studies.page import filled
from train.studies.paper.adversaries import ATTACKS, FURTHER, STEPS, answers, recognised_parts, with_random_signs
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import draw_shares, percent
from train.studies.paper.subjects import Subject, finer, recognised_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ATTACKED = (1, 5)


@dataclass
class UnseenViewSettings(SectionSettings):
    """sets: of attacked views, of each mesh. views: unseen ones for each set."""

    sets: int
    views: int


STATES = {
    "first": "adversary as found",
    "further": f"adversary {FURTHER} steps on",
    "random": "random change as large as the last",
}
PAPER = {"lighting": {1: 29.4, 5: 64.2}, "geometry": {1: 0.6, 5: 3.6}}
BINS = (0, 15, 30, 60, 90, 180)  # degrees
FAR = 90  # degrees
COLOURS = {1: "#4269d0", 5: "#ef7a34"}


@dataclass(frozen=True)
class Together:
    """All examples of a problem, of one view each, as the views of a single one: one light or shape for all of them."""

    problem: Perturbation

    @property
    def start(self) -> Tensor:
        return self.problem.start[:1]

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        every = torch.arange(len(self.problem.start))
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


def summary(scene: Scene, kind: str, values: Tensor, classifier: Classifier, label: str) -> dict[str, Any]:
    """How far values (1, D) went, and whether they fool the classifier in every view of a scene."""
    problem, every = ATTACKS[kind].problem(scene), torch.arange(len(scene))
    said = answers(problem, values.expand(len(scene), -1), every, classifier)
    return {"distance": round(float((values - problem.start[:1]).norm()), 4), "fooled": label not in said}


def unseen(
    subject: Subject, classifier: Classifier, index: int, count: int, light: str, seed: int
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
    attacked = {
        f"{kind}, {views} attacked": summary(scenes[views], kind, values["further"], classifier, subject.label)
        for (kind, views), values in found.items()
    }
    for scene, kept in recognised_parts(subject, classifier, light, count, draws):
        said = {
            f"{kind}, {views} attacked": {
                state: answers(ATTACKS[kind].problem(scene), values.expand(len(kept), -1), kept, classifier)
                for state, values in by_state.items()
            }
            for (kind, views), by_state in found.items()
        }
        for row, example in enumerate(kept.tolist()):
            yield {
                "mesh": subject.name,
                "set": index,
                "attacked": attacked,
                "angle": {str(views): _angle(scene, example, seen) for views, seen in scenes.items()},
                "answers": {
                    attack: {state: named[row] for state, named in by_state.items()}
                    for attack, by_state in said.items()
                },
            }


def _angle(scene: Scene, example: int, attacked: Scene) -> float:
    """Degrees between an example's azimuth and the nearest that was attacked."""
    azimuth = scene.cameras[example][0].azimuth
    apart = [abs(math.remainder(azimuth - views[0].azimuth, 2 * math.pi)) for views in attacked.cameras]
    return round(math.degrees(min(apart)), 2)


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


def attacked_success(records: Sequence[Mapping[str, Any]]) -> str:
    """In how many sets the attack reached its goal and how far it went, by kind and number of views."""
    sets = list({(record["mesh"], record["set"]): record["attacked"] for record in records}.values())
    parts = []
    for attack in sets[0]:
        fooled = sum(each[attack]["fooled"] for each in sets)
        distance = np.median([each[attack]["distance"] for each in sets])
        parts.append(f"{attack}: {fooled} of {len(sets)}, {distance:.2g}")
    return "; ".join(parts)


def far(records: Sequence[Mapping[str, Any]], label: str) -> str:
    """How the strongest adversaries of one view do near it and behind it."""
    parts = []
    for kind in ATTACKS:
        near, behind = (
            percent(
                outcomes([each for each in records if low <= each["angle"]["1"] <= high], kind, 1, "further", label)
            )
            for low, high in ((0, FAR), (FAR, 180))
        )
        parts.append(f"{near} within {FAR}° of the one attacked view and {behind} beyond ({kind})")
    return "; ".join(parts)


def draw(records: Sequence[Mapping[str, Any]], label: str, path: Path) -> None:
    """A panel per kind: success by angle, a line per number of attacked views."""
    figure, panels = panels_beside(len(ATTACKS), (4.2, 3.2))
    for panel, kind in zip(panels, ATTACKS, strict=True):
        for views in ATTACKED:
            _line(panel, records, kind, views, label)
        panel.set(title=kind, xlabel="degrees to the nearest attacked view", xlim=(0, 180), ylim=(-2, 102))
    panels[0].set_ylabel("unseen views fooled, %")
    panels[-1].legend(frameon=False)
    save(figure, path)


def _line(panel: "Axes", records: Sequence[Mapping[str, Any]], kind: str, views: int, label: str) -> None:
    angles = np.array([record["angle"][str(views)] for record in records])
    fooled = np.array(outcomes(records, kind, views, "further", label))
    places, shares = [], []
    for low, high in pairwise(BINS):
        here = (angles >= low) & (angles <= high)
        if here.any():
            places.append(angles[here].mean())
            shares.append(share(int(fooled[here].sum()), int(here.sum())))
    name = f"{views} view{'s' * (views > 1)} attacked"
    draw_shares(panel, places, shares, scale=100, marker="o", capsize=2, color=COLOURS[views], label=name)


def measure(study: Study, settings: UnseenViewSettings) -> Section:
    """All sets of attacked views of every mesh."""
    records = [
        record
        for subject in map(finer, study.subjects)
        for index in range(settings.sets)
        for record in unseen(subject, study.classifier, index, settings.views, study.light, study.seed)
    ]
    text = filled(
        __file__,
        classifier=study.classifier.name,
        label=study.label,
        table=results(records, study.label),
        attacked=attacked_success(records),
        far=far(records, study.label),
        sets=settings.sets * len(study.subjects),
        per_set=settings.views,
        views=len(records),
        meshes=study.meshes,
        further=FURTHER,
        steps=STEPS,
        light=study.light,
    )
    return Section(text, records, {"unseen_views.png": partial(draw, records, study.label)})
