"""Attack parameters have exact gradients, stay in their balls, and end where theory says."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import draw
from torch import Tensor

from augment.attack_settings import AttackSettings, SkylightSettings, StepSettings
from augment.attacks.loop import Minimum, minimize
from augment.attacks.objective import Objective
from augment.attacks.optimizers import NormBalls
from augment.attacks.parameters import make_parameter
from augment.attacks.problem import SceneProblem, build_problem
from augment.scene import render
from augment.scene.scene import Scene
from augment.tasks.classification import ClassCriterion
from renderer.camera import orbit_cameras
from renderer.light.environment import to_map
from renderer.light.files import mean_luminance
from renderer.light.harmonics import irradiance_error
from renderer.light.nonnegative import TOLERANCE
from renderer.light.skylight import ZENITH, coefficients
from renderer.settings import TURBIDITY

EPS = torch.finfo(torch.float64).eps
SKY = (51.6, 22.9, 3.0)  # zenith and azimuth in degrees, turbidity
EVERY = torch.arange(3)
FRONT, SIDE, BACK = orbit_cameras(3, 2.2)
TWO_VIEWS = [[FRONT, SIDE], [SIDE, BACK], [FRONT, BACK]]


def sky_at(start: tuple[float, float, float], **steps: Any) -> SkylightSettings:
    zenith, azimuth, turbidity = start
    return SkylightSettings(zenith=zenith, azimuth=azimuth, turbidity=turbidity, **steps)


def split(problem: SceneProblem, values: Tensor) -> list[Tensor]:
    return [part for _, part in problem.split_by_parameter(values)]


def problem_of(scene: Scene, **settings: StepSettings) -> SceneProblem:
    parameters = [make_parameter(name, scene, steps) for name, steps in settings.items()]
    return SceneProblem(scene, parameters)


def free(*names: str) -> dict[str, StepSettings]:
    settings = {name: StepSettings() for name in names}
    if "skylight" in names:
        settings["skylight"] = sky_at(SKY)
    return settings


def attack(model, problem, criterion, steps) -> Minimum:
    settings = AttackSettings(max_steps=steps, margin=0.0, quantized=False)
    return minimize(problem, Objective(model, criterion, settings))


def test_each_example_starts_at_the_sky_of_the_settings_with_its_own_mean_luminance(make_scene):
    scene = make_scene()
    factors = torch.tensor([1.0, 0.3, 2.5]).double()
    lights = scene.lights * factors[:, None, None]
    problem = problem_of(scene.changed(lights=lights), skylight=sky_at(SKY))
    skies = problem.conditions(problem.start, EVERY).light
    for sky, light in zip(skies, lights, strict=True):
        assert mean_luminance(sky) == pytest.approx(mean_luminance(light), rel=1e-9)
        expected = coefficients(*SKY)
        expected *= mean_luminance(light) / mean_luminance(expected)
        assert (sky - expected).norm() < 1e-6 * expected.norm()


@pytest.mark.parametrize(
    ("zenith", "turbidity"), [(ZENITH[0], TURBIDITY[0]), (ZENITH[1], TURBIDITY[1]), (45.0, 3.0)]
)
def test_a_nonnegative_sky_keeps_its_mean_and_nearly_its_irradiance(make_scene, zenith, turbidity):
    scene = make_scene()
    lights = []
    for is_negative_allowed in (True, False):
        steps = sky_at((zenith, 30.0, turbidity))
        settings = AttackSettings(skylight=steps, allow_negative=is_negative_allowed)
        problem = build_problem(settings, scene)
        lights.append(problem.conditions(problem.start, EVERY).light[0])
    cut_off, nonnegative = lights
    radiance = to_map(nonnegative, 64)
    assert (radiance.amin((0, 1)) >= -TOLERANCE * radiance.amax((0, 1))).all()
    torch.testing.assert_close(nonnegative[0], cut_off[0])
    assert irradiance_error(nonnegative, cut_off) < 0.09
    without_window = to_map(cut_off, 64)
    assert (without_window.amin((0, 1)) < -TOLERANCE * without_window.amax((0, 1))).any()


@pytest.mark.parametrize("name", ["lighting", "geometry", "albedo", "pixels"])
def test_a_parameter_starts_at_the_scene_as_it_is(make_scene, name):
    scene = make_scene(dtype=torch.float32)
    (parameter,) = problem_of(scene, **free(name)).parameters
    conditions = parameter.apply(parameter.start, scene.conditions(EVERY), EVERY)
    expected = scene.render(scene.conditions(EVERY), EVERY)
    rounding = 64 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(scene.render(conditions, EVERY), expected, rtol=0, atol=rounding)


@pytest.fixture
def fixed_visibility(monkeypatch) -> None:
    """Show cameras what they saw first, which is what the analytic gradient assumes."""
    build = render.build_fragments
    seen = {}

    def build_once(vertices, faces, cameras, *others, **options):
        if cameras not in seen:
            seen[cameras] = build(vertices, faces, cameras, *others, **options)
        return seen[cameras]

    monkeypatch.setattr(render, "build_fragments", build_once)


MIXTURE = ["skylight", "geometry", "albedo", "pixels"]


def derivatives(function: Callable[[Tensor], Tensor], at: Tensor, directions: Tensor) -> Tensor:
    """Return derivatives in several directions: central differences by Richardson's rule."""

    def central(h: float) -> Tensor:
        ahead = function(at + h * directions)
        behind = function(at - h * directions)
        return (ahead - behind) / (2 * h)

    return (4 * central(2e-4) - central(4e-4)) / 3


