"""Triangle meshes with colors: the data class, normalizing, and subdividing for attacks that move vertices.

World axes are right-handed with z up. Colors stay as authored for display (sRGB-encoded); linear
light needs them decoded.
"""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from renderer.errors import InputError, describe, require_range
from renderer.geometry.normals import doubled_area_vectors, plain_face_normals, vertex_normals
from renderer.geometry.skin import Skin
from renderer.settings import MAX_VERTICES
from renderer.validation import as_array, require_whole

Y_UP_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
_KINDS = {  # NumPy's letters for the types that the arrays of a mesh may have
    "vertices": "fiu",
    "faces": "iu",
    "corner_colors": "fiu",
    "corner_uvs": "fiu",
    "texture_ids": "iu",
    "gloss": "fiu",
}
PER_FACE = ("faces", "corner_colors", "corner_uvs", "texture_ids", "gloss")
EDGES = ((0, 1), (1, 2), (2, 0))  # corners of a face
_QUARTERS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # corners 0 to 2 and the middles of the edges as 3 to 5


@dataclass(frozen=True)
class Mesh:
    """F triangles over V vertices, with colors held per corner so that seams need no split vertices.

    vertices       (V, 3) float64, world coordinates
    faces          (F, 3) int64, counter-clockwise seen from outside
    corner_colors  (F, 3, 3) float32, RGB in [0, 1], sRGB-encoded
    corner_uvs     (F, 3, 2) float32, origin at the bottom left of the texture; zeros where there is none
    texture_ids    (F,) int32, index into `textures`, -1 where there is none
    textures       tuple of (H, W, 3) uint8, sRGB-encoded, row 0 at the top
    gloss          (F, 3) float32: roughness, metallic and strength in [0, 1] (`renderer.Gloss`); None for a matte mesh
    gloss_textures tuple of (H, W, 2) uint8, for each of `textures`, that multiply roughness and metallic; or empty
    skin           the joints that carry the vertices, None without joints

    InputError: arrays of other shapes, no faces, faces of vertices that are not there.

    >>> square = Mesh.plain([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], color=(1, 0.5, 0))
    >>> square.face_areas().tolist(), square.face_normals()[0].tolist(), square.closed
    ([0.5, 0.5], [0.0, 0.0, 1.0], False)
    """

    vertices: np.ndarray
    faces: np.ndarray
    corner_colors: np.ndarray
    corner_uvs: np.ndarray
    texture_ids: np.ndarray
    textures: tuple[np.ndarray, ...] = ()
    gloss: np.ndarray | None = None
    gloss_textures: tuple[np.ndarray, ...] = ()
    skin: Skin | None = None

    def __post_init__(self) -> None:
        for name, kinds in _KINDS.items():
            value = getattr(self, name)
            if not isinstance(value, np.ndarray) and not (name == "gloss" and value is None):
                object.__setattr__(self, name, as_array(name, value, kinds))
        count = len(self.faces) if self.faces.ndim else 0
        vertex_count = len(self.vertices) if self.vertices.ndim else 0
        for name, shape in (
            ("vertices", (vertex_count, 3)),
            ("faces", (count, 3)),
            ("corner_colors", (count, 3, 3)),
            ("corner_uvs", (count, 3, 2)),
            ("texture_ids", (count,)),
            ("gloss", (count, 3)),
        ):
            values = getattr(self, name)
            if name == "gloss" and values is None:
                continue
            if values.shape != shape or values.dtype.kind not in _KINDS[name]:
                raise InputError(f"{name} must be numbers of shape {shape}, got {values.dtype} {values.shape}")
        require_range("the number of faces", count, 1, np.inf)
        if not 0 <= self.faces.min() <= self.faces.max() < vertex_count:
            raise InputError(f"faces name vertices that are not there: give indices from 0 to {vertex_count - 1}")
        for name, channels in (("textures", 3), ("gloss_textures", 2)):
            object.__setattr__(self, name, _as_textures(name, getattr(self, name), channels))
        if self.texture_ids.max() >= len(self.textures):
            raise InputError(f"texture_ids name textures that are not there: give indices below {len(self.textures)}")

    @staticmethod
    def plain(vertices: ArrayLike, faces: ArrayLike, color: ArrayLike = (1.0, 1.0, 1.0)) -> Mesh:
        """An untextured mesh. `color` is one RGB (3,) or one per vertex (V, 3), sRGB-encoded in [0, 1]."""
        vertices = np.array(as_array("vertices", vertices), dtype=np.float64)
        corners = as_array("faces", faces)
        with np.errstate(invalid="ignore"):  # NaN is refused below
            faces = corners.astype(np.int64)
        if not np.array_equal(faces, corners):
            raise InputError("faces holds numbers that are not whole: give indices of vertices")
        color = as_array("color", color).astype(np.float32)
        if not color.size or not (color.min() >= 0 and color.max() <= 1):
            raise InputError(f"color={reprlib.repr(color.tolist())}: give red, green and blue from 0 to 1")
        try:
            vertex_colors = np.broadcast_to(color, vertices.shape)
            corner_colors = vertex_colors.take(faces, axis=0, mode="clip")  # missing vertices are refused below
        except (TypeError, ValueError, OverflowError, IndexError) as error:
            raise InputError(f"vertices, faces and color ({error}): give (V, 3), (F, 3) and (3)") from error
        return Mesh(
            vertices=vertices,
            faces=faces,
            corner_colors=corner_colors,
            corner_uvs=np.zeros((len(faces), 3, 2), dtype=np.float32),
            texture_ids=np.full(len(faces), -1, dtype=np.int32),
        )

    def face_normals(self) -> np.ndarray:
        """(F, 3) unit normals, outward for counter-clockwise faces; the zero vector for zero-area faces."""
        return plain_face_normals(self.vertices, self.faces)

    def face_areas(self) -> np.ndarray:
        """(F,) areas in squared world units."""
        return np.linalg.norm(doubled_area_vectors(self.vertices, self.faces), axis=1) / 2

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """(V, 3) of `renderer.geometry.normals.vertex_normals`."""
        return vertex_normals(torch.from_numpy(self.vertices), torch.from_numpy(self.faces)).numpy()

    @cached_property
    def displayable(self) -> bool:
        """Whether all colors are in [0, 1]."""
        return bool(self.corner_colors.min() >= 0 and self.corner_colors.max() <= 1)  # NaN is not

    @cached_property
    def one_color_per_face(self) -> bool:
        """Whether the corners of each face have the same color."""
        return bool((self.corner_colors == self.corner_colors[:, :1]).all())

    def moved(self, vertices: np.ndarray) -> Mesh:
        """The mesh with vertices (V, 3) in place of its own, and its packed textures; without a skin."""
        mesh = replace(self, vertices=vertices, skin=None)
        mesh.__dict__["packed_textures"] = self.packed_textures  # which take long to pack
        return mesh

    @cached_property
    def packed_textures(self) -> tuple[np.ndarray, ...]:
        """Textures (H, W) int32, red, green and blue in the bits from 0, 8 and 16: one number is looked up faster."""
        return tuple(texture.astype(np.int32) @ np.array([1, 2**8, 2**16], dtype=np.int32) for texture in self.textures)

    @cached_property
    def closed(self) -> bool:
        """Whether no face is ever seen from behind: every part is watertight, its faces counter-clockwise from outside.
        Then each edge occurs once in either direction, and the faces that edges connect enclose a positive volume."""
        part = _closed_parts(self.faces.astype(np.int64).tobytes())
        first = (self.vertices - self.vertices.mean(axis=0))[self.faces[:, 0]]
        volumes = np.einsum("fi,fi->f", first, doubled_area_vectors(self.vertices, self.faces))
        return part is not None and bool((np.bincount(part, volumes) > 0).all())


