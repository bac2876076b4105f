"""Bases of light: sets of functions whose weighted sums are the lights of one kind.

The weights are called the coefficients of a light. There are three for each
function, for red, green and blue. If light sources do not move, an image is
linear in the coefficients. A transfer operator can therefore be computed for each
basis.

Environment light has the basis `Harmonics`. Local light comes from sources within
the scene, such as lamps. Each kind of local light is a subclass of `LocalBasis` in
light/lamps.py or in a module of its own. CONTRIBUTING.md describes how to add a
kind.

In shapes, `size` is the number of functions of a basis.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, ClassVar, NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderer.light import harmonics, nonnegative
from renderer.vectors import Ball, nearest_in_box, unit


class Part(NamedTuple):
    """One of the lights of a basis: environment light, lamps or a projector.

    Attributes:
        rows: Slice that selects the coefficients of this light from the
            coefficients of all lights, shape (size, 3).
        basis: Basis of this light, `Harmonics` for environment light.
    """

    rows: slice
    basis: Any


class Basis(ABC):
    """Set of functions whose weighted sums are the lights of one kind.

    The weights are RGB coefficients, shape (size, 3).
    """

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of basis functions, which is the number of RGB coefficients."""

    @property
    def lights(self) -> list[Part]:
        """All lights, in the order of their coefficients."""
        return [Part(slice(0, self.size), self)]

    @property
    def environment(self) -> Part | None:
        """Environment light of this basis, or None if all its lights are local."""
        return next((part for part in self.lights if isinstance(part.basis, Harmonics)), None)

    @property
    def local_lights(self) -> list[Part]:
        """Lamps and projectors of this basis, in the order of their coefficients."""
        return [part for part in self.lights if isinstance(part.basis, LocalBasis)]

    @property
    def movable_light(self) -> Part | None:
        """First local light of this basis whose sources can be moved, or None."""
        return next((part for part in self.local_lights if part.basis.is_movable), None)

    @abstractmethod
    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Replace lights by similar lights that can exist, without negative radiance.

        Args:
            coefficients: RGB coefficients of the lights, shape (..., size, 3).

        Returns:
            RGB coefficients without negative radiance, shape (..., size, 3).
        """

    def moved(self, positions: Tensor) -> Self:
        """Return a copy of this basis in which the movable light sources are moved.

        Args:
            positions: New positions of the L movable light sources in world axes,
                shape (L, 3).

        Returns:
            The copy. A basis without movable light sources returns itself.
        """
        return self

    def picture(self, coefficients: Tensor) -> Tensor | None:
        """Convert coefficients to the image that a projector shows.

        Args:
            coefficients: RGB coefficients, shape (size, 3).

        Returns:
            Image in [0, 1], shape (H, W, 3). None if the light is no projector.
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
    """

    degree: int = 6

    name: ClassVar[str] = "harmonics"
    allow_negative: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the degree."""
        harmonics.require_degree(self.degree)

    def __str__(self) -> str:
        return f"{self.name} of degree {self.degree}"

    @property
    def size(self) -> int:
        """Number of harmonics."""
        return (self.degree + 1) ** 2

    @property
    def nonzero(self) -> Tensor:
        """Ascending indices of the K harmonics that change the irradiance, shape (K,).

        All other harmonics have no effect on a diffuse surface without shadows.
        """
        return harmonics.nonzero_coefficients(self.degree)

    def irradiance(self, normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N K"]:
        """Compute the irradiance of N surfaces from each harmonic that changes it.

        Column k is for a coefficient of 1 of the harmonic `nonzero[k]`.
        """
        # One row for each of K harmonics. Transposing at the end is faster than filling
        # columns.
        _, irradiance = harmonics.diffuse_basis(unit(normals.double().T), self.degree)
        return irradiance.T.to(normals.dtype).contiguous()

    def radiance(self, directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N size"]:
        """Compute the radiance of each harmonic from N directions."""
        return harmonics.basis(directions, self.degree)

    def project_nonnegative(
        self, coefficients: Float[Tensor, "... size 3"]
    ) -> Float[Tensor, "... size 3"]:
        """Replace lights by the most similar lights without negative radiance.

        The new light has the same mean radiance. Of all such lights, its irradiance
        is the closest to the irradiance of the given light.
        """
        return nonnegative.project_nonnegative(coefficients)

    def nearest_nonnegative(
        self, coefficients: Float[Tensor, "... size 3"], within: Ball | None = None
    ) -> Tensor:
        """Replace lights by the nearest lights without negative radiance.

        The distance between lights is the Euclidean distance of their
        coefficients. The mean radiance may change. With `within`, one ball for each light,
        centers must have no negative radiance.
        """
        return nonnegative.nearest_nonnegative(coefficients, within)


# Default basis of environment light.
HARMONICS = Harmonics()
# Degree of the default environment light.
DEGREE = HARMONICS.degree
# Number of SH coefficients of the default environment light.
COEFFICIENTS = HARMONICS.size


class LightPaths(NamedTuple):
    """E straight paths of light from local lights to surface points.

    Attributes:
        point: Index of the surface point at the end of each path, int64,
            shape (E,).
        function: Index of the basis function (lamp, or pixel of a projector) from
            which each path comes, int64, shape (E,).
        source: Position of the start of each path in world axes, shape (E, 3).
        irradiance: Irradiance of the surface point per unit of the function's
            coefficient, shape (E,). It is differentiable with respect to the
            points and normals. The choice of the paths is not differentiable.
    """

    point: Int[Tensor, " E"]
    function: Int[Tensor, " E"]
    source: Float[Tensor, "E 3"]
    irradiance: Float[Tensor, " E"]


class LocalBasis(Basis):
    """Basis of light from sources within the scene, which casts shadows and does not bounce.

    A subclass is a frozen dataclass. The function `nb.render` accepts an
    instance as a light.

    Attributes:
        name: Name of this kind of light in settings, in file names and in
            messages.
        allow_negative: True if coefficients may be negative.
        is_movable: True if the sources have `positions` and can move to others. `connect` and
            `moved` then accept positions.
        power: Largest coefficient. The smallest coefficient is 0.
    """

    name: ClassVar[str]
    allow_negative: ClassVar[bool] = False
    is_movable: ClassVar[bool] = False
    power: float

    @classmethod
    @abstractmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        """Create a light, that is, a basis and its coefficients, from settings.

        Args:
            settings: The settings of this kind of light in `augment.settings`, with
                angles in degrees.

        Returns:
            A tuple of
            - the basis;
            - its RGB coefficients before an attack, shape (size, 3).

        Raises:
            InputError: If a setting is out of range.
        """

    @abstractmethod
    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None, lobe_width: float
    ) -> LightPaths:
        """Find the straight paths from light sources to S surface points, without shadows.

        Args:
            points: Surface points in world axes, shape (S, 3).
            normals: Unit normals at the points, shape (S, 3).
            positions: Positions to which the L light sources have moved,
                shape (L, 3). None for their own `positions`. Only a basis with
                `is_movable` accepts positions.
            lobe_width: Smallest width α of the specular lobes at the points
                (`renderer.microfacets`). Infinite if they are matte.

        Returns:
            Paths, also those that an object blocks. Their irradiance is
            differentiable with respect to all arguments.
        """

    def arriving(
        self, light: Float[Tensor, "K C"], paths: LightPaths, points: Float[Tensor, "S 3"]
    ) -> Float[Tensor, "E C"]:
        """Return the coefficient of the light on each path to a surface point."""
        return light[paths.function]

    @abstractmethod
    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        """Create the descriptions of emitters with the same light for the renderer Mitsuba.

        A diffuse surface reflects albedo / π times the irradiance in Mitsuba, and
        albedo times the irradiance in this project. The emitters are brighter to
        compensate for this.

        Args:
            coefficients: RGB coefficients of the light, shape (size, 3).
            albedo_scale: Factor for the albedo of the mesh. Here it multiplies the
                light, which gives the same image.

        Returns:
            For each emitter, the dictionary that describes it in a Mitsuba scene.
        """

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Clamp RGB coefficients to the range from 0 to the `power` of this light source.

        A lamp or projector cannot emit less than nothing or more than its power.

        Args:
            coefficients: RGB coefficients of the lights, shape (..., size, 3).

        Returns:
            Clamped coefficients, shape (..., size, 3).
        """
        return self.nearest_nonnegative(coefficients)

    def nearest_nonnegative(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        """Replace coefficients by the nearest coefficients between 0 and `power`.

        Args:
            coefficients: RGB coefficients, shape (..., size, 3). With `within`, the
                shape is (A, size, 3).
            within: Norm balls, one for each of A lights, in which the results must
                lie, too. None for no ball.

        Returns:
            Nearest coefficients, in the same shape.
        """
        return nearest_in_box(coefficients, 0, self.power, within)


# A lamp or projector with its RGB coefficients (size, 3).
LitBasis = tuple[LocalBasis, Tensor]


@dataclass(frozen=True)
class SumBasis(Basis):
    """Basis of lights that are sums of lights of several bases.

    Attributes:
        parts: Bases, at most one of which is environment light. The coefficients
            of the second basis follow those of the first one, and so on.
    """

    parts: tuple[Harmonics | LocalBasis, ...]

    def __str__(self) -> str:
        return " and ".join(map(str, self.parts))

    @property
    def size(self) -> int:
        """Number of basis functions, summed over all bases in `parts`."""
        return sum(part.size for part in self.parts)

    @property
    def lights(self) -> list[Part]:
        """All lights, in the order of their coefficients."""
        ends = accumulate(basis.size for basis in self.parts)
        bases_and_ends = zip(self.parts, ends, strict=True)
        return [Part(slice(end - basis.size, end), basis) for basis, end in bases_and_ends]

    def project_nonnegative(self, coefficients: Tensor) -> Tensor:
        """Replace the coefficients of each light in `parts` by ones without negative radiance."""
        parts = [part.project_nonnegative(coefficients[..., at, :]) for at, part in self.lights]
        return torch.cat(parts, dim=-2)

    def moved(self, positions: Float[Tensor, "L 3"]) -> Self:
        """Return a copy of this basis in which the movable light sources are moved."""
        return replace(self, parts=tuple(part.moved(positions) for part in self.parts))


def harmonics_of(basis: Basis) -> Harmonics:
    """Return the spherical harmonics of the environment light of a basis."""
    environment = basis.environment
    assert environment is not None
    return environment.basis


class SplitLight(NamedTuple):
    """Light that is divided into environment light and local lights.

    Attributes:
        environment: SH coefficients of the environment light,
            shape ((degree + 1)², 3). None without environment light.
        local_lights: For each local light, its basis and its RGB coefficients,
            shape (size, 3).
    """

    environment: Tensor | None
    local_lights: list[LitBasis]

    @property
    def basis(self) -> SumBasis:
        """Basis of all lights, with the environment light first."""
        bases: list[Any] = [basis for basis, _ in self.local_lights]
        if self.environment is not None:
            bases.insert(0, Harmonics(harmonics.degree_of(self.environment)))
        return SumBasis(tuple(bases))


def split_light(basis: Basis, coefficients: Float[Tensor, "*views size 3"]) -> SplitLight:
    """Divide the coefficients of a basis into environment light and local lights."""
    environment = basis.environment
    return SplitLight(
        environment=None if environment is None else coefficients[..., environment.rows, :],
        local_lights=[(part.basis, coefficients[..., part.rows, :]) for part in basis.local_lights],
    )


def with_local_lights(sky: Tensor, lights: Sequence[LitBasis]) -> tuple[Basis, Tensor]:
    """Combine environment light and local lights to one basis with its coefficients.

    The environment light comes first.
    """
    if not lights:
        return Harmonics(harmonics.degree_of(sky)), sky
    coefficients = torch.cat([sky, *(values.to(sky) for _, values in lights)])
    return SplitLight(sky, list(lights)).basis, coefficients
