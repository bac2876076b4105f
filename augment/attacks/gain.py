"""Search for projected light that changes the predicted class of photographs.

A projector shows a picture (a slide) on a photograph. The search multiplies the slide by factors
(gains): one for each color channel in each cell of a grid. The logarithms of the factors lie in an
L∞ ball around 0.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from augment.attacks.norm_ball import take_step
from augment.losses import adversarial_cost, logit_gap
from augment.parameter_settings import StepSettings
from augment.projected_light import ProjectedLight

# Total length of all steps of an attack, in units of the radius of the norm-ball. It is more than
# the diameter, so that the steps can cross the ball from any start (Madry et al. 2018).
TRAVELED_RADII = 2.5


def draw_log_gain(
    count: int, cells: int, radius: float, draws: torch.Generator
) -> Float[Tensor, "count 3 cells cells"]:
    """Draw random factors of projected light, with logarithms uniform in [-radius, radius]."""
    return radius * (2 * torch.rand(count, 3, cells, cells, generator=draws) - 1)


class Best:
    """Record of the best factors of projected light that a search has found so far.

    Each of B photographs is lit by a slide, which is multiplied by factors. The
    best factors are those with the largest logit gap: the largest logit of all
    other classes minus the logit of the class of the unchanged photograph.

    Attributes:
        log_gain: Logarithms of the best factors of each channel in each cell,
            shape (B, 3, cells, cells).
        gap: Logit gap of the best factors, shape (B,).
    """

    def __init__(self, log_gain: Tensor):
        self.log_gain = log_gain.clone()
        self.gap = log_gain.new_full((len(log_gain),), -torch.inf)

    def update(
        self,
        log_gain: Float[Tensor, "B 3 cells cells"],
        logits: Float[Tensor, "B classes"],
        source: Int[Tensor, " B"],
    ) -> None:
        """Replace the best factors of each photograph if new ones have a larger logit gap.

        `source` has the predicted classes of the unchanged photographs, and `log_gain` logarithms.
        """
        gap = logit_gap(logits.detach().float(), source)
        is_better = gap > self.gap
        self.gap = torch.where(is_better, gap, self.gap)
        self.log_gain[is_better] = log_gain.detach()[is_better]


@torch.no_grad()
def search_gain(
    model: nn.Module,
    albedo: Float[Tensor, "B 3 H W"],
    light: ProjectedLight,
    source: Int[Tensor, " B"],
    candidates: list[Tensor],
) -> Float[Tensor, "B 3 cells cells"]:
    """Choose the best of several random factors of projected light for each photograph.

    The best factors are those that come closest to a change of the predicted class, or change it
    most surely. Photographs are linear, and candidates are logarithms, each for all photographs.
    """
    best = Best(candidates[0])
    for log_gain in candidates:
        best.update(log_gain, model(light.expose(albedo, log_gain)), source)
    return best.log_gain


@torch.enable_grad()
def descend_gain(
    model: nn.Module,
    albedo: Float[Tensor, "B 3 H W"],
    light: ProjectedLight,
    source: Int[Tensor, " B"],
    start: Float[Tensor, "B 3 cells cells"],
    radius: float,
    steps: int,
    best: Best | None = None,
) -> Float[Tensor, "B 3 cells cells"]:
    """Search for projected light that changes the class of photographs, by gradient descent.

    The light is a slide, which is multiplied by factors. Projected gradient descent changes the
    factors, so that the probability of the class of the unchanged photograph falls. Photographs are
    linear, and the factors are logarithms. `best` records the factors before each step.
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
