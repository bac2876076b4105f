"""Orthographic and perspective cameras that look at the origin, and orbits of them.

World axes are right-handed with z up.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from renderer.errors import LARGEST, InputError, describe, is_number, require_range
from renderer.settings import MAX_VIEWS
from renderer.validation import require_whole

REACH = 2.0  # enough for a normalized mesh, whose radius is at most √3
MOST_TURN = 4 * math.pi  # radians: larger angles are taken for degrees
NEAREST = 0.01  # of its distance: a mesh that comes nearer to the camera is refused


@dataclass(frozen=True)
class Camera(ABC):
    """A square image from polar angle θ off +z and azimuth φ off +x towards +y, both in radians.

    width: width of the image in world units, at the origin; a normalized mesh spans at most [-1, 1] per axis.
    right, up: the origin's position in the image, in world units from the middle. reach: the depth along the view, in
    world units to either side of the origin, within which surfaces are visible. distance: of the camera from the
    origin. Fields may be tensors, arrays or lists of one number. InputError: a width or distance that is not positive,
    values that are not finite or too large, a polar angle beyond two turns.
    """

    polar: float
    azimuth: float
    width: float
    right: float = 0.0
    up: float = 0.0
    reach: float = field(default=REACH, kw_only=True)

    distance: ClassVar[float]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if type(value) is not float:
                object.__setattr__(self, name, _as_scalar(name, value))
        require_range("width", self.width, 1 / LARGEST, LARGEST)
        require_range("reach", self.reach, 1 / LARGEST, LARGEST)
        _require_radians("polar", self.polar)
        for name in ("azimuth", "right", "up"):
            require_range(name, getattr(self, name), -LARGEST, LARGEST)

    @property
    def near(self) -> float:
        """Distance from the camera at which visible surface begins."""
        return max(self.distance - self.reach, NEAREST * self.distance)

    @property
    def far(self) -> float:
        """Distance from the camera at which visible surface ends."""
        return self.distance + self.reach

    def seeing(self, radius: float) -> Self:
        """The same camera, with a reach that contains a ball around the origin."""
        return self if radius <= self.reach else replace(self, reach=math.floor(radius) + 1.0)

    def fixed(self) -> Self:
        """The same camera with numbers in place of tensors, if it has any."""
        numbers = {name: value.item() for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **numbers) if numbers else self

    def moved(self, polar: Tensor, azimuth: Tensor, log_distance: Tensor) -> Self:
        """Turned by angles and, with the same field of view, farther by a factor exp(log_distance); without
        perspective, its image is wider by that factor. Its fields are tensors."""
        factor = log_distance.exp()
        moved: dict[str, Any] = {"polar": self.polar + polar, "azimuth": self.azimuth + azimuth}
        moved |= {name: getattr(self, name) * factor for name in ("width", "distance") if name in vars(self)}
        return replace(self, **moved)

    def axes(self) -> np.ndarray:
        """(3, 3) float64, rows: right, up and back (from the origin to the camera), in world coordinates."""
        sin_polar, cos_polar = math.sin(self.polar), math.cos(self.polar)
        sin_azimuth, cos_azimuth = math.sin(self.azimuth), math.cos(self.azimuth)
        back = [sin_polar * cos_azimuth, sin_polar * sin_azimuth, cos_polar]
        right = [-sin_azimuth, cos_azimuth, 0.0]
        up = [-cos_polar * cos_azimuth, -cos_polar * sin_azimuth, back[0] * cos_azimuth + back[1] * sin_azimuth]
        return np.array([right, up, back])

    def pose(self) -> np.ndarray:
        """(4, 4) the axes and, last, the position of the camera, as columns in world coordinates."""
        axes, position = self.axes(), np.array([-self.right, -self.up, self.distance])
        return np.vstack([np.column_stack([axes.T, position @ axes]), [0, 0, 0, 1]])

    def eye(self) -> np.ndarray:
        """(4,) homogeneous: the direction to the camera and 0."""
        return np.append(self.axes()[2], 0.0)

    @abstractmethod
    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (V, 3) to normalized device coordinates (V, 3): x right, y up, z depth.

        The image is [-1, 1]² in x and y. Depth is smaller where nearer, from -1 at `near` to 1 at `far`, and planes
        stay planes in it.
        """

    def homogeneous(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Image positions (V, 3) of world points (V, 3) as (x w, y w, w), and how near these are (V,), which is linear
        in the image. Differentiable in the points, and in the camera's fields if they are tensors."""
        polar, azimuth = (torch.as_tensor(angle).to(points) for angle in (self.polar, self.azimuth))
        (sin_polar, cos_polar), (sin, cos) = ((angle.sin(), angle.cos()) for angle in (polar, azimuth))
        rows = (
            [-sin, cos, 0 * sin],
            [-cos_polar * cos, -cos_polar * sin, sin_polar],
            [sin_polar * cos, sin_polar * sin, cos_polar],
        )
        right, up, back = torch.stack([torch.stack(row) for row in rows]) @ points.T
        w, nearness = self._w(back)
        scale = 2 / self.width
        return torch.stack([(right + self.right) * scale, (up + self.up) * scale, w]).T, nearness

    @abstractmethod
    def _w(self, back: Tensor) -> tuple[Tensor, Tensor]:
        """(w, nearness) of points so far (V,) from the origin to the camera."""

    def depths(self, points: np.ndarray) -> np.ndarray | None:
        """(V,) along the view from the camera to world points (V, 3), by which an image with perspective is divided;
        None of one without."""
        return None


@dataclass(frozen=True)
class OrthographicCamera(Camera):
    """A parallel projection; its angles and lengths are `Camera`'s.

    >>> camera = OrthographicCamera(polar=math.pi / 2, azimuth=0.0, width=2.0)  # on +x
    >>> camera.project(np.array([[0.0, 1.0, 0.5]]))[:, :2].round(6).tolist()  # x right, y up
    [[1.0, 0.5]]
    """

    @property
    def distance(self) -> float:  # type: ignore[override]
        """In files; images do not depend on it."""
        return 2 * self.reach

    def project(self, points: np.ndarray) -> np.ndarray:
        scale = np.array([2 / self.width, 2 / self.width, -1 / self.reach])
        rows = (self.axes() * scale[:, None]) @ points.T
        rows += (np.array([self.right, self.up, 0.0]) * scale)[:, None]
        return rows.T

    def _w(self, back: Tensor) -> tuple[Tensor, Tensor]:
        return torch.ones_like(back), back


@dataclass(frozen=True)
class PerspectiveCamera(Camera):
    """A pinhole at a distance; from far away, an orthographic camera of the same field of view sees the same.

    >>> camera = PerspectiveCamera(polar=math.pi / 2, azimuth=0.0, width=2.0, distance=4.0)
    >>> camera.project(np.array([[2.0, 0.5, 0.0]]))[0, 0].round(6).item()  # half as far away, so twice as large
    1.0
    """

    distance: float = field(kw_only=True)  # type: ignore[misc]  # each has its own, where orthographic cameras share one

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("distance", self.distance, 1 / LARGEST, LARGEST)

    def eye(self) -> np.ndarray:
        """(4,) homogeneous: the position and 1."""
        return self.pose()[:, 3]

    @property
    def angle(self) -> float:
        """Between opposite sides of the image, in radians."""
        return 2 * math.atan(self.width / 2 / self.distance)

    def project(self, points: np.ndarray) -> np.ndarray:
        """InputError: as `depths`."""
        depths, (right, up, back) = self.depths(points), self.axes() @ points.T
        scale = 2 / self.width * (self.distance / depths)
        before = self.distance - self.near
        depth = 2 * self.far / (self.far - self.near) * ((before - back) / depths) - 1
        return np.stack([(right + self.right) * scale, (up + self.up) * scale, depth]).T

    def _w(self, back: Tensor) -> tuple[Tensor, Tensor]:
        w = 1 - back / self.distance
        return w, 1 / w

    def depths(self, points: np.ndarray) -> np.ndarray:
        """InputError where a point lies behind the camera or as good as there."""
        depths = self.distance - points @ self.axes()[2]
        if not (depths >= NEAREST * self.distance).all():
            advice = "give a larger distance (a smaller fov or a larger width), or normalize the mesh"
            raise InputError(f"the mesh reaches to a camera at distance {self.distance:g}, or beyond: {advice}")
        return depths


def _as_scalar(name: str, value: Any) -> Any:
    """Convert a camera's field to one number, or to a tensor () that gradients flow to."""
    if isinstance(value, Tensor) and value.numel() == 1:
        value = value.reshape(())
    elif isinstance(value, np.ndarray | list | tuple) and np.size(value) == 1:
        value = np.asarray(value).item()
    if not is_number(value):
        raise InputError(f"{name} is {describe(value)}: give one number")
    return value.item() if isinstance(value, np.generic | np.ndarray) else value


def _require_radians(name: str, angle: float) -> None:
    """Check that an angle is within two turns, which angles in degrees usually exceed."""
    if not -MOST_TURN <= angle <= MOST_TURN:
        raise InputError(f"{name}={float(angle):g}: give radians, such as math.radians({float(angle):g})")


def orbit_cameras(
    views: int, width: float, polar: float = math.pi / 3, azimuth: float = 0.0, fov: float | None = None
) -> list[Camera]:
    """Cameras at one polar angle and equally spaced azimuths from a first (the paper's appendix C: π/3 and 10).

    width: of the image at the origin, in world units. fov: the angle between opposite sides of the image, in radians,
    which sets the distance of perspective cameras; None for orthographic ones. InputError: values out of range.

    >>> [round(math.degrees(camera.azimuth)) for camera in orbit_cameras(views=4, width=2.0)]
    [0, 90, 180, 270]
    >>> orbit_cameras(views=1, width=2.0, fov=math.radians(30))[0].distance.__round__(3)
    3.732
    """
    require_whole("views", views)
    require_range("views", views, 1, MAX_VIEWS)
    width, polar, azimuth = _as_scalar("width", width), _as_scalar("polar", polar), _as_scalar("azimuth", azimuth)
    _require_radians("azimuth", azimuth)
    azimuths = [azimuth + 2 * math.pi * view / views for view in range(views)]
    if fov is None:
        return [OrthographicCamera(polar, angle, width) for angle in azimuths]
    fov = _as_scalar("fov", fov)
    require_range("fov", fov, 1e-3, 3)
    distance = width / 2 / math.tan(fov / 2)
    return [PerspectiveCamera(polar, angle, width, distance=distance) for angle in azimuths]
