"""Pinhole cameras with any pose and intrinsics, from matrices and files of cameras.

The intrinsics of a camera are the matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
The focal lengths fx and fy are in pixels. The principal point (cx, cy) is in
pixels from the top left corner of the image.
"""

import json
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from renderer import errors
from renderer.camera import PerspectiveCamera, Points
from renderer.errors import InputError
from renderer.io.images import SUFFIXES, open_image

# Smallest depth that a pinhole camera can show, divided by the depth of the farthest point of the
# mesh. A mesh with a smaller depth raises an error.
MIN_DEPTH_RATIO = 1e-3
# Tolerance for matrices of cameras: largest difference between R Rᵀ and the identity for a rotation
# matrix R, and largest skew of intrinsics as a fraction of the focal length.
MATRIX_TOLERANCE = 1e-4
# Text file in which COLMAP stores the poses of images.
COLMAP_IMAGES = "images.txt"
# COLMAP's camera models without lens distortion, with their numbers of parameters.
COLMAP_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
# Points of an image in COLMAP's file: x, y and the number of a point in space for each, which is
# -1 or 2^64 - 1 for no point.
COLMAP_POINTS = re.compile(r"([-+.\de]+ [-+.\de]+ -?\d+ )*", re.IGNORECASE)
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


@dataclass(frozen=True)
class PinholeCamera(PerspectiveCamera):
    """Pinhole camera with any position, direction, roll and principal point.

    `from_matrix` creates it from a view matrix and intrinsics, and
    `nb.load_cameras` from the files of COLMAP and nerfstudio. It shows
    everything in front of it. The fields polar, azimuth, distance, right, up and
    width are relative to the point (center_x, center_y, center_z) instead of the
    origin. Attacks on the pose turn the camera about this point.

    Attributes:
        clip_range: Depth that files of cameras store. Images do not depend on
            it.
        roll: Turn about the viewing direction from the right to the top of the
            image, in degrees.
        center_x: x of the point about which attacks turn the camera, in world
            units.
        center_y: y of this point.
        center_z: z of this point.
        principal_right: Distance of the principal point to the right of the image
            center, in halves of the image width.
        principal_up: Distance of the principal point above the image center, in
            halves of the image width.
        pixel_aspect: Vertical focal length divided by the horizontal one, both in
            pixels.

    >>> import numpy as np
    >>> import norm_balls as nb
    >>> view = np.eye(4)
    >>> view[2, 3] = 5.0  # The origin lies 5 units in front of the camera.
    >>> camera = nb.PinholeCamera.from_matrix(view, [[50, 0, 16], [0, 50, 20], [0, 0, 1]], size=32)
    >>> image_position = camera.project(np.array([[0.0, 0.0, 0.0]]))[0, :2]
    >>> (16 + 16 * image_position * [1, -1]).round(6).tolist()  # in pixels, y down
    [16.0, 20.0]
    """

    roll: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    center_x: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    center_y: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    center_z: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    principal_right: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    principal_up: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    pixel_aspect: float = field(default=1.0, kw_only=True)  # type: ignore[misc]

    @classmethod
    def from_matrix(
        cls,
        view: np.ndarray | Tensor | Sequence[Sequence[float]],
        intrinsics: np.ndarray | Tensor | Sequence[Sequence[float]],
        size: int | tuple[int, int],
        convention: str = "opencv",
        whole: bool = False,
    ) -> Self:
        """Create a camera from a view matrix and intrinsics.

        In both conventions, the principal point (cx, cy) is in pixels from the
        upper left corner of the image to the right and down. The center of the
        first pixel is at (0.5, 0.5), as in COLMAP and nerfstudio. In calibrations of
        OpenCV, it is at (0, 0): add 0.5 to their cx and cy.

        If the given image size is not square, square renders show the central square
        of the image, whose side is the shorter side. With `whole`, renders of the
        size (height, width) show the whole image.

        Args:
            view: Matrix from world to camera coordinates, shape (4, 4) or
                (3, 4).
            intrinsics: Matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels,
                shape (3, 3).
            size: Size of the image for which the intrinsics are valid: pixels per
                side, or width and height. Renders may have another size.
            convention: Axes of the camera. "opencv" (also COLMAP) has x to the
                right, y down and z forward. "opengl" (also nerfstudio and Blender)
                has x to the right, y up and z backward.
            whole: Whether the camera is as wide as the image, also if the image is
                wider than high.

        Returns:
            Camera. Attacks on the pose turn it about the point on its optical axis
            that is as far from it as the world's origin.

        Raises:
            InputError: If a matrix has another shape, is no rotation and
                translation, has skew, or if the convention is unknown.

        Example:
            >>> import norm_balls as nb
            >>> view = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]]
            >>> intrinsics = [[80, 0, 30], [0, 80, 32], [0, 0, 1]]
            >>> camera = nb.PinholeCamera.from_matrix(view, intrinsics, size=64)
            >>> nb.render(nb.solid("orange"), camera, nb.load_light("grace"), size=64).shape[-1]
            64
        """
        errors.require_choice("convention", convention, ("opencv", "opengl"))
        # The rows of the rotation matrix are the axes of the camera in world axes.
        rotation, translation = _split_view(view)
        if convention == "opencv":
            # OpenCV's axes are right, down and forward. Ours are right, up and back.
            rotation = rotation * [[1], [-1], [-1]]
            translation = translation * [1, -1, -1]
        focal_x, focal_y, principal_x, principal_y = _split_intrinsics(intrinsics)
        image_width, image_height = size if isinstance(size, tuple | list) else (size, size)
        for side in (image_width, image_height):
            errors.require_whole("size", side, 1, errors.MAX_MAGNITUDE)
        errors.require_flag("whole", whole)
        side = image_width if whole else min(image_width, image_height)
        right, up, back = rotation
        position = -translation @ rotation
        distance = float(np.linalg.norm(position)) or 1.0
        center_x, center_y, center_z = position - distance * back
        azimuth = math.atan2(back[1], back[0])
        # This horizontal vector would be the camera's axis to the right if there were no roll.
        right_without_roll = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        roll = math.atan2(-up @ right_without_roll, right @ right_without_roll)
        return cls(
            polar=math.degrees(math.atan2(math.hypot(back[0], back[1]), back[2])),
            azimuth=math.degrees(azimuth),
            width=distance * side / focal_x,
            distance=distance,
            roll=math.degrees(roll),
            center_x=center_x,
            center_y=center_y,
            center_z=center_z,
            principal_right=(2 * principal_x - image_width) / side,
            principal_up=(image_height - 2 * principal_y) / side,
            pixel_aspect=focal_y / focal_x,
        )

    def translated(self, offset: np.ndarray) -> Self:
        """Return a camera whose image stays the same if the mesh is moved by an offset (3,)."""
        centers = zip(("center_x", "center_y", "center_z"), offset.tolist(), strict=True)
        return replace(self, **{name: getattr(self, name) + by for name, by in centers})

    def normalized(self, center: np.ndarray, scale: float) -> Self:
        """Return a camera whose image stays the same, and that attacks turn about the origin."""
        return replace(super().normalized(center, scale), center_x=0.0, center_y=0.0, center_z=0.0)

    def _limits(self, cameras: Sequence[Any], depths: Points) -> tuple[Any, Any, Any]:
        """Return the smallest allowed depth, and depths just around those of the points."""
        library: Any = torch if isinstance(depths, Tensor) else np
        near, far = library.amin(depths, 1)[:, None], library.amax(depths, 1)[:, None]
        smallest = MIN_DEPTH_RATIO * library.maximum(-near, far)
        return smallest, near * (1 - MIN_DEPTH_RATIO), far * (1 + MIN_DEPTH_RATIO)


