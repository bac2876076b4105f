import math
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import trimesh
from scipy import optimize
from torch import Tensor

from renderer.light.ball import Ball
from renderer.light.harmonics import basis, lambertian_factors, project, quadrature
from renderer.light.nonnegative import TOLERANCE, nearest_nonnegative, project_nonnegative
from renderer.light.presets import ambient, load_light
from renderer.light.window import nonnegative_window

ORDERS = {"linf": torch.inf, "l2": 2}
DENSE = basis(torch.from_numpy(np.array(trimesh.creation.icosphere(subdivisions=5).vertices)), 6)  # 10,242 directions


def random_lights(count: int, amplitude: float) -> Tensor:
    draws = torch.Generator().manual_seed(round(100 * amplitude))
    offsets = torch.randn(count, 49, 3, generator=draws, dtype=torch.float64)
    return load_light("grace").double() + amplitude * offsets


def test_degree_1_is_projected_into_a_second_order_cone():
    """a + b·ω is nowhere negative where |b| ≤ a, whose projection has a closed form (Boyd and Vandenberghe, 8.1.1);
    Y₁ is √3 times as steep as Y₀ is high."""
    draws = torch.Generator().manual_seed(0)
    lights = torch.randn(10, 4, 3, generator=draws, dtype=torch.float64)
    slope = torch.tensor(3.0, dtype=torch.float64).sqrt()
    height, tilt = lights[:, 0], lights[:, 1:].norm(dim=1)
    on_cone = (height + slope * tilt / 3).clamp(min=0) * 3 / 4  # along (1, 1/√3), that of height a and tilt a / √3
    inside = slope * tilt <= height
    expected = lights.clone()
    expected[:, 0] = torch.where(inside, height, on_cone)
    expected[:, 1:] *= torch.where(inside, 1.0, on_cone / slope / tilt)[:, None]
    nearest = nearest_nonnegative(lights)
    torch.testing.assert_close(nearest, expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(("norm", "radius"), [("linf", None), ("linf", 0.1), ("l2", 0.3)])
def test_scipy_finds_no_nearer_light_that_is_nowhere_negative_on_a_grid(norm, radius):
    """A grid's program lacks the directions between, so that its light is nearer, by the grid's width squared."""
    target = random_lights(1, 0.1)[0, :, 0]
    center = nearest_nonnegative(load_light("grace").double())[:, 0]
    nearest = nearest_nonnegative(target[None, :, None], radius and Ball(center[None, :, None], radius, norm))[0]
    grid = basis(torch.from_numpy(np.array(trimesh.creation.icosphere(subdivisions=3).vertices)), 6).numpy()
    c = center.numpy()
    bright = {"type": "ineq", "fun": lambda x: grid @ x, "jac": lambda x: grid}
    ball = {"type": "ineq", "fun": lambda x: radius**2 - ((x - c) ** 2).sum(), "jac": lambda x: 2 * (c - x)}
    found = optimize.minimize(
        lambda x: ((x - target.numpy()) ** 2).sum(),
        nearest[:, 0].numpy(),
        jac=lambda x: 2 * (x - target.numpy()),
        bounds=[(value - radius, value + radius) for value in c] if radius and norm == "linf" else None,
        constraints=[bright, ball] if norm == "l2" else bright,
        method="SLSQP",
        options={"ftol": 1e-12},
    )
    assert found.success
    distance, bound = float((nearest[:, 0] - target).norm()), found.fun**0.5
    assert bound - 1e-5 <= distance <= 1.03 * bound


@pytest.mark.parametrize("radius", [0.3, 0.6, 3.0])
def test_within_a_sphere_the_result_satisfies_the_conditions_of_optimality(radius):
    """x is nearest to v in the sphere about c if it is nearest to c + (v - c) / (1 + λ) without it; what is added to
    that is orthogonal to x, so that x·(v - x) = λ x·(x - c)."""
    target = random_lights(2, 0.1)
    center = nearest_nonnegative(load_light("grace").double()).expand_as(target)
    nearest = nearest_nonnegative(target, Ball(center, radius, "l2"))
    distance = (nearest - center).flatten(1).norm(dim=1)
    assert (distance <= radius * (1 + 1e-12)).all() and (radius > 1 or (distance >= radius * (1 - 1e-6)).all())
    products = [(nearest * offset).sum((1, 2), keepdim=True) for offset in (target - nearest, nearest - center)]
    multiplier = (products[0] / products[1]).clamp(min=0)
    expected = nearest_nonnegative(center + (target - center) / (1 + multiplier))
    assert ((nearest - expected).flatten(1).norm(dim=1) <= 0.01 * distance).all()  # dips within the tolerance are left


@pytest.mark.parametrize(("norm", "radius"), [("linf", None), ("linf", 0.1), ("l2", 0.01), ("l2", 100.0)])
@pytest.mark.parametrize("amplitude", [0.02, 3.0])
def test_radiance_is_nowhere_negative(amplitude, norm, radius):
    target = random_lights(2, amplitude)
    center = nearest_nonnegative(load_light("grace").double()).expand_as(target)
    nearest = nearest_nonnegative(target, radius and Ball(center, radius, norm))
    radiance = torch.einsum("dk,nkc->ndc", DENSE, nearest)
    assert (radiance.amin(1) >= -TOLERANCE * radiance.abs().amax(1)).all()
    assert not radius or ((nearest - center).flatten(1).norm(ORDERS[norm], dim=1) <= radius * (1 + 1e-12)).all()


BOTH = pytest.mark.parametrize("physical", [nearest_nonnegative, project_nonnegative])


@BOTH
def test_light_that_is_nowhere_negative_stays_to_the_bit(physical):
    lights = load_light("grace").repeat(2, 1, 1)
    lights[1, :, 1] = ambient(torch.ones(3))[:, 1]
    changed = physical(lights)
    assert changed.dtype == torch.float32 and torch.equal(changed[1, :, 1], lights[1, :, 1])
    assert not torch.equal(changed[0], lights[0])
    assert torch.equal(physical(changed), changed)


@BOTH
def test_dark_light_and_light_that_touches_zero_along_circles_stay(physical):
    dark = torch.zeros(49, 3)
    assert torch.equal(physical(dark), dark)
    torch.testing.assert_close(physical(ambient(-torch.ones(3))), dark, rtol=0, atol=1e-6)
    squared = project(lambda directions: (directions[:, :1] ** 3 + directions[:, 1:2] ** 3) ** 2 * torch.ones(3), 6)
    torch.testing.assert_close(physical(squared), squared, rtol=0, atol=1e-12)


@BOTH
@pytest.mark.parametrize("scale", [1e-30, 1e5])
def test_the_projection_scales_with_the_light(scale, physical):
    light = random_lights(1, 0.1)[0]
    changed = physical(light)
    torch.testing.assert_close(physical(scale * light), scale * changed, rtol=1e-4, atol=1e-5 * scale)


HDRI = Path(__file__).parents[4] / "shared/data/hdri"
NORMALS, SHARES = quadrature(20)


def concentrated(name: str, degree: int) -> Tensor:
    """Coefficients (K, 3) of generated light: a sun, which is the worst; two suns in a dim sky; three small lamps of
    different colors in the dark, one of which no channel but one sees."""
    draws = torch.Generator().manual_seed(4)
    directions = F.normalize(torch.randn(3, 3, generator=draws, dtype=torch.float64), dim=1)
    powers = {
        "sun": torch.tensor([[1.0, 1, 1], [0, 0, 0], [0, 0, 0]]),
        "suns": torch.tensor([[1.0, 0.8, 0.6], [0.2, 0.3, 0.5], [0, 0, 0]]),
        "lamps": torch.tensor([[1.0, 0, 0], [0.5, 1, 0], [0.3, 0.1, 0]]),
    }
    light = basis(directions, degree).T @ powers[name].double()
    light[0] += (name == "suns") * 0.02
    return light


def irradiance(light: Tensor, points: int = 160) -> Tensor:
    """(N, C) at NORMALS, by quadrature of the clamped cosine."""
    directions, weights = quadrature(points)
    radiance = basis(directions, math.isqrt(len(light)) - 1) @ light.double()
    return (NORMALS @ directions.T).clamp(min=0) @ (weights[:, None] * radiance)


def require_physical(given: Tensor, degree: int) -> None:
    """The three properties of `project_nonnegative`, checked by quadrature, beside those of the best window."""
    physical, windowed = project_nonnegative(given), nonnegative_window(degree)[:, None] * given.double()
    torch.testing.assert_close(physical[0], given[0].clamp(min=0), rtol=1e-6, atol=0)
    radiance = basis(quadrature(4 * degree + 7)[0], degree) @ physical.double()
    assert (radiance.amin(0) >= -TOLERANCE * radiance.amax(0)).all()
    expected = irradiance(given)
    error, allowed = ((irradiance(light) - expected).square() for light in (physical, windowed))
    rms, largest = ((SHARES @ part).sqrt() for part in (error, allowed))
    assert (rms <= 1.001 * largest + 1e-6 * expected.abs().amax(0)).all()


@pytest.mark.parametrize("name", ["sun", "suns", "lamps"])
@pytest.mark.parametrize(
    "degree", [0, 1, 2, 3, 6, *(pytest.param(degree, marks=pytest.mark.slow) for degree in (4, 9, 12, 15, 19, 20))]
)
def test_physical_light_keeps_the_mean_and_no_window_has_a_smaller_irradiance_error(name, degree):
    require_physical(concentrated(name, degree), degree)


@pytest.mark.realdata
@pytest.mark.skipif(not HDRI.is_dir(), reason="without ../shared/data")
@pytest.mark.parametrize("name", ["city", "forest", "night", "studio"])
@pytest.mark.parametrize("degree", [2, 6, *(pytest.param(degree, marks=pytest.mark.slow) for degree in (12, 19, 20))])
def test_a_real_map_made_physical_keeps_its_mean_and_its_irradiance(name, degree):
    require_physical(load_light(str(HDRI / f"{name}.npy"), degree), degree)


@pytest.mark.parametrize("degree", [2, 6])
def test_scipy_finds_no_light_of_the_same_mean_whose_irradiance_is_more_alike(degree):
    """By sequential quadratic programming with the constraints of a grid, which lacks the directions between."""
    given = random_lights(1, 0.1)[0, : (degree + 1) ** 2, 0]
    physical = project_nonnegative(given[:, None])[:, 0]
    factors = lambertian_factors(degree).numpy()
    grid = DENSE[:, : len(given)].numpy()[:642]
    found = optimize.minimize(
        lambda x: (factors**2 * (x - given.numpy()) ** 2).sum(),
        physical.numpy(),
        jac=lambda x: 2 * factors**2 * (x - given.numpy()),
        constraints=[
            {"type": "ineq", "fun": lambda x: grid @ x, "jac": lambda x: grid},
            {"type": "eq", "fun": lambda x: x[:1] - given[0].numpy(), "jac": lambda x: np.eye(len(x))[:1]},
        ],
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 200},
    )
    error = float((lambertian_factors(degree) * (physical - given)).norm())
    assert error <= 1.03 * found.fun**0.5 + 1e-3 * float(given[0])


def test_light_without_a_positive_mean_becomes_dark():
    light = torch.randn(49, 3, generator=torch.Generator().manual_seed(0))
    light[0] = torch.tensor([-1.0, 0.0, 5.0])
    assert torch.equal(project_nonnegative(light)[:, :2], torch.zeros(49, 2))
