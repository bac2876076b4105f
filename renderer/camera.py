"""Orthographic and perspective cameras that look at the origin, and orbits of them.

World axes are right-handed, and z points up.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from renderer.errors import MAX_MAGNITUDE, InputError, describe, is_number, require_range
from renderer.settings import MAX_VIEWS
from renderer.validation import require_whole

# Default of `Camera.reach`. A normalized mesh has a radius of at most √3.
REACH = 2.0
# Largest polar angle and largest first azimuth of an orbit in degrees: two turns.
MAX_TURN = 720.0
# Limits of the field of view in degrees.
MIN_FOV = 0.05
MAX_FOV = 172.0
# Distance of the near plane from a perspective camera is at least this fraction
# of the distance of the camera. A mesh that comes nearer raises an error.
NEAREST = 0.01


@dataclass(frozen=True)
class Camera(ABC):
    """Camera that looks at the origin and takes square images.

    The camera lies at a polar angle from +z and at an azimuth from +x toward
    +y. Fields can be numbers, or tensors, arrays and lists of one number. Images
    are differentiable with respect to fields that are tensors. Derivatives with
    respect to an angle are per degree.

    Attributes:
        polar: Polar angle in degrees, within two turns.
        azimuth: Azimuth in degrees.
        width: Width of the image at the origin in world units. A normalized
            mesh spans at most [-1, 1] along each axis.
        right: Position of the origin in the image, to the right of the center
            in world units.
        up: Position of the origin in the image, above the center in world
            units.
        reach: Surfaces are visible if their depth differs from the depth of the
            origin by at most this, in world units.
        distance: Distance of the camera from the origin in world units.

    Raises:
        InputError: If `width`, `reach` or `distance` is not positive, if
            `polar` is beyond two turns, or if a value is not one number, not
            finite or too large.
    """

    polar: float
    azimuth: float
    width: float
    right: float = 0.0
    up: float = 0.0
    reach: float = field(default=REACH, kw_only=True)

    distance: ClassVar[float]

    def __post_init__(self) -> None:
        """Convert and check the fields."""
        for name, value in vars(self).items():
            if type(value) is not float:
                object.__setattr__(self, name, _as_scalar(name, value))
        require_range("width", self.width, 1 / MAX_MAGNITUDE, MAX_MAGNITUDE)
        require_range("reach", self.reach, 1 / MAX_MAGNITUDE, MAX_MAGNITUDE)
        require_range("polar", self.polar, -MAX_TURN, MAX_TURN)
        for name in ("azimuth", "right", "up"):
            require_range(name, getattr(self, name), -MAX_MAGNITUDE, MAX_MAGNITUDE)

    @property
    def near(self) -> float:
        """Depth of the near plane: the smallest visible depth in world units."""
        return max(self.distance - self.reach, NEAREST * self.distance)

    @property
    def far(self) -> float:
        """Depth of the far plane: the largest visible depth in world units."""
        return self.distance + self.reach

    def seeing(self, radius: float) -> Self:
        """Return a camera that shows a ball around the origin in its full depth.

        Args:
            radius: Radius of the ball in world units.

        Returns:
            This camera if its reach suffices, and otherwise a copy with a
            larger reach.
        """
        if radius <= self.reach:
            return self
        return replace(self, reach=math.floor(radius) + 1.0)

    def fixed(self) -> Self:
        """Return a camera with numbers instead of tensors.

        Returns:
            This camera if it has no tensors, and otherwise a copy.
        """
        numbers: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                numbers[name] = value.item()
        return replace(self, **numbers) if numbers else self

    def moved(self, polar: Tensor, azimuth: Tensor, log_distance: Tensor) -> Self:
        """Return a camera that is turned about the origin and moved away from it.

        The field of view stays the same, so the width of the image at the
        origin grows with the distance. An orthographic camera only changes its
        width.

        Args:
            polar: Angle to add to the polar angle in degrees, shape ().
            azimuth: Angle to add to the azimuth in degrees, shape ().
            log_distance: Natural logarithm of the factor for the distance,
                shape ().

        Returns:
            Camera whose changed fields are tensors.
        """
        factor = log_distance.exp()
        moved: dict[str, Any] = {"polar": self.polar + polar, "azimuth": self.azimuth + azimuth}
        # The distance of an orthographic camera is no field.
        for name in ("width", "distance"):
            if name in vars(self):
                moved[name] = getattr(self, name) * factor
        return replace(self, **moved)

    def axes(self) -> np.ndarray:
        """Return the axes of the camera in world coordinates.

        Returns:
            Unit vectors to the right, up and back (from the origin to the
            camera) as rows, float64, shape (3, 3).
        """
        polar = math.radians(self.polar)
        azimuth = math.radians(self.azimuth)
        sin_polar = math.sin(polar)
        cos_polar = math.cos(polar)
        sin_azimuth = math.sin(azimuth)
        cos_azimuth = math.cos(azimuth)
        back_x = sin_polar * cos_azimuth
        back_y = sin_polar * sin_azimuth
        # This is the sine of the polar angle.
        up_z = back_x * cos_azimuth + back_y * sin_azimuth
        right = [-sin_azimuth, cos_azimuth, 0.0]
        up = [-cos_polar * cos_azimuth, -cos_polar * sin_azimuth, up_z]
        back = [back_x, back_y, cos_polar]
        return np.array([right, up, back])

    def pose(self) -> np.ndarray:
        """Return the matrix that maps camera coordinates to world coordinates.

        Returns:
            The axes right, up and back and the position of the camera as
            columns, float64, shape (4, 4). The last row is (0, 0, 0, 1).
        """
        axes = self.axes()
        position = np.array([-self.right, -self.up, self.distance])
        columns = np.column_stack([axes.T, position @ axes])
        return np.vstack([columns, [0, 0, 0, 1]])

    def eye(self) -> np.ndarray:
        """Return where the camera is, in homogeneous world coordinates.

        Returns:
            For an orthographic camera, the unit vector to the camera and 0. For
            a perspective camera, its position and 1. Float64, shape (4,).
        """
        return np.append(self.axes()[2], 0.0)

    @abstractmethod
    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points to normalized device coordinates.

        Depth is -1 at the near plane and 1 at the far plane. A plane in world
        coordinates is a plane in normalized device coordinates, too.

        Args:
            points: Points in world coordinates, shape (V, 3).

        Returns:
            x to the right, y up and depth, shape (V, 3). The image is [-1, 1]
            in x and y.

        Raises:
            InputError: If a perspective camera lies in or behind the points.
        """

    def homogeneous(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points to homogeneous image coordinates.

        The result is differentiable with respect to the points, and with
        respect to fields of the camera that are tensors.

        Args:
            points: Points in world coordinates, shape (V, 3).

        Returns:
            A tuple of
            - (x w, y w, w) for the image position (x, y), shape (V, 3). The
              number w is 1 for an orthographic camera, and the depth over
              `distance` for a perspective camera;
            - the nearness of each point, shape (V,). It is larger for nearer
              points, and linear in the image on a plane.
        """
        polar = torch.as_tensor(_in_radians(self.polar)).to(points)
        azimuth = torch.as_tensor(_in_radians(self.azimuth)).to(points)
        sin_polar = polar.sin()
        cos_polar = polar.cos()
        sin_azimuth = azimuth.sin()
        cos_azimuth = azimuth.cos()
        axes = (
            [-sin_azimuth, cos_azimuth, 0 * sin_azimuth],
            [-cos_polar * cos_azimuth, -cos_polar * sin_azimuth, sin_polar],
            [sin_polar * cos_azimuth, sin_polar * sin_azimuth, cos_polar],
        )
        right, up, back = torch.stack([torch.stack(axis) for axis in axes]) @ points.T
        w, nearness = self._w_and_nearness(back)
        scale = 2 / self.width
        x = (right + self.right) * scale
        y = (up + self.up) * scale
        return torch.stack([x, y, w]).T, nearness

    @abstractmethod
    def _w_and_nearness(self, back: Tensor) -> tuple[Tensor, Tensor]:
        """Compute w and the nearness of points, see `homogeneous`.

        Args:
            back: Coordinate of the points along the axis from the origin to the
                camera, in world units, shape (V,).

        Returns:
            A tuple of w and the nearness, shape (V,) each.
        """

    def depths(self, points: np.ndarray) -> np.ndarray | None:
        """Compute the depths of points, by which a perspective camera divides.

        Args:
            points: Points in world coordinates, shape (V, 3).

        Returns:
            Distance from the camera along the viewing direction, in world
            units, shape (V,). None for an orthographic camera.

        Raises:
            InputError: If a point lies behind a perspective camera or very near
                to it.
        """
        return None


@dataclass(frozen=True)
class OrthographicCamera(Camera):
    """Camera with parallel projection.

    The attributes are those of `Camera`.

    >>> camera = OrthographicCamera(polar=90.0, azimuth=0.0, width=2.0)  # It lies on +x.
    >>> camera.project(np.array([[0.0, 1.0, 0.5]]))[:, :2].round(6).tolist()  # x and y
    [[1.0, 0.5]]
    """

    @property
    def distance(self) -> float:  # type: ignore[override]
        """Distance that files store. Images do not depend on it."""
        return 2 * self.reach

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points to normalized device coordinates, see `Camera.project`."""
        scale = np.array([2 / self.width, 2 / self.width, -1 / self.reach])
        coordinates = (self.axes() * scale[:, None]) @ points.T
        coordinates += (np.array([self.right, self.up, 0.0]) * scale)[:, None]
        return coordinates.T

    def _w_and_nearness(self, back: Tensor) -> tuple[Tensor, Tensor]:
        """Return ones and the coordinate toward the camera."""
        return torch.ones_like(back), back


@dataclass(frozen=True)
class PerspectiveCamera(Camera):
    """Pinhole camera at a distance from the origin.

    The attributes are those of `Camera`. From a large distance, the image is
    the same as the image of an orthographic camera of the same width.

    >>> camera = PerspectiveCamera(polar=90.0, azimuth=0.0, width=2.0, distance=4.0)
    >>> point = np.array([[2.0, 0.5, 0.0]])  # It has half the distance of the origin.
    >>> camera.project(point)[0, 0].round(6).item()
    1.0
    """

    # A perspective camera stores its distance. An orthographic camera derives it.
    distance: float = field(kw_only=True)  # type: ignore[misc]

    def __post_init__(self) -> None:
        """Convert and check the fields."""
        super().__post_init__()
        require_range("distance", self.distance, 1 / MAX_MAGNITUDE, MAX_MAGNITUDE)

    def eye(self) -> np.ndarray:
        """Return the position of the camera and 1, float64, shape (4,)."""
        return self.pose()[:, 3]

    @property
    def angle(self) -> float:
        """Field of view: the angle between opposite sides of the image in degrees."""
        return math.degrees(2 * math.atan(self.width / 2 / self.distance))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points to normalized device coordinates, see `Camera.project`."""
        depths = self.depths(points)
        right, up, back = self.axes() @ points.T
        scale = 2 / self.width * (self.distance / depths)
        x = (right + self.right) * scale
        y = (up + self.up) * scale
        # Coordinate of the near plane along the axis from the origin to the
        # camera.
        near_back = self.distance - self.near
        depth_scale = 2 * self.far / (self.far - self.near)
        normalized_depth = depth_scale * ((near_back - back) / depths) - 1
        return np.stack([x, y, normalized_depth]).T

    def _w_and_nearness(self, back: Tensor) -> tuple[Tensor, Tensor]:
        """Return the depth over the distance of the camera, and the inverse of this ratio."""
        w = 1 - back / self.distance
        return w, 1 / w

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Compute the depths of points, see `Camera.depths`."""
        depths = self.distance - points @ self.axes()[2]
        if not (depths >= NEAREST * self.distance).all():
            raise InputError(
                f"the mesh reaches the camera at distance {self.distance:g} or extends beyond it: "
                "increase the distance (by a smaller fov or a larger width), or normalize the mesh"
            )
        return depths


def _as_scalar(name: str, value: Any) -> Any:
    """Convert a field of a camera to one number, or to a tensor () that gradients flow to."""
    if isinstance(value, Tensor) and value.numel() == 1:
        value = value.reshape(())
    elif isinstance(value, np.ndarray | list | tuple) and np.size(value) == 1:
        value = np.asarray(value).item()
    if not is_number(value):
        raise InputError(f"{name} is {describe(value)}: give one number")
    return value.item() if isinstance(value, np.generic | np.ndarray) else value


def _in_radians(degrees: Any) -> Any:
    """Convert an angle, which is a number or a tensor that gradients flow to."""
    if isinstance(degrees, Tensor):
        return torch.deg2rad(degrees)
    return math.radians(degrees)


def orbit_cameras(
    views: int,
    width: float,
    polar: float = 60.0,
    azimuth: float = 0.0,
    fov: float | None = None,
) -> list[Camera]:
    """Create cameras at equally spaced azimuths and the same polar angle.

    The paper uses the default polar angle and 10 views (appendix C).

    Args:
        views: Number of cameras.
        width: Width of the images at the origin in world units.
        polar: Polar angle in degrees, within two turns.
        azimuth: Azimuth of the first camera in degrees, within two turns.
        fov: Field of view: the angle between opposite sides of the image in
            degrees, from 0.05 to 172. It sets the distance of perspective
            cameras. None creates orthographic cameras.

    Returns:
        Cameras in ascending order of the azimuth.

    Raises:
        InputError: If a value is out of range.

    >>> [camera.azimuth for camera in orbit_cameras(views=4, width=2.0)]
    [0.0, 90.0, 180.0, 270.0]
    >>> orbit_cameras(views=1, width=2.0, fov=30.0)[0].distance.__round__(3)
    3.732
    """
    require_whole("views", views)
    require_range("views", views, 1, MAX_VIEWS)
    width = _as_scalar("width", width)
    polar = _as_scalar("polar", polar)
    azimuth = _as_scalar("azimuth", azimuth)
    require_range("azimuth", azimuth, -MAX_TURN, MAX_TURN)
    azimuths = [azimuth + 360 * view / views for view in range(views)]
    if fov is None:
        return [OrthographicCamera(polar, angle, width) for angle in azimuths]
    fov = _as_scalar("fov", fov)
    require_range("fov", fov, MIN_FOV, MAX_FOV)
    distance = width / 2 / math.tan(math.radians(fov) / 2)
    return [PerspectiveCamera(polar, angle, width, distance=distance) for angle in azimuths]
