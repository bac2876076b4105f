"""Projections to light that is nowhere negative, against closed forms and SciPy's optimizers."""

import math
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import trimesh
from oracles import draw, random_directions
from scipy import optimize
from torch import Tensor

from renderer.light.files import ambient, load_light
from renderer.light.harmonics import basis, lambertian_factors, project, quadrature
from renderer.light.nonnegative import TOLERANCE, nearest_nonnegative, project_nonnegative
from renderer.light.ringing import nonnegative_window
from renderer.vectors import Ball

GRACE = load_light("grace").double()


def icosphere_basis(subdivisions: int) -> Tensor:
    vertices = trimesh.creation.icosphere(subdivisions=subdivisions).vertices
    return basis(torch.from_numpy(np.array(vertices)), 6)


# Harmonics at 10,242 directions.
DENSE = icosphere_basis(5)


def random_lights(count: int, amplitude: float) -> Tensor:
    return GRACE + amplitude * draw(count, 49, 3, seed=round(100 * amplitude))


def test_degree_1_is_projected_into_a_second_order_cone():
    """The light a + b·ω is nowhere negative if |b| ≤ a (Boyd and Vandenberghe, section 8.1.1)."""
    lights = draw(10, 4, 3)
    height = lights[:, 0]
    tilt = lights[:, 1:].norm(dim=1)
    # The cone has the side (1, 1/√3) in the plane of height and tilt.
    height_on_side = (height + tilt / math.sqrt(3)).clamp(min=0) * 3 / 4
    tilt_on_side = height_on_side / math.sqrt(3)
    is_inside = math.sqrt(3) * tilt <= height
    expected = lights.clone()
    expected[:, 0] = torch.where(is_inside, height, height_on_side)
    expected[:, 1:] *= torch.where(is_inside, 1.0, tilt_on_side / tilt)[:, None]
    torch.testing.assert_close(nearest_nonnegative(lights), expected, rtol=0, atol=TOLERANCE)


def best_on_grid(target, weights, start, grid, **options) -> float:
    """Return the weighted distance of SciPy's nearest light that is nowhere negative on a grid.

    Its light is slightly nearer than the one that is nowhere negative between the nodes, too.
    """
    [constraint] = options.pop("constraints", [None])
    radiance = {"type": "ineq", "fun": lambda values: grid @ values, "jac": lambda values: grid}
    options["constraints"] = [radiance, constraint] if constraint else [radiance]
    options |= {"method": "SLSQP", "options": {"ftol": 1e-12, "maxiter": 200}}
    options["jac"] = lambda x: 2 * weights**2 * (x - target)
    found = optimize.minimize(lambda x: (weights**2 * (x - target) ** 2).sum(), start, **options)
    return math.sqrt(found.fun)


@pytest.mark.parametrize("norm", [None, "linf", "l2"])
def test_scipy_finds_no_nearer_light_also_in_a_ball(norm):
    target = random_lights(1, 0.1)[0, :, 0]
    center = nearest_nonnegative(GRACE)[:, 0]
    radius = {None: None, "linf": 0.1, "l2": 0.3}[norm]
    ball = Ball(center[None, :, None], radius, norm) if norm else None
    options = {}
    if norm == "linf":
        options["bounds"] = [(value - radius, value + radius) for value in center.tolist()]
    if norm == "l2":
        middle = center.numpy()
        sphere = {"type": "ineq", "fun": lambda x: radius**2 - ((x - middle) ** 2).sum()}
        sphere["jac"] = lambda x: 2 * (middle - x)
        options["constraints"] = [sphere]
    nearest = nearest_nonnegative(target[None, :, None], ball)[0, :, 0]
    grid = icosphere_basis(3).numpy()
    expected = best_on_grid(target.numpy(), np.ones(49), nearest.numpy(), grid, **options)
    distance = float((nearest - target).norm())
    assert expected - 1e-5 <= distance <= 1.03 * expected


def assert_nowhere_negative(lights: Tensor) -> None:
    radiance = torch.einsum("dk,nkc->ndc", DENSE, lights)
    assert (radiance.amin(1) >= -TOLERANCE * radiance.abs().amax(1)).all()


@pytest.mark.parametrize(
    ("amplitude", "norm", "radius"), [(3.0, "linf", 0.1), (0.1, "l2", 0.3), (3.0, "l2", 100.0)]
)
def test_the_nearest_light_in_a_ball_is_there_and_nowhere_negative(amplitude, norm, radius):
    assert_nowhere_negative(nearest_nonnegative(random_lights(2, amplitude)))
    target = random_lights(2, amplitude)
    center = nearest_nonnegative(GRACE).expand_as(target)
    nearest = nearest_nonnegative(target, Ball(center, radius, norm))
    assert_nowhere_negative(nearest)
    order = {"linf": torch.inf, "l2": 2}[norm]
    distance = (nearest - center).flatten(1).norm(order, dim=1)
    assert (distance <= radius * (1 + 1e-12)).all()
    if radius < 1:  # The target is outside, so that the nearest point is on the surface.
        assert (distance >= radius * (1 - 1e-6)).all()


both_projections = pytest.mark.parametrize("projection", [nearest_nonnegative, project_nonnegative])


