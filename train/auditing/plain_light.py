"""Find views that a classifier recognizes in plain light, from which an audit attacks."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from augment.attacks.search import EXPOSURES
from augment.classifiers import Classifier
from augment.progress import progress
from augment.scene.conditions import Conditions
from renderer.light.presets import UNIFORM, load_light
from train.auditing.lights import LIGHT, Views, is_correct

# Lights that have nothing unusual: that of the scene, and even light.
PLAIN_LIGHTS = (LIGHT, UNIFORM)
# Factors of the size of the objects that are tried.
SIZES = (1.0, 0.75, 1.2)
# Least fraction of recognized views at which the search ends.
ENOUGH = 0.75


@dataclass(frozen=True)
class PlainViews:
    """How many views a classifier recognizes in plain light.

    Attributes:
        light: Name of the light.
        exposure: Factor of the light.
        size: Factor of the size of the objects.
        recognized: Number of views that are classified correctly.
        n: Number of views.
        recognized_as_given: The same number before the search, with exposure
            and size as they are.
    """

    light: str
    exposure: float
    size: float
    recognized: int
    n: int
    recognized_as_given: int

    def apply_to(self, views: Views) -> Views:
        """Return views in this light, with this exposure and this size."""
        return replace(views, light=self.light, exposure=self.exposure, size=self.size)


def find_plain_views(classifier: Classifier, views: Views) -> PlainViews:
    """Search light, exposure and size for the views that a classifier recognizes most often.

    The search ends at the first candidate with ENOUGH recognized views. The
    views as they are come first.

    Args:
        classifier: Classifier to test.
        views: Views of objects of one class.

    Returns:
        The best candidate. The views as they are, if none is recognized.
    """
    best: PlainViews | None = None
    candidates = list(_candidates(views))
    for candidate in progress(candidates, "search for plain light"):
        recognized = _count_recognized(classifier, candidate)
        if best is None or recognized > best.recognized:
            best = PlainViews(
                light=candidate.light,
                exposure=candidate.exposure,
                size=candidate.size,
                recognized=recognized,
                n=views.count,
                recognized_as_given=recognized if best is None else best.recognized_as_given,
            )
        if best.recognized >= ENOUGH * views.count:
            break
    assert best is not None
    return best


def _candidates(views: Views) -> Iterator[Views]:
    """Yield copies of views in each plain light, at each exposure and each size of objects."""
    for size in SIZES:
        for exposure in EXPOSURES:
            for light in PLAIN_LIGHTS:
                yield replace(views, light=light, exposure=exposure, size=size)


def _count_recognized(classifier: Classifier, views: Views) -> int:
    """Render views in their light, and count those that a classifier recognizes."""
    scene = views.scene(classifier.size)
    light = load_light(views.light).to(scene.lights) * views.exposure
    examples = torch.arange(views.count, device=views.device)
    with torch.no_grad():
        images = scene.render(Conditions(light.expand(len(scene), -1, -1)), examples)
    return int(is_correct(classifier, scene, images).sum())
