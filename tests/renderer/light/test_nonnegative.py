import numpy as np
import pytest
import torch
import trimesh
from scipy import optimize
from torch import Tensor

from renderer.light.basis import Ball
from renderer.light.harmonics import basis, project
from renderer.light.nonnegative import TOLERANCE, project_nonnegative
from renderer.light.presets import ambient, load_light

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
    nearest = project_nonnegative(lights)
    torch.testing.assert_close(nearest, expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(("norm", "radius"), [("linf", None), ("linf", 0.1), ("l2", 0.3)])
def test_scipy_finds_no_nearer_light_that_is_nowhere_negative_on_a_grid(norm, radius):
    """A grid's program lacks the directions between, so that its light is nearer, by the grid's width squared."""
    target = random_lights(1, 0.1)[0, :, 0]
    center = project_nonnegative(load_light("grace").double())[:, 0]
    nearest = project_nonnegative(target[None, :, None], radius and Ball(center[None, :, None], radius, norm))[0]
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
    center = project_nonnegative(load_light("grace").double()).expand_as(target)
    nearest = project_nonnegative(target, Ball(center, radius, "l2"))
    distance = (nearest - center).flatten(1).norm(dim=1)
    assert (distance <= radius * (1 + 1e-12)).all() and (radius > 1 or (distance >= radius * (1 - 1e-6)).all())
    products = [(nearest * offset).sum((1, 2), keepdim=True) for offset in (target - nearest, nearest - center)]
    multiplier = (products[0] / products[1]).clamp(min=0)
    expected = project_nonnegative(center + (target - center) / (1 + multiplier))
    assert ((nearest - expected).flatten(1).norm(dim=1) <= 0.01 * distance).all()  # dips within the tolerance are left


@pytest.mark.parametrize(("norm", "radius"), [("linf", None), ("linf", 0.1), ("l2", 0.01), ("l2", 100.0)])
@pytest.mark.parametrize("amplitude", [0.02, 3.0])
def test_radiance_is_nowhere_negative(amplitude, norm, radius):
    target = random_lights(2, amplitude)
    center = project_nonnegative(load_light("grace").double()).expand_as(target)
    nearest = project_nonnegative(target, radius and Ball(center, radius, norm))
    radiance = torch.einsum("dk,nkc->ndc", DENSE, nearest)
    assert (radiance.amin(1) >= -TOLERANCE * radiance.abs().amax(1)).all()
    assert not radius or ((nearest - center).flatten(1).norm(ORDERS[norm], dim=1) <= radius * (1 + 1e-12)).all()


def test_light_that_is_nowhere_negative_stays_to_the_bit():
    lights = load_light("grace").repeat(2, 1, 1)
    lights[1, :, 1] = ambient(torch.ones(3))[:, 1]
    nearest = project_nonnegative(lights)
    assert nearest.dtype == torch.float32 and torch.equal(nearest[1, :, 1], lights[1, :, 1])
    assert not torch.equal(nearest[0], lights[0])
    assert torch.equal(project_nonnegative(nearest), nearest)


def test_dark_light_and_light_that_touches_zero_along_circles_stay():
    dark = torch.zeros(49, 3)
    assert torch.equal(project_nonnegative(dark), dark)
    torch.testing.assert_close(project_nonnegative(ambient(-torch.ones(3))), dark, rtol=0, atol=1e-6)
    squared = project(lambda directions: (directions[:, :1] ** 3 + directions[:, 1:2] ** 3) ** 2 * torch.ones(3), 6)
    torch.testing.assert_close(project_nonnegative(squared), squared, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-30, 1e5])
def test_the_projection_scales_with_the_light(scale):
    light = random_lights(1, 0.1)[0]
    nearest = project_nonnegative(light)
    torch.testing.assert_close(project_nonnegative(scale * light), scale * nearest, rtol=1e-4, atol=0)
