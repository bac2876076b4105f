"""Shapes, colors and lights in the scene, attacked at once."""

from dataclasses import replace

import pytest
import torch

import augment
from augment.attacks.adversary import Adversary, reload, write_adversary
from augment.attacks.norm_ball import StepSettings
from augment.attacks.parameters import AttackProblem, Skylight
from augment.build import LampsSettings, ProjectorSettings
from augment.scene import Conditions, Scene
from renderer.rasterizer import choose

SIZE, EVERY = 16, torch.arange(2)
PROJECTOR = ProjectorSettings(pixels=6, polar=50, azimuth=10, power=2.0, pattern=0.3)
LAMPS = LampsSettings([[2, 0, 2], [0, 2, 2]], start=[[0.5, 0.4, 0.3], [0.1, 0.2, 0.3]])
CLASSES = ("orange", "lime", "sky")
STEPS = {
    "lighting": StepSettings("linf", None, "unit", 0.1),
    "skylight": augment.SkylightSettings("linf", None, "unit", 0.2),
    "projector": StepSettings("linf", None, "unit", 0.5),
    "lamps": StepSettings("linf", None, "unit", 0.2),
    "positions": StepSettings("l2", 1.0, "unit", 0.3),
    "geometry": StepSettings("linf", 0.02, "sign", 0.01),
    "albedo": StepSettings("linf", 0.1, "sign", 0.05),
}


def scene(solid: str = "solid:cup", **choices) -> Scene:
    """Two views before black, of what throws shadows on itself."""
    lights = {"projector": PROJECTOR, "lamps": LAMPS, "light": "st_peters", "exposure": 0.2} | choices
    return augment.build_scene([(solid, "orange")], SIZE, 2, rasterizer="numpy", backgrounds=[0.0], **lights)


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_a_moved_mesh_is_seen_as_one_that_was_made_so(normals, shadows):
    """By operators, which share with shading neither the sum over the lights nor that over the samples. Shadows of the
    sky are those of a shape close by."""
    shown = scene(normals=normals, shadows=shadows)
    draws = torch.Generator().manual_seed(0)
    far = 1e-3 if shadows else 0.1
    vertices = shown.vertices[0] + far * (torch.rand(shown.vertices[0].shape, generator=draws) - 0.5)
    positions = torch.tensor(LAMPS.positions) + 0.3 * torch.randn(2, 3, generator=draws)
    given = Conditions(shown.lights, vertices.expand(2, -1, -1), positions=positions.expand(2, -1, -1))
    mesh = replace(shown.mesh(0), vertices=vertices.double().numpy())
    other = replace(shown, objects=[replace(shown.objects[0], mesh=mesh)], basis=shown.basis_under(given, 0))
    expected = other.render(other.conditions(EVERY), EVERY)
    seen = shown.render(given, EVERY)
    torch.testing.assert_close(seen, expected, rtol=0, atol=2e-3 if shadows else 2e-6)
    assert (seen - shown.render(shown.conditions(EVERY), EVERY)).abs().max() > 0.02


def test_gradients_by_shape_and_color_add_up_over_the_lights():
    """Of a weighted sum of the image, where nothing is clamped."""
    weights = torch.rand(2, 1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))

    def gradients(**choices) -> tuple[torch.Tensor, ...]:
        shown = scene(**choices)
        given = shown.vertices.expand(2, -1, -1).clone(), torch.zeros(2, len(shown.mesh(0).faces), 3)
        vertices, albedo = (each.requires_grad_() for each in given)
        images = shown.render(Conditions(shown.lights, vertices, albedo), EVERY)
        return torch.autograd.grad((images * weights).sum(), (vertices, albedo))

    both, dark = gradients(), {"exposure": 1e-9}
    parts = gradients(projector=None, lamps=None), gradients(**dark, lamps=None), gradients(**dark, projector=None)
    for whole, *each in zip(both, *parts, strict=True):
        assert all(part.abs().max() > 1e-3 for part in each)
        torch.testing.assert_close(whole, sum(each), rtol=0, atol=1e-5 * float(whole.abs().max()))


@pytest.mark.parametrize(
    "kinds", ["projector+geometry", "lamps+albedo", "lighting+positions+geometry+albedo", "geometry"]
)
def test_a_joint_attack_lowers_the_cost_and_is_read_back_to_the_same_image(kinds, tmp_path):
    steps = {name: STEPS[name] for name in kinds.split("+")}
    classifier = augment.Classifier(lambda images: 30 * images.mean((2, 3)), SIZE, CLASSES)
    settings = augment.AttackSettings(**steps, max_steps=3, shorten=True)
    done = augment.attack(classifier, scene(), settings=settings, force=True)
    assert (done.descent.cost < done.descent.cost_before).all()
    assert (done.images - done.images_before).abs().max() > 0.02
    for example in range(2):
        images = done.images_before[example], done.images[example]
        write_adversary(Adversary.of(done.problem.scene, example, done.conditions, *images), tmp_path)
        seen = reload(tmp_path).render(choose("numpy"))
        torch.testing.assert_close(seen, done.images[example], rtol=0, atol=1 / 255)


def test_a_sky_is_attacked_beside_a_projector():
    shown = scene(lamps=None)
    problem = AttackProblem(shown, [Skylight(shown, STEPS["skylight"])])
    light = problem.conditions(problem.start, EVERY).light
    assert torch.equal(light[:, 49:], shown.lights[:, 49:]) and not torch.equal(light[:, :49], shown.lights[:, :49])
