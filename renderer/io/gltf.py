"""Read meshes from glTF 2.0 files, and cut out the parts of a surface whose alpha is too small.

Shape (with the default weights of morph targets), color, alpha and gloss are
read. A feature that changes neither the shape nor the base color is ignored and
named in a warning. A file that has any other feature, such as joints, is refused.

A part is a mesh with one material (a primitive of glTF). The renderer has no
transparency, so holes are cut into the faces. Faces that the border of a hole
crosses are divided until their sides are shorter than a texel. The border is
straight within such a face.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import map_coordinates

from renderer.errors import require_memory
from renderer.image import encode
from renderer.io.gltf_file import QUANTIZATION, GltfFile, Material, ignored_features, read_material
from renderer.io.mesh_file import CPU, MeshFile, Part, colored_mesh, require_bounded
from renderer.mesh import shared_edges

# Kind of primitives that consist of triangles (5.24.4). Lower numbers are points and lines.
TRIANGLES = 4
# Alpha from which on a texel with 8 bits counts as opaque.
ALMOST_ONE = 1 - 0.5 / 255
# Widths of the attributes of vertices that are read (3.7.2.1), by the first part of their names.
ATTRIBUTES = {"POSITION": (3,), "NORMAL": (3,), "TEXCOORD": (2,), "COLOR": (3, 4)}
# Bytes that a face and a vertex take while the parts are read and joined.
FACE_BYTES = 2000
VERTEX_BYTES = 1000

# Columns of the values of vertices.
POSITION = slice(0, 3)
U, V, ALPHA = 3, 4, 5
COLOR = slice(6, 9)
NORMAL = slice(9, 12)


class _Surface(NamedTuple):
    """Faces whose vertices have values.

    Attributes:
        values: Position (3), texture coordinates (2), alpha, linear color (3) and normal (3) of
            the V vertices, shape (V, 12). Normals of 0 if the file has none.
        faces: Vertex indices of the corners of the F faces, shape (F, 3).
    """

    values: Float[np.ndarray, "V 12"]
    faces: Int[np.ndarray, "F 3"]


def read_gltf(file: MeshFile) -> list[Part]:
    """Read the parts of a .gltf or .glb file in the axes of its scene."""
    gltf = GltfFile(file)
    for feature in ignored_features(gltf.tree):
        file.ignore(feature)
    # Nodes may share a mesh, and meshes a material. Each is read once and cached.
    material = cache(partial(read_material, gltf))
    read_part = cache(partial(_read_part, gltf, material))
    placed_parts = []
    # Bytes of memory for all parts.
    needed = 0
    for index in gltf.scene_nodes():
        node = gltf.tree["nodes"][index]
        # A scale of 0 hides an object.
        if "mesh" not in node or not gltf.poses[index][:3, :3].any():
            continue
        if "skin" in node:
            raise ValueError("joints move its vertices: apply the armature, and export it")
        mesh = gltf.entry("meshes", node["mesh"])
        # Weights of the morph targets. Those of the node replace those of the mesh.
        weights = tuple(node.get("weights", mesh.get("weights", ())))
        for number, primitive in enumerate(mesh["primitives"]):
            mode = primitive.get("mode", TRIANGLES)
            if mode > TRIANGLES:
                raise ValueError("it has strips or fans of triangles: export single triangles")
            if mode < TRIANGLES:
                file.ignore("points and lines")
            else:
                surface, material_of_part = read_part(node["mesh"], number, weights)
                # A small file can show one mesh very often.
                needed += FACE_BYTES * len(surface.faces) + VERTEX_BYTES * len(surface.values)
                require_memory("its faces", needed, CPU)
                placed_parts += _place(surface, material_of_part, gltf.poses[index])
    modes = {material.get("alphaMode") for material in gltf.tree.get("materials", ())}
    if not placed_parts and "MASK" in modes:
        raise ValueError("its alpha cuts out all faces (alphaMode MASK): use OPAQUE")
    return placed_parts


def _read_part(
    file: GltfFile, material_of: Any, mesh: int, number: int, weights: tuple[float, ...]
) -> tuple[_Surface, Material]:
    """Read a primitive of a mesh, with its morph targets at the given weights.

    Return its surface in its own axes, and its material.
    """
    primitive = file.tree["meshes"][mesh]["primitives"][number]
    material: Material = material_of(primitive.get("material"))
    # Name of the attribute with the texture coordinates that the textures use.
    uv_name = "" if material.placement is None else f"TEXCOORD_{material.placement.uv_set}"
    # Arrays of the file by name, such as "POSITION", with one row for each vertex.
    attributes = _attributes(file, primitive, weights, uv_name)
    positions = attributes["POSITION"]
    faces = _faces(file, primitive, len(positions))
    # Linear red, green, blue and alpha of each vertex. Without COLOR_0, they are 1.
    colors = np.ones((len(positions), 4))
    # The file may leave out alpha, the fourth column.
    file_colors = colors if material.is_emitted else attributes.get("COLOR_0", colors)
    colors[:, : file_colors.shape[1]] = np.clip(file_colors, 0, 1)
    colors *= material.color
    if material.placement is not None and uv_name not in attributes:
        raise ValueError("the mesh has a texture, but no texture coordinates")
    uvs = attributes.get(uv_name, np.zeros((len(positions), 2)))
    require_bounded(coordinates=positions, colors=colors, **{"texture coordinates": uvs})
    # From here on, texture coordinates are those of `Mesh`: textures repeat, and v points up.
    material, uvs = material.placed(uvs, file)
    normals = attributes.get("NORMAL", np.zeros_like(positions))
    # The columns have the order of `_Surface.values`.
    values = np.column_stack([positions, uvs, colors[:, 3], colors[:, :3], normals])
    return _Surface(values, faces), material


def _attributes(
    file: GltfFile, primitive: dict[str, Any], weights: tuple[float, ...], uv_name: str
) -> dict[str, np.ndarray]:
    """Read the vertex attributes that are used of a primitive, with morph targets (3.7.2.2)."""
    attributes = {}
    for name, index in primitive["attributes"].items():
        # "TEXCOORD" for the name "TEXCOORD_1".
        kind = name.partition("_")[0]
        if name not in ("POSITION", "NORMAL", "COLOR_0", uv_name):
            continue
        values = file.array(index)
        if values.ndim != 2 or values.shape[1] not in ATTRIBUTES[kind]:
            raise ValueError(f"{name} has a wrong number of values for each vertex")
        if values.dtype.kind in "iu":
            # Colors must be normalized. Files that forget to say so are common.
            if kind == "COLOR":
                values = values / np.iinfo(values.dtype).max
            elif QUANTIZATION not in file.tree.get("extensionsUsed", ()):
                raise ValueError(f"{name} has integers without {QUANTIZATION}: export it again")
        attributes[name] = values.astype(np.float64)
    # Each morph target has changes of attributes, which are added with a weight each.
    targets = primitive.get("targets", [])
    if weights and len(weights) != len(targets):
        raise ValueError(f"it has {len(weights)} weights for {len(targets)} morph targets")
    for weight, target in zip(weights, targets, strict=False):
        for name, index in target.items():
            if weight != 0 and name in attributes:
                change = file.array(index)
                # NumPy would repeat a single row.
                if len(change) != len(attributes[name]):
                    raise ValueError(f"a morph target has {len(change)} entries of {name}")
                attributes[name] = attributes[name] + weight * change
    counts = {name: len(values) for name, values in attributes.items()}
    if len({*counts.values()}) > 1:
        raise ValueError(f"its attributes have unequal numbers of entries: {counts}")
    return attributes


def _faces(file: GltfFile, primitive: dict[str, Any], vertex_count: int) -> np.ndarray:
    """Return the vertex indices of the corners of the faces of a primitive (3.7.2.1)."""
    indices = np.arange(vertex_count)
    if "indices" in primitive:
        indices = file.array(primitive["indices"]).ravel()
        if indices.dtype.kind != "u" or indices.max(initial=0) >= vertex_count:
            raise ValueError(f"it has indices of faces beyond its {vertex_count} vertices")
        indices = indices.astype(np.int64)
    return indices[: len(indices) // 3 * 3].reshape(-1, 3)


def _place(surface: _Surface, material: Material, pose: Float[np.ndarray, "4 4"]) -> list[Part]:
    """Return a part without its holes, with its matrix in the scene, or none if no face is left."""
    visible = surface
    if material.mode != "OPAQUE":
        # The alpha of a material decides what is visible (3.9.6).
        cutoff = ALMOST_ONE if material.mode == "BLEND" else material.cutoff
        visible = _cut_out(surface, material.alpha, cutoff)
    if material.mode == "BLEND" and visible is not surface:
        raise ValueError("its surface is transparent (alphaMode BLEND): use OPAQUE or MASK")
    values, faces = visible
    if not len(faces):
        return []
    vertices = values[:, POSITION]
    # Axes: face, corner, column of the values.
    corners = values[faces]
    colors = encode(torch.from_numpy(corners[..., COLOR]), "srgb").numpy()
    textures = [] if material.texture is None else [material.texture]
    mesh = colored_mesh(vertices, faces, colors, corners[..., U:ALPHA], textures=textures)
    if material.gloss is not None:
        # All faces have the same roughness, metallic and specular factor.
        gloss = np.tile(material.gloss.astype(np.float32), (len(faces), 1))
        texture = material.gloss_texture
        mesh = replace(mesh, gloss=gloss, gloss_textures=() if texture is None else (texture,))
    return [Part(mesh, corners[..., NORMAL], pose)]


# Largest alpha of a texel.
FULL = 255
# Largest number of faces before the last division.
MAX_FACES = 10**6


class _AlphaTexture:
    """Alpha of a texture, which repeats, and its range within rectangles."""

    def __init__(self, texels: UInt8[np.ndarray, "H W"]) -> None:
        """Compute the minimum and the maximum of the 2^n × 2^n texels from each texel on."""
        self.texels = texels
        # Axes: level, minimum or maximum, row, column. On level 0, both are the texel.
        level_count = 1 + (max(texels.shape) - 1).bit_length()
        self._levels = np.tile(texels, (level_count, 2, 1, 1))
        for level in range(1, level_count):
            low, high = self._levels[level - 1]
            for axis in (0, 1):
                # Two neighboring squares of half the size, first along rows and then along columns,
                # make one of the next level. The texture repeats, so `roll` wraps around.
                step = -(2 ** (level - 1))
                low = np.minimum(low, np.roll(low, step, axis))
                high = np.maximum(high, np.roll(high, step, axis))
            self._levels[level] = low, high

    def ranges(self, positions: np.ndarray) -> np.ndarray:
        """Return bounds (2, F) of alpha within F faces with corners at positions (F, 3, 2)."""
        # First texel, and number of columns and rows, of the rectangle around each face.
        start = np.floor(positions.min(axis=1)).astype(np.int64)
        extent = np.floor(positions.max(axis=1)).astype(np.int64) + 2 - start
        # From the last level on, a square holds all texels.
        # Level n has the ranges of squares of 2^n texels, so this is the smallest that fits.
        levels = np.ceil(np.log2(extent.max(axis=1))).astype(np.int64)
        levels = np.minimum(levels, len(self._levels) - 1)
        column, row = (start % self.texels.shape[::-1]).T
        return self._levels[levels, :, row, column].T / FULL


def _cut_out(given: _Surface, texels: UInt8[np.ndarray, "H W"] | None, cutoff: float) -> _Surface:
    """Remove the parts of a surface whose alpha is below a value.

    Alpha is the interpolated product of the texture, or 1 without texels, and of the alpha of
    corners. All values are interpolated linearly at new vertices. Faces that share an edge also
    share the new vertices on it.
    """
    surface = given
    texture = _AlphaTexture(np.full((1, 1), FULL, np.uint8) if texels is None else texels)
    while True:
        values, faces = surface
        # Columns and rows of the vertices, in texels, shape (V, 2).
        height, width = texture.texels.shape
        positions = np.stack([values[:, U] * width, (1 - values[:, V]) * height], axis=1) - 0.5
        corners = positions[faces]
        # Smallest and largest alpha of the texture within each face, shape (F,).
        low, high = texture.ranges(corners)
        alphas = values[faces, ALPHA]
        # A face is shown if its alpha may reach the cutoff, and crossed if its alpha may also be
        # below.
        is_shown = high * alphas.max(axis=1) >= cutoff
        is_crossed = is_shown & (low * alphas.min(axis=1) < cutoff)
        # Lengths, in texels, of the sides 0-1, 1-2 and 2-0 of each face.
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        is_large = is_crossed & (lengths.max(axis=1) > 1)
        # Without a texture, alpha is linear in each face, so faces need not be divided.
        if texels is None or not is_large.any():
            break
        if len(faces) > MAX_FACES:
            fault = f"the border of its alpha needs more than {MAX_FACES} faces"
            raise ValueError(f"{fault}: smooth it")
        surface = _halve(values, faces[is_shown], lengths[is_shown], is_large[is_shown])
    # SciPy has rows first.
    places = positions.T[::-1]
    flat_alpha = map_coordinates(texture.texels, places, np.float64, order=1, mode="grid-wrap")
    # Alpha of each vertex minus the cutoff. It is 0 at the border of a hole.
    excess = flat_alpha / FULL * values[:, ALPHA] - cutoff
    crossed = faces[is_crossed]
    if is_shown.all() and not (excess[crossed] < 0).any():
        return given
    values, cut_faces = _cut(values, crossed, excess)
    return _Surface(values, np.concatenate([faces[is_shown & ~is_crossed], cut_faces]))


def _halve(
    values: np.ndarray, faces: np.ndarray, lengths: np.ndarray, is_large: np.ndarray
) -> _Surface:
    """Halve some faces at an edge that is the longest of all faces around it, so no crack opens.

    Such an edge is at the end of a path from each large face over the longest edge to the next
    face (Rivara 1984). `lengths` are those of the sides 0-1, 1-2 and 2-0, shape (F, 3).
    """
    # Ends (E, 2) of the E edges, and the edge of each side of each face, shape (F, 3).
    ends, edge_of_side = shared_edges(faces)
    edge_length = np.zeros(len(ends))
    edge_length[edge_of_side] = lengths
    # Edges of one length are ordered by their numbers.
    rank = np.argsort(np.argsort(edge_length, kind="stable"))
    # Number of the longest side of each face, 0 to 2.
    longest = rank[edge_of_side].argmax(axis=1)
    longest_edge = np.take_along_axis(edge_of_side, longest[:, None], axis=1)[:, 0]
    # Also mark the longest edge of each face that has a marked edge, until none is new.
    is_halved = np.zeros(len(ends), dtype=bool)
    touched = is_large
    while not is_halved[longest_edge[touched]].all():
        is_halved[longest_edge[touched]] = True
        touched = is_halved[edge_of_side].any(axis=1)
    # Keep only edges that are the longest side of all faces around them.
    is_halved[edge_of_side[edge_of_side != longest_edge[:, None]]] = False
    divided = is_halved[longest_edge]
    # Corners 0 and 1 are the ends of the longest side, and point 3 is its middle.
    order = (longest[divided, None] + np.arange(3)) % 3
    # Middles become new vertices behind the present ones, in the order of their edges.
    middle = len(values) + (np.cumsum(is_halved) - 1)[longest_edge[divided]]
    points = np.column_stack([np.take_along_axis(faces[divided], order, axis=1), middle])
    return _Surface(
        np.concatenate([values, values[ends[is_halved]].mean(axis=1)]),
        np.concatenate([faces[~divided], points[:, [0, 3, 2]], points[:, [3, 1, 2]]]),
    )


def _cut(values: np.ndarray, faces: np.ndarray, excess: Float[np.ndarray, " V"]) -> _Surface:
    """Keep the parts of faces where `excess`, which is linear in each face, is not negative."""
    # For each corner, True if it lies on the part that stays.
    is_kept = excess[faces] >= 0
    count = is_kept.sum(axis=1)
    is_whole, is_cut = count == 3, (count == 1) | (count == 2)
    # The corner 0 is the one that differs from both others.
    odd = np.where(count == 1, is_kept.argmax(axis=1), is_kept.argmin(axis=1))[is_cut]
    turned = np.take_along_axis(faces[is_cut], (odd[:, None] + np.arange(3)) % 3, axis=1)
    # Points 3 and 4 lie on the sides 0-1 and 0-2.
    sides = np.sort(turned[:, [[0, 1], [0, 2]]].reshape(-1, 2), axis=1)
    # One integer for both ends of a side, so that faces with a common side share the new vertex.
    keys, point_of_side = np.unique(sides @ [len(values), 1], return_inverse=True)
    low, high = np.divmod(keys, len(values))
    # The excess is linear along the side, and 0 at this fraction of the way.
    share = excess[low] / (excess[low] - excess[high])
    points = values[low] + share[:, None] * (values[high] - values[low])
    ids = np.column_stack([turned, len(values) + point_of_side.reshape(-1, 2)])
    # One kept corner leaves a triangle. Two leave a quadrilateral, that is, two triangles.
    single = count[is_cut] == 1
    pieces = [ids[single][:, [0, 3, 4]], ids[~single][:, [3, 1, 2]], ids[~single][:, [3, 2, 4]]]
    return _Surface(np.concatenate([values, points]), np.concatenate([faces[is_whole], *pieces]))
