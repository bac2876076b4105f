"""Parameters of an attack, alone and side by side: gradients, norm-balls, domains, draws, and descents on them."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from augment.attack_settings import AttackSettings
from augment.attacks import norm_ball
from augment.attacks.descent import DescentResult, Goal, descend
from augment.attacks.parameters import make_parameter, parameter_class
from augment.attacks.parameters.local_light import LocalLight
from augment.attacks.problem import AttackProblem
from augment.parameter_settings import PARAMETER_NAMES, SkylightSettings, StepSettings
from augment.scene import reshading
from augment.scene.conditions import Conditions
from augment.scene.scene import Scene
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.light.basis import DEGREE
from renderer.light.environment import read_map, to_map, write_map
from renderer.light.harmonics import nonzero_coefficients, project
from renderer.light.local_lights import LOCAL_LIGHTS
from renderer.light.nonnegative import TOLERANCE
from renderer.light.presets import directional, mean_luminance
from renderer.light.skylight import ZENITH, coefficients
from renderer.settings import TURBIDITY
from renderer.transport.operators import build_operators

EPS = torch.finfo(torch.float64).eps
SKY = (51.6, 22.9, 3.0)
EVERY = torch.arange(3)
ZERO = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)  # no effect on diffuse surfaces
FRONT, SIDE, BACK = orbit_cameras(3, 2.2)
ONE_VIEW, TWO_VIEWS = [[FRONT], [SIDE], [BACK]], [[FRONT, SIDE], [SIDE, BACK], [FRONT, BACK]]


def sky_at(start: tuple[float, float, float], **steps: Any) -> SkylightSettings:
    """Zenith and azimuth in degrees, turbidity."""
    zenith, azimuth, turbidity = start
    return SkylightSettings(zenith=zenith, azimuth=azimuth, turbidity=turbidity, **steps)


def split(problem: AttackProblem, values: Tensor) -> list[Tensor]:
    return [part for _, part in problem.by_parameter(values)]


def problem_of(scene: Scene, **settings: StepSettings) -> AttackProblem:
    return AttackProblem(scene, [make_parameter(name, scene, steps) for name, steps in settings.items()])


def free(*names: str) -> dict[str, StepSettings]:
    """Without a radius."""
    return {name: sky_at(SKY) if name == "skylight" else StepSettings() for name in names}


def attack(model: nn.Module, problem: AttackProblem, goal: Goal, steps: int, **settings) -> DescentResult:
    return descend(model, problem, goal, AttackSettings(max_steps=steps, **{"margin": 0.0, **settings}))


def towards(problem: AttackProblem, target: int | None = 1) -> Goal:
    """Every image's class 0 falls and another, or none in particular, rises."""
    classes = torch.zeros(len(problem.scene), problem.scene.views, dtype=torch.int64)
    return Goal(classes, None if target is None else classes + target)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_each_field_of_the_settings_has_a_class_of_its_name_or_is_a_local_light(name):
    kind = parameter_class(name)
    if name in LOCAL_LIGHTS:
        assert kind is LocalLight
    else:
        assert kind.name == name


def test_a_parameter_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="name=settings"):
        parameter_class("settings")


@pytest.mark.parametrize("wrong", [{"zenith": 120}, {"zenith": -1}, {"turbidity": 1}, {"azimuth": math.nan}])
def test_a_sky_outside_of_the_model_is_refused_when_its_settings_are_made_in_their_units(wrong):
    [(name, value)] = wrong.items()
    with pytest.raises(InputError, match=f"{name}={value}"):
        SkylightSettings(**wrong)
    assert SkylightSettings(zenith=90, azimuth=-180, turbidity=10).zenith == 90


def test_each_example_gets_a_sky_of_its_own_mean_luminance(make_scene):
    scene = make_scene()
    lights = scene.lights * torch.tensor([1.0, 0.3, 2.5]).double()[:, None, None]
    scene = scene.changed(lights=lights)
    problem = problem_of(scene, skylight=sky_at(SKY))
    skies = problem.conditions(problem.start, EVERY).light
    for sky, light in zip(skies, lights, strict=True):
        assert mean_luminance(sky) == pytest.approx(mean_luminance(light), rel=1e-9)