@pytest.mark.parametrize(
    ("names", "encoding"),
    [(["lighting"], "srgb"), (MIXTURE, "srgb"), (MIXTURE, "linear")],
    ids=lambda value: value if isinstance(value, str) else "+".join(value),
)
def test_gradients_are_central_differences(make_scene, fixed_visibility, names, encoding):
    """Two views share the values. The gradient is compared along eight directions."""
    scene = make_scene(encoding=encoding)
    # The first render decides what `fixed_visibility` keeps in sight.
    unchanged_albedo = scene.lights.new_zeros(3, 20, 3)
    scene.render(replace(scene.conditions(EVERY), albedo=unchanged_albedo), EVERY)
    problem = problem_of(scene, **free(*names))
    at = problem.start[1] + 0.02 * draw(problem.start.shape[1], seed=2)
    weights = draw(2, 3, 6, 6, seed=3)
    directions = draw(8, len(at), seed=4)

    def weighted_sum(values: Tensor) -> Tensor:
        example = torch.ones(len(values), dtype=torch.int64)
        return (problem.render(values, example) * weights).sum((1, 2, 3, 4))

    expected = derivatives(weighted_sum, at, directions)
    largest = float(expected.abs().max())
    assert largest > 0.01
    point = at[None].clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(weighted_sum(point).sum(), point)
    found = directions @ gradient[0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9 * largest)


def test_an_attack_on_the_pixels_renders_only_the_examples_that_it_attacks(
    make_scene, make_linear, monkeypatch
):
    rendered = set()
    original = Scene.render

    def render_noted(scene: Scene, conditions: Any, examples: Tensor, *options: Any) -> Tensor:
        rendered.update(examples.tolist())
        return original(scene, conditions, examples, *options)

    monkeypatch.setattr(Scene, "render", render_noted)
    settings = AttackSettings(pixels=StepSettings("linf", 0.1, "sign", 0.03), max_steps=2)
    problem = build_problem(settings, make_scene())
    criterion = ClassCriterion(torch.zeros(2, 2, dtype=torch.int64))
    objective = Objective(make_linear(3, bias=50.0), criterion, settings)
    minimize(problem, objective, examples=torch.tensor([2, 0]))
    assert rendered == {0, 2}


