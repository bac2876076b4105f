"""Entries of Mitsuba scenes, as dictionaries.

A scene is a dictionary as `mitsuba.load_dict` takes it, except for two kinds of
value. A to_world transform is an array (4, 4). An image is an array (H, W, 3)
under "bitmap", or the name of a file under "filename". `renderer.mitsuba_scene`
loads and writes such scenes.
"""

from typing import Any

import numpy as np

from renderer.camera import Camera, PerspectiveCamera

# Type of an entry of a Mitsuba scene.
Scene = dict[str, Any]

# Matrix from the axes of Mitsuba's environment maps to world axes. Mitsuba's maps have
# y up, and +z is in the middle column. In our maps, z is up, and +x is in the middle.
TO_Z_UP = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def integrator(bounces: int, emitter_samples: int = 0) -> Scene:
    """Create the entry of an integrator, which says how Mitsuba follows light.

    Args:
        bounces: Number of bounces between surfaces. With 0, only light that comes
            directly from emitters is rendered.
        emitter_samples: Number of rays from a surface point to emitters if
            `bounces` is 0. One more ray has a random direction.

    Returns:
        Entry of the type "path" or "direct".
    """
    if bounces:
        # Mitsuba also counts the emitter and the surface that the camera sees.
        depth = bounces + 2
        return {"type": "path", "max_depth": depth, "rr_depth": depth, "hide_emitters": True}
    samples = {"emitter_samples": emitter_samples, "bsdf_samples": 1}
    return {"type": "direct", **samples, "hide_emitters": True}


def environment(radiance: Scene, scale: float = 1.0) -> Scene:
    """Create the entry of an environment map.

    Args:
        radiance: Image of the map in the layout of `renderer.light.environment`,
            as {"bitmap": array} or {"filename": name}.
        scale: Factor for the radiance.

    Returns:
        Entry of the emitter "envmap".
    """
    return {"type": "envmap", **radiance, "scale": scale, "to_world": TO_Z_UP}


def projector(pose: np.ndarray, fov: float, pattern: Scene, scale: float) -> Scene:
    """Create the entry of a projector.

    Args:
        pose: Matrix from the axes of the projector to world axes, from `pose_of`,
            shape (4, 4).
        fov: Angle between opposite sides of the pattern in degrees.
        pattern: Image of the pattern, as {"bitmap": array} or
            {"filename": name}, with other options of the texture.
        scale: Factor for the pattern. A white surface that faces the projector
            at distance 1 has the radiance pattern · scale.

    Returns:
        Entry of the emitter "projector".
    """
    irradiance = {"type": "bitmap", **pattern, "raw": True}
    lens = {"fov": fov, "scale": scale, "to_world": pose}
    return {"type": "projector", "irradiance": irradiance, **lens}


def sensor(
    pose: np.ndarray,
    size: int,
    fov: float | None = None,
    pixel_format: str = "rgba",
    film_center: tuple[float, float] = (0.0, 0.0),
    pixel_aspect: float = 1.0,
) -> Scene:
    """Create the entry of a camera.

    Args:
        pose: Matrix from the axes of the camera to world axes, from `pose_of`,
            shape (4, 4).
        size: Number of pixels along one side of the image.
        fov: Angle between opposite sides of the image in degrees. None for a
            camera without perspective, whose image shows [-1, 1] in the x and y
            of the pose.
        pixel_format: Channels of the image, such as "rgba".
        film_center: Center of the image of a perspective camera, to the right of
            the principal point and below it, divided by the width and the height
            of the image.
        pixel_aspect: Vertical focal length divided by the horizontal one, both
            in pixels. Mitsuba has square pixels, so the image gets another number
            of rows instead.

    Returns:
        Entry of the sensor "perspective" or "orthographic".
    """
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": max(1, round(size / pixel_aspect)),
        "pixel_format": pixel_format,
        "rfilter": {"type": "box"},
    }
    lens: Scene = {"type": "orthographic"}
    if fov is not None:
        lens = {"type": "perspective", "fov": fov}
    if any(film_center):
        right, below = film_center
        lens |= {"principal_point_offset_x": right, "principal_point_offset_y": below}
    return {**lens, "to_world": pose, "film": film}


def sensor_of(camera: Camera, size: int, pixel_format: str = "rgba") -> Scene:
    """Convert a camera of the renderer to an entry of a Mitsuba scene.

    Args:
        camera: Camera to convert.
        size: Number of pixels along one side of the image.
        pixel_format: Channels of the image, such as "rgba".

    Returns:
        Entry of the sensor, see `sensor`.
    """
    if isinstance(camera, PerspectiveCamera):
        film_center = (-camera.principal_right / 2, camera.principal_up / 2)
        pose = pose_of(camera)
        aspect = camera.pixel_aspect
        return sensor(pose, size, camera.angle, pixel_format, film_center, aspect)
    return sensor(pose_of(camera, camera.width / 2), size, None, pixel_format)


def pose_of(camera: Camera, scale: float = 1.0) -> np.ndarray:
    """Compute the pose of a camera, or of a projector at the same place, for Mitsuba.

    Mitsuba's cameras and projectors look along +z, and x points to the left. Our
    cameras look along -z, and x points to the right.

    Args:
        camera: Camera of the renderer.
        scale: Number of world units per unit along x and y.

    Returns:
        Matrix from the axes of Mitsuba's camera to world axes, shape (4, 4).
    """
    pose = camera.pose()
    # The first three columns are the axes x, y and z.
    pose[:3] *= [-scale, scale, -1, 1]
    return pose


def look_at(origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the pose of a Mitsuba camera or projector that looks at a point, with z up.

    Args:
        origin: Position of the camera in world axes, shape (3,).
        target: Point at which the camera looks, shape (3,). It must not lie
            exactly above or below the camera.

    Returns:
        Matrix from the axes of Mitsuba's camera to world axes, shape (4, 4).
    """
    ahead = (target - origin) / np.linalg.norm(target - origin)
    left = np.cross([0, 0, 1], ahead)
    left /= np.linalg.norm(left)
    axes = np.stack([left, np.cross(ahead, left), ahead, origin], axis=1)
    return np.block([[axes], [np.array([0, 0, 0, 1.0])]])
