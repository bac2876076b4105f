"""A shot's scene, path-traced by Mitsuba 3: an object on a table under a projector with weak light from everywhere, or
under an environment map."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from renderer.io.mitsuba import TO_Z_UP, mitsuba
from train.laboratory.props import Part
from train.laboratory.shots import FIELD_OF_VIEW, Shot

ROUGHNESS = 0.5  # of the objects' surface: a soft gloss, as peel has
THROW = 2.6  # half of the width that the projector lights where it aims, in world units
FLOOR = 100.0  # half of the table's width


def photograph(parts: Sequence[Part], shot: Shot, size: int, samples: int, bounces: int, seed: int) -> np.ndarray:
    """(size, size, 3) float32 linear radiance; the seed is that of Mitsuba's samples, `samples` per pixel and light.

    The projector and the surroundings are rendered one by one and added: with both in one scene each path would draw
    which of them to look at, which is most of the noise. InputError: Mitsuba is not installed.
    """
    with mitsuba() as mi:
        still = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": _sensor(mi, shot, size),
            "table": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(FLOOR),
                "bsdf": {"type": "diffuse", "reflectance": _rgb(shot.table)},
            },
            **{f"part_{index}": shape for index, shape in enumerate(_object(mi, parts, shot))},
        }
        scenes = [mi.load_dict({**still, "light": light}) for light in _lights(mi, shot)]
        return np.sum([np.array(mi.render(scene, spp=samples, seed=seed)) for scene in scenes], axis=0)


def _sensor(mi: ModuleType, shot: Shot, size: int) -> dict[str, Any]:
    look = mi.ScalarTransform4f().look_at(origin=list(shot.camera), target=list(shot.aim), up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": FIELD_OF_VIEW, "to_world": look, "film": film}


def _lights(mi: ModuleType, shot: Shot) -> list[dict[str, Any]]:
    if shot.environment is not None:
        turn = mi.ScalarTransform4f([list(row) for row in TO_Z_UP])
        return [{"type": "envmap", "bitmap": mi.Bitmap(shot.environment), "to_world": turn}]
    return [_projector(mi, shot), {"type": "constant", "radiance": _rgb(shot.ambient)}]


def _projector(mi: ModuleType, shot: Shot) -> dict[str, Any]:
    """Mitsuba's gives a white surface that faces it at distance 1 the radiance of its image."""
    distance = float(np.linalg.norm(shot.projector - shot.center))
    return {
        "type": "projector",
        "to_world": mi.ScalarTransform4f().look_at(origin=list(shot.projector), target=list(shot.center), up=[0, 0, 1]),
        "fov": 2 * float(np.degrees(np.arctan(THROW / distance))),
        "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(shot.pattern), "raw": True},
        "scale": shot.brightness * distance**2,
    }


def _object(mi: ModuleType, parts: Sequence[Part], shot: Shot) -> list[Any]:
    """The object turned, scaled and set down on the table."""
    turned = [shot.scale * part.positions @ shot.turn.T for part in parts]
    lowest = min(positions[..., 2].min() for positions in turned)
    return [
        _shape(mi, part, positions - [0, 0, lowest], part.normals @ shot.turn.T)
        for part, positions in zip(parts, turned, strict=True)
    ]


def _shape(mi: ModuleType, part: Part, positions: np.ndarray, normals: np.ndarray) -> Any:
    """Every face gets corners of its own, as colors are kept."""
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
    buffers["vertex_positions"] = positions.astype(np.float32).ravel()
    buffers["vertex_normals"] = normals.astype(np.float32).ravel()
    buffers["vertex_texcoords"] = part.uvs.astype(np.float32).ravel()
    buffers.update()
    return shape


def _rgb(color: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in color]}
