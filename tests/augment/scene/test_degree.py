import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

import augment
from augment.attacks.parameters import make_parameter
from augment.parameter_settings import MaterialSettings
from augment.scene.build import build_scene
from augment.scene.degree import Smoothest, degree_of_scene, reached_gloss
from augment.scene.scene import Scene
from augment.scene.variation import vary
from augment.settings import ObjectSettings, PropSettings, SpecularLayerSettings, VariationSettings
from renderer.geometry.shapes import solid
from renderer.light.basis import Harmonics, harmonics_of
from renderer.light.environment import to_map, write_map
from renderer.light.harmonics import quadrature
from renderer.light.highlights import required_degree
from renderer.light.presets import directional, load_light, probe
from renderer.shading.gloss import Gloss, smoothest

MATTE, OPTIONS = ("solid:pear", "pear"), {"samples": 1, "rasterizer": "numpy"}
EVERYWHERE = MaterialSettings()  # without a radius, down to a roughness of 0.2


def quietly(build, *arguments, **options):
    """The result, and the text of all warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = build(*arguments, **options)
    return result, " ".join(str(warning.message) for warning in caught)


def scene_of(item, **options) -> tuple[Scene, str]:
    return quietly(build_scene, [item], 8, **OPTIONS | options)


def lowest_roughness(scene: Scene, settings: MaterialSettings) -> float:
    """That of the object's own faces, after the largest step there is towards less of it, within the norm-ball."""
    attacked = make_parameter("material", scene, settings)
    rows = torch.arange(len(scene))
    values = attacked.project(attacked.start - torch.tensor([1e3, 0, 0, 0]), rows)
    own = torch.from_numpy(np.stack([scene.mesh(row).gloss[:, 1:].any(1) for row in rows.tolist()]))
    gloss = attacked.apply(values, scene.conditions(rows), rows).gloss[..., 0]
    return float(gloss.expand_as(own)[own].min())


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("radius", [0.3, 0.64, 1.5, None])
@pytest.mark.parametrize("faces", ["alike", "different"])
def test_the_degree_shows_the_least_roughness_that_an_attack_on_the_material_reaches(
    faces, radius, norm
):
    mesh = solid("pear")
    roughness = torch.full((len(mesh.faces),), 0.6)
    roughness[:9] -= 0.1 * (faces == "different")
    settings = MaterialSettings(norm, radius)
    scene, told = quietly(
        build_scene,
        [(Gloss(roughness).on(mesh), "pear")],
        8,
        attack=augment.AttackSettings(material=settings),
        **OPTIONS,
    )
    expected = required_degree(lowest_roughness(scene, settings))
    assert scene.basis == Harmonics(max(6, expected))
    assert ("can reach gloss of roughness" in told) == (expected > 6)


def test_a_matte_object_attacked_in_its_material_has_the_gloss_that_the_attack_begins_with():
    assert scene_of(MATTE, attack=augment.AttackSettings(material=EVERYWHERE))[
        0
    ].basis == Harmonics(required_degree(0.2))
    hue = MaterialSettings(roughness=0, metallic=0, specular_factor=0, hue=30)
    light = augment.AttackSettings(lighting=augment.StepSettings())
    for attack in (augment.AttackSettings(material=hue), light):
        scene, told = scene_of(MATTE, attack=attack)
        assert (scene.basis, told) == (Harmonics(6), "")


def test_the_degree_shows_every_varnish_that_is_drawn():
    varied = VariationSettings(gloss=SpecularLayerSettings([0.22, 0.6], [0.0, 1.0]))
    scene, told = scene_of(MATTE, vary=varied)
    draws = [vary(scene, varied, torch.Generator().manual_seed(seed)) for seed in range(20)]
    roughness = [smoothest(drawn.objects[0].mesh) for drawn in draws]
    assert 0.22 <= min(roughness) < 0.3 and scene.basis == Harmonics(required_degree(0.22))
    assert "can reach gloss of roughness 0.22" in told
    settings, attack = SpecularLayerSettings([0.5, 0.6], [0.0, 1.0]), MaterialSettings(radius=0.5)
    reached = reached_gloss(scene.objects, attack, settings)
    assert reached.roughness == pytest.approx(0.5 - 0.5 * 0.3, abs=1e-6)


def test_gloss_of_props_of_single_faces_and_of_other_objects_counts():
    mug = PropSettings("solid:cup", at=[0.9, 0.6], gloss=[0.25])
    among = ObjectSettings("solid:pear", "pear", props=[mug])
    assert scene_of(among)[0].basis == Harmonics(required_degree(0.25))
    mesh = solid("pear")
    roughness, strength = torch.full((2, len(mesh.faces)), 0.5)
    roughness[3], roughness[5], strength[5] = 0.25, 0.2, 0.0  # the last is matte
    single = Gloss(roughness, specular_factor=strength).on(mesh), "pear"
    scene, _ = quietly(build_scene, [MATTE, single], 8, **OPTIONS)
    assert scene.basis == Harmonics(required_degree(0.25))
    scene, _ = quietly(
        build_scene,
        [MATTE, single],
        8,
        attack=augment.AttackSettings(material=EVERYWHERE),
        **OPTIONS,
    )
    assert scene.basis == Harmonics(required_degree(0.2))


