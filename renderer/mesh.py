"""Triangle meshes with colors, and functions that normalize, divide and join meshes.

World axes are right-handed with z up. Colors are stored as they are displayed (sRGB-encoded).
Shading first decodes them to linear values. A mesh has V vertices and F faces.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from renderer import errors
from renderer.errors import InputError
from renderer.image import decode, encode
from renderer.normals import CREASE, doubled_area_vectors, normal_groups, vertex_normals
from renderer.settings import ENCODINGS, MAX_VERTICES, NORMALS

# Affine matrix, shape (4, 4), that rotates the y-axis to the z-axis. It converts meshes from files
# in which y points up to our axes, in which z points up.
Y_UP_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
# Value of `Mesh.texture_ids` for a face without a texture.
NO_TEXTURE = -1
# Each array of a mesh: its allowed types, as values of `dtype.kind` (f is floating-point, i is a
# signed and u an unsigned integer), and the shape of a row.
_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "vertices": ("fiu", (3,)),
    "faces": ("iu", (3,)),
    "corner_colors": ("fiu", (3, 3)),
    "corner_uvs": ("fiu", (3, 2)),
    "texture_ids": ("iu", ()),
    "gloss": ("fiu", (3,)),
    "normal_ids": ("iu", (3,)),
}
# Names of the arrays of a mesh that have one row for each face.
PER_FACE = ("faces", "corner_colors", "corner_uvs", "texture_ids", "gloss", "normal_ids")
# A mesh is far from the origin beyond its size times this factor.
FAR = 10
# The three edges of a triangle. Each edge joins two of the corners 0, 1 and 2.
EDGES = ((0, 1), (1, 2), (2, 0))
# Corners of the four triangles into which a triangle is divided. Points 0, 1 and 2 are its corners.
# Points 3, 4 and 5 are the midpoints of its edges 0-1, 1-2 and 2-0.
_QUARTERS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
# Roughness, metallic and specular factor of a face without specular reflection.
_MATTE = np.array([[1, 0, 0]], dtype=np.float32)
# Gloss texture with one texel that leaves roughness and
# metallic unchanged. The stored value 255 means the factor 1.
_NEUTRAL_GLOSS = np.full((1, 1, 2), 255, dtype=np.uint8)


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh with F faces, V vertices, and a color at each corner of a face.

    Two faces with a common vertex may have different colors at this vertex.

    Attributes:
        vertices: Positions in world axes, float64, shape (V, 3).
        faces: Vertex indices of the three corners of each face, counter-clockwise
            seen from outside, int64, shape (F, 3).
        corner_colors: sRGB-encoded colors in [0, 1] of the three corners of each
            face, float32, shape (F, 3, 3).
        corner_uvs: Texture coordinates of the three corners of each face,
            float32, shape (F, 3, 2). The origin is the bottom left corner of the
            texture. Zeros for faces without a texture.
        texture_ids: Index in `textures` of the texture of each face, int32,
            shape (F,). -1 for a face without a texture.
        textures: sRGB-encoded textures, uint8, shape (H, W, 3) each, for H rows
            and W columns of texels. Row 0 is at the top.
        gloss: Roughness, metallic and specular factor of each face, in [0, 1]
            (see `nb.Gloss`), float32, shape (F, 3). None for a matte mesh.
        gloss_textures: For each texture, a texture with factors for roughness
            and metallic, uint8, shape (H, W, 2) each, with 255 for the factor 1.
            Empty if the mesh has no gloss textures.
        normal_ids: Index of the normal of each of the three corners of each face,
            int64, shape (F, 3). With `normals="smooth"`, corners with the same
            index share a normal, which is computed anew if the vertices move. If
            it is not given, edges at which faces meet at more than 40° are sharp.
            `replace(mesh, normal_ids=mesh.faces)` makes all edges smooth.

    Raises:
        InputError: If an array has a wrong shape or type, if there are no faces,
            or if an index is out of range.

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
    # Always an array after `__post_init__`.
    normal_ids: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Convert lists to arrays, check all fields, and find sharp edges."""
        # Permitted kinds of numbers of each array, and the shape of one of its rows.
        for name, (kinds, row) in _ARRAYS.items():
            if getattr(self, name) is None and name in ("gloss", "normal_ids"):
                continue
            array = errors.as_array(name, getattr(self, name), kinds)
            # Small and unsigned integers would overflow, and torch refuses negative strides and
            # some types, such as those of another byte order.
            native = array.dtype.newbyteorder("=")
            is_short = native in (np.float16, np.float32) and name != "vertices"
            dtype = np.int64 if kinds == "iu" else native if is_short else np.float64
            array = np.asarray(array, dtype, order="C")
            # A frozen dataclass forbids assignments, so fields are set by object.__setattr__.
            object.__setattr__(self, name, array)
            # Arrays per face have as many rows as `faces`. Other arrays may have any number of
            # rows.
            shape = (*(self.faces if name in PER_FACE else array).shape[:1], *row)
            errors.require_shape(name, array, *shape)
        errors.require_range("the number of faces", len(self.faces), 1, np.inf)
        for name, channels in (("textures", 3), ("gloss_textures", 2)):
            expected = f"a list of arrays (height, width, {channels}) of uint8"
            given = errors.as_list(name, getattr(self, name), object, expected)
            textures = tuple(np.asarray(errors.as_array(name, item), order="C") for item in given)
            for texture in textures:
                if texture.shape[2:] != (channels,) or texture.dtype != np.uint8:
                    raise InputError(f"{name} has {errors.describe(texture)}: give {expected}")
            object.__setattr__(self, name, textures)
        limits = {
            "faces": (0, len(self.vertices) - 1),
            "texture_ids": (NO_TEXTURE, len(self.textures) - 1),
            # A larger index is a mistake that would take all memory.
            "normal_ids": (0, 2**31 - 1),
        }
        for name, (least, most) in limits.items():
            ids = getattr(self, name)
            if ids is not None and not least <= ids.min() <= ids.max() <= most:
                fault = f"{name} has indices from {ids.min()} to {ids.max()}"
                raise InputError(f"{fault}: give indices from {least} to {most}")
        if self.normal_ids is None:
            object.__setattr__(self, "normal_ids", normal_groups(self.vertices, self.faces))

    @cached_property
    def origin(self) -> np.ndarray:
        """Center of a mesh that is far from the origin, or else the origin, shape (3,).

        Relative to it, positions have enough digits in float32.
        """
        # Vertices that no face uses do not count.
        corners = self.vertices[self.faces].reshape(-1, 3)
        ends = np.array([corners.min(0), corners.max(0)])
        is_far = np.abs(ends).max() > FAR * np.ptp(ends, axis=0).max()
        return ends.mean(0) if is_far else np.zeros(3)

    @staticmethod
    def plain(
        vertices: ArrayLike,
        faces: ArrayLike,
        color: ArrayLike = (1.0, 1.0, 1.0),
        crease: float = CREASE,
    ) -> Mesh:
        """Create a mesh without textures.

        Args:
            vertices: Positions in world axes, shape (V, 3).
            faces: Vertex indices of the three corners of each face,
                counter-clockwise seen from outside, shape (F, 3).
            color: sRGB-encoded color in [0, 1], shape (3,), or one color per
                vertex, shape (V, 3).
            crease: Angle in degrees. With `normals="smooth"`, edges at which faces
                meet at a larger angle are sharp. 180 makes all edges smooth.

        Returns:
            Matte mesh with float64 vertices.

        Raises:
            InputError: If an argument has a wrong shape or is out of range.
        """
        vertices = np.array(errors.as_array("vertices", vertices), dtype=np.float64)
        given_faces = errors.as_array("faces", faces)
        # astype turns NaN into an arbitrary integer, with a warning.
        with np.errstate(invalid="ignore"):
            faces = given_faces.astype(np.int64)
        if not np.array_equal(faces, given_faces):
            raise InputError("faces has numbers that are not whole: give the indices of vertices")
        color = errors.as_array("color", color).astype(np.float32)
        if not color.size or not (color.min() >= 0 and color.max() <= 1):
            given = reprlib.repr(color.tolist())
            raise InputError(f"color={given} is not a color: give red, green and blue from 0 to 1")
        shapes = "give the shapes (V, 3), (F, 3) and (3,)"
        with errors.explained("vertices, faces and color do not fit together", shapes):
            # Vertex indices out of range are clipped, because `Mesh(...)` raises a better error.
            # Give each corner the color of its vertex, or the single color.
            corner_colors = np.broadcast_to(color, vertices.shape).take(faces, axis=0, mode="clip")
        errors.require_range("crease", crease, 0, 180)
        corner_uvs = np.zeros((len(faces), 3, 2), dtype=np.float32)
        texture_ids = np.full(len(faces), NO_TEXTURE, dtype=np.int32)
        mesh = Mesh(vertices, faces, corner_colors, corner_uvs, texture_ids, normal_ids=faces)
        return replace(mesh, normal_ids=normal_groups(vertices, faces, crease=crease))

    def face_normals(self) -> np.ndarray:
        """Compute the outward unit normals of the F faces, shape (F, 3).

        The normal of a face without area is zero.
        """
        doubled_vectors = doubled_area_vectors(self.vertices, self.faces)
        lengths = np.linalg.norm(doubled_vectors, axis=1, keepdims=True)
        zeros = np.zeros_like(doubled_vectors)
        return np.divide(doubled_vectors, lengths, out=zeros, where=lengths > 0)

    def face_areas(self) -> np.ndarray:
        """Compute the areas of the F faces in squared world units, shape (F,)."""
        return np.linalg.norm(doubled_area_vectors(self.vertices, self.faces), axis=1) / 2

    @cached_property
    def corner_normals(self) -> np.ndarray:
        """Outward unit normals of the corners with `normals="smooth"`, shape (F, 3, 3).

        A normal is the mean of the normals of the faces that share it, weighted
        with the areas of the faces.
        """
        arrays = (self.vertices, self.faces, self.normal_ids)
        vertices, faces, normal_ids = map(torch.from_numpy, arrays)
        normals = vertex_normals(vertices, faces, normal_ids, self.normal_ids.max() + 1)
        return normals.numpy()[self.normal_ids]

    def written_normals(self, normals: str) -> np.ndarray:
        """Compute the unit normals of the corners for a file, shape (F, 3, 3).

        Args:
            normals: "flat" gives a corner the normal of its face, and "smooth" gives
                it one of `corner_normals`. (0, 0, 1) replaces a normal of zero.

        Raises:
            InputError: If `normals` is neither "smooth" nor "flat".
        """
        errors.require_choice("normals", normals, NORMALS)
        values = self.corner_normals
        if normals == "flat":
            values = np.broadcast_to(self.face_normals()[:, None], values.shape)
        return np.where(values.any(axis=-1, keepdims=True), values, [0.0, 0.0, 1.0])

    @cached_property
    def displayable(self) -> bool:
        """True if all corner colors are in [0, 1], and none of them is NaN."""
        return bool(self.corner_colors.min() >= 0 and self.corner_colors.max() <= 1)

    @cached_property
    def one_color_per_face(self) -> bool:
        """True if the three corners of each face have the same color."""
        return bool((self.corner_colors == self.corner_colors[:, :1]).all())

    @cached_property
    def closed(self) -> bool:
        """True if no camera outside of the mesh can see a face from behind.

        Each connected part of the mesh must be watertight, and its faces must be
        counter-clockwise seen from outside. This is so if each edge of the part
        belongs to one face in one direction and to one face in the other
        direction, and if the faces enclose a positive volume. The part must not cross itself: a
        bulge that is inside out, as a large change of the shape can make it, is not noticed.
        """
        part_of_face = _closed_parts(self.faces.astype(np.int64).tobytes())
        if part_of_face is None:
            return False
        first_corners = self.vertices[self.faces[:, 0]] - self.vertices.mean(axis=0)
        doubled_vectors = doubled_area_vectors(self.vertices, self.faces)
        # Six times the volume of the tetrahedron of each face and the mesh center, shape (F,). It
        # is negative if the face is turned toward the center.
        sixfold_volumes = np.einsum("fi,fi->f", first_corners, doubled_vectors)
        return bool((np.bincount(part_of_face, sixfold_volumes) > 0).all())


