"""Triangle meshes with colors, and operations on them: normalize, subdivide, concatenate.

World axes are right-handed with z up. Colors are stored as they are displayed
(sRGB-encoded). Computing with light needs them decoded.
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

# Affine matrix that turns the y axis to the z axis.
Y_UP_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
# Value of `Mesh.texture_ids` for a face without a texture.
NO_TEXTURE = -1
# Kinds of NumPy types (f: floating, i: signed, u: unsigned) of the arrays of a mesh.
_KINDS = {
    "vertices": "fiu",
    "faces": "iu",
    "corner_colors": "fiu",
    "corner_uvs": "fiu",
    "texture_ids": "iu",
    "gloss": "fiu",
}
# Attributes of a mesh that have a row for each face.
PER_FACE = ("faces", "corner_colors", "corner_uvs", "texture_ids", "gloss")
# Corners of a face at the two ends of each of its edges.
EDGES = ((0, 1), (1, 2), (2, 0))
# Corners of the quarters of a face. Points 0 to 2 are the corners of the face,
# and points 3 to 5 are the midpoints of its `EDGES`.
_QUARTERS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
# Gloss of a face of a matte mesh, when it is joined with a glossy mesh.
_MATTE = np.array([[1, 0, 0]], dtype=np.float32)
# Gloss texture that changes nothing, for a texture without one.
_NEUTRAL_GLOSS = np.full((1, 1, 2), 255, dtype=np.uint8)
# Factors that put red, green and blue in the bits from 0, 8 and 16.
_PACKING = np.array([1, 2**8, 2**16], dtype=np.int32)


@dataclass(frozen=True)
class Mesh:
    """F triangles over V vertices, with colors at the corners of each triangle.

    Corners at one vertex may have different colors, so a seam between colors
    needs no second vertex.

    Attributes:
        vertices: Positions in world coordinates, shape (V, 3), float64.
        faces: Indices of the vertices of each face, shape (F, 3), int64,
            counter-clockwise from outside.
        corner_colors: sRGB-encoded colors in [0, 1], shape (F, 3, 3), float32.
        corner_uvs: Texture coordinates, with the origin at the bottom left of
            the texture, shape (F, 3, 2), float32. Zeros without a texture.
        texture_ids: Index of the texture of each face, shape (F,), int32, or
            `NO_TEXTURE`.
        textures: sRGB-encoded textures, shape (H, W, 3) each, uint8. Row 0 is
            the top.
        gloss: Roughness, metallic and specular factor of each face in [0, 1]
            (`nb.Gloss`), shape (F, 3), float32. None for a matte mesh.
        gloss_textures: For each of the textures, factors of roughness and
            metallic, shape (H, W, 2) each, uint8. Empty without such textures.
        skin: Joints that carry the vertices. None without joints.

    Raises:
        InputError: If an array has another shape or type, there are no faces, or
            an index is out of range.

    Example:
        >>> import norm_balls as nb
        >>> corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        >>> square = nb.Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], color=(1, 0.5, 0))
        >>> square.face_areas().tolist()
        [0.5, 0.5]
        >>> square.face_normals()[0].tolist()
        [0.0, 0.0, 1.0]
        >>> square.closed
        False
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
        """Convert lists to arrays, and check shapes, types and indices."""
        for name, kinds in _KINDS.items():
            value = getattr(self, name)
            is_no_gloss = name == "gloss" and value is None
            if not isinstance(value, np.ndarray) and not is_no_gloss:
                object.__setattr__(self, name, as_array(name, value, kinds))
        self._require_shapes()
        self._require_indices()
        object.__setattr__(self, "textures", _as_textures("textures", self.textures, 3))
        factors = _as_textures("gloss_textures", self.gloss_textures, 2)
        object.__setattr__(self, "gloss_textures", factors)
        if self.texture_ids.max() >= len(self.textures):
            raise InputError(
                "texture_ids name textures that are not there: "
                f"give indices below {len(self.textures)}"
            )

    def _require_shapes(self) -> None:
        """Raise `InputError` if an array has another shape or type."""
        vertex_count = len(self.vertices) if self.vertices.ndim else 0
        face_count = len(self.faces) if self.faces.ndim else 0
        shapes = {
            "vertices": (vertex_count, 3),
            "faces": (face_count, 3),
            "corner_colors": (face_count, 3, 3),
            "corner_uvs": (face_count, 3, 2),
            "texture_ids": (face_count,),
        }
        if self.gloss is not None:
            shapes["gloss"] = (face_count, 3)
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or values.dtype.kind not in _KINDS[name]:
                raise InputError(
                    f"{name} must be numbers of shape {shape}, got {values.dtype} {values.shape}"
                )

    def _require_indices(self) -> None:
        """Raise `InputError` if there are no faces, or they have vertices that are not there."""
        require_range("the number of faces", len(self.faces), 1, np.inf)
        vertex_count = len(self.vertices)
        if not 0 <= self.faces.min() <= self.faces.max() < vertex_count:
            raise InputError(
                f"faces name vertices that are not there: give indices from 0 to {vertex_count - 1}"
            )

    @staticmethod
    def plain(vertices: ArrayLike, faces: ArrayLike, color: ArrayLike = (1.0, 1.0, 1.0)) -> Mesh:
        """Make a mesh without textures.

        Args:
            vertices: Positions in world coordinates, shape (V, 3).
            faces: Indices of vertices, shape (F, 3), counter-clockwise from
                outside.
            color: sRGB-encoded color in [0, 1], shape (3,), or one per vertex,
                shape (V, 3).

        Returns:
            The mesh.

        Raises:
            InputError: If an argument has another shape or is out of range.
        """
        vertices = np.array(as_array("vertices", vertices), dtype=np.float64)
        given_faces = as_array("faces", faces)
        # NaN becomes an arbitrary integer here, and is refused below.
        with np.errstate(invalid="ignore"):
            faces = given_faces.astype(np.int64)
        if not np.array_equal(faces, given_faces):
            raise InputError("faces holds numbers that are not whole: give indices of vertices")
        color = as_array("color", color).astype(np.float32)
        if not color.size or not (color.min() >= 0 and color.max() <= 1):
            given = reprlib.repr(color.tolist())
            raise InputError(f"color={given}: give red, green and blue from 0 to 1")
        try:
            vertex_colors = np.broadcast_to(color, vertices.shape)
            # The constructor refuses indices out of range, which are clipped here.
            corner_colors = vertex_colors.take(faces, axis=0, mode="clip")
        except (TypeError, ValueError, OverflowError, IndexError) as error:
            raise InputError(
                f"vertices, faces and color ({error}): give (V, 3), (F, 3) and (3)"
            ) from error
        return Mesh(
            vertices=vertices,
            faces=faces,
            corner_colors=corner_colors,
            corner_uvs=np.zeros((len(faces), 3, 2), dtype=np.float32),
            texture_ids=np.full(len(faces), NO_TEXTURE, dtype=np.int32),
        )

    def face_normals(self) -> np.ndarray:
        """Return the outward unit normals of the faces, shape (F, 3).

        A face without area has the zero vector.
        """
        return plain_face_normals(self.vertices, self.faces)

    def face_areas(self) -> np.ndarray:
        """Return the areas of the faces in squared world units, shape (F,)."""
        doubled = doubled_area_vectors(self.vertices, self.faces)
        return np.linalg.norm(doubled, axis=1) / 2

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """Return `renderer.geometry.normals.vertex_normals` of the mesh, shape (V, 3)."""
        return vertex_normals(torch.from_numpy(self.vertices), torch.from_numpy(self.faces)).numpy()

    @cached_property
    def displayable(self) -> bool:
        """Return whether all colors are in [0, 1]. NaN is not."""
        return bool(self.corner_colors.min() >= 0 and self.corner_colors.max() <= 1)

    @cached_property
    def one_color_per_face(self) -> bool:
        """Return whether the corners of each face have the same color."""
        return bool((self.corner_colors == self.corner_colors[:, :1]).all())

    def moved(self, vertices: np.ndarray) -> Mesh:
        """Return a copy with other vertex positions, without a skin.

        Args:
            vertices: Positions, shape (V, 3).
        """
        mesh = replace(self, vertices=vertices, skin=None)
        # Packing textures takes long, so the copy shares the packed ones.
        mesh.__dict__["packed_textures"] = self.packed_textures
        return mesh

    @cached_property
    def packed_textures(self) -> tuple[np.ndarray, ...]:
        """Return the textures with one number per texel, shape (H, W) each, int32.

        Red, green and blue are in the bits from 0, 8 and 16. One number is
        looked up faster than three.
        """
        return tuple(texture.astype(np.int32) @ _PACKING for texture in self.textures)

    @cached_property
    def closed(self) -> bool:
        """Return whether no face is ever seen from behind.

        Every connected part of the mesh is then watertight, with faces that are
        counter-clockwise from outside. This is so if each edge occurs once in
        either direction, and if the faces of a part enclose a positive volume.
        """
        part_of_face = _closed_parts(self.faces.astype(np.int64).tobytes())
        if part_of_face is None:
            return False
        corners = (self.vertices - self.vertices.mean(axis=0))[self.faces[:, 0]]
        # Six times the volume of the tetrahedron of each face and the center.
        volumes = np.einsum("fi,fi->f", corners, doubled_area_vectors(self.vertices, self.faces))
        return bool((np.bincount(part_of_face, volumes) > 0).all())