SIZES = {"lighting": 49 * 3, "skylight": 3, "geometry": 12 * 3, "albedo": 20 * 3, "pixels": 2 * 3 * 6 * 6}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SIZES)
def test_a_parameter_starts_at_the_scene_as_it_is_in_the_dtype_of_its_light(make_scene, name, dtype):
    """Under a sky the light is another, of the same mean luminance."""
    scene = make_scene(dtype=dtype)
    (parameter,) = problem_of(scene, **free(name)).parameters
    assert parameter.start.shape == (3, SIZES[name]) and parameter.start.dtype == dtype
    conditions = parameter.apply(parameter.start, scene.conditions(EVERY), EVERY)
    if name == "skylight":
        light = conditions.light[0]
        assert mean_luminance(light) == pytest.approx(mean_luminance(scene.lights[0]), rel=1e-6)
        expected = coefficients(*SKY)
        expected *= mean_luminance(scene.lights[0]) / mean_luminance(expected)
        assert (light - expected).norm() < 1e-6 * expected.norm()
    else:
        images = scene.render(scene.conditions(EVERY), EVERY)
        rounding = 64 * torch.finfo(dtype).eps
        torch.testing.assert_close(scene.render(conditions, EVERY), images, rtol=0, atol=rounding)


@pytest.fixture
def fixed_visibility(monkeypatch) -> None:
    """Whatever moves, each camera sees what it saw first, which is what the analytic gradient assumes."""
    build, seen = reshading.build_fragments, {}

    def still(vertices, faces, cameras, settings, rasterizer, closed=False):
        if cameras[0] not in seen:
            seen[cameras[0]] = build(vertices, faces, cameras, settings, rasterizer, closed=closed)
        return seen[cameras[0]]

    monkeypatch.setattr(reshading, "build_fragments", still)


MIXTURE = ["skylight", "geometry", "albedo", "pixels"]
COMBINATIONS = [*([name] for name in SIZES), ["lighting", "geometry", "albedo"], MIXTURE]


def differences(function: Callable[[Tensor], Tensor], at: Tensor, directions: Tensor) -> Tensor:
    """(N,) derivatives at a point (D,) in directions (N, D), by Richardson from central differences at h and 2h."""

    def central(h: float) -> Tensor:
        ahead, behind = function(torch.cat([at + h * directions, at - h * directions])).split(len(directions))
        return (ahead - behind) / (2 * h)

    return (4 * central(2e-4) - central(4e-4)) / 3


@pytest.mark.parametrize(
    ("names", "encoding"),
    [*((names, "srgb") for names in COMBINATIONS), (MIXTURE, "linear")],
    ids=lambda value: value if isinstance(value, str) else "+".join(value),
)
def test_gradients_are_central_differences(make_scene, fixed_visibility, names, encoding):
    """Away from the start, with two views that share the values; by each value, or along eight mixtures of several
    parameters'. The differences leave a fourth power of h = 2e-4, times fifth derivatives, and rounding over h."""
    scene, draws = make_scene(encoding=encoding), torch.Generator().manual_seed(2)
    scene.render(replace(scene.conditions(EVERY), albedo=scene.lights.new_zeros(3, 20, 3)), EVERY)  # is what is seen
    problem = problem_of(scene, **free(*names))
    at = problem.start[1] + 0.02 * torch.randn(problem.start.shape[1], generator=draws)
    weights = torch.randn(2, 3, 6, 6, generator=draws, dtype=torch.float64)
    directions = torch.eye(len(at)) if len(names) == 1 else torch.randn(8, len(at), generator=draws)
    directions = directions.double()

    def weighed(values: Tensor) -> Tensor:
        return (problem.render(values, torch.ones(len(values), dtype=torch.int64)) * weights).sum((1, 2, 3, 4))

    values = at[None].clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(weighed(values), values)
    expected = differences(weighed, at, directions)
    assert expected.abs().max() > 0.01
    torch.testing.assert_close(directions @ gradient[0], expected, rtol=0, atol=1e-9 * float(expected.abs().max()))


