"""Bases of light: sets of functions whose weighted sums are the lights of one kind.

The weights are called the coefficients of a light. There are three for each
function, for red, green and blue. If light sources do not move, an image is
linear in the coefficients. A transfer operator can therefore be computed for each
basis.

Environment light has the basis `Harmonics`. Local light comes from sources within
the scene, such as lamps. Each kind of local light is a subclass of `LocalBasis` in
a module of its own, such as light/lamps.py. CONTRIBUTING.md describes how to add a
kind.

In shapes, `size` is the number of functions of a basis.
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
    """Part of a basis that is environment light.

    Attributes:
        rows: Slice of the coefficients of the whole basis that belong to this
            part.
        basis: Basis of this part.
    """

    rows: slice
    basis: Harmonics


class LocalPart(NamedTuple):
    """Part of a basis that is one kind of local light.

    Attributes:
        rows: Slice of the coefficients of the whole basis that belong to this
            part.
        basis: Basis of this part.
    """

    rows: slice
    basis: LocalBasis


class Basis(ABC):
    """Set of functions whose weighted sums are the lights of one kind.

    The weights are RGB coefficients, shape (size, 3).
    """

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of functions."""

    @property
    def environment(self) -> EnvironmentPart | None:
        """Part of this basis that is environment light, or None."""
        return None

    @property
    def local_lights(self) -> list[LocalPart]:
        """Parts of this basis that are local lights, in the order of their coefficients."""
        return []

    @property
    def movable_light(self) -> LocalPart | None:
        """First part of this basis that is a movable local light, or None."""
        return next((part for part in self.local_lights if part.basis.is_movable), None)

    @abstractmethod
    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Replace coefficients by those of a light that can exist, without negative radiance.

        Args:
            coefficients: Coefficients, shape (..., size, 3).

        Returns:
            Coefficients, shape (..., size, 3).
        """

    def moved(self, positions: Tensor) -> Self:
        """Return a copy in which movable lights are at other positions.

        Args:
            positions: Positions of the L movable lights in world axes,
                shape (L, 3).

        Returns:
            The copy. A basis without movable lights returns itself.
        """
        return self

    def picture(self, coefficients: Tensor) -> Tensor | None:
        """Convert coefficients to an image, if a light of this kind projects an image.

        Args:
            coefficients: Coefficients, shape (size, 3).

        Returns:
            Image in [0, 1], shape (H, W, 3), or None.
        """
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
        """Check the degree."""
        require_whole("degree", self.degree)
        require_range("the degree of harmonics", self.degree, 0, MAX_DEGREE)

    def __str__(self) -> str:
        return f"{self.name} of degree {self.degree}"

    @property
    def size(self) -> int:
        """Number of harmonics."""
        return (self.degree + 1) ** 2

    @property
    def environment(self) -> EnvironmentPart:
        """These harmonics, with the rows of all coefficients."""
        return EnvironmentPart(slice(0, self.size), self)

    @property
    def nonzero(self) -> Tensor:
        """Ascending indices of the K functions that change the irradiance, shape (K,).

        All other functions have no effect on a diffuse surface without shadows.
        """
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
        # Shape (K, N). Transposing at the end is faster than filling columns.
        by_function = torch.stack(rows).to(normals.dtype) * factors[:, None]
        return by_function.T.contiguous()

    def radiance(self, directions: Tensor) -> Tensor:
        """Compute the radiance from N directions per unit of each coefficient.

        Args:
            directions: Directions toward the light, shape (N, 3).

        Returns:
            Radiance, shape (N, size).
        """
        return basis(directions, self.degree)

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Replace coefficients by a light without negative radiance and with the same mean.

        Of all such lights, the result has the most similar irradiance.

        Args:
            coefficients: Coefficients, shape (..., size, 3).

        Returns:
            Coefficients, shape (..., size, 3).
        """
        # The module is imported here because it imports SciPy's optimizers, which takes
        # long.
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


