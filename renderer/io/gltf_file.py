"""Open glTF 2.0 files: their JSON object, arrays, images, nodes and materials.

Chapters refer to the specification of glTF 2.0. Files that a .gltf file refers
to are read only if they lie below its folder. Positions, normals and vectors
are rows.

The color and the alpha of a material are read, and on request its roughness,
metallic value and specular factor. Its other properties are ignored
(`ignored_features`). What lets light pass through the surface is refused.
"""

import json
import math
import struct
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple
from urllib.request import urlopen

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from renderer.errors import require_memory
from renderer.image import decode, encode, to_bytes
from renderer.io.mesh_file import CPU, TEXEL_BYTES, MeshFile, decode_image

# Types of the numbers in accessors (3.6.2.2).
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# Count of numbers in one element of an accessor (3.6.2.2).
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
WEBP = "EXT_texture_webp"
VISIBILITY = "KHR_node_visibility"
# Bytes that a number of an accessor takes while it is read.
ARRAY_BYTES = 16


class GltfFile:
    """A .gltf or .glb file.

    Attributes:
        file: The file, with the files beside it.
        tree: JSON object of the file.
        poses: Matrix (4, 4) from the axes of each node to the axes of the scene.
        extended: Pairs of a texture and an extended copy (`Material.placed`), which parts share.
    """

    def __init__(self, file: MeshFile) -> None:
        """Parse the JSON of a file, and check its version."""
        self.file = file
        self.extended: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}
        content = file.content
        self._binary_chunk: bytes | None = None
        if content.startswith(b"glTF"):
            content, self._binary_chunk = _chunks(content)
        # Python's parser accepts NaN and Infinity, which glTF forbids. It passes
        # these names to `parse_constant`, and `int("NaN")` raises ValueError.
        self.tree: dict[str, Any] = json.loads(content, parse_constant=int)
        version = self.tree["asset"]["version"]
        if not version.startswith("2."):
            raise ValueError(f"it is glTF {version}: export it as glTF 2.0")
        self._roots, self.poses = self._trees()

    def entry(self, kind: str, index: int) -> dict[str, Any]:
        """Look up an entry of a list of the JSON object, such as number 2 of "meshes"."""
        entries: list[dict[str, Any]] = self.tree.get(kind, [])
        # Python would count a negative index from the end.
        if not 0 <= index < len(entries):
            raise ValueError(f"it refers to number {index} of {len(entries)} {kind}")
        return entries[index]

    # Arrays

    def array(self, index: int) -> np.ndarray:
        """Read an accessor, shape (count, width), or (count, 4, 4) for matrices.

        Normalized integers become float64 numbers in [-1, 1]. Other numbers keep their type.
        """
        accessor = self.entry("accessors", index)
        dtype = np.dtype(TYPES[accessor["componentType"]])
        width = WIDTHS[accessor["type"]]
        shape = (accessor["count"], width)
        require_memory("arrays", ARRAY_BYTES * math.prod(shape), CPU)
        values = np.zeros(shape, dtype)
        # Without a buffer view, all numbers are 0.
        if "bufferView" in accessor:
            values = self._elements(accessor, accessor["count"], dtype, width)
        # A sparse accessor replaces single elements. `rows` are their indices.
        if "sparse" in accessor:
            values = values.copy()
            sparse = accessor["sparse"]
            index_type = np.dtype(TYPES[sparse["indices"]["componentType"]])
            rows = self._elements(sparse["indices"], sparse["count"], index_type, 1)
            values[rows.ravel()] = self._elements(sparse["values"], sparse["count"], dtype, width)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        # Matrices are stored column by column.
        return values.reshape(-1, 4, 4).swapaxes(1, 2) if width == 16 else values

    def _elements(
        self, location: dict[str, Any], count: int, dtype: np.dtype[Any], width: int
    ) -> np.ndarray:
        """Return the elements that an accessor or its sparse part stores, without a copy."""
        index = location["bufferView"]
        view = self._view(index)
        row_size = width * dtype.itemsize
        stride = self.entry("bufferViews", index).get("byteStride", row_size)
        # `stride` is the distance in bytes from one element to the next.
        offset = location.get("byteOffset", 0)
        end = offset + stride * (count - 1) + row_size
        # NumPy would read bytes before the buffer at a negative offset.
        if stride < row_size or min(offset, count) < 0 or end > len(view):
            raise ValueError(f"an array overlaps itself or leaves its buffer view {index}")
        return np.ndarray((count, width), dtype, view, offset, (stride, dtype.itemsize))

    def _view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        start = view.get("byteOffset", 0)
        length = view["byteLength"]
        buffer = self._buffers[view["buffer"]]
        if not 0 <= start <= start + length <= len(buffer):
            raise ValueError(f"its buffer view {index} ends behind its buffer: the file is damaged")
        return buffer[start : start + length]

    @cached_property
    def _buffers(self) -> list[memoryview]:
        """Bytes of all buffers."""
        buffers = []
        chunk = self._binary_chunk
        for buffer in self.tree.get("buffers", []):
            content = self._resource(buffer["uri"]) if "uri" in buffer else chunk
            chunk = None  # Only the first buffer can be that chunk (3.6.1.2).
            if content is None or len(content) < buffer["byteLength"]:
                raise ValueError("the bytes of a buffer are missing: export the file again")
            buffers.append(memoryview(content))
        return buffers

    def _resource(self, uri: str) -> bytes:
        """Read the bytes that a URI holds (a data URI), or of a file below the folder."""
        if not uri.startswith("data:"):
            return self.file.read(uri)
        with urlopen(uri) as response:
            return bytes(response.read())

    # Images

    def image(self, texture_index: int) -> Image.Image:
        """Decode the image of a texture with 8 bits per channel."""
        texture = self.entry("textures", texture_index)
        source = texture.get("extensions", {}).get(WEBP, texture).get("source")
        if source is None:
            names = ", ".join(texture.get("extensions", {"no image": {}}))
            raise ValueError(f"a texture has only {names}: export the textures as PNG or JPEG")
        entry = self.entry("images", source)
        uri = entry.get("uri")
        content = self._view(entry["bufferView"]) if uri is None else self._resource(uri)
        return decode_image(content)

    # Nodes

    def _trees(self) -> tuple[list[int], dict[int, np.ndarray]]:
        """Return the nodes without a parent, and the poses (4, 4) of all nodes, parents first."""
        nodes = self.tree.get("nodes", [])
        children = [child for node in nodes for child in node.get("children", [])]
        # With two parents, 40 nodes could stand for 2^40 copies of a mesh.
        if len(set(children)) < len(children):
            raise ValueError("a node has two parents: the file is damaged")
        roots = sorted(set(range(len(nodes))) - set(children))
        poses = {root: _local_matrix(nodes[root]) for root in roots}
        # The loop extends the queue while it runs, so every node comes after its parent.
        queue = roots[:]
        for parent in queue:
            for child in nodes[parent].get("children", []):
                poses[child] = poses[parent] @ _local_matrix(self.entry("nodes", child))
                queue.append(child)
        # Nodes of a cycle have no root above them, so the loop never reaches them.
        if len(poses) < len(nodes):
            raise ValueError("a node is a child of itself: the file is damaged")
        return roots, poses

    def scene_nodes(self) -> list[int]:
        """List the visible nodes of the default scene, parents before their children."""
        roots = self._roots
        if "scenes" in self.tree:
            roots = self.entry("scenes", self.tree.get("scene", 0)).get("nodes", [])
        # A dictionary without values. A scene may list a node and also its parent.
        listed: dict[int, None] = {}
        # The next node is at the end.
        waiting = list(dict.fromkeys(reversed(roots)))
        while waiting:
            node = waiting.pop()
            entry = self.entry("nodes", node)
            # The children of a hidden node are hidden, too.
            if entry.get("extensions", {}).get(VISIBILITY, {}).get("visible", True):
                listed[node] = None
                waiting += reversed(entry.get("children", []))
        return list(listed)


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON object and the binary chunk, if there is one, of a .glb file (4.4)."""
    version, length, json_length = struct.unpack_from("<4x3I", content)
    if version != 2:
        raise ValueError(f"it is glTF {version}.0: export it as glTF 2.0")
    if length > len(content):
        raise ValueError("its end is missing: copy the file again")
    end = 20 + json_length
    has_binary = content[end + 4 : end + 8] == b"BIN\0"
    return content[20:end], content[end + 8 : length] if has_binary else None


def _local_matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix (4, 4) of a node relative to its parent (3.5.2)."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix[:3, :3] = rotation * node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


TRANSFORM = "KHR_texture_transform"
QUANTIZATION = "KHR_mesh_quantization"
SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
SPECULAR = "KHR_materials_specular"
IOR = "KHR_materials_ior"
# Extensions that are read. SPECULAR and IOR are read only for the gloss.
READ = {TRANSFORM, QUANTIZATION, SPECULAR_GLOSSINESS, SPECULAR, IOR}
READ |= {WEBP, VISIBILITY}
# Extensions by which a mesh has copies, or compressed arrays.
REFUSED = {"EXT_mesh_gpu_instancing", "KHR_draco_mesh_compression"}
REFUSED |= {"EXT_meshopt_compression", "KHR_meshopt_compression"}
# Beginnings of the names of extensions that may be required by a
# file but ignored, because they change neither shape nor color.
HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_animation_")
# Extensions by which a surface lets light pass, and their factors.
TRANSPARENT = {
    "KHR_materials_transmission": "transmissionFactor",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
}
# Reflectance at normal incidence of a surface with the specular factor 1.
DIELECTRIC = 0.04
# Numbers of OpenGL for the use of textures (5.26).
REPEAT, CLAMP, MIRROR, NEAREST = 10497, 33071, 33648, 9728


class Placement(NamedTuple):
    """Place of a texture on a surface.

    Attributes:
        uv_set: Number n of the texture coordinates TEXCOORD_n.
        transform: Rows of the matrix (2, 3) that maps a column (u, v, 1) of texture coordinates.
        wraps: How the texture continues beyond [0, 1] in u and in v.
    """

    uv_set: int
    transform: tuple[tuple[float, ...], ...]
    wraps: tuple[int, int]


@dataclass(frozen=True)
class Material:
    """Material of a surface.

    Attributes:
        color: Linear color and alpha by which those of the texture are multiplied, shape (4,).
        mode: Use of alpha: "OPAQUE", "MASK" or "BLEND".
        cutoff: Alpha below which the mode "MASK" cuts out the surface.
        placement: Place of the textures. None without textures.
        texture: sRGB-encoded color, uint8, shape (H, W, 3), or None.
        alpha: Alpha of the texture, uint8, shape (H, W). None if it is 1 everywhere.
        gloss: Roughness, metallic and specular factor, shape (3,). None for a matte surface.
        gloss_texture: Factors of roughness and metallic, uint8, shape (H, W, 2), or None.
        is_emitted: Whether the color is emitted light, which colors of vertices leave alone (3.9).
    """

    color: Float[np.ndarray, " 4"]
    mode: str = "OPAQUE"
    cutoff: float = 0.5
    placement: Placement | None = None
    texture: UInt8[np.ndarray, "H W 3"] | None = None
    alpha: UInt8[np.ndarray, "H W"] | None = None
    gloss: Float[np.ndarray, " 3"] | None = None
    gloss_texture: UInt8[np.ndarray, "_ _ 2"] | None = None
    is_emitted: bool = False

    def placed(self, uvs: np.ndarray, file: GltfFile) -> tuple["Material", np.ndarray]:
        """Convert texture coordinates (V, 2) of the file to those of `Mesh`.

        The textures of `Mesh` repeat. A texture that is mirrored is therefore
        doubled, and a clamped texture is extended at its edges.
        """
        if self.placement is None:
            return self, uvs
        # Transform texture coordinates by the matrix (2, 3) of the file.
        matrix = np.array(self.placement.transform)
        uvs = uvs @ matrix[:, :2].T + matrix[:, 2]
        planes = {name: getattr(self, name) for name in ("texture", "alpha", "gloss_texture")}
        textures = {name: texels for name, texels in planes.items() if texels is not None}
        # Axis 0 is u, which runs along columns, and axis 1 is v, which runs along rows.
        for axis, wrap in enumerate(self.placement.wraps):
            if wrap not in (MIRROR, CLAMP):
                continue
            largest = max(texels.shape[1 - axis] for texels in textures.values())
            for name, texels in textures.items():
                if texels.shape[1 - axis] == 1:  # A single texel is the same everywhere.
                    textures[name] = texels.repeat(largest, 1 - axis)
            sizes = [texels.shape[1 - axis] for texels in textures.values()]
            # All textures grow by the same fraction, so they are divided into as many blocks. Sizes
            # without a common divisor make one block, and clamped textures three times as large.
            count = math.gcd(*sizes)
            coordinates = uvs[:, axis]
            mode: Any = "edge"
            if wrap == MIRROR:
                # Blocks are added before the first and after the last one.
                before, after, mode = 0, count, "symmetric"
            else:
                # Interpolation needs one texel more than the surface covers.
                border = count / min(sizes)
                before = math.ceil(border + max(0, -coordinates.min() * count))
                after = math.ceil(border + max(0, (coordinates.max() - 1) * count))
            new_count = before + count + after
            for name, texels in textures.items():
                length = texels.shape[1 - axis] // count
                key = id(texels), axis, length * before, length * after
                if key not in file.extended:
                    new_size = length * new_count * texels.shape[axis]
                    require_memory("textures", TEXEL_BYTES * new_size, CPU)
                    padding = [(0, 0)] * texels.ndim
                    padding[1 - axis] = key[2:]
                    file.extended[key] = texels, np.pad(texels, padding, mode)
                _, textures[name] = file.extended[key]
            # The same texel has another coordinate in the larger texture.
            uvs[:, axis] = (coordinates * count + before) / new_count
        # v points down in glTF, and up in `Mesh`.
        uvs[:, 1] = 1 - uvs[:, 1]
        return replace(self, **textures), uvs

    def with_placement(self, placement: Placement, shape: tuple[int, ...]) -> "Material":
        """Return a copy with a texture at a place, which is white (H, W) if there was none."""
        if self.placement is None:
            white = np.full((*shape, 3), 255, dtype=np.uint8)
            return replace(self, placement=placement, texture=white)
        if self.placement != placement:
            raise ValueError("its textures differ in texture coordinates, transform or wrap mode")
        return self

    def with_gloss_texture(self, texels: np.ndarray, placement: Placement) -> "Material":
        """Return a copy with factors of roughness and metallic (H, W, 2)."""
        # A material without a texture gets a white one, because each `gloss_texture` of `Mesh`
        # belongs to a texture. It has the size of the gloss texture, if both will be extended.
        is_extended = placement.wraps != (REPEAT, REPEAT)
        material = self.with_placement(placement, texels.shape[:2] if is_extended else (1, 1))
        return replace(material, gloss_texture=texels)


def ignored_features(tree: dict[str, Any]) -> list[str]:
    """List the features of a file that change neither its shape nor its base color.

    Light that a surface emits is among them, unless it is black: the renderer alone lights a mesh.
    """
    features = set()
    for material in tree.get("materials", []):
        features |= {"normalTexture", "occlusionTexture"} & material.keys()
        if any(material.get("emissiveFactor", ())) and not _emits_its_color(material):
            features.add("emitted light")
        features |= set(material.get("extensions", ())) - READ
    for sampler in tree.get("samplers", []):
        if sampler.get("magFilter") == NEAREST:
            features.add("textures without interpolation")
    if "animations" in tree:
        features.add("animations")
    if len(tree.get("scenes", ())) > 1:
        features.add("all scenes but the first" if "scene" not in tree else "other scenes")
    # Names of extensions that are not read. An error is raised for one that may change shape or
    # color.
    used = set(tree.get("extensionsUsed", ())) - READ
    for name in {*tree.get("extensionsRequired", ()), *(REFUSED & used)} - READ:
        if not name.startswith(HARMLESS):
            raise ValueError(f"it uses the extension {name}: export the mesh without it")
    return sorted(features | used)


def _emits_its_color(material: dict[str, Any]) -> bool:
    """Whether a material is black and emits light, as Blender writes a texture without shading."""
    extensions = {SPECULAR_GLOSSINESS, "KHR_materials_unlit"} & {*material.get("extensions", ())}
    # Another model has a color of its own, and the opacity is that of the base color.
    if extensions or material.get("alphaMode", "OPAQUE") != "OPAQUE":
        return False
    base = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1])
    return not any(base[:3]) and any(material.get("emissiveFactor", ()))


def read_material(file: GltfFile, index: int | None) -> Material:
    """Read a material. Without an index, it is white and matte."""
    if index is None:
        return Material(color=np.ones(4))
    entry = file.entry("materials", index)
    extensions = entry.get("extensions", {})
    for name, factor in TRANSPARENT.items():
        if extensions.get(name, {}).get(factor, 0) > 0:
            raise ValueError(f"a material lets light pass ({name}): make it opaque")
    mode = entry.get("alphaMode", "OPAQUE")
    if mode not in ("OPAQUE", "MASK", "BLEND"):
        raise ValueError(f"a material has the alphaMode {mode}: use OPAQUE, MASK or BLEND")
    material = Material(np.ones(4), mode, entry.get("alphaCutoff", 0.5))
    if SPECULAR_GLOSSINESS in extensions:
        return _specular_glossiness(material, file, extensions[SPECULAR_GLOSSINESS])
    # The model of glTF itself (3.9.2).
    model = entry.get("pbrMetallicRoughness", {})
    if _emits_its_color(entry):
        file.file.assume("the light that a black material emits is taken as its color")
        emission = entry | {"emissiveFactor": [*entry["emissiveFactor"], 1.0]}
        material = _with_color(replace(material, is_emitted=True), file, emission, "emissive")
    else:
        material = _with_color(material, file, model, "baseColor")
    if not file.file.gloss:
        return material
    # Roughness, metallic and specular factor.
    factors = [model.get("roughnessFactor", 1), model.get("metallicFactor", 1)]
    material = replace(material, gloss=np.clip([*factors, _specular_factor(extensions)], 0.0, 1.0))
    if "metallicRoughnessTexture" not in model:
        return material
    image, placement = _image(file, model["metallicRoughnessTexture"])
    # glTF stores roughness in green and metallic in blue.
    return material.with_gloss_texture(np.array(image.convert("RGB"))[..., 1:], placement)


def _specular_factor(extensions: dict[str, Any]) -> float:
    """Compute the specular factor, which is 1 for a reflectance of 4%, by its two extensions."""
    specular = extensions.get(SPECULAR, {})
    colors = np.array(specular.get("specularColorFactor", [1.0] * 3))
    if {"specularTexture", "specularColorTexture"} & specular.keys() or np.ptp(colors) > 0:
        raise ValueError("a material has a specular color or texture: read it without gloss")
    ior = extensions.get(IOR, {}).get("ior", 1.5)
    # Reflectance at normal incidence (Fresnel) for the index of refraction, 1.5 by default.
    reflectance = ((ior - 1) / (ior + 1)) ** 2
    return float(specular.get("specularFactor", 1.0) * min(colors[0] * reflectance, 1) / DIELECTRIC)


def _specular_glossiness(material: Material, file: GltfFile, model: dict[str, Any]) -> Material:
    """Return a material with the color and the gloss of KHR_materials_pbrSpecularGlossiness.

    The albedo of this extension is diffuse · (1 - max(specular)).
    """
    material = _with_color(material, file, model, "diffuse")
    # Specular color and glossiness become arrays (H, W, 3) and (H, W) if there is a texture.
    specular = np.clip(model.get("specularFactor", [1.0] * 3), 0.0, 1.0).reshape(3)
    glossiness = np.array(model.get("glossinessFactor", 1.0))
    placement = None
    if "specularGlossinessTexture" in model:
        image, placement = _image(file, model["specularGlossinessTexture"])
        texels = torch.from_numpy(np.array(image.convert("RGBA"), dtype=np.float32) / 255)
        specular = specular * decode(texels[..., :3], "srgb").numpy()
        glossiness = glossiness * texels[..., 3].numpy()
    # The strongest channel of the specular color is the fraction of light that is not diffuse.
    reflectance = np.clip(specular, 0, 1).max(axis=-1)
    if placement is None:
        material = replace(material, color=material.color * [*[1 - reflectance] * 3, 1])
    else:
        material = material.with_placement(placement, reflectance.shape)
        assert material.texture is not None
        size = material.texture.shape[1::-1]
        fraction = Image.fromarray((1 - reflectance).astype(np.float32))
        factors = np.array(fraction.resize(size, Image.Resampling.BILINEAR))[..., None]
        # Colors are multiplied as linear light and encoded again.
        linear = decode(torch.from_numpy(material.texture).float() / 255, "srgb")
        dimmed = to_bytes(encode(linear * torch.from_numpy(factors), "srgb"))
        material = replace(material, texture=dimmed.numpy())
    if not file.file.gloss:
        return material
    # The renderer has one specular factor without a color, so the mean replaces the texture.
    factor = min(float(reflectance.mean()) / DIELECTRIC, 1.0)
    if np.abs(specular - factor * DIELECTRIC).max() > 1e-3:
        file.file.assume(f"the specular factor {factor:.2g} stands for a specular color")
    roughness = np.clip(1 - glossiness, 0, 1)
    if placement is None:
        return replace(material, gloss=np.array([float(roughness), 0, factor]))
    # The gloss texture has roughness and metallic. Metallic is multiplied by 0 below.
    texture = np.stack([np.rint(255 * roughness), np.full(roughness.shape, 255)], axis=-1)
    material = replace(material, gloss=np.array([1.0, 0, factor]))
    return material.with_gloss_texture(texture.astype(np.uint8), placement)


def _with_color(material: Material, file: GltfFile, model: dict[str, Any], name: str) -> Material:
    """Return a material with the factor and the texture whose names begin with `name`."""
    color = np.clip(model.get(f"{name}Factor", [1.0] * 4), 0.0, 1.0).reshape(4)
    material = replace(material, color=color)
    if f"{name}Texture" not in model:
        return material
    image, placement = _image(file, model[f"{name}Texture"])
    texels = np.array(image.convert("RGBA"))
    # None stands for an alpha of 1 everywhere.
    alpha = texels[..., 3] if texels[..., 3].min() < 255 else None
    texture = np.ascontiguousarray(texels[..., :3])
    return replace(material, placement=placement, texture=texture, alpha=alpha)


def _image(file: GltfFile, info: dict[str, Any]) -> tuple[Image.Image, Placement]:
    """Decode the image of a texture, and find its place on the surface."""
    transform = info.get("extensions", {}).get(TRANSFORM, {})
    cosine = math.cos(transform.get("rotation", 0))
    sine = math.sin(transform.get("rotation", 0))
    # v points down, and the rotation is counter-clockwise as one sees it. The
    # matrix in the text of the extension has another sign, which is an error
    # (github.com/KhronosGroup/glTF/issues/1563).
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    # Scaling comes first, then the rotation, then the offset.
    linear = rotation * transform.get("scale", (1, 1))
    rows = np.column_stack([linear, transform.get("offset", (0, 0))])
    sampler_index = file.entry("textures", info["index"]).get("sampler")
    sampler = {} if sampler_index is None else file.entry("samplers", sampler_index)
    uv_set = transform.get("texCoord", info.get("texCoord", 0))
    wraps = (sampler.get("wrapS", REPEAT), sampler.get("wrapT", REPEAT))
    return file.image(info["index"]), Placement(uv_set, tuple(map(tuple, rows.tolist())), wraps)
