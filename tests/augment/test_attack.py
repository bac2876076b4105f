import math

import pytest
import torch
from torch import Tensor, nn

from augment.attack import STEPS, AttackResult, AttackSettings, descend
from augment.phases import Phases
from renderer.errors import InputError

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
PIXELS, PARAMETERS = (3, 2, 2), 5
FIELDS = ("parameters", "images", "steps", "fooled_before", "fooled", "loss_before", "loss", "zero_gradient")


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class Linear(nn.Module):
    """Two classes, logits linear in the picture. `seen` counts the pictures it was shown."""

    def __init__(self, weight: Tensor, bias: float = 0.0):
        super().__init__()
        self.weight = nn.Parameter(weight)
        self.bias = torch.tensor([bias, 0.0], dtype=weight.dtype)
        self.seen = 0

    def forward(self, images: Tensor) -> Tensor:
        self.seen += len(images)
        return images.flatten(1) @ self.weight.T + self.bias


WEIGHT, CAMERA = random(2, 12, seed=0), random(PARAMETERS, 12, seed=1) / 4


def project(parameters: Tensor, examples: Tensor) -> Tensor:
    """Pictures that are linear in the parameters, each example in another tint."""
    return (parameters @ CAMERA).view(-1, *PIXELS) * (1 + examples.double().view(-1, 1, 1, 1) / 10)


def attack(
    model: nn.Module,
    start: Tensor,
    labels: Tensor,
    settings: AttackSettings,
    render=project,
    phases: Phases | None = None,
) -> AttackResult:
    return descend(model, render, start, labels, settings, phases or Phases())


def closed_form(step: str, size: float, max_steps: int, slope: Tensor, margin: float) -> tuple[Tensor, int, float]:
    """(displacement, steps, margin) after descent on log σ(margin), with margin = slope · parameters.

    Its gradient is σ(-margin) · slope: the direction never changes.
    """
    displacement, steps = torch.zeros(PARAMETERS, dtype=torch.float64), 0
    while margin > 0 and steps < max_steps:
        move = {
            "unit": slope / slope.norm(),
            "sign": slope.sign(),
            "raw": slope / (1 + math.exp(margin)),
        }[step]
        displacement -= size * move
        margin -= size * float(slope @ move)
        steps += 1
    return displacement, steps, margin


@pytest.mark.parametrize(("step", "size"), [("unit", 0.3), ("sign", 0.1), ("raw", 0.4)])
def test_on_a_linear_classifier_every_step_is_as_in_closed_form(step, size):
    start, labels = random(16, PARAMETERS, seed=2), torch.arange(16) % 2
    result = attack(Linear(WEIGHT), start, labels, AttackSettings(step, size, max_steps=6, batch_size=5))
    towards = CAMERA @ (WEIGHT[0] - WEIGHT[1])
    taken = set()
    for row in range(16):
        slope = towards * (1 + row / 10) * (1 - 2 * labels[row])
        before = float(slope @ start[row])
        displacement, steps, after = closed_form(step, size, 6, slope, before)
        taken.add(steps)
        assert int(result.steps[row]) == steps
        assert bool(result.fooled_before[row]) == (before < 0) and bool(result.fooled[row]) == (after < 0)
        # Six steps of a few roundings each, in sums of 12 terms.
        torch.testing.assert_close(result.parameters[row] - start[row], displacement, rtol=0, atol=64 * EPS)
        for loss, margin in ((result.loss_before, before), (result.loss, after)):
            assert float(loss[row]) == pytest.approx(math.log1p(math.exp(-margin)), rel=128 * EPS)
    assert {0, 6} < taken  # examples that were fooled at once, on the way, and never
    pictures = project(result.parameters, torch.arange(16))
    torch.testing.assert_close(result.images, pictures, rtol=0, atol=16 * EPS)
    assert not result.zero_gradient.any()


def test_fooled_examples_stay_and_are_not_looked_at_again():
    start, labels, model = random(16, PARAMETERS, seed=2), torch.arange(16) % 2, Linear(WEIGHT)
    rendered = torch.zeros(16, dtype=torch.int64)

    def render(parameters: Tensor, examples: Tensor) -> Tensor:
        rendered.index_add_(0, examples, torch.ones_like(examples))
        return project(parameters, examples)

    result = attack(model, start, labels, AttackSettings("unit", 0.3, max_steps=6), render)
    torch.testing.assert_close(rendered, result.steps + 1)
    assert model.seen == int(rendered.sum())
    at_once = result.fooled_before
    assert at_once.any() and not result.steps[at_once].any()
    torch.testing.assert_close(result.parameters[at_once], start[at_once], rtol=0, atol=0)
    logits = model(result.images)
    torch.testing.assert_close(logits.argmax(1) != labels, result.fooled)


def test_without_steps_nothing_moves_and_the_losses_are_told():
    start, labels = random(16, PARAMETERS, seed=2), torch.arange(16) % 2
    result = attack(Linear(WEIGHT), start, labels, AttackSettings(max_steps=0))
    torch.testing.assert_close(result.parameters, start, rtol=0, atol=0)
    torch.testing.assert_close(result.loss, result.loss_before, rtol=0, atol=0)
    assert not result.steps.any() and torch.equal(result.fooled, result.fooled_before)


