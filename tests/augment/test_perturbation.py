import itertools
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from augment.attacks.attack import AttackSettings
from augment.attacks.criteria import Goal
from augment.attacks.descent import DescentResult, descend
from augment.attacks.norm_ball import StepSettings
from augment.attacks.parameters import (
    Albedo,
    AttackProblem,
    Geometry,
    Lighting,
    Pixels,
    Skylight,
    SkylightSettings,
)
from augment.scene import Scene
from renderer.camera import orbit_cameras
from renderer.light.harmonics import nonzero_coefficients
from renderer.transfer import build_operators

EPS = torch.finfo(torch.float64).eps
EVERY = torch.arange(3)
DEAD = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
FRONT, SIDE, BACK = orbit_cameras(3, 2.2)


def attack(model: nn.Module, problem: AttackProblem, goal: Goal, steps: int, **settings) -> DescentResult:
    return descend(model, problem, goal, AttackSettings(max_steps=steps, margin=0.0, **settings))


def towards(problem: AttackProblem, target: int | None = 1) -> Goal:
    """Every image's class 0 falls and another, or none in particular, rises."""
    classes = torch.zeros(len(problem.scene), problem.scene.views, dtype=torch.int64)
    return Goal(classes, None if target is None else classes + target)


def light_slope(scene: Scene, weight: Tensor) -> Tensor:
    """(E, 49, 3) the derivative by the light of weight · images, summed over views, from the operators alone."""
    slope = torch.zeros(len(scene), 49, 3, dtype=weight.dtype)
    for row, cameras in enumerate(scene.cameras):
        operators = build_operators(scene.mesh(row), cameras, scene.settings, scene.rasterizer, dtype=weight.dtype)
        for operator in operators:
            transfer, seen = operator.transfer * operator.albedo[:, None], weight.view(3, -1)[:, operator.pixels]
            slope[row, nonzero_coefficients(6)] += torch.einsum("ckp,cp->kc", transfer, seen)
    return slope


ONE_VIEW, TWO_VIEWS = [[FRONT], [SIDE], [BACK]], [[FRONT, SIDE], [SIDE, BACK], [FRONT, BACK]]
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
def test_the_light_that_fools_a_linear_classifier_most_is_reached(
    make_scene, make_linear, norm, step, step_size, steps, case, dtype
):
    """Where no pixel clamps, the margin is s · U + const, summed over the views that share the light. The ball's lowest
    point is its corner U₀ - r sign(s), to the bit, or U₀ - r s/|s|, to rounding; dead coefficients stay."""
    radius, (cameras, classes, bias, target) = 0.01, CASES[case]
    scene, model = make_scene(cameras=cameras, dtype=dtype), make_linear(classes, bias, dtype=dtype)
    problem = AttackProblem(scene, [Lighting(scene, StepSettings(norm, radius, step, step_size))])
    result = attack(model, problem, towards(problem, target=target), steps)
    assert not result.success.any() and result.steps.eq(steps).all()
    assert result.images.min() > 0 and result.images.max() < 1

    weight, eps = (model[1].weight[0] - model[1].weight[1]).detach().double(), torch.finfo(dtype).eps
    slope, start = light_slope(scene, weight), scene.lights
    lights = result.values.unflatten(1, (49, 3))
    live = slope.abs() > 100 * eps  # a sum of 108 products of each view has a sign then
    assert torch.equal(live, ~DEAD[:, None].expand(3, 49, 3))
    assert torch.equal(lights[:, DEAD], start[:, DEAD])
    if norm == "linf":
        corner = torch.where(slope > 0, start - radius, start + radius)
        assert torch.equal(lights[live], corner[live])
        reach = slope.abs().sum((1, 2))
    else:
        reach = slope.flatten(1).norm(dim=1)
        surface = start - radius * slope / reach[:, None, None]
        torch.testing.assert_close(lights.double(), surface, rtol=0, atol=16 * eps)
    if target is not None:  # then the cost is the margin itself
        lowest = result.cost_before.double() - radius * reach
        torch.testing.assert_close(result.cost.double(), lowest, rtol=0, atol=4 * 50 * eps)


@pytest.mark.parametrize("name", ["lighting", "skylight", "geometry", "albedo"])
def test_views_that_share_what_is_attacked_add_their_gradients(make_scene, make_linear, name):
    """A raw step with two views is the sum of the steps with either: of one light, sky, shape or paint."""

    def moved(cameras: list) -> Tensor:
        scene = make_scene(cameras=[cameras], backgrounds=torch.full((1, 3, 6, 6), 0.5))
        settings = StepSettings(step="raw")
        kind = {
            "lighting": lambda: Lighting(scene, settings),
            "skylight": lambda: Skylight(scene, SkylightSettings(step="raw")),
            "geometry": lambda: Geometry(scene, settings),
            "albedo": lambda: Albedo(scene, settings),
        }[name]()
        problem = AttackProblem(scene, [kind])
        result = attack(make_linear(5, bias=50.0), problem, towards(problem), steps=1)
        return result.values - problem.start

    both, front, side = moved([FRONT, SIDE]), moved([FRONT]), moved([SIDE])
    assert (front != 0).any() and (side != 0).any()
    torch.testing.assert_close(both, front + side, rtol=0, atol=64 * EPS)


