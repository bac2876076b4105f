"""Orthographic and perspective cameras, and orbits of them.

World axes are right-handed, and z points up.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from renderer import errors
from renderer.settings import MAX_VIEWS

# An array of points, or a tensor on any device.
Points = TypeVar("Points", np.ndarray, Tensor)
# Default of a camera's `clip_range` in world units. A camera then shows all of a normalized mesh,
# whose vertices are at most √3 from the origin.
CLIP_RANGE = 2.0
# Largest polar angle, roll and first azimuth of an orbit in degrees: two turns.
MAX_TURN = 720.0
# One degree in radians.
DEGREE = math.pi / 180
# Limits of the field of view in degrees, for the cameras of an orbit and for projectors.
MIN_FOV = 0.05
MAX_FOV = 172.0
# Smallest depth that a perspective camera can show, divided by the distance between camera and
# origin. A mesh with a smaller depth raises an error.
MIN_NEAR_RATIO = 0.01
# End of errors about cameras that are too close.
IN_FRONT = "give cameras that have the whole mesh in front of them"
# Smallest and largest values of fields that are lengths, ratios or angles.
_POSITIVE = (1 / errors.MAX_MAGNITUDE, errors.MAX_MAGNITUDE)
_RANGES = {
    **dict.fromkeys(("width", "clip_range", "distance", "pixel_aspect"), _POSITIVE),
    **dict.fromkeys(("polar", "roll"), (-MAX_TURN, MAX_TURN)),
}


@dataclass(frozen=True)
class Camera(ABC):
    """Camera that takes images of a scene around the origin.

    The camera lies at a polar angle from +z and at an azimuth from +x toward
    +y. Fields can be numbers, or tensors, arrays and lists of one number. If
    `nb.render` gets `silhouettes=True`, images are differentiable with respect to
    fields that are tensors. Otherwise they have no such gradient. Derivatives with
    respect to an angle are per degree.

    Attributes:
        polar: Polar angle in degrees, within two turns.
        azimuth: Azimuth in degrees.
        width: Width of the image at the origin in world units. A normalized
            mesh spans at most [-1, 1] along each axis. The height of the image
            follows from its size in pixels.
        right: Distance by which the origin appears to the right of the image
            center, in world units.
        up: Distance by which the origin appears above the image center, in world
            units.
        clip_range: Largest difference between the depth of a visible surface and
            the depth of the origin, in world units. The default is extended to
            show the whole mesh.
        distance: Distance of the camera from the origin in world units.

    Raises:
        InputError: If `width`, `clip_range` or `distance` is not positive, if
            `polar` is beyond two turns, or if a value is not one number, not
            finite or too large.
    """

    polar: float
    azimuth: float
    width: float
    right: float = 0.0
    up: float = 0.0
    clip_range: float = field(default=CLIP_RANGE, kw_only=True)

    distance: ClassVar[float]
    # Only a camera with perspective has a field `distance`.
    has_perspective: ClassVar[bool] = False
    # Roll, point about which attacks turn the camera, principal point relative to the image
    # center, and aspect ratio of the pixels. Only a `PinholeCamera` has other values.
    roll: ClassVar[float] = 0.0
    center_x: ClassVar[float] = 0.0
    center_y: ClassVar[float] = 0.0
    center_z: ClassVar[float] = 0.0
    principal_right: ClassVar[float] = 0.0
    principal_up: ClassVar[float] = 0.0
    pixel_aspect: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        """Convert each field to a number or to a tensor of shape (), and check its range."""
        for name, value in vars(self).items():
            if type(value) is not float:
                object.__setattr__(self, name, _as_scalar(name, value))
            limits = _RANGES.get(name, (-errors.MAX_MAGNITUDE, errors.MAX_MAGNITUDE))
            errors.require_range(name, getattr(self, name), *limits)

    @property
    def near(self) -> float:
        """Depth of the near plane, the smallest visible depth, in world units."""
        return max(self.distance - self.clip_range, MIN_NEAR_RATIO * self.distance)

    @property
    def far(self) -> float:
        """Depth of the far plane, the largest visible depth, in world units."""
        return self.distance + self.clip_range

    def with_clip_range(self, radius: float) -> Self:
        """Return a camera that shows all depths of a ball of this radius around the origin."""
        if radius <= self.clip_range:
            return self
        return replace(self, clip_range=math.floor(radius) + 1.0)

    def fixed(self) -> Self:
        """Return a camera whose fields are numbers instead of tensors."""
        numbers: dict[str, Any] = {
            name: value.item() for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **numbers) if numbers else self

    def moved(self, polar: Tensor, azimuth: Tensor, log_distance: Tensor) -> Self:
        """Return a camera that is turned about the origin and moved toward or away from it.

        The two angles are added, in degrees. `log_distance` is the natural logarithm of the
        factor for the distance. The field of view stays the same, so the width of the image
        at the origin grows with the distance. An orthographic camera has no distance, and
        only its width changes.
        """
        turned: dict[str, Any] = {"polar": self.polar + polar, "azimuth": self.azimuth + azimuth}
        return replace(self.widened(log_distance.exp()), **turned)

    def widened(self, factor: Any) -> Self:
        """Return a camera that sees `factor` times the width, at the same field of view.

        Only a perspective camera has a distance, which is multiplied by the factor, too.
        """
        names = ("width", "distance") if self.has_perspective else ("width",)
        return replace(self, **{name: getattr(self, name) * factor for name in names})

    def normalized(self, center: np.ndarray, scale: float) -> Self:
        """Return a camera whose image stays the same if the mesh is moved and scaled.

        Each point p of the mesh is moved to (p - center) · scale.

        Args:
            center: Point of the mesh that is moved to the origin, in world units,
                shape (3,).
            scale: Factor by which the mesh is scaled.

        Returns:
            Camera that shows the moved and scaled mesh as this camera shows the
            mesh. Attacks on the pose turn it about the origin.

        Raises:
            InputError: If the center lies behind a perspective camera.
        """
        # The center relative to the pivot (`_from_pivots`), in the axes of the camera.
        right, up, back = self.axes() @ _from_pivots([self], center)[0, 0]
        changed: dict[str, Any] = {
            "right": scale * (self.right + right),
            "up": scale * (self.up + up),
            "width": scale * self.width,
            "clip_range": scale * self.clip_range,
        }
        if self.has_perspective:
            distance = self.distance - back
            if not distance > 0:
                place = np.round(center, 3).tolist()
                fault = f"the center {place} of the mesh lies behind a camera"
                raise errors.InputError(f"cameras: {fault}: {IN_FRONT}")
            changed["distance"] = scale * distance
            changed["width"] = scale * self.width * (distance / self.distance)
        return replace(self, **changed)

    def axes(self) -> np.ndarray:
        """Return the axes of the camera in world coordinates.

        Returns:
            Unit vectors to the right, up and back (from the origin to the
            camera) as rows, float64, shape (3, 3).
        """
        polar, azimuth, roll = map(math.radians, (self.polar, self.azimuth, self.roll))
        sine, cosine = math.sin(azimuth), math.cos(azimuth)
        back = np.array([math.sin(polar) * cosine, math.sin(polar) * sine, math.cos(polar)])
        right = np.array([-sine, cosine, 0.0])
        # The last component is sin(polar), except for rounding errors. Using sin(polar) instead
        # would change the last bits of images.
        up = np.array([-back[2] * cosine, -back[2] * sine, back[0] * cosine + back[1] * sine])
        sine, cosine = math.sin(roll), math.cos(roll)
        return np.array([cosine * right + sine * up, cosine * up - sine * right, back])

    def pose(self) -> np.ndarray:
        """Return the matrix that maps camera coordinates to world coordinates.

        Returns:
            The axes right, up and back and the position of the camera as
            columns, float64, shape (4, 4). The last row is (0, 0, 0, 1).
        """
        axes = self.axes()
        position = np.array([-self.right, -self.up, self.distance]) @ axes
        columns = np.column_stack([axes.T, position - _from_pivots([self], np.zeros(3))[0, 0]])
        return np.vstack([columns, [0, 0, 0, 1]])

    def eye(self) -> np.ndarray:
        """Return the position of the camera in homogeneous world coordinates.

        Returns:
            Position (x, y, z, 1) of a perspective camera. An orthographic camera is
            infinitely far away, so its position is (x, y, z, 0) with the unit vector
            (x, y, z) toward the camera. Float64, shape (4,).
        """
        return self.differentiable_eye().detach().numpy()

    def differentiable_eye(self) -> Tensor:
        """Compute `eye` differentiably with respect to fields of the camera that are tensors.

        Returns:
            Position of the camera (x, y, z, w), float64, shape (4,).
        """
        # Camera coordinates of the origin and of the unit vectors give the axes of the camera.
        coordinates = self._camera_coordinates(torch.eye(4, 3, dtype=torch.float64).roll(1, 0))
        origin = coordinates[:, 0]
        axes = coordinates[:, 1:] - origin[:, None]
        if not self.has_perspective:
            return F.pad(axes[2], (0, 1))
        # Camera coordinates relative to the pivot, as in `pose`.
        offsets = [-self.right, -self.up, self.distance]
        position = torch.stack([tensor_like(offset, origin) for offset in offsets])
        return F.pad((position - origin) @ axes, (0, 1), value=1.0)

    def project(self, points: Points) -> Points:
        """Project points to normalized device coordinates.

        The image goes from -1 to 1 in x, and y has the same unit. The depth is -1 at the
        near plane and 1 at the far plane. Planes in the world stay planes.

        Args:
            points: Points in world coordinates, an array or a tensor on any device,
                shape (V, 3).

        Returns:
            Coordinates (x, y, depth) of the same type, with x to the right and y up,
            shape (V, 3).

        Raises:
            InputError: If a perspective camera lies in or behind the points.
        """
        return self._project_views([self], points)[0]

    @abstractmethod
    def _project_views(self, cameras: Sequence[Any], points: Points) -> Points:
        """Project by N cameras of this class, of which this is the first, shape (N, V, 3)."""

    def homogeneous(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points to homogeneous image coordinates.

        The result is differentiable with respect to the points, and with
        respect to fields of the camera that are tensors.

        Args:
            points: Points in world coordinates, shape (V, 3).

        Returns:
            A tuple of

            - (x w, y w, w), shape (V, 3), for the position (x, y) from the image
              center in halves of the image width. The number w is 1 for an
              orthographic camera, and the depth divided by `distance` for a
              perspective camera;
            - the nearness of each point, shape (V,). It is larger for nearer
              points. On a plane, it is a linear function of the image position.
        """
        right, up, back = self._camera_coordinates(points)
        # `back` points from the pivot to the camera, so the depth is distance - back.
        w = 1 - back / self.distance if self.has_perspective else torch.ones_like(back)
        nearness = 1 / w if self.has_perspective else back
        scale = 2 / self.width
        x = (right + self.right) * scale + self.principal_right * w
        y = (up + self.up) * scale * self.pixel_aspect + self.principal_up * w
        return torch.stack([x, y, w]).T, nearness

    def _camera_coordinates(self, points: Float[Tensor, "V 3"]) -> Float[Tensor, "3 V"]:
        """Convert points to the axes right, up and back of the camera, from the pivot."""
        angles = (self.polar, self.azimuth, self.roll)
        polar, azimuth, roll = (tensor_like(angle * DEGREE, points) for angle in angles)
        center = [self.center_x, self.center_y, self.center_z]
        pivot = torch.stack([tensor_like(coordinate, points) for coordinate in center])
        # Axes right, up and back in world coordinates, without roll.
        axes = (
            [-azimuth.sin(), azimuth.cos(), 0 * azimuth],
            [-polar.cos() * azimuth.cos(), -polar.cos() * azimuth.sin(), polar.sin()],
            [polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()],
        )
        right, up, back = torch.stack([torch.stack(axis) for axis in axes]) @ (points - pivot).T
        # The roll turns right and up about the axis back.
        cosine, sine = roll.cos(), roll.sin()
        return torch.stack([cosine * right + sine * up, cosine * up - sine * right, back])

    def depths(self, points: Points) -> Points | None:
        """Compute the depths of points, which a perspective projection divides by.

        Args:
            points: Points in world coordinates, shape (V, 3).

        Returns:
            Distance of each point from the camera along the viewing direction, in
            world units, shape (V,). None for an orthographic camera.

        Raises:
            InputError: If a point lies behind a perspective camera or very near
                to it.
        """
        return None