# The result for the last mesh is cached. The next mesh often has the same
# faces, for example if it is another instance of the same procedural solid.
@lru_cache(maxsize=1)
def _closed_parts(face_bytes: bytes) -> Int[np.ndarray, " F"] | None:
    """Find the connected part of each face. None if one is open or has mixed orientations."""
    # trimesh is imported here because the import takes half a second.
    from trimesh.graph import connected_component_labels
    from trimesh.grouping import group_rows

    faces = np.frombuffer(face_bytes, dtype=np.int64).reshape(-1, 3)
    # Side s of face f has the number 3 f + s.
    sides = faces[:, EDGES].reshape(-1, 2)
    # Each edge of a closed surface has two sides, one in each direction.
    pairs = group_rows(np.sort(sides, axis=1), require_count=2)
    if 2 * len(pairs) < len(sides) or (sides[pairs[:, 0]] != sides[pairs[:, 1], ::-1]).any():
        return None
    return connected_component_labels(pairs // 3, node_count=len(faces))


def require_mesh(name: str, value: object) -> None:
    """Check that an argument is a mesh with colors in [0, 1]."""
    if not isinstance(value, Mesh):
        path = repr(value) if isinstance(value, str) else "path"
        advice = f"give an nb.Mesh, such as nb.load_mesh({path}) or nb.Mesh.plain(vertices, faces)"
        raise InputError(f"{name} is {errors.describe(value)}: {advice}")
    if not value.displayable:
        raise InputError(f"{name}.corner_colors has values outside [0, 1]: divide bytes by 255")


def concatenate(meshes: Sequence[Mesh]) -> Mesh:
    """Join several meshes to one mesh, which has the faces of all meshes in order.

    Vertices are not merged. Meshes that share a texture also share it in the result.
    """
    faces, texture_ids, normal_ids, gloss = [], [], [], []
    # The indices of a mesh grow by the numbers of vertices and normals before it.
    vertex_count = normal_count = 0
    # Number of each pair of texture and gloss texture, and the pair, by their identities.
    pairs: dict[tuple[int, int], tuple[int, np.ndarray, np.ndarray]] = {}
    for mesh in meshes:
        faces.append(mesh.faces + vertex_count)
        normal_ids.append(mesh.normal_ids + normal_count)
        vertex_count += len(mesh.vertices)
        normal_count += mesh.normal_ids.max() + 1
        # A mesh without gloss is matte if another mesh has gloss.
        gloss.append(_MATTE.repeat(len(mesh.faces), 0) if mesh.gloss is None else mesh.gloss)
        # The last entry belongs to the index -1, which is NO_TEXTURE.
        new_ids = [NO_TEXTURE]
        # A mesh without gloss textures has a factor of 1 for each of its textures.
        neutral = (_NEUTRAL_GLOSS,) * len(mesh.textures)
        for pair in zip(mesh.textures, mesh.gloss_textures or neutral, strict=True):
            number, *_ = pairs.setdefault((id(pair[0]), id(pair[1])), (len(pairs), *pair))
            new_ids.insert(-1, number)
        texture_ids.append(np.array(new_ids, dtype=np.int32)[mesh.texture_ids])
    has_factors = any(mesh.gloss_textures for mesh in meshes)
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        corner_colors=np.concatenate([mesh.corner_colors for mesh in meshes]),
        corner_uvs=np.concatenate([mesh.corner_uvs for mesh in meshes]),
        texture_ids=np.concatenate(texture_ids),
        textures=tuple(texture for _, texture, _ in pairs.values()),
        gloss=None if all(mesh.gloss is None for mesh in meshes) else np.concatenate(gloss),
        gloss_textures=tuple(factors for *_, factors in pairs.values()) if has_factors else (),
        normal_ids=np.concatenate(normal_ids),
    )


