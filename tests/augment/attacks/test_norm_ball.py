import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import optimize, stats
from torch import Tensor

from augment.attacks.norm_ball import project, sample, scale_gradient
from augment.parameter_settings import NORMS, STEPS, StepSettings
from renderer.errors import InputError
from renderer.light.ball import nearest_in_box

EPS = torch.finfo(torch.float32).eps
DTYPES = [torch.float32, torch.float64]
COORDINATES = st.floats(-100, 100).map(
    lambda value: round(value, 6)
)  # squares of smaller ones vanish in float32
RADII = st.one_of(st.just(0.0), st.floats(1e-3, 100))
DRAWS = 4000


def norm(offset: Tensor, name: str) -> Tensor:
    return offset.norm(dim=1) if name == "l2" else offset.abs().amax(1)


def dual_norm(offset: Tensor, name: str) -> Tensor:
    return offset.norm(dim=1) if name == "l2" else offset.abs().sum(1)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NORMS)
@given(pair=arrays(np.float64, (2, 4, 6), elements=COORDINATES), radius=RADII)
@settings(max_examples=60, deadline=None)
def test_the_projection_is_the_nearest_point_of_the_ball(name, dtype, pair, radius):
    """p is nearest to v exactly when it lies in the ball and (v - p)·(q - p) ≤ 0 for all of its points q; the largest
    of these products is (v - p)·(c - p) + radius × the dual norm of v - p. Points of the ball stay to the bit."""
    values, center = torch.from_numpy(pair).to(dtype)
    nearest = project(StepSettings(name, radius), values, center)
    assert nearest.dtype == dtype
    moved, inward = (values - nearest).double(), (center - nearest).double()
    rounding = 16 * torch.finfo(dtype).eps * 200  # of differences of numbers up to 200
    assert (norm(inward, name) <= radius + rounding).all()
    products = (moved * inward).sum(1) + radius * dual_norm(moved, name)
    assert (products <= rounding * (1 + dual_norm(moved, name))).all()
    inside = norm((values - center).double(), name) <= radius * (
        1 - 1e-6
    )  # clear of the rounding at the surface
    assert torch.equal(nearest[inside], values[inside])
    assert torch.equal(project(StepSettings(name, 0.0), values, center), center)
    assert torch.equal(project(StepSettings(name, None), values, center), values)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NORMS)
@given(
    pair=arrays(np.float64, (2, 3), elements=st.floats(-3, 3)),
    ends=arrays(np.float64, (2, 3), elements=st.one_of(st.floats(0, 2), st.just(np.inf))),
    radius=st.floats(0.01, 4),
)
@settings(max_examples=50, deadline=None)
def test_within_a_box_the_projection_is_the_nearest_point_of_what_it_shares_with_the_ball(
    name, dtype, pair, ends, radius
):
    """The ends are distances from the center, downwards and upwards. No descent by scipy gets nearer."""
    (values, center), (down, up) = (
        torch.from_numpy(pair).to(dtype),
        torch.from_numpy(ends).to(dtype),
    )
    low, high = center - down, center + up
    box = partial(nearest_in_box, low=low, high=high)
    nearest = project(StepSettings(name, radius), values[None], center[None], box)[0]
    rounding = 64 * torch.finfo(dtype).eps
    assert nearest.dtype == dtype and (low <= nearest).all() and (nearest <= high).all()
    offset = (nearest - center).double()[None]
    assert norm(offset, name) <= radius + rounding
    v, c = values.double().numpy(), center.double().numpy()
    bounds = [
        (max(a, d - radius), min(b, d + radius))
        for a, b, d in zip(low.double(), high.double(), c, strict=True)
    ]
    ball = {
        "type": "ineq",
        "fun": lambda x: radius**2 - ((x - c) ** 2).sum(),
        "jac": lambda x: 2 * (c - x),
    }
    found = optimize.minimize(
        lambda x: ((x - v) ** 2).sum(),
        c,
        jac=lambda x: 2 * (x - v),
        bounds=bounds,
        constraints=[ball] if name == "l2" else [],
        method="SLSQP",
        options={"ftol": 1e-12},
    )
    # SLSQP may leave the ball by a little.
    assert np.linalg.norm(nearest.double().numpy() - v) <= math.sqrt(found.fun) + 1e-5


@pytest.mark.parametrize("dimensions", [1, 3, 12])
@pytest.mark.parametrize("name", NORMS)
def test_draws_are_uniform_in_the_ball(name, dimensions):
    """(norm / radius)^D is uniform in [0, 1], and no direction is preferred: the means vanish and the covariances are
    those of the ball, r²/3 along each axis of a cube and r²/(D + 2) of a sphere, to five standard errors."""
    radius, center = 0.3, torch.linspace(-1, 1, dimensions, dtype=torch.float64).expand(DRAWS, -1)
    offset = (
        sample(StepSettings(name, radius), center, torch.Generator().manual_seed(1)) - center
    ) / radius
    assert norm(offset, name).max() <= 1 + 1e-6  # draws have float32's digits
    assert stats.kstest(norm(offset, name).numpy() ** dimensions, "uniform").pvalue > 0.01
    variance = 1 / 3 if name == "linf" else 1 / (dimensions + 2)
    assert offset.mean(0).abs().max() < 5 * math.sqrt(variance / DRAWS)
    products = offset.T @ offset / DRAWS
    # The variance of a product or a square of two coordinates is at most 2 × variance².
    assert (products - variance * torch.eye(dimensions)).abs().max() < 5 * variance * math.sqrt(
        2 / DRAWS
    )


@pytest.mark.parametrize(
    ("scale", "tolerance"), [(1.0, EPS), (1e30, EPS), (1e-30, EPS), (1e-40, 1e-4)]
)
def test_a_unit_step_has_unit_length_whatever_the_gradients_size(scale, tolerance):
    """1e-40 is subnormal in float32, with five digits left."""
    gradient = torch.randn(20, 50, generator=torch.Generator().manual_seed(0))
    expected = gradient.double() / gradient.double().norm(dim=1, keepdim=True)
    step = scale_gradient(StepSettings(step_size=1.0), gradient * scale)
    torch.testing.assert_close(step.double(), expected, rtol=0, atol=4 * tolerance)


@pytest.mark.parametrize("step", STEPS)
def test_every_example_steps_by_its_own_gradient_and_a_zero_one_stays(step):
    gradient = torch.tensor([[3.0, -4.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-3]])
    expected = {
        "unit": [[0.6, -0.8, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
        "raw": gradient.tolist(),
        "sign": [[1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
    }[step]
    steps = scale_gradient(StepSettings(step=step, step_size=1.0), gradient)
    torch.testing.assert_close(steps, torch.tensor(expected), rtol=0, atol=EPS)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StepSettings("l1", 1.0), "norm=l1: choose one of linf, l2"),
        (lambda: StepSettings("l2", -0.1), "radius=-0.1 must be at least 0"),
        (lambda: StepSettings(step="newton"), "step=newton: choose one of unit, raw, sign"),
        (lambda: StepSettings(step_size=0.0), "step_size=0.0 must be at least"),
        (lambda: StepSettings(step_size=math.nan), "step_size=nan"),
        (
            lambda: sample(StepSettings(), torch.zeros(1, 2), torch.Generator()),
            "radius=None has no uniform draw",
        ),
    ],
)
def test_balls_and_draws_that_make_no_sense_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