@both_projections
def test_channels_that_are_nowhere_negative_stay_to_the_bit(projection):
    lights = load_light("grace").repeat(2, 1, 1)
    lights[1, :, 1] = ambient(torch.ones(3))[:, 1]
    projected = projection(lights)
    assert projected.dtype == torch.float32
    assert torch.equal(projected[1, :, 1], lights[1, :, 1])
    assert not torch.equal(projected[0], lights[0])
    assert torch.equal(projection(projected), projected)


@both_projections
def test_dark_light_stays_and_negative_light_becomes_dark(projection):
    dark = torch.zeros(49, 3)
    assert torch.equal(projection(dark), dark)
    torch.testing.assert_close(projection(ambient(-torch.ones(3))), dark, rtol=0, atol=1e-6)


@both_projections
def test_light_that_is_zero_along_circles_stays(projection):
    def radiance(directions: Tensor) -> Tensor:
        x, y, _ = directions.split(1, dim=1)
        return (x**3 + y**3) ** 2 * torch.ones(3)

    light = project(radiance, 6)
    torch.testing.assert_close(projection(light), light, rtol=0, atol=1e-12)


@both_projections
def test_the_projection_scales_with_the_light(projection):
    light = random_lights(1, 0.1)[0, :, :1]
    expected = 1e-30 * projection(light)
    torch.testing.assert_close(projection(1e-30 * light), expected, rtol=1e-4, atol=1e-35)


# Powers of three point sources in concentrated lights.
POWERS = {
    "sun": [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    "two suns": [[1.0, 0.8, 0.6], [0.2, 0.3, 0.5], [0.0, 0.0, 0.0]],
    "lamps": [[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.3, 0.1, 0.0]],
}


def concentrated_light(name: str, degree: int) -> Tensor:
    powers = torch.tensor(POWERS[name], dtype=torch.float64)
    light = basis(random_directions(3, seed=4), degree).T @ powers
    if name == "two suns":
        light[0] += 0.02
    return light


@cache
def irradiance_at_normals(degree: int) -> Tensor:
    """Integrate each harmonic times the clamped cosine at the nodes of `quadrature(20)`, (N, K)."""
    normals, _ = quadrature(20)
    directions, weights = quadrature(160)
    cosine = (normals @ directions.T).clamp(min=0)
    return cosine @ (weights[:, None] * basis(directions, degree))


def rms_irradiance_error(found: Tensor, given: Tensor, degree: int) -> Tensor:
    _, shares = quadrature(20)
    error = irradiance_at_normals(degree) @ (found.double() - given.double())
    return (shares @ error.square()).sqrt()


def require_physical(given: Tensor, degree: int) -> None:
    """Check the three documented properties of `project_nonnegative` by quadrature."""
    physical = project_nonnegative(given)
    torch.testing.assert_close(physical[0], given[0].clamp(min=0), rtol=1e-6, atol=0)
    directions, _ = quadrature(4 * degree + 7)
    radiance = basis(directions, degree) @ physical.double()
    assert (radiance.amin(0) >= -TOLERANCE * radiance.amax(0)).all()
    windowed = nonnegative_window(degree)[:, None] * given.double()
    error = rms_irradiance_error(physical, given, degree)
    window_error = rms_irradiance_error(windowed, given, degree)
    brightest = (irradiance_at_normals(degree) @ given.double()).abs().amax(0)
    assert (error <= 1.001 * window_error + 1e-6 * brightest).all()


def slow(*values: object) -> list:
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


@pytest.mark.parametrize("name", POWERS)
@pytest.mark.parametrize("degree", [0, 1, 2, 6, *slow(3, 4, 9, 12, 15, 19, 20)])
def test_physical_light_keeps_the_mean_and_no_window_has_a_smaller_error(name, degree):
    require_physical(concentrated_light(name, degree), degree)


@both_projections
def test_random_light_of_degree_9_is_nowhere_negative(projection):
    light = draw(100, 6, seed=5)
    light[0] = 6
    directions, _ = quadrature(200)
    radiance = basis(directions, 9) @ projection(light)
    assert (radiance.amin(0) >= -TOLERANCE * radiance.amax(0)).all()


def test_light_of_degree_2_is_closer_to_a_physical_one_with_more_degrees():
    """An attack on gloss gives degree 39 to light of degree 2."""
    given = concentrated_light("lamps", 2)
    padded = F.pad(given, (0, 0, 0, 9**2 - len(given)))
    physical = project_nonnegative(padded)
    error = rms_irradiance_error(physical, padded, 8)
    radiance = basis(random_directions(2000, seed=5), 8) @ physical
    assert (radiance.amin(0) >= -TOLERANCE * radiance.amax(0)).all()
    assert (error <= rms_irradiance_error(project_nonnegative(given), given, 2)).all()


@pytest.mark.parametrize("degree", [2, *slow(6)])
def test_scipy_finds_no_light_of_the_same_mean_with_a_closer_irradiance(degree):
    given = random_lights(1, 0.1)[0, : (degree + 1) ** 2, 0]
    physical = project_nonnegative(given[:, None])[:, 0]
    factors = lambertian_factors(degree).numpy()
    same_mean = {"type": "eq", "fun": lambda x: x[:1] - given.numpy()[:1]}
    same_mean["jac"] = lambda x: np.eye(len(x))[:1]
    grid = DENSE[:642, : len(given)].numpy()
    found = best_on_grid(given.numpy(), factors, physical.numpy(), grid, constraints=[same_mean])
    error = float((torch.from_numpy(factors) * (physical - given)).norm())
    assert error <= 1.03 * found + 1e-3 * float(given[0])
