"""Cameras from the files of COLMAP and nerfstudio."""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from renderer.camera import PinholeCamera
from renderer.errors import InputError, require_file
from renderer.validation import as_path

# Files of a model of COLMAP, as text.
COLMAP_CAMERAS = "cameras.txt"
COLMAP_IMAGES = "images.txt"
# File of nerfstudio.
TRANSFORMS = "transforms.json"
# Number of parameters of the models of COLMAP without distortion.
COLMAP_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
# Distortion in the files of nerfstudio.
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
UNDISTORT = "undistort the images first, such as with colmap image_undistorter"
# What the entries of a damaged file raise.
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
    """Read a model of COLMAP from its text files."""
    cameras_path = folder / COLMAP_CAMERAS
    require_file(cameras_path, "give a folder with cameras.txt and images.txt")
    intrinsics = {}
    cameras = {}
    path = cameras_path
    try:
        for line in _lines(cameras_path):
            name, model, width, height, *parameters = line.split()
            size = (int(width), int(height))
            intrinsics[name] = (_colmap_intrinsics(model, parameters), size)
        path = folder / COLMAP_IMAGES
        for line in _image_lines(path):
            _, qw, qx, qy, qz, tx, ty, tz, camera, image = line.split(maxsplit=9)
            rotation = _rotation(np.array([qw, qx, qy, qz], dtype=float))
            translation = np.array([tx, ty, tz], dtype=float)
            view = np.column_stack([rotation, translation])
            matrix, size = intrinsics[camera]
            cameras[image.strip()] = PinholeCamera.from_matrix(view, matrix, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(
            f"{path} is no text file of COLMAP ({error!r}): export it again"
        ) from error
    return cameras


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file that are neither empty nor comments."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            yield line


def _image_lines(path: Path) -> Iterator[str]:
    """Yield the first line of each image. The next line has its points, and may be empty."""
    lines = iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if line.strip() and not line.startswith("#"):
            yield line
            next(lines, "")


def _colmap_intrinsics(model: str, parameters: list[str]) -> np.ndarray:
    """Return the matrix (3, 3) of a camera of COLMAP."""
    if model not in COLMAP_PARAMETERS:
        known = " and ".join(COLMAP_PARAMETERS)
        raise InputError(
            f"the camera model {model} has distortion, but {known} have none: {UNDISTORT}"
        )
    values = [float(parameter) for parameter in parameters]
    if len(values) != COLMAP_PARAMETERS[model]:
        raise ValueError(f"{model} with {len(values)} parameters")
    # A simple pinhole has one focal length.
    *focal_lengths, x, y = values
    return _matrix(focal_lengths[0], focal_lengths[-1], x, y)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion (w, x, y, z)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _matrix(focal_x: float, focal_y: float, x: float, y: float) -> np.ndarray:
    """Return the matrix (3, 3) of intrinsics."""
    return np.array([[focal_x, 0, x], [0, focal_y, y], [0, 0, 1]])


def _read_transforms(path: Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a transforms.json file."""
    require_file(path, "give transforms.json, or a folder with cameras.txt and images.txt")
    cameras = {}
    try:
        shared = json.loads(path.read_text(encoding="utf-8-sig"))
        for frame in shared["frames"]:
            # A frame may have intrinsics of its own.
            matrix, size = _transforms_intrinsics({**shared, **frame})
            view = np.linalg.inv(np.array(frame["transform_matrix"], dtype=float))
            camera = PinholeCamera.from_matrix(view, matrix, size, "opengl")
            cameras[str(frame["file_path"])] = camera
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(f"{path} is no transforms.json ({error!r}): export it again") from error
    return cameras


def _transforms_intrinsics(entries: Mapping[str, Any]) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the intrinsics (3, 3) and the size (width, height) of a frame."""
    distortion = [name for name in DISTORTION if entries.get(name)]
    if distortion:
        raise InputError(f"the cameras have distortion ({', '.join(distortion)}): {UNDISTORT}")
    # Files with an angle alone may leave out the size of their square images.
    width = int(entries.get("w", 1))
    height = int(entries.get("h", width))
    if "fl_x" in entries:
        focal_x = float(entries["fl_x"])
    else:
        focal_x = width / 2 / math.tan(float(entries["camera_angle_x"]) / 2)
    focal_y = float(entries.get("fl_y", focal_x))
    x = float(entries.get("cx", width / 2))
    y = float(entries.get("cy", height / 2))
    return _matrix(focal_x, focal_y, x, y), (width, height)
