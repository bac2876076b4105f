"""A shot, path-traced by Mitsuba 3: an object on a table under a projector with weak light from everywhere, or under an
environment map."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from renderer.image import decode
from renderer.io.mitsuba import Part, environment, load, look_at, mitsuba, projector, sensor, shape, split_parts
from renderer.mesh import Mesh
from renderer.normals import corner_normals
from train.lab.shots import FOV, Shot

SHARP = 0.85  # cosine off the vertex normal beyond which a face keeps its own: at a right-angled edge at most 0.82
ROUGHNESS = 0.5  # of the objects' surface: a soft gloss, as peel has
THROW = 2.6  # half of the width that the projector lights where it aims, in world units
FLOOR = 100.0  # half of the table's width


def lab_parts(mesh: Mesh, albedo_scale: float) -> list[Part]:
    """The mesh by texture: smooth but at sharp edges, with linear colors and textures (H, W, 3) times `albedo_scale`
    and at most 1."""

    def scaled(linear: np.ndarray) -> np.ndarray:
        return np.clip(albedo_scale * linear, 0, 1).astype(np.float32)

    parts = []
    for part in split_parts(mesh, corner_normals(mesh, "smooth", SHARP), "srgb"):
        texture = part.texture
        if texture is not None:
            texture = scaled(decode(torch.from_numpy(texture / 255), "srgb").numpy())
        parts.append(replace(part, colors=scaled(part.colors), texture=texture))
    return parts


def photograph(parts: Sequence[Part], shot: Shot, size: int, spp: int, bounces: int, seed: int) -> np.ndarray:
    """(size, size, 3) float32 linear radiance, from `spp` samples per pixel and light; seed: of Mitsuba's samples.

    Projector and surroundings are rendered one by one and added: with both in one scene each path would choose one of
    them at random, which is most of the noise. InputError: Mitsuba is not installed.
    """
    with mitsuba() as module:
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": sensor(look_at(shot.camera, shot.aim), size, FOV, "rgb"),
            "table": {
                "type": "rectangle",
                "to_world": np.diag([FLOOR, FLOOR, FLOOR, 1.0]),
                "bsdf": {"type": "diffuse", "reflectance": _rgb(shot.table)},
            },
            **{f"part_{index}": part for index, part in enumerate(_object(module, parts, shot))},
        }
        scenes = [load(module, {**scene, "light": light}) for light in _lights(shot)]
        return np.sum([np.array(module.render(scene, spp=spp, seed=seed)) for scene in scenes], axis=0)


def _rgb(color: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in color]}


def _lights(shot: Shot) -> list[dict[str, Any]]:
    if shot.environment is not None:
        return [environment({"bitmap": shot.environment})]
    distance = float(np.linalg.norm(shot.projector - shot.center))
    fov, scale = 2 * float(np.degrees(np.arctan(THROW / distance))), shot.brightness * distance**2
    pattern = projector(look_at(shot.projector, shot.center), fov, {"bitmap": shot.pattern}, scale)
    return [pattern, {"type": "constant", "radiance": _rgb(shot.ambient)}]


def _object(module: Any, parts: Sequence[Part], shot: Shot) -> list[Any]:
    """The object rotated, scaled and set down on the table, a shape per part."""
    rotated = [(shot.scale * part.positions @ shot.rotation.T).reshape(-1, 3) for part in parts]
    lowest, shapes = min(positions[:, 2].min() for positions in rotated), []
    for part, positions in zip(parts, rotated, strict=True):
        albedo: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
        if part.texture is not None:
            albedo = {"type": "bitmap", "bitmap": part.texture, "raw": True}
        surface = {"type": "principled", "base_color": albedo, "roughness": ROUGHNESS}
        faces, normals = np.arange(len(positions)).reshape(-1, 3), (part.normals @ shot.rotation.T).reshape(-1, 3)
        positions, uvs, colors = positions - [0, 0, lowest], part.uvs.reshape(-1, 2), part.colors.reshape(-1, 3)
        twosided = {"type": "twosided", "surface": surface}
        shapes.append(shape(module, twosided, positions, faces, normals, uvs, colors))
    return shapes