@pytest.mark.parametrize(("scale", "tolerance"), [(1.0, 8 * EPS32), (1e-30, 8 * EPS32), (1e-40, 1e-4)])
def test_gradients_of_any_size_make_unit_steps(scale, tolerance):
    """1e-40 is subnormal in float32, with five digits left."""
    slope = (WEIGHT[0] - WEIGHT[1]).float()

    def render(parameters: Tensor, examples: Tensor) -> Tensor:
        return 0.5 + scale * parameters.view(-1, *PIXELS)

    result = attack(
        Linear(WEIGHT.float(), bias=5.0),
        torch.zeros(2, 12),
        torch.zeros(2, dtype=torch.int64),
        AttackSettings("unit", 0.25, max_steps=3),
        render,
    )
    assert result.steps.tolist() == [3, 3] and not result.zero_gradient.any()
    expected = (-0.75 * slope / slope.norm()).expand(2, 12)
    torch.testing.assert_close(result.parameters, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("step", STEPS)
def test_a_zero_gradient_leaves_the_parameters_and_is_told(step):
    """The second example's picture is clamped all over."""

    def render(parameters: Tensor, examples: Tensor) -> Tensor:
        return parameters.view(-1, *PIXELS).clamp(0, 1)

    start = torch.stack([torch.full((12,), 0.5), torch.full((12,), 3.0)]).double()
    model = Linear(WEIGHT, bias=20.0)
    result = attack(model, start, torch.zeros(2, dtype=torch.int64), AttackSettings(step, 0.01, max_steps=4), render)
    assert result.zero_gradient.tolist() == [False, True]
    assert result.steps.tolist() == [4, 4] and not result.fooled.any()
    assert (result.parameters[0] != start[0]).all()
    torch.testing.assert_close(result.parameters[1], start[1], rtol=0, atol=0)


def small_network() -> nn.Sequential:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return nn.Sequential(
            nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.SiLU(), nn.Dropout(0.5), nn.Flatten(), nn.Linear(32, 4)
        ).double()


@pytest.mark.parametrize("batch_size", [1, 4, 100])
def test_the_batch_size_does_not_matter(batch_size):
    network, start, labels = small_network(), 3 * random(9, PARAMETERS, seed=3), torch.arange(9) % 4
    settings = [AttackSettings("unit", 0.3, max_steps=5, batch_size=size) for size in (9, batch_size)]
    whole, batched = (attack(network, start, labels, choice) for choice in settings)
    assert len(whole.steps.unique()) > 2
    for name in FIELDS:
        # The order of sums differs, in float64, and five steps amplify it little.
        torch.testing.assert_close(getattr(batched, name), getattr(whole, name), rtol=0, atol=1e-12)


def test_every_example_is_attacked_as_if_alone():
    network, start, labels = small_network(), 3 * random(6, PARAMETERS, seed=3), torch.arange(6) % 4
    settings = AttackSettings("unit", 0.2, max_steps=8)
    together = attack(network, start, labels, settings)
    for row in range(6):
        alone = attack(
            network, start[[row]], labels[[row]], settings, lambda p, _, row=row: project(p, torch.tensor([row]))
        )
        for name in FIELDS:
            torch.testing.assert_close(getattr(alone, name)[0], getattr(together, name)[row], rtol=0, atol=1e-12)


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
            raise RuntimeError("out of memory")
        return self.network(images)

    def state(self) -> dict:
        return {
            "modes": [module.training for module in self.modules()],
            "requires_grad": [parameter.requires_grad for parameter in self.parameters()],
            "grads": [
                parameter.grad if parameter.grad is None else parameter.grad.clone() for parameter in self.parameters()
            ],
            "weights and buffers": {name: value.clone() for name, value in self.state_dict().items()},
            "random": torch.random.get_rng_state(),
            "grad mode": torch.is_grad_enabled(),
        }


@pytest.mark.parametrize("fails_at", [None, 1, 4])
@pytest.mark.parametrize("grad_mode", [True, False])
def test_the_model_and_the_random_state_are_left_as_they_were(fails_at, grad_mode):
    model = Watched(fails_at).train()
    model.network[1].eval()
    start = random(4, PARAMETERS, seed=3)
    labels = small_network().eval()(project(start, torch.arange(4))).argmax(1)
    with torch.set_grad_enabled(grad_mode):
        before = model.state()
        try:
            attack(model, start, labels, AttackSettings(batch_size=2, max_steps=3))
        except RuntimeError:
            assert fails_at
        after = model.state()
    assert model.calls == fails_at or not fails_at
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    assert model.training and not model.network[1].training and model.network[3].training


def test_the_start_is_not_written_to():
    start = random(1, PARAMETERS, seed=2)
    shared = start.expand(4, PARAMETERS)  # one light for all, in one place in memory
    result = attack(Linear(WEIGHT), shared, torch.arange(4) % 2, AttackSettings("unit", 0.3))
    torch.testing.assert_close(start, random(1, PARAMETERS, seed=2), rtol=0, atol=0)
    assert not result.parameters.requires_grad and not result.images.requires_grad


def test_the_classifiers_share_of_the_time_is_told():
    phases = Phases()
    attack(Linear(WEIGHT), random(2, PARAMETERS, seed=2), torch.arange(2), AttackSettings(), phases=phases)
    assert phases.take()["attack_classifier"] > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": "newton"}, r"augment\.attack\.step=newton: choose one of unit, raw, sign"),
        ({"step_size": 0.0}, "step_size=0.0"),
        ({"step_size": -0.05}, "step_size=-0.05"),
        ({"step_size": math.nan}, "step_size=nan"),
        ({"max_steps": -1}, "max_steps=-1"),
        ({"batch_size": 0}, "batch_size=0"),
    ],
)
def test_settings_that_make_no_attack_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        AttackSettings(**change)