@dataclass(frozen=True)
class OrthographicCamera(Camera):
    """Camera with parallel projection.

    The attributes are those of `Camera`.

    >>> import numpy as np
    >>> import norm_balls as nb
    >>> camera = nb.OrthographicCamera(polar=90.0, azimuth=0.0, width=2.0)  # It lies on +x.
    >>> camera.project(np.array([[0.0, 1.0, 0.5]]))[:, :2].round(6).tolist()  # x and y
    [[1.0, 0.5]]
    """

    @property
    def distance(self) -> float:  # type: ignore[override]
        """Distance that files of cameras store. Images do not depend on it."""
        return 2 * self.clip_range

    def _project_views(self, cameras: Sequence[Any], points: Points) -> Points:
        """Project points without perspective, with depths from -1 at `near` to 1 at `far`."""
        scales = [[2 / each.width, 2 / each.width, -1 / each.clip_range] for each in cameras]
        scale = np.array(scales)[..., None]
        shift = np.array([[each.right, each.up, 0.0] for each in cameras])[..., None]
        axes = np.stack([each.axes() for each in cameras])
        coordinates = _like(axes * scale, points) @ points.T
        coordinates += _like(shift * scale, points)
        return coordinates.swapaxes(1, 2)


@dataclass(frozen=True)
class PerspectiveCamera(Camera):
    """Pinhole camera at a distance from the origin.

    The attributes are those of `Camera`. From a large distance, the image is
    the same as the image of an orthographic camera of the same width.

    >>> import numpy as np
    >>> import norm_balls as nb
    >>> camera = nb.PerspectiveCamera(polar=90.0, azimuth=0.0, width=2.0, distance=4.0)
    >>> # The camera is at (4, 0, 0). The image is 1 unit wide at the depth of this point.
    >>> point = np.array([[2.0, 0.5, 0.0]])
    >>> camera.project(point)[0, 0].round(6).item()  # 1 is the right side of the image.
    1.0
    """

    distance: float = field(kw_only=True)  # type: ignore[misc]
    has_perspective: ClassVar[bool] = True

    @property
    def angle(self) -> float:
        """Field of view, the angle between the left and the right side of the image."""
        return math.degrees(2 * math.atan(self.width / 2 / self.distance))

    def _project_views(self, cameras: Sequence[Any], points: Points) -> Points:
        """Project points with perspective, with depths from -1 (near plane) to 1 (far plane)."""
        depths = self._depths_of_views(cameras, points)
        field = partial(_column, cameras, points)
        axes = _like(np.stack([each.axes() for each in cameras]), points)
        right, up, back = (axes @ _from_pivots(cameras, points).swapaxes(1, 2)).swapaxes(0, 1)
        distance = field("distance")
        scale = 2 / field("width") * (distance / depths)
        x = (right + field("right")) * scale + field("principal_right")
        y = (up + field("up")) * scale * field("pixel_aspect") + field("principal_up")
        _, near, far = self._limits(cameras, depths)
        # The near plane is measured along the axis from the pivot to the camera.
        normalized_depth = 2 * far / (far - near) * ((distance - near - back) / depths) - 1
        return _stack([x, y, normalized_depth], 1).swapaxes(1, 2)

    def depths(self, points: Points) -> Points:
        """Compute the depths of points, which must lie in front of the camera."""
        return self._depths_of_views([self], points)[0]

    def _depths_of_views(self, cameras: Sequence[Any], points: Points) -> Points:
        """Compute the depths (N, V) of points that must lie in front of N cameras."""
        backs = _like(np.stack([each.axes()[2] for each in cameras]), points)
        along = (_from_pivots(cameras, points) @ backs[..., None])[..., 0]
        depths = _column(cameras, points, "distance") - along
        is_behind = depths < self._limits(cameras, depths)[0]
        if is_behind.any():
            camera = cameras[int(is_behind.any(1).nonzero()[0][0])]
            place = camera.pose()[:3, 3].round(3).tolist()
            fault = f"the mesh reaches the camera at {place} or lies behind it: normalize the mesh"
            advice = f"increase the distance (by a smaller fov or a larger width), or {IN_FRONT}"
            raise errors.InputError(f"{fault}, {advice}")
        return depths

    def _limits(self, cameras: Sequence[Any], depths: Points) -> tuple[Any, Any, Any]:
        """Return the smallest allowed depth, and the depths of the near and of the far plane."""
        field = partial(_column, cameras, depths)
        return MIN_NEAR_RATIO * field("distance"), field("near"), field("far")


