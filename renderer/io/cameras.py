"""Read cameras from the files of COLMAP and nerfstudio.

The intrinsics of a camera are the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
The focal lengths fx and fy are in pixels. The principal point (cx, cy) is in
pixels from the top left corner of the image.
"""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from renderer.errors import InputError, as_path, require_file
from renderer.pinhole import PinholeCamera

# Names of the text files in which COLMAP
# stores cameras and the poses of images.
COLMAP_CAMERAS = "cameras.txt"
COLMAP_IMAGES = "images.txt"
# Name of the file in which nerfstudio stores cameras.
TRANSFORMS = "transforms.json"
# COLMAP's camera models without lens
# distortion, with their numbers of parameters.
COLMAP_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
# Camera models of nerfstudio that are perspective. Parameters of lens distortion, which
# they also have, are checked separately.
PERSPECTIVE = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL")
# Names of the parameters of lens distortion in transforms.json.
DISTORTION = (
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"),
    *("ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"),
)
# Entries of transforms.json that name another kind of camera, as instant-ngp, Blender and
# others write them.
OTHER_CAMERAS = (
    *("is_fisheye", "fisheye", "ortho_scale", "orthographic", "is_orthographic"),
    *("equirectangular", "latlong", "rolling_shutter", "distortion_params"),
)
# Advice at the end of errors about lens distortion.
UNDISTORT = "undistort the images first, for example with colmap image_undistorter"
# Exceptions that Python raises if a file lacks an entry or has a wrong one.
_DAMAGED_FILE_ERRORS = (
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError),
)


