"""Optimizers find known minima of known problems, and each example is attacked by itself."""

import dataclasses
import math
from contextlib import nullcontext
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from oracles import draw
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from augment.attack_settings import (
    NORMS,
    OPTIMIZERS,
    STEPS,
    AttackSettings,
    EOTSettings,
    StepSettings,
)
from augment.attacks import loop
from augment.attacks.loop import Minimum, minimize
from augment.attacks.objective import Objective
from augment.attacks.optimizers import NormBalls
from augment.tasks.classification import ClassCriterion
from tests.pretend_gpu import is_read

EPS = torch.finfo(torch.float64).eps
IMAGE_SHAPE = (3, 2, 2)
VALUE_COUNT = 5
FIELDS = [field.name for field in dataclasses.fields(Minimum)]


class Linear(nn.Module):
    def __init__(self, bias: float = 0.0):
        super().__init__()
        self.weight = nn.Parameter(WEIGHT)
        self.bias = torch.tensor([bias, 0.0], dtype=torch.float64)
        self.image_count = 0

    def forward(self, images: Tensor) -> Tensor:
        self.image_count += len(images)
        return images.flatten(1) @ self.weight.T + self.bias


WEIGHT = draw(2, 12, seed=0)
CAMERAS = draw(2, VALUE_COUNT, 12, seed=1) / 4
# Gradient of the lead of the first class with respect to the values, in each view.
SLOPES = CAMERAS @ (WEIGHT[0] - WEIGHT[1])


@dataclass
class LinearScene:
    """Images that are linear in the values; example i is 1 + i / 10 times as bright."""

    start: Tensor
    steps: StepSettings = field(default_factory=StepSettings)
    views: int = 1
    center: Tensor | None = None  # of the balls, shape (E, D); None for the start
    group_size: int = 1000

    def __post_init__(self):
        if self.center is None:
            self.center = self.start
        balls = NormBalls(self.steps, self.center)
        self.project = balls.project
        self.scale_gradient = balls.scale_gradient
        self.render_counts = torch.zeros(len(self.start), dtype=torch.int64)

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        self.render_counts.index_add_(0, examples, torch.ones_like(examples))
        images = torch.einsum("ad,vdp->avp", values, CAMERAS[: self.views])
        brightness = 1 + examples.double() / 10
        return (images * brightness[:, None, None]).unflatten(2, IMAGE_SHAPE)

    def search_scale(self, examples: Tensor) -> Tensor:
        return torch.full_like(self.center[examples], self.steps.radius / 2)


def settings_of(max_steps: int = 30, margin: float = 0.0, **others) -> AttackSettings:
    return AttackSettings(max_steps=max_steps, margin=margin, quantized=False, **others)


def descend(model: nn.Module, problem, criterion: ClassCriterion, settings, restarts=()) -> Minimum:
    return minimize(problem, Objective(model, criterion, settings), restarts=restarts)


def attack(model: nn.Module, problem, labels: Tensor, steps: int = 30, **settings) -> Minimum:
    return descend(model, problem, ClassCriterion(labels[:, None]), settings_of(steps, **settings))


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_the_lowest_point_of_a_ball_is_found_from_anywhere_in_it(optimizer, norm):
    """The first class leads by 50, so that no example succeeds."""
    step = "unit" if norm == "l2" else "sign"
    ball = StepSettings(norm, 0.4, step, step_size=0.3)
    center = draw(3, VALUE_COUNT, seed=2)
    start = NormBalls(ball, center).draw(torch.Generator().manual_seed(0))
    # With a target, the cost is the sum of the leads of all views, which is linear in the values.
    views = 2
    zeros = torch.zeros(3, views, dtype=torch.int64)
    criterion = ClassCriterion(zeros, zeros + 1)
    queries = None if optimizer == "gradient" else 300 * views
    settings = settings_of(120, optimizer=optimizer, max_queries=queries)
    problem = LinearScene(start, ball, views, center)
    result = descend(Linear(bias=50.0), problem, criterion, settings)
    slope = SLOPES[:views].sum(0)
    direction = slope / slope.norm() if norm == "l2" else slope.sign()
    depth = (center - result.values) @ slope
    # Random changes of all values at once seldom move the last one alone to its face of the cube.
    share = 0.9 if (optimizer, norm) == ("random_search", "linf") else 0.999
    assert (depth > share * 0.4 * direction @ slope).all()
    if optimizer == "gradient":
        # Each step turns the values towards the end by a factor of at least 0.4 / 0.7.
        expected = (center - 0.4 * direction).expand(3, -1)
        torch.testing.assert_close(result.values, expected, rtol=0, atol=64 * EPS)


