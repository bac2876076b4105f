"""Measure how confidently a classifier recognizes the renders.

This is the paper's appendix "Evaluate Rendering Quality". Cameras are random, and
each sees the mesh before five grays. Intervals resample cameras, because the
renders of a camera resemble each other.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from augment import Classifier
from augment.network import compute_outputs
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from benchmarks.common import Row
from benchmarks.paper import common
from renderer import InputError, OrthographicCamera

# Number of bootstrap resamples.
RESAMPLES = 1000
# Statistics of confidences, shape (cameras, grays), with NaN for renders that
# are misclassified.
STATISTICS: Mapping[str, Callable[[np.ndarray], float]] = {
    "clean-correct": lambda confidences: float(np.isfinite(confidences).mean()),
    "median confidence": lambda confidences: float(np.nanmedian(confidences)),
}


def measure_confidences(
    subject: SceneObject, classifier: Classifier, renders: int, seed: int
) -> np.ndarray:
    """Render an object from random cameras until enough renders are classified correctly.

    Args:
        subject: Object to render.
        classifier: Classifier of the renders.
        renders: Number of renders that must be classified correctly.
        seed: Seed of the cameras.

    Returns:
        Confidence in the label, shape (cameras, grays). A render that is
        misclassified has NaN.

    Raises:
        InputError: If hardly any render is classified correctly.
    """
    draws = generator(seed, subject.name, "quality")
    rows: list[np.ndarray] = []
    correct_count = 0
    while correct_count < renders:
        made_count = len(rows) * len(common.GRAYS)
        # The search makes at least 5,000 renders before it gives up.
        if made_count > max(100, renders) / common.MIN_CORRECT_FRACTION:
            counts = f"{correct_count} of {made_count} renders of {subject.name}"
            raise InputError(
                f"{classifier.name} classifies only {counts} correctly. "
                "Choose another mesh, label or classifier."
            )
        azimuth = 360 * float(torch.rand((), generator=draws))
        width = common.WIDTHS[len(rows) % len(common.WIDTHS)]
        camera = OrthographicCamera(common.POLAR, azimuth, width)
        rows.append(confidences_of_camera(subject, classifier, camera))
        correct_count += int(np.isfinite(rows[-1]).sum())
    return np.stack(rows)


def confidences_of_camera(
    subject: SceneObject, classifier: Classifier, camera: OrthographicCamera
) -> np.ndarray:
    """Render an object before each gray, and measure the confidence in the label.

    Args:
        subject: Object to render.
        classifier: Classifier of the renders.
        camera: Camera of all renders.

    Returns:
        Confidence for each gray, shape (grays,). A render that is misclassified
        has NaN.
    """
    views = [common.View(camera, gray) for gray in common.GRAYS]
    scene = common.make_scene(subject, classifier.size, views)
    logits = compute_outputs(classifier, common.render_all(scene), len(views))
    probabilities = logits[:, 0].softmax(1)
    label = classifier.label(subject.label)
    is_correct = probabilities.argmax(1) == label
    confidences = torch.where(is_correct, probabilities[:, label], torch.nan)
    return confidences.double().numpy()


def summarize(confidences: np.ndarray, seed: int) -> Row:
    """Compute each statistic with its 95% bootstrap interval over cameras.

    Args:
        confidences: Confidence in the label, shape (cameras, grays), with NaN
            for renders that are misclassified.
        seed: Seed of the resamples.

    Returns:
        Numbers of cameras and renders, and for each statistic its value and
        the ends of its interval.
    """
    draws = np.random.default_rng(seed)
    camera_count = len(confidences)
    resamples = []
    for _ in range(RESAMPLES):
        cameras = draws.integers(camera_count, size=camera_count)
        resamples.append(confidences[cameras])
    row: Row = {"cameras": camera_count, "rendered": confidences.size}
    for name, statistic in STATISTICS.items():
        values = [statistic(resample) for resample in resamples]
        low, high = np.quantile(values, [0.025, 0.975]).tolist()
        row[name] = [statistic(confidences), low, high]
    return row


def main(argv: Sequence[str] | None = None) -> None:
    """Measure the confidence in renders of each mesh, and append a record for each.

    The last record is of the renders of all meshes together.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = common.make_parser("rendering_quality", __doc__)
    parser.add_argument(
        "--renders",
        type=int,
        default=10_000,
        help="number of clean-correct renders of all meshes together",
    )
    setup = common.prepare(parser, argv)
    options = setup.options
    renders_per_mesh = math.ceil(options.renders / len(setup.subjects))
    confidences = {
        subject.name: measure_confidences(subject, setup.classifier, renders_per_mesh, options.seed)
        for subject in setup.subjects
    }
    confidences["all"] = np.concatenate(list(confidences.values()))
    for name, values in confidences.items():
        common.append(options.out, {"mesh": name, **summarize(values, options.seed)})


if __name__ == "__main__":
    main()