@pytest.mark.parametrize("gray", [0.0, 1.0])
def test_steps_from_a_random_start_are_pgd(make_scene, make_linear, gray):
    """PGD clips the images of the start and of each step to the ball and to [0, 1]."""
    pixels = StepSettings("linf", 0.1, "sign", 0.03)
    options = {"max_steps": 8, "margin": 1e4, "quantized": False, "allow_negative": True}
    settings = AttackSettings(pixels=pixels, **options)
    problem = build_problem(settings, make_scene(backgrounds=torch.full((3, 3, 6, 6), gray)))
    model = make_linear(4)
    before = problem.images(problem.start)
    labels = model(before.flatten(0, 1)).argmax(1)
    draws = 2 * torch.rand(problem.start.shape, generator=torch.Generator().manual_seed(0)) - 1
    start = (before + 0.1 * draws.view_as(before)).clamp(0, 1)
    expected = start.clone()
    for _ in range(8):
        leaf = expected.requires_grad_()
        loss = torch.nn.functional.cross_entropy(model(leaf.flatten(0, 1)), labels)
        (gradient,) = torch.autograd.grad(loss, leaf)
        stepped = leaf.detach() + 0.03 * gradient.sign()
        expected = stepped.clamp(before - 0.1, before + 0.1).clamp(0, 1)

    sampled = problem.sample(torch.Generator().manual_seed(0))
    torch.testing.assert_close(before + sampled.view_as(before), start, rtol=0, atol=2e-6)
    objective = Objective(model, ClassCriterion(labels.view(3, 2)), settings)
    images = minimize(problem, objective, start=sampled).images
    torch.testing.assert_close(images, expected, rtol=0, atol=2e-6)


SKY_STARTS = st.tuples(st.floats(*ZENITH), st.floats(-400, 400), st.floats(*TURBIDITY))
FINITE = st.floats(-50, 50)
RADII = st.one_of(st.none(), st.floats(0, 4))
# Values of a sky are zenith and azimuth in radians, and a quarter of the turbidity.
LOWEST_SKY = [0.0, -99.0, 0.5]
HIGHEST_SKY = [math.pi / 2, 99.0, 2.5]
SKY_UNITS = [math.degrees(1), math.degrees(1), 4.0]


@pytest.fixture(scope="session")
def scenes_by_dtype(make_scene) -> dict[torch.dtype, Scene]:
    return {dtype: make_scene(dtype=dtype) for dtype in (torch.float32, torch.float64)}


