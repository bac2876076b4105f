"""Cut square windows out of photographs, each as a camera without lens shift sees it.

The optical axis of a camera passes through the center of its image. An object
elsewhere in a photograph is therefore seen by a camera that is turned towards it
at the same place. The two images are related by a homography (Hartley and
Zisserman 2004, section 8.4.2). Photographs must not be cropped: the optical axis
of their camera passes through their center.

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
# Smallest number of samples per side of a pixel that is larger than the pixels of
# the photograph.
LEAST_SAMPLES = 8
# Pixels around a part of a photograph that interpolation needs.
BORDER = 2


@dataclass(frozen=True)
class Photograph:
    """A photograph by an upright camera.

    Attributes:
        pixels: Pixels of 8 bits, shape (H, W, 3).
        focal_length: Distance of the image plane from the camera in pixels. None
            for a camera without perspective.
    """

    pixels: UInt8[Array, "height width 3"]
    focal_length: float | None

    def window(self, center: Array, side: float, above: Array) -> Window:
        """Turn the camera towards a square of the photograph, without roll.

        Args:
            center: Center of the square (column, row) in pixels.
            side: Side of the square in pixels.
            above: World's z axis in the axes of the photograph's camera, shape
                (3,).

        Returns:
            The window of the turned camera, whose optical axis passes through the
            center of the square.
        """
        focal_length = self.focal_length
        if focal_length is None:
            # Rows of an image count downwards.
            column, row = center
            to_pixels = np.array([[1.0, 0.0, column], [0.0, -1.0, row], [0.0, 0.0, 1.0]])
            return Window(to_pixels, side, np.eye(3))
        height, width = self.pixels.shape[:2]
        # A ray (x, y, z) meets the image plane at (x, y) × focal_length / -z.
        to_pixels = np.array(
            [
                [focal_length, 0, -width / 2],
                [0, -focal_length, -height / 2],
                [0.0, 0.0, -1.0],
            ]
        )
        forward = np.linalg.solve(to_pixels, np.array([*center, 1.0]))
        back = -forward / np.linalg.norm(forward)
        right = np.cross(above, back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back])
        # A point (x, y, 1) of the window is the ray (x, y, -focal_length).
        to_ray = np.diag([1.0, 1.0, -focal_length])
        return Window(to_pixels @ axes.T @ to_ray, side, axes)


@dataclass(frozen=True)
class Window:
    """The square image of a turned camera, which replaces a part of a photograph.

    Attributes:
        homography: Matrix from a point (x right, y up, 1), in pixels from the
            center of the window, to homogeneous (column, row, weight) in the
            photograph, shape (3, 3).
        side: Side of the window, in pixels of the size that they have in the
            center of the photograph.
        axes: Axes right, up and back of the window's camera, as rows, in the axes
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
        """Resample the window in linear light.

        Args:
            photograph: Pixels of 8 bits, shape (H, W, C).
            size: Pixels per side of the result.
            encoding: Encoding of the photograph, "linear" or "srgb".
            beyond: Value outside of the photograph, 0 to 255. None repeats its
                border.

        Returns:
            Linear values in [0, 1], shape (C, size, size), float32.
        """
        is_enlarged = self.side < size
        samples = 1 if is_enlarged else max(LEAST_SAMPLES, math.ceil(self.side / size))
        part = self._needed_part()
        pixels = part.read(photograph, beyond)
        linear = decode(torch.from_numpy(pixels).permute(2, 0, 1) / 255, encoding)[None]
        # Pixels are averaged by the renderer's box filter. Where pixels are
        # enlarged, this would leave steps, so these are interpolated.
        mode = "bicubic" if is_enlarged else "nearest"
        resolution = size * samples
        offsets = ((np.arange(resolution) + 0.5) / resolution - 0.5) * self.side
        resampled = []
        # Resampling a row of pixels at a time bounds the memory.
        for y in -offsets.reshape(size, samples):
            points = np.stack(self.pixels(*np.meshgrid(offsets, y)), axis=-1)
            grid = torch.from_numpy(part.normalized(points)).to(linear)[None]
            at_samples = F.grid_sample(linear, grid, mode, align_corners=False)
            resampled.append(F.avg_pool2d(at_samples, samples)[0])
        return torch.cat(resampled, dim=1).clamp(0, 1)

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
        """Return the part of the photograph that the window shows, with a border.

        A homography keeps straight lines, so the corners of the window are its
        outermost points.
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
    """A rectangle of pixels, which may lie beyond the photograph.

    It has the columns from `left` to `right`, and the rows from `top` to `bottom`,
    without the last one.
    """

    left: int
    top: int
    right: int
    bottom: int

    def read(self, photograph: Array, beyond: int | None) -> Array:
        """Return the pixels of a photograph (H, W, C) in this part.

        Args:
            photograph: Photograph, shape (H, W, C).
            beyond: Value of pixels beyond the photograph. None for the value of
                the nearest pixel.
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
        """Return points (..., 2) of columns and rows, with this part in [-1, 1]."""
        extent = [self.right - self.left, self.bottom - self.top]
        return 2 * (points - [self.left, self.top]) / extent - 1
