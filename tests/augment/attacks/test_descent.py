import math
from dataclasses import dataclass, field, fields

import pytest
import torch
from torch import Tensor, nn

from augment.attack_settings import AttackSettings
from augment.attacks.descent import DescentResult, Goal, descend
from augment.attacks.norm_ball import project, sample, scale_gradient
from augment.parameter_settings import STEPS, StepSettings

EPS = torch.finfo(torch.float64).eps
PIXELS, DIMENSIONS = (3, 2, 2), 5
FIELDS = [each.name for each in fields(DescentResult)]


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class Linear(nn.Module):
    """Two classes, logits linear in the image. `seen` counts the images that it was given."""

    def __init__(self, weight: Tensor, bias: float = 0.0):
        super().__init__()
        self.weight = nn.Parameter(weight)
        self.bias = torch.tensor([bias, 0.0], dtype=weight.dtype)
        self.seen = 0

    def forward(self, images: Tensor) -> Tensor:
        self.seen += len(images)
        return images.flatten(1) @ self.weight.T + self.bias


WEIGHT, CAMERAS = random(2, 12, seed=0), random(2, DIMENSIONS, 12, seed=1) / 4


@dataclass
class LinearScene:
    """Images that are linear in the values: each view by its camera, each example in another tint."""

    start: Tensor
    rule: str = "unit"
    size: float = 0.05
    ball: StepSettings = field(default_factory=StepSettings)
    views: int = 1
    center: Tensor | None = None  # of the balls, where it is not the start
    at_once: int = 1000

    def __post_init__(self):
        self.center = self.start if self.center is None else self.center
        self.rendered = torch.zeros(len(self.start), dtype=torch.int64)

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        self.rendered.index_add_(0, examples, torch.ones_like(examples))
        images = torch.einsum("ad,vdp->avp", values, CAMERAS[: self.views])
        return (images * (1 + examples.double() / 10)[:, None, None]).unflatten(2, PIXELS)

    def take_step(self, values: Tensor, gradient: Tensor, examples: Tensor, length: Tensor) -> Tensor:
        step = scale_gradient(StepSettings(step=self.rule, step_size=self.size), gradient)
        return project(self.ball, values - length * step, self.center[examples])


def settings_of(max_steps: int = 30, **others) -> AttackSettings:
    """Until the classifier errs, unless a margin is given."""
    return AttackSettings(max_steps=max_steps, **{"margin": 0.0, **others})


def attack(model: nn.Module, problem, classes: Tensor, steps: int = 30, **settings) -> DescentResult:
    """Without a target."""
    goal = Goal(classes if classes.ndim == 2 else classes[:, None])
    return descend(model, problem, goal, settings_of(steps, **settings))


def closed_form(step: str, size: float, max_steps: int, slope: Tensor, margin: float) -> tuple[Tensor, int, float]:
    """(displacement, steps, margin) after descent on log σ(margin), with margin = slope · values.

    Its gradient is σ(-margin) · slope: the direction never changes.
    """
    displacement, steps = torch.zeros(DIMENSIONS, dtype=torch.float64), 0
    while margin > 0 and steps < max_steps:
        move = {"unit": slope / slope.norm(), "sign": slope.sign(), "raw": slope / (1 + math.exp(margin))}[step]
        displacement -= size * move
        margin -= size * float(slope @ move)
        steps += 1
    return displacement, steps, margin


@pytest.mark.parametrize(("step", "size"), [("unit", 0.3), ("sign", 0.1), ("raw", 0.4)])
def test_on_a_linear_classifier_every_step_is_as_in_closed_form(step, size):
    start, classes = random(16, DIMENSIONS, seed=2), torch.arange(16) % 2
    problem, model = LinearScene(start, step, size), Linear(WEIGHT)
    result = attack(model, problem, classes, steps=6, batch_size=5)
    # Successful examples are not rendered again.
    assert torch.equal(problem.rendered, result.steps + 1) and model.seen == int(problem.rendered.sum())
    towards = CAMERAS[0] @ (WEIGHT[0] - WEIGHT[1])
    taken = set()
    for row in range(16):
        slope = towards * (1 + row / 10) * (1 - 2 * classes[row])
        before = float(slope @ start[row])
        displacement, steps, after = closed_form(step, size, 6, slope, before)
        taken.add(steps)
        assert int(result.steps[row]) == steps
        assert bool(result.success_before[row]) == (before < 0) and bool(result.success[row]) == (after < 0)
        # Six steps of a few roundings each, in sums of 12 terms.
        torch.testing.assert_close(result.values[row] - start[row], displacement, rtol=0, atol=64 * EPS)
        for cost, margin in ((result.cost_before, before), (result.cost, after)):
            assert float(cost[row]) == pytest.approx(-math.log1p(math.exp(-margin)), rel=128 * EPS)
    assert {0, 6} < taken  # examples that succeed at once, on the way, and never
    assert torch.equal(result.predicted[:, 0] != classes, result.success)
    images = problem.render(result.values, torch.arange(16))
    torch.testing.assert_close(result.images, images, rtol=0, atol=16 * EPS)
    assert not result.zero_gradient.any()


