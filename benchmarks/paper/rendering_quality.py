"""How surely a classifier recognizes the renders (the paper's appendix "Evaluate Rendering Quality").

Cameras are random, and each sees the mesh on five grays. Intervals resample cameras, whose renders resemble each other.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from augment import Classifier
from augment.attacks.attack import logits_of
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from benchmarks.common import Row
from benchmarks.paper import common
from renderer import InputError, OrthographicCamera

RESAMPLES = 1000
STATISTICS: Mapping[str, Callable[[np.ndarray], float]] = {  # of confidences (cameras, grays), NaN where it errs
    "clean-correct": lambda views: float(np.isfinite(views).mean()),
    "median confidence": lambda views: float(np.nanmedian(views)),
}


def confidences(subject: SceneObject, classifier: Classifier, renders: int, seed: int) -> np.ndarray:
    """(cameras, grays) with so many clean-correct renders: the confidence in the label, NaN where another class is
    predicted. InputError: hardly any is clean-correct."""
    draws, label = generator(seed, subject.name, "quality"), classifier.label(subject.label)
    rows: list[np.ndarray] = []
    while (correct := int(np.isfinite(rows).sum())) < renders:
        made = len(rows) * len(common.GRAYS)
        if made > max(100, renders) / common.LEAST_CORRECT:
            raise InputError(f"{subject.name}: only {correct} of {made} renders are clean-correct")
        azimuth = 2 * math.pi * float(torch.rand((), generator=draws))
        camera = OrthographicCamera(math.pi / 3, azimuth, common.WIDTHS[len(rows) % len(common.WIDTHS)])
        scene = common.scene_of(subject, classifier.size, [(camera, gray) for gray in common.GRAYS])
        probabilities = logits_of(classifier, common.images_of(scene), len(common.GRAYS))[:, 0].softmax(1)
        confidence = torch.where(probabilities.argmax(1) == label, probabilities[:, label], torch.nan)
        rows.append(confidence.double().numpy())
    return np.stack(rows)


def summary(views: np.ndarray, seed: int) -> Row:
    """Counts, and each statistic with its 95 % bootstrap interval over cameras."""
    draws = np.random.default_rng(seed)
    resampled = [views[draws.integers(len(views), size=len(views))] for _ in range(RESAMPLES)]
    row: Row = {"cameras": len(views), "rendered": views.size}
    for name, statistic in STATISTICS.items():
        interval = np.quantile([statistic(sample) for sample in resampled], [0.025, 0.975])
        row[name] = [statistic(views), *interval.tolist()]
    return row


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("rendering_quality", __doc__)
    options.add_argument("--renders", type=int, default=10_000, help="clean-correct ones, of all meshes together")
    args, classifier, subjects = common.prepare(options, argv)
    count = -(-args.renders // len(subjects))
    views = {subject.name: confidences(subject, classifier, count, args.seed) for subject in subjects}
    for name, values in {**views, "all": np.concatenate(list(views.values()))}.items():
        common.append(args.out, {"mesh": name, **summary(values, args.seed)})


if __name__ == "__main__":
    main()
