"""Bases of light: functions whose weighted sums are the lights of one kind.

The weights are the coefficients of a light. If its position is fixed, an image
is linear in them, so that operators can be computed for each basis.

Environment light has one basis, `Harmonics`. Each kind of light within the scene
is a subclass of `LocalBasis` in a module of its own, such as light/lamps.py and
light/projector.py. CONTRIBUTING.md describes how to add one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from renderer.errors import InputError, require_finite, require_range
from renderer.light.ball import Ball, nearest_in_box
from renderer.light.harmonics import (
    basis,
    degree_of,
    lambertian_factors,
    nonzero_coefficients,
    select_rows,
)
from renderer.settings import MAX_DEGREE
from renderer.validation import require_whole
from renderer.vectors import unit


class EnvironmentPart(NamedTuple):
    """The environment light of a basis.

    Attributes:
        rows: Its coefficients among those of the whole basis.
        basis: Its own basis.
    """

    rows: slice
    basis: Harmonics


class LocalPart(NamedTuple):
    """One local light of a basis.

    Attributes:
        rows: Its coefficients among those of the whole basis.
        basis: Its own basis.
    """

    rows: slice
    basis: LocalBasis


class Basis(ABC):
    """Functions whose sums, weighted with RGB coefficients (size, 3), are lights of one kind."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of functions."""

    @property
    def environment(self) -> EnvironmentPart | None:
        """Environment light of this basis, or None."""
        return None

    @property
    def local_lights(self) -> list[LocalPart]:
        """Lights within the scene, in the order of their coefficients."""
        return []

    @property
    def movable_light(self) -> LocalPart | None:
        """First light within the scene that can be moved, or None."""
        return next((part for part in self.local_lights if part.basis.is_movable), None)

    @abstractmethod
    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Project coefficients (..., size, 3) to those of light that can be emitted."""

    def moved(self, positions: Tensor) -> Self:
        """Return the basis with those of its lights that can be moved at positions (L, 3)."""
        return self

    def picture(self, coefficients: Tensor) -> Tensor | None:
        """Return the image (H, W, 3) in [0, 1] that coefficients (size, 3) show, or None."""
        return None


@dataclass(frozen=True)
class Harmonics(Basis):
    """Environment light as a sum of real spherical harmonics.

    The light comes from infinitely far away, so it is the same at each point of a
    scene. The number of functions is (degree + 1)².

    Attributes:
        degree: Degree of the harmonics, from 0 to 40.
        name: Name of this kind of light in files and messages.
        allow_negative: True, because coefficients with negative radiance are
            rendered, too, as in the paper. Such a light does not exist.

    Raises:
        InputError: If the degree is out of range.

    Example:
        >>> Harmonics(degree=2).size
        9
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
    def environment(self) -> EnvironmentPart:
        return EnvironmentPart(slice(0, self.size), self)

    @property
    def nonzero(self) -> Tensor:
        """Ascending indices of the functions that an unshadowed diffuse surface reflects, (K,)."""
        return nonzero_coefficients(self.degree)

    def irradiance(self, normals: Tensor) -> Tensor:
        """Compute the irradiance of surfaces per unit of each coefficient in `nonzero`.

        Args:
            normals: Unit normals of the surfaces, shape (N, 3).

        Returns:
            The irradiance, shape (N, K).

        Raises:
            InputError: If a normal is not finite.
        """
        require_finite(normals=normals)
        factors = lambertian_factors(self.degree)[self.nonzero].to(normals)
        rows = select_rows(unit(normals.double().T), self.nonzero.tolist())
        by_function = torch.stack(rows).to(normals.dtype) * factors[:, None]
        # A processor fills rows fastest, so that the matrix is transposed last.
        return by_function.T.contiguous()

    def radiance(self, directions: Tensor) -> Tensor:
        """Compute the radiance per unit of each coefficient, (N, size), from directions (N, 3)."""
        return basis(directions, self.degree)

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Project coefficients to light without negative radiance and with the same mean.

        Of such lights, the result has the most similar irradiance.

        Args:
            coefficients: Coefficients, shape (..., size, 3).

        Returns:
            Coefficients, shape (..., size, 3).
        """
        # The import of the optimizers of SciPy takes long.
        from renderer.light.nonnegative import project_nonnegative

        return project_nonnegative(coefficients)

    def nearest_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest coefficients of light without negative radiance.

        The mean radiance may change.

        Args:
            coefficients: Coefficients, shape (..., size, 3), or (A, size, 3) if
                `within` is given.
            within: Ball in which the result lies. Its centers must have no
                negative radiance.

        Returns:
            Coefficients of the same shape.
        """
        from renderer.light.nonnegative import nearest_nonnegative

        return nearest_nonnegative(coefficients, within)


