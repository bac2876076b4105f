"""Pinhole cameras with any pose and intrinsics, as view matrices and files of cameras have."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from renderer.camera import MAX_TURN, PerspectiveCamera, in_radians, tensor_like
from renderer.errors import (
    MAX_MAGNITUDE,
    InputError,
    as_array,
    require_choice,
    require_range,
    require_whole,
)

# Conventions for the axes of a camera in its view matrix. OpenCV has y down and z forward. OpenGL
# has y up and z backward.
CONVENTIONS = ("opencv", "opengl")
# Smallest depth that a pinhole camera can show, divided by the depth of the farthest point of the
# mesh. A mesh with a smaller depth raises an error.
MIN_DEPTH_RATIO = 1e-3
# Tolerance for matrices of cameras: largest difference between R Rᵀ and the identity for a rotation
# matrix R, and largest skew of intrinsics as a fraction of the focal length.
MATRIX_TOLERANCE = 1e-4


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
            halves of the image height.
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

    roll: float = field(default=0.0, kw_only=True)
    center_x: float = field(default=0.0, kw_only=True)
    center_y: float = field(default=0.0, kw_only=True)
    center_z: float = field(default=0.0, kw_only=True)
    principal_right: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    principal_up: float = field(default=0.0, kw_only=True)  # type: ignore[misc]
    pixel_aspect: float = field(default=1.0, kw_only=True)  # type: ignore[misc]

    def __post_init__(self) -> None:
        """Convert each field to a number or to a tensor of shape (), and check its range."""
        super().__post_init__()
        require_range("roll", self.roll, -MAX_TURN, MAX_TURN)
        require_range("pixel_aspect", self.pixel_aspect, 1 / MAX_MAGNITUDE, MAX_MAGNITUDE)
        for name in ("center_x", "center_y", "center_z", "principal_right", "principal_up"):
            require_range(name, getattr(self, name), -MAX_MAGNITUDE, MAX_MAGNITUDE)

    @classmethod
    def from_matrix(
        cls,
        view: np.ndarray | Tensor | Sequence[Sequence[float]],
        intrinsics: np.ndarray | Tensor | Sequence[Sequence[float]],
        size: int | tuple[int, int],
        convention: str = "opencv",
    ) -> Self:
        """Create a camera from a view matrix and intrinsics.

        In both conventions, the principal point (cx, cy) is in pixels from the
        upper left corner of the image to the right and down. The center of the
        first pixel is at (0.5, 0.5), as in COLMAP and nerfstudio. In calibrations of
        OpenCV, it is at (0, 0): add 0.5 to their cx and cy.

        Images are square. If the given image size is not square, the camera shows
        the central square of the image, whose side is the shorter side.

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
        require_choice("convention", convention, CONVENTIONS)
        rotation, translation = _split_view(view)
        if convention == "opencv":
            # OpenCV's axes are right, down and forward. Ours are right, up and back.
            rotation = rotation * [[1], [-1], [-1]]
            translation = translation * [1, -1, -1]
        focal_x, focal_y, principal_x, principal_y = _split_intrinsics(intrinsics)
        image_width, image_height = _as_image_size(size)
        side = min(image_width, image_height)
        # The rows of the rotation matrix are the axes of the camera in world axes.
        right, up, back = rotation
        position = -translation @ rotation
        distance = float(np.linalg.norm(position)) or 1.0
        pivot = position - distance * back
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
            center_x=pivot[0],
            center_y=pivot[1],
            center_z=pivot[2],
            principal_right=(2 * principal_x - image_width) / side,
            principal_up=(image_height - 2 * principal_y) / side,
            pixel_aspect=focal_y / focal_x,
        )

    def normalized(self, center: np.ndarray, scale: float) -> Self:
        """Return a camera whose image stays the same, and that attacks turn about the origin."""
        moved = super().normalized(center, scale)
        return replace(moved, center_x=0.0, center_y=0.0, center_z=0.0)

    def axes(self) -> np.ndarray:
        """Return the axes of the camera, which is turned by `roll`, in world coordinates."""
        right, up, back = super().axes()
        cosine = math.cos(math.radians(self.roll))
        sine = math.sin(math.radians(self.roll))
        return np.array([cosine * right + sine * up, cosine * up - sine * right, back])

    def pose(self) -> np.ndarray:
        """Return the matrix that maps camera coordinates to world coordinates, shape (4, 4)."""
        pose = super().pose()
        pose[:3, 3] += [self.center_x, self.center_y, self.center_z]
        return pose

    def _from_pivot(self, points: Float[np.ndarray, "... 3"]) -> np.ndarray:
        """Subtract the point about which attacks turn the camera from other points."""
        return points - np.array([self.center_x, self.center_y, self.center_z])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points with perspective, with depths from about -1 at the nearest to about 1."""
        depths = self.depths(points)
        right, up, _ = self.axes() @ self._from_pivot(points).T
        scale = 2 / self.width * (self.distance / depths)
        x = (right + self.right) * scale + self.principal_right
        y = (up + self.up) * scale * self.pixel_aspect + self.principal_up
        near = depths.min() * (1 - MIN_DEPTH_RATIO)
        far = depths.max() * (1 + MIN_DEPTH_RATIO)
        normalized_depth = 2 * far / (far - near) * (1 - near / depths) - 1
        return np.stack([x, y, normalized_depth]).T

    def homogeneous(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points to homogeneous image coordinates, with the principal point."""
        positions, nearness = super().homogeneous(points)
        x, y, w = positions.T
        x = x + self.principal_right * w
        y = y * self.pixel_aspect + self.principal_up * w
        return torch.stack([x, y, w]).T, nearness

    def _camera_coordinates(self, points: Float[Tensor, "V 3"]) -> Float[Tensor, "3 V"]:
        """Convert points to the axes right, up and back, starting at the pivot (`_from_pivot`)."""
        center = [self.center_x, self.center_y, self.center_z]
        pivot = torch.stack([tensor_like(coordinate, points) for coordinate in center])
        right, up, back = super()._camera_coordinates(points - pivot)
        roll = tensor_like(in_radians(self.roll), points)
        cosine = roll.cos()
        sine = roll.sin()
        return torch.stack([cosine * right + sine * up, cosine * up - sine * right, back])

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Compute the depths of points, which must lie in front of the camera."""
        depths = self.distance - self._from_pivot(points) @ self.axes()[2]
        if not (depths >= MIN_DEPTH_RATIO * np.abs(depths).max()).all():
            position = self.pose()[:3, 3].round(3).tolist()
            raise InputError(
                f"the mesh reaches the camera at {position} or lies behind it: "
                "give cameras that have the whole mesh in front of them"
            )
        return depths


def _split_view(view: Any) -> tuple[np.ndarray, np.ndarray]:
    """Check and split a view matrix, (4, 4) or (3, 4): rotation (3, 3) and translation (3,)."""
    matrix = as_array("view", view).astype(np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"view has shape {matrix.shape}: give a matrix (4, 4) or (3, 4)")
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    is_right_handed = np.linalg.det(rotation) > 0
    is_affine = np.array_equal(matrix[3:], np.eye(4)[3 : len(matrix)])
    if not (error <= MATRIX_TOLERANCE and is_right_handed and is_affine):
        raise InputError(
            f"view={matrix.tolist()} is not a rotation with a translation: give the matrix from "
            "world to camera coordinates"
        )
    return rotation, matrix[:3, 3]


def _split_intrinsics(intrinsics: Any) -> tuple[float, float, float, float]:
    """Check an intrinsic matrix in pixels, and return fx, fy, cx and cy."""
    matrix = as_array("intrinsics", intrinsics).astype(np.float64)
    if matrix.shape != (3, 3):
        raise InputError(f"intrinsics has shape {matrix.shape}: give a matrix (3, 3)")
    (focal_x, skew, center_x), (below_diagonal, focal_y, center_y), last_row = matrix.tolist()
    has_focal_lengths = focal_x > 0 and focal_y > 0
    has_zeros = below_diagonal == 0 and abs(skew) <= MATRIX_TOLERANCE * focal_x
    if not (has_focal_lengths and has_zeros and last_row == [0, 0, 1]):
        raise InputError(
            f"intrinsics is {matrix.tolist()}: give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        )
    return focal_x, focal_y, center_x, center_y


def _as_image_size(size: int | tuple[int, int]) -> tuple[int, int]:
    """Convert the size of an image to its width and its height, and check them."""
    width, height = size if isinstance(size, tuple | list) and len(size) == 2 else (size, size)
    for side in (width, height):
        require_whole("size", side, 1, MAX_MAGNITUDE)
    return width, height
