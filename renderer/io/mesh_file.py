"""What readers of mesh files share: the files beside a mesh, numbers in text, polygons, colors."""

import io
import re
import warnings
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import mapbox_earcut
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Num
from PIL import Image, UnidentifiedImageError

from renderer.errors import MAX_MAGNITUDE, require_memory
from renderer.io.files import file_below
from renderer.io.images import eight_bits, identify
from renderer.mesh import NO_TEXTURE, Mesh, transformed
from renderer.visibility.numpy import doubled_areas

# Largest difference from the range [0, 1] that counts as rounding of a color.
TOLERANCE = 1e-3
# Bytes that a texel takes while its image is read and as a texture.
TEXEL_BYTES = 20
# Device of the textures.
CPU = torch.device("cpu")
# Opacity above which a surface counts as opaque.
OPAQUE = 1 - TOLERANCE


class Part(NamedTuple):
    """Mesh of a file, with its normals and its place in the scene.

    Attributes:
        mesh: Mesh in its own coordinates.
        normals: Normals of the corners of the faces in the file, of any length,
            shape (F, 3, 3). Zero for corners without a normal.
        matrix: Affine matrix that places the mesh in the scene, shape (4, 4).
    """

    mesh: Mesh
    normals: Float[np.ndarray, "F 3 3"]
    matrix: Float[np.ndarray, "4 4"] = np.eye(4)

    def placed(self) -> tuple[Mesh, Float[np.ndarray, "F 3 3"]]:
        """Return the mesh in the axes of the scene, and its normals there."""
        mesh = transformed(self.mesh, self.matrix)
        # Only finite normals count. Some programs write NaN for faces without area.
        normals = np.where(np.abs(self.normals) <= MAX_MAGNITUDE, self.normals, 0)
        # The matrix of cofactors is the inverse of the transpose times the determinant,
        # and exists even without an inverse.
        axes = self.matrix[:3, :3]
        cofactors = np.cross(axes[[1, 2, 0]], axes[[2, 0, 1]])
        if axes[0] @ cofactors[0] < 0:
            # `transformed` reverses the corners of a mirrored mesh.
            return mesh, normals[:, [0, 2, 1]] @ -cofactors.T
        return mesh, normals @ cofactors.T


class MeshFile:
    """Content of a mesh file, with the files beside it.

    Attributes:
        path: Path of the file.
        gloss: True if the gloss of materials is read, too.
        content: Content of the file.
        beside: Files that were read beside the mesh.
    """

    def __init__(self, path: Path, gloss: bool) -> None:
        self.path = path
        self.gloss = gloss
        self.content = path.read_bytes()
        self.beside: set[Path] = set()
        # Dictionaries without values, because sets have no order.
        self._ignored: dict[str, None] = {}
        self._assumptions: dict[str, None] = {}

    def read(self, name: str, folder: str = "") -> bytes:
        """Read a file below the folder of the mesh file.

        The file is sought in `folder`, at the given path, and by its name alone. The
        path may contain \\ instead of / and %20 instead of a blank.
        """
        written = name.strip('" \t').replace("\\", "/")
        errors = []
        # A name in a text file may be followed by a comment.
        paths = (written, unquote(written), re.split(r"\s+#", written)[0])
        names = [path.rpartition("/")[2] for path in paths]
        for candidate in (*(f"{folder}{path}" for path in paths), *paths, *names):
            try:
                found = file_below(self.path.parent, candidate)
            except ValueError as error:
                errors.append(error)
                continue
            self.beside.add(found)
            return found.read_bytes()
        raise errors[0]

    def texture(self, name: str, folder: str = "") -> np.ndarray:
        """Read an image file as a texture, uint8, shape (H, W, 3)."""
        pixels = np.array(decode_image(self.read(name, folder), name).convert("RGBA"))
        if pixels[..., 3].min() < 255:
            self.assume(f"the alpha of {name} is ignored")
        return np.ascontiguousarray(pixels[..., :3])

    def ignore(self, feature: str) -> None:
        """Note that a feature is ignored, which changes neither the shape nor the base color."""
        self._ignored[feature] = None

    def assume(self, assumption: str) -> None:
        """Note what the reader assumes, in a clause such as "the colors are sRGB-encoded"."""
        self._assumptions[assumption] = None

    def warn(self, stacklevel: int) -> None:
        """Warn once of all that was ignored or assumed."""
        if self._assumptions:
            warnings.warn(f"{self.path}: {'; '.join(self._assumptions)}", stacklevel=stacklevel + 1)
        if self._ignored:
            kind = self.path.suffix.lower()
            names = ", ".join(sorted(self._ignored))
            text = f"ignored in {kind} files, as they change neither shape nor color: {names}"
            warn_once(text, stacklevel + 1)