def normalize(mesh: Mesh) -> Mesh:
    """Return a copy of a mesh that is centered and scaled to the cube [-1, 1]³.

    The centroid of the surface moves to the origin. It is the mean of the face
    centers, weighted with the areas of the faces. The largest magnitude of a
    coordinate becomes 1. The vertices are rounded to float32. Mesh files store
    float32 numbers exactly, so a mesh that is saved and loaded covers the same
    pixels.

    The appendix of the paper "Beyond Pixel Norm-Balls" averages the vertices,
    weighted with the areas around them. This gives the same point.

    Args:
        mesh: Mesh to normalize.

    Returns:
        Normalized mesh, with float64 vertices.

    Raises:
        InputError: If the surface has no area. A mesh from `load_mesh` always
            has an area.

    Example:
        >>> import numpy as np
        >>> import norm_balls as nb
        >>> bottle = nb.normalize(nb.solid("bottle"))
        >>> float(np.abs(bottle.vertices).max())
        1.0
    """
    require_mesh("mesh", mesh)
    center, extent = center_and_extent(mesh)
    normalized = ((mesh.vertices - center) / extent).astype(np.float32)
    return replace(mesh, vertices=normalized.astype(np.float64))


def center_and_extent(mesh: Mesh) -> tuple[np.ndarray, float]:
    """Compute the center of a mesh, and its largest extent from the center along an axis.

    `normalize` moves the center to the origin and scales the extent to 1. The center is the mean
    of the face centers, weighted with the areas.
    """
    areas = mesh.face_areas()
    if not areas.sum() > 0:
        raise InputError("the surface of the mesh has the area 0: give faces with an area")
    corners = mesh.vertices.take(mesh.faces, axis=0)
    center = np.average(corners.mean(axis=1), axis=0, weights=areas)
    return center, np.abs(corners - center).max()