def test_vertices_that_move_along_the_view_have_the_gradient_of_the_image_rendered_anew(make_scene):
    """No outline moves then, and so every change is one of normals: the one test in which nothing stays fixed."""
    scene, draws = make_scene(), torch.Generator().manual_seed(2)
    (geometry,) = problem_of(scene, **free("geometry")).parameters
    weights = torch.randn(3, 6, 6, generator=draws, dtype=torch.float64)
    for view, camera in enumerate(scene.cameras[1]):
        away = torch.from_numpy(camera.axes()[2])
        directions = torch.kron(torch.eye(12, dtype=torch.float64), away)

        def weighed(values: Tensor, view: int = view) -> Tensor:
            example = torch.ones(len(values), dtype=torch.int64)
            images = scene.render(geometry.apply(values, scene.conditions(example), example), example)
            return (images[:, view] * weights).sum((1, 2, 3))

        values = geometry.start[:1].clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(weighed(values), values)
        expected = differences(weighed, geometry.start[0], directions)
        assert expected.abs().max() > 0.01
        torch.testing.assert_close(directions @ gradient[0], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("gray", [0.0, 0.5, 1.0])
def test_one_step_of_the_radius_along_the_sign_is_fgsm(make_scene, make_linear, gray):
    """x + ε sign(∂CE/∂x), clamped, with ∂CE/∂x = Σ (p_c - [c = y]) W_c; before black and white backgrounds too."""
    scene, epsilon = make_scene(backgrounds=torch.full((3, 3, 6, 6), gray)), 8 / 255
    model, before = make_linear(4), scene.render(scene.conditions(EVERY), EVERY)
    logits = model(before.flatten(0, 1)).detach()
    truth = logits.argmax(1)
    slopes = (logits.softmax(1) - torch.nn.functional.one_hot(truth, 4)) @ model[1].weight.detach()
    problem = problem_of(scene, pixels=StepSettings("linf", epsilon, "sign", epsilon))
    images = attack(model, problem, Goal(truth.view(3, 2)), steps=1).images
    expected = (before + epsilon * slopes.sign().view_as(before)).clamp(0, 1)
    assert torch.equal(images, expected)
    assert ((images - before).abs() > 0.99 * epsilon).double().mean() > 0.4


def test_a_random_start_makes_it_projected_gradient_descent_within_the_same_ball(make_scene, make_linear):
    """Every restart ends in the corner that lies downhill of the middle, not of where it began."""
    scene = make_scene()
    problem = problem_of(scene, pixels=StepSettings("linf", 0.03, "sign", 0.01))
    problem.start = problem.sample(torch.Generator().manual_seed(0))
    assert problem.start.abs().max() <= 0.03 and problem.start.std() > 0.01
    model = make_linear(2, bias=50.0)
    values = attack(model, problem, towards(problem), steps=7).values
    downhill = (model[1].weight[1] - model[1].weight[0]).detach().sign()
    assert torch.equal(values, (0.03 * downhill).expand(3, 2, -1).flatten(1))


def ringing(scene: Scene) -> Scene:
    """The same in the light of a sun, which dips below zero where harmonics of degree 6 cut it short."""
    sun = directional(torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64), 0.3 * torch.ones(3, dtype=torch.float64))
    return scene.changed(lights=sun)


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_nonnegative_light_is_the_nearest_within_the_ball(make_scene, norm):
    """q is nearest to v exactly when (v - q)·(p - q) ≤ 0 for all p of the set: here other lights that were projected
    into it, the center, and the light's own way there and beyond."""
    scene, draws = ringing(make_scene()), torch.Generator().manual_seed(3)
    light = make_parameter("lighting", scene, StepSettings(norm, {"linf": 0.05, "l2": 0.4}[norm]), nonnegative=True)
    assert not torch.equal(light.start, scene.lights.flatten(1))
    values = light.start + 0.1 * torch.randn(3, 147, generator=draws, dtype=torch.float64)
    nearest, offset = light.project(values, EVERY), light.start - values
    reach = nearest - light.start
    assert torch.all((reach.norm(dim=1) if norm == "l2" else reach.abs().amax(1)) <= light.settings.radius * (1 + 1e-9))
    torch.testing.assert_close(light.domain(nearest), nearest, rtol=0, atol=TOLERANCE)
    others = [light.sample(draws) for _ in range(2)] + [light.start, light.start + reach / 2]
    for other in others:
        product = ((values - nearest) * (other - nearest)).sum(1)
        assert (product <= 1e-3 * offset.norm(dim=1) * (other - nearest).norm(dim=1)).all()
    torch.testing.assert_close(light.project(nearest, EVERY), nearest, rtol=0, atol=10 * TOLERANCE)


