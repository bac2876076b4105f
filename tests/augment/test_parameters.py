import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from augment import reshading
from augment.attacks.attack import AttackSettings
from augment.attacks.criteria import Goal
from augment.attacks.descent import descend
from augment.attacks.norm_ball import STEPS, StepSettings, direction
from augment.attacks.parameters import (
    PARAMETERS,
    Albedo,
    AttackProblem,
    Geometry,
    Lighting,
    Parameter,
    Pixels,
    Skylight,
    SkylightSettings,
)
from augment.scene import Conditions, Scene
from renderer.errors import InputError
from renderer.light.environment import read_map, to_map, write_map
from renderer.light.harmonics import project
from renderer.light.nonnegative import TOLERANCE
from renderer.light.presets import directional, mean_luminance
from renderer.light.skylight import TURBIDITY, ZENITH, coefficients
from renderer.transfer import DEGREE

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
FREE = StepSettings()
SKY = (0.9, 0.4, 3.0)
EVERY = torch.arange(3)


def sky_at(start: tuple[float, float, float], **steps: Any) -> SkylightSettings:
    """Zenith and azimuth in radians, turbidity."""
    zenith, azimuth, turbidity = start
    return SkylightSettings(zenith=math.degrees(zenith), azimuth=math.degrees(azimuth), turbidity=turbidity, **steps)


MAKERS: dict[str, Callable[[Scene], Parameter]] = {"skylight": partial(Skylight, settings=sky_at(SKY))} | {
    kind.name: partial(kind, settings=FREE) for kind in (Lighting, Geometry, Albedo, Pixels)
}
SIZES = {"lighting": 49 * 3, "skylight": 3, "geometry": 12 * 3, "albedo": 20 * 3, "pixels": 2 * 3 * 6 * 6}


def test_every_kind_has_a_name_of_its_own():
    assert PARAMETERS.keys() - {"projector", "lamps", "positions"} == MAKERS.keys() == SIZES.keys()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", MAKERS)
def test_a_kind_starts_at_the_scene_as_it_is_in_the_dtype_of_its_light(make_scene, name, dtype):
    """Under a sky the light is another, of the same mean luminance."""
    scene = make_scene(dtype=dtype)
    kind = MAKERS[name](scene)
    assert kind.start.shape == (3, SIZES[name]) and kind.start.dtype == dtype
    conditions = kind.apply(kind.start, scene.conditions(EVERY), EVERY)
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


COMBINATIONS = [
    *([name] for name in MAKERS),
    ["lighting", "geometry", "albedo"],
    ["skylight", "geometry", "albedo", "pixels"],
]


def differences(function: Callable[[Tensor], Tensor], at: Tensor, directions: Tensor) -> Tensor:
    """(N,) derivatives at a point (D,) in directions (N, D), by Richardson from central differences at h and 2h."""

    def central(h: float) -> Tensor:
        ahead, behind = function(torch.cat([at + h * directions, at - h * directions])).split(len(directions))
        return (ahead - behind) / (2 * h)

    return (4 * central(2e-4) - central(4e-4)) / 3


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
@pytest.mark.parametrize("names", COMBINATIONS, ids="+".join)
def test_gradients_are_central_differences(make_scene, fixed_visibility, names, encoding):
    """Away from the start, with two views that share the values; by each value, or along eight mixtures of several
    kinds'. The differences leave a fourth power of h = 2e-4, times fifth derivatives, and rounding over h."""
    scene, draws = make_scene(encoding=encoding), torch.Generator().manual_seed(2)
    scene.render(replace(scene.conditions(EVERY), albedo=scene.lights.new_zeros(3, 20, 3)), EVERY)  # is what is seen
    problem = AttackProblem(scene, [MAKERS[name](scene) for name in names])
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
    """No outline moves then, and so every change is one of normals: the one test in which nothing is held fixed."""
    scene, draws = make_scene(), torch.Generator().manual_seed(2)
    geometry, weights = Geometry(scene, FREE), torch.randn(3, 6, 6, generator=draws, dtype=torch.float64)
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


def attack(model: torch.nn.Module, problem: AttackProblem, goal: Goal, steps: int) -> tuple[Tensor, Tensor]:
    """(values, images) that a descent of so many steps ends with."""
    result = descend(model, problem, goal, AttackSettings(max_steps=steps, margin=0.0, batch_size=4))
    return result.values, result.images


@pytest.mark.parametrize("gray", [0.0, 0.5, 1.0])
def test_one_step_of_the_radius_along_the_sign_is_fgsm(make_scene, make_linear, gray):
    """x + ε sign(∂CE/∂x), clamped, with ∂CE/∂x = Σ (p_c - [c = y]) W_c; before black and white backgrounds too."""
    scene, epsilon = make_scene(backgrounds=torch.full((3, 3, 6, 6), gray)), 8 / 255
    model, before = make_linear(4), scene.render(scene.conditions(EVERY), EVERY)
    logits = model(before.flatten(0, 1)).detach()
    truth = logits.argmax(1)
    slopes = (logits.softmax(1) - torch.nn.functional.one_hot(truth, 4)) @ model[1].weight.detach()
    problem = AttackProblem(scene, [Pixels(scene, StepSettings("linf", epsilon, "sign", epsilon))])
    _, images = attack(model, problem, Goal(truth.view(3, 2)), steps=1)
    expected = (before + epsilon * slopes.sign().view_as(before)).clamp(0, 1)
    assert torch.equal(images, expected)
    assert ((images - before).abs() > 0.99 * epsilon).double().mean() > 0.4


