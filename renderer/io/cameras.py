"""Read cameras from the files of COLMAP and nerfstudio.

The intrinsics of a camera are the matrix (fx, 0, cx; 0, fy, cy; 0, 0, 1) with
the focal lengths fx and fy and the principal point (cx, cy), in pixels from the
top left corner of the image.
"""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from renderer.camera import PinholeCamera
from renderer.errors import InputError, require_file
from renderer.validation import as_path

# Names of the text files of a COLMAP model.
COLMAP_CAMERAS = "cameras.txt"
COLMAP_IMAGES = "images.txt"
# Name of the camera file of nerfstudio.
TRANSFORMS = "transforms.json"
# COLMAP's camera models without lens distortion, and their numbers of parameters.
COLMAP_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
# Keys of the distortion parameters in transforms.json.
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# Advice in errors about lens distortion.
UNDISTORT = "undistort the images first, for example with colmap image_undistorter"
# Exceptions that are raised if a file has missing or wrong entries.
_DAMAGED_FILE_ERRORS = (ValueError, KeyError, TypeError, IndexError, AttributeError)


def load_cameras(path: str | Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a scene from files of COLMAP or nerfstudio.

    COLMAP's models SIMPLE_PINHOLE and PINHOLE are read. Images with lens
    distortion must be undistorted first, for example by COLMAP's
    image_undistorter. Binary models are written as text by `colmap
    model_converter --output_type TXT`.

    The cameras have the world coordinates of the file, so load the mesh with
    up="z", which leaves its axes as they are. Cameras of images that are not
    square show the square in the center, see `PinholeCamera.from_matrix`.

    Args:
        path: A transforms.json file of nerfstudio, or a folder with this file or
            with the files cameras.txt and images.txt of COLMAP.

    Returns:
        Cameras by the names of their images, in the order of the file.

    Raises:
        InputError: If a file is missing or damaged, has no cameras, or if a
            camera has distortion.

    Example:
        >>> import json
        >>> from pathlib import Path
        >>> import norm_balls as nb
        >>> pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
        >>> frames = [{"file_path": "front.png", "transform_matrix": pose}]
        >>> scene = {"camera_angle_x": 0.6, "frames": frames}
        >>> _ = Path("transforms.json").write_text(json.dumps(scene))
        >>> cameras = nb.load_cameras("transforms.json")
        >>> [*cameras], round(cameras["front.png"].distance, 3)
        (['front.png'], 4.0)
    """
    path = as_path("path", path)
    if path.is_dir() and (path / COLMAP_IMAGES).exists():
        cameras = _read_colmap(path)
    else:
        cameras = _read_transforms(path / TRANSFORMS if path.is_dir() else path)
    if not cameras:
        raise InputError(f"{path} has no cameras: give files with one image or more")
    return cameras


def _read_colmap(folder: Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a COLMAP model from its text files.

    Args:
        folder: Folder with cameras.txt and images.txt.

    Returns:
        Cameras by the names of their images.

    Raises:
        InputError: If a file is missing or damaged, or if a camera has
            distortion.
    """
    cameras_path = folder / COLMAP_CAMERAS
    require_file(cameras_path, "give a folder with cameras.txt and images.txt")
    # Intrinsics and image size (width, height) by the id of the camera.
    intrinsics_and_size = {}
    cameras = {}
    # File that is being read, for the error.
    path = cameras_path
    try:
        for line in _lines(cameras_path):
            camera_id, model, width, height, *parameters = line.split()
            size = (int(width), int(height))
            intrinsics_and_size[camera_id] = (_colmap_intrinsics(model, parameters), size)
        path = folder / COLMAP_IMAGES
        for line in _image_lines(path):
            _, qw, qx, qy, qz, tx, ty, tz, camera_id, image_name = line.split(maxsplit=9)
            rotation = _rotation(np.array([qw, qx, qy, qz], dtype=float))
            translation = np.array([tx, ty, tz], dtype=float)
            # Matrix from world axes to the axes of the camera, shape (3, 4).
            view_matrix = np.column_stack([rotation, translation])
            intrinsics, size = intrinsics_and_size[camera_id]
            camera = PinholeCamera.from_matrix(view_matrix, intrinsics, size)
            cameras[image_name.strip()] = camera
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(
            f"{path} is no text file of COLMAP ({error!r}): export the model again"
        ) from error
    return cameras


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file that are neither empty nor comments."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            yield line


def _image_lines(path: Path) -> Iterator[str]:
    """Yield the line with the pose of each image from the file images.txt of COLMAP.

    The file has two lines for each image. The second line lists image points, is
    skipped, and may be empty.

    Args:
        path: Path of images.txt.

    Yields:
        First line of each image.
    """
    lines = iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if line.strip() and not line.startswith("#"):
            yield line
            next(lines, "")


def _colmap_intrinsics(model: str, parameters: list[str]) -> np.ndarray:
    """Convert the parameters of a COLMAP camera to an intrinsic matrix.

    Args:
        model: Name of the camera model, such as "PINHOLE".
        parameters: One or two focal lengths and the principal point (x, y), in
            pixels, as text.

    Returns:
        Intrinsic matrix, shape (3, 3).

    Raises:
        InputError: If the model has distortion.
        ValueError: If the number of parameters is wrong.
    """
    if model not in COLMAP_PARAMETERS:
        known = " and ".join(COLMAP_PARAMETERS)
        raise InputError(
            f"the camera model {model} is not supported, because it has lens distortion (supported "
            f"are {known}): {UNDISTORT}"
        )
    values = [float(parameter) for parameter in parameters]
    if len(values) != COLMAP_PARAMETERS[model]:
        raise ValueError(f"{model} with {len(values)} parameters")
    # SIMPLE_PINHOLE has one focal length for both axes.
    *focal_lengths, center_x, center_y = values
    return _intrinsic_matrix(focal_lengths[0], focal_lengths[-1], center_x, center_y)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Convert a quaternion to a rotation matrix.

    Args:
        quaternion: Quaternion (w, x, y, z) of any length, shape (4,).

    Returns:
        Rotation matrix, shape (3, 3).
    """
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    # Multiplying by this matrix is the cross product with (x, y, z).
    cross_matrix = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross_matrix + 2 * cross_matrix @ cross_matrix


def _intrinsic_matrix(
    focal_x: float, focal_y: float, center_x: float, center_y: float
) -> np.ndarray:
    """Create the intrinsic matrix of a pinhole camera.

    Args:
        focal_x: Focal length along image rows, in pixels.
        focal_y: Focal length along image columns, in pixels.
        center_x: Principal point, in pixels from the left edge of the image.
        center_y: Principal point, in pixels from the top edge of the image.

    Returns:
        Matrix, shape (3, 3).
    """
    return np.array([[focal_x, 0, center_x], [0, focal_y, center_y], [0, 0, 1]])


def _read_transforms(path: Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a transforms.json file of nerfstudio.

    Args:
        path: Path of the file.

    Returns:
        Cameras by the paths of their images in the file.

    Raises:
        InputError: If the file is missing or damaged, or if a camera has
            distortion.
    """
    require_file(path, "give transforms.json, or a folder with cameras.txt and images.txt")
    cameras = {}
    try:
        scene = json.loads(path.read_text(encoding="utf-8-sig"))
        for frame in scene["frames"]:
            # Intrinsics of the frame override those of the scene.
            intrinsics, size = _transforms_intrinsics({**scene, **frame})
            # The file stores the matrix from the axes of the camera to world axes.
            camera_to_world = np.array(frame["transform_matrix"], dtype=float)
            view_matrix = np.linalg.inv(camera_to_world)
            camera = PinholeCamera.from_matrix(view_matrix, intrinsics, size, "opengl")
            cameras[str(frame["file_path"])] = camera
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(
            f"{path} is no transforms.json of nerfstudio ({error!r}): export the file again"
        ) from error
    return cameras


def _transforms_intrinsics(entries: Mapping[str, Any]) -> tuple[np.ndarray, tuple[int, int]]:
    """Read the intrinsic matrix and the image size of a frame of transforms.json.

    Args:
        entries: Entries of the scene, overridden by those of the frame.

    Returns:
        A tuple of
        - the intrinsic matrix, shape (3, 3);
        - the width and the height of the image in pixels.

    Raises:
        InputError: If the camera has distortion.
    """
    distortion_keys = [name for name in DISTORTION if entries.get(name)]
    if distortion_keys:
        raise InputError(
            f"the cameras have lens distortion ({', '.join(distortion_keys)}), which is not "
            f"supported: {UNDISTORT}"
        )
    # A file with only a field of view may leave out the size of its square images.
    # The intrinsics are then those of an image of one pixel.
    width = int(entries.get("w", 1))
    height = int(entries.get("h", width))
    if "fl_x" in entries:
        focal_x = float(entries["fl_x"])
    else:
        focal_x = width / 2 / math.tan(float(entries["camera_angle_x"]) / 2)
    focal_y = float(entries.get("fl_y", focal_x))
    center_x = float(entries.get("cx", width / 2))
    center_y = float(entries.get("cy", height / 2))
    return _intrinsic_matrix(focal_x, focal_y, center_x, center_y), (width, height)