def classifier() -> augment.Classifier:
    def logits(images: Tensor) -> Tensor:
        mean = images.mean((1, 2, 3))
        return torch.stack([9 + mean, 0 * mean], dim=1)

    return augment.Classifier(logits, size=8, classes=["pear", "other"])


def attacked(scene: Scene, settings: MaterialSettings) -> tuple[Scene, str]:
    chosen = augment.AttackSettings(material=settings, max_steps=1)
    result, told = quietly(augment.attack, classifier(), scene, settings=chosen)
    return result.problem.scene, told


@pytest.mark.slow
def test_an_attack_in_python_lights_the_scene_by_the_degree_that_it_needs(tmp_path):
    """From the map itself; a scene whose degree or light was given stays, and a cut light is told."""
    write_map(tmp_path / "map.exr", to_map(probe("eucalyptus"), 64).clamp(min=0))
    name, settings = str(tmp_path / "map.exr"), MaterialSettings(radius=0.64)
    plain, _ = scene_of(MATTE, light=name, exposure=0.7)
    now, told = attacked(plain, settings)
    assert (
        plain.basis == Harmonics(6)
        and now.basis == Harmonics(required_degree(0.5 - 0.64 * 0.3)) != plain.basis
    )
    expected = 0.7 * load_light(name, now.basis.degree)
    torch.testing.assert_close(now.lights[0], harmonics_of(now.basis).project_nonnegative(expected))
    assert "can reach gloss of roughness" in told
    given, _ = scene_of(MATTE, light=name, degree=6)
    kept, told = attacked(given, settings)
    assert kept.basis == Harmonics(6) and "degree=6" in told
    other = augment.build_scene([MATTE], 8, light=0.9 * load_light(name), **OPTIONS)
    assert attacked(other, settings)[0].basis == Harmonics(6)
    exact, told = attacked(
        scene_of(MATTE, degree=6)[0], settings
    )  # of the probes, no band above the second is known
    assert exact.basis == Harmonics(6) and "rings" not in told


def test_a_matte_object_hears_nothing_of_gloss_and_degree_0_is_told_and_exact_for_even_light():
    assert scene_of(MATTE, degree=2)[1] == ""
    scene, told = scene_of(MATTE, degree=0, light="uniform")
    assert "degree=0 shades all sides of an object alike" in told and "gloss" not in told
    rows = torch.arange(1)
    usual, _ = scene_of(MATTE, light="uniform")
    images = [shown.render(shown.conditions(rows), rows) for shown in (scene, usual)]
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=1e-6)
    shiny = ObjectSettings("solid:pear", "pear", gloss=[0.5])
    assert "degree=0" in scene_of(shiny, degree=0, light="uniform")[1]


def irradiance_rms(light: Tensor) -> float:
    """Over normals and channels, by quadrature."""
    normals, shares = quadrature(16)
    directions, weights = quadrature(100)
    radiance = Harmonics(round(len(light) ** 0.5) - 1).radiance(directions) @ light.double()
    irradiance = (normals @ directions.T).clamp(min=0) @ (weights[:, None] * radiance)
    return float((shares @ irradiance.square()).sum().sqrt())


def test_light_whose_irradiance_changes_as_it_is_made_physical_is_told(tmp_path):
    """A sun of degree 6 by 17 %, and one in a brighter sky by less than 5 %; by quadrature."""
    toward = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    for sky, warned in ((0.0, True), (1.5, False)):
        light = directional(toward, torch.ones(3, dtype=torch.float64)).float()
        light[0] += sky
        scene = augment.build_scene([MATTE], 8, light=light, **OPTIONS)
        chosen = augment.AttackSettings(pixels=augment.StepSettings(radius=0.1), max_steps=0)
        result, told = quietly(augment.attack, classifier(), scene, settings=chosen)
        physical = result.problem.scene.lights[0]
        error = irradiance_rms(physical - light) / irradiance_rms(light)
        assert (error > 0.05) == warned and (f"irradiance is off by {error:.0%}" in told) == warned


def test_a_light_that_a_low_degree_cuts_off_is_told(tmp_path):
    """Bands above the second have .087 of a sun's rms irradiance, Σ (2l + 1) A_l² (Ramamoorthi and Hanrahan 2001)."""
    sun = torch.zeros(64, 128, 3)
    sun[20, 30] = 100
    write_map(tmp_path / "sun.npy", sun)
    name = str(tmp_path / "sun.npy")
    assert "irradiance that is off by 9%" in scene_of(MATTE, light=name, degree=2)[1]
    assert scene_of(MATTE, light=name, degree=4)[1] == ""


def test_a_degree_whose_operators_no_memory_holds_is_lowered_and_the_error_is_told():
    """Operators of 10⁹ pixels take 392 GB at degree 6, so that no higher degree is chosen."""
    glossy = Smoothest(0.2, "ball")
    with pytest.warns(UserWarning, match="memory for degree 6.* off by [0-9]+%"):
        assert degree_of_scene(glossy, None, 10**9) == 6
    with pytest.warns(UserWarning, match="degree=6"):
        assert degree_of_scene(glossy, None, 10) == glossy.degree
