"""Describe cameras, lights and integrators as entries of a Mitsuba scene.

A Mitsuba scene is a dictionary, and so is each of its entries. `mitsuba.load_dict`
takes such dictionaries, except for two kinds of value. A transformation
("to_world") is an array (4, 4). An image is an array (H, W, 3) under "bitmap", or
the name of a file under "filename". `renderer.mitsuba_scene` loads and writes
such scenes.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from renderer.camera import Camera, PerspectiveCamera
from renderer.settings import Size, height_and_width

# Type of a Mitsuba scene, and of an entry of
# the scene such as a camera: a dictionary.
Scene = dict[str, Any]

# Matrix from the axes of a camera or a projector to world axes.
Pose = Float[np.ndarray, "4 4"]
# Matrix from the axes of Mitsuba's environment maps to world
# axes. In Mitsuba's maps, y is up and the middle column shows
# +z. In our maps, z is up and the middle column shows +x.
TO_Z_UP = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def integrator(bounces: int, emitter_samples: int = 0) -> Scene:
    """Describe an integrator, which computes the light that reaches the camera, for Mitsuba.

    With 0 bounces, only light that comes directly from emitters is rendered, with one ray in a
    random direction besides the `emitter_samples`.
    """
    if bounces:
        # Mitsuba's depth counts path segments: two more than
        # the bounces between surfaces, from the emitter to the
        # first surface and from the last surface to the camera.
        depth = bounces + 2
        return {"type": "path", "max_depth": depth, "rr_depth": depth, "hide_emitters": True}
    samples = {"emitter_samples": emitter_samples, "bsdf_samples": 1}
    return {"type": "direct", **samples, "hide_emitters": True}


def environment(radiance: Scene, scale: float = 1.0) -> Scene:
    """Describe an environment map, {"bitmap": array} or {"filename": name}, for Mitsuba."""
    return {"type": "envmap", **radiance, "scale": scale, "to_world": TO_Z_UP}


def projector(pose: Pose, fov: float, pattern: Scene, scale: float) -> Scene:
    """Describe a projector for Mitsuba.

    A white surface that faces the projector at distance 1 has the radiance pattern · scale. The
    pose is that of `pose_of`, and `fov` is in degrees.
    """
    lens = {"fov": fov, "scale": scale, "to_world": pose}
    return {"type": "projector", "irradiance": {"type": "bitmap", **pattern, "raw": True}, **lens}


def sensor(
    pose: Pose, size: Size, lens: Scene, pixel_format: str = "rgba", pixel_aspect: float = 1.0
) -> Scene:
    """Describe a camera for Mitsuba, which calls it a sensor.

    The lens is {"type": "perspective", "fov": horizontal angle in degrees}, or, for x and y from
    -1 to 1 without perspective, {"type": "orthographic"}. Mitsuba has square pixels, so the number
    of rows is divided by `pixel_aspect`.
    """
    height, width = height_and_width(size)
    film = {"type": "hdrfilm", "width": width, "height": max(1, round(height / pixel_aspect))}
    film |= {"pixel_format": pixel_format, "rfilter": {"type": "box"}}
    return {**lens, "to_world": pose, "film": film}


def sensor_of(camera: Camera, size: Size) -> Scene:
    """Convert a camera of this renderer to a camera of Mitsuba."""
    if not isinstance(camera, PerspectiveCamera):
        return sensor(pose_of(camera, camera.width / 2), size, {"type": "orthographic"})
    lens: Scene = {"type": "perspective", "fov": camera.angle}
    # By default, Mitsuba shows nothing nearer than 0.01 or farther than 10,000 units.
    lens |= {"near_clip": min(0.01, camera.near), "far_clip": max(1e4, camera.far)}
    if camera.principal_right or camera.principal_up:
        # The principal point is measured from the image center in halves of the image, and
        # Mitsuba measures the image center from the principal point, right and down, in widths
        # and heights of the image. Ours are in halves of its width.
        height, width = height_and_width(size)
        lens["principal_point_offset_x"] = -camera.principal_right / 2
        lens["principal_point_offset_y"] = camera.principal_up / 2 * (width / height)
    return sensor(pose_of(camera), size, lens, pixel_aspect=camera.pixel_aspect)


def pose_of(camera: Camera, scale: float = 1.0) -> Pose:
    """Compute the pose of a camera, or of a projector at the same place, for Mitsuba.

    Mitsuba's cameras and projectors look along +z, and x points to the left. Our
    cameras look along -z, and x points to the right. The matrix maps to world axes. One unit of x
    and y in Mitsuba is `scale` world units.
    """
    pose = camera.pose()
    # The columns are the axes x, y and z and the
    # position. Mitsuba's x and z are opposite.
    pose[:3] *= [-scale, scale, -1, 1]
    return pose


def look_at(origin: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Pose:
    """Compute the pose of a Mitsuba camera or projector that looks at a point, with z up."""
    ahead = (target - origin) / np.linalg.norm(target - origin)
    left = np.cross([0, 0, 1], ahead)
    left /= np.linalg.norm(left)
    axes = np.stack([left, np.cross(ahead, left), ahead, origin], axis=1)
    return np.block([[axes], [np.array([0, 0, 0, 1.0])]])