def load_cameras(path: str | Path, whole: bool = False) -> dict[str, PinholeCamera]:
    """Read the cameras of a scene from files of COLMAP or nerfstudio.

    COLMAP's models SIMPLE_PINHOLE and PINHOLE are read. Images with lens
    distortion must be undistorted first, for example by COLMAP's
    image_undistorter. Binary models are written as text by `colmap
    model_converter --output_type TXT`.

    The cameras have the world coordinates of the file, so load the mesh with
    `nb.load_mesh(path, up="z")`, which leaves its axes as they are. The camera of
    an image that is not square shows the square in its center. With `whole`, renders
    of the size (height, width) show the whole image.

    Args:
        path: A transforms.json file of nerfstudio, or a folder with this file or
            with the files cameras.txt and images.txt of COLMAP.
        whole: Whether a camera is as wide as its image, also if the image is wider
            than high.

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
        >>> scene = {"camera_angle_x": 0.6, "w": 640, "h": 480, "frames": frames}
        >>> _ = Path("transforms.json").write_text(json.dumps(scene))
        >>> cameras = nb.load_cameras("transforms.json")
        >>> [*cameras], round(cameras["front.png"].distance, 3)
        (['front.png'], 4.0)
    """
    path = errors.as_path("path", path)
    if path.is_dir() and (path / COLMAP_IMAGES).exists():
        cameras = _read_colmap(path, whole)
    else:
        cameras = _read_transforms(path / "transforms.json" if path.is_dir() else path, whole)
    if not cameras:
        raise InputError(f"{path} has no cameras: give files with at least one image")
    return cameras