# Default basis of environment light, and its degree and number of coefficients.
HARMONICS = Harmonics()
DEGREE = HARMONICS.degree
COEFFICIENTS = HARMONICS.size


class LightPaths(NamedTuple):
    """E straight paths of light from local lights to surface points.

    Attributes:
        point: Index of the surface point at the end of each path, int64,
            shape (E,).
        function: Index of the basis function whose light each path carries,
            int64, shape (E,).
        source: Position of the start of each path in world axes, shape (E, 3).
        irradiance: Irradiance of the surface point per unit of the function's
            coefficient, shape (E,). It is differentiable with respect to the
            points and normals. The choice of the paths is not differentiable.
    """

    point: Tensor
    function: Tensor
    source: Tensor
    irradiance: Tensor


class LocalBasis(Basis):
    """Basis of light from sources within the scene, which casts shadows and does not bounce.

    A subclass is a frozen dataclass. The function `nb.render` accepts an
    instance as a light.

    Attributes:
        name: Name of this kind of light in settings, in file names and in
            messages.
        allow_negative: True if coefficients may be negative.
        is_movable: True if the sources can be at other positions than
            `source_positions`. `connect` and `moved` then accept positions.
        power: Largest coefficient. The smallest coefficient is 0.
    """

    name: ClassVar[str]
    allow_negative: ClassVar[bool] = False
    is_movable: ClassVar[bool] = False
    power: float

    @classmethod
    @abstractmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        """Create the basis and the coefficients that settings describe.

        Args:
            settings: The settings of this kind of light in `augment.settings`, with
                angles in degrees.

        Returns:
            The basis, and the coefficients (size, 3) that attacks begin with.

        Raises:
            InputError: If a setting is out of range.
        """

    def source_positions(self) -> Tensor:
        """Return the positions of the L sources of a movable light, shape (L, 3)."""
        raise NotImplementedError

    @abstractmethod
    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None = None
    ) -> LightPaths:
        """Find the paths from the sources to S surface points, as if nothing blocked them.

        Args:
            points: Surface points in world axes, shape (S, 3).
            normals: Unit normals at the points, shape (S, 3).
            positions: Positions to which the L sources have moved, shape (L, 3).
                None uses the positions of the basis. Only a movable basis accepts
                positions.

        Returns:
            Paths. Their irradiance is differentiable with respect to all
            arguments.
        """

    @abstractmethod
    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        """Create the entries of Mitsuba emitters that give the same light.

        A diffuse surface reflects albedo / π times the irradiance in Mitsuba, and
        albedo times the irradiance in this project. The emitters are brighter to
        compensate for this.

        Args:
            coefficients: Coefficients of the light, shape (size, 3).
            albedo_scale: Factor for the albedo of the mesh. The emitters are
                multiplied by it, because the materials in Mitsuba are not.

        Returns:
            Entry of a Mitsuba scene for each emitter (see
            `renderer.io.mitsuba_entries`).
        """

    @property
    def local_lights(self) -> list[LocalPart]:
        """This light as the only entry, with the rows of all coefficients."""
        return [LocalPart(slice(0, self.size), self)]

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Clamp coefficients to [0, power], see `Basis.project_nonnegative`."""
        return self.nearest_nonnegative(coefficients)

    def nearest_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest coefficients in [0, power], also within a ball.

        Args:
            coefficients: Coefficients, shape (..., size, 3), or (A, size, 3) if
                `within` is given.
            within: Ball in which the result must lie, or None.

        Returns:
            Coefficients of the same shape.
        """
        return nearest_in_box(coefficients, 0, self.power, within)


