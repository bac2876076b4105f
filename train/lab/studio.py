"""A shot, path-traced by Mitsuba 3: an object on a table under a projector with weak light from everywhere, or under an
environment map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from renderer.errors import InputError
from renderer.image import decode
from renderer.io.export import corner_normals
from renderer.io.mitsuba import TO_Z_UP, mitsuba
from renderer.mesh import Mesh
from train.lab.shots import FOV, Shot

SHARP = 0.85  # cosine off the vertex normal beyond which a face keeps its own: at a right-angled edge at most 0.82
ROUGHNESS = 0.5  # of the objects' surface: a soft gloss, as peel has
THROW = 2.6  # half of the width that the projector lights where it aims, in world units
FLOOR = 100.0  # half of the table's width


@dataclass(frozen=True)
class Part:
    """F faces with the same texture, or without one.

    positions, normals (F, 3, 3) and uvs (F, 3, 2), the last with v downwards: per corner. albedo: linear in [0, 1], of
    the corners (F, 3, 3), or of the texture's pixels (H, W, 3) if `textured`.
    """

    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    albedo: np.ndarray
    textured: bool


def split_parts(mesh: Mesh, albedo_scale: float, name: str) -> list[Part]:
    """The mesh by texture, with the albedo times `albedo_scale` and at most 1.

    InputError, naming the mesh: a texture on corners of different colors.
    """
    normals, parts = crease_normals(mesh), []
    for texture in np.unique(mesh.texture_ids):
        faces = mesh.texture_ids == texture
        colors = _linear(mesh.corner_colors[faces])
        if texture >= 0:
            if (colors != colors[0, 0]).any():
                raise InputError(f"{name} has a texture and colors of its vertices, too: paint them into the texture")
            colors = _linear(mesh.textures[texture] / 255) * colors[0, 0]
        albedo = np.clip(albedo_scale * colors, 0, 1).astype(np.float32)
        uvs = mesh.corner_uvs[faces] * [1, -1] + [0, 1]
        parts.append(Part(mesh.vertices[mesh.faces[faces]], normals[faces], uvs, albedo, bool(texture >= 0)))
    return parts


def crease_normals(mesh: Mesh) -> np.ndarray:
    """(F, 3, 3) unit normals: smooth, except for faces that meet their neighbors at a sharp edge, which stay flat."""
    smooth, flat = corner_normals(mesh, "smooth"), corner_normals(mesh, "flat")
    return np.where((smooth * flat).sum(axis=-1, keepdims=True) < SHARP, flat, smooth)


def _linear(colors: np.ndarray) -> np.ndarray:
    return decode(torch.from_numpy(np.asarray(colors, dtype=np.float64)), "srgb").numpy()


def photograph(parts: Sequence[Part], shot: Shot, size: int, spp: int, bounces: int, seed: int) -> np.ndarray:
    """(size, size, 3) float32 linear radiance, from `spp` samples per pixel and light; seed: of Mitsuba's samples.

    Projector and surroundings are rendered one by one and added: with both in one scene each path would choose one of
    them at random, which is most of the noise. InputError: Mitsuba is not installed.
    """
    with mitsuba() as mi:
        film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        pose = _look_at(mi, shot.camera, shot.aim)
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": {"type": "perspective", "fov": FOV, "to_world": pose, "film": film},
            "table": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(FLOOR),
                "bsdf": {"type": "diffuse", "reflectance": _rgb(shot.table)},
            },
            **{f"part_{index}": shape for index, shape in enumerate(_object(mi, parts, shot))},
        }
        scenes = [mi.load_dict({**scene, "light": light}) for light in _lights(mi, shot)]
        return np.sum([np.array(mi.render(scene, spp=spp, seed=seed)) for scene in scenes], axis=0)


def _look_at(mi: Any, origin: np.ndarray, target: np.ndarray) -> Any:
    return mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=[0, 0, 1])


def _rgb(color: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in color]}


def _lights(mi: Any, shot: Shot) -> list[dict[str, Any]]:
    """Mitsuba's projector gives a white surface that faces it at distance 1 the radiance of its image."""
    if shot.environment is not None:
        to_world = mi.ScalarTransform4f([list(row) for row in TO_Z_UP])
        return [{"type": "envmap", "bitmap": mi.Bitmap(shot.environment), "to_world": to_world}]
    distance = float(np.linalg.norm(shot.projector - shot.center))
    projector = {
        "type": "projector",
        "to_world": _look_at(mi, shot.projector, shot.center),
        "fov": 2 * float(np.degrees(np.arctan(THROW / distance))),
        "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(shot.pattern), "raw": True},
        "scale": shot.brightness * distance**2,
    }
    return [projector, {"type": "constant", "radiance": _rgb(shot.ambient)}]


def _object(mi: Any, parts: Sequence[Part], shot: Shot) -> list[Any]:
    """The object rotated, scaled and set down on the table, a shape per part."""
    rotated = [shot.scale * part.positions @ shot.rotation.T for part in parts]
    lowest = min(positions[..., 2].min() for positions in rotated)
    return [
        _shape(mi, part, positions - [0, 0, lowest], part.normals @ shot.rotation.T)
        for part, positions in zip(parts, rotated, strict=True)
    ]


def _shape(mi: Any, part: Part, positions: np.ndarray, normals: np.ndarray) -> Any:
    """Corners are not shared between faces, since each has its own normal and color."""
    albedo: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
    if part.textured:
        albedo = {"type": "bitmap", "bitmap": mi.Bitmap(part.albedo), "raw": True}
    surface = {"type": "principled", "base_color": albedo, "roughness": ROUGHNESS}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "surface": surface})
    corners = 3 * len(positions)
    shape = mi.Mesh(
        "part", corners, len(positions), props=properties, has_vertex_normals=True, has_vertex_texcoords=True
    )
    if not part.textured:
        shape.add_attribute("vertex_color", 3, part.albedo.ravel())
    buffers = mi.traverse(shape)
    buffers["faces"] = np.arange(corners, dtype=np.uint32)
    for name, values in (("positions", positions), ("normals", normals), ("texcoords", part.uvs)):
        buffers[f"vertex_{name}"] = values.astype(np.float32).ravel()
    buffers.update()
    return shape
