"""A scene's light has the degree that its gloss needs, and a lower one is told."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import augment
from augment.attack_settings import MaterialSettings, SkylightSettings
from augment.attacks.parameters import make_parameter
from augment.augmentation_settings import SpecularLayerSettings, VariationSettings
from augment.scene.build import (
    Smoothest,
    build_scene,
    degree_of_scene,
    reached_gloss,
    with_needed_degree,
)
from augment.scene.scene import Scene
from augment.scene.vary import vary
from augment.settings import ObjectSettings
from renderer.light.basis import Harmonics, harmonics_of
from renderer.light.environment import to_map, write_map
from renderer.light.files import directional, load_light, probe
from renderer.light.harmonics import quadrature
from renderer.light.ringing import required_degree
from renderer.solids import solid
from renderer.surface.gloss import Gloss, smallest_roughness
from tests.helpers import images_of

MATTE = ("solid:pear", "pear")
OPTIONS = {"samples": 1, "rasterizer": "numpy"}
# An attack without a radius reaches a roughness of 0.2. An attacked sky has detail of any degree.
UNLIMITED = MaterialSettings()
LIGHTING, SKY = augment.StepSettings(), SkylightSettings()
ON_UNLIMITED_MATERIAL = augment.AttackSettings(material=UNLIMITED, skylight=SKY)


def recorded(build: Callable, *arguments, **options) -> tuple[Any, str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = build(*arguments, **options)
    return result, " ".join(str(warning.message) for warning in caught)


def scene_of(*items, **options) -> tuple[Scene, str]:
    return recorded(build_scene, list(items), 8, **OPTIONS | options)


def lowest_roughness(scene: Scene, settings: MaterialSettings) -> float:
    """Return the roughness of the object's own faces after the largest step towards less."""
    attacked = make_parameter("material", scene, settings)
    rows = torch.arange(len(scene))
    smoother = torch.tensor([1e3, 0, 0, 0])
    values = attacked.project(attacked.start - smoother, rows)
    roughness = attacked.apply(values, scene.conditions(rows), rows).gloss[..., 0]
    is_own = np.stack([scene.mesh(row).gloss[:, 1:].any(1) for row in rows.tolist()])
    return float(roughness.expand(is_own.shape)[torch.from_numpy(is_own)].min())


@pytest.mark.parametrize(("smoothest", "radius"), [(0.6, 0.3), (0.5, 0.64)])
def test_the_degree_shows_the_least_roughness_that_an_attack_on_material_reaches(smoothest, radius):
    mesh = solid("pear")
    roughness = torch.full((len(mesh.faces),), 0.6)
    roughness[:9] = smoothest
    settings = MaterialSettings(radius=radius)
    attack = augment.AttackSettings(material=settings, skylight=SKY)
    scene, told = scene_of((Gloss(roughness).on(mesh), "pear"), attack=attack)
    expected = required_degree(lowest_roughness(scene, settings))
    assert scene.basis == Harmonics(max(6, expected))
    assert ("can reach gloss of roughness" in told) == (expected > 6)


def test_a_matte_object_attacked_in_its_material_has_the_gloss_that_the_attack_begins_with():
    scene, _ = scene_of(MATTE, attack=ON_UNLIMITED_MATERIAL)
    assert scene.basis == Harmonics(required_degree(0.2))


HUE_ALONE = MaterialSettings(roughness=0, metallic=0, specular_factor=0, hue=30)


@pytest.mark.parametrize(
    "changed",
    [{"material": HUE_ALONE}, {"lighting": LIGHTING}, {"material": UNLIMITED}],
    ids=["hue", "light", "gloss in light without detail"],
)
def test_attacks_that_show_no_sharper_highlights_keep_degree_6_without_a_warning(changed):
    scene, told = scene_of(MATTE, attack=augment.AttackSettings(**changed))
    assert scene.basis == Harmonics(6)
    assert told == ""