def decode_image(content: bytes | memoryview, name: str = "a texture") -> Image.Image:
    """Decode an image file with 8 bits per channel, if it fits into memory as a texture."""
    try:
        image = identify(io.BytesIO(content))
    except UnidentifiedImageError as error:
        raise ValueError(f"{name} is no image that can be read: save it as PNG or JPEG") from error
    require_memory("textures", TEXEL_BYTES * image.width * image.height, CPU)
    return eight_bits(image)


# Python's own filter forgets what it has shown whenever a library changes the filters.
@cache
def warn_once(text: str, stacklevel: int) -> None:
    """Warn, but only once in a process, so that the files of a set do not repeat a warning."""
    warnings.warn(text, stacklevel=stacklevel + 1)


def as_utf8(text: bytes) -> bytes:
    """Convert text with a byte-order mark, and other text that may be Latin-1, to UTF-8."""
    if text.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = text.decode("utf-16").encode()
    text = text.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in text:
        raise ValueError("the text has NUL bytes, so the file is damaged: export it again")
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


def without_comments(text: bytes) -> bytes:
    """Remove comments from # on, but keep 1.#IND and 1.#INF, which are NaN and infinity."""
    return re.sub(rb"(?<!\.)#.*", b"", text)


def require_bounded(**values: np.ndarray) -> None:
    """Raise `ValueError` if numbers of a file are not finite or huge."""
    for name, numbers in values.items():
        # A comparison with NaN is False, so `not` also finds NaN.
        if not (np.abs(numbers) <= MAX_MAGNITUDE).all():
            raise ValueError(f"{name} are not finite or beyond {MAX_MAGNITUDE:g}")


def parse_numbers(text: bytes, dtype: type) -> np.ndarray:
    """Parse numbers between blanks or line breaks."""
    if not text.strip():
        return np.zeros(0, dtype)
    # NumPy stops at a word that is no number, with a warning or, in new versions, an error.
    with warnings.catch_warnings(action="error", category=DeprecationWarning):
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (ValueError, DeprecationWarning) as error:
            raise ValueError("a word is not a number: export the file again") from error


def words_per_line(text: bytes) -> np.ndarray:
    """Count the words of each line of a text that ends with a line break."""
    characters = np.frombuffer(b"\n" + text, dtype=np.uint8)
    # A word begins where a character follows a blank or a line break.
    is_blank = characters <= ord(" ")
    lines = np.cumsum(characters == ord("\n"))[1:][is_blank[:-1] & ~is_blank[1:]] - 1
    return np.bincount(lines, minlength=text.count(b"\n"))


def triangles_of(
    file: MeshFile,
    vertices: Num[np.ndarray, "V 3"],
    indices: Int[np.ndarray, " C"],
    sizes: Int[np.ndarray, " P"],
) -> tuple[np.ndarray, np.ndarray]:
    """Divide the faces of a file into triangles.

    The result is the places in `indices` of the corners of the T triangles, shape (T, 3), and the
    face of each triangle.
    """
    require_bounded(coordinates=vertices)
    highest = len(vertices) - 1
    if len(indices) and not 0 <= indices.min() <= indices.max() <= highest:
        raise ValueError(f"a face has a vertex that is not from 0 to {highest}")
    is_face = sizes >= 3
    if not is_face.all():
        file.ignore("faces with fewer than 3 corners")
    # Places in `indices` of the corners of polygons with at least 3 corners.
    places = np.flatnonzero(is_face.repeat(sizes))
    corners, polygons, crossing_count = triangulate(vertices[indices[places]], sizes[is_face])
    if crossing_count:
        file.assume(f"{crossing_count} faces intersect themselves, so their shape is unclear")
    return places[corners], np.flatnonzero(is_face)[polygons]