@dataclass(frozen=True)
class SumBasis(Basis):
    """Basis of lights that are sums of lights of several bases.

    Attributes:
        parts: Bases, at most one of which is environment light. The coefficients
            of the second basis follow those of the first one, and so on.

    Raises:
        InputError: If two parts are environment light.
    """

    parts: tuple[Harmonics | LocalBasis, ...]

    def __post_init__(self) -> None:
        """Check that at most one part is an environment light."""
        if sum(part.environment is not None for part in self.parts) > 1:
            raise InputError(
                "parts has two environment lights: use one, and add the coefficients of both"
            )

    def __str__(self) -> str:
        return " and ".join(map(str, self.parts))

    @property
    def size(self) -> int:
        """Number of functions of all parts together."""
        return sum(part.size for part in self.parts)

    @property
    def environment(self) -> EnvironmentPart | None:
        """Environment light of the part that has one, with its rows in the coefficients."""
        for rows, part in self._rows_of_parts():
            if part.environment is not None:
                return EnvironmentPart(rows, part.environment.basis)
        return None

    @property
    def local_lights(self) -> list[LocalPart]:
        """Lamps and projectors of all parts, with their rows in the coefficients."""
        return [
            LocalPart(rows, light.basis)
            for rows, part in self._rows_of_parts()
            for light in part.local_lights
        ]

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Apply `project_nonnegative` to the coefficients of each part."""
        projected = [
            part.project_nonnegative(coefficients[..., rows, :])
            for rows, part in self._rows_of_parts()
        ]
        return torch.cat(projected, dim=-2)

    def moved(self, positions: Tensor) -> Self:
        """Return a copy in which the movable lights of all parts are at other positions.

        Args:
            positions: Positions of the L movable lights in world axes,
                shape (L, 3).
        """
        return replace(self, parts=tuple(part.moved(positions) for part in self.parts))

    def _rows_of_parts(self) -> Iterator[tuple[slice, Harmonics | LocalBasis]]:
        """List the parts with the slices of their coefficients.

        Yields:
            Slice of the coefficients, and part.
        """
        first = 0
        for part in self.parts:
            yield slice(first, first + part.size), part
            first += part.size


def parts_of(basis: Basis) -> list[EnvironmentPart | LocalPart]:
    """List the environment light and the local lights of a basis.

    Args:
        basis: Basis of all lights.

    Returns:
        Parts in the order of their coefficients.
    """
    environment = [] if basis.environment is None else [basis.environment]
    return sorted([*environment, *basis.local_lights], key=lambda part: part.rows.start)


def harmonics_of(basis: Basis) -> Harmonics:
    """Return the harmonics of a basis with environment light.

    Args:
        basis: Basis with environment light, as each scene has one.
    """
    environment = basis.environment
    assert environment is not None
    return environment.basis


class SplitLight(NamedTuple):
    """Light that is divided into environment light and local lights.

    Attributes:
        environment: SH coefficients of the environment light,
            shape ((degree + 1)², 3). None without environment light.
        local_lights: Basis of each local light, with its coefficients,
            shape (size, 3).
    """

    environment: Tensor | None
    local_lights: list[tuple[LocalBasis, Tensor]]

    @property
    def basis(self) -> SumBasis:
        """Basis of all lights, with the environment light first."""
        environment = [] if self.environment is None else [Harmonics(degree_of(self.environment))]
        return SumBasis((*environment, *(basis for basis, _ in self.local_lights)))


def split_light(basis: Basis, coefficients: Tensor) -> SplitLight:
    """Divide the coefficients of a basis into environment light and local lights.

    Args:
        basis: Basis of all lights.
        coefficients: Coefficients of the basis, shape (size, 3).

    Returns:
        Coefficients of the environment light, and local lights with their
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
    """Combine environment light and local lights to one basis with coefficients.

    Args:
        sky: SH coefficients of environment light, shape ((degree + 1)², 3).
        lights: Bases of local lights with their coefficients, shape (size, 3)
            each.

    Returns:
        Basis of all lights, with the environment light first, and coefficients of
        this basis.
    """
    harmonics = Harmonics(degree_of(sky))
    if not lights:
        return harmonics, sky
    bases = [basis for basis, _ in lights]
    coefficients = [values.to(sky) for _, values in lights]
    return SumBasis((harmonics, *bases)), torch.cat([sky, *coefficients])