@contextmanager
def _reading(path: Path) -> Iterator[str]:
    """Read the text of a file for a `with` block, and name the file in errors of the block."""
    errors.require_file(path, "give transforms.json, or a folder with cameras.txt and images.txt")
    with errors.reading(path, "is no file of cameras", "export it again"):
        yield path.read_text(encoding="utf-8-sig")


def _add(values: dict[str, Any], name: str, value: object) -> None:
    """Add a value to a dictionary, and raise InputError if it has the name already."""
    if name in values:
        raise InputError(f"{name} occurs twice: give each image and camera a name of its own")
    values[name] = value


def _read_colmap(folder: Path, whole: bool) -> dict[str, PinholeCamera]:
    """Read the cameras of a COLMAP model from its text files, by the names of their images."""
    from scipy.spatial.transform import Rotation

    # Intrinsic matrix and image size (width, height) of each camera by its id in the file.
    lenses: dict[str, tuple[np.ndarray, tuple[int, int]]] = {}
    cameras: dict[str, PinholeCamera] = {}
    with _reading(folder / "cameras.txt") as text:
        for line in _lines(text):
            camera_id, model, width, height, *parameters = line.split()
            lens = _colmap_intrinsics(model, parameters), (int(width), int(height))
            _add(lenses, camera_id, lens)
    with _reading(folder / COLMAP_IMAGES) as text:
        may_be_points = False
        for line in _lines(text):
            # A second line of an image lists its points. It may be empty or missing.
            if may_be_points and COLMAP_POINTS.fullmatch(" ".join(line.split()) + " "):
                may_be_points = False
                continue
            may_be_points = True
            # A line has the number of the image, a quaternion, a translation, a camera and a name.
            _, *numbers, camera_id, image_name = line.split(maxsplit=9)
            pose = np.array(numbers, dtype=float)
            rotation = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
            view = np.column_stack([rotation, pose[4:]])
            camera = PinholeCamera.from_matrix(view, *lenses[camera_id], whole=whole)
            _add(cameras, image_name.strip(), camera)
    return cameras


def _lines(text: str) -> list[str]:
    """List the lines of a text that are neither empty nor comments."""
    # `splitlines` would also split at other characters, which may be in names.
    return [line for line in text.split("\n") if not re.match(r"\s*(#|$)", line)]


def _colmap_intrinsics(model: str, parameters: list[str]) -> np.ndarray:
    """Convert one or two focal lengths and a principal point to an intrinsic matrix."""
    if model not in COLMAP_PARAMETERS:
        fault = f"the camera model {model} is not supported, because it has lens distortion"
        supported = " and ".join(COLMAP_PARAMETERS)
        raise InputError(f"{fault} (supported are {supported}): {UNDISTORT}")
    if len(parameters) != COLMAP_PARAMETERS[model]:
        raise ValueError(f"{model} with {len(parameters)} parameters")
    *focal_lengths, center_x, center_y = map(float, parameters)
    return np.array([[focal_lengths[0], 0, center_x], [0, focal_lengths[-1], center_y], [0, 0, 1]])


def _read_transforms(path: Path, whole: bool) -> dict[str, PinholeCamera]:
    """Read the cameras of a transforms.json file of nerfstudio, by the paths of their images."""
    cameras: dict[str, PinholeCamera] = {}
    with _reading(path) as text:
        scene = json.loads(text)
        for frame in scene["frames"]:
            # A frame is an image of the scene. Its entries override those of the scene.
            if not isinstance(frame["file_path"], str):
                raise TypeError(f"file_path is {frame['file_path']}")
            # An angle of a frame also overrides the focal lengths and the other angle of the scene.
            angles = {"camera_angle_x", "camera_angle_y"}
            hidden = {"fl_x", "fl_y", *angles} if angles & frame.keys() else {*frame}
            entries = {key: value for key, value in scene.items() if key not in hidden} | frame
            if not {"w", "h", "fl_x", "fl_y", "cx", "cy"} & entries.keys():
                entries |= _size_of_image(path.parent / frame["file_path"])
            intrinsics, size = _transforms_intrinsics(entries)
            pose = np.array(frame["transform_matrix"], dtype=float)
            # Some programs leave out the last row, which is always the same.
            if pose.shape == (3, 4):
                pose = np.vstack([pose, [0, 0, 0, 1]])
            view = np.linalg.inv(pose)
            camera = PinholeCamera.from_matrix(view, intrinsics, size, "opengl", whole)
            _add(cameras, frame["file_path"], camera)
    return cameras