def load_cameras(path: str | Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a scene from files of COLMAP or nerfstudio.

    COLMAP's models SIMPLE_PINHOLE and PINHOLE are read. Images with lens
    distortion must be undistorted first, for example by COLMAP's
    image_undistorter. Binary models are written as text by `colmap
    model_converter --output_type TXT`.

    The cameras have the world coordinates of the file, so load the mesh with
    `nb.load_mesh(path, up="z")`, which leaves its axes as they are. The camera of
    an image that is not square shows the square in its center.

    Args:
        path: A transforms.json file of nerfstudio, or a folder with this file or
            with the files cameras.txt and images.txt of COLMAP.

    Returns:
        Cameras by the names of their images, in the order of the file.

    Raises:
        InputError: If a file is missing or damaged, has no cameras, or has two
            images of one name, or if a camera is not perspective or has
            distortion.

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
        raise InputError(f"{path} has no cameras: give files with at least one image")
    return cameras


def _read_colmap(folder: Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a COLMAP model from its text files, by the names of their images."""
    cameras_path = folder / COLMAP_CAMERAS
    require_file(cameras_path, "give a folder with cameras.txt and images.txt")
    # Intrinsic matrix and image size (width, height)
    # of each camera by its id in the file.
    intrinsics_and_size: dict[str, tuple[np.ndarray, tuple[int, int]]] = {}
    cameras: dict[str, PinholeCamera] = {}
    # The error below names the file that is being read.
    path = cameras_path
    try:
        for line in _lines(cameras_path):
            camera_id, model, width, height, *parameters = line.split()
            size = (int(width), int(height))
            _add(intrinsics_and_size, camera_id, (_colmap_intrinsics(model, parameters), size))
        path = folder / COLMAP_IMAGES
        for line in _image_lines(path):
            _, qw, qx, qy, qz, tx, ty, tz, camera_id, image_name = line.split(maxsplit=9)
            rotation = _rotation(np.array([qw, qx, qy, qz], dtype=float))
            translation = np.array([tx, ty, tz], dtype=float)
            # Matrix from world coordinates to camera coordinates, shape (3, 4).
            view_matrix = np.column_stack([rotation, translation])
            intrinsics, size = intrinsics_and_size[camera_id]
            camera = PinholeCamera.from_matrix(view_matrix, intrinsics, size)
            _add(cameras, image_name.strip(), camera)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(
            f"{path} is no text file of COLMAP ({error!r}): export the model again"
        ) from error
    return cameras


def _add(values: dict[str, Any], name: str, value: object) -> None:
    """Add a value to a dictionary, and raise InputError if it has the name already."""
    if name in values:
        raise InputError(f"{name} occurs twice: give each image and camera a name of its own")
    values[name] = value


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file that are neither empty nor comments."""
    # `splitlines` would also split at other characters, which may be in names.
    for line in path.read_text(encoding="utf-8-sig").split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            yield line


def _image_lines(path: Path) -> Iterator[str]:
    """Yield the line with the pose of each image from the file images.txt of COLMAP.

    A second line of an image lists points in the image: x, y and the number of a
    point in space for each. It may be empty or missing.
    """
    require_file(path, "give a folder with cameras.txt and images.txt")
    may_be_points = False
    for line in _lines(path):
        if may_be_points and _is_points(line):
            may_be_points = False
        else:
            yield line
            may_be_points = True


def _is_points(line: str) -> bool:
    """Return whether a line consists of triples of two numbers and a whole number."""
    words = line.split()
    try:
        np.array(words, dtype=float)
        # The number of no point is -1, or 2^64 - 1.
        [int(word) for word in words[2::3]]
    except ValueError:
        return False
    return len(words) % 3 == 0


def _colmap_intrinsics(model: str, parameters: list[str]) -> Float[np.ndarray, "3 3"]:
    """Convert one or two focal lengths and a principal point to an intrinsic matrix."""
    if model not in COLMAP_PARAMETERS:
        known = " and ".join(COLMAP_PARAMETERS)
        raise InputError(
            f"the camera model {model} is not supported, because it has lens distortion (supported "
            f"are {known}): {UNDISTORT}"
        )
    values = [float(parameter) for parameter in parameters]
    if len(values) != COLMAP_PARAMETERS[model]:
        raise ValueError(f"{model} with {len(values)} parameters")
    # PINHOLE has the focal lengths (fx, fy),
    # and SIMPLE_PINHOLE has one for both axes.
    *focal_lengths, center_x, center_y = values
    return _intrinsic_matrix(focal_lengths[0], focal_lengths[-1], center_x, center_y)


def _rotation(quaternion: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    """Convert a quaternion (w, x, y, z) of any length to a rotation matrix."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    # The product of this matrix and a vector is the
    # cross product of (x, y, z) and the vector.
    cross_matrix = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross_matrix + 2 * cross_matrix @ cross_matrix


def _intrinsic_matrix(
    focal_x: float, focal_y: float, center_x: float, center_y: float
) -> Float[np.ndarray, "3 3"]:
    """Create the intrinsic matrix of a pinhole camera from lengths in pixels."""
    return np.array([[focal_x, 0, center_x], [0, focal_y, center_y], [0, 0, 1]])


def _read_transforms(path: Path) -> dict[str, PinholeCamera]:
    """Read the cameras of a transforms.json file of nerfstudio, by the paths of their images."""
    require_file(path, "give transforms.json, or a folder with cameras.txt and images.txt")
    cameras: dict[str, PinholeCamera] = {}
    try:
        scene = json.loads(path.read_text(encoding="utf-8-sig"))
        for frame in scene["frames"]:
            # A frame is an image of the scene. Its
            # entries override those of the scene.
            intrinsics, size = _transforms_intrinsics({**scene, **frame})
            # Matrix from camera coordinates to world coordinates, shape (4, 4).
            camera_to_world = np.array(frame["transform_matrix"], dtype=float)
            view_matrix = np.linalg.inv(camera_to_world)
            camera = PinholeCamera.from_matrix(view_matrix, intrinsics, size, "opengl")
            if not isinstance(frame["file_path"], str):
                raise TypeError(f"file_path is {frame['file_path']}")
            _add(cameras, frame["file_path"], camera)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGED_FILE_ERRORS as error:
        raise InputError(
            f"{path} is no transforms.json of nerfstudio ({error!r}): export the file again"
        ) from error
    return cameras


def _transforms_intrinsics(entries: Mapping[str, Any]) -> tuple[np.ndarray, tuple[int, int]]:
    """Read the intrinsic matrix and the size (width, height) of an image of transforms.json."""
    for name in ("camera_model", "camera_type"):
        model = entries.get(name, "PINHOLE")
        if str(model).upper() not in PERSPECTIVE:
            raise InputError(f"{name}={model} is not supported: {UNDISTORT}")
    for name in OTHER_CAMERAS:
        value = entries.get(name)
        # The motion of a rolling shutter is a list of numbers.
        if any(value) if isinstance(value, list) else value:
            raise InputError(f"{name}={value} is not supported: give perspective cameras")
    distortion_keys = [name for name in DISTORTION if entries.get(name)]
    if distortion_keys:
        raise InputError(
            f"the cameras have lens distortion ({', '.join(distortion_keys)}), which is not "
            f"supported: {UNDISTORT}"
        )
    if not {"w", "h"} <= entries.keys() and {"fl_x", "fl_y", "cx", "cy"} & entries.keys():
        raise InputError("the focal length is in pixels, but the image size w and h is missing")
    # A file with square images may have a field of view,
    # but no image size. The focal length and the principal
    # point are then computed for an image of one pixel.
    width = int(entries.get("w", 1))
    height = int(entries.get("h", width))
    # Pixels are square if only one of the two is given.
    given = [_focal_length(entries, "x", width), _focal_length(entries, "y", height)]
    known = [length for length in given if length is not None]
    if not known:
        raise KeyError("fl_x")
    focal_x, focal_y = known[0], known[-1]
    center_x = float(entries.get("cx", width / 2))
    center_y = float(entries.get("cy", height / 2))
    return _intrinsic_matrix(focal_x, focal_y, center_x, center_y), (width, height)


def _focal_length(entries: Mapping[str, Any], axis: str, side: int) -> float | None:
    """Read the focal length in pixels along an axis, "x" or "y". None if the file has none."""
    if f"fl_{axis}" in entries:
        return float(entries[f"fl_{axis}"])
    if f"camera_angle_{axis}" in entries:
        return side / 2 / math.tan(float(entries[f"camera_angle_{axis}"]) / 2)
    return None