def test_the_degree_shows_every_varnish_that_is_drawn():
    varied = VariationSettings(gloss=SpecularLayerSettings([0.22, 0.6], [0.0, 1.0]))
    scene, told = scene_of(MATTE, vary=varied)
    assert scene.basis == Harmonics(required_degree(0.22))
    assert "can reach gloss of roughness 0.22" in told
    roughness = []
    for seed in range(6):
        drawn = vary(scene, varied, torch.Generator().manual_seed(seed))
        roughness.append(smallest_roughness(drawn.objects[0].mesh))
    assert 0.22 <= min(roughness) < 0.35


def test_an_attack_starts_from_the_smoothest_varnish_that_is_drawn():
    scene, _ = scene_of(MATTE)
    varnish = SpecularLayerSettings([0.5, 0.6], [0.0, 1.0])
    reached = reached_gloss(scene.objects, MaterialSettings(radius=0.5), varnish)
    assert reached.roughness == pytest.approx(0.5 - 0.5 * 0.3, abs=1e-6)


def test_the_gloss_of_props_counts():
    mug = ObjectSettings("solid:cup", at=[0.9, 0.6], gloss=[0.25])
    scene, _ = scene_of(ObjectSettings("solid:pear", "pear", others=[mug]))
    assert scene.basis == Harmonics(required_degree(0.25))


def test_the_gloss_of_single_faces_and_of_other_objects_counts():
    """One face of the pear has the roughness 0.25, and a smoother one is matte."""
    mesh = solid("pear")
    roughness = torch.full((len(mesh.faces),), 0.5)
    strength = torch.full((len(mesh.faces),), 0.5)
    roughness[3] = 0.25
    roughness[5] = 0.2
    strength[5] = 0.0
    pear = Gloss(roughness, specular_factor=strength).on(mesh), "pear"
    scene, _ = scene_of(MATTE, pear)
    assert scene.basis == Harmonics(required_degree(0.25))
    attacked, _ = scene_of(MATTE, pear, attack=ON_UNLIMITED_MATERIAL)
    assert attacked.basis == Harmonics(required_degree(0.2))


def always_a_pear(images: Tensor) -> Tensor:
    mean = images.mean((1, 2, 3))
    return torch.stack([9 + mean, 0 * mean], dim=1)


CLASSIFIER = augment.Classifier(always_a_pear, size=8, classes=["pear", "other"])


def attacked_scene(scene: Scene, settings: augment.AttackSettings) -> tuple[Scene, str]:
    result, told = recorded(augment.attack, CLASSIFIER, scene, settings=settings)
    return result.problem.scene, told