def transformed(mesh: Mesh, matrix: Float[np.ndarray, "4 4"]) -> Mesh:
    """Return a copy of a mesh after an affine transformation.

    A transformation that mirrors the mesh would make its faces clockwise seen
    from outside. The order of their corners is therefore reversed. The matrix is multiplied by
    columns (x, y, z, 1).
    """
    arrays: dict[str, Any] = {"vertices": mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]}
    if np.linalg.det(matrix[:3, :3]) < 0:
        for name in ("faces", "corner_colors", "corner_uvs", "normal_ids"):
            arrays[name] = getattr(mesh, name)[:, [0, 2, 1]]
    return replace(mesh, **arrays)


def subdivide(mesh: Mesh, vertices: float, encoding: str = "linear") -> Mesh:
    """Divide all faces of a mesh into four, until the mesh has more than `vertices` vertices.

    The surface stays the same. New vertices are the midpoints of edges. Faces
    that share an edge share the new vertex, so a closed mesh stays closed. Colors
    and texture coordinates are interpolated, too. The old vertices keep their
    indices. Each division replaces face f by the faces 4 f to 4 f + 3.

    Args:
        mesh: Mesh to divide.
        vertices: Number of vertices that the result must exceed, from 0 to
            `MAX_VERTICES`.
        encoding: Encoding of the images that will be rendered, `"linear"` or
            `"srgb"`. Shading interpolates linear colors.

    Returns:
        Divided mesh. The given mesh itself if it already has more vertices.

    Raises:
        InputError: If `vertices` is not whole or out of range, or if `encoding` is unknown.

    Example:
        >>> import norm_balls as nb
        >>> table = nb.solid("table")
        >>> finer = nb.subdivide(table, vertices=1000)
        >>> len(finer.vertices) > 1000, len(finer.faces) % len(table.faces)
        (True, 0)
    """
    require_mesh("mesh", mesh)
    # A whole number may be written as a float, such as 1e4.
    if isinstance(vertices, float) and vertices.is_integer():
        vertices = int(vertices)
    errors.require_whole("vertices", vertices, 0, MAX_VERTICES)
    errors.require_choice("encoding", encoding, ENCODINGS)
    while len(mesh.vertices) <= vertices:
        mesh = _quartered(mesh, encoding)
    return mesh