def test_a_descent_in_nonnegative_light_ends_in_light_that_an_environment_map_holds(make_scene, make_linear, tmp_path):
    """And begins with the nearest to the scene's: RGBE, which has no negative numbers, gives the images back."""
    scene = ringing(make_scene())
    light = make_parameter("lighting", scene, StepSettings(step_size=0.5), nonnegative=True)
    problem = AttackProblem(scene, [light])
    result = attack(make_linear(2, bias=50.0), problem, towards(problem), steps=4)
    assert (result.values - problem.start).norm(dim=1).min() > 1
    written = []
    for light in result.values:
        write_map(tmp_path / "light.hdr", to_map(light.unflatten(0, (49, 3)), 128))
        written.append(project(read_map(tmp_path / "light.hdr"), DEGREE))
    read = scene.render(Conditions(torch.stack(written)), EVERY)
    torch.testing.assert_close(read, result.images, rtol=0, atol=0.5 / 255)


FINITE = st.floats(-50, 50)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_a_sky_never_leaves_its_domain_nor_its_ball(make_scene, norm, dtype):
    """Wherever it starts, the horizon and the clearest and haziest air included; the sky model refuses any other."""
    scene = make_scene(dtype=dtype)
    rounding = 64 * torch.finfo(dtype).eps

    @given(
        start=st.tuples(st.floats(*ZENITH), st.floats(-400, 400), st.floats(*TURBIDITY)),
        values=st.tuples(FINITE, FINITE, FINITE),
        radius=st.one_of(st.none(), st.floats(0, 4)),
    )
    @settings(max_examples=30, deadline=None)
    def check(start: tuple, values: tuple, radius: float | None):
        sky = make_parameter("skylight", scene, sky_at(start, norm=norm, radius=radius))
        problem = AttackProblem(scene, [sky])
        center, ends = sky.start[0], torch.tensor([[0, -99, 0.5], [math.pi / 2, 99, 2.5]], dtype=dtype)
        units = torch.tensor([math.degrees(1), math.degrees(1), 4], dtype=dtype)
        torch.testing.assert_close(center * units, torch.tensor(start, dtype=dtype))
        anywhere = torch.tensor(values, dtype=dtype).expand(3, 3)
        projected = problem.project(anywhere, EVERY)
        assert projected.dtype == dtype
        moved = [projected] if radius is None else [projected, problem.sample(torch.Generator().manual_seed(0))]
        for sky_values in moved:
            assert sky.apply(sky_values, scene.conditions(EVERY), EVERY).light.isfinite().all()
            assert (ends[0] <= sky_values).all() and (sky_values <= ends[1]).all()
            offset = (sky_values - center).abs()
            reach = offset.norm(dim=1) if norm == "l2" else offset.amax(1)
            assert radius is None or (reach <= radius + rounding * 20).all()
        if norm == "linf":  # boxes both, so that the nearest point of what they share is that of each axis
            low, high = (ends[0], ends[1]) if radius is None else (center - radius, center + radius)
            nearest = anywhere.clamp(torch.maximum(low, ends[0]), torch.minimum(high, ends[1]))
            torch.testing.assert_close(projected, nearest, rtol=0, atol=0)

    check()


