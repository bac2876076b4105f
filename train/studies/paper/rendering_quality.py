"""How surely a classifier recognises the renders (the paper's appendix "Evaluate Rendering Quality")."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.attacks.run import logits_of
from augment.classifiers import Classifier
from augment.seeding import generator
from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from train.report.tables import markdown
from train.studies.figures import panels_beside, save
from train.studies.page import filled
from train.studies.paper.section import Section, SectionSettings, Study
from train.studies.paper.subjects import FIELDS_OF_VIEW, GREYS, Subject, scene_of

LEAST_SHARE = 0.02  # recognised; below it the search for renders is given up
BINS = np.linspace(0, 1, 21)
RESAMPLES = 1000


@dataclass
class QualitySettings(SectionSettings):
    """renders: recognised ones, of all meshes together."""

    renders: int


@dataclass(frozen=True)
class View:
    """A camera's renders: for each grey the confidence in the label where it is the answer, else None."""

    mesh: str
    azimuth: float
    field_of_view: float
    confidence: tuple[float | None, ...]

    @property
    def recognised(self) -> list[float]:
        return [value for value in self.confidence if value is not None]


def views_of(subject: Subject, classifier: Classifier, light: str, seed: int) -> Iterator[View]:
    """Random cameras without end, the fields of view in turn."""
    draws, label = generator(seed, subject.name, "quality"), classifier.label(subject.label)
    for field in cycle(FIELDS_OF_VIEW):
        azimuth = 2 * math.pi * float(torch.rand((), generator=draws))
        camera = OrthographicCamera(math.pi / 3, azimuth, field)
        scene = scene_of(subject, classifier, light, [[camera]] * len(GREYS), torch.tensor(GREYS))
        examples = torch.arange(len(scene))
        with torch.no_grad():
            images = scene.render(scene.conditions(examples), examples)
        shares = logits_of(classifier, images, len(images))[:, 0].softmax(1)
        correct = (shares.argmax(1) == label).tolist()
        confidence = zip(shares[:, label].tolist(), correct, strict=True)
        yield View(
            subject.name, azimuth, field, tuple(round(value, 4) if right else None for value, right in confidence)
        )


def enough_views(views: Iterator[View], renders: int) -> list[View]:
    """As many as hold so many recognised renders."""
    found, recognised = [], 0
    while recognised < renders:
        found.append(next(views))
        recognised += len(found[-1].recognised)
        if len(found) * len(GREYS) > max(100, renders) / LEAST_SHARE:
            raise InputError(f"{found[0].mesh}: only {recognised} of {len(found) * len(GREYS)} renders are recognised")
    return found


def bootstrap(views: Sequence[View], statistic: Callable[[Sequence[View]], float], seed: int) -> tuple[float, float]:
    """The 95 % interval of a statistic under resampling of cameras."""
    draws = np.random.default_rng(seed)
    values = [statistic([views[i] for i in draws.integers(len(views), size=len(views))]) for _ in range(RESAMPLES)]
    return tuple(np.quantile(values, [0.025, 0.975]))


def share_recognised(views: Sequence[View]) -> float:
    return sum(len(view.recognised) for view in views) / (len(views) * len(GREYS))


def median_confidence(views: Sequence[View]) -> float:
    return float(np.median(np.concatenate([view.recognised for view in views])))


def share_above_half(views: Sequence[View]) -> float:
    return float(np.mean(np.concatenate([view.recognised for view in views]) > 0.5))


STATISTICS = {
    "recognised": share_recognised,
    "median confidence": median_confidence,
    "confidence above one half": share_above_half,
}


def row(name: str, views: Sequence[View], seed: int) -> list[str]:
    cells = []
    for statistic in STATISTICS.values():
        low, high = bootstrap(views, statistic, seed)
        cells.append(f"{statistic(views):.3f} [{low:.3f}, {high:.3f}]")
    return [name, f"{len(views):,}", f"{sum(len(view.recognised) for view in views):,}", *cells]


def by_grey(views: Sequence[View]) -> str:
    """The share recognised on each grey."""
    shares = np.mean([[value is not None for value in view.confidence] for view in views], axis=0)
    return ", ".join(f"{share:.2f} on {grey:g}" for grey, share in zip(GREYS, shares, strict=True))


def by_field(views: Sequence[View]) -> str:
    """The share recognised at each field of view."""
    shares = {
        field: share_recognised([view for view in views if view.field_of_view == field]) for field in FIELDS_OF_VIEW
    }
    return ", ".join(f"{share:.2f} at {field:g}" for field, share in shares.items())


def histograms(views: Sequence[View]) -> Iterator[dict[str, Any]]:
    """A record per mesh, field of view and grey: how many were rendered, and recognised at which confidence."""
    for mesh, field in sorted({(view.mesh, view.field_of_view) for view in views}):
        here = [view.confidence for view in views if (view.mesh, view.field_of_view) == (mesh, field)]
        for grey, values in zip(GREYS, zip(*here, strict=True), strict=True):
            counts, _ = np.histogram([value for value in values if value is not None], BINS)
            cell = {"mesh": mesh, "field_of_view": field, "background": grey, "rendered": len(values)}
            yield cell | {"recognised": int(counts.sum()), "histogram": counts.tolist()}


def draw(found: dict[str, list[View]], path: Path) -> None:
    """A histogram per mesh, side by side, on one scale."""
    figure, panels = panels_beside(len(found), (3.6, 2.8))
    for panel, (name, views) in zip(panels, found.items(), strict=True):
        panel.hist(
            np.concatenate([view.recognised for view in views]), BINS.tolist(), color="#4269d0", edgecolor="white"
        )
        panel.set(title=name, xlabel="confidence in the correct label", xlim=(0, 1))
    panels[0].set_ylabel("renders")
    save(figure, path)


def measure(study: Study, settings: QualitySettings) -> Section:
    """As many recognised renders as are asked for, of all meshes alike."""
    wanted = -(-settings.renders // len(study.subjects))
    found = {
        subject.name: enough_views(views_of(subject, study.classifier, study.light, study.seed), wanted)
        for subject in study.subjects
    }
    everything = [view for views in found.values() for view in views]
    rows = [row(name, views, study.seed) for name, views in found.items()]
    if len(found) > 1:
        rows.append(row("all", everything, study.seed))
    text = filled(
        __file__,
        recognised=sum(len(view.recognised) for view in everything),
        rendered=len(everything) * len(GREYS),
        classifier=study.classifier.name,
        label=study.label,
        greys=len(GREYS),
        table=markdown(["mesh", "cameras", "recognised renders", *STATISTICS], rows),
        by_grey=by_grey(everything),
        by_field=by_field(everything),
        above=share_above_half(everything),
        meshes=study.meshes,
        light=study.light,
    )
    return Section(text, histograms(everything), {"rendering_quality.png": partial(draw, found)})