STEP_SIZES = {"unit": 0.3, "sign": 0.1, "raw": 0.4}
EXAMPLE_COUNT = 16
MAX_STEPS = 6


@pytest.mark.parametrize("rule", STEP_SIZES)
def test_descent_on_a_linear_classifier_follows_its_closed_form(rule):
    """The cost is log σ(m) with the lead m = slope · values, and its gradient σ(−m) · slope."""
    start = draw(EXAMPLE_COUNT, VALUE_COUNT, seed=2)
    labels = torch.arange(EXAMPLE_COUNT) % 2
    problem = LinearScene(start, StepSettings(step=rule, step_size=STEP_SIZES[rule]))
    model = Linear()
    result = attack(model, problem, labels, steps=MAX_STEPS, batch_size=5)
    # The lead of class 1 is the negative one of class 0.
    signs = (1 - 2 * labels) * (1 + torch.arange(EXAMPLE_COUNT).double() / 10)
    slopes = signs[:, None] * SLOPES[0]
    values = start.clone()
    leads = (slopes * values).sum(1)
    before = leads
    steps = torch.zeros_like(labels)
    for _ in range(MAX_STEPS):
        moves = {"unit": slopes / slopes.norm(dim=1, keepdim=True), "sign": slopes.sign()}
        moves["raw"] = slopes * (-leads).sigmoid()[:, None]
        values = torch.where((leads > 0)[:, None], values - STEP_SIZES[rule] * moves[rule], values)
        steps += leads > 0
        leads = (slopes * values).sum(1)
    assert {0, MAX_STEPS} < set(steps.tolist())
    assert torch.equal(result.steps, steps)
    # Each of six steps rounds a few times, in sums of 12 terms.
    torch.testing.assert_close(result.values, values, rtol=0, atol=64 * EPS)
    for cost, lead in ((result.cost_before, before), (result.cost, leads)):
        torch.testing.assert_close(cost, nn.functional.logsigmoid(lead), rtol=128 * EPS, atol=0)
    assert torch.equal(result.success_before, before < 0)
    assert torch.equal(result.success, leads < 0)
    assert torch.equal(result.predicted[:, 0] != labels, result.success)
    assert not result.zero_gradient.any()
    # Successful examples are not rendered again.
    assert torch.equal(problem.render_counts, result.steps + 1)
    assert model.image_count == int(problem.render_counts.sum())
    images = problem.render(result.values, torch.arange(EXAMPLE_COUNT))
    torch.testing.assert_close(result.images, images, rtol=0, atol=16 * EPS)


class OfValue(nn.Module):
    def __init__(self, logits):
        super().__init__()
        self.logits = logits

    def forward(self, images: Tensor) -> Tensor:
        return self.logits(images.flatten(1)[:, 0])


def two_classes(lead) -> OfValue:
    return OfValue(lambda value: torch.stack([lead(value), torch.zeros_like(value)], dim=1))


def detour(value: Tensor) -> Tensor:
    """Return logits of probabilities 0.4, 0.3, 0.3 at 1, where the first grows with the value.

    Below zero, the probabilities are 0.45, 0.55, 0.
    """
    above = torch.tensor([0.4, 0.3, 0.3]).double().log() + (value[:, None] - 1) * torch.eye(3)[0]
    below = torch.tensor([0.45, 0.55, 1e-30]).double().log()
    return torch.where(value[:, None] > 0, above, below)


