"""Adversarial against random perturbations in norm-balls of light, shape and pixels (Section 4.1 and appendix A)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import generator
from train.photographs.shares import share
from train.report.tables import markdown
from train.studies.figures import panels_beside, pyplot, save
from train.studies.paper.balls import LEVELS, SPACES, Outcome, attack_ball, joined, parts
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.shares import draw_shares, interval
from train.studies.paper.subjects import finer, recognised_scene

TITLE = "Adversarial against random perturbations"


@dataclass
class Settings(SectionSettings):
    """examples: of each mesh. steps: of a descent at most, and draws of a search."""

    examples: int
    steps: int


METHODS = {"adversarial": "adversarial", "random": "random, one draw", "search": "random, any of {steps} draws"}
STYLES: dict[str, dict[str, Any]] = {
    "adversarial": {"color": "#c2410c", "marker": "o", "linestyle": "-"},
    "random": {"color": "#888888", "marker": "s", "linestyle": ":"},
    "search": {"color": "#222222", "marker": "^", "linestyle": "--"},
}


def measure(study: Study, settings: Settings) -> Section:
    """All balls of all meshes."""
    found = {subject.name: outcomes(finer(subject), study, settings) for subject in study.subjects}
    pooled = {ball: joined([each[ball] for each in found.values()]) for ball in next(iter(found.values()))}
    records = [record(mesh, *ball, outcome) for mesh, balls in found.items() for ball, outcome in balls.items()]
    together = [record("all", *ball, outcome) for ball, outcome in pooled.items()]
    methods = [method.format(steps=settings.steps) for method in METHODS.values()]
    header = ["space", "radius", *methods, "L∞ on the image", "pixels beyond half of it"]
    values = {"count": settings.examples * len(found), "table": markdown(header, map(row, together))}
    figures = {
        "norm_balls.png": partial(draw_success, together, methods),
        "norm_balls.spaces.png": partial(draw_examples, pooled, study.classifier, study.label),
    }
    return Section(values, records + together, figures)


def outcomes(subject: SceneObject, study: Study, settings: Settings) -> dict[tuple[str, float], Outcome]:
    """All balls' outcomes over the same recognised examples of a subject."""
    scene = recognised_scene(subject, study.classifier, study.light, settings.examples, study.seed)
    draws = {name: generator(study.seed, subject.name, name) for name in SPACES}
    balls = [(name, radius) for name, space in SPACES.items() for radius in space.radii]
    found: dict[tuple[str, float], list[Outcome]] = {ball: [] for ball in balls}
    for part in parts(scene):
        for (name, radius), outcome in found.items():
            outcome.append(attack_ball(part, study.classifier, study.label, name, radius, settings.steps, draws[name]))
    return {ball: joined(outcome) for ball, outcome in found.items()}


def record(mesh: str, name: str, radius: float, outcome: Outcome) -> dict[str, Any]:
    """A ball's shares with their intervals, and averages: how far its images went, and the share of pixels that
    changed by more than half of the most that any did."""
    change = (outcome.images - outcome.before).abs().amax(1)
    changed = change > outcome.reach.view(-1, 1, 1) / 2
    return {
        "mesh": mesh,
        "space": name,
        "radius": radius,
        **{method: share(int(getattr(outcome, method).sum()), len(change)) for method in METHODS},
        "reach": float(outcome.reach.mean()),
        "changed_pixels": float(changed.double().mean()),
    }


def row(found: Mapping[str, Any]) -> list[str]:
    space = SPACES[found["space"]]
    radius = f"{found['radius']:g}" + (" (paper)" if found["radius"] in space.paper else "")
    shares = [interval(found[method]) for method in METHODS]
    return [space.title, radius, *shares, f"{found['reach']:.2f}", f"{found['changed_pixels']:.2%}"]


def draw_success(pooled: Sequence[Mapping[str, Any]], labels: Sequence[str], path: Path) -> None:
    """Success against radius, a panel per space, a line with its label per method; the paper's radii are dashed."""
    figure, panels = panels_beside(len(SPACES), (3.7, 4), layout="constrained")
    for panel, (name, space) in zip(panels, SPACES.items(), strict=True):
        here = [each for each in pooled if each["space"] == name]
        for index, (method, label) in enumerate(zip(METHODS, labels, strict=True)):
            radii = [radius * 1.06 ** (index - 1) for radius in space.radii]  # beside each other
            draw_shares(panel, radii, [each[method] for each in here], 1, label=label, capsize=3, **STYLES[method])
        for radius in space.paper:
            panel.axvline(radius, color="#bbbbbb", linestyle=(0, (4, 4)), linewidth=1, zorder=0)
        panel.set(xscale="log", title=space.title, xlabel=f"L∞ radius {space.axis}", ylim=(-0.03, 1.03))
        panel.set_xticks(space.radii, [f"{radius:g}" for radius in space.radii], fontsize=8)
        panel.set_xticks([], minor=True)
    panels[0].set_ylabel("share fooled")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(METHODS))
    save(figure, path)


def most_comparable(found: Mapping[tuple[str, float], Outcome]) -> tuple[int, dict[tuple[str, str], float]]:
    """The example whose adversaries come nearest to the paper's levels on the image, and for each space and level the
    radius of its nearest one."""
    off: dict[tuple[str, str], Tensor] = {}  # by space and level, (radii, E)
    for name, space in SPACES.items():
        balls = [found[name, radius] for radius in space.radii]
        reach = torch.stack([torch.where(ball.adversarial, ball.reach, torch.inf) for ball in balls])
        off |= {(name, level): (reach - wanted).abs() for level, wanted in LEVELS.items()}
    example = int(torch.stack([each.amin(0) for each in off.values()]).amax(0).argmin())
    return example, {key: SPACES[key[0]].radii[int(each[:, example].argmin())] for key, each in off.items()}


def draw_examples(found: Mapping[tuple[str, float], Outcome], classifier: Classifier, label: str, path: Path) -> None:
    """Adversaries of one example at about the same L∞ on the image, a row per level, each beside its difference."""
    example, chosen = most_comparable(found)
    before = next(iter(found.values())).before[example]
    figure, cells = pyplot().subplots(len(LEVELS), 1 + 2 * len(SPACES), figsize=(13, 6.9), layout="tight")
    for cell in cells.flat:
        cell.set(xticks=[], yticks=[])
    for line, (level, wanted) in zip(cells, LEVELS.items(), strict=True):
        line[0].imshow(array(before))
        line[0].set_title(label, fontsize=9)
        line[0].set_ylabel(f"{level}: L∞ {wanted}", fontsize=10)
        for index, (name, space) in enumerate(SPACES.items()):
            radius = chosen[name, level]
            outcome = found[name, radius]
            image, change = line[1 + 2 * index], line[2 + 2 * index]
            image.imshow(array(outcome.images[example]))
            image.set_title(classifier.classes[int(outcome.predicted[example])], fontsize=9)
            image.set_xlabel(f"{space.title}, radius {radius:g}", fontsize=8)
            change.imshow(array((outcome.images[example] - before) / 2 + 0.5))
            change.set_xlabel(f"change, L∞ {float(outcome.reach[example]):.2f}", fontsize=8)
    save(figure, path, dpi=75)


def array(image: Tensor) -> np.ndarray:
    """(H, W, 3) of an image (3, H, W)."""
    return image.permute(1, 2, 0).numpy()