# The last result is kept, because the instances of a solid have the same faces.
@lru_cache(maxsize=1)
def _closed_parts(faces: bytes) -> np.ndarray | None:
    """Return the connected part (F,) of each face, or None for an open mesh.

    The argument holds faces (F, 3) of int64. In a closed mesh, each edge occurs
    once in either direction.
    """
    # Importing trimesh takes half a second.
    from trimesh.graph import connected_component_labels

    corners = np.frombuffer(faces, dtype=np.int64).reshape(-1, 3)
    edges = corners[:, EDGES].reshape(-1, 2)
    vertex_count = corners.max(initial=0) + 1
    # Each edge from vertex a to vertex b gets the number a · V + b, and in the
    # opposite direction b · V + a. In a closed mesh, both sets of numbers are equal.
    forward = edges @ [vertex_count, 1]
    backward = edges @ [1, vertex_count]
    by_forward = np.argsort(forward)
    by_backward = np.argsort(backward)
    is_repeated = (np.diff(forward[by_forward]) == 0).any()
    if is_repeated or not np.array_equal(forward[by_forward], backward[by_backward]):
        return None
    # Row i of the sorted lists is one edge of two faces. The edges 3 f to 3 f + 2
    # are those of face f.
    neighbors = np.stack([by_forward, by_backward], axis=1) // 3
    return connected_component_labels(neighbors, node_count=len(corners))


