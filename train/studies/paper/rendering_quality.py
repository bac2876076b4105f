"""How surely a classifier recognises the renders (the paper's appendix "Evaluate Rendering Quality")."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.attacks.attack import logits_of
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import generator
from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from train.report.tables import markdown
from train.studies.figures import panels_beside, save
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.subjects import FIELDS_OF_VIEW, GREYS, LEAST_SHARE, scene_of

TITLE = "Rendering quality"


@dataclass
class Settings(SectionSettings):
    """renders: recognised ones, of all meshes together."""

    renders: int


BINS = np.linspace(0, 1, 21)
RESAMPLES = 1000


def measure(study: Study, settings: Settings) -> Section:
    """As many recognised renders as are asked for, of all meshes alike."""
    wanted = -(-settings.renders // len(study.subjects))
    found = {
        subject.name: enough_views(views_of(subject, study.classifier, study.light, study.seed), wanted, subject.name)
        for subject in study.subjects
    }
    everything = np.concatenate(list(found.values()))
    named = found | ({"all": everything} if len(found) > 1 else {})
    values = {
        "recognised": np.isfinite(everything).sum(),
        "rendered": everything.size,
        "greys": len(GREYS),
        "table": markdown(
            ["mesh", "cameras", *STATISTICS], (row(name, views, study.seed) for name, views in named.items())
        ),
    }
    return Section(values, map(record, found, found.values()), {"rendering_quality.png": partial(draw, found)})


def views_of(subject: SceneObject, classifier: Classifier, light: str, seed: int) -> Iterator[np.ndarray]:
    """Of random cameras without end, the fields of view in turn: for each grey (len(GREYS),) the confidence in the
    label where it is the answer, else NaN."""
    draws, label = generator(seed, subject.name, "quality"), classifier.label(subject.label)
    for field in cycle(FIELDS_OF_VIEW):
        azimuth = 2 * math.pi * float(torch.rand((), generator=draws))
        camera = OrthographicCamera(math.pi / 3, azimuth, field)
        scene = scene_of(subject, classifier, light, [[camera]] * len(GREYS), torch.tensor(GREYS))
        examples = torch.arange(len(scene))
        with torch.no_grad():
            images = scene.render(scene.conditions(examples), examples)
        shares = logits_of(classifier, images, len(images))[:, 0].softmax(1)
        yield torch.where(shares.argmax(1) == label, shares[:, label], torch.nan).double().numpy()


def enough_views(views: Iterator[np.ndarray], renders: int, name: str) -> np.ndarray:
    """(cameras, greys): as many as hold so many recognised renders. InputError: too few are recognised."""
    found, recognised, drawn = [], 0, 0
    while recognised < renders:
        found.append(next(views))
        recognised, drawn = recognised + np.isfinite(found[-1]).sum(), drawn + len(GREYS)
        if drawn > max(100, renders) / LEAST_SHARE:
            raise InputError(f"{name}: only {recognised} of {drawn} renders are recognised")
    return np.stack(found)


STATISTICS: Mapping[str, Callable[[np.ndarray], float]] = {  # of (cameras, greys)
    "recognised": lambda views: np.isfinite(views).mean(),
    "median confidence": np.nanmedian,
    "confidence above one half": lambda views: (views[np.isfinite(views)] > 0.5).mean(),
}


def row(name: str, views: np.ndarray, seed: int) -> list[str]:
    cells = []
    for statistic in STATISTICS.values():
        low, high = bootstrap(views, statistic, seed)
        cells.append(f"{statistic(views):.3f} [{low:.3f}, {high:.3f}]")
    return [name, f"{len(views):,}", *cells]


def bootstrap(views: np.ndarray, statistic: Callable[[np.ndarray], float], seed: int) -> tuple[float, float]:
    """The 95 % interval of a statistic under resampling of cameras."""
    draws = np.random.default_rng(seed)
    values = [statistic(views[draws.integers(len(views), size=len(views))]) for _ in range(RESAMPLES)]
    return tuple(np.quantile(values, [0.025, 0.975]))


def record(name: str, views: np.ndarray) -> dict[str, Any]:
    """How many were rendered, and recognised at which confidence."""
    counts, _ = np.histogram(views[np.isfinite(views)], BINS)
    return {"mesh": name, "rendered": views.size, "recognised": int(counts.sum()), "histogram": counts.tolist()}


def draw(found: Mapping[str, np.ndarray], path: Path) -> None:
    """A histogram per mesh, side by side, on one scale."""
    figure, panels = panels_beside(len(found), (3.6, 2.8))
    for panel, (name, views) in zip(panels, found.items(), strict=True):
        panel.hist(views[np.isfinite(views)], BINS.tolist(), color="#4269d0", edgecolor="white")
        panel.set(title=name, xlabel="confidence in the correct label", xlim=(0, 1))
    panels[0].set_ylabel("renders")
    save(figure, path)
