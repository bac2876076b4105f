"""Cut square windows out of photographs, as if the camera had been turned toward an object.

An object may be anywhere in a photograph. This module computes the square image
that the camera would have taken if it had been turned toward the object. The
photograph and this image are related by a homography (Hartley and Zisserman
2004, section 8.4.2). Photographs must not be cropped, because the optical axis
of the camera must pass through the center of the photograph.

A camera has the axes right, up and back. It looks along minus back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from renderer.image import decode

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

Array = NDArray[Any]
# Smallest number of samples along one side of a
# pixel, if a window of a photograph is resampled to
# pixels that are larger than those of the photograph.
MIN_SAMPLES = 8
# Number of additional rows and columns of pixels that are read on each side of
# a window. The bicubic interpolation at the border of the window needs them.
BORDER = 2


@dataclass(frozen=True)
class Photograph:
    """Photograph that an upright camera took.

    Attributes:
        pixels: RGB values, uint8, shape (H, W, 3).
        focal_length: Focal length in pixels. None for a camera without
            perspective.
    """

    pixels: UInt8[Array, "height width 3"]
    focal_length: float | None

    def window(self, center: Array, side: float, z_axis: Array) -> Window:
        """Compute a square window around a point of the photograph.

        The window shows what the camera would see if it were turned toward the
        point and stayed upright. Without perspective, the window is a square of the
        photograph itself. `center` is a column and a row, and `side` is in pixels. `z_axis`
        has the components right, up and back of the camera that took the photograph.
        """
        focal_length = self.focal_length
        if focal_length is None:
            # Columns grow to the right as x does, but rows grow downward.
            column, row = center
            homography = np.array([[1.0, 0.0, column], [0.0, -1.0, row], [0.0, 0.0, 1.0]])
            return Window(homography, side, np.eye(3))
        height, width = self.pixels.shape[:2]
        # Matrix from a direction (x, y, z) in the axes of the camera
        # to the homogeneous position (column, row, 1) · (-z) in the
        # photograph. The column is width / 2 - focal_length · x / z.
        to_pixels = np.array(
            [
                [focal_length, 0, -width / 2],
                [0, -focal_length, -height / 2],
                [0.0, 0.0, -1.0],
            ]
        )
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
        rectangle = self._needed_rectangle()
        pixels = rectangle.read(photograph, beyond)
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
        # Heights of samples above the window center, with one row for
        # each row of pixels. The first row of pixels is at the top.
        heights = -offsets.reshape(size, samples)
        rows = []
        # Resampling one row of pixels at a time needs less memory.
        for row_heights in heights:
            x, y = np.meshgrid(offsets, row_heights)
            points = np.stack(self.pixels(x, y), axis=-1)
            grid = torch.from_numpy(rectangle.normalized(points)).to(linear)[None]
            at_samples = F.grid_sample(linear, grid, mode, align_corners=False)
            rows.append(F.avg_pool2d(at_samples, samples)[0])
        return torch.cat(rows, dim=1).clamp(0, 1)

    def pixels(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Map points of the window to positions in the photograph.

        Points are distances right of and above the window center in pixels. The results are
        columns and rows.
        """
        points = np.stack([x, y, np.ones_like(x)])
        columns, rows, weights = np.tensordot(self.homography, points, 1)
        return columns / weights, rows / weights

    def _needed_rectangle(self) -> _Rectangle:
        """Find the rectangle of pixels of the photograph that the window shows, with a border.

        A homography maps lines to lines. The outermost points of the window in the
        photograph are therefore its corners.
        """
        half = self.side / 2
        x = np.array([-half, half, half, -half])
        y = np.array([-half, -half, half, half])
        columns, rows = self.pixels(x, y)
        return _Rectangle(
            left=math.floor(columns.min()) - BORDER,
            top=math.floor(rows.min()) - BORDER,
            right=math.ceil(columns.max()) + BORDER,
            bottom=math.ceil(rows.max()) + BORDER,
        )


@dataclass(frozen=True)
class _Rectangle:
    """Rectangle of pixels of a photograph, which may extend beyond the photograph.

    Attributes:
        left: First column of pixels.
        top: First row of pixels.
        right: Column after the last column.
        bottom: Row after the last row.
    """

    left: int
    top: int
    right: int
    bottom: int

    def read(self, photograph: Array, beyond: int | None) -> Array:
        """Read the pixels of the rectangle."""
        height, width = photograph.shape[:2]
        columns = np.arange(self.left, self.right)
        rows = np.arange(self.top, self.bottom)
        pixels = photograph[rows.clip(0, height - 1)[:, None], columns.clip(0, width - 1)]
        if beyond is not None:
            is_row_outside = (rows < 0) | (rows >= height)
            is_column_outside = (columns < 0) | (columns >= width)
            pixels[is_row_outside[:, None] | is_column_outside] = beyond
        return pixels

    def normalized(self, points: Array) -> Array:
        """Convert positions in the photograph to coordinates for torch's `grid_sample`.

        Points are columns and rows. Coordinates (x, y) go from -1 to 1 in the rectangle.
        """
        extent = [self.right - self.left, self.bottom - self.top]
        return 2 * (points - [self.left, self.top]) / extent - 1
