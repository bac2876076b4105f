"""The images that a glTF file's base colors need, and what of the file is not read: glTF 2.0."""

import base64
import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

FLOAT = 5126  # a component's type (section 3.6.2.2)
INDICES = {"source", "index", "material", "mesh", "bufferView", "buffer", "indices"}
INDICES |= {"POSITION", "TEXCOORD_0", "COLOR_0"}  # of a part's attributes
SURFACES = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")  # begin what may be required: none moves a vertex


def gltf_images(content: bytes, read: Callable[[str], bytes]) -> Iterator[tuple[str, bytes]]:
    """(name, bytes) of the images of the materials that are used, inside the file or beside it (section 4.4).

    ValueError, KeyError and the like for a damaged file, and for one that trimesh would read otherwise than meant.
    """
    binary = b""
    if content.startswith(b"glTF"):
        (length,) = struct.unpack_from("<I", content, 12)
        content, binary = content[20 : 20 + length], content[28 + length :]
    tree = json.loads(content, object_hook=_counted, parse_constant=_no_number)
    parts = [part for mesh in tree.get("meshes", []) for part in mesh["primitives"]]
    _require_plain(tree, parts)

    def data(source: dict[str, Any]) -> bytes:
        if "bufferView" in source:
            view = tree["bufferViews"][source["bufferView"]]
            start = view.get("byteOffset", 0)
            return data(tree["buffers"][view["buffer"]])[start : start + view["byteLength"]]
        uri = source.get("uri")
        if uri is None:
            return binary
        return base64.b64decode(uri.partition(",")[2]) if uri.startswith("data:") else read(uri)

    for number in {part["material"] for part in parts if "material" in part}:
        for reference in _references(tree["materials"][number]):
            if reference.get("texCoord") or "KHR_texture_transform" in reference.get("extensions", {}):
                raise ValueError("an image is placed by a second set of coordinates or moved, which is not read")
            texture = tree["textures"][reference["index"]]
            source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
            if source is None:
                raise ValueError("a texture has no image as PNG, JPEG or WebP")
            image = tree["images"][source]
            yield image.get("name") or image.get("uri", "")[:40] or f"image {source}", data(image)


def _references(material: dict[str, Any]) -> list[dict[str, Any]]:
    """Of the textures of a material's color."""
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    both = material.get("pbrMetallicRoughness", {}).get("baseColorTexture"), glossy.get("diffuseTexture")
    return [reference for reference in both if reference is not None]


def _require_plain(tree: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    """ValueError where shape or texture coordinates are stored in a way that trimesh takes for another."""
    for name in tree.get("extensionsRequired", []):
        if not name.startswith(SURFACES):
            raise ValueError(f"it needs {name}, which is not read")
    for part in parts:
        for name, number in {**part["attributes"], "indices": part.get("indices")}.items():
            accessor = tree["accessors"][number] if number is not None else {}
            if "sparse" in accessor:
                raise ValueError("it has sparse accessors, which are not read")
            if name in ("POSITION", "TEXCOORD_0") and accessor["componentType"] != FLOAT:
                raise ValueError(f"its {name} are whole numbers, which are not read")


def _counted(node: dict[str, Any]) -> dict[str, Any]:
    """ValueError for an index from the end, as Python has it and glTF has not."""
    for key in INDICES:
        if isinstance(node.get(key), int) and node[key] < 0:
            raise ValueError(f"{key} is {node[key]}")
    return node


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number in JSON")