def colored_mesh(
    vertices: Num[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colors: np.ndarray,
    uvs: Float[np.ndarray, "F 3 2"] | None = None,
    texture_ids: Int[np.ndarray, " F"] | None = None,
    textures: Sequence[np.ndarray] = (),
) -> Mesh:
    """Create a matte mesh from the arrays of a file.

    Colors are sRGB-encoded in [0, 1], and absent texture coordinates are NaN. Without
    `texture_ids`, all faces have the first texture.
    """
    if texture_ids is None:
        texture_ids = np.full(len(faces), 0 if textures else NO_TEXTURE)
    is_textured = texture_ids != NO_TEXTURE
    # Faces without a texture keep texture coordinates of 0.
    corner_uvs = np.zeros((len(faces), 3, 2), dtype=np.float32)
    if is_textured.any():
        if uvs is None or np.isnan(uvs[is_textured]).any():
            raise ValueError("faces with a texture have no texture coordinates")
        require_bounded(texture_coordinates=uvs[is_textured])
        corner_uvs[is_textured] = uvs[is_textured]
    return Mesh(
        vertices=vertices.astype(np.float64),
        faces=faces,
        corner_colors=np.broadcast_to(colors, (len(faces), 3, 3)).astype(np.float32),
        corner_uvs=corner_uvs,
        texture_ids=texture_ids.astype(np.int32),
        textures=tuple(textures),
        # Sharp edges are found later, when equal positions have become one vertex.
        normal_ids=faces,
    )


def unit_colors(colors: np.ndarray, file: MeshFile) -> np.ndarray:
    """Convert colors to [0, 1].

    Unsigned integers of 8 and 16 bits are divided by their maximum. Other numbers
    are from 0 to 1, or from 0 to 255.
    """
    if colors.dtype in (np.uint8, np.uint16):
        return colors / np.iinfo(colors.dtype).max
    # A color of 2 or more cannot be in [0, 1], and whole numbers look like bytes.
    is_whole = (colors == np.round(colors)).all()
    if colors.dtype.kind in "iu" or (is_whole and 1 + TOLERANCE < colors.max(initial=0) <= 255):
        file.assume("colors are taken as values from 0 to 255")
        colors = colors / 255
    # A comparison with NaN is False, so `not` also finds NaN.
    if not ((colors >= -TOLERANCE) & (colors <= 1 + TOLERANCE)).all():
        raise ValueError("colors are out of range: give values from 0 to 1, or bytes")
    return colors.astype(np.float64).clip(0, 1)


def beside_textures(
    colors: Float[np.ndarray, "F 3 3"], is_textured: Bool[np.ndarray, " F"], file: MeshFile
) -> np.ndarray:
    """Return corner colors that are white on faces with a texture.

    Programs for scans write the same color at vertices and in the texture. No product is meant.
    """
    if (colors[is_textured] < 1).any():
        file.assume("the texture is taken as the color, not the colors of its vertices or faces")
    return np.where(is_textured[:, None, None], 1.0, colors)


# Axes that remain if a polygon is projected along the axis x, y or z. A
# polygon that is counter-clockwise seen from the positive axis stays so.
_REMAINING_AXES = np.array([[1, 2], [2, 0], [0, 1]])
# Largest relative difference of areas that counts as rounding.
_AREA_TOLERANCE = 1e-6


def triangulate(
    corners: Num[np.ndarray, "C 3"], sizes: Int[np.ndarray, " P"]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Divide polygons into triangles that cover the same area, also if the polygons are concave.

    All corners of a polygon are corners of its triangles, also corners on a
    straight edge. Neighboring faces therefore still share their vertices. The results are
    the corners of the triangles, the ascending polygon of each triangle, and the number of
    polygons that intersect themselves, whose area is unclear.
    """
    # First corner of each polygon. A polygon with n corners has n - 2 triangles.
    starts = np.cumsum(sizes) - sizes
    triangle_counts = sizes - 2
    polygons = np.arange(len(sizes)).repeat(triangle_counts)
    first_triangles = np.cumsum(triangle_counts) - triangle_counts
    # Number of each triangle within its polygon.
    steps = np.arange(len(polygons)) - first_triangles[polygons]
    # Each fan of triangles is around the first corner of the polygon.
    triangles = starts[polygons, None] + np.stack([0 * steps, steps + 1, steps + 2], axis=1)
    if (sizes == 3).all():
        return triangles, polygons, 0
    # Corners in the plane of their polygon, in which it is counter-clockwise, shape (C, 2).
    points = _projected(corners, starts, sizes)
    # A fan of counter-clockwise triangles covers the polygon. A triangle always is such a fan.
    is_fan = np.minimum.reduceat(doubled_areas(points[triangles].T), first_triangles) >= 0
    parts = [triangles[is_fan[polygons]]]
    owners = [polygons[is_fan[polygons]]]
    crossing_count = 0
    for polygon in np.flatnonzero(~is_fan):
        polygon_points = points[starts[polygon] : starts[polygon] + sizes[polygon]]
        clipped, is_crossing = _clip_ears(polygon_points)
        crossing_count += is_crossing
        parts.append(starts[polygon] + clipped)
        owners.append(np.full(len(clipped), polygon))
    polygons = np.concatenate(owners)
    # Triangles of fans come before clipped ones. Sort them by polygon.
    order = np.argsort(polygons, kind="stable")
    return np.concatenate(parts)[order], polygons[order], crossing_count


def _projected(corners: np.ndarray, starts: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Project polygons along the largest component of their normals, so that they turn left.

    The coordinates are relative to the first corner of the polygon, shape (C, 2).
    """
    relative = corners - corners[starts].repeat(sizes, axis=0)
    # Index of the next corner of the same polygon.
    following = np.arange(1, len(corners) + 1)
    following[starts + sizes - 1] = starts
    # Newell's normal, whose length is twice the area of a planar polygon.
    normals = np.add.reduceat(np.cross(relative, relative[following]), starts)
    axes = np.abs(normals).argmax(axis=1)
    remaining = _REMAINING_AXES[axes]
    is_clockwise = np.take_along_axis(normals, axes[:, None], axis=1)[:, 0] < 0
    # Swapping both axes mirrors a polygon, so that it is counter-clockwise.
    remaining[is_clockwise] = remaining[is_clockwise, ::-1]
    return np.take_along_axis(relative, remaining.repeat(sizes, axis=0), axis=1)


def _clip_ears(points: Num[np.ndarray, "N 2"]) -> tuple[Int[np.ndarray, "T 3"], bool]:
    """Divide a counter-clockwise polygon into triangles, and tell whether it intersects itself."""
    count = len(points)
    ends = np.array([count], dtype=np.uint32)
    # Earcut cuts triangles (ears) off the polygon until nothing is left.
    triangles = mapbox_earcut.triangulate_float64(points, ends).astype(np.int64).reshape(-1, 3)
    if not len(triangles):  # The polygon has no area.
        fan = np.arange(1, count - 1)
        return np.stack([0 * fan, fan, fan + 1], axis=1), False
    if doubled_areas(points[triangles].T).sum() < 0:
        triangles = triangles[:, ::-1]
    # The ears leave out some corners on straight edges. Each triangle
    # at such an edge is divided, so that it has these corners, too.
    used_corners = np.unique(triangles)
    for start, end in pairwise([*used_corners, used_corners[0] + count]):
        if end == start + 1:
            continue
        # Corners that were left out, with the corners before and behind them.
        chain = np.arange(start, end + 1) % count
        is_at_edge = (triangles == chain[0]) & (np.roll(triangles, -1, axis=1) == chain[-1])
        if not is_at_edge.any():
            continue
        row, column = np.argwhere(is_at_edge)[0]
        # Replace the triangle by a fan around the corner opposite to the edge.
        opposite = np.full(len(chain) - 1, triangles[row, column - 1])
        fan = np.stack([chain[:-1], chain[1:], opposite], axis=1)
        triangles = np.concatenate([np.delete(triangles, row, axis=0), fan])
    # Twice the area of the polygon (shoelace formula). Triangles of a polygon that intersects
    # itself cover another area.
    following = np.roll(points, -1, axis=0)
    area = (points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum()
    covered = np.abs(doubled_areas(points[triangles].T)).sum()
    return triangles, bool(abs(covered - area) > _AREA_TOLERANCE * np.ptp(points, axis=0).prod())