def showing(
    cameras: Sequence[Camera], vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> list[Camera]:
    """Extend the clipping range of cameras that have the default, so that they show all faces."""
    # A bound of the distance from the origin, which is enough for normalized meshes.
    radius = math.sqrt(3) * float(np.abs(vertices).max(initial=0))
    if not CLIP_RANGE < radius < math.inf:
        return list(cameras)
    radius = float(np.linalg.norm(vertices[faces], axis=-1).max(initial=0))
    return [
        camera.with_clip_range(radius) if camera.clip_range == CLIP_RANGE else camera
        for camera in cameras
    ]


def project_views(cameras: Sequence[Camera], points: Points) -> Points:
    """Project points by N cameras, shape (N, V, 3). Those of one class project at once."""
    if len({type(camera) for camera in cameras}) == 1:
        return cameras[0]._project_views(cameras, points)
    return _stack([camera.project(points) for camera in cameras])


def depths_of_views(cameras: Sequence[Camera], points: Points) -> Points | None:
    """Compute the depths of points from N cameras, shape (N, V). None without perspective.

    From a camera without perspective among others, all depths are 1.
    """
    if not any(camera.has_perspective for camera in cameras):
        return None
    first = cameras[0]
    if isinstance(first, PerspectiveCamera) and len({type(camera) for camera in cameras}) == 1:
        return first._depths_of_views(cameras, points)
    given = [camera.depths(points) for camera in cameras]
    return _stack([0 * points[:, 0] + 1 if depths is None else depths for depths in given])


def _stack(arrays: Sequence[Points], axis: int = 0) -> Points:
    """Stack arrays, or tensors."""
    stack: Any = torch.stack if isinstance(arrays[0], Tensor) else np.stack
    return stack(arrays, axis)


def _from_pivots(cameras: Sequence[Camera], points: Points) -> Points:
    """Subtract the points about which attacks turn N cameras from other points, (N, V, 3)."""
    pivots = [[each.center_x, each.center_y, each.center_z] for each in cameras]
    return points - _like(np.array(pivots)[:, None], points)


def _column(cameras: Sequence[Camera], like: Points, name: str) -> Points:
    """Return a field of N cameras as a column (N, 1)."""
    return _like(np.array([[getattr(each, name)] for each in cameras]), like)


def _as_scalar(name: str, value: Any) -> Any:
    """Convert a camera's field to a number, or a tensor to shape (), which keeps its gradient."""
    if isinstance(value, Tensor) and value.numel() == 1:
        value = value.reshape(())
    elif isinstance(value, np.generic | np.ndarray | list | tuple) and np.size(value) == 1:
        value = np.asarray(value).item()
    if not errors.is_number(value):
        raise errors.InputError(f"{name} is {errors.describe(value)}: give one number")
    return value


def _like(array: np.ndarray, points: Points) -> Points:
    """Convert an array to a tensor on the device of the points, if they are one."""
    if isinstance(points, Tensor):
        return torch.from_numpy(array).to(points, non_blocking=True)
    return array


def tensor_like(value: float | Tensor, like: Tensor) -> Tensor:
    """Convert a number or a tensor to a tensor with the dtype and the device of `like`."""
    if isinstance(value, Tensor):
        return value.to(like, non_blocking=like.is_cuda)
    return like.new_full((), value)


def orbit_cameras(
    views: int, width: float, polar: float = 60.0, azimuth: float = 0.0, fov: float | None = None
) -> list[Camera]:
    """Create cameras around the origin, at equally spaced azimuths and the same polar angle.

    The paper "Beyond Pixel Norm-Balls" uses the default polar angle and 10 views
    (appendix C).

    Args:
        views: Number of cameras.
        width: Width in world units that an image shows at the origin.
        polar: Polar angle in degrees, within two turns.
        azimuth: Azimuth of the first camera in degrees, within two turns.
        fov: Field of view: the angle between the left and the right side of the
            image in degrees, from 0.05 to 172. It sets the distance of perspective
            cameras. None creates orthographic cameras.

    Returns:
        Cameras in ascending order of the azimuth.

    Raises:
        InputError: If a value is out of range.

    >>> import norm_balls as nb
    >>> [camera.azimuth for camera in nb.orbit_cameras(views=4, width=2.0)]
    [0.0, 90.0, 180.0, 270.0]
    >>> nb.orbit_cameras(views=1, width=2.0, fov=30.0)[0].distance.__round__(3)
    3.732
    """
    errors.require_whole("views", views, 1, MAX_VIEWS)
    width, polar, azimuth = map(_as_scalar, ("width", "polar", "azimuth"), (width, polar, azimuth))
    errors.require_range("azimuth", azimuth, -MAX_TURN, MAX_TURN)
    azimuths = [azimuth + 360 * view / views for view in range(views)]
    if fov is None:
        return [OrthographicCamera(polar, angle, width) for angle in azimuths]
    fov = _as_scalar("fov", fov)
    errors.require_range("fov", fov, MIN_FOV, MAX_FOV)
    # The image of width `width` appears at the angle `fov` from this distance.
    distance = width / 2 / math.tan(math.radians(fov) / 2)
    return [PerspectiveCamera(polar, angle, width, distance=distance) for angle in azimuths]
