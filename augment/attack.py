"""Descent on the adversarial cost over any parameters that render differentiably, until the classifier is fooled."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment.cost import adversarial_cost
from augment.model_state import as_found
from augment.phases import Phases
from renderer.errors import InputError

STEPS = ("unit", "raw", "sign")


@dataclass
class AttackSettings:
    """The paper's appendix C: 0.05 along the gradient's direction, at most 30 steps.

    step: what "along the direction" means: the gradient at unit L2 norm per example, as it is, or its sign.
    batch_size: examples per pass through the classifier.
    """

    step: str = "unit"
    step_size: float = 0.05
    max_steps: int = 30
    batch_size: int = 128

    def __post_init__(self):
        if self.step not in STEPS:
            raise InputError(f"augment.attack.step={self.step}: choose one of {', '.join(STEPS)}")
        if not self.step_size > 0 or self.max_steps < 0 or self.batch_size < 1:
            raise InputError(
                f"augment.attack: step_size={self.step_size}, max_steps={self.max_steps} and "
                f"batch_size={self.batch_size} must be positive"
            )


@dataclass(frozen=True)
class AttackResult:
    """What an attack did, per example; all tensors have E rows and lie on the parameters' device.

    parameters, images: where the descent ended. steps: int64, taken. fooled_before, fooled: bool.
    loss_before, loss: cross entropy of the true class. zero_gradient: bool, the first gradient was exactly zero.
    """

    parameters: Tensor
    images: Tensor
    steps: Tensor
    fooled_before: Tensor
    fooled: Tensor
    loss_before: Tensor
    loss: Tensor
    zero_gradient: Tensor


@torch.enable_grad()
def descend(
    model: nn.Module,
    render: Callable[[Tensor, Tensor], Tensor],
    start: Tensor,
    labels: Tensor,
    settings: AttackSettings,
    phases: Phases,
) -> AttackResult:
    """Step each example's parameters down the cost until the classifier errs; fooled examples leave the batch.

    model: (N, 3, H, W) in [0, 1] → logits; used in eval mode and left as it was found. render: parameters (A, ...) of
    the examples with indices (A,) → images (A, 3, H, W). start: (E, ...). labels: (E,) int64, the true classes. The
    forward pass that yields the gradient also tells who is fooled, and only examples that go on are rendered.
    """
    parameters = start.detach().clone()
    active = torch.arange(len(labels), device=labels.device)
    steps, fooled = torch.zeros_like(labels), torch.zeros_like(labels, dtype=torch.bool)
    loss = start.new_zeros(len(labels))
    with as_found(model):
        for step in range(settings.max_steps + 1):
            chosen = parameters[active].requires_grad_(True)
            rendered = render(chosen, active)
            with phases("attack_classifier"):
                passed = _classifier_pass(model, rendered.detach(), labels[active], settings.batch_size)
            loss[active], fooled[active], pixel_gradient = passed
            (gradient,) = torch.autograd.grad(rendered, chosen, pixel_gradient)
            if step == 0:
                images = rendered.detach().clone()
                fooled_before, loss_before = fooled.clone(), loss.clone()
                zero_gradient = gradient.flatten(1).abs().amax(1) == 0
            images[active] = rendered.detach()
            going = ~fooled[active]
            active = active[going]
            if step == settings.max_steps or not len(active):
                break
            parameters[active] -= settings.step_size * _direction(gradient[going], settings.step)
            steps[active] += 1
    return AttackResult(parameters, images, steps, fooled_before, fooled, loss_before, loss, zero_gradient)


def _classifier_pass(
    model: nn.Module, images: Tensor, labels: Tensor, batch_size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Cross entropy (A,), misclassified (A,) and the cost's gradient (A, 3, H, W) for images (A, 3, H, W)."""
    losses, errs, gradients = [], [], []
    for batch, truth in zip(images.split(batch_size), labels.split(batch_size), strict=True):
        pictures = batch.detach().requires_grad_(True)
        logits = model(pictures)
        cost = adversarial_cost(logits, truth)
        gradients += torch.autograd.grad(cost.sum(), pictures)
        losses.append(-cost.detach())
        errs.append(logits.detach().argmax(1) != truth)
    return torch.cat(losses), torch.cat(errs), torch.cat(gradients)


def _direction(gradient: Tensor, step: str) -> Tensor:
    """The gradient (A, ...) as a step: unit L2 norm per example (a zero gradient stays zero), raw, or its sign."""
    if step == "raw":
        return gradient
    if step == "sign":
        return gradient.sign()
    # Scaling by the largest entry first keeps tiny gradients from underflowing when squared.
    flat = gradient.flatten(1)
    scaled = flat / flat.abs().amax(1, keepdim=True).clamp(min=torch.finfo(flat.dtype).tiny)
    return F.normalize(scaled, eps=torch.finfo(flat.dtype).tiny).view_as(gradient)
