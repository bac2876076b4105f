"""Find ordinary lighting in which a classifier recognizes objects before an attack.

Plain light is ordinary light. An attack says nothing about views that the
classifier does not even recognize in plain light.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from augment.attacks.find_scene import EXPOSURES
from augment.network import Classifier
from augment.progress import progress
from augment.scene.conditions import Conditions
from renderer.light.presets import UNIFORM, load_light
from train.auditing.lights import LIGHT, Views, is_correct

# Names of the plain lights that are tried: an environment map, and uniform light.
PLAIN_LIGHTS = (LIGHT, UNIFORM)
# The objects are scaled by each of these factors.
SIZES = (1.0, 0.75, 1.2)
# The search ends as soon as this fraction of the views is recognized.
ENOUGH = 0.75


@dataclass(frozen=True)
class PlainViews:
    """Lighting and size at which a classifier recognizes most views in plain light.

    Attributes:
        light: Name of the environment lighting.
        exposure: Factor by which this lighting is multiplied.
        size: Factor by which the objects are scaled.
        recognized: Number of views that are classified correctly.
        n: Number of views.
        recognized_as_given: Number of views that are classified correctly
            before the search, with an exposure and a size of 1.
    """

    light: str
    exposure: float
    size: float
    recognized: int
    n: int
    recognized_as_given: int

    def apply_to(self, views: Views) -> Views:
        """Return a copy of views with the light, the exposure and the size of this result."""
        return replace(views, light=self.light, exposure=self.exposure, size=self.size)


def find_plain_views(classifier: Classifier, views: Views) -> PlainViews:
    """Find the plain light, exposure and size at which a classifier recognizes most views.

    All combinations are tried, until one is found at which the classifier recognizes a fraction of
    ENOUGH. If no view is ever recognized, the first combination is returned.
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
    """Yield a copy of views for each combination of size, exposure and plain light."""
    for size in SIZES:
        for exposure in EXPOSURES:
            for light in PLAIN_LIGHTS:
                yield replace(views, light=light, exposure=exposure, size=size)


def _count_recognized(classifier: Classifier, views: Views) -> int:
    """Render views in their own light, and count those that are classified correctly."""
    scene = views.scene(classifier.size)
    light = load_light(views.light).to(scene.lights) * views.exposure
    examples = torch.arange(views.count, device=views.device)
    with torch.no_grad():
        images = scene.render(Conditions(light.expand(len(scene), -1, -1)), examples)
    return int(is_correct(classifier, scene, images).sum())