def _as_textures(name: str, textures: object, channels: int) -> tuple[np.ndarray, ...]:
    """Convert textures to arrays (height, width, channels) of uint8, or raise `InputError`."""
    expected = f"a list of arrays (height, width, {channels}) of uint8"
    if not isinstance(textures, list | tuple):
        raise InputError(f"{name} is {describe(textures)}: give {expected}")
    arrays = [as_array(name, texture) for texture in textures]
    for array in arrays:
        if array.ndim != 3 or array.shape[2] != channels or array.dtype != np.uint8:
            raise InputError(f"{name} holds {describe(array)}: give {expected}")
    is_unchanged = all(array is texture for array, texture in zip(arrays, textures, strict=True))
    return textures if isinstance(textures, tuple) and is_unchanged else tuple(arrays)


def require_mesh(name: str, value: object) -> None:
    """Check that an argument is a mesh whose colors can be displayed.

    Args:
        name: Name of the argument in the error.
        value: The argument.

    Raises:
        InputError: If it has another type, such as a path, or a color is not in
            [0, 1].
    """
    if not isinstance(value, Mesh):
        path = repr(value) if isinstance(value, str) else "path"
        raise InputError(
            f"{name} is {describe(value)}: give an nb.Mesh, "
            f"such as nb.load_mesh({path}) or nb.Mesh.plain(vertices, faces)"
        )
    if not value.displayable:
        raise InputError(
            f"{name}: its corner_colors hold values beyond [0, 1]: divide colors of 8 bits by 255"
        )


