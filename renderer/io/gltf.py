"""Read meshes from glTF 2.0 files.

Shape (with the default weights of morph targets and the default pose of
joints), color, alpha and gloss are read. A feature that changes neither the
shape nor the base color is ignored and named in a warning. A file that has any
other feature is refused.

A part is a mesh with one material (a primitive of glTF).
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from renderer.image import encode
from renderer.io.cutout import cut_out
from renderer.io.gltf_file import GltfFile
from renderer.io.gltf_material import QUANTIZATION, Material, ignored_features, read_material
from renderer.io.mesh_file import MeshFile, Part, require_bounded
from renderer.memory import require_memory
from renderer.mesh import NO_TEXTURE, Mesh

# Kinds of primitives that consist of triangles (5.24.4).
TRIANGLES = 4
STRIP = 5
FAN = 6
# Alpha from which on a texel with 8 bits counts as opaque.
ALMOST_ONE = 1 - 0.5 / 255
# Widths of the attributes of vertices that are read (3.7.2.1), by the first part of their names.
ATTRIBUTES = {
    "POSITION": (3,),
    "NORMAL": (3,),
    "TEXCOORD": (2,),
    "COLOR": (3, 4),
    "JOINTS": (4,),
    "WEIGHTS": (4,),
}
# Beginnings of the names of attributes that joints use.
SKINNING = ("JOINTS", "WEIGHTS")
DRACO = "KHR_draco_mesh_compression"
# Bytes that a face and a vertex take while the parts are read and joined.
FACE_BYTES = 2000
VERTEX_BYTES = 400
# The same for a vertex that joints move.
SKINNED_VERTEX_BYTES = 1000
# The weights of the joints of a vertex should add up to 1. Their sum may
# differ from 1 by at most this much, because weights with 8 bits are rounded.
MAX_WEIGHT_ERROR = 0.01


@dataclass(frozen=True)
class _Primitive:
    """Part in its own axes, with V vertices and F faces.

    Attributes:
        positions: Positions of the vertices, shape (V, 3).
        faces: Vertex indices of the corners, shape (F, 3).
        corners: Texture coordinates (2), alpha, linear color (3) and normal (3)
            of the corners, shape (F, 3, 9). Normals of 0 if the file has none.
        material: Material of the part.
        joints: Attributes JOINTS_n and WEIGHTS_n of the vertices.
    """

    positions: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    corners: Float[np.ndarray, "F 3 9"]
    material: Material
    joints: dict[str, np.ndarray]


def read_gltf(mesh_file: MeshFile, gloss: bool) -> list[Part]:
    """Read the parts of a .gltf or .glb file in the axes of its scene."""
    file = GltfFile(mesh_file)
    for feature in ignored_features(file.tree):
        mesh_file.ignore(feature)
    nodes = [node for node in file.scene_nodes() if "mesh" in file.tree["nodes"][node]]
    _require_memory(file, nodes)
    material = cache(lambda index: read_material(file, index, gloss))
    part = cache(lambda *key: _read_part(file, material, *key))
    placed_parts = []
    for index in nodes:
        node = file.tree["nodes"][index]
        mesh = file.entry("meshes", node["mesh"])
        weights = tuple(node.get("weights", mesh.get("weights", ())))
        for number, primitive in enumerate(mesh["primitives"]):
            if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
                mesh_file.ignore("points and lines")
            else:
                read = part(node["mesh"], number, weights)
                placed_parts += _place(file, index, read)
    if not placed_parts and any(
        m.get("alphaMode") == "MASK" for m in file.tree.get("materials", ())
    ):
        raise ValueError("its alpha cuts out all faces (alphaMode MASK): use OPAQUE")
    return placed_parts


def _require_memory(file: GltfFile, nodes: list[int]) -> None:
    """Check that the faces that the nodes show fit into the memory, before arrays are read.

    A small file can show one mesh very often, or declare an array of zeros.
    """
    needed = 0
    for index in nodes:
        node = file.tree["nodes"][index]
        for primitive in file.entry("meshes", node["mesh"])["primitives"]:
            vertices = file.entry("accessors", primitive["attributes"]["POSITION"])["count"]
            corners = vertices
            if "indices" in primitive:
                corners = file.entry("accessors", primitive["indices"])["count"]
            faces = corners / 3 if primitive.get("mode", TRIANGLES) == TRIANGLES else corners
            copies = file.instance_count(index)
            vertex_bytes = SKINNED_VERTEX_BYTES if "skin" in node else VERTEX_BYTES
            needed += copies * int(FACE_BYTES * faces + vertex_bytes * vertices)
    require_memory("its faces", needed, torch.device("cpu"))


def _read_part(
    file: GltfFile, material_of: Any, mesh: int, number: int, weights: tuple[float, ...]
) -> _Primitive:
    """Read a primitive of a mesh, with its morph targets at the given weights."""
    primitive = file.tree["meshes"][mesh]["primitives"][number]
    material: Material = material_of(primitive.get("material"))
    uv_name = "" if material.placement is None else f"TEXCOORD_{material.placement.uv_set}"
    attributes = _attributes(file, primitive, weights, uv_name)
    positions = attributes["POSITION"]
    faces = _faces(file, primitive, len(positions))
    colors = np.ones((len(positions), 4))
    if "COLOR_0" in attributes:
        given = attributes["COLOR_0"]
        colors[:, : given.shape[1]] = np.clip(given, 0, 1)
    colors *= material.color
    uvs = np.zeros((len(positions), 2))
    if material.placement is not None:
        if uv_name not in attributes:
            raise ValueError("the mesh has a texture, but no texture coordinates")
        uvs = attributes[uv_name]
    require_bounded(coordinates=positions, colors=colors, **{"texture coordinates": uvs})
    material, uvs = material.placed(uvs)
    normals = attributes.get("NORMAL", np.zeros_like(positions))
    values = np.concatenate([uvs, colors[:, 3:], colors[:, :3], normals], axis=1)
    joints = {key: v for key, v in attributes.items() if key.startswith(SKINNING)}
    return _Primitive(positions, faces, values[faces], material, joints)


def _attributes(
    file: GltfFile, primitive: dict[str, Any], weights: tuple[float, ...], uv_name: str
) -> dict[str, np.ndarray]:
    """Read the attributes of the vertices of a primitive, with its morph targets (3.7.2.2).

    Attributes that nothing uses, such as other texture coordinates, are not read.
    """
    if DRACO in primitive.get("extensions", {}) and any(
        "bufferView" not in file.entry("accessors", index)
        for index in primitive["attributes"].values()
    ):
        raise ValueError(f"its arrays are compressed ({DRACO}): export it without compression")
    attributes = {}
    for name, index in primitive["attributes"].items():
        kind = name.partition("_")[0]
        if name not in ("POSITION", "NORMAL", "COLOR_0", uv_name) and kind not in SKINNING:
            continue
        values = file.array(index)
        if values.ndim != 2 or values.shape[1] not in ATTRIBUTES[kind]:
            raise ValueError(f"{name} has a wrong number of values for each vertex")
        is_vector = kind != "JOINTS"
        if is_vector and values.dtype.kind in "iu":
            # Colors and weights must be normalized. Files that forget to say so are common.
            if kind in ("COLOR", "WEIGHTS"):
                values = values / np.iinfo(values.dtype).max
            elif QUANTIZATION not in file.tree.get("extensionsUsed", ()):
                raise ValueError(f"{name} has integers without {QUANTIZATION}: export it again")
        attributes[name] = values.astype(np.float64) if is_vector else values
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
    vertex_count = len(attributes["POSITION"])
    for name, values in attributes.items():
        if len(values) != vertex_count:
            raise ValueError(f"{name} has {len(values)} entries for {vertex_count} vertices")
    return attributes


def _faces(file: GltfFile, primitive: dict[str, Any], vertex_count: int) -> np.ndarray:
    """Return the vertex indices of the corners of the faces of a primitive (3.7.2.1)."""
    indices = np.arange(vertex_count)
    if "indices" in primitive:
        indices = file.array(primitive["indices"]).ravel()
        if indices.dtype.kind != "u" or indices.max(initial=0) >= vertex_count:
            raise ValueError(f"it has indices of faces beyond its {vertex_count} vertices")
        indices = indices.astype(np.int64)
    mode = primitive.get("mode", TRIANGLES)
    if mode == TRIANGLES or len(indices) < 3:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode == FAN:
        first = np.full(max(len(indices) - 2, 0), indices[0])
        faces = np.stack([indices[1:-1], indices[2:], first], axis=1)
    else:
        faces = np.lib.stride_tricks.sliding_window_view(indices, 3).copy()
        # Every second face of a strip has the opposite orientation.
        faces[1::2] = faces[1::2][:, [0, 2, 1]]
    # Faces that only join the parts of a strip have the same vertex twice.
    is_face = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return faces[is_face]


def _place(file: GltfFile, index: int, part: _Primitive) -> list[Part]:
    """Place a part in the scene, once for each copy that a node shows, and cut out its holes."""
    if not len(part.faces):
        return []
    poses = file.instances(index)
    vertices = part.positions
    node = file.tree["nodes"][index]
    if "skin" in node:
        if len(poses) > 1:
            raise ValueError("it shows several copies of a mesh that joints move")
        vertices, pose = _posed(file, file.entry("skins", node["skin"]), part)
        poses = pose[None]
    vertices, faces, corners = _visible(part, vertices)
    if not len(faces):
        return []
    texture_id = NO_TEXTURE if part.material.texture is None else 0
    gloss = part.material.gloss
    mesh = Mesh(
        vertices=vertices,
        faces=faces,
        corner_colors=encode(torch.from_numpy(corners[..., 3:6]), "srgb").float().numpy(),
        corner_uvs=corners[..., :2].astype(np.float32),
        texture_ids=np.full(len(faces), texture_id, dtype=np.int32),
        # `load_mesh` finds the sharp edges of all parts together.
        normal_ids=faces,
        textures=() if part.material.texture is None else (part.material.texture,),
        gloss=None if gloss is None else np.tile(gloss.astype(np.float32), (len(faces), 1)),
        gloss_textures=(
            () if part.material.gloss_texture is None else (part.material.gloss_texture,)
        ),
    )
    normals = corners[..., 6:] if corners[..., 6:].any() else None
    if "skin" not in node:
        return [Part(mesh, normals, pose) for pose in poses]
    # The values of the normals are only compared, so they need not follow the joints.
    posed, normals = Part(mesh, normals, poses[0]).placed()
    return [Part(replace(posed, vertices=vertices), normals)]


def _posed(
    file: GltfFile, skin: dict[str, Any], part: _Primitive
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "4 4"]]:
    """Move the vertices of a part by the joints of its skin, in the pose of the nodes (3.7.3.3).

    The result is the positions in the scene, and the matrix of the first joint, which tells
    whether the part is mirrored.
    """
    matrices = np.stack([file.poses[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        # There may be more matrices than joints.
        bind = file.array(skin["inverseBindMatrices"])[: len(matrices)]
        if len(bind) < len(matrices):
            raise ValueError(f"a skin has {len(bind)} matrices for {len(matrices)} joints")
        matrices = matrices @ bind
    # Weighted sum of the matrices of the joints, and of the weights, for each vertex.
    blended = np.zeros((len(part.positions), 4, 4))
    sums = np.zeros(len(part.positions))
    for name in part.joints:
        if not name.startswith("JOINTS"):
            continue
        weights = part.joints[name.replace("JOINTS", "WEIGHTS")]
        # A joint with the weight 0 may be any number, so it is replaced by joint 0.
        joints = np.where(weights == 0, 0, part.joints[name])
        if not 0 <= joints.min() <= joints.max() < len(matrices):
            raise ValueError(
                f"a vertex has the joint {joints.max()}, but its skin has {len(matrices)} joints"
            )
        for joint, weight in zip(joints.T, weights.T, strict=True):
            blended += weight[:, None, None] * matrices[joint]
            sums += weight
    deviations = np.abs(sums - 1)
    # A comparison with NaN is False, so `not` also finds NaN.
    if not (deviations <= MAX_WEIGHT_ERROR).all():
        worst = sums[deviations.argmax()]
        raise ValueError(f"the weights of a vertex add up to {worst:g} instead of 1")
    blended /= sums[:, None, None]
    positions = np.einsum("vij,vj->vi", blended[:, :3, :3], part.positions) + blended[:, :3, 3]
    return positions, matrices[0]


def _visible(part: _Primitive, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and corners of the visible surface of a part (3.9.6)."""
    material = part.material
    if material.mode == "OPAQUE":
        return vertices, part.faces, part.corners
    cutoff = ALMOST_ONE if material.mode == "BLEND" else material.cutoff
    visible = cut_out(vertices, part.faces, part.corners, material.alpha, cutoff)
    if material.mode == "BLEND" and visible[1] is not part.faces:
        raise ValueError(
            "its surface is transparent (alphaMode BLEND with alpha below 1): "
            "make it opaque, or use alphaMode MASK"
        )
    return visible
