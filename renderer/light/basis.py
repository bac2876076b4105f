"""What lights are made of. An image is linear in any light of fixed place, so that each of these has operators."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from renderer.errors import require_range
from renderer.light.convex import Ball, nearest_in_box
from renderer.light.harmonics import MAX_DEGREE, basis, irradiance_basis, nonzero_coefficients


class LightBasis(ABC):
    """`size` functions of light; a light is a coefficient (size, 3) of each, RGB. Equal ones have equal fields.

    name: in files and messages. signed: whether coefficients that nothing can emit are of use, too.
    """

    name: ClassVar[str]
    signed: ClassVar[bool] = False

    @property
    @abstractmethod
    def size(self) -> int:
        """How many functions there are."""

    @abstractmethod
    def project_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """The light (..., size, 3) nearest to the coefficients that something can emit.

        within: for coefficients (A, size, 3), a ball that it is to lie in; its centers are such lights.
        """


class EnvironmentBasis(LightBasis):
    """Light from so far away that all of a scene is in the same."""

    @property
    @abstractmethod
    def nonzero(self) -> Tensor:
        """(K,) ascending indices of those that reach a diffuse surface under an open sky."""

    @abstractmethod
    def irradiance(self, normals: Tensor) -> Tensor:
        """(N, K) at unit normals (N, 3), per unit of each nonzero coefficient."""

    @abstractmethod
    def radiance(self, directions: Tensor) -> Tensor:
        """(N, size) that comes from unit directions (N, 3), per unit of each coefficient."""


class LightPaths(NamedTuple):
    """E connections from lights to surface points. point, function: (E,) int64, the surface point and the function of
    the basis. source: (E, 3), where the light starts. irradiance: (E,) per unit of the function's coefficient,
    differentiable in the points and normals; which connections there are is held fixed."""

    point: Tensor
    function: Tensor
    source: Tensor
    irradiance: Tensor


class LocalBasis(LightBasis):
    """Light from places, which throws shadows. Outside of it there is none, so that no coefficient is negative.

    power: the largest coefficient.
    """

    power: float

    def project_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        return nearest_in_box(coefficients, 0, self.power, within)

    @abstractmethod
    def connect(self, points: Tensor, normals: Tensor) -> LightPaths:
        """The paths to surface points (S, 3) of unit normals (S, 3), occlusion ignored."""


@dataclass(frozen=True)
class SumBasis:
    """Lights of several bases at once: the coefficients of one after the other."""

    parts: tuple[EnvironmentBasis | LocalBasis, ...]

    def __str__(self) -> str:
        return " and ".join(map(str, self.parts))

    @property
    def name(self) -> str:
        return "+".join(part.name for part in self.parts)

    @property
    def signed(self) -> bool:
        return any(part.signed for part in self.parts)

    @property
    def size(self) -> int:
        return sum(part.size for part in self.parts)

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """That of each."""
        own = coefficients.split([part.size for part in self.parts], dim=-2)
        return torch.cat([part.project_nonnegative(each) for part, each in zip(self.parts, own, strict=True)], dim=-2)


Basis = EnvironmentBasis | LocalBasis | SumBasis


def parts_of(basis: Basis) -> list[tuple[slice, EnvironmentBasis | LocalBasis]]:
    """(the coefficients of, each) basis that is no sum, in order."""
    found, first = [], 0
    for part in basis.parts if isinstance(basis, SumBasis) else (basis,):
        found.append((slice(first, first + part.size), part))
        first += part.size
    return found


@dataclass(frozen=True)
class Harmonics(EnvironmentBasis):
    """Environment light as real spherical harmonics. Any coefficients render, negative radiance included (the paper's);
    only such exist whose radiance is nowhere negative."""

    degree: int = 6

    name = "harmonics"
    signed = True

    def __post_init__(self) -> None:
        require_range("the degree of harmonics", self.degree, 0, MAX_DEGREE)

    def __str__(self) -> str:
        return f"{self.name} of degree {self.degree}"

    @property
    def size(self) -> int:
        return (self.degree + 1) ** 2

    @property
    def nonzero(self) -> Tensor:
        return nonzero_coefficients(self.degree)

    def irradiance(self, normals: Tensor) -> Tensor:
        return irradiance_basis(normals, self.degree)

    def radiance(self, directions: Tensor) -> Tensor:
        return basis(directions, self.degree)

    def project_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        from renderer.light.nonnegative import project_nonnegative  # scipy's optimizers take long to import

        return project_nonnegative(coefficients, within)


HARMONICS = Harmonics()


def with_local_lights(sky: Tensor, placed: Sequence[tuple[LocalBasis, Tensor]]) -> tuple[Basis, Tensor]:
    """(basis, coefficients (size, 3)) of the sky in harmonics and of lights in the scene, each with its own."""
    if not placed:
        return HARMONICS, sky
    coefficients = [own.to(sky) for _, own in placed]
    return SumBasis((HARMONICS, *(basis for basis, _ in placed))), torch.cat([sky, *coefficients])