HARMONICS = Harmonics()
# Degree and number of coefficients of environment light by default.
DEGREE = HARMONICS.degree
COEFFICIENTS = HARMONICS.size


class LightPaths(NamedTuple):
    """Straight paths of light from local lights to surface points.

    Attributes:
        point: Index of the surface point at the end of each path, int64, shape (E,).
        function: Index of the function of the basis that each path belongs to,
            int64, shape (E,).
        source: Position at which each path starts, shape (E, 3).
        irradiance: Irradiance per unit of the function's coefficient, shape (E,).
            It is differentiable in the points and normals. The choice of paths
            is not.
    """

    point: Tensor
    function: Tensor
    source: Tensor
    irradiance: Tensor


class LocalBasis(Basis):
    """Light from sources within the scene, which casts shadows and does not bounce.

    A subclass is a frozen dataclass. `nb.render` takes it as it is. Its
    name is that of its settings and of its file in the folder of an adversary.

    Attributes:
        name: Name of this kind of light, in files, settings and messages.
        allow_negative: Whether coefficients may be negative.
        is_movable: Whether `connect` and `moved` take other positions than
            `source_positions`.
        power: The largest coefficient. The smallest is 0.
    """

    name: ClassVar[str]
    allow_negative: ClassVar[bool] = False
    is_movable: ClassVar[bool] = False
    power: float

    @classmethod
    @abstractmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        """Create the light that settings describe.

        Args:
            settings: The settings of this kind of light in `augment.settings`, with
                angles in degrees.

        Returns:
            The basis, and the coefficients (size, 3) that attacks begin with.

        Raises:
            InputError: If a setting is out of range.
        """

    def source_positions(self) -> Tensor:
        """Return the positions (L, 3) of the sources of a movable light."""
        raise NotImplementedError

    @abstractmethod
    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None = None
    ) -> LightPaths:
        """Find the paths from the lights to surface points, without regard to occlusion.

        Args:
            points: Surface points, shape (S, 3).
            normals: Unit normals there, shape (S, 3).
            positions: Positions of the lights, shape (L, 3). The default is those
                of the basis. Only a movable basis takes others.

        Returns:
            The paths, whose irradiance is differentiable in all arguments.
        """

    @abstractmethod
    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        """Describe the light for Mitsuba.

        Args:
            coefficients: Coefficients of the light, shape (size, 3).
            albedo_scale: Factor of the light, which stands for that of the albedo.

        Returns:
            An entry of a Mitsuba scene for each emitter (see
            `renderer.io.mitsuba_entries`). Mitsuba reflects albedo / π of the
            irradiance, and this project all of it.
        """

    @property
    def local_lights(self) -> list[LocalPart]:
        return [LocalPart(slice(0, self.size), self)]

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Project coefficients to the nearest that can be emitted.

        Each light shows on its own where it is clamped.
        """
        return self.nearest_nonnegative(coefficients)

    def nearest_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest coefficients from 0 to `power`, as `Harmonics.nearest_nonnegative`."""
        return nearest_in_box(coefficients, 0, self.power, within)


