"""Projectors and lamps are attacked, stay within their limits, and are read back."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import augment
from augment.attack_settings import StepSettings
from augment.attacks.adversary import Adversary, reload, write_adversary
from augment.attacks.parameters import make_parameter
from augment.attacks.problem import SceneProblem
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from augment.settings import LOCAL_LIGHT_SETTINGS, LampsSettings, ProjectorSettings
from renderer.errors import InputError
from renderer.light.files import read_light, save_light
from renderer.light.lamps import LOCAL_LIGHTS, Lamps, Projector
from renderer.visibility import choose
from tests.helpers import by_channel

SIZE = 16
BOTH = torch.arange(2)  # indices of both examples
PROJECTOR = ProjectorSettings(pixels=6, polar=50, azimuth=10, power=2.0, pattern=0.1)
LAMPS = LampsSettings([[2, 0, 2], [0, 2, 2]], start=[[0.5, 0.4, 0.3], [0.1, 0.2, 0.3]])
NO_SKY = torch.zeros(49, 3)

# A cup throws shadows on itself.
CUP = {"solid": "solid:cup", "exposure": 0.2, "backgrounds": [0.0]}


def scene(size: int = SIZE, solid: str = "solid:orange", **choices) -> Scene:
    """Build two views of a solid before gray, with a projector and two lamps."""
    options = {"projector": PROJECTOR, "lamps": LAMPS, "light": "st_peters"} | choices
    return augment.build_scene([(solid, "orange")], size, 2, rasterizer="numpy", **options)


def rendered(shown: Scene, conditions: Conditions | None = None) -> Tensor:
    return shown.render(conditions or shown.conditions(BOTH), BOTH)


@pytest.mark.parametrize("kind", LOCAL_LIGHTS.values())
def test_each_kind_of_local_light_is_read_back_from_its_file(kind, tmp_path):
    basis, _ = kind.from_settings(LOCAL_LIGHT_SETTINGS[kind.name]())
    coefficients = torch.rand(basis.size, 3, generator=torch.Generator().manual_seed(0))
    save_light(tmp_path / "light.json", coefficients, basis)
    found, values = read_light(tmp_path / "light.json", *LOCAL_LIGHTS.values())
    assert found == basis
    assert torch.equal(values, coefficients)


@pytest.mark.parametrize("parameter", ["lighting", "projector", "lamps", "positions"])
def test_each_light_changes_alone_with_the_gradient_of_finite_differences(parameter):
    """On most of an orange, no shadow moves with the lamps. Two views share the lights."""
    first = torch.arange(1)
    shown = scene(exposure=0.3, shared=True, samples=4)
    problem = SceneProblem(shown, [make_parameter(parameter, shown, StepSettings())])
    values = problem.start.clone().requires_grad_(True)
    images = problem.render(values, first)
    unchanged = shown.render(shown.conditions(first), first)
    torch.testing.assert_close(images, unchanged, rtol=0, atol=1e-6)

    draws = torch.Generator().manual_seed(0)
    weights = torch.rand(images.shape, generator=draws)
    direction = torch.rand(values.shape, generator=draws)
    (gradient,) = torch.autograd.grad((images * weights).sum(), values)
    ahead = problem.render(problem.start + 1e-2 * direction, first).double()
    behind = problem.render(problem.start - 1e-2 * direction, first).double()
    slope = (weights * (ahead - behind)).sum() / 2e-2
    found = (gradient * direction).double().sum()
    tolerance = 2e-2 if parameter == "positions" else 1e-3
    torch.testing.assert_close(found, slope, rtol=tolerance, atol=0)

    changed = problem.conditions(problem.start + direction, first).light != shown.lights
    changed_count = int(changed.any(2).any(0).sum())
    assert changed_count == (0 if parameter == "positions" else values.shape[1] // 3)


@pytest.mark.parametrize(
    ("parameter", "power", "norm"), [("projector", 2.0, "linf"), ("lamps", 10.0, "l2")]
)
def test_patterns_and_powers_stay_in_range_and_in_their_norm_ball(norm, parameter, power):
    changed = make_parameter(parameter, scene(), StepSettings(norm, 0.4))
    draws = torch.Generator().manual_seed(1)
    far = changed.start + 9 * torch.randn(changed.start.shape, generator=draws)
    for values in (changed.project(far, BOTH), changed.sample(draws)):
        assert 0 <= values.min() <= values.max() <= power
        offset = values - changed.start
        distance = offset.norm(dim=1) if norm == "l2" else offset.abs()
        assert distance.max() <= 0.4 * (1 + 1e-5)


@pytest.fixture(scope="module", params=[0.0, 0.1], ids=["points", "discs"])
def joint_attack(request, tmp_path_factory) -> tuple[augment.AttackResult, Adversary, Path]:
    """Attack all lights, the shape and the albedo at once, and write the first example."""
    light = StepSettings("linf", None, "unit", 0.5)
    steps = dict.fromkeys(("lighting", "projector", "lamps"), light)
    steps["positions"] = StepSettings("l2", 1.0, "unit", 0.3)
    steps["geometry"] = StepSettings("linf", 0.02, "sign", 0.01)
    steps["albedo"] = StepSettings("linf", 0.1, "sign", 0.05)
    settings = augment.AttackSettings(**steps, max_steps=3, backtracking=True)
    shown = scene(exposure=0.3, lamps=replace(LAMPS, radius=request.param))
    done = augment.attack(by_channel(SIZE), shown, settings=settings, force=True)
    before = done.images_in_views_before[0]
    written = Adversary.of(done.problem.scene, 0, done.conditions, before, done.images_in_views[0])
    folder = tmp_path_factory.mktemp("joint")
    write_adversary(written, folder)
    return done, written, folder


def test_a_joint_attack_lowers_the_cost_and_is_read_back_to_its_image(joint_attack):
    done, written, folder = joint_attack
    assert (done.images - done.images_before).abs().max() > 0.05
    assert (done.minimum.cost < done.minimum.cost_before).all()
    found = reload(folder)
    assert torch.equal(found.light, written.light)
    assert found.basis == written.basis
    image = found.render(choose("numpy"))
    torch.testing.assert_close(image, done.images[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("wrong", [torch.full((2, 2, 3), torch.nan), torch.ones(2, 1, 3)])
def test_positions_of_other_lamps_than_those_of_the_scene_are_refused(wrong):
    shown = scene()
    with pytest.raises(InputError, match="positions"):
        shown.render(Conditions(shown.lights, positions=wrong), BOTH)


def test_an_attacked_pattern_is_written_as_an_image_and_moved_lamps_where_they_ended(joint_attack):
    done, written, folder = joint_attack
    image = str(folder / "projector.png")
    projector, pattern = Projector.from_settings(ProjectorSettings(6, power=2.0, pattern=image))
    expected = written.light[49 : 49 + 6**2]
    torch.testing.assert_close(pattern, expected, rtol=0, atol=projector.power / 255)
    lamps, powers = Lamps.from_settings(LampsSettings(start=str(folder / "lamps.json")))
    assert torch.equal(torch.tensor(lamps.positions), done.conditions.positions[0])
    assert torch.equal(powers, written.light[-len(powers) :])
    with pytest.raises(InputError, match=r"projector\.json"):
        Lamps.from_settings(LampsSettings(start=str(folder / "projector.json")))


def test_mitsuba_renders_a_joint_attack_alike(joint_attack):
    """Mitsuba samples the lights, its discs cast soft shadows, and our outlines are coarse."""
    from augment.attacks.files import render_again

    done, _, folder = joint_attack
    image = render_again(folder, ["mitsuba"], choose("numpy"))["mitsuba"]
    assert (image - done.images[0]).abs().median() < 2 / 255


def test_a_table_receives_the_projection_and_the_shadow():
    """At a distance of 4, a screen would be white. The table is darker by the squared ratio."""
    above = ProjectorSettings(pixels=1, polar=0, pattern=1.0, fov=60)
    lights = {"light": NO_SKY, "projector": above, "lamps": None, "backgrounds": [0.0]}
    options = lights | {"width": 4.0, "polar": 0, "samples": 4}
    color = [0.2, 0.5, 0.7]
    shown = scene(48, ground=color, **options)
    on_table = rendered(shown)[0, 0]
    orange = rendered(scene(48, ground=None, **options))[0, 0]
    is_beside = (orange.sum(0) == 0) & (on_table.sum(0) > 0)
    beside = on_table[:, is_beside]
    depth = -shown.mesh(0).vertices[:, 2].min()
    expected = torch.tensor(color) * (4 / (4 + depth)) ** 2
    torch.testing.assert_close(beside.amax(1), expected.float(), rtol=1e-5, atol=0)
    lit_count = int((beside[1] > 0.9 * expected[1]).sum())
    assert 4 <= lit_count < beside.shape[1]


@pytest.mark.parametrize(
    ("shadows", "distance", "tolerance", "normals"),
    [(False, 0.1, 2e-6, "smooth"), (True, 1e-3, 2e-3, "flat")],
    ids=["no shadows", "shadows"],
)
def test_a_moved_mesh_and_lamps_look_as_if_built_there(normals, shadows, distance, tolerance):
    """Operators sum over lights and samples in other code. Shadows of the sky are frozen."""
    shown = scene(**CUP, normals=normals, shadows=shadows)
    draws = torch.Generator().manual_seed(0)
    before = shown.vertices[0]
    vertices = before + distance * (torch.rand(before.shape, generator=draws) - 0.5)
    positions = torch.tensor(LAMPS.positions) + 0.3 * torch.randn(2, 3, generator=draws)
    conditions = Conditions(
        shown.lights, vertices.expand(2, -1, -1), positions=positions.expand(2, -1, -1)
    )
    mesh = replace(shown.mesh(0), vertices=vertices.double().numpy())
    objects = [replace(shown.objects[0], mesh=mesh)]
    other = shown.changed(objects=objects, basis=shown.basis_under(conditions, 0))
    images = rendered(shown, conditions)
    torch.testing.assert_close(images, rendered(other), rtol=0, atol=tolerance)
    assert (images - rendered(shown)).abs().max() > 0.02


@pytest.mark.parametrize("parameter, light", [("projector", "projector"), ("positions", "lamps")])
def test_an_attack_on_a_light_that_the_scene_lacks_is_refused(parameter, light):
    with pytest.raises(InputError, match=f"{light}"):
        make_parameter(parameter, scene(**{light: None}), StepSettings())