def ridge(value: Tensor) -> Tensor:
    """Return the logits of `detour`, with probabilities 0.42, 0.41, 0.17 between 0 and 1/2."""
    is_on_ridge = (value > 0) & (value < 0.5)
    on_ridge = torch.tensor([0.42, 0.41, 0.17]).double().log()
    return torch.where(is_on_ridge[:, None], on_ridge, detour(value))


@dataclass
class Axis:
    start: Tensor
    group_size: int = 1000

    def __post_init__(self):
        self.rendered = []

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        self.rendered += values.flatten().tolist()
        return values[:, :, None, None, None]

    def scale_gradient(self, gradient: Tensor) -> Tensor:
        return 1.5 * gradient.sign()

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        return values


# Values after each step. From 1, a step leads to -1/2. From there 1.5 is too far, but 3/4 is not.
# The length is halved at every other step.
FROM_1 = [1, -1 / 2, -1 / 2, 1 / 4, 1 / 4, -1 / 8, -1 / 8, 1 / 16]
# The first three step lengths are too long. The fourth, 3/16, lowers the cost.
FROM_EIGHTH = [1 / 8, 1 / 8, 1 / 8, 1 / 8, -1 / 16, -1 / 16, 1 / 32, 1 / 32]
# The first step leads to the same cost, which is no fall, and the second to the bottom.
FROM_THREE_QUARTERS = [3 / 4, 3 / 4, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("steps", range(2, 8))
def test_a_step_that_does_not_lower_the_cost_is_taken_back_and_tried_at_half_its_length(steps):
    """Every value is exact."""
    start = torch.tensor([[1.0], [0.125], [0.75]], dtype=torch.float64)
    zeros = torch.zeros(3, 1, dtype=torch.int64)
    criterion = ClassCriterion(zeros, zeros + 1)
    hill = two_classes(lambda value: 1 + value**2)
    result = descend(hill, Axis(start), criterion, settings_of(steps, backtracking=True))
    values = result.values.flatten()
    assert values.tolist() == [FROM_1[steps], FROM_EIGHTH[steps], FROM_THREE_QUARTERS[steps]]
    assert torch.equal(result.images.flatten(), values)
    # The cost is a difference of two cross entropies, which round.
    torch.testing.assert_close(result.cost, 1 + values.square(), rtol=0, atol=8 * EPS)
    assert result.steps.tolist() == [steps] * 3
    assert result.predicted.flatten().tolist() == [0] * 3


def attack_from_one(model: nn.Module, **settings) -> tuple[Minimum, list[float]]:
    axis = Axis(torch.ones(1, 1, dtype=torch.float64))
    result = attack(model, axis, torch.zeros(1, dtype=torch.int64), **settings)
    assert result.success.tolist() == [True]
    return result, axis.rendered


def test_a_step_that_succeeds_is_kept_even_if_its_cost_is_higher():
    """With three classes, the true one may gain while another overtakes it."""
    result, _ = attack_from_one(OfValue(detour), steps=5, backtracking=True)
    assert result.steps.tolist() == [1]
    assert result.values.tolist() == [[-0.5]]
    assert float(result.cost_before) == pytest.approx(math.log(0.4))
    assert float(result.cost) == pytest.approx(math.log(0.45))


def test_after_a_success_of_higher_cost_steps_are_compared_with_where_they_start_from():
    """The step to -1/2 succeeds, short of the margin. The next one, to 1/4, is no fall from 0.4."""
    result, rendered = attack_from_one(OfValue(ridge), steps=3, backtracking=True, margin=1.0)
    assert rendered == [1, -0.5, 0.25, 0.625]
    assert result.values.tolist() == [[0.625]]  # Its cost is the lowest.


def test_of_several_successes_the_one_of_the_lowest_cost_is_kept():
    """The steps lead from 1 to -1/2 and back. The margin is out of reach."""
    hill = two_classes(lambda value: (value - 0.1) ** 2 - 2)  # It is lowest at 0.1.
    result, rendered = attack_from_one(hill, steps=2, backtracking=False, margin=100.0)
    assert rendered == [1, -0.5, 1]
    assert result.values.tolist() == [[-0.5]]


def test_points_of_cma_es_outside_of_the_ball_are_told_with_a_penalty(monkeypatch):
    """It is the interquartile range of the costs times the mean squared distance from the ball."""
    import cma

    told = []
    monkeypatch.setattr(
        cma.CMAEvolutionStrategy, "tell", lambda self, points, costs: told.append((points, costs))
    )
    radius = 0.5
    problem = LinearScene(torch.zeros(1, VALUE_COUNT).double(), StepSettings("linf", radius))
    attack(Linear(), problem, torch.zeros(1).long(), 2, optimizer="cma_es", max_queries=20)
    points, costs = map(np.array, told[0])
    values = torch.from_numpy(points * radius / 2).clamp(-radius, radius)
    images = problem.render(values, torch.zeros(len(values)).long())[:, 0]
    expected = Linear()(images).log_softmax(1)[:, 0].detach().numpy()
    outside = np.maximum(np.abs(points) - 2, 0)  # in units of half the radius
    assert outside.any()
    penalties = np.subtract(*np.quantile(expected, [0.75, 0.25])) * (outside**2).mean(1)
    np.testing.assert_allclose(costs, expected + penalties, atol=1e-6)


@pytest.mark.parametrize("optimizer", ["random_search", "cma_es"])
def test_each_start_of_a_search_draws_changes_of_its_own(optimizer):
    problem = LinearScene(torch.zeros(1, VALUE_COUNT).double(), StepSettings("linf", 0.5))
    drawn, project = [], problem.project
    problem.project = lambda values, examples: drawn.append(values) or project(values, examples)
    zeros = torch.zeros(1, 1, dtype=torch.int64)
    settings = settings_of(optimizer=optimizer, max_queries=30)
    descend(Linear(bias=50.0), problem, ClassCriterion(zeros), settings, [problem.start] * 2)
    assert len({tuple(values[0].tolist()) for values in drawn}) == len(drawn) > 2


def test_of_several_candidates_the_success_of_the_lowest_cost_is_taken():
    """The first costs least and is none, and the last is one that costs more than the second."""
    costs = torch.tensor([-3.0, -1.0, 1.0])
    is_success = torch.tensor([False, True, True])

    class Scored(Objective):
        def select(self, rows):
            return self

        def moved(self, problem, values, examples):
            return self

        def score(self, images, needs_gradient):
            score, _ = super().score(images, False)
            return dataclasses.replace(score, cost=costs.double(), is_success=is_success), None

    problem = LinearScene(torch.zeros(1, VALUE_COUNT, dtype=torch.float64))
    criterion = ClassCriterion(torch.zeros(3, 1, dtype=torch.int64))
    candidates = draw(1, 3, VALUE_COUNT, seed=4)
    objective = Scored(Linear(), criterion, settings_of())
    result = loop.evaluate(problem, objective, candidates, torch.zeros(1, dtype=torch.int64), False)
    assert torch.equal(result.values, candidates[:, 1])
    assert result.costs.tolist() == [costs.tolist()]


class ClampedScene(LinearScene):
    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return values.view(-1, 1, *IMAGE_SHAPE).clamp(0, 1)


@pytest.mark.parametrize("step", STEPS)
def test_a_zero_gradient_leaves_the_values_and_is_reported(step):
    gray = torch.full((12,), 0.5)
    overexposed = torch.full((12,), 3.0)
    start = torch.stack([gray, overexposed]).double()
    problem = ClampedScene(start, StepSettings(step=step, step_size=0.01))
    labels = torch.zeros(2, dtype=torch.int64)
    result = attack(Linear(bias=20.0), problem, labels, steps=4)
    assert result.zero_gradient.tolist() == [False, True]
    assert result.steps.tolist() == [4, 4]
    assert not result.success.any()
    assert (result.values[0] != start[0]).all()
    assert torch.equal(result.values[1], start[1])


def small_network() -> nn.Sequential:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        layers = [nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.SiLU(), nn.Dropout(0.5)]
        return nn.Sequential(*layers, nn.Flatten(), nn.Linear(32, 4)).double()


NINE_STARTS = 3 * draw(9, VALUE_COUNT, seed=3)


def attack_nine(
    views: int, examples: Tensor | None = None, seed: int = 0, norm: str = "l2", **settings
) -> Minimum:
    """Attack nine examples, of which some succeed at once, some on the way and some never."""
    problem = LinearScene(NINE_STARTS, StepSettings(norm, 3.0, step_size=0.3), views=views)
    chosen = torch.arange(9) if examples is None else examples
    criterion = ClassCriterion((chosen % 4)[:, None].expand(-1, views))
    options = {"max_steps": 8} | settings
    objective = Objective(small_network(), criterion, settings_of(**options), seed)
    return minimize(problem, objective, examples=examples)


@pytest.mark.parametrize(
    ("batch_size", "views", "options"),
    [
        (1, 2, {}),
        (4, 1, {}),
        (100, 2, {}),
        (1, 2, {"eot": EOTSettings(draws=2)}),
        (7, 2, {"eot": EOTSettings(draws=2), "optimizer": "cma_es", "max_queries": 150}),
    ],
)
def test_the_batch_size_does_not_matter(batch_size, views, options):
    """A batch may end between two views of an example."""
    whole = attack_nine(views, batch_size=9 * views, **options)
    batched = attack_nine(views, batch_size=batch_size, **options)
    assert len(whole.steps.unique()) > 2
    for name in FIELDS:
        # Sums in another order differ by rounding.
        found = getattr(batched, name)
        torch.testing.assert_close(found, getattr(whole, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "options",
    [
        {"backtracking": True},
        {"optimizer": "random_search", "max_queries": 30},
        {"optimizer": "cma_es", "max_queries": 30},
    ],
    ids=["gradient", "random_search", "cma_es"],
)
def test_every_example_is_attacked_as_if_alone_and_alike_with_the_same_seed(options):
    numpy_state = np.random.get_state()[1].copy()
    torch_state = torch.random.get_rng_state()
    together = attack_nine(2, **options)
    assert (np.random.get_state()[1] == numpy_state).all()
    assert torch.equal(torch.random.get_rng_state(), torch_state)
    for row in range(0, 9, 2):
        alone = attack_nine(2, torch.tensor([row]), **options)
        for name in FIELDS:
            found = getattr(alone, name)[0]
            torch.testing.assert_close(found, getattr(together, name)[row], rtol=0, atol=1e-12)
    other = attack_nine(2, seed=1, **options)
    assert torch.equal(other.values, together.values) == ("optimizer" not in options)


@pytest.mark.parametrize(
    "options", [{}, {"backtracking": True}, {"eot": EOTSettings(draws=2, jitter=0.3)}], ids=str
)
def test_finished_examples_that_stay_in_the_batch_change_no_result(options, monkeypatch):
    at_once = attack_nine(2, **options)
    monkeypatch.setattr(loop, "drop_period", lambda device: 4)
    later = attack_nine(2, **options)
    assert len(at_once.steps[at_once.success].unique()) > 2
    for name in FIELDS:
        found = getattr(later, name)
        torch.testing.assert_close(found, getattr(at_once, name), rtol=0, atol=1e-12)


class Waits(TorchDispatchMode):
    """Counts the operations for whose results a CPU would wait for a GPU."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        self.count += is_read(function, arguments)
        return function(*arguments, **(options or {}))


@pytest.mark.parametrize("period", [1, 4])
def test_only_steps_that_drop_examples_wait_for_a_gpu(period, monkeypatch):
    """Both attacks drop examples after steps 0 and 4, and after the last."""
    monkeypatch.setattr(loop, "drop_period", lambda device: period)
    counts = []
    for steps in (5, 7):
        with Waits() as waits:
            attack_nine(2, norm="linf", max_steps=steps, margin=1e4)
        counts.append(waits.count)
    assert (counts[0] == counts[1]) == (period == 4)


@pytest.mark.parametrize("backtracking", [False, True])
def test_a_margin_changes_no_success_and_lets_successful_examples_continue(backtracking):
    without = attack_nine(2, backtracking=backtracking)
    with_margin = attack_nine(2, backtracking=backtracking, margin=0.5)
    assert torch.equal(with_margin.success, without.success)
    assert (with_margin.steps >= without.steps).all()
    assert (with_margin.steps > without.steps)[without.success].any()


def test_restarts_go_on_with_the_examples_without_success_and_keep_the_first_success():
    """Of 40 examples, some need one or two restarts and some never succeed."""
    center = draw(40, VALUE_COUNT, seed=3)
    steps = StepSettings("linf", 0.5, "sign", 0.1)
    criterion = ClassCriterion(torch.arange(40)[:, None] % 2)
    settings = settings_of(2, sensor_noise=0.0)
    balls = NormBalls(steps, center)
    starts = [balls.draw(torch.Generator().manual_seed(seed)) for seed in (4, 5)]
    problem = LinearScene(center, steps)
    result = descend(Linear(), problem, criterion, settings, restarts=starts)
    single = []
    for start in (center, *starts):
        alone = LinearScene(start, steps, center=center)
        single.append(descend(Linear(), alone, criterion, settings))
    # The ball limits some values.
    radius = torch.tensor(0.5).double()
    assert torch.isclose((single[1].values - center).abs(), radius).any()
    successes = torch.stack([each.success for each in single])
    # The first single descent that succeeds, or 0.
    first_success = successes.long().argmax(0).tolist()
    assert set(first_success) == {0, 1, 2}
    assert not result.success.all()
    assert torch.equal(result.success, successes.any(0))
    for row, chosen in enumerate(first_success):
        for name in ("values", "images", "cost", "predicted"):
            found = getattr(result, name)[row]
            expected = getattr(single[chosen], name)[row]
            torch.testing.assert_close(found, expected, rtol=0, atol=64 * EPS)
        last = chosen if result.success[row] else 2
        step_count = sum(int(each.steps[row]) for each in single[: last + 1])
        assert int(result.steps[row]) == step_count
        assert int(problem.render_counts[row]) == step_count + last + 1
    for name in ("cost_before", "success_before", "zero_gradient"):
        assert torch.equal(getattr(result, name), getattr(single[0], name))


class Watched(nn.Module):
    """A network that draws random numbers and raises an error at one of its calls."""

    def __init__(self, fails_at: int | None):
        super().__init__()
        self.network = small_network()
        self.network[0].bias.requires_grad_(False)
        self.calls = 0
        self.fails_at = fails_at

    def forward(self, images: Tensor) -> Tensor:
        assert not any(module.training for module in self.modules())
        assert not any(parameter.requires_grad for parameter in self.parameters())
        torch.rand(7)
        self.calls += 1
        if self.calls == self.fails_at:
            raise RuntimeError("shapes differ")
        return self.network(images)

    def state(self) -> dict:
        return {
            "modes": [module.training for module in self.modules()],
            "requires_grad": [parameter.requires_grad for parameter in self.parameters()],
            "gradients": [parameter.grad for parameter in self.parameters()],
            "weights": {name: value.clone() for name, value in self.state_dict().items()},
            "random": torch.random.get_rng_state(),
            "grad mode": torch.is_grad_enabled(),
        }


@pytest.mark.parametrize(("fails_at", "grad_mode"), [(None, True), (1, False), (4, True)])
def test_the_model_and_the_random_state_are_left_as_they_were(fails_at, grad_mode):
    model = Watched(fails_at).train()
    model.network[1].eval()
    problem = LinearScene(draw(4, VALUE_COUNT, seed=3))
    images = problem.render(problem.start, torch.arange(4))[:, 0]
    labels = small_network().eval()(images).argmax(1)
    expected_error = nullcontext() if fails_at is None else pytest.raises(RuntimeError)
    with torch.set_grad_enabled(grad_mode):
        before = model.state()
        with expected_error:
            attack(model, problem, labels, steps=3, batch_size=2)
        torch.testing.assert_close(model.state(), before, rtol=0, atol=0)