@pytest.mark.parametrize(("steps", "reach"), [(2, 0.02), (3, 0.03), (9, 0.03)])
def test_iterated_steps_on_pixels_stop_at_the_radius(make_scene, make_linear, steps, reach):
    scene = make_scene(backgrounds=torch.ones(3, 3, 6, 6))
    model, before = make_linear(2, bias=50.0), scene.render(scene.conditions(EVERY), EVERY)
    problem = AttackProblem(scene, [Pixels(scene, StepSettings("linf", 0.03, "sign", 0.01))])
    classes = torch.zeros(3, 2, dtype=torch.int64)
    _, images = attack(model, problem, Goal(classes, classes + 1), steps)
    downhill = (model[1].weight[1] - model[1].weight[0]).detach().sign().view(3, 6, 6)
    torch.testing.assert_close(images, (before + reach * downhill).clamp(0, 1), rtol=0, atol=4 * EPS)


def test_a_random_start_makes_it_projected_gradient_descent_within_the_same_ball(make_scene, make_linear):
    """Every restart ends in the corner that lies downhill of the middle, not of where it began."""
    scene = make_scene()
    problem = AttackProblem(scene, [Pixels(scene, StepSettings("linf", 0.03, "sign", 0.01))])
    problem.start = problem.sample(torch.Generator().manual_seed(0))
    assert problem.start.abs().max() <= 0.03 and problem.start.std() > 0.01
    model, classes = make_linear(2, bias=50.0), torch.zeros(3, 2, dtype=torch.int64)
    values, _ = attack(model, problem, Goal(classes, classes + 1), steps=7)
    downhill = (model[1].weight[1] - model[1].weight[0]).detach().sign()
    assert torch.equal(values, (0.03 * downhill).expand(3, 2, -1).flatten(1))


class Exposure(Parameter):
    """A kind that the package does not have: the logarithm of a factor on the light."""

    name = "exposure"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, scene.lights.new_zeros(len(scene), 1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, light=conditions.light * values.exp()[:, :, None])


def test_a_new_kind_is_one_class_and_goes_with_the_others(make_scene, make_linear):
    """It ends at the end of its interval that lies downhill, on top of the light that is attacked beside it."""
    scene, model, classes = make_scene(), make_linear(2, bias=50.0), torch.zeros(3, 2, dtype=torch.int64)
    kinds = [kind(scene, StepSettings("linf", 0.1, "sign", 0.05)) for kind in (Lighting, Exposure)]
    problem = AttackProblem(scene, kinds)
    values, images = attack(model, problem, Goal(classes, classes + 1), steps=4)
    light, exposure = problem.split(values)
    assert exposure.abs().eq(0.1).all() and (light - problem.split(problem.start)[0]).abs().max() <= 0.1 + EPS
    lit = scene.render(Conditions(light.view(3, 49, 3) * exposure.exp()[:, :, None]), EVERY)
    torch.testing.assert_close(images, lit, rtol=0, atol=64 * EPS)
    other = scene.render(Conditions(light.view(3, 49, 3) * (-exposure).exp()[:, :, None]), EVERY)
    margin, worse = (
        (model(p.flatten(0, 1)) @ torch.tensor([1.0, -1.0]).double()).view(3, 2).sum(1) for p in (lit, other)
    )
    assert (margin < worse).all()


def ringing(scene: Scene) -> Scene:
    """The same in the light of a sun, which dips below zero where harmonics of degree 6 cut it short."""
    sun = directional(torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64), 0.3 * torch.ones(3, dtype=torch.float64))
    return replace(scene, lights=sun)


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_nonnegative_light_is_the_nearest_within_the_ball(make_scene, norm):
    """q is nearest to v exactly when (v - q)·(p - q) ≤ 0 for all p of the set: here other lights that were projected
    into it, the center, and the light's own way there and beyond."""
    scene, draws = ringing(make_scene()), torch.Generator().manual_seed(3)
    light = Lighting(scene, StepSettings(norm, {"linf": 0.05, "l2": 0.4}[norm]), nonnegative=True)
    assert not torch.equal(light.start, scene.lights.flatten(1))
    wanted = light.start + 0.1 * torch.randn(3, 147, generator=draws, dtype=torch.float64)
    nearest, offset = light.project(wanted, EVERY), light.start - wanted
    reach = nearest - light.start
    assert torch.all((reach.norm(dim=1) if norm == "l2" else reach.abs().amax(1)) <= light.settings.radius * (1 + 1e-9))
    torch.testing.assert_close(light.within_domain(nearest), nearest, rtol=0, atol=TOLERANCE)
    others = [light.sample(draws, EVERY) for _ in range(5)] + [light.start, light.start + reach / 2]
    for other in others:
        product = ((wanted - nearest) * (other - nearest)).sum(1)
        assert (product <= 1e-3 * offset.norm(dim=1) * (other - nearest).norm(dim=1)).all()
    torch.testing.assert_close(light.project(nearest, EVERY), nearest, rtol=0, atol=10 * TOLERANCE)