@lru_cache(maxsize=1)  # for instances of a solid, which have the same faces
def _closed_parts(faces: bytes) -> np.ndarray | None:
    """(F,) the connected part of each face (F, 3) of int64, or None where an edge is not once in either direction."""
    from trimesh.graph import connected_component_labels  # trimesh takes half a second

    corners = np.frombuffer(faces, dtype=np.int64).reshape(-1, 3)
    edges, count = corners[:, EDGES].reshape(-1, 2), corners.max(initial=0) + 1
    forth, back = edges @ [count, 1], edges @ [1, count]
    by_forth, by_back = np.argsort(forth), np.argsort(back)
    if (np.diff(forth[by_forth]) == 0).any() or not np.array_equal(forth[by_forth], back[by_back]):
        return None
    return connected_component_labels(np.stack([by_forth, by_back], axis=1) // 3, node_count=len(corners))


def _as_textures(name: str, textures: object, channels: int) -> tuple[np.ndarray, ...]:
    """Convert textures to arrays (height, width, channels) of 8 bits."""
    expected = f"a list of arrays (height, width, {channels}) of uint8"
    if not isinstance(textures, list | tuple):
        raise InputError(f"{name} is {describe(textures)}: give {expected}")
    arrays = [as_array(name, texture) for texture in textures]
    for array in arrays:
        if array.ndim != 3 or array.shape[2] != channels or array.dtype != np.uint8:
            raise InputError(f"{name} holds {describe(array)}: give {expected}")
    unchanged = all(array is texture for array, texture in zip(arrays, textures, strict=True))
    return textures if isinstance(textures, tuple) and unchanged else tuple(arrays)


def require_mesh(name: str, value: object) -> None:
    """Check that an argument is a mesh whose colors can be displayed.

    Raises:
        InputError: If it is of another type, such as a path, or a color is not in [0, 1].
    """
    if not isinstance(value, Mesh):
        path = repr(value) if isinstance(value, str) else "path"
        advice = f"give a renderer.Mesh, such as renderer.load_mesh({path}) or renderer.Mesh.plain(vertices, faces)"
        raise InputError(f"{name} is {describe(value)}: {advice}")
    if not value.displayable:
        raise InputError(f"{name}: its corner_colors hold values beyond [0, 1]: divide colors of 8 bits by 255")


def concatenate(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh with the faces of all, in order; vertices are not merged. The joints are the first one's."""
    faces, texture_ids, vertices, textures = [], [], 0, 0
    matte, plain = np.array([[1, 0, 0]], dtype=np.float32), np.full((1, 1, 2), 255, dtype=np.uint8)
    gloss, factors = None, tuple[np.ndarray, ...]()
    if any(mesh.gloss is not None for mesh in meshes):
        rows = [matte.repeat(len(mesh.faces), 0) if mesh.gloss is None else mesh.gloss for mesh in meshes]
        gloss = np.concatenate(rows)
    if any(mesh.gloss_textures for mesh in meshes):
        parts = (mesh.gloss_textures or (plain,) * len(mesh.textures) for mesh in meshes)
        factors = tuple(texture for part in parts for texture in part)
    skin = meshes[0].skin
    if skin is not None:
        still = [np.zeros((len(mesh.vertices), *skin.carried.shape[1:]), dtype=np.float32) for mesh in meshes]
        rows = [mesh.skin.carried if mesh.skin else zeros for mesh, zeros in zip(meshes, still, strict=True)]
        skin = replace(skin, carried=np.concatenate(rows))
    for mesh in meshes:
        faces.append(mesh.faces + vertices)
        texture_ids.append(np.where(mesh.texture_ids < 0, -1, mesh.texture_ids + textures).astype(np.int32))
        vertices, textures = vertices + len(mesh.vertices), textures + len(mesh.textures)
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        corner_colors=np.concatenate([mesh.corner_colors for mesh in meshes]),
        corner_uvs=np.concatenate([mesh.corner_uvs for mesh in meshes]),
        texture_ids=np.concatenate(texture_ids),
        textures=tuple(texture for mesh in meshes for texture in mesh.textures),
        gloss=gloss,
        gloss_textures=factors,
        skin=skin,
    )


def normalize(mesh: Mesh) -> Mesh:
    """Move the area-weighted centroid of the faces to the origin and scale the largest |coordinate| to 1, rounded to
    float32: so files hold the vertices exactly, and a mesh that is read back covers the same pixels.

    The same point is the average of the vertices weighted with the areas around them (the paper's appendix).
    InputError where there is no positive area, which `load_mesh` ensures.

    >>> float(np.abs(normalize(renderer.solid("bottle")).vertices).max())
    1.0
    """
    require_mesh("mesh", mesh)
    areas = mesh.face_areas()
    if not areas.sum() > 0:
        raise InputError("the mesh has a surface of zero area: give one with faces of some extent")
    centroids = mesh.vertices.take(mesh.faces, axis=0).mean(axis=1)
    center = np.average(centroids, axis=0, weights=areas)
    centered = mesh.vertices - center
    largest = np.abs(centered).max()
    scaled, matrix = (centered / largest).astype(np.float32).astype(np.float64), np.eye(4)
    matrix[:3] = np.column_stack([np.eye(3), -center]) / largest
    return replace(mesh, vertices=scaled, skin=mesh.skin and mesh.skin.transformed(matrix))


def transformed(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """The mesh under an affine matrix (4, 4). A mirroring one reverses the faces, so that normals stay outward."""
    order = [0, 1, 2] if np.linalg.det(matrix[:3, :3]) >= 0 else [0, 2, 1]
    return replace(
        mesh,
        vertices=mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3],
        faces=mesh.faces[:, order],
        corner_colors=mesh.corner_colors[:, order],
        corner_uvs=mesh.corner_uvs[:, order],
        skin=mesh.skin and mesh.skin.transformed(matrix),
    )


def subdivide(mesh: Mesh, vertices: float) -> Mesh:
    """The same surface with more vertices than `vertices`: every face is divided into four until there are enough.

    New vertices are the middles of edges, shared by the faces that share the edge, so that a closed mesh stays closed;
    colors (as they are stored, sRGB-encoded) and texture coordinates are interpolated. The old vertices keep their
    indices, and the quarters of face f are the faces 4f to 4f + 3. A mesh with enough vertices comes back as it is.

    >>> table = renderer.solid("table")
    >>> finer = subdivide(table, vertices=1000)
    >>> len(finer.vertices) > 1000, len(finer.faces) % len(table.faces)
    (True, 0)
    """
    require_mesh("mesh", mesh)
    is_whole_float = isinstance(vertices, float) and vertices.is_integer()  # such as 1e4
    require_whole("vertices", int(vertices) if is_whole_float else vertices)
    require_range("vertices", vertices, 0, MAX_VERTICES)
    while len(mesh.vertices) <= vertices:
        mesh = _quartered(mesh)
    return mesh


def refine(mesh: Mesh, area: float) -> Mesh:
    """The same surface with faces of at most an area: larger ones are divided into four until none is left.
    The faces come in another order; the old vertices keep their indices, and new ones may lie on a neighbor's edge."""
    large = mesh.face_areas() > area
    if not large.any():
        return mesh
    if large.all():
        return refine(_quartered(mesh), area)
    small, finer = select_faces(mesh, ~large), refine(_quartered(select_faces(mesh, large)), area)
    halves = {name: (getattr(small, name), getattr(finer, name)) for name in PER_FACE}
    joined: dict[str, Any] = {name: np.concatenate(both) for name, both in halves.items() if both[0] is not None}
    return replace(finer, **joined)


def select_faces(mesh: Mesh, faces: np.ndarray | slice) -> Mesh:
    """Some of the faces, over all vertices."""
    per_face = {name: getattr(mesh, name) for name in PER_FACE}
    return replace(mesh, **{name: values[faces] for name, values in per_face.items() if values is not None})


def _quartered(mesh: Mesh) -> Mesh:
    count = len(mesh.vertices)
    ends = np.sort(mesh.faces[:, EDGES].reshape(-1, 2), axis=1)
    edges, edge = np.unique(ends @ [count, 1], return_inverse=True)  # one number is sorted faster than a pair
    ends = np.stack(np.divmod(edges, count), axis=1)
    middles, skin = mesh.vertices[ends].mean(axis=1), mesh.skin
    if skin is not None:
        skin = replace(skin, carried=np.concatenate([skin.carried, skin.carried[ends].mean(axis=1)]))
    around = np.concatenate([mesh.faces, count + edge.reshape(-1, 3)], axis=1)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, middles]),
        faces=around[:, _QUARTERS].reshape(-1, 3),
        corner_colors=_interpolated(mesh.corner_colors),
        corner_uvs=_interpolated(mesh.corner_uvs),
        texture_ids=mesh.texture_ids.repeat(4),
        gloss=None if mesh.gloss is None else mesh.gloss.repeat(4, axis=0),
        skin=skin,
    )


def _interpolated(corners: np.ndarray) -> np.ndarray:
    """Values (4F, 3, D) at the corners of the quarters, of values (F, 3, D) at the corners of the faces."""
    middles = corners[:, EDGES].mean(axis=2)
    return np.concatenate([corners, middles], axis=1)[:, _QUARTERS].reshape(-1, *corners.shape[1:])