@given(
    start=SKY_STARTS,
    values=st.tuples(FINITE, FINITE, FINITE),
    radius=RADII,
    norm=st.sampled_from(["linf", "l2"]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_a_sky_stays_in_its_domain_and_ball(scenes_by_dtype, norm, dtype, start, values, radius):
    """Starts include the horizon and the clearest and haziest air of the sky model."""
    scene = scenes_by_dtype[dtype]
    sky = make_parameter("skylight", scene, sky_at(start, norm=norm, radius=radius))
    problem = SceneProblem(scene, [sky])
    center = sky.start[0]
    lowest = torch.tensor(LOWEST_SKY, dtype=dtype)
    highest = torch.tensor(HIGHEST_SKY, dtype=dtype)
    units = torch.tensor(SKY_UNITS, dtype=dtype)
    torch.testing.assert_close(center * units, torch.tensor(start, dtype=dtype))

    projected = problem.project(torch.tensor(values, dtype=dtype).expand(3, 3), EVERY)
    assert projected.dtype == dtype
    candidates = [projected]
    if radius is not None:
        candidates.append(problem.sample(torch.Generator().manual_seed(0)))
    for candidate in candidates:
        conditions = sky.apply(candidate, scene.conditions(EVERY), EVERY)
        assert conditions.light.isfinite().all()
        assert (lowest <= candidate).all()
        assert (candidate <= highest).all()
        if radius is not None:
            rounding = 20 * 64 * torch.finfo(dtype).eps
            order = {"l2": 2, "linf": torch.inf}[norm]
            assert ((candidate - center).norm(order, dim=1) <= radius + rounding).all()


TARGETS_OF_VIEWS = torch.tensor([[1, 2], [2, 1], [1, 1]])


def test_one_light_shows_each_view_as_another_class(make_scene, make_linear):
    gray = torch.full((3, 3, 6, 6), 0.5)
    scene = make_scene(cameras=[[FRONT, SIDE]] * 3, backgrounds=gray)
    criterion = ClassCriterion(torch.zeros_like(TARGETS_OF_VIEWS), TARGETS_OF_VIEWS)
    model = make_linear(3, seed=6)
    problem = problem_of(scene, lighting=StepSettings())
    result = attack(model, problem, criterion, steps=30)
    assert result.success.all()
    assert not result.success_before.any()
    predicted = model(result.images.flatten(0, 1)).argmax(1).view(3, 2)
    assert torch.equal(predicted, TARGETS_OF_VIEWS)
    assert torch.equal(result.predicted, TARGETS_OF_VIEWS)


def test_each_parameter_is_projected_and_steps_as_if_it_were_alone(make_scene):
    mixed = problem_of(
        make_scene(),
        lighting=StepSettings("linf", 0.02, step_size=1.0),
        geometry=StepSettings("l2", 0.03, step_size=2.0),
        albedo=StepSettings("l2", 0.1, step_size=3.0),
        pixels=StepSettings("linf", 0.01, step_size=4.0),
    )
    chosen = torch.tensor([2, 0])
    gradient = draw(*mixed.start.shape)
    values = (mixed.start + 0.1 * gradient)[chosen]
    before, after = split(mixed, values), split(mixed, mixed.project(values, chosen))
    for parameter, part, projected in zip(mixed.parameters, before, after, strict=True):
        balls = NormBalls(parameter.settings, parameter.start[chosen])
        assert torch.equal(projected, balls.project(part, torch.arange(2)))
    steps = split(mixed, mixed.scale_gradient(gradient))
    for size, (part, step) in enumerate(zip(split(mixed, gradient), steps, strict=True), start=1):
        expected = size * part / part.norm(dim=1, keepdim=True)
        torch.testing.assert_close(step, expected, rtol=0, atol=64 * EPS)


def test_random_draws_go_as_far_as_an_attack_without_a_radius_went(make_scene):
    albedo = StepSettings("l2", 0.1)
    problem = problem_of(make_scene(), **free("lighting", "geometry"), albedo=albedo)
    lengths = torch.tensor([[0.1], [0.0], [0.3]])
    offsets = lengths * draw(*problem.start.shape)
    drawn = problem.sample(torch.Generator().manual_seed(1), problem.start + offsets)
    attacked_parts = split(problem, offsets.double())
    drawn_parts = split(problem, drawn - problem.start)
    for index in (0, 1):  # light and shape, which have no radius
        attacked = attacked_parts[index]
        random = drawn_parts[index]
        expected = attacked.norm(dim=1)
        torch.testing.assert_close(random.norm(dim=1), expected, rtol=0, atol=64 * EPS)
        assert expected[0] > 0
        assert (random[0] != attacked[0]).all()
        assert not random[1].any()
    assert (drawn_parts[2].norm(dim=1) <= 0.1 + 1e-6).all()


@pytest.mark.parametrize(
    ("names", "steps", "expected"),
    [
        (("lighting", "pixels"), 3, [3]),  # All cameras at once.
        (("lighting", "albedo"), 3, [2, 2, 2]),  # The two cameras of each example once.
        (("lighting", "geometry"), 2, [2] * 3 * 3),  # Three examples of three images.
    ],
)
def test_only_an_attack_on_shape_rasterizes_in_every_step(
    make_scene, make_linear, rasterized, names, steps, expected
):
    problem = problem_of(make_scene(cameras=TWO_VIEWS), **free(*names))
    source = torch.zeros(3, 2, dtype=torch.int64)
    criterion = ClassCriterion(source, source + 1)
    result = attack(make_linear(3, bias=50.0), problem, criterion, steps)
    assert result.steps.tolist() == [steps] * 3
    assert rasterized == expected
