"""Examples of a scene, and the light, shape and colors with which they are rendered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from renderer.camera import Camera
from renderer.geometry.mesh import Mesh
from renderer.validation import as_tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Names of the fields of `Conditions` that have a row for each vertex of a mesh. `Conditions.row`
# cuts them to the vertices of one mesh.
OF_VERTICES = ("vertices",)
# Names of the fields that have a row for each face.
OF_FACES = ("albedo", "gloss", "hue")


@dataclass(frozen=True)
class Example:
    """Example of a scene: an object from V cameras in front of a background.

    Attributes:
        object: The index of the object in the scene's list.
        cameras: The V cameras.
        background: The index of the background in the scene's list.
        exposure: The factor of the light.
    """

    object: int
    cameras: tuple[Camera, ...]
    background: int
    exposure: float = 1.0


@dataclass(frozen=True)
class Conditions:
    """Light, shape and colors with which A examples are rendered.

    N and F are the numbers of vertices and faces of the largest mesh of the scene. A smaller mesh
    uses only the first rows. A field that is None leaves the scene as it is.

    Attributes:
        light: The coefficients of the scene's basis, shape (A, coefficients, 3).
        vertices: The vertices, shape (A, N, 3). None for those of the meshes.
        albedo: Linear RGB that is added to the albedo of each face, shape (A, F, 3).
        pixels: Offsets that are added to the pixel values of the V images, shape
            (A, V, 3, size, size).
        positions: The positions of the L lamps, shape (A, L, 3). None for those of the basis.
        cameras: Changes of the polar angle and the azimuth (in degrees) and of the logarithm of
            the distance. All V cameras of an example are changed alike, shape (A, 3).
        gloss: Roughness, metallic and specular factor of each face, shape (A, F, 3), or of all
            faces, shape (A, 1, 3). Textures of gloss multiply them.
        hue: The angle in degrees by which the hue of a changed albedo is turned, shape (A, F).
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
        """Return the conditions of one example, without the first dimension.

        Args:
            index: The row of the example in the conditions.
            mesh: The mesh of the example. Rows beyond its vertices and faces are left out.

        Returns:
            The conditions.
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