@pytest.mark.parametrize("step", ["unit", "raw"])
@pytest.mark.parametrize("views", [1, 2])
def test_the_lowest_point_of_a_sphere_is_reached_from_anywhere_in_it(views, step):
    """Also from starts off its center, where the steps first lead elsewhere: the way along the surface converges."""
    ball, center = StepSettings("l2", 0.4), random(8, DIMENSIONS, seed=2)
    problem = LinearScene(sample(ball, center, torch.Generator().manual_seed(0)), step, 0.3, ball, views, center)
    goal = Goal(torch.zeros(8, views, dtype=torch.int64), torch.ones(8, views, dtype=torch.int64))
    result = descend(Linear(WEIGHT, bias=50.0), problem, goal, settings_of(120))
    slope = (CAMERAS[:views] @ (WEIGHT[0] - WEIGHT[1])).sum(0)
    expected = center - 0.4 * slope / slope.norm()
    # Each step turns the values towards the end by a factor of at least 0.4 / 0.7, and 120 of them by 1e-29.
    torch.testing.assert_close(result.values, expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize(
    ("source", "target", "predicted", "success"),
    [
        ([[0, 1]], None, [[2, 2]], True),  # any error, in every view
        ([[0, 1]], None, [[1, 0]], True),
        ([[0, 1]], None, [[2, 1]], False),
        ([[0, 0]], [[1, 2]], [[1, 2]], True),  # its own target in every view
        ([[0, 0]], [[1, 2]], [[2, 1]], False),
        ([[0, 0]], [[1, 2]], [[1, 1]], False),
        ([[0], [1], [2]], [[1], [1], [1]], [[1], [2], [0]], [True, False, False]),
    ],
)
def test_a_goal_is_reached_when_every_view_is_predicted_as_asked(source, target, predicted, success):
    goal = Goal(torch.tensor(source), None if target is None else torch.tensor(target))
    reached = goal.reached(torch.tensor(predicted))
    assert reached.tolist() == torch.tensor(success).flatten().tolist()
    last = torch.tensor([len(source) - 1])
    assert goal.of(last).reached(torch.tensor(predicted)[last]).tolist() == [reached.tolist()[-1]]


class Bowl(nn.Module):
    """Two classes; the margin of the first over the second is 1 + the square of the image's value."""

    def forward(self, images: Tensor) -> Tensor:
        margin = 1 + images.flatten(1).square().sum(1)
        return torch.stack([margin, torch.zeros_like(margin)], dim=1)


class Detour(nn.Module):
    """Three classes of confidence 0.4, 0.3, 0.3 at 1, where the first grows, and of 0.45, 0.55, 0 below zero."""

    def forward(self, images: Tensor) -> Tensor:
        value, shares = images.flatten(1), torch.tensor([0.4, 0.3, 0.3]).double().log()
        above = shares + torch.cat([value - 1, torch.zeros_like(value), torch.zeros_like(value)], dim=1)
        return torch.where(value > 0, above, torch.tensor([0.45, 0.55, 1e-30]).double().log())


@dataclass
class Axis:
    """Images of one value, which steps of 1.5 cross."""

    start: Tensor
    at_once: int = 1000

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return values[:, :, None, None, None]

    def take_step(self, values: Tensor, gradient: Tensor, examples: Tensor, length: Tensor) -> Tensor:
        return values - length * 1.5 * gradient.sign()


def on_the_axis(steps: int, shorten: bool) -> DescentResult:
    start = torch.tensor([[1.0], [0.125], [0.75]], dtype=torch.float64)
    goal = Goal(torch.zeros(3, 1, dtype=torch.int64), torch.ones(3, 1, dtype=torch.int64))
    return descend(Bowl(), Axis(start), goal, settings_of(steps, shorten=shorten))


def test_a_step_that_does_not_lower_the_cost_is_taken_back_and_tried_at_half_its_length():
    """From 1 by 1.5 to -1/2; from there 1.5 is too far, but 3/4 is not; and so on, halving at every other step. From
    1/8 only the fourth length, 3/16, is short enough; from 3/4 the first leads to the same cost, which is no fall, and
    the second to the bottom. Every number is exact."""
    first = [1, -1 / 2, -1 / 2, 1 / 4, 1 / 4, -1 / 8, -1 / 8, 1 / 16]
    second = [1 / 8, 1 / 8, 1 / 8, 1 / 8, -1 / 16, -1 / 16, 1 / 32, 1 / 32]
    third = [3 / 4, 3 / 4, 0, 0, 0, 0, 0, 0]
    for steps, expected in enumerate(zip(first, second, third, strict=True)):
        result = on_the_axis(steps, shorten=True)
        assert tuple(result.values.flatten().tolist()) == expected
        assert torch.equal(result.images.flatten(), result.values.flatten())
        # The margin's two cross entropies round.
        torch.testing.assert_close(result.cost, 1 + result.values.flatten().square(), rtol=0, atol=8 * EPS)
        assert result.steps.tolist() == [steps] * 3 and result.predicted.flatten().tolist() == [0] * 3


def test_a_step_that_succeeds_is_kept_whatever_its_cost():
    """With three classes the true one may gain while another overtakes it."""
    start = torch.ones(1, 1, dtype=torch.float64)
    result = attack(Detour(), Axis(start), torch.zeros(1, dtype=torch.int64), steps=5, shorten=True)
    assert result.success.tolist() == [True] and result.steps.tolist() == [1] and result.values.tolist() == [[-0.5]]
    assert [float(result.cost_before), float(result.cost)] == pytest.approx([math.log(0.4), math.log(0.45)])


def test_after_a_success_of_higher_cost_steps_are_still_compared_with_where_they_start_from():
    """From 1, at a confidence of 0.4: -1/2 succeeds at 0.45, short of the margin; 1/4 has 0.42, which is no fall."""

    class Ridge(Detour):
        def forward(self, images: Tensor) -> Tensor:
            on_ridge = (images.flatten(1) > 0) & (images.flatten(1) < 0.5)
            return torch.where(on_ridge, torch.tensor([0.42, 0.41, 0.17]).double().log(), super().forward(images))

    class Recorded(Axis):
        def render(self, values: Tensor, examples: Tensor) -> Tensor:
            rendered.append(values.item())
            return super().render(values, examples)

    rendered: list[float] = []
    start = torch.ones(1, 1, dtype=torch.float64)
    result = attack(Ridge(), Recorded(start), torch.zeros(1, dtype=torch.int64), steps=3, shorten=True, margin=1.0)
    assert rendered == [1, -0.5, 0.25, 0.625]
    assert result.success.tolist() == [True] and result.values.tolist() == [[0.625]]  # of lower cost


@pytest.mark.parametrize("step", STEPS)
def test_a_zero_gradient_leaves_the_values_and_is_reported(step):
    """The second example's image is clamped all over."""

    class Clamped(LinearScene):
        def render(self, values: Tensor, examples: Tensor) -> Tensor:
            return values.view(-1, 1, *PIXELS).clamp(0, 1)

    start = torch.stack([torch.full((12,), 0.5), torch.full((12,), 3.0)]).double()
    problem, classes = Clamped(start, step, 0.01), torch.zeros(2, dtype=torch.int64)
    result = attack(Linear(WEIGHT, bias=20.0), problem, classes, steps=4)
    assert result.zero_gradient.tolist() == [False, True]
    assert result.steps.tolist() == [4, 4] and not result.success.any()
    assert (result.values[0] != start[0]).all() and torch.equal(result.values[1], start[1])


def small_network() -> nn.Sequential:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return nn.Sequential(
            nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.SiLU(), nn.Dropout(0.5), nn.Flatten(), nn.Linear(32, 4)
        ).double()


def small_attack(
    views: int, batch_size: int = 128, shorten: bool = False, margin: float = 0.0
) -> tuple[LinearScene, DescentResult]:
    """Nine examples, of which some succeed at once, on the way and never."""
    problem = LinearScene(3 * random(9, DIMENSIONS, seed=3), size=0.3, views=views)
    classes = (torch.arange(9) % 4)[:, None].expand(9, views)
    settings = settings_of(8, shorten=shorten, batch_size=batch_size, margin=margin)
    return problem, descend(small_network(), problem, Goal(classes), settings)


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("batch_size", [1, 3, 4, 100])
def test_the_batch_size_does_not_matter(batch_size, views):
    """Nor that a batch ends between two views of an example."""
    (_, whole), (_, batched) = small_attack(views, 9 * views), small_attack(views, batch_size)
    assert len(whole.steps.unique()) > 2
    for name in FIELDS:
        # The order of sums differs, in float64, and eight steps amplify it little.
        torch.testing.assert_close(getattr(batched, name), getattr(whole, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize("shorten", [False, True])
@pytest.mark.parametrize("views", [1, 2])
def test_every_example_is_attacked_as_if_alone(views, shorten):
    problem, together = small_attack(views, shorten=shorten)

    class Alone(LinearScene):
        def render(self, values: Tensor, examples: Tensor) -> Tensor:
            return problem.render(values, examples + self.row)

    for row in range(9):
        alone = Alone(problem.start[[row]], size=0.3, views=views)
        alone.row = row
        classes = torch.full((1, views), row % 4)
        result = descend(small_network(), alone, Goal(classes), settings_of(8, shorten=shorten))
        for name in FIELDS:
            torch.testing.assert_close(getattr(result, name)[0], getattr(together, name)[row], rtol=0, atol=1e-12)


def test_restarts_go_on_with_those_that_are_left_and_keep_successes():
    """Against as many descents one by one: an example's result is that of the first that succeeds, or of the first."""
    center, ball, network = random(40, DIMENSIONS, seed=3), StepSettings("linf", 0.5), Linear(WEIGHT)
    goal, settings = Goal(torch.arange(40)[:, None] % 2), settings_of(2)
    starts = [sample(ball, center, torch.Generator().manual_seed(seed)) for seed in (4, 5)]
    problem = LinearScene(center, "sign", 0.1, ball)
    result = descend(network, problem, goal, settings, restarts=starts)
    counted = problem.rendered.clone()
    problems = [LinearScene(start, "sign", 0.1, ball, center=center) for start in (center, *starts)]
    single = [descend(network, each, goal, settings) for each in problems]
    assert torch.isclose((single[1].values - center).abs(), torch.tensor(0.5).double()).any()  # the ball limits some
    rounds = torch.stack([each.success for each in single]).long().argmax(0)
    assert set(rounds.tolist()) == {0, 1, 2} and not result.success.all()
    assert torch.equal(result.success, torch.stack([each.success for each in single]).any(0))
    for row, chosen in enumerate(rounds.tolist()):
        last = chosen if result.success[row] else 2
        assert int(result.steps[row]) == sum(int(each.steps[row]) for each in single[: last + 1])
        assert int(counted[row]) == int(result.steps[row]) + last + 1
        for name in ("values", "images", "cost", "predicted"):
            expected = getattr(single[chosen], name)[row]
            torch.testing.assert_close(getattr(result, name)[row], expected, rtol=0, atol=64 * EPS)
        for name in ("cost_before", "success_before", "zero_gradient"):
            assert torch.equal(getattr(result, name)[row], getattr(single[0], name)[row])


@pytest.mark.parametrize("shorten", [False, True])
def test_a_margin_changes_no_success_and_sends_successes_on(shorten):
    (_, border), (_, beyond) = small_attack(2, shorten=shorten), small_attack(2, shorten=shorten, margin=0.5)
    assert torch.equal(beyond.success, border.success) and (beyond.steps > border.steps)[border.success].any()
    assert (beyond.steps >= border.steps).all()


class Watched(nn.Module):
    """Draws random numbers, and fails at one of its calls."""

    def __init__(self, fails_at: int | None):
        super().__init__()
        self.network = small_network()
        self.network[1].eval()
        self.network[0].bias.requires_grad_(False)
        self.network[5].bias.grad = torch.ones(4, dtype=torch.float64)
        self.calls, self.fails_at = 0, fails_at

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
            "gradients": [None if parameter.grad is None else parameter.grad + 0 for parameter in self.parameters()],
            "weights and buffers": {name: value.clone() for name, value in self.state_dict().items()},
            "random": torch.random.get_rng_state(),
            "grad mode": torch.is_grad_enabled(),
        }


@pytest.mark.parametrize("fails_at", [None, 1, 4])
@pytest.mark.parametrize("grad_mode", [True, False])
def test_the_model_and_the_random_state_are_left_as_they_were(fails_at, grad_mode):
    model = Watched(fails_at).train()
    model.network[1].eval()
    problem = LinearScene(random(4, DIMENSIONS, seed=3))
    images = problem.render(problem.start, torch.arange(4))[:, 0]
    classes = small_network().eval()(images).argmax(1)
    with torch.set_grad_enabled(grad_mode):
        before = model.state()
        try:
            attack(model, problem, classes, steps=3, batch_size=2)
        except RuntimeError:
            assert fails_at
        after = model.state()
    assert not fails_at or model.calls == fails_at
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    assert model.training and not model.network[1].training and model.network[3].training


def test_the_start_is_not_written_to():
    start = random(1, DIMENSIONS, seed=2)
    shared = start.expand(4, DIMENSIONS)  # one light for all, in one place in memory
    result = attack(Linear(WEIGHT), LinearScene(shared, size=0.3), torch.arange(4) % 2)
    assert torch.equal(start, random(1, DIMENSIONS, seed=2))
    assert not result.values.requires_grad and not result.images.requires_grad
