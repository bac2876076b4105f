"""Joints and weights of a glTF file: trimesh reads attributes whose names begin with _, so they are given such names.

Sections 3.7.3 and 5.28 of glTF 2.0. Morph targets and animations are left out: the joints stand as the nodes do.
"""

import json
import struct
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from renderer.geometry.mesh import Mesh, transformed
from renderer.geometry.skin import Skin

BIND, JOINTS, WEIGHTS = "_BIND", "_JOINTS_", "_WEIGHTS_"
TOLERANCE = 0.01  # of the sum of a vertex's weights, which may be of 8 bits


def with_skins_as_attributes(content: bytes, tree: dict[str, Any]) -> bytes:
    """A .gltf or .glb file whose tree has skins, with its parts' joints, weights and inverse bind matrices as
    attributes that trimesh reads, and its nodes named by their numbers. ValueError: a skin without weights."""
    tree = deepcopy(tree)
    for number, node in enumerate(tree["nodes"]):
        node["name"] = str(number)
        if "skin" not in node:
            continue
        mesh = tree["meshes"][node["mesh"]]
        if mesh.setdefault("extras", {}).setdefault("skin", node["skin"]) != node["skin"]:
            raise ValueError("a mesh with two skins is not supported")
        for attributes in (part["attributes"] for part in mesh["primitives"]):
            if not {"JOINTS_0", "WEIGHTS_0"} <= attributes.keys():
                raise ValueError("a mesh with a skin has no joints and weights (JOINTS_0, WEIGHTS_0)")
            attributes |= {f"_{name}": index for name, index in attributes.items() if name[:3] in ("JOI", "WEI")}
            if (bind := tree["skins"][node["skin"]].get("inverseBindMatrices")) is not None:
                attributes[BIND] = bind
    text = json.dumps(tree).encode()
    if not content.startswith(b"glTF"):
        return text
    text += b" " * (-len(text) % 4)
    version, _, length = struct.unpack_from("<III", content, 4)
    rest = content[20 + length :]
    return struct.pack("<4sIIII", b"glTF", version, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def skinned(part: Mesh, node: str, scene: trimesh.Scene, tree: dict[str, Any]) -> Mesh:
    """A part of such a file where its joints carry it: by its weights or, without a skin, as it hangs on a joint, if it
    does. node: where the scene has it. tree: the file's own. ValueError: weights that do not sum to one, joints out of
    range."""
    nodes, joints = tree["nodes"], {joint for skin in tree["skins"] for joint in skin["joints"]}
    parents = {child: parent for parent, item in enumerate(nodes) for child in item.get("children", [])}

    def above(number: int) -> list[int]:
        """The joints from a node upwards, itself included."""
        return [*([number] if number in joints else []), *(above(parents[number]) if number in parents else [])]

    order = sorted(joints, key=lambda joint: (len(above(joint)), joint))
    column = {joint: index for index, joint in enumerate(order)}
    number, (matrix, name) = int(node.split("_")[0]), scene.graph[node]
    weights, matrices = np.zeros((len(part.vertices), len(order))), matrix[None].repeat(len(order), axis=0)
    places = np.stack([scene.graph[str(joint)][0] for joint in order])
    if "skin" in nodes[number]:
        used = np.array([column[joint] for joint in tree["skins"][nodes[number]["skin"]]["joints"]])
        attributes = scene.geometry[name].vertex_attributes
        bind = attributes[BIND].swapaxes(1, 2) if BIND in attributes else np.eye(4)  # glTF has columns after columns
        matrices[used], matrix = places[used] @ bind, (places[used] @ bind)[0]
        for key in [key for key in attributes if key.startswith(JOINTS)]:
            values = attributes[key.replace(JOINTS, WEIGHTS)]
            values = values / (np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1)
            indices = np.where(values == 0, 0, attributes[key])
            if indices.max() >= len(used):
                raise ValueError(f"a vertex names joint {indices.max()}, but its skin has {len(used)}")
            np.add.at(weights, (np.arange(len(weights))[:, None], used[indices]), values)
        sums = weights.sum(axis=1)
        if not (np.abs(sums - 1) <= TOLERANCE).all():  # NaN is not
            raise ValueError(f"the weights of a vertex sum to {sums[np.abs(sums - 1).argmax()]:g} instead of one")
        weights /= sums[:, None]
    elif above(number):
        weights[:, column[above(number)[0]]] = 1
    homogeneous = np.insert(part.vertices, 3, 1, axis=1)
    carried = (np.einsum("jab,vb->vja", matrices, homogeneous) * weights[..., None]).astype(np.float32)
    hangs_on = [column[above(joint)[1]] if len(above(joint)) > 1 else -1 for joint in order]
    names = tuple(str(nodes[joint].get("name", joint)) for joint in order)
    placed = transformed(part, matrix)  # whose faces are reversed where it mirrors
    if weights.any():
        placed = replace(placed, vertices=carried[..., :3].sum(axis=1, dtype=np.float64))
    return replace(placed, skin=Skin(names, np.array(hangs_on), places[:, :3, 3], carried))
