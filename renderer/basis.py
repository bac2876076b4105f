"""What lights are made of. An image is linear in any light of fixed place, so that each of these has operators."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from renderer.harmonics import basis, irradiance_basis, live_coefficients


class Basis(Protocol):
    """`size` functions of light; a light is a coefficient (size, 3) of each, RGB. Equal ones have equal fields."""

    @property
    def name(self) -> str:
        """In files and messages."""

    @property
    def size(self) -> int:
        """How many functions there are."""

    @property
    def live(self) -> Tensor:
        """(K,) ascending indices of those that reach a diffuse surface under an open sky; see `Operator.kept`."""

    def irradiance(self, normals: Tensor) -> Tensor:
        """(N, K) at unit normals (N, 3), per unit of each live coefficient."""

    def radiance(self, directions: Tensor) -> Tensor:
        """(N, size) that comes from unit directions (N, 3), per unit of each coefficient."""

    def within_domain(self, coefficients: Tensor) -> Tensor:
        """Coefficients (..., size, 3) clamped to a box, or as they are where any light is allowed."""


@dataclass(frozen=True)
class Harmonics:
    """Distant light as real spherical harmonics; any coefficients, negative radiance included (the paper's)."""

    degree: int = 6

    name = "harmonics"

    def __str__(self) -> str:
        return f"{self.name} of degree {self.degree}"

    @property
    def size(self) -> int:
        return (self.degree + 1) ** 2

    @property
    def live(self) -> Tensor:
        return live_coefficients(self.degree)

    def irradiance(self, normals: Tensor) -> Tensor:
        return irradiance_basis(normals, self.degree)

    def radiance(self, directions: Tensor) -> Tensor:
        return basis(directions, self.degree)

    def within_domain(self, coefficients: Tensor) -> Tensor:
        return coefficients


HARMONICS = Harmonics()
