"""Entries of Mitsuba scenes, as dictionaries.

A scene is a dictionary as `mitsuba.load_dict` takes it, except for two kinds of
value. A to_world transform is an array (4, 4). An image is an array (H, W, 3)
under "bitmap", or the name of a file under "filename". `renderer.mitsuba_scene`
loads and writes such scenes.
"""

from typing import Any

import numpy as np

from renderer.camera import Camera, PerspectiveCamera

Scene = dict[str, Any]

# Turns Mitsuba's environment maps, whose y is up and whose +z is in the middle.
TO_Z_UP = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def integrator(bounces: int, emitter_samples: int = 0) -> Scene:
    """Describe how light is followed.

    Args:
        bounces: Number of bounces between surfaces. With 0, light is direct: rays
            leave surfaces by the cosine.
        emitter_samples: Rays from a surface to emitters, for direct light.

    Returns:
        A "path" or a "direct" integrator.
    """
    if bounces:
        depth = bounces + 2
        return {"type": "path", "max_depth": depth, "rr_depth": depth, "hide_emitters": True}
    samples = {"emitter_samples": emitter_samples, "bsdf_samples": 1}
    return {"type": "direct", **samples, "hide_emitters": True}


def environment(radiance: Scene, scale: float = 1.0) -> Scene:
    """Describe an environment map.

    Args:
        radiance: Its entry "bitmap" or "filename", laid out as in
            `renderer.light.environment`.
        scale: Factor of the radiance.

    Returns:
        An "envmap" emitter.
    """
    return {"type": "envmap", **radiance, "scale": scale, "to_world": TO_Z_UP}


def projector(pose: np.ndarray, fov: float, pattern: Scene, scale: float) -> Scene:
    """Describe a projector.

    Args:
        pose: Projector to world, shape (4, 4), as `pose_of` returns it.
        fov: Angle between opposite sides of the pattern, in degrees.
        pattern: Its entry "bitmap" or "filename".
        scale: Factor of the pattern. A white surface that faces the projector at
            distance 1 has the radiance pattern · scale.

    Returns:
        A "projector" emitter.
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
    """Describe a camera.

    Args:
        pose: Camera to world, shape (4, 4), as `pose_of` returns it.
        size: Pixels per side.
        fov: Angle between the image's sides, in degrees. Without perspective, the
            image spans [-1, 1] in x and y under the pose.
        pixel_format: Mitsuba's name of the channels.
        film_center: Position of the center of the film of a perspective camera,
            right of and below the principal point, in units of the film's sides.
        pixel_aspect: Vertical over horizontal focal length in pixels. Mitsuba's
            pixels are square, so that the film has another number of rows.

    Returns:
        A "perspective" or an "orthographic" sensor.
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
    """Describe a camera of the renderer, see `sensor`.

    Args:
        camera: Camera to describe.
        size: Pixels per side of the image.
        pixel_format: Channels of the image, such as "rgba".

    Returns:
        The sensor as a dictionary for Mitsuba.
    """
    if isinstance(camera, PerspectiveCamera):
        film_center = (-camera.principal_right / 2, camera.principal_up / 2)
        pose = pose_of(camera)
        aspect = camera.pixel_aspect
        return sensor(pose, size, camera.angle, pixel_format, film_center, aspect)
    return sensor(pose_of(camera, camera.width / 2), size, None, pixel_format)


def pose_of(camera: Camera, scale: float = 1.0) -> np.ndarray:
    """Compute the pose of a camera, or of a projector in its place.

    Mitsuba's cameras and projectors look along +z and have x to the left.

    Args:
        camera: The camera.
        scale: World units per unit along x and y.

    Returns:
        Camera to world, shape (4, 4).
    """
    pose = camera.pose()
    pose[:3] *= [-scale, scale, -1, 1]
    return pose


def look_at(origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the pose of a camera or projector at a point that looks at another, with z up.

    Args:
        origin: Where it stands, shape (3,).
        target: What it looks at, shape (3,), not above or below the origin.

    Returns:
        Camera to world, shape (4, 4).
    """
    ahead = (target - origin) / np.linalg.norm(target - origin)
    left = np.cross([0, 0, 1], ahead)
    left /= np.linalg.norm(left)
    axes = np.stack([left, np.cross(ahead, left), ahead, origin], axis=1)
    return np.block([[axes], [np.array([0, 0, 0, 1.0])]])
