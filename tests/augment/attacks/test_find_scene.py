from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

import augment
from augment.attack_settings import MaterialSettings
from augment.attacks.attack import _candidates, find_scene
from augment.random_streams import generator
from augment.settings import SceneSettings

# Settings that the search may change.
CHANGED = ("polar", "azimuth", "width", "fov", "light", "exposure")
LIGHTING = augment.AttackSettings(lighting=augment.StepSettings(), allow_negative=True)
MATERIAL = augment.AttackSettings(material=MaterialSettings(), optimizer="random_search")
Score = Callable[[Tensor], Tensor]


def classifier_of(score: Score) -> augment.Classifier:
    def logits(images: Tensor) -> Tensor:
        scores = score(images)
        return torch.stack([scores, -scores], dim=1)

    return augment.Classifier(logits, 16, ("orange", "other"))


def bright_and_small(images: Tensor) -> Tensor:
    middle = images[..., 6:10, 6:10].mean((1, 2, 3))
    border = images[..., :2, :].mean((1, 2, 3))
    return torch.minimum(60 * (middle - 0.5), 200 * (0.02 - (border - 0.5).abs()))


def built(settings: SceneSettings, shared: bool = False) -> augment.Scene:
    meshes = [("solid:orange:0", "orange")]
    options = {"scene": settings, "shared": shared, "rasterizer": "numpy"}
    return augment.build_scene(meshes, 16, settings.views, **options)


def found(score, settings, cameras=40, shared=False, attacked=LIGHTING) -> SceneSettings:
    build = partial(built, shared=shared)
    classifier = classifier_of(score)
    return find_scene(classifier, settings, attacked, build, cameras, generator(0))[0]


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("settings", [SceneSettings(views=2), SceneSettings(fov=40.0)])
@pytest.mark.parametrize("attacked", [LIGHTING, MATERIAL])
def test_a_camera_and_light_are_found_in_which_all_views_are_classified_correctly(
    settings, shared, attacked
):
    chosen = found(bright_and_small, settings, shared=shared, attacked=attacked)
    assert chosen != settings
    other_settings = {name: getattr(settings, name) for name in CHANGED}
    assert replace(chosen, **other_settings) == settings
    before = replace(attacked, max_steps=0, max_queries=1)
    classifier = classifier_of(bright_and_small)
    result = augment.attack(classifier, built(chosen, shared), settings=before)
    assert result.clean_correct.all()


def test_a_dark_object_is_found_at_multiples_of_the_exposure_that_is_chosen_for_it():
    dark = augment.ObjectSettings("solid:orange:0", label="orange", albedo_scale=0.02)
    settings = SceneSettings(exposure="auto")
    build = partial(augment.build_scene, [dark], 16, rasterizer="numpy")
    classifier = classifier_of(lambda images: 60 * (images[..., 6:10, 6:10].mean((1, 2, 3)) - 0.6))
    *_, scene = find_scene(
        classifier, settings, LIGHTING, lambda chosen: build(scene=chosen), 1, generator(0)
    )
    assert augment.attack(classifier, scene, settings=replace(LIGHTING, max_steps=0)).clean_correct


def test_cameras_of_a_wide_lens_are_drawn_from_where_all_of_the_mesh_lies_before_them():
    settings = SceneSettings(fov=90.0, backgrounds=["behind.png"])
    _, *drawn = _candidates(settings, 50, torch.Generator().manual_seed(0))
    assert len(drawn) == 49
    assert {candidate.fov for candidate in drawn} == {90}
    widths = [candidate.width for candidate in drawn]
    assert min(widths) >= 4
    assert max(widths) > 7


def test_settings_stay_as_they_are_if_no_scene_is_found():
    settings = SceneSettings()
    assert found(lambda images: 0 * images.sum((1, 2, 3)) - 1, settings, cameras=2) == settings
