"""Find the camera and the light of an object anywhere in a photograph.

A square window around the object is cut out of the photograph, as if the camera
had been turned toward the object, and `renderer.fit` fits this window. The
photograph and this image are related by a homography (Hartley and Zisserman
2004, section 8.4.2). Photographs must not be cropped, because the optical axis
of the camera must pass through the center of the photograph.

A camera has the axes right, up and back. It looks along minus back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.fit import FittedScene, fit_scene
from renderer.image import decode
from renderer.mesh import Mesh

Array = NDArray[Any]
# Smallest number of samples along one side of a
# pixel, if a window of a photograph is resampled to
# pixels that are larger than those of the photograph.
MIN_SAMPLES = 8
# Number of additional rows and columns of pixels that are read on each side of
# a window. The bicubic interpolation at the border of the window needs them.
BORDER = 2
# Side of the square window that is cut around an object, divided by the longer side of the object's
# bounding box.
WINDOW_SCALE = 1.6
# A pixel of an 8-bit mask belongs to the object if its value is larger than this.
MASK_THRESHOLD = 127
# First guess of the angle between +z and the direction to the camera, in degrees.
GUESSED_POLAR = 60.0
# A window of the photograph is cut and fitted again if the first fit changes a component of the
# axes of the window by more than this.
MAX_AXIS_CHANGE = 1e-3


class FittedPhotograph(NamedTuple):
    """Camera and light of an object anywhere in a photograph, and the window that was fitted.

    Attributes:
        scene: Camera and light. The camera looks at the center of the mesh.
        window: Square part of the photograph that the camera shows.
    """

    scene: FittedScene
    window: Window


@dataclass(frozen=True)
class Window:
    """Square window of a photograph, as if the camera had been turned toward its center.

    Attributes:
        homography: Matrix from a point (x, y, 1) of the window to the homogeneous
            position (column, row, 1) · w in the photograph, with any w > 0,
            shape (3, 3). The point is in pixels from the window center, with x to
            the right and y up.
        side: Side of the window in pixels. The pixels have the size of those in
            the center of the photograph.
        axes: Axes right, up and back of the turned camera as rows, in the axes of
            the camera that took the photograph, shape (3, 3).
    """

    homography: Array
    side: float
    axes: Array

    def cut(
        self,
        photograph: UInt8[Array, "height width channels"],
        size: int,
        encoding: str = "linear",
        beyond: int | None = None,
    ) -> Float[Tensor, "channels size size"]:
        """Cut the window out of the photograph, and resample it.

        The result is linear in [0, 1]. Pixels outside of the photograph have the value
        `beyond`, from 0 to 255, or repeat its border for None.
        """
        is_enlarged = self.side < size
        samples = 1 if is_enlarged else max(MIN_SAMPLES, math.ceil(self.side / size))
        # Rectangle of pixels of the photograph that the window shows, with a border. A homography
        # maps lines to lines, so the outermost points of the window are its corners.
        half = self.side / 2
        corners = self.pixels(*np.meshgrid([-half, half], [-half, half]))
        # First and last column and row of the rectangle. `pixels` repeats the border of the
        # photograph beyond it.
        low = np.floor(corners.min(axis=(0, 1))).astype(int) - BORDER
        high = np.ceil(corners.max(axis=(0, 1))).astype(int) + BORDER
        columns = np.arange(low[0], high[0])
        rows = np.arange(low[1], high[1])
        last_row, last_column = np.array(photograph.shape[:2]) - 1
        pixels = photograph[rows.clip(0, last_row)[:, None], columns.clip(0, last_column)]
        if beyond is not None:
            is_row_outside = (rows < 0) | (rows > last_row)
            is_column_outside = (columns < 0) | (columns > last_column)
            pixels[is_row_outside[:, None] | is_column_outside] = beyond
        linear = decode(torch.from_numpy(pixels).permute(2, 0, 1) / 255, encoding)[None]
        # If pixels become larger, their values are means over
        # many samples, as with the box filter of the renderer.
        # If they become smaller, the nearest pixel would make
        # visible steps, so the values are interpolated.
        mode = "bicubic" if is_enlarged else "nearest"
        resolution = size * samples
        # Positions of all samples along one side,
        # in pixels from the window center.
        offsets = ((np.arange(resolution) + 0.5) / resolution - 0.5) * self.side
        resampled = []
        # Resampling one row of pixels at a time needs less memory. The first one is at the top.
        for heights in -offsets.reshape(size, samples):
            points = self.pixels(*np.meshgrid(offsets, heights))
            # `grid_sample` takes coordinates from -1 to 1 in the rectangle.
            grid = torch.from_numpy(2 * (points - low) / (high - low) - 1).to(linear)[None]
            at_samples = F.grid_sample(linear, grid, mode, align_corners=False)
            resampled.append(F.avg_pool2d(at_samples, samples)[0])
        return torch.cat(resampled, dim=1).clamp(0, 1)

    def pixels(self, x: Array, y: Array) -> Array:
        """Map points of the window to positions (column, row) in the photograph, shape (..., 2).

        Points are distances right of and above the window center in pixels.
        """
        points = np.stack([x, y, np.ones_like(x)])
        columns, rows, weights = np.tensordot(self.homography, points, 1)
        return np.stack([columns / weights, rows / weights], axis=-1)


def window_around(
    shape: tuple[int, ...], focal_length: float | None, center: Array, side: float, z_axis: Array
) -> Window:
    """Compute a square window around a point of a photograph that an upright camera took.

    The window shows what the camera would see if it were turned toward the
    point and stayed upright. Without perspective (a `focal_length` of None), the window is a
    square of the photograph itself. `center` is a column and a row, and `side` is in pixels, as
    the focal length is. `z_axis` has the components right, up and back of the camera. `shape`
    begins with the height and the width of the photograph.
    """
    if focal_length is None:
        # Columns grow to the right as x does, but rows grow downward.
        column, row = center
        homography = np.array([[1.0, 0.0, column], [0.0, -1.0, row], [0.0, 0.0, 1.0]])
        return Window(homography, side, np.eye(3))
    height, width = shape[:2]
    # Matrix from a direction (x, y, z) in the axes of the camera
    # to the homogeneous position (column, row, 1) · (-z) in the
    # photograph. The column is width / 2 - focal_length · x / z.
    to_pixels = np.diag([focal_length, -focal_length, -1.0])
    to_pixels[:2, 2] = -width / 2, -height / 2
    # Direction in which the camera sees the point.
    forward = np.linalg.solve(to_pixels, np.array([*center, 1.0]))
    # Axes of the turned camera. Its axis to the right is horizontal.
    back = -forward / np.linalg.norm(forward)
    right = np.cross(z_axis, back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    # The turned camera sees the point (x, y, 1) of the
    # window in the direction (x, y, -focal_length).
    to_direction = np.diag([1.0, 1.0, -focal_length])
    return Window(to_pixels @ axes.T @ to_direction, side, axes)


def fit_photograph(
    photograph: UInt8[NDArray[Any], "height width 3"],
    mask: UInt8[NDArray[Any], "height width"],
    mesh: Mesh,
    size: int = 64,
    *,
    fov: float | None = None,
    encoding: str = "srgb",
    **options: Any,
) -> FittedPhotograph:
    """Find the camera and the light of an object anywhere in a photograph.

    The function cuts a square window around the object out of the photograph.
    The window shows what a camera would see if it were turned toward the object
    (see `renderer.photograph`). The window is fitted with `fit_scene`. The upward
    direction in the window depends on the height of the camera, which is only
    known after the fit. If the first window was tilted, a second window is cut
    and fitted. The camera of the photograph is upright, and its optical axis passes through the
    center of the photograph. The mask is white where the object is. `fov` is the field of view of
    the window in degrees, or None for no perspective.
    """
    rows, columns = np.nonzero(mask > MASK_THRESHOLD)
    if not len(rows):
        advice = "give a mask that is white where the object is, or a box around the object"
        raise InputError(f"the mask has no white pixels: {advice}")
    # Center (column, row) of the object's bounding box in the photograph, in pixels.
    center = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
    # Side of the window in pixels.
    side = WINDOW_SCALE * max(int(np.ptp(rows)), int(np.ptp(columns)), 1)
    focal_length = None if fov is None else side / 2 / math.tan(math.radians(fov) / 2)
    window_at = partial(window_around, photograph.shape, focal_length)

    def fit(window: Window, start: Camera | None) -> FittedScene:
        """Fit the camera and the light in one window. Without a start camera, search for one."""
        image = window.cut(photograph, size, encoding)
        # Share of each pixel that the object covers, shape (size, size).
        coverage = window.cut(mask[..., None], size, beyond=0)[0]
        camera = {"fov": fov} if start is None else {"start": start}
        return fit_scene(image, coverage, mesh, encoding=encoding, **camera, **options)

    # The window needs the direction of the world's z-axis in the axes of the photograph's camera:
    # right, up and back. For the first fit, this direction is guessed.
    polar = math.radians(GUESSED_POLAR)
    window = window_at(center, side, np.array([0.0, math.sin(polar), math.cos(polar)]))
    scene = fit(window, None)
    # The first fit gives a better direction of the z-axis for the second fit. The axes right, up
    # and back of the fitted camera are also the axes of the window.
    up = window.axes.T @ scene.camera.axes()[:, 2]
    # The camera of the photograph is upright, so the z-axis does not point to its right.
    up[0] = 0
    upright_window = window_at(center, side, up)
    if np.abs(upright_window.axes - window.axes).max() > MAX_AXIS_CHANGE:
        window = upright_window
        scene = fit(window, scene.camera)
    # Turn the camera and the window so that the mesh center is in their center.
    camera = scene.camera
    # Offset (right, up) of the mesh center from the window center, in pixels.
    offset = np.array([camera.right, camera.up]) * window.side / camera.width
    up = window.axes.T @ camera.axes()[:, 2]
    centered_window = window_at(window.pixels(*offset), window.side, up)
    return FittedPhotograph(scene._replace(camera=_turned_to_mesh(camera)), centered_window)


def _turned_to_mesh(camera: Camera) -> Camera:
    """Turn a perspective camera, or shift another one, toward the mesh's center, the origin."""
    if not isinstance(camera, PerspectiveCamera):
        return replace(camera, right=0.0, up=0.0)
    x, y, z = camera.eye()[:3].tolist()
    # Polar angle, azimuth and distance of the position of the camera, seen from the mesh.
    distance = math.hypot(x, y, z)
    return replace(
        camera,
        polar=math.degrees(math.acos(z / distance)),
        azimuth=math.degrees(math.atan2(y, x)),
        # The field of view stays the same.
        width=camera.width * distance / camera.distance,
        right=0.0,
        up=0.0,
        distance=distance,
    )