def refine(mesh: Mesh, area: float, encoding: str) -> Mesh:
    """Divide the large faces of a mesh into four, until all faces are small enough.

    The surface stays the same, but the order of the faces changes. The old
    vertices keep their indices. A new vertex of a divided face may lie in the
    middle of an edge of a neighboring face that is not divided. The largest allowed `area` of a
    face is in squared world units.
    """
    is_large = mesh.face_areas() > area
    if not is_large.any():
        return mesh
    divided = refine(_quartered(select_faces(mesh, is_large), encoding), area, encoding)
    arrays: dict[str, Any] = {
        name: np.concatenate([rows[~is_large], getattr(divided, name)])
        for name, rows in _rows_of_faces(mesh).items()
    }
    # The divided mesh has all old vertices, so the vertex
    # indices of the small faces are valid in it, too.
    return replace(divided, **arrays)


def select_faces(mesh: Mesh, faces: np.ndarray | slice) -> Mesh:
    """Return a copy of a mesh with some faces (indices, mask or slice) and all of its vertices."""
    return replace(mesh, **{name: rows[faces] for name, rows in _rows_of_faces(mesh).items()})


def _rows_of_faces(mesh: Mesh) -> dict[str, Any]:
    """Return the arrays of a mesh with one row for each face. A matte mesh has no gloss."""
    return {name: getattr(mesh, name) for name in PER_FACE if getattr(mesh, name) is not None}


