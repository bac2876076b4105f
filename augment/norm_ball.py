"""Norm-balls in a space of parameters: the exact projection into them and uniform draws from them."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from renderer.basis import Ends
from renderer.errors import FACTOR, InputError, require_range

NORMS = ("linf", "l2")
SECANTS = 6  # four are usual; what they end with is within the ball, at most that much short of the nearest


class Domain(Protocol):
    """A convex set of values (D,)."""

    def __call__(self, values: Tensor, ends: Ends | None = None) -> Tensor:
        """Its nearest points to values (A, D), between ends (A, D) each that some of its points lie between."""


def anywhere(values: Tensor, ends: Ends | None = None) -> Tensor:
    """The domain without a bound."""
    return values if ends is None else values.clamp(*ends)


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

    def project(self, values: Tensor, centre: Tensor, domain: Domain = anywhere) -> Tensor:
        """The nearest points of what ball and domain share, in the Euclidean sense; values and centre (A, D).

        The domain holds the centre.
        """
        if self.radius is None:
            return domain(values)
        if self.norm == "linf":
            return domain(values, (centre - self.radius, centre + self.radius))
        return _project_into_sphere(values, centre, self.radius, domain)

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


def _project_into_sphere(values: Tensor, centre: Tensor, radius: float, domain: Domain) -> Tensor:
    """The domain's nearest points to points on the way from the centre to the values, as far as the radius goes.

    With a multiplier λ for the ball, what is nearest to values v is the domain's nearest to c + (v - c) / (1 + λ), and
    the farther on the way, the farther from the centre. How far is found by secants of the squared distance over the
    squared share of the way, which for a box is straight between the corners that it cuts off.
    """
    offset, squared = values - centre, radius**2

    def at(share: Tensor) -> tuple[Tensor, Tensor]:
        nearest = domain(torch.where(share < 1, centre + share.sqrt() * offset, values))
        return nearest, (nearest - centre).square().sum(1, keepdim=True)

    share = (squared / offset.square().sum(1, keepdim=True)).clamp(max=1)  # a domain's nearest points are no farther
    nearest, distance = at(share)
    other, its_distance = torch.zeros_like(share), torch.zeros_like(distance)
    rounding = 8 * torch.finfo(values.dtype).eps * squared
    for _ in range(SECANTS):
        left = squared - distance
        going = (share < 1) & (share != other) & (left > rounding)
        if not going.any():
            break
        slope = ((distance - its_distance) / (share - other)).clamp(min=torch.finfo(values.dtype).tiny)
        tried = torch.where(going, share + left / slope, share).clamp(max=1)
        found, found_distance = at(tried)
        inside = found_distance <= squared + rounding
        other = torch.where(inside, share, tried)
        its_distance = torch.where(inside, distance, found_distance)
        share, distance = torch.where(inside, tried, share), torch.where(inside, found_distance, distance)
        nearest = torch.where(inside, found, nearest)
    return nearest
