"""Cut square windows out of photographs, as if the camera had been turned toward an object.

The optical axis of our cameras passes through the image center. If an object is
elsewhere in a photograph, this module computes the image of a camera at the same
place that is turned toward the object. The photograph and this image are related
by a homography (Hartley and Zisserman 2004, section 8.4.2). Photographs must not
be cropped, because the optical axis of the camera must pass through the center
of the photograph.

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
# Smallest number of samples along one side of a pixel in `Window.cut`, if the pixels of
# the window are larger than those of the photograph.
LEAST_SAMPLES = 8
# Number of pixels that `Window.cut` reads around the window, because bicubic
# interpolation needs neighbors.
BORDER = 2


@dataclass(frozen=True)
class Photograph:
    """Photograph of an upright camera.

    Attributes:
        pixels: RGB values, uint8, shape (H, W, 3).
        focal_length: Focal length in pixels. None for a camera without
            perspective.
    """

    pixels: UInt8[Array, "height width 3"]
    focal_length: float | None

    def window(self, center: Array, side: float, above: Array) -> Window:
        """Compute the window that a camera sees that is turned toward a point, without roll.

        Args:
            center: Column and row of the point in the photograph, in pixels,
                shape (2,).
            side: Side of the window in pixels.
            above: World's z-axis in the axes of the photograph's camera,
                shape (3,).

        Returns:
            Window whose center shows the point.
        """
        focal_length = self.focal_length
        if focal_length is None:
            # Without perspective, the window is shifted. Rows are counted downward.
            column, row = center
            to_pixels = np.array([[1.0, 0.0, column], [0.0, -1.0, row], [0.0, 0.0, 1.0]])
            return Window(to_pixels, side, np.eye(3))
        height, width = self.pixels.shape[:2]
        # Matrix from a direction (x, y, z) in the axes of the camera to homogeneous
        # (column, row). The direction meets the image plane at
        # (x, y) · focal_length / -z.
        to_pixels = np.array(
            [
                [focal_length, 0, -width / 2],
                [0, -focal_length, -height / 2],
                [0.0, 0.0, -1.0],
            ]
        )
        # Direction to the point, and axes of the turned camera.
        forward = np.linalg.solve(to_pixels, np.array([*center, 1.0]))
        back = -forward / np.linalg.norm(forward)
        right = np.cross(above, back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back])
        # A point (x, y, 1) of the window has the direction (x, y, -focal_length) in the
        # axes of the turned camera.
        to_direction = np.diag([1.0, 1.0, -focal_length])
        return Window(to_pixels @ axes.T @ to_direction, side, axes)


@dataclass(frozen=True)
class Window:
    """Square image that a camera would see that is turned toward a part of a photograph.

    Attributes:
        homography: Matrix from a point of the window to homogeneous
            (column, row, weight) in the photograph, shape (3, 3). The point is
            (x, y, 1), with x to the right and y up, in pixels from the center of
            the window.
        side: Side of the window in pixels. The pixels have the size of those in
            the center of the photograph.
        axes: Axes right, up and back of the turned camera as rows, in the axes
            of the photograph's camera, shape (3, 3).
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
        """Resample the photograph in the window, with linear values.

        Args:
            photograph: Photograph or mask, uint8, shape (H, W, C).
            size: Number of pixels per side of the result.
            encoding: Encoding of the photograph, "linear" or "srgb".
            beyond: Value of pixels outside of the photograph, from 0 to 255. None
                repeats the pixels at the border of the photograph.

        Returns:
            Linear values in [0, 1], float32, shape (C, size, size).
        """
        is_enlarged = self.side < size
        samples = 1 if is_enlarged else max(LEAST_SAMPLES, math.ceil(self.side / size))
        part = self._needed_part()
        part_pixels = part.read(photograph, beyond)
        linear = decode(torch.from_numpy(part_pixels).permute(2, 0, 1) / 255, encoding)[None]
        # Large pixels are the mean of samples with the values of the nearest pixels, as
        # with the box filter of the renderer. Small pixels would have visible steps, so
        # they are interpolated.
        mode = "bicubic" if is_enlarged else "nearest"
        resolution = size * samples
        # Positions of samples along one side, in pixels from the window center.
        offsets = ((np.arange(resolution) + 0.5) / resolution - 0.5) * self.side
        rows = []
        # Resampling one row of pixels at a time limits the memory.
        for sample_rows in -offsets.reshape(size, samples):
            points = np.stack(self.pixels(*np.meshgrid(offsets, sample_rows)), axis=-1)
            grid = torch.from_numpy(part.normalized(points)).to(linear)[None]
            at_samples = F.grid_sample(linear, grid, mode, align_corners=False)
            rows.append(F.avg_pool2d(at_samples, samples)[0])
        return torch.cat(rows, dim=1).clamp(0, 1)

    def pixels(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Map points in the window to the photograph.

        Args:
            x: Pixels to the right of the center of the window, any shape.
            y: Pixels above the center, of the same shape.

        Returns:
            Columns and rows of the photograph.
        """
        points = np.stack([x, y, np.ones_like(x)])
        columns, rows, weights = np.tensordot(self.homography, points, 1)
        return columns / weights, rows / weights

    def _needed_part(self) -> _Part:
        """Find the rectangle of the photograph that the window shows, with a border.

        A homography maps lines to lines. The corners of the window are therefore
        its outermost points in the photograph.
        """
        half = self.side / 2
        x = np.array([-half, half, half, -half])
        y = np.array([-half, -half, half, half])
        columns, rows = self.pixels(x, y)
        return _Part(
            left=math.floor(columns.min()) - BORDER,
            top=math.floor(rows.min()) - BORDER,
            right=math.ceil(columns.max()) + BORDER,
            bottom=math.ceil(rows.max()) + BORDER,
        )


@dataclass(frozen=True)
class _Part:
    """Rectangle of pixels, which may extend beyond the photograph.

    Attributes:
        left: First column.
        top: First row.
        right: Column after the last one.
        bottom: Row after the last one.
    """

    left: int
    top: int
    right: int
    bottom: int

    def read(self, photograph: Array, beyond: int | None) -> Array:
        """Read the pixels of the rectangle.

        Args:
            photograph: Photograph, shape (H, W, C).
            beyond: Value of pixels outside of the photograph. None uses the value
                of the nearest pixel.

        Returns:
            Pixels, shape (bottom - top, right - left, C).
        """
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
        """Convert columns and rows of the photograph to coordinates of `grid_sample`.

        Args:
            points: Columns and rows in pixels, shape (..., 2).

        Returns:
            Coordinates (x, y), which are in [-1, 1] in the rectangle,
            shape (..., 2).
        """
        extent = [self.right - self.left, self.bottom - self.top]
        return 2 * (points - [self.left, self.top]) / extent - 1
