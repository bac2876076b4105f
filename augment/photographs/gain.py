"""Search for the factors of a slide that change the predicted class of photographs.

The logarithms of the factors lie in an L∞ ball around 0.
"""

import torch
from torch import Tensor, nn

from augment.attacks.norm_ball import take_step
from augment.losses import adversarial_cost, logit_gap
from augment.parameter_settings import StepSettings
from augment.photographs.projected_light import ProjectedLight

# All steps of an attack together have the length of this many radii, so that they
# can cross the ball from any start (Madry et al. 2018).
TRAVELED_RADII = 2.5


def draw_log_gain(count: int, cells: int, radius: float, draws: torch.Generator) -> Tensor:
    """Draw logarithms of factors uniformly from the L∞ ball.

    Args:
        count: Number of photographs.
        cells: Number of cells per side.
        radius: Radius of the ball.
        draws: CPU generator of the random numbers.

    Returns:
        Logarithms, on the CPU, shape (count, 3, cells, cells).
    """
    return radius * (2 * torch.rand(count, 3, cells, cells, generator=draws) - 1)


class Best:
    """Best factors so far of each of B photographs.

    The best factors are those with the largest gap.

    Attributes:
        log_gain: Logarithms of the factors, shape (B, 3, cells, cells).
        gap: Lead of the best other class over the source class, shape (B,).
    """

    def __init__(self, log_gain: Tensor):
        self.log_gain = log_gain.clone()
        self.gap = log_gain.new_full((len(log_gain),), -torch.inf)

    def update(self, log_gain: Tensor, logits: Tensor, source: Tensor) -> None:
        """Keep the factors of those photographs whose gap has grown.

        Args:
            log_gain: Logarithms of new factors, shape (B, 3, cells, cells).
            logits: Logits of the photographs that are relit with these factors, shape
                (B, classes).
            source: Classes of the unchanged photographs, shape (B,).
        """
        gap = logit_gap(logits.detach().float(), source)
        is_better = gap > self.gap
        self.gap = torch.where(is_better, gap, self.gap)
        self.log_gain[is_better] = log_gain.detach()[is_better]


@torch.no_grad()
def search_gain(
    model: nn.Module,
    albedo: Tensor,
    light: ProjectedLight,
    source: Tensor,
    candidates: list[Tensor],
) -> Tensor:
    """Choose the best of several random factors for each photograph.

    Args:
        model: Network from images in [0, 1] to logits.
        albedo: Linear values of the photographs, shape (B, 3, H, W).
        light: Light on them.
        source: Classes of the unchanged photographs, shape (B,).
        candidates: Logarithms of factors, shape (B, 3, cells, cells) each.

    Returns:
        Logarithms of the best factors, shape (B, 3, cells, cells).
    """
    best = Best(candidates[0])
    for log_gain in candidates:
        best.update(log_gain, model(light.expose(albedo, log_gain)), source)
    return best.log_gain


@torch.enable_grad()
def descend_gain(
    model: nn.Module,
    albedo: Tensor,
    light: ProjectedLight,
    source: Tensor,
    start: Tensor,
    radius: float,
    steps: int,
    best: Best | None = None,
) -> Tensor:
    """Search for factors that change the class, by projected gradient descent.

    The descent lowers the confidence in the source class.

    Args:
        model: Network from images in [0, 1] to logits, without gradients of its
            parameters.
        albedo: Linear values of the photographs, shape (B, 3, H, W).
        light: Light on them.
        source: Classes of the unchanged photographs, shape (B,).
        start: Logarithms of the factors at the start, shape
            (B, 3, cells, cells).
        radius: Radius of the L∞ ball around 0.
        steps: Number of steps. Each has a forward and a backward pass.
        best: Record of the best factors, which the forward passes update. None
            if only the last factors are of interest.

    Returns:
        Logarithms of the factors after the last step, shape
        (B, 3, cells, cells).
    """
    if not steps or not radius:
        return start
    step_size = TRAVELED_RADII * radius / steps
    ball = StepSettings(norm="linf", radius=radius, step="sign", step_size=step_size)
    center = torch.zeros_like(start)
    log_gain = start
    for _ in range(steps):
        log_gain = log_gain.detach().requires_grad_(True)
        logits = model(light.expose(albedo, log_gain))
        if best is not None:
            best.update(log_gain, logits, source)
        cost = adversarial_cost(logits.float(), source).sum()
        (gradient,) = torch.autograd.grad(cost, log_gain)
        log_gain = take_step(ball, log_gain.detach(), gradient, center)
    return log_gain