@pytest.fixture(scope="module")
def map_name(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("map") / "map.exr"
    write_map(path, to_map(probe("eucalyptus"), 64).clamp(min=0))
    return str(path)


REACHED = 0.5 - 0.64 * 0.3  # roughness after an attack of radius 0.64 on the start at 0.5
ON_MATERIAL = augment.AttackSettings(material=MaterialSettings(radius=0.64), max_steps=1)


@pytest.mark.slow
def test_an_attack_in_python_lights_the_scene_by_the_degree_that_it_needs(map_name):
    """The coefficients come from the map itself."""
    scene, _ = scene_of(MATTE, light=map_name, exposure=0.7)
    shown, told = attacked_scene(scene, ON_MATERIAL)
    assert scene.basis == Harmonics(6)
    assert shown.basis == Harmonics(required_degree(REACHED)) != scene.basis
    light = 0.7 * load_light(map_name, shown.basis.degree)
    physical = harmonics_of(shown.basis).project_nonnegative(light)
    torch.testing.assert_close(shown.lights[0], physical)
    assert "can reach gloss of roughness" in told


@pytest.mark.slow
def test_an_attack_keeps_the_degree_or_the_light_that_was_given(map_name):
    scene, _ = scene_of(MATTE, light=map_name, degree=6)
    shown, told = attacked_scene(scene, ON_MATERIAL)
    assert shown.basis == Harmonics(6)
    assert "degree=6" in told
    scene, _ = scene_of(MATTE, light=0.9 * load_light(map_name))
    shown, _ = attacked_scene(scene, ON_MATERIAL)
    assert shown.basis == Harmonics(6)


def test_attacked_light_keeps_its_degree_and_tells_which_one_the_gloss_would_take():
    attack = augment.AttackSettings(material=UNLIMITED, lighting=LIGHTING)
    scene, _ = scene_of(MATTE, attack=attack)
    shown, told = recorded(with_needed_degree, scene, attack)
    assert shown.basis == Harmonics(6)
    assert f"takes light of degree {required_degree(0.2)}: degree=6" in told


def test_degree_0_is_exact_for_even_light():
    low, _ = scene_of(MATTE, degree=0, light="uniform")
    usual, _ = scene_of(MATTE, light="uniform")
    torch.testing.assert_close(images_of(low), images_of(usual), rtol=0, atol=1e-6)


def irradiance_rms(light: Tensor) -> float:
    """Return the rms of the irradiance over all normals and channels, by quadrature."""
    normals, normal_weights = quadrature(16)
    directions, direction_weights = quadrature(100)
    degree = round(len(light) ** 0.5) - 1
    radiance = Harmonics(degree).radiance(directions) @ light.double()
    cosines = (normals @ directions.T).clamp(min=0)
    irradiance = cosines @ (direction_weights[:, None] * radiance)
    return float((normal_weights @ irradiance.square()).sum().sqrt())


@pytest.mark.parametrize(
    ("sky", "is_told"), [(0.0, True), (1.5, False)], ids=["a sun alone", "a sun in a bright sky"]
)
def test_light_whose_irradiance_changes_as_it_is_made_physical_is_told(sky, is_told):
    """Removing what is negative in a sun of degree 6 changes the irradiance by 17 %."""
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    light = directional(direction, torch.ones(3, dtype=torch.float64)).float()
    light[0] += sky
    scene = augment.build_scene([MATTE], 8, light=light, **OPTIONS)
    pixels = augment.StepSettings(radius=0.1)
    shown, told = attacked_scene(scene, augment.AttackSettings(pixels=pixels, max_steps=0))
    error = irradiance_rms(shown.lights[0] - light) / irradiance_rms(light)
    assert (error > 0.05) == is_told
    assert (f"irradiance is off by {error:.0%}" in told) == is_told


@pytest.mark.parametrize(("degree", "told"), [(2, "irradiance that is off by 9%"), (4, "")])
def test_a_light_that_a_low_degree_cuts_off_is_told(tmp_path, degree, told):
    """Degrees above 2 have 8.7 % of Σ (2l + 1) A_l² (Ramamoorthi and Hanrahan 2001)."""
    sun = torch.zeros(64, 128, 3)
    sun[20, 30] = 100
    write_map(tmp_path / "sun.npy", sun)
    _, warned = scene_of(MATTE, light=str(tmp_path / "sun.npy"), degree=degree)
    assert told in warned
    assert bool(told) == bool(warned)


def test_a_window_for_highlights_that_dims_the_light_is_told(tmp_path):
    """At degree 6, a kernel without negative values for a roughness of 0.2 dims a sun by 17 %."""
    sun = torch.zeros(64, 128, 3)
    sun[20, 30] = 100
    write_map(tmp_path / "sun.npy", sun)
    light = str(tmp_path / "sun.npy")
    scene, warned = scene_of((Gloss(0.2).on(solid("orange")), "orange"), light=light, degree=6)
    difference = load_light(light, 6)
    exact = irradiance_rms(difference)
    difference -= scene.lights[0]
    error = irradiance_rms(difference) / exact
    assert error > 0.1
    assert f"irradiance that is off by {error:.0%}" in warned


def test_a_degree_whose_operators_no_memory_holds_is_lowered_and_said():
    """Operators of 10⁹ pixels take 392 GB at degree 6, so that no higher degree is chosen."""
    with pytest.warns(UserWarning, match="degree=6, the highest that fits"):
        assert degree_of_scene(Smoothest(0.2, "ball"), None, 10**9) == 6
