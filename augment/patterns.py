"""Patterns that a projector throws onto an image: stripes, checkers, spots, halves, solid colours, drawn at random."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from renderer.image import decode


def draw_patterns(count: int, size: int, draws: torch.Generator) -> Tensor:
    """(count, 3, size, size) linear light in [0, 1], each pattern of two colours, at any angle, scale and place."""
    middles = (torch.arange(size) + 0.5) / size * 2 - 1
    points = torch.stack(torch.meshgrid(middles, middles, indexing="xy"))  # (2, size, size)
    return torch.stack([_pattern(points, draws) for _ in range(count)])


def _pattern(points: Tensor, draws: torch.Generator) -> Tensor:
    angle, period, *place = torch.rand(4, generator=draws) * torch.tensor([2 * math.pi, 1.0, 1.0, 1.0])
    turn = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    across = torch.einsum("ij,jyx->iyx", turn, points)
    family = FAMILIES[int(torch.randint(len(FAMILIES), (), generator=draws))]
    share = family(across / (0.25 + 0.75 * period), torch.stack(place))
    first, second = _colour(draws), _colour(draws) * torch.rand(1, generator=draws)  # the darker one down to nothing
    return second[:, None, None] + share * (first - second)[:, None, None]


def _stripes(points: Tensor, place: Tensor) -> Tensor:
    return ((points[0] + place[0]) % 1 < 0.5).float()


def _checkers(points: Tensor, place: Tensor) -> Tensor:
    return (((points + place[:, None, None]) % 1 < 0.5).sum(0) == 1).float()


def _spots(points: Tensor, place: Tensor) -> Tensor:
    """Discs on a square grid, over half of it."""
    return (((points + place[:, None, None]) % 1 - 0.5).norm(dim=0) < 0.4).float()


def _half(points: Tensor, place: Tensor) -> Tensor:
    return (points[0] > place[0] - 0.5).float()


def _solid(points: Tensor, place: Tensor) -> Tensor:
    return torch.ones_like(points[0])


FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (_stripes, _checkers, _spots, _half, _solid)


def _colour(draws: torch.Generator) -> Tensor:
    """(3,) linear, of any hue, from white to pure; the largest channel is 1."""
    hue, saturation = torch.rand(2, generator=draws)
    ramps = (6 * hue + torch.tensor([0.0, 4.0, 2.0])) % 6  # of the hexcone (Smith 1978)
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")
