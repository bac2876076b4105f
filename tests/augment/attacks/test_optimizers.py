"""Projections reach the nearest point of a norm-ball, draws are uniform, steps have their size."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import optimize, stats
from torch import Tensor

from augment.attack_settings import NORMS, StepSettings
from augment.attacks.optimizers import NormBalls
from renderer.vectors import Ball, nearest_in_box

EPS = torch.finfo(torch.float32).eps
DTYPES = st.sampled_from([torch.float32, torch.float64])
# Squares of smaller coordinates vanish in float32.
COORDINATES = st.floats(-100, 100).map(lambda value: round(value, 6))
RADII = st.one_of(st.just(0.0), st.floats(1e-3, 100))
DRAW_COUNT = 4000


# Orders of the norms, and of their dual norms.
ORDERS = {"l2": (2, 2), "linf": (torch.inf, 1)}


def norms(offsets: Tensor, name: str, is_dual: bool = False) -> Tensor:
    return offsets.norm(ORDERS[name][is_dual], dim=1)


def project(name: str, radius: float | None, values: Tensor, center: Tensor) -> Tensor:
    balls = NormBalls(StepSettings(name, radius), center)
    return balls.project(values, torch.arange(len(values)))


PAIRS = arrays(np.float64, (2, 4, 6), elements=COORDINATES)  # values and centers


@pytest.mark.parametrize("name", NORMS)
@given(pair=PAIRS, radius=RADII, dtype=DTYPES)
def test_the_projection_is_the_nearest_point_of_the_ball(name, dtype, pair, radius):
    """The largest (v - p)·(q - p) in the ball is (v - p)·(c - p) + radius × the dual norm."""
    values, center = torch.from_numpy(pair).to(dtype)
    nearest = project(name, radius, values, center)
    assert nearest.dtype == dtype
    moved = (values - nearest).double()
    inward = (center - nearest).double()
    rounding = 16 * torch.finfo(dtype).eps * 200  # Differences are up to 200.
    assert (norms(inward, name) <= radius + rounding).all()
    dual = norms(moved, name, is_dual=True)
    largest_products = (moved * inward).sum(1) + radius * dual
    assert (largest_products <= rounding * (1 + dual)).all()
    # Points of the ball stay to the bit, but those at the surface may round.
    is_inside = norms((values - center).double(), name) <= radius * (1 - 1e-6)
    assert torch.equal(nearest[is_inside], values[is_inside])
    assert torch.equal(project(name, 0.0, values, center), center)
    assert torch.equal(project(name, None, values, center), values)


def nearest_distance(name: str, radius: float, *points: np.ndarray) -> float:
    point, center, low, high = points
    ball = {"type": "ineq", "fun": lambda x: radius**2 - ((x - center) ** 2).sum()}
    ball["jac"] = lambda x: 2 * (center - x)
    options = {"constraints": [ball] if name == "l2" else [], "method": "SLSQP"}
    options["bounds"] = optimize.Bounds(low.clip(center - radius), high.clip(max=center + radius))
    options |= {"jac": lambda x: 2 * (x - point), "options": {"ftol": 1e-12}}
    found = optimize.minimize(lambda x: ((x - point) ** 2).sum(), center, **options)
    return math.sqrt(found.fun)


SMALL_PAIRS = arrays(np.float64, (2, 3), elements=st.floats(-3, 3))
# Distances of the box's ends from the center, downwards and upwards.
REACHES = arrays(np.float64, (2, 3), elements=st.one_of(st.floats(0, 2), st.just(np.inf)))


@pytest.mark.parametrize("name", NORMS)
@given(pair=SMALL_PAIRS, reaches=REACHES, radius=st.floats(0.01, 4), dtype=DTYPES)
def test_in_a_box_scipy_gets_no_nearer_than_the_projection(name, dtype, pair, reaches, radius):
    values, center = torch.from_numpy(pair).to(dtype)
    down, up = torch.from_numpy(reaches).to(dtype)
    low = center - down
    high = center + up
    nearest = nearest_in_box(values[None], low, high, Ball(center[None], radius, name))[0]
    assert nearest.dtype == dtype
    assert (low <= nearest).all()
    assert (nearest <= high).all()
    rounding = 64 * torch.finfo(dtype).eps
    assert norms((nearest - center).double()[None], name) <= radius + rounding

    arrays_of = [each.double().numpy() for each in (values, center, low, high)]
    distance = np.linalg.norm((nearest - values).double().numpy())
    # SLSQP may leave the ball by a little.
    assert distance <= nearest_distance(name, radius, *arrays_of) + 1e-5


@pytest.mark.parametrize("dimensions", [1, 12])
@pytest.mark.parametrize("name", NORMS)
def test_draws_are_uniform_in_the_ball(name, dimensions):
    """(norm / radius)^D is uniform, and variances are radius² / 3 or radius² / (D + 2)."""
    radius = 0.3
    center = torch.linspace(-1, 1, dimensions, dtype=torch.float64).expand(DRAW_COUNT, -1)
    drawn = NormBalls(StepSettings(name, radius), center).draw(torch.Generator().manual_seed(1))
    offsets = (drawn - center) / radius
    lengths = norms(offsets, name)
    assert lengths.max() <= 1 + 1e-6  # Draws are in float32.
    assert stats.kstest(lengths.numpy() ** dimensions, "uniform").pvalue > 0.01
    variance = 1 / 3 if name == "linf" else 1 / (dimensions + 2)
    assert offsets.mean(0).abs().max() < 5 * math.sqrt(variance / DRAW_COUNT)
    covariance = offsets.T @ offsets / DRAW_COUNT
    expected = variance * torch.eye(dimensions)
    # The variance of a product of two coordinates is at most 2 × variance².
    error = 5 * variance * math.sqrt(2 / DRAW_COUNT)
    assert (covariance - expected).abs().max() < error


@pytest.mark.parametrize("name", NORMS)
def test_draws_along_some_axes_are_uniform_in_the_ball_of_these_axes(name):
    is_used = torch.tensor([True, False, True, False, False]).repeat(DRAW_COUNT, 1)
    is_used[0] = False
    center = torch.zeros(DRAW_COUNT, 5)
    draws = torch.Generator().manual_seed(1)
    drawn = NormBalls(StepSettings(name, 1.0), center, is_used).draw(draws)
    assert not drawn[~is_used].any()
    assert stats.kstest(norms(drawn[1:], name).numpy() ** 2, "uniform").pvalue > 0.01
    without_radius = NormBalls(StepSettings(name), center, is_used).sample(draws, center + is_used)
    assert not without_radius[~is_used].any()


@pytest.mark.parametrize(
    ("scale", "tolerance"),
    # 1e-40 is subnormal in float32, with five digits left.
    [(1e30, EPS), (1e-30, EPS), (1e-40, 1e-4)],
)
def test_a_unit_step_has_unit_length_whatever_the_gradients_size(scale, tolerance):
    gradient = torch.randn(20, 50, generator=torch.Generator().manual_seed(0))
    expected = gradient.double() / gradient.double().norm(dim=1, keepdim=True)
    step = NormBalls(StepSettings(step_size=1.0), gradient).scale_gradient(gradient * scale)
    torch.testing.assert_close(step.double(), expected, rtol=0, atol=4 * tolerance)