def concatenate(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes to one mesh with the faces of all of them, in order.

    Vertices are not merged. The joints are those of the first mesh, and do not
    carry the vertices of meshes without joints.

    Args:
        meshes: At least one mesh.
    """
    faces = []
    texture_ids = []
    vertex_count = 0
    texture_count = 0
    for mesh in meshes:
        faces.append(mesh.faces + vertex_count)
        shifted = np.where(mesh.texture_ids < 0, NO_TEXTURE, mesh.texture_ids + texture_count)
        texture_ids.append(shifted.astype(np.int32))
        vertex_count += len(mesh.vertices)
        texture_count += len(mesh.textures)
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        corner_colors=np.concatenate([mesh.corner_colors for mesh in meshes]),
        corner_uvs=np.concatenate([mesh.corner_uvs for mesh in meshes]),
        texture_ids=np.concatenate(texture_ids),
        textures=tuple(texture for mesh in meshes for texture in mesh.textures),
        gloss=_joined_gloss(meshes),
        gloss_textures=_joined_gloss_textures(meshes),
        skin=_joined_skin(meshes),
    )


def _joined_gloss(meshes: Sequence[Mesh]) -> np.ndarray | None:
    """Return the gloss of the faces of all meshes, or None if all are matte."""
    if all(mesh.gloss is None for mesh in meshes):
        return None
    rows = []
    for mesh in meshes:
        rows.append(_MATTE.repeat(len(mesh.faces), 0) if mesh.gloss is None else mesh.gloss)
    return np.concatenate(rows)


def _joined_gloss_textures(meshes: Sequence[Mesh]) -> tuple[np.ndarray, ...]:
    """Return a gloss texture for each texture of all meshes, or nothing if no mesh has any."""
    if not any(mesh.gloss_textures for mesh in meshes):
        return ()
    joined: list[np.ndarray] = []
    for mesh in meshes:
        joined += mesh.gloss_textures or (_NEUTRAL_GLOSS,) * len(mesh.textures)
    return tuple(joined)


def _joined_skin(meshes: Sequence[Mesh]) -> Skin | None:
    """Return the skin of the first mesh, extended by the vertices of all meshes."""
    skin = meshes[0].skin
    if skin is None:
        return None
    rows = []
    for mesh in meshes:
        uncarried = np.zeros((len(mesh.vertices), *skin.carried.shape[1:]), dtype=np.float32)
        rows.append(mesh.skin.carried if mesh.skin else uncarried)
    return replace(skin, carried=np.concatenate(rows))


def normalize(mesh: Mesh) -> Mesh:
    """Return a copy of a mesh that is centered and scaled to the cube [-1, 1]³.

    The centroid of the faces, weighted with their areas, moves to the origin.
    (This is also the average of the vertices, weighted with the areas around
    them, as in the paper's appendix.) The largest magnitude of a coordinate
    becomes 1. The vertices are rounded to float32, which files hold exactly, so
    a mesh that is read back covers the same pixels.

    Args:
        mesh: The mesh.

    Returns:
        The normalized mesh, with float64 vertices.

    Raises:
        InputError: If the surface has no area. `load_mesh` ensures that it has.

    Example:
        >>> import numpy as np
        >>> import norm_balls as nb
        >>> bottle = nb.normalize(nb.solid("bottle"))
        >>> float(np.abs(bottle.vertices).max())
        1.0
    """
    require_mesh("mesh", mesh)
    center, largest = center_and_extent(mesh)
    centered = mesh.vertices - center
    scaled = (centered / largest).astype(np.float32).astype(np.float64)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([np.eye(3), -center]) / largest
    skin = mesh.skin and mesh.skin.transformed(matrix)
    return replace(mesh, vertices=scaled, skin=skin)


def center_and_extent(mesh: Mesh) -> tuple[np.ndarray, float]:
    """Return the center and the extent that `normalize` brings to the origin and to 1.

    Args:
        mesh: The mesh.

    Returns:
        A tuple of
        - the centroid of the faces, weighted with their areas, shape (3,);
        - the largest difference of a coordinate from the centroid.

    Raises:
        InputError: If the surface has no area.
    """
    areas = mesh.face_areas()
    if not areas.sum() > 0:
        raise InputError("the mesh has a surface of zero area: give one with faces of some extent")
    centroids = mesh.vertices.take(mesh.faces, axis=0).mean(axis=1)
    center = np.average(centroids, axis=0, weights=areas)
    return center, np.abs(mesh.vertices - center).max()


def transformed(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """Return a copy of a mesh under an affine transformation.

    A matrix that mirrors reverses the corners of the faces, so that normals stay
    outward.

    Args:
        mesh: The mesh.
        matrix: Affine matrix, shape (4, 4).
    """
    is_mirroring = np.linalg.det(matrix[:3, :3]) < 0
    order = [0, 2, 1] if is_mirroring else [0, 1, 2]
    return replace(
        mesh,
        vertices=mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3],
        faces=mesh.faces[:, order],
        corner_colors=mesh.corner_colors[:, order],
        corner_uvs=mesh.corner_uvs[:, order],
        skin=mesh.skin and mesh.skin.transformed(matrix),
    )


def subdivide(mesh: Mesh, vertices: float) -> Mesh:
    """Divide every face into four, until there are more vertices than a number.

    The surface stays the same. New vertices are the midpoints of edges. Faces
    that share an edge share the new vertex, so a closed mesh stays closed. Colors
    (sRGB-encoded) and texture coordinates are interpolated. The old vertices
    keep their indices, and the quarters of face f are the faces 4f to 4f + 3.

    Args:
        mesh: The mesh.
        vertices: The number, from 0 to `MAX_VERTICES`.

    Returns:
        The subdivided mesh, or the given mesh if it has enough vertices.

    Raises:
        InputError: If the number is not whole or out of range.

    Example:
        >>> import norm_balls as nb
        >>> table = nb.solid("table")
        >>> finer = nb.subdivide(table, vertices=1000)
        >>> len(finer.vertices) > 1000, len(finer.faces) % len(table.faces)
        (True, 0)
    """
    require_mesh("mesh", mesh)
    # Whole numbers such as 1e4 are accepted.
    is_whole_float = isinstance(vertices, float) and vertices.is_integer()
    require_whole("vertices", int(vertices) if is_whole_float else vertices)
    require_range("vertices", vertices, 0, MAX_VERTICES)
    while len(mesh.vertices) <= vertices:
        mesh = _quartered(mesh)
    return mesh


def refine(mesh: Mesh, area: float) -> Mesh:
    """Divide faces into four until none has more than some area.

    The surface stays the same. The faces come in another order. The old vertices
    keep their indices, and new vertices may lie on the edge of a neighbor.

    Args:
        mesh: The mesh.
        area: Largest area of a face in squared world units.

    Returns:
        The refined mesh, or the given mesh if no face is larger.
    """
    is_large = mesh.face_areas() > area
    if not is_large.any():
        return mesh
    if is_large.all():
        return refine(_quartered(mesh), area)
    small = select_faces(mesh, ~is_large)
    refined = refine(_quartered(select_faces(mesh, is_large)), area)
    joined: dict[str, Any] = {}
    for name in PER_FACE:
        rows_of_small = getattr(small, name)
        if rows_of_small is not None:
            joined[name] = np.concatenate([rows_of_small, getattr(refined, name)])
    return replace(refined, **joined)


def select_faces(mesh: Mesh, faces: np.ndarray | slice) -> Mesh:
    """Return a copy of a mesh with some of its faces and all of its vertices.

    Args:
        mesh: The mesh.
        faces: Indices, a mask or a slice of the faces to keep.
    """
    kept = {}
    for name in PER_FACE:
        rows = getattr(mesh, name)
        if rows is not None:
            kept[name] = rows[faces]
    return replace(mesh, **kept)


def _quartered(mesh: Mesh) -> Mesh:
    """Divide every face of a mesh into four."""
    vertex_count = len(mesh.vertices)
    ends_of_corners = np.sort(mesh.faces[:, EDGES].reshape(-1, 2), axis=1)
    # One number for each edge is sorted faster than a pair of vertices.
    keys, edge_of_corner = np.unique(ends_of_corners @ [vertex_count, 1], return_inverse=True)
    edge_ends = np.stack(np.divmod(keys, vertex_count), axis=1)
    midpoints = mesh.vertices[edge_ends].mean(axis=1)
    skin = mesh.skin
    if skin is not None:
        carried = np.concatenate([skin.carried, skin.carried[edge_ends].mean(axis=1)])
        skin = replace(skin, carried=carried)
    # The vertices of the six points of each face, shape (F, 6).
    points = np.concatenate([mesh.faces, vertex_count + edge_of_corner.reshape(-1, 3)], axis=1)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, midpoints]),
        faces=points[:, _QUARTERS].reshape(-1, 3),
        corner_colors=_interpolated(mesh.corner_colors),
        corner_uvs=_interpolated(mesh.corner_uvs),
        texture_ids=mesh.texture_ids.repeat(4),
        gloss=None if mesh.gloss is None else mesh.gloss.repeat(4, axis=0),
        skin=skin,
    )


def _interpolated(corners: np.ndarray) -> np.ndarray:
    """Return values (4F, 3, D) at the corners of quarters, from values (F, 3, D) of faces."""
    midpoints = corners[:, EDGES].mean(axis=2)
    points = np.concatenate([corners, midpoints], axis=1)
    return points[:, _QUARTERS].reshape(-1, *corners.shape[1:])
