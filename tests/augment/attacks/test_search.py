"""Where a classifier is wrong about a mesh, a scene is found in which it is right."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

import augment
from augment.attacks.search import LIGHT_GRAY, _candidates, find_scene
from augment.random_streams import generator
from augment.settings import SceneSettings

CHANGED = ("polar", "azimuth", "width", "fov", "light", "exposure")
ATTACK = augment.AttackSettings(lighting=augment.StepSettings(), allow_negative=True)


def classifier_of(score) -> augment.Classifier:
    """An orange where the score is positive."""
    return augment.Classifier(
        lambda images: torch.stack([score(images), -score(images)], dim=1), 16, ("orange", "other")
    )


def bright_and_small(images: Tensor) -> Tensor:
    """Bright in the middle, on a wide border of the background's gray."""
    middle, border = images[..., 6:10, 6:10].mean((1, 2, 3)), images[..., :2, :].mean((1, 2, 3))
    return torch.minimum(60 * (middle - 0.5), 200 * (0.02 - (border - 0.5).abs()))


def built(settings: SceneSettings, shared: bool = False) -> augment.Scene:
    options = {"scene": settings, "shared": shared, "rasterizer": "numpy"}
    return augment.build_scene([("solid:orange:0", "orange")], 16, settings.views, **options)


def found(
    score, cameras: int = 40, shared: bool = False, **scene
) -> tuple[SceneSettings, SceneSettings]:
    """The settings, and those that the search finds in their place."""
    settings, build = SceneSettings(**scene), partial(built, shared=shared)
    return settings, find_scene(
        classifier_of(score), settings, ATTACK, build, cameras, generator(0)
    )


def test_a_scene_that_is_classified_correctly_stays_as_it_is():
    settings, chosen = found(lambda images: images.mean((1, 2, 3)) + 1)
    assert chosen == settings


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("scene", [{"views": 2}, {"fov": 40.0}])
def test_a_camera_and_a_light_are_found_in_which_all_views_are_classified_correctly(scene, shared):
    """And the same ones from the same draws."""
    settings, chosen = found(bright_and_small, shared=shared, **scene)
    assert chosen != settings and chosen == found(bright_and_small, shared=shared, **scene)[1]
    assert replace(chosen, **{name: getattr(settings, name) for name in CHANGED}) == settings
    before = replace(ATTACK, max_steps=0)
    result = augment.attack(classifier_of(bright_and_small), built(chosen, shared), settings=before)
    assert result.clean_correct.all()


def test_cameras_of_a_wide_lens_are_drawn_from_where_all_of_the_mesh_lies_before_them():
    settings = SceneSettings(fov=90.0, backgrounds=["behind.png"])
    _, *drawn = _candidates(settings, 50, torch.Generator().manual_seed(0))
    assert len(drawn) == 49 and {candidate.fov for candidate in drawn} == {90}
    widths = [candidate.width for candidate in drawn]
    assert min(widths) >= 4 and max(widths) > 7


def test_what_is_classified_correctly_before_light_gray_alone_is_found_there():
    settings, chosen = found(lambda images: 100 * (images[..., 0, 0].mean(1) - 0.8))
    assert chosen == replace(settings, backgrounds=[LIGHT_GRAY])


def test_where_nothing_is_found_the_settings_stay_as_they_are():
    settings, chosen = found(lambda images: 0 * images.sum((1, 2, 3)) - 1, cameras=2)
    assert chosen == settings
