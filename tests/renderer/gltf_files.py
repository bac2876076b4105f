"""Writer of the glTF files of the tests."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from oracles import encoded

from renderer.io.meshes import load_mesh
from renderer.mesh import Mesh

TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SQUARE = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
# v points down in glTF.
SQUARE_UVS = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
SQUARE_FACES = np.uint16([0, 1, 2, 0, 2, 3])


class Gltf:
    def __init__(self) -> None:
        self.buffer = b""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}]}
        self.tree |= {"scenes": [{"nodes": [0]}], "scene": 0}
        self.tree |= {name: [] for name in ("accessors", "bufferViews", "materials", "meshes")}

    def view(self, content: bytes, **entries: Any) -> int:
        """Append bytes to the buffer, and return the index of their view."""
        self.buffer += b"\0" * (-len(self.buffer) % 4)
        view = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(content), **entries}
        self.buffer += content
        self.tree["bufferViews"].append(view)
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: np.ndarray, normalized: bool = False) -> int:
        values = np.asarray(values)
        width = values[0].size
        accessor = {"bufferView": self.view(values.tobytes()), "count": len(values)}
        accessor |= {"componentType": TYPES.get(values.dtype.name, 5126), "normalized": normalized}
        accessor["type"] = KINDS[width]
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def sparse(self, index: int, rows: np.ndarray, values: np.ndarray) -> None:
        indices = {"bufferView": self.view(rows.tobytes()), "componentType": TYPES[rows.dtype.name]}
        sparse = {"count": len(rows), "indices": indices}
        sparse["values"] = {"bufferView": self.view(values.tobytes())}
        self.tree["accessors"][index]["sparse"] = sparse

    def mesh(self, attributes, indices=None, **entries) -> dict[str, Any]:
        """Append a mesh with one primitive, and return the primitive."""
        accessors = {
            name: values if isinstance(values, int) else self.array(values)
            for name, values in attributes.items()
        }
        primitive = {"attributes": accessors, **entries}
        if indices is not None:
            primitive["indices"] = self.array(indices)
        self.tree["meshes"].append({"primitives": [primitive]})
        return primitive

    def texture(self, texels: np.ndarray, **sampler: int) -> dict[str, int]:
        """Append a texture, and return a reference to it."""
        for kind in ("images", "samplers", "textures"):
            self.tree.setdefault(kind, [])
        view = self.view(encoded(texels))
        self.tree["images"].append({"bufferView": view, "mimeType": "image/png"})
        self.tree["samplers"].append(sampler)
        index = len(self.tree["textures"])
        self.tree["textures"].append({"source": index, "sampler": index})
        return {"index": index}

    def square(self, **material: Any) -> "Gltf":
        attributes = {"POSITION": SQUARE, "TEXCOORD_0": SQUARE_UVS}
        self.mesh(attributes, SQUARE_FACES, material=len(self.tree["materials"]))
        self.tree["materials"].append(material)
        return self

    def text(self) -> str:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.buffer).decode()
        return json.dumps(self.tree | {"buffers": [{"byteLength": len(self.buffer), "uri": uri}]})

    def glb(self) -> bytes:
        buffers = [{"byteLength": len(self.buffer)}, *self.tree.get("buffers", ())]
        text = json.dumps(self.tree | {"buffers": buffers}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.buffer), b"BIN\0") + self.buffer
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def write(self, path: Path) -> Path:
        path.write_bytes(self.glb() if path.suffix == ".glb" else self.text().encode())
        return path

    def load(self, folder: Path, gloss: bool = False) -> Mesh:
        return load_mesh(self.write(folder / "mesh.gltf"), up="z", gloss=gloss)


def read_tree(path: Path) -> dict[str, Any]:
    """Read the JSON of a .glb file."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length])
