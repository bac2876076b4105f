import math
from dataclasses import fields, replace

import pytest
import torch

import augment
from augment.attacks.adversary import Adversary, reload, write_adversary
from augment.attacks.parameters import make_parameter
from augment.attacks.problem import AttackProblem
from augment.parameter_settings import StepSettings
from augment.scene.build import build_local_light
from augment.scene.conditions import Conditions
from augment.scene.scene import Scene
from augment.settings import LOCAL_LIGHT_SETTINGS, LampsSettings, ProjectorSettings, SceneSettings
from renderer.errors import InputError
from renderer.light.light_files import read_light, save_light
from renderer.light.local_lights import LOCAL_LIGHTS
from renderer.transport import lamp_paths as sparse
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

SIZE, EVERY = 16, torch.arange(2)
PROJECTOR = ProjectorSettings(pixels=6, polar=50, azimuth=10, power=2.0, pattern=0.1)
LAMPS = LampsSettings([[2, 0, 2], [0, 2, 2]], start=[[0.5, 0.4, 0.3], [0.1, 0.2, 0.3]])
CLASSES = ("orange", "lime", "sky")


CUP = {"solid": "solid:cup", "exposure": 0.2, "backgrounds": [0.0]}  # which throws shadows on itself


def scene(size: int = SIZE, solid: str = "solid:orange", **choices) -> Scene:
    """Two views before gray."""
    lights = {"projector": PROJECTOR, "lamps": LAMPS, "light": "st_peters"} | choices
    return augment.build_scene([(solid, "orange")], size, 2, rasterizer="numpy", **lights)


@pytest.mark.parametrize("kind", LOCAL_LIGHTS.values())
def test_each_kind_of_local_light_has_settings_an_attack_and_a_file(kind, tmp_path):
    basis, coefficients = build_local_light(LOCAL_LIGHT_SETTINGS[kind.name]())
    assert type(basis) is kind and coefficients.shape == (basis.size, 3)
    assert kind.name in {item.name for item in fields(SceneSettings)}
    assert kind.name in {item.name for item in fields(augment.AttackSettings)}
    given = torch.rand(basis.size, 3, generator=torch.Generator().manual_seed(0))
    save_light(tmp_path / "light.json", given, basis)
    found, values = read_light(tmp_path / "light.json", *LOCAL_LIGHTS.values())
    assert found == basis and torch.equal(values, given)


