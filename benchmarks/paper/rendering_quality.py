"""How surely a classifier recognizes the renders (the paper's appendix "Evaluate Rendering Quality").

python -m benchmarks.paper.rendering_quality --out rendering_quality.jsonl --renders 10000 \\
    --meshes orange_studio.glb '{mesh: orange_sketchfab.glb, albedo_scale: 3}'
python -m benchmarks.paper.table rendering_quality.jsonl

Cameras are random, and each sees the mesh on five grays. Intervals resample cameras, whose renders resemble each other.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from augment import Classifier
from augment.attacks.attack import logits_of
from augment.objects import SceneObject
from augment.utils import generator
from benchmarks.paper import common
from renderer import InputError, OrthographicCamera

BINS = np.linspace(0, 1, 21)
RESAMPLES = 1000
STATISTICS: Mapping[str, Callable[[np.ndarray], float]] = {  # of confidences (cameras, grays), NaN where it errs
    "recognized": lambda views: float(np.isfinite(views).mean()),
    "median confidence": lambda views: float(np.nanmedian(views)),
    "confidence above one half": lambda views: float((views[np.isfinite(views)] > 0.5).mean()),
}


def confidences(subject: SceneObject, classifier: Classifier, light: str, renders: int, seed: int) -> np.ndarray:
    """(cameras, grays): of as many cameras as hold so many recognized renders, the confidence in the label where it is
    the answer, else NaN. InputError: too few are recognized."""
    draws, label = generator(seed, subject.name, "quality"), classifier.label(subject.label)
    rows: list[np.ndarray] = []
    while (recognized := int(np.isfinite(rows).sum())) < renders:
        if len(rows) * len(common.GRAYS) > max(100, renders) / common.LEAST_RECOGNIZED:
            raise InputError(
                f"{subject.name}: only {recognized} of {len(rows) * len(common.GRAYS)} renders are recognized"
            )
        azimuth = 2 * math.pi * float(torch.rand((), generator=draws))
        camera = OrthographicCamera(math.pi / 3, azimuth, common.FIELDS_OF_VIEW[len(rows) % len(common.FIELDS_OF_VIEW)])
        images = common.images_of(
            common.scene_of(subject, classifier.size, light, [(camera, gray) for gray in common.GRAYS])
        )
        shares = logits_of(classifier, images, len(common.GRAYS))[:, 0].softmax(1)
        rows.append(torch.where(shares.argmax(1) == label, shares[:, label], torch.nan).double().numpy())
    return np.stack(rows)


def summary(views: np.ndarray, seed: int) -> dict[str, object]:
    """Counts, a histogram of confidence, and each statistic with its 95 % bootstrap interval over cameras."""
    draws = np.random.default_rng(seed)
    resampled = [views[draws.integers(len(views), size=len(views))] for _ in range(RESAMPLES)]
    statistics = {
        name: [statistic(views), *np.quantile([statistic(some) for some in resampled], [0.025, 0.975]).tolist()]
        for name, statistic in STATISTICS.items()
    }
    histogram = np.histogram(views[np.isfinite(views)], BINS)[0].tolist()
    return {"cameras": len(views), "rendered": views.size, **statistics, "histogram": histogram}


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("rendering_quality", __doc__)
    options.add_argument("--renders", type=int, default=10_000, help="recognized ones, of all meshes together")
    args, classifier, subjects = common.prepare(options, argv)
    wanted = -(-args.renders // len(subjects))
    found = {each.name: confidences(each, classifier, args.light, wanted, args.seed) for each in subjects}
    for name, views in {**found, "all": np.concatenate(list(found.values()))}.items():
        common.append(args.out, {"mesh": name, **summary(views, args.seed)})


if __name__ == "__main__":
    main()