def _size_of_image(path: Path) -> dict[str, int]:
    """Read the entries w and h from an image, whose name may lack its suffix. Empty without one."""
    for file in (path, *(path.parent / f"{path.name}{suffix}" for suffix in SUFFIXES)):
        if file.is_file():
            with open_image(file) as image:
                return {"w": image.width, "h": image.height}
    return {}


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
        fault = f"the cameras have lens distortion ({', '.join(distortion_keys)})"
        raise InputError(f"{fault}, which is not supported: {UNDISTORT}")
    has_size = {"w", "h"} <= entries.keys()
    if not has_size and {"fl_x", "fl_y", "cx", "cy"} & entries.keys():
        raise InputError("the focal length is in pixels, but the image size w and h is missing")
    # Files with fields of view need no image size. One field of view is that of square images.
    tangents = [math.tan(float(entries.get(f"camera_angle_{axis}", 0)) / 2) for axis in "xy"]
    ratio = tangents[1] / tangents[0] if all(tangents) else 1
    width = int(entries["w"] if has_size else errors.MAX_SCALE)
    height = int(entries["h"] if has_size else round(width * ratio))
    sides = zip("xy", (width, height), tangents, strict=True)
    given = [entries.get(f"fl_{axis}", side / 2 / t if t else None) for axis, side, t in sides]
    focal_lengths = [float(length) for length in given if length is not None]
    if not focal_lengths:
        keys = "fl_x, fl_y, camera_angle_x or camera_angle_y"
        raise InputError(f"the cameras have no focal length: give {keys}")
    if not has_size and not all(tangents):
        warnings.warn("the cameras have no image size w and h: images are square", stacklevel=4)
    center_x = float(entries.get("cx", width / 2))
    center_y = float(entries.get("cy", height / 2))
    # Pixels are square if only one focal length is given.
    rows = [[focal_lengths[0], 0, center_x], [0, focal_lengths[-1], center_y], [0, 0, 1]]
    return np.array(rows), (width, height)


def _split_view(view: Any) -> tuple[np.ndarray, np.ndarray]:
    """Check and split a view matrix, (4, 4) or (3, 4): rotation (3, 3) and translation (3,)."""
    matrix = errors.as_array("view", view).astype(np.float64)
    if matrix.shape in ((4, 4), (3, 4)):
        rotation = matrix[:3, :3]
        # A rotation times its transpose is the identity. A mirror has the determinant -1.
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        # The last row must be (0, 0, 0, 1). A matrix (3, 4) has none.
        is_affine = np.array_equal(matrix[3:], np.eye(4)[3 : len(matrix)])
        if error <= MATRIX_TOLERANCE and np.linalg.det(rotation) > 0 and is_affine:
            return rotation, matrix[:3, 3]
    advice = "give the matrix (4, 4) or (3, 4) from world to camera coordinates"
    raise InputError(f"view={matrix.tolist()} is not a rotation with a translation: {advice}")


def _split_intrinsics(intrinsics: Any) -> tuple[float, float, float, float]:
    """Check an intrinsic matrix in pixels, and return fx, fy, cx and cy."""
    matrix = errors.as_array("intrinsics", intrinsics).astype(np.float64)
    if matrix.shape == (3, 3):
        focal_x, focal_y, center_x, center_y = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        expected = [[focal_x, 0, center_x], [0, focal_y, center_y], [0, 0, 1]]
        error = np.abs(matrix - expected).max()
        if focal_x > 0 and focal_y > 0 and error <= MATRIX_TOLERANCE * focal_x:
            return focal_x, focal_y, center_x, center_y
    advice = "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
    raise InputError(f"intrinsics is {matrix.tolist()}: {advice}")
