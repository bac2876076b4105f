"""Examples of a scene, and the light, shape and colors with which they are rendered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from renderer.camera import Camera
from renderer.mesh import Mesh
from renderer.short_repr import ShortRepr
from renderer.validation import as_tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Fields of `Conditions` whose second axis is the vertices of a mesh. `Conditions.row` cuts it to
# the number of vertices of a mesh.
OF_VERTICES = ("vertices",)
# Fields of `Conditions` whose second axis is the faces of a mesh.
OF_FACES = ("albedo", "gloss", "hue")


@dataclass(frozen=True)
class Example:
    """Example of a scene: an object in front of a background, seen from V cameras.

    Attributes:
        object: Index of the object among the objects of the scene.
        cameras: The V cameras.
        background: Index of the background among the backgrounds of the scene.
        exposure: Factor that multiplies the light of the scene.
    """

    object: int
    cameras: tuple[Camera, ...]
    background: int
    exposure: float = 1.0


@dataclass(frozen=True, repr=False)
class Conditions(ShortRepr):
    """Light, shape and colors with which A examples are rendered.

    N and F are the numbers of vertices and faces of the largest mesh of the scene. A smaller mesh
    uses only the first of the N or F entries. A field that is None changes nothing in the scene.

    Attributes:
        light: RGB coefficients of all lights in the scene's basis, shape (A, coefficients, 3).
        vertices: Positions of the vertices, shape (A, N, 3).
        albedo: Linear RGB that is added to the albedo of each face, shape (A, F, 3).
        pixels: Offsets that are added to the pixel values of the V images, shape
            (A, V, 3, size, size).
        positions: Positions of the L lamps, shape (A, L, 3).
        cameras: Change of the polar angle in degrees, change of the azimuth in degrees, and
            change of the logarithm of the distance, shape (A, 3). They apply to all V cameras of
            an example.
        gloss: Roughness, metallic and specular factor of each face, shape (A, F, 3), or of all
            faces, shape (A, 1, 3). Textures of gloss are multiplied by them.
        hue: Angle in degrees by which the hue of the albedo of each face is turned, after the
            addition of `albedo`, shape (A, F).
    """

    light: Float[Tensor, "A coefficients 3"]
    vertices: Float[Tensor, "A N 3"] | None = None
    albedo: Float[Tensor, "A F 3"] | None = None
    pixels: Float[Tensor, "A V 3 size size"] | None = None
    positions: Float[Tensor, "A L 3"] | None = None
    cameras: Float[Tensor, "A 3"] | None = None
    gloss: Float[Tensor, "A F 3"] | Float[Tensor, "A 1 3"] | None = None
    hue: Float[Tensor, "A F"] | None = None

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if values is not None and not isinstance(values, Tensor):
                object.__setattr__(self, name, as_tensor(name, values))

    def row(self, index: int, mesh: Mesh) -> Conditions:
        """Return the conditions of one example, without the dimension of the examples.

        Args:
            index: Index of the example in the first dimension of all fields.
            mesh: Mesh of the example. Entries of vertices and faces are cut to the numbers of
                its vertices and faces.
        """
        rows = {}
        for name, values in vars(self).items():
            if values is None:
                continue
            row = values[index]
            if name in OF_VERTICES:
                row = row[: len(mesh.vertices)]
            elif name in OF_FACES:
                row = row[: len(mesh.faces)]
            rows[name] = row
        return Conditions(**rows)