def by_material(mesh: Mesh, *columns: np.ndarray) -> Iterator[tuple[np.ndarray, int, Any]]:
    """Yield the faces (F,) of each texture and gloss, the texture's index and the gloss.

    The gloss is empty for a matte mesh. Faces that differ in `columns`, the first sort keys, are in
    different groups.
    """
    gloss = [] if mesh.gloss is None else [mesh.gloss]
    keys = np.column_stack([*columns, mesh.texture_ids, *gloss])
    for key in np.unique(keys, axis=0):
        texture_id, *group_gloss = key[len(columns) :].tolist()
        yield (keys == key).all(axis=1), int(texture_id), group_gloss


def _quartered(mesh: Mesh, encoding: str) -> Mesh:
    """Return a copy of a mesh in which each face is divided into four triangles (`subdivide`)."""
    edge_ends, edge_of_side = shared_edges(mesh.faces)
    midpoints = mesh.vertices[edge_ends].mean(axis=1)
    # Vertices of the three corners and of the three midpoints of each face, shape (F, 6). The
    # midpoints follow the old vertices.
    points = np.concatenate([mesh.faces, len(mesh.vertices) + edge_of_side], axis=1)
    # Two faces share the normal in the middle of an edge if they share the normals at both ends.
    _, normal_of_side = shared_edges(mesh.normal_ids)
    normals = np.concatenate([mesh.normal_ids, mesh.normal_ids.max() + 1 + normal_of_side], axis=1)
    # Shading interpolates linear colors.
    linear = decode(torch.from_numpy(mesh.corner_colors), encoding).numpy()
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, midpoints]),
        faces=points[:, _QUARTERS].reshape(-1, 3),
        corner_colors=encode(torch.from_numpy(_interpolate_quarters(linear)), encoding).numpy(),
        corner_uvs=_interpolate_quarters(mesh.corner_uvs),
        texture_ids=mesh.texture_ids.repeat(4),
        gloss=None if mesh.gloss is None else mesh.gloss.repeat(4, axis=0),
        normal_ids=normals[:, _QUARTERS].reshape(-1, 3),
    )


def shared_edges(faces: Int[np.ndarray, "F 3"]) -> tuple[np.ndarray, np.ndarray]:
    """List the ends (E, 2) of the edges of a mesh, and the edge (F, 3) of each side of a face."""
    vertex_count = faces.max() + 1
    # The two vertices of each side, the smaller index first, shape (3 F, 2).
    side_ends = np.sort(faces[:, EDGES].reshape(-1, 2), axis=1)
    # A side from vertex a to b gets the key a · V + b. np.unique sorts numbers faster than pairs.
    edge_keys, edge_of_side = np.unique(side_ends @ [vertex_count, 1], return_inverse=True)
    # Dividing the key a · V + b by V gives the quotient a and the remainder b.
    return np.stack(np.divmod(edge_keys, vertex_count), axis=1), edge_of_side.reshape(-1, 3)


def _interpolate_quarters(corner_values: Float[np.ndarray, "F 3 D"]) -> np.ndarray:
    """Interpolate corner values to the four parts of each face (`_QUARTERS`), (4 F, 3, D)."""
    # Axes: face, edge, end of the edge, value.
    midpoint_values = corner_values[:, EDGES].mean(axis=2)
    # Values at the three corners and the three midpoints of each face, shape (F, 6, D).
    point_values = np.concatenate([corner_values, midpoint_values], axis=1)
    return point_values[:, _QUARTERS].reshape(-1, *corner_values.shape[1:])
