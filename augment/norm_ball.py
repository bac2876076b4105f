"""Norm-balls in a space of parameters: the exact projection into them and uniform draws from them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from renderer.errors import FACTOR, InputError, require_range

NORMS = ("linf", "l2")
Domain = Callable[[Tensor], Tensor]


@dataclass
class NormBall:
    """All values (D,) within a radius of a centre; radius None is the whole space.

    The paper's radii (Section 4.1): linf 0.1 per lighting coefficient and 0.002 per vertex axis.
    InputError: unknown norm, radius below zero.
    """

    norm: str = "linf"
    radius: float | None = None

    def __post_init__(self) -> None:
        if self.norm not in NORMS:
            raise InputError(f"attack: norm={self.norm}: choose one of {', '.join(NORMS)}")
        require_range("attack: radius", self.radius, 0, FACTOR)  # no limit: null

    def project(self, values: Tensor, centre: Tensor, domain: Domain = lambda values: values) -> Tensor:
        """The nearest points of the ball in the Euclidean sense; values and centre (A, D).

        domain: clamps values to a box that holds the centre; then the nearest points of what ball and box share.
        """
        if self.radius is None:
            return domain(values)
        if self.norm == "linf":
            return domain(values).clamp(centre - self.radius, centre + self.radius)
        return _project_on_sphere(values, centre, self.radius, domain)

    def sample(self, centre: Tensor, generator: torch.Generator, used: Tensor | None = None) -> Tensor:
        """A uniform draw around each centre (A, D), on the generator's device. InputError where there is no radius.

        used: (A, D) bool, the axes along which each is drawn; None for all.
        """
        if self.radius is None:
            raise InputError("attack: radius=null has no uniform draw: set a radius to compare with random ones")
        if self.norm == "linf":
            offset = 2 * torch.rand(centre.shape, generator=generator) - 1
        else:
            direction = torch.randn(centre.shape, generator=generator)
            axes: int | Tensor = centre.shape[1]
            if used is not None:
                direction, axes = direction * used.cpu(), used.cpu().sum(1, keepdim=True)
            share = torch.rand(len(centre), 1, generator=generator) ** (1 / axes)
            offset = direction / direction.norm(dim=1, keepdim=True) * share
        if used is not None:
            offset = offset * used.cpu()
        return centre + self.radius * offset.to(centre)


def _project_on_sphere(values: Tensor, centre: Tensor, radius: float, domain: Domain) -> Tensor:
    """Straight towards the values and along the domain's ends from there on, as far as the radius goes.

    Where the box cuts an axis off, the others may go further: what is left of the squared radius is theirs. Each round
    but the last cuts off another axis.
    """
    offset = values - centre
    share = (radius / offset.norm(dim=1, keepdim=True)).clamp(max=1)
    while True:
        straight = torch.where(share < 1, centre + share * offset, values)
        nearest = domain(straight)
        cut = nearest != straight
        left = radius**2 - torch.where(cut, nearest - centre, 0).square().sum(1, keepdim=True)
        longer = (left.clamp(min=0).sqrt() / torch.where(cut, 0, offset).norm(dim=1, keepdim=True)).clamp(max=1)
        further = cut.any(1, keepdim=True) & (longer > share)
        if not further.any():
            return nearest
        share = torch.where(further, longer, share)