def test_pixels_of_one_view_do_not_change_those_of_another(make_scene, make_linear):
    """Views share the values' example and nothing else: a raw step is either view's own."""
    scene = make_scene(cameras=[[FRONT, SIDE]], backgrounds=torch.full((1, 3, 6, 6), 0.5))
    problem = AttackProblem(scene, [Pixels(scene, StepSettings(step="raw", step_size=0.1))])
    model = make_linear(5, bias=50.0)
    result = attack(model, problem, towards(problem), steps=1)
    downhill = (model[1].weight[1] - model[1].weight[0]).detach()
    torch.testing.assert_close(result.values, 0.1 * downhill.repeat(2)[None], rtol=0, atol=16 * EPS)


def test_a_deep_optical_illusion_shows_each_view_another_class(make_scene, make_linear):
    """One light per example makes two views of one thing two other things, in each way; it ends only when both are."""
    targets = torch.tensor([[1, 2], [2, 1], [1, 1]])
    scene = make_scene(cameras=[[FRONT, SIDE]] * 3, backgrounds=torch.full((3, 3, 6, 6), 0.5))
    model, goal = make_linear(3, seed=6), Goal(torch.zeros_like(targets), targets)
    problem = AttackProblem(scene, [Lighting(scene, StepSettings())])
    result = attack(model, problem, goal, steps=30)
    assert result.success.all() and not result.success_before.any()
    assert torch.equal(model(result.images.flatten(0, 1)).argmax(1).view(3, 2), targets)
    assert torch.equal(result.predicted, targets)
    last = result.steps.argmax()
    before = attack(model, problem, goal, steps=int(result.steps[last]) - 1)
    assert not before.success[last] and (before.predicted[last] == targets[last]).sum() < 2


def mixed(scene: Scene, **settings) -> AttackProblem:
    """Light, shape, paint and pixels at once, with balls of their own."""
    return AttackProblem(
        scene,
        [
            Lighting(scene, StepSettings("linf", 0.02, **settings)),
            Geometry(scene, StepSettings("l2", 0.03, **settings)),
            Albedo(scene, StepSettings("l2", 0.1, **settings)),
            Pixels(scene, StepSettings("linf", 0.01, **settings)),
        ],
    )


def reaches(problem: AttackProblem, values: Tensor) -> list[Tensor]:
    """How far each kind has gone, as a share of its radius."""
    parts = zip(problem.parameters, problem.split(values - problem.start), strict=True)
    return [
        (part.norm(dim=1) if kind.settings.norm == "l2" else part.abs().amax(1)) / kind.settings.radius
        for kind, part in parts
    ]


def test_several_kinds_at_once_each_go_to_the_end_of_their_own_ball(make_scene, make_linear):
    scene = make_scene()
    problem = mixed(scene, step_size=0.3)
    result = attack(make_linear(3, bias=50.0), problem, towards(problem), steps=4)
    for reach in reaches(problem, result.values):
        torch.testing.assert_close(reach, torch.ones(3, dtype=torch.float64), rtol=0, atol=1e-9)
    torch.testing.assert_close(result.images, problem.render(result.values, EVERY), rtol=0, atol=0)
    assert (result.cost < result.cost_before).all()


