"""Open glTF 2.0 files: their JSON object, arrays, images and nodes.

Chapters refer to the specification of glTF 2.0. Files that a .gltf file refers
to are read only if they lie below its folder. Positions, normals and vectors
are rows.
"""

import io
import json
import struct
from collections import Counter
from functools import cached_property
from typing import Any
from urllib.request import urlopen

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from renderer.io.images import eight_bits, identify
from renderer.io.mesh_file import MeshFile
from renderer.memory import require_memory

# Types of the numbers in accessors (3.6.2.2).
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# Count of numbers in one element of an accessor (3.6.2.2).
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Types of the chunks of a .glb file (4.4.3): "JSON" and "BIN\0".
JSON_CHUNK = 0x4E4F534A
BINARY_CHUNK = 0x004E4942
WEBP = "EXT_texture_webp"
INSTANCING = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"
# Bytes that a number of an accessor takes while it is read.
ARRAY_BYTES = 16
# Bytes that a texel takes while its image is read and as a texture.
TEXEL_BYTES = 20


class GltfFile:
    """A .gltf or .glb file.

    Attributes:
        file: The file, with the files beside it.
        tree: JSON object of the file.
    """

    def __init__(self, file: MeshFile) -> None:
        """Parse the JSON of a file, and check its version."""
        self.file = file
        content = file.content
        chunks = _chunks(content) if content.startswith(b"glTF") else {JSON_CHUNK: content}
        self._binary_chunk = chunks.get(BINARY_CHUNK)
        # Python's parser accepts NaN and Infinity, which glTF forbids. It passes
        # these names to `parse_constant`, and `int("NaN")` raises ValueError.
        self.tree: dict[str, Any] = json.loads(chunks[JSON_CHUNK], parse_constant=int)
        version = self.tree["asset"]["version"]
        if not version.startswith("2."):
            raise ValueError(f"it is glTF {version}: export it as glTF 2.0")

    def entry(self, kind: str, index: int) -> dict[str, Any]:
        """Look up an entry of a list of the JSON object, such as number 2 of "meshes"."""
        entries = self.tree.get(kind, [])
        # Python would count a negative index from the end.
        if not 0 <= index < len(entries):
            raise ValueError(f"it refers to number {index} of {len(entries)} {kind}")
        entry: dict[str, Any] = entries[index]
        return entry

    # Arrays

    def array(self, index: int) -> np.ndarray:
        """Read an accessor, shape (count, width), or (count, 4, 4) for matrices.

        Normalized integers become float64 numbers in [-1, 1]. Other numbers keep their type.
        """
        accessor = self.entry("accessors", index)
        dtype = np.dtype(TYPES[accessor["componentType"]])
        width = WIDTHS[accessor["type"]]
        needed = ARRAY_BYTES * accessor["count"] * width
        require_memory("arrays", needed, torch.device("cpu"))
        if "bufferView" in accessor:
            values = self._elements(accessor, accessor["count"], dtype, width)
        else:
            values = np.zeros((accessor["count"], width), dtype)
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
        size = dtype.itemsize
        stride = self.entry("bufferViews", index).get("byteStride", width * size)
        offset = location.get("byteOffset", 0)
        end = offset + stride * (count - 1) + width * size
        if stride < width * size:
            raise ValueError(f"the elements of an array overlap in its buffer view {index}")
        # NumPy would read bytes before the buffer at a negative offset.
        if min(offset, count) < 0 or end > len(view):
            raise ValueError(f"an array ends behind its buffer view {index}: the file is damaged")
        return np.ndarray((count, width), dtype, view, offset, (stride, size))

    def _view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        if "EXT_meshopt_compression" in view.get("extensions", {}):
            raise ValueError("its arrays are compressed (meshopt): export it without compression")
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
        for buffer in self.tree.get("buffers", []):
            content = self._resource(buffer["uri"]) if "uri" in buffer else self._binary_chunk
            if content is None or len(content) < buffer["byteLength"]:
                raise ValueError("the bytes of a buffer are missing: export the file again")
            buffers.append(memoryview(content))
        return buffers

    def _resource(self, uri: str) -> bytes:
        """Read the bytes that a URI holds (a data URI), or of a file below the folder."""
        if uri.startswith("data:"):
            with urlopen(uri) as response:
                content: bytes = response.read()
            return content
        return self.file.read(uri)

    # Images

    def image(self, texture_index: int) -> Image.Image:
        """Decode the image of a texture with 8 bits per channel."""
        texture = self.entry("textures", texture_index)
        source = texture.get("extensions", {}).get(WEBP, texture).get("source")
        if source is None:
            names = ", ".join(texture.get("extensions", {"no image": {}}))
            raise ValueError(f"a texture has only {names}: export the textures as PNG or JPEG")
        entry = self.entry("images", source)
        content = (
            self._resource(entry["uri"]) if "uri" in entry else self._view(entry["bufferView"])
        )
        image = identify(io.BytesIO(content))
        texel_bytes = TEXEL_BYTES * image.width * image.height
        require_memory("textures", texel_bytes, torch.device("cpu"))
        return eight_bits(image)

    # Nodes

    @cached_property
    def poses(self) -> dict[int, np.ndarray]:
        """Matrix (4, 4) from the axes of each node to the axes of the scene.

        The nodes are in an order in which parents come before their children.
        """
        nodes = self.tree.get("nodes", [])
        poses = {}
        roots = [index for index in range(len(nodes)) if index not in self.parents]
        queue = [(root, np.eye(4)) for root in roots]
        for index, parent_pose in queue:
            poses[index] = parent_pose @ _local_matrix(nodes[index])
            queue += [(child, poses[index]) for child in nodes[index].get("children", [])]
        if len(poses) < len(nodes):
            raise ValueError("a node is a child of itself: the file is damaged")
        return poses

    @cached_property
    def parents(self) -> dict[int, int]:
        """Parent of each node that has one."""
        nodes = self.tree.get("nodes", [])
        edges = [
            (child, parent)
            for parent, node in enumerate(nodes)
            for child in node.get("children", [])
        ]
        for child, _ in edges:
            self.entry("nodes", child)
        if max(Counter(child for child, _ in edges).values(), default=0) > 1:
            raise ValueError("a node has two parents: the file is damaged")
        return dict(edges)

    def scene_nodes(self) -> list[int]:
        """List the visible nodes of the default scene, parents before their children."""
        # `poses` checks that the nodes form trees. Without this
        # check, 40 nodes could stand for 2^40 copies of a mesh.
        roots = [node for node in self.poses if node not in self.parents]
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

    def instance_count(self, index: int) -> int:
        """Count the copies of its mesh that a node shows (EXT_mesh_gpu_instancing)."""
        counts = {self.entry("accessors", i)["count"] for i in self._instancing(index).values()}
        if len(counts) > 1:
            raise ValueError(f"the arrays of {INSTANCING} have different lengths")
        return min(counts, default=1)

    def instances(self, index: int) -> np.ndarray:
        """Return the matrices (N, 4, 4) that place the N copies of a node's mesh in the scene."""
        arrays = {name: self.array(i) for name, i in self._instancing(index).items()}
        copies = [
            _local_matrix({name: values[row] for name, values in arrays.items()})
            for row in range(self.instance_count(index))
        ]
        return self.poses[index] @ np.stack(copies)

    def _instancing(self, index: int) -> dict[str, int]:
        """Return the accessors of the translations, rotations and scales of the copies."""
        extensions = self.tree["nodes"][index].get("extensions", {})
        attributes: dict[str, int] = extensions.get(INSTANCING, {}).get("attributes", {})
        # Files may have more attributes, such as a number of each copy.
        places = ("translation", "rotation", "scale")
        return {name: attributes[name.upper()] for name in places if name.upper() in attributes}


def _chunks(content: bytes) -> dict[int, bytes]:
    """Divide a .glb file into its chunks, by their types (4.4)."""
    _, version, length = struct.unpack_from("<4sII", content)
    if version != 2:
        raise ValueError(f"it is glTF {version}.0: export it as glTF 2.0")
    if length > len(content):
        raise ValueError("its end is missing: copy the file again")
    chunks: dict[int, bytes] = {}
    start = 12
    while start + 8 <= length:
        chunk_length, kind = struct.unpack_from("<II", content, start)
        chunks.setdefault(kind, content[start + 8 : start + 8 + chunk_length])
        start += 8 + chunk_length
    return chunks


def _local_matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix (4, 4) of a node relative to its parent (3.5.2)."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix[:3, :3] = rotation * np.asarray(node.get("scale", (1, 1, 1)))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