@dataclass(frozen=True)
class SumBasis(Basis):
    """Lights of several bases at once.

    Attributes:
        parts: The bases, of which one at most is environment light. Their
            coefficients follow each other.

    Raises:
        InputError: If two parts are environment light.
    """

    parts: tuple[Harmonics | LocalBasis, ...]

    def __post_init__(self) -> None:
        if sum(part.environment is not None for part in self.parts) > 1:
            raise InputError("parts holds two environment lights: add their coefficients instead")

    def __str__(self) -> str:
        return " and ".join(map(str, self.parts))

    @property
    def size(self) -> int:
        return sum(part.size for part in self.parts)

    @property
    def environment(self) -> EnvironmentPart | None:
        for rows, part in self._rows_of_parts():
            if part.environment is not None:
                return EnvironmentPart(rows, part.environment.basis)
        return None

    @property
    def local_lights(self) -> list[LocalPart]:
        return [
            LocalPart(rows, light.basis)
            for rows, part in self._rows_of_parts()
            for light in part.local_lights
        ]

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Project the coefficients of each part."""
        projected = [
            part.project_nonnegative(coefficients[..., rows, :])
            for rows, part in self._rows_of_parts()
        ]
        return torch.cat(projected, dim=-2)

    def moved(self, positions: Tensor) -> Self:
        return replace(self, parts=tuple(part.moved(positions) for part in self.parts))

    def _rows_of_parts(self) -> Iterator[tuple[slice, Harmonics | LocalBasis]]:
        """Yield each part after its rows of coefficients."""
        first = 0
        for part in self.parts:
            yield slice(first, first + part.size), part
            first += part.size


def parts_of(basis: Basis) -> list[EnvironmentPart | LocalPart]:
    """Return the parts of a basis in the order of their coefficients, each with its rows."""
    environment = [] if basis.environment is None else [basis.environment]
    return sorted([*environment, *basis.local_lights], key=lambda part: part.rows.start)


def harmonics_of(basis: Basis) -> Harmonics:
    """Return the harmonics of the environment light, which a scene always has."""
    environment = basis.environment
    assert environment is not None
    return environment.basis


class SplitLight(NamedTuple):
    """A light, divided into environment light and local lights.

    Attributes:
        environment: Coefficients ((degree + 1)², 3), None without such light.
        local_lights: Each basis with its coefficients (size, 3).
    """

    environment: Tensor | None
    local_lights: list[tuple[LocalBasis, Tensor]]

    @property
    def basis(self) -> SumBasis:
        """Basis of all lights, with that of the environment light first."""
        environment = [] if self.environment is None else [Harmonics(degree_of(self.environment))]
        return SumBasis((*environment, *(basis for basis, _ in self.local_lights)))


def split_light(basis: Basis, coefficients: Tensor) -> SplitLight:
    """Divide coefficients (size, 3) of a basis into environment light and local lights.

    Args:
        basis: Basis of all lights.
        coefficients: Coefficients of the basis, shape (size, 3).

    Returns:
        The coefficients of the environment light, and each local light with its
        coefficients.
    """
    environment = basis.environment
    return SplitLight(
        environment=None if environment is None else coefficients[environment.rows],
        local_lights=[(part.basis, coefficients[part.rows]) for part in basis.local_lights],
    )


def with_local_lights(
    sky: Tensor, lights: Sequence[tuple[LocalBasis, Tensor]]
) -> tuple[Basis, Tensor]:
    """Join environment light and local lights.

    Args:
        sky: Coefficients of environment light, shape ((degree + 1)², 3).
        lights: Local lights, each with its coefficients (size, 3).

    Returns:
        The basis of all lights, the sky's first, and their coefficients.
    """
    harmonics = Harmonics(degree_of(sky))
    if not lights:
        return harmonics, sky
    bases = [basis for basis, _ in lights]
    coefficients = [values.to(sky) for _, values in lights]
    return SumBasis((harmonics, *bases)), torch.cat([sky, *coefficients])