def test_a_descent_in_nonnegative_light_ends_in_light_that_an_environment_map_holds(make_scene, make_linear, tmp_path):
    """And begins with the nearest to the scene's: RGBE, which has no negative numbers, gives the images back."""
    scene, classes = ringing(make_scene()), torch.zeros(3, 2, dtype=torch.int64)
    problem = AttackProblem(scene, [Lighting(scene, StepSettings(step_size=0.5), nonnegative=True)])
    values, images = attack(make_linear(2, bias=50.0), problem, Goal(classes, classes + 1), steps=6)
    assert (values - problem.start).norm(dim=1).min() > 1
    written = []
    for light in values:
        write_map(tmp_path / "light.hdr", to_map(light.unflatten(0, (49, 3)), 128))
        written.append(project(read_map(tmp_path / "light.hdr"), DEGREE))
    read = scene.render(Conditions(torch.stack(written)), EVERY)
    torch.testing.assert_close(read, images, rtol=0, atol=0.5 / 255)


FINITE = st.floats(-50, 50)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_a_sky_never_leaves_its_domain_nor_its_ball(make_scene, norm, dtype):
    """Wherever it starts, the horizon and the clearest and haziest air included; the sky model refuses any other."""
    scene = make_scene(dtype=dtype)
    rounding = 64 * torch.finfo(dtype).eps

    @given(
        start=st.tuples(st.floats(*ZENITH), st.floats(-7, 7), st.floats(*TURBIDITY)),
        values=st.tuples(FINITE, FINITE, FINITE),
        radius=st.one_of(st.none(), st.floats(0, 4)),
    )
    @settings(max_examples=80, deadline=None)
    def check(start: tuple, values: tuple, radius: float | None):
        sky = Skylight(scene, sky_at(start, norm=norm, radius=radius))
        problem = AttackProblem(scene, [sky])
        center, ends = sky.start[0], torch.tensor([[ZENITH[0], -99, 0.5], [ZENITH[1], 99, 2.5]], dtype=dtype)
        torch.testing.assert_close(center * torch.tensor([1, 1, 4], dtype=dtype), torch.tensor(start, dtype=dtype))
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


def test_a_free_descent_over_the_sky_slides_along_the_end_of_its_domain(make_scene, make_linear):
    """With steps far beyond it, up to the horizon and to the haziest or clearest air."""
    scene, classes = make_scene(), torch.zeros(3, 2, dtype=torch.int64)
    problem = AttackProblem(scene, [Skylight(scene, sky_at(SKY, step="sign", step_size=0.8))])
    values, _ = attack(make_linear(2, bias=50.0), problem, Goal(classes, classes + 1), steps=6)
    ends = torch.tensor([[0, math.pi / 2], [0.5, 2.5]], dtype=torch.float64)
    reached = (values[:, [0, 2], None] == ends).any(2)
    assert reached.any(0).all()


@pytest.mark.parametrize("start", [(-0.1, 0, 3), (1.6, 0, 3), (1, 0, 1.9), (1, 0, 10.1), (1, math.nan, 3)])
def test_a_sky_that_starts_outside_its_domain_is_refused(make_scene, start):
    with pytest.raises(InputError, match=r"zenith=|turbidity=|azimuth holds"):
        Skylight(make_scene(), sky_at(start))


@pytest.mark.parametrize(("scale", "tolerance"), [(1.0, EPS32), (1e30, EPS32), (1e-30, EPS32), (1e-40, 1e-4)])
def test_a_unit_step_has_unit_length_whatever_the_gradients_size(scale, tolerance):
    """1e-40 is subnormal in float32, with five digits left."""
    gradient = torch.randn(20, 50, generator=torch.Generator().manual_seed(0))
    expected = gradient.double() / gradient.double().norm(dim=1, keepdim=True)
    step = direction(gradient * scale, "unit")
    torch.testing.assert_close(step.double(), expected, rtol=0, atol=4 * tolerance)


@pytest.mark.parametrize("step", STEPS)
def test_every_example_steps_by_its_own_gradient_and_a_zero_one_stays(step):
    gradient = torch.tensor([[3.0, -4.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-3]])
    expected = {
        "unit": [[0.6, -0.8, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
        "raw": gradient.tolist(),
        "sign": [[1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
    }[step]
    torch.testing.assert_close(direction(gradient, step), torch.tensor(expected), rtol=0, atol=EPS32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": "newton"}, "step=newton: choose one of unit, raw, sign"),
        ({"step_size": 0.0}, "step_size=0.0 must be at least"),
        ({"step_size": -0.05}, "step_size=-0.05"),
        ({"step_size": math.nan}, "step_size=nan"),
        ({"norm": "l1"}, "norm=l1"),
        ({"radius": -1.0}, "radius=-1.0"),
    ],
)
def test_steps_that_lead_nowhere_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        StepSettings(**change)