@pytest.mark.parametrize("parameter", ["lighting", "projector", "lamps", "positions"])
def test_each_light_changes_alone_with_the_gradient_of_finite_differences(parameter):
    """On an orange, on most of which no shadow moves with the lamps; two views share the lights."""
    shown, one = scene(exposure=0.3, shared=True, samples=4), torch.arange(1)
    problem = AttackProblem(shown, [make_parameter(parameter, shown, StepSettings())])
    draws = torch.Generator().manual_seed(0)
    values = problem.start.clone().requires_grad_(True)
    images = problem.render(values, one)
    torch.testing.assert_close(images, shown.render(shown.conditions(one), one), rtol=0, atol=1e-6)
    weights, direction = torch.rand(images.shape, generator=draws), torch.rand(values.shape, generator=draws)
    (gradient,) = torch.autograd.grad((images * weights).sum(), values)
    ends = [problem.render(problem.start + step * direction, one).double() for step in (1e-2, -1e-2)]
    slope = (weights * (ends[0] - ends[1])).sum() / 2e-2
    moved = parameter == "positions"
    torch.testing.assert_close((gradient * direction).double().sum(), slope, rtol=2e-2 if moved else 1e-3, atol=0)
    changed = problem.conditions(problem.start + direction, one).light != shown.lights
    assert changed.any(2).any(0).sum() == (0 if moved else values.shape[1] // 3)


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_patterns_and_powers_stay_in_range_and_in_their_norm_ball(norm):
    shown = scene()
    for parameter, most in (("projector", 2.0), ("lamps", 10.0)):
        changed = make_parameter(parameter, shown, StepSettings(norm, 0.4))
        wanted = changed.start + 9 * torch.randn(changed.start.shape, generator=torch.Generator().manual_seed(1))
        for values in (changed.project(wanted, EVERY), changed.sample(torch.Generator().manual_seed(2))):
            assert values.min() >= 0 and values.max() <= most
            reach = (values - changed.start).norm(dim=1) if norm == "l2" else (values - changed.start).abs()
            assert reach.max() <= 0.4 * (1 + 1e-5)


@pytest.mark.parametrize("radius", [0.0, 0.1])
def test_a_joint_attack_lowers_the_cost_and_is_reloaded_and_rendered_alike_by_mitsuba(radius, tmp_path):
    """Within 2/255 at the median: Mitsuba samples the lights, its discs cast shadows, and outlines have four samples
    here."""
    classifier = augment.Classifier(lambda images: 30 * images.mean((2, 3)), SIZE, CLASSES)
    steps = {
        **dict.fromkeys(("lighting", "projector", "lamps"), StepSettings("linf", None, "unit", 0.5)),
        "positions": StepSettings("l2", 1.0, "unit", 0.3),
        "geometry": StepSettings("linf", 0.02, "sign", 0.01),
        "albedo": StepSettings("linf", 0.1, "sign", 0.05),
    }
    settings = augment.AttackSettings(**steps, max_steps=3, shorten=True)
    shown = scene(exposure=0.3, lamps=replace(LAMPS, radius=radius))
    done = augment.attack(classifier, shown, settings=settings, force=True)
    assert (done.images - done.images_before).abs().max() > 0.05
    assert (done.descent.cost < done.descent.cost_before).all()
    written = Adversary.of(done.problem.scene, 0, done.conditions, done.images_before[0], done.images[0])
    write_adversary(written, tmp_path)
    found = reload(tmp_path)
    assert torch.equal(found.light, written.light) and found.basis == written.basis
    torch.testing.assert_close(found.render(choose("numpy")), done.images[0], rtol=0, atol=1e-6)
    projector, pattern = build_local_light(ProjectorSettings(6, power=2.0, pattern=str(tmp_path / "projector.png")))
    torch.testing.assert_close(pattern, written.light[49:85], rtol=0, atol=projector.power / 255)

    pytest.importorskip("mitsuba")
    from augment.attacks.attack_files import render_again

    seen = render_again(tmp_path, ["mitsuba"], choose("numpy"))["mitsuba"]
    assert (seen - done.images[0]).abs().median() < 2 / 255


def test_a_table_receives_the_projection_and_the_shadow():
    """Lit from straight above, from where a screen through the origin, at 4, would be white: but for the shadow of the
    orange, the table below it is even, and darker by the squares of the distances."""
    above = ProjectorSettings(pixels=1, polar=0, pattern=1.0, fov=60)
    alone = {"light": torch.zeros(49, 3), "projector": above, "lamps": None, "backgrounds": [0.0], "width": 4.0}
    shown, bare = (scene(48, **alone, polar=0, ground=color, samples=4) for color in ([0.2, 0.5, 0.7], None))
    table, orange = (each.render(each.conditions(EVERY), EVERY)[0, 0] for each in (shown, bare))
    beside = table[:, (orange.sum(0) == 0) & (table.sum(0) > 0)]
    below = -shown.mesh(0).vertices[:, 2].min()
    expected = torch.tensor([0.2, 0.5, 0.7]) * (4 / (4 + below)) ** 2
    torch.testing.assert_close(beside.amax(1), expected.float(), rtol=1e-5, atol=0)
    assert 4 <= (beside[1] > 0.9 * expected[1]).sum() < beside.shape[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: build_local_light(ProjectorSettings(pattern="gone.png")), r"pattern: gone\.png"),
        (lambda: build_local_light(LampsSettings([[math.nan, 0, 3]])), r"a coordinate of lamps\.positions=nan"),
        (lambda: build_local_light(LampsSettings([[1, 0]])), r"lamps: give positions"),
        (lambda: build_local_light(LampsSettings(start=[[11, 0, 0]] * 4)), r"start=.* to power=10$"),
        (
            lambda: make_parameter("projector", scene(projector=None), StepSettings()),
            r"^projector: the scene has no projector",
        ),
        (lambda: make_parameter("positions", scene(lamps=None), StepSettings()), "the scene has no lamps"),
    ],
)
def test_impossible_lights_are_refused_by_name(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_moved_lamps_stay_in_their_norm_ball_and_are_read_where_they_ended(tmp_path):
    classifier = augment.Classifier(lambda images: 30 * images.mean((2, 3)), SIZE, CLASSES)
    settings = augment.AttackSettings(positions=StepSettings("l2", 0.6, "unit", 0.5), max_steps=3)
    done = augment.attack(classifier, scene(exposure=0.3), settings=settings, force=True)
    distances = (done.conditions.positions - torch.tensor(LAMPS.positions)).flatten(1).norm(dim=1)
    assert (distances > 0.1).all() and (distances <= 0.6 * (1 + 1e-5)).all()
    after = Adversary.of(done.problem.scene, 1, done.conditions, done.images_before[1], done.images[1])
    write_adversary(after, tmp_path)
    torch.testing.assert_close(reload(tmp_path).render(choose("numpy")), done.images[1], rtol=0, atol=1e-6)
    lamps, powers = build_local_light(LampsSettings(start=str(tmp_path / "lamps.json")))
    assert torch.equal(torch.tensor(lamps.positions), done.conditions.positions[1])
    assert torch.equal(powers, after.light[-len(powers) :])
    with pytest.raises(InputError, match=r"projector\.json: its basis is 'projector', give one of lamps"):
        build_local_light(LampsSettings(start=str(tmp_path / "projector.json")))


def test_stacked_sparse_operators_give_the_images_and_gradients_of_each_operator(monkeypatch):
    """Against the operators one by one, with examples left out, repeated and in another order."""
    monkeypatch.setattr(sparse, "SMALL", 0)
    shown = scene(projector=ProjectorSettings(pixels=16, power=2.0))
    draws = torch.Generator().manual_seed(0)
    rows = torch.tensor([1, 0, 0, 1])
    light = (torch.rand(4, shown.basis.size, 3, generator=draws) * 0.2).requires_grad_(True)
    images = shown.render(Conditions(light), rows)[:, 0]
    weights = torch.rand(images.shape, generator=draws)
    (gradient,) = torch.autograd.grad((images * weights).sum(), light)
    item, scene_of = shown.objects[0], (shown.settings, shown.rasterizer)
    cameras = [row.cameras[0] for row in shown.examples]
    operators = build_operators(item.mesh, cameras, *scene_of, item.albedo_scale, shown.basis)
    assert all(operator.sparse is not None for operator in operators)
    alone = light.detach().requires_grad_(True)
    expected = torch.stack([operators[row].image(alone[index]) for index, row in enumerate(rows.tolist())])
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-6)
    (slopes,) = torch.autograd.grad((expected * weights).sum(), alone)
    torch.testing.assert_close(gradient, slopes, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_a_moved_mesh_under_local_lights_looks_like_a_mesh_built_so(normals, shadows):
    """By operators, which sum over lights and samples in code of their own. Shadows of the sky are frozen."""
    shown = scene(**CUP, normals=normals, shadows=shadows)
    draws = torch.Generator().manual_seed(0)
    far = 1e-3 if shadows else 0.1
    vertices = shown.vertices[0] + far * (torch.rand(shown.vertices[0].shape, generator=draws) - 0.5)
    positions = torch.tensor(LAMPS.positions) + 0.3 * torch.randn(2, 3, generator=draws)
    given = Conditions(shown.lights, vertices.expand(2, -1, -1), positions=positions.expand(2, -1, -1))
    mesh = replace(shown.mesh(0), vertices=vertices.double().numpy())
    other = shown.changed(objects=[replace(shown.objects[0], mesh=mesh)], basis=shown.basis_under(given, 0))
    expected = other.render(other.conditions(EVERY), EVERY)
    seen = shown.render(given, EVERY)
    torch.testing.assert_close(seen, expected, rtol=0, atol=2e-3 if shadows else 2e-6)
    assert (seen - shown.render(shown.conditions(EVERY), EVERY)).abs().max() > 0.02


def test_images_and_gradients_by_shape_and_color_add_up_over_the_lights():
    """Of a weighted sum of the image, where nothing is clamped, over black."""
    weights = torch.rand(2, 1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))

    def rendered(**choices) -> tuple[torch.Tensor, ...]:
        shown = scene(**CUP | choices)
        vertices = shown.vertices.expand(2, -1, -1).clone().requires_grad_()
        albedo = torch.zeros(2, len(shown.mesh(0).faces), 3).requires_grad_()
        images = shown.render(Conditions(shown.lights, vertices, albedo), EVERY)
        still = shown.render(shown.conditions(EVERY), EVERY)
        return still, images.detach(), *torch.autograd.grad((images * weights).sum(), (vertices, albedo))

    both, dark = rendered(), {"light": torch.zeros(49, 3)}
    parts = rendered(projector=None, lamps=None), rendered(**dark, lamps=None), rendered(**dark, projector=None)
    assert both[0].max() < 1
    for whole, *alone in zip(both, *parts, strict=True):
        assert all(part.abs().max() > 1e-3 for part in alone)
        torch.testing.assert_close(whole, sum(alone), rtol=0, atol=1e-5 * float(whole.abs().max()))