def test_each_kind_steps_and_is_projected_as_if_it_were_alone(make_scene):
    """A unit step is one of each kind, by the size that it has. Examples may have starts of their own."""
    problem, draws = mixed(make_scene()), torch.Generator().manual_seed(0)
    for size, kind in enumerate(problem.parameters, start=1):
        kind.settings, kind.start = replace(kind.settings, step_size=size), kind.start + torch.arange(3)[:, None]
    values = problem.start + 0.1 * torch.randn(problem.start.shape, generator=draws)
    parts, steps = problem.split(values), problem.split(problem.step(values))
    chosen = torch.tensor([2, 0])
    projected = problem.split(problem.project(values[chosen], chosen))
    for kind, part, step, nearest in zip(problem.parameters, parts, steps, projected, strict=True):
        unit = part / part.norm(dim=1, keepdim=True)
        torch.testing.assert_close(step, kind.settings.step_size * unit, rtol=0, atol=16 * EPS)
        assert torch.equal(nearest, kind.settings.project(part[chosen], kind.start[chosen]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_random_draws_keep_to_every_kinds_ball_and_repeat(make_scene, dtype):
    problem = mixed(make_scene(dtype=dtype))
    first, again = (problem.sample(torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first, again) and first.dtype == dtype
    assert not torch.equal(first, problem.sample(torch.Generator().manual_seed(6)))
    for reach in reaches(problem, first):
        # Of 36 values or more: the middle of the ball is rare.
        assert (reach <= 1 + 1e-4).all() and (reach > 0.8).all() and len(reach.unique()) == 3
    assert problem.render(first, EVERY).isfinite().all()


def test_random_draws_go_as_far_as_an_attack_without_a_radius_went(make_scene):
    scene, draws = make_scene(), torch.Generator().manual_seed(0)
    kinds = [
        Lighting(scene, StepSettings()),
        Geometry(scene, StepSettings()),
        Albedo(scene, StepSettings("l2", 0.1)),
    ]
    problem = AttackProblem(scene, kinds)
    values = problem.start + torch.randn(problem.start.shape, generator=draws) * torch.tensor([[0.1], [0.0], [0.3]])
    drawn = problem.sample_as_far(values, torch.Generator().manual_seed(1))
    free = zip(problem.split(values - problem.start), problem.split(drawn - problem.start), strict=True)
    for there, here in itertools.islice(free, 2):
        torch.testing.assert_close(here.norm(dim=1), there.norm(dim=1), rtol=0, atol=64 * EPS)
        assert there[0].norm() > 0 and (here[0] != there[0]).all() and not here[1].any()
    assert (problem.split(drawn)[2].norm(dim=1) <= 0.1 + 1e-6).all()


def test_an_attack_on_light_rasterizes_a_camera_once_and_one_on_shape_every_view_and_step(
    make_scene, make_linear, rasterized
):
    model = make_linear(3, bias=50.0)
    scene = make_scene(cameras=TWO_VIEWS)
    problem = AttackProblem(scene, [Lighting(scene, StepSettings()), Pixels(scene, StepSettings())])
    attack(model, problem, towards(problem), steps=9)
    assert rasterized == [3]
    problem = AttackProblem(scene, [Lighting(scene, StepSettings()), Albedo(scene, StepSettings())])
    attack(model, problem, towards(problem), steps=9)
    assert rasterized == [3] + [1] * 3
    problem = AttackProblem(scene, [Lighting(scene, StepSettings()), Geometry(scene, StepSettings())])
    result = attack(model, problem, towards(problem), steps=4)
    assert result.steps.tolist() == [4, 4, 4] and rasterized == [3] + [1] * (3 + 5 * 6)


def test_shapes_are_rasterized_only_while_they_are_attacked(make_scene, make_linear, rasterized):
    scene, model = make_scene(cameras=ONE_VIEW), make_linear(2, seed=7)
    problem = AttackProblem(scene, [Geometry(scene, StepSettings(step_size=0.3))])
    truth = model(problem.render(problem.start, EVERY).flatten(0, 1)).argmax(1)[:, None]
    rasterized.clear()
    result = attack(model, problem, Goal(truth), steps=6)
    assert result.success.any() and not result.success.all()
    assert rasterized == [1] * int((result.steps + 1).sum())


def test_with_shortened_steps_no_shape_is_worse_than_the_one_before_when_rendered_anew(make_scene, make_linear):
    """Steps of half the mesh's size; without shortening some raise the cost."""
    scene, model = make_scene(), make_linear(3, bias=50.0)
    problem = AttackProblem(scene, [Geometry(scene, StepSettings(step_size=0.5))])
    costs = {}
    for shorten in (False, True):
        results = [attack(model, problem, towards(problem), steps, shorten=shorten) for steps in range(7)]
        costs[shorten] = torch.stack([result.cost for result in results])
        for result in results:
            torch.testing.assert_close(result.images, problem.render(result.values, EVERY), rtol=0, atol=0)
    assert (costs[False].diff(dim=0) > 0).any()
    assert (costs[True].diff(dim=0) <= 0).all() and (costs[True][-1] < costs[True][0]).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_hundreds_of_examples_are_attacked_in_one_batch_and_the_same_each_time(make_scene, make_linear, dtype):
    """300 images of ten cameras, from random lights of a seed; whether fooled at once, on the way or never."""
    cameras = [[camera] for _ in range(30) for camera in orbit_cameras(10, 2.2)]
    scene, model = make_scene(cameras=cameras, dtype=dtype), make_linear(6, dtype=dtype, seed=2)
    problem = AttackProblem(scene, [Lighting(scene, StepSettings("l2", 0.4, step_size=0.1))])
    classes = model(problem.render(problem.start, torch.arange(300)).flatten(0, 1)).argmax(1)[:, None]
    results = []
    for _ in range(2):
        problem.start = problem.sample(torch.Generator().manual_seed(0))
        results.append(attack(model, problem, Goal(classes), steps=5, batch_size=64))
    first, again = results
    assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in vars(first))
    assert {0, 1, 5} <= set(first.steps.tolist()) and 0.1 < first.success.double().mean() < 1
    assert torch.equal(model(first.images.flatten(0, 1)).argmax(1) != classes[:, 0], first.success)