def light_slope(scene: Scene, weight: Tensor) -> Tensor:
    """(E, 49, 3) the derivative by the light of weight · images, summed over views, from the operators alone."""
    slope = torch.zeros(len(scene), 49, 3, dtype=weight.dtype)
    for row, cameras in enumerate(scene.cameras):
        operators = build_operators(scene.mesh(row), cameras, scene.settings, scene.rasterizer, dtype=weight.dtype)
        for operator in operators:
            transfer, seen = operator.transfer * operator.albedo[:, None], weight.view(3, -1)[:, operator.pixels]
            slope[row, nonzero_coefficients(6)] += torch.einsum("ckp,cp->kc", transfer, seen)
    return slope


CASES = {  # cameras, classes, bias of the first class, the one to increase
    "one view, untargeted": (ONE_VIEW, 2, 4.0, None),
    "one view": (ONE_VIEW, 5, 50.0, 1),
    "two views": (TWO_VIEWS, 5, 50.0, 1),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(
    ("norm", "step", "step_size", "steps"),
    [
        ("linf", "sign", 0.004, 3),
        ("linf", "unit", 1e5, 1),  # so far that the smallest derivative reaches its face of the cube too
        ("l2", "unit", 0.004, 3),
        ("l2", "raw", 1e5, 1),
    ],
)
def test_the_light_of_the_lowest_cost_of_a_linear_classifier_is_reached(
    make_scene, make_linear, norm, step, step_size, steps, case, dtype
):
    """Where no pixel clamps, the margin is s · U + const, summed over the views that share the light. The ball's lowest
    point is its corner U₀ - r sign(s), to the bit, or U₀ - r s/|s|, to rounding; coefficients without effect stay."""
    radius, (cameras, classes, bias, target) = 0.01, CASES[case]
    scene, model = make_scene(cameras=cameras, dtype=dtype), make_linear(classes, bias, dtype=dtype)
    problem = problem_of(scene, lighting=StepSettings(norm, radius, step, step_size))
    result = attack(model, problem, towards(problem, target=target), steps)
    assert not result.success.any() and result.steps.eq(steps).all()
    assert result.images.min() > 0 and result.images.max() < 1

    weight, eps = (model[1].weight[0] - model[1].weight[1]).detach().double(), torch.finfo(dtype).eps
    slope, start = light_slope(scene, weight), scene.lights
    lights = result.values.unflatten(1, (49, 3))
    nonzero = slope.abs() > 100 * eps  # a sum of 108 products of each view has a sign then
    assert torch.equal(nonzero, ~ZERO[:, None].expand(3, 49, 3))
    assert torch.equal(lights[:, ZERO], start[:, ZERO])
    if norm == "linf":
        corner = torch.where(slope > 0, start - radius, start + radius)
        assert torch.equal(lights[nonzero], corner[nonzero])
        reach = slope.abs().sum((1, 2))
    else:
        reach = slope.flatten(1).norm(dim=1)
        surface = start - radius * slope / reach[:, None, None]
        torch.testing.assert_close(lights.double(), surface, rtol=0, atol=16 * eps)
    if target is not None:  # then the cost is the margin itself
        lowest = result.cost_before.double() - radius * reach
        torch.testing.assert_close(result.cost.double(), lowest, rtol=0, atol=4 * 50 * eps)


def test_a_deep_optical_illusion_shows_each_view_another_class(make_scene, make_linear):
    """One light per example makes two views of one thing two other things, in each way; it ends only when both are."""
    targets = torch.tensor([[1, 2], [2, 1], [1, 1]])
    scene = make_scene(cameras=[[FRONT, SIDE]] * 3, backgrounds=torch.full((3, 3, 6, 6), 0.5))
    model, goal = make_linear(3, seed=6), Goal(torch.zeros_like(targets), targets)
    problem = problem_of(scene, lighting=StepSettings())
    result = attack(model, problem, goal, steps=30)
    assert result.success.all() and not result.success_before.any()
    assert torch.equal(model(result.images.flatten(0, 1)).argmax(1).view(3, 2), targets)
    assert torch.equal(result.predicted, targets)
    last = result.steps.argmax()
    before = attack(model, problem, goal, steps=int(result.steps[last]) - 1)
    assert not before.success[last] and (before.predicted[last] == targets[last]).sum() < 2


def mixed(scene: Scene, **steps) -> AttackProblem:
    """Light, shape, paint and pixels at once, with balls of their own."""
    balls = {"lighting": ("linf", 0.02), "geometry": ("l2", 0.03), "albedo": ("l2", 0.1), "pixels": ("linf", 0.01)}
    return problem_of(scene, **{name: StepSettings(*ball, **steps) for name, ball in balls.items()})


def test_each_parameter_steps_and_is_projected_as_if_it_were_alone(make_scene):
    """A unit step is one of each parameter. Examples may have starts of their own."""
    problem, draws = mixed(make_scene()), torch.Generator().manual_seed(0)
    for size, parameter in enumerate(problem.parameters, start=1):
        parameter.settings = replace(parameter.settings, step_size=size)
        parameter.start = parameter.start + torch.arange(3)[:, None]
    values = problem.start + 0.1 * torch.randn(problem.start.shape, generator=draws)
    parts = split(problem, values)
    chosen = torch.tensor([2, 0])
    length = torch.tensor([[0.5], [2.0]]).double()
    projected = split(problem, problem.project(values[chosen], chosen))
    stepped = split(problem, problem.take_step(values[chosen], values[chosen], chosen, length))
    for parameter, part, nearest, after in zip(problem.parameters, parts, projected, stepped, strict=True):
        part, center = part[chosen], parameter.start[chosen]
        assert torch.equal(nearest, norm_ball.project(parameter.settings, part, center))
        unit = part / part.norm(dim=1, keepdim=True)
        expected = norm_ball.project(parameter.settings, part - length * parameter.settings.step_size * unit, center)
        torch.testing.assert_close(after, expected, rtol=0, atol=64 * EPS)


def test_random_draws_go_as_far_as_an_attack_without_a_radius_went(make_scene):
    scene, draws = make_scene(), torch.Generator().manual_seed(0)
    problem = problem_of(scene, **free("lighting", "geometry"), albedo=StepSettings("l2", 0.1))
    values = problem.start + torch.randn(problem.start.shape, generator=draws) * torch.tensor([[0.1], [0.0], [0.3]])
    drawn = problem.sample(torch.Generator().manual_seed(1), values)
    pairs = zip(split(problem, values - problem.start), split(problem, drawn - problem.start), strict=True)
    for there, here in itertools.islice(pairs, 2):
        torch.testing.assert_close(here.norm(dim=1), there.norm(dim=1), rtol=0, atol=64 * EPS)
        assert there[0].norm() > 0 and (here[0] != there[0]).all() and not here[1].any()
    assert (split(problem, drawn)[2].norm(dim=1) <= 0.1 + 1e-6).all()


def test_an_attack_on_light_rasterizes_a_camera_once_and_one_on_shape_every_view_and_step(
    make_scene, make_linear, rasterized
):
    model = make_linear(3, bias=50.0)
    scene = make_scene(cameras=TWO_VIEWS)
    problem = problem_of(scene, **free("lighting", "pixels"))
    attack(model, problem, towards(problem), steps=9)
    assert rasterized == [3]
    problem = problem_of(scene, **free("lighting", "albedo"))
    attack(model, problem, towards(problem), steps=9)
    assert rasterized == [3] + [1] * 3
    problem = problem_of(scene, **free("lighting", "geometry"))
    result = attack(model, problem, towards(problem), steps=4)
    assert result.steps.tolist() == [4, 4, 4] and rasterized == [3] + [1] * (3 + 5 * 6)
