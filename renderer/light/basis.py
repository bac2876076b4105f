"""Bases of light. An image is linear in the coefficients of a light of fixed position, so each basis has operators.

Environment light has one basis, `Harmonics`. Lights within the scene are frozen dataclasses of `LocalBasis`: see
`Lamps` and `Projector` in light/local.py. `renderer.render` takes a new one as it is; to configure and to attack it,
add it to augment/build.py and give it a module in augment/attacks/parameters/.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from renderer.errors import require_finite, require_range
from renderer.light.harmonics import (
    MAX_DEGREE,
    basis,
    degree_of,
    lambertian_factors,
    nonzero_coefficients,
    select_rows,
    unit,
)
from renderer.validation import require_whole

_STEPS = 20  # four are usual; after fewer than needed the result is within the ball, but not at its surface


@dataclass(frozen=True)
class Harmonics:
    """Environment light as real spherical harmonics: from infinitely far away, the same at each point of a scene.

    `size` functions, of which a light has a coefficient (size, 3) each, RGB. name: in files and messages.
    allow_negative: any coefficients render, negative radiance included (the paper's), though only light exists whose
    radiance is nowhere negative. InputError: a degree beyond 40.
    """

    degree: int = 6

    name: ClassVar[str] = "harmonics"
    allow_negative: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_whole("degree", self.degree)
        require_range("the degree of harmonics", self.degree, 0, MAX_DEGREE)

    def __str__(self) -> str:
        return f"{self.name} of degree {self.degree}"

    @property
    def size(self) -> int:
        return (self.degree + 1) ** 2

    @property
    def nonzero(self) -> Tensor:
        """(K,) ascending indices of the functions that reach a diffuse surface under an open sky."""
        return nonzero_coefficients(self.degree)

    def irradiance(self, normals: Tensor) -> Tensor:
        """(N, K) at unit normals (N, 3), per unit of each nonzero coefficient."""
        require_finite(normals=normals)
        factors = lambertian_factors(self.degree)[self.nonzero].to(normals)
        rows = select_rows(unit(normals.double().T), self.nonzero.tolist())
        by_function = torch.stack(rows).to(normals.dtype) * factors[:, None]
        return by_function.T.contiguous()  # Transposed last, since rows are what a processor fills fastest.

    def radiance(self, directions: Tensor) -> Tensor:
        """(N, size) from unit directions (N, 3), per unit of each coefficient."""
        return basis(directions, self.degree)

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Coefficients (..., size, 3) of light that can be emitted, of the same mean and the most alike irradiance."""
        from renderer.light.nonnegative import project_nonnegative  # scipy's optimizers take long to import

        return project_nonnegative(coefficients)

    def nearest_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """The nearest coefficients (..., size, 3) of light that can be emitted, whose mean may be another.
        within: for coefficients (A, size, 3), a ball in which the result lies; its centers can be emitted."""
        from renderer.light.nonnegative import nearest_nonnegative

        return nearest_nonnegative(coefficients, within)


HARMONICS = Harmonics()


class LightPaths(NamedTuple):
    """E connections from lights to surface points. point, function: (E,) int64, the surface point and the function of
    the basis. source: (E, 3), where the light starts. irradiance: (E,) per unit of the function's coefficient,
    differentiable in the points and normals; which connections there are is fixed."""

    point: Tensor
    function: Tensor
    source: Tensor
    irradiance: Tensor


class LocalBasis(ABC):
    """Light from sources within the scene, which casts shadows. Coefficients (size, 3) are in [0, power]."""

    name: ClassVar[str]
    allow_negative: ClassVar[bool] = False
    power: float

    @property
    @abstractmethod
    def size(self) -> int:
        """How many functions there are."""

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """The nearest coefficients that can be emitted: each light shows on its own where it is clamped."""
        return self.nearest_nonnegative(coefficients)

    def nearest_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """As `Harmonics.nearest_nonnegative`."""
        return nearest_in_box(coefficients, 0, self.power, within)

    @abstractmethod
    def connect(self, points: Tensor, normals: Tensor, positions: Tensor | None = None) -> LightPaths:
        """The paths to surface points (S, 3) of unit normals (S, 3), occlusion ignored. positions: (L, 3) of lamps,
        instead of the basis'; the irradiance is differentiable in them, too."""


@dataclass(frozen=True)
class SumBasis:
    """Lights of several bases at once: the coefficients of one after the other."""

    parts: tuple[Harmonics | LocalBasis, ...]

    def __str__(self) -> str:
        return " and ".join(map(str, self.parts))

    @property
    def size(self) -> int:
        return sum(part.size for part in self.parts)

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """The projection of each part."""
        projected = [part.project_nonnegative(coefficients[..., rows, :]) for rows, part in parts_of(self)]
        return torch.cat(projected, dim=-2)


Basis = Harmonics | LocalBasis | SumBasis


def parts_of(basis: Basis) -> list[tuple[slice, Harmonics | LocalBasis]]:
    """(rows of coefficients, basis) of each part of a sum, or of the basis itself."""
    parts, first = [], 0
    for part in basis.parts if isinstance(basis, SumBasis) else (basis,):
        parts.append((slice(first, first + part.size), part))
        first += part.size
    return parts


def harmonics_of(basis: Basis) -> Harmonics:
    """Those of the environment light, which come first."""
    first = parts_of(basis)[0][1]
    assert isinstance(first, Harmonics)
    return first


def with_local_lights(sky: Tensor, lights: Sequence[tuple[LocalBasis, Tensor]]) -> tuple[Basis, Tensor]:
    """(basis, coefficients (size, 3)) of the sky in harmonics and of lights in the scene, each with its own."""
    harmonics = Harmonics(degree_of(sky))
    if not lights:
        return harmonics, sky
    coefficients = [values.to(sky) for _, values in lights]
    return SumBasis((harmonics, *(basis for basis, _ in lights))), torch.cat([sky, *coefficients])


@dataclass(frozen=True)
class Ball:
    """Values (A, ...), each within a radius of its center, in the norm "linf" or "l2"."""

    center: Tensor
    radius: float
    norm: str

    def unflatten(self, *shape: int) -> Ball:
        """The ball of values (A, *shape), of a ball of values (A, D)."""
        return Ball(self.center.unflatten(1, shape), self.radius, self.norm)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """The lowest and the highest values, where the norm is "linf"."""
        return self.center - self.radius, self.center + self.radius


def nearest_in_box(values: Tensor, low: Any, high: Any, within: Ball | None = None) -> Tensor:
    """The values from `low` to `high`, numbers or tensors, that are nearest to values (A, ...) in the Euclidean sense.
    within: a ball, whose centers lie there."""
    if within is None:
        return values.clamp(low, high)
    if within.norm == "linf":
        return values.clamp(low, high).clamp(*within.ends)
    return _nearest_in_box_and_sphere(values, low, high, within)


def _nearest_in_box_and_sphere(values: Tensor, low: Any, high: Any, ball: Ball) -> Tensor:
    """With a multiplier λ for the ball, the nearest point is the box's nearest to c + (v - c) / (1 + λ).

    Its squared distance from the center c is a concave and piecewise linear function of s = 1 / (1 + λ)². From s = 0
    on, Newton's steps therefore end where the distance is the radius, without going beyond.
    """
    offset, squared = values - ball.center, ball.radius**2
    fraction, slope, distance = offset.new_zeros(()), _square(offset), offset.new_zeros(())
    for _ in range(_STEPS):
        step = (squared - distance) / slope.clamp(min=torch.finfo(values.dtype).tiny)
        fraction = (fraction + step.clamp(min=0)).clamp(max=1)
        target = torch.where(fraction < 1, ball.center + fraction.sqrt() * offset, values)
        nearest = target.clamp(low, high)
        slope, distance = _square(offset * (nearest == target)), _square(nearest - ball.center)
        if not ((fraction < 1) & (squared - distance > 8 * torch.finfo(values.dtype).eps * squared)).any():
            break
    return nearest


def _square(offsets: Tensor) -> Tensor:
    """(A, 1, ...): the squared length of offsets (A, ...)."""
    return offsets.square().sum(tuple(range(1, offsets.dim())), keepdim=True)
