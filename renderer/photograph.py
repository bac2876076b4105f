"""Cut square windows out of photographs, each as a camera without lens shift sees it.

A camera's optical axis passes through the middle of its image. An object elsewhere in the photograph is therefore seen
by a camera that is turned at the same place, and the two images are related by a homography (Hartley and Zisserman
2004, section 8.4.2). A photograph is taken to be whole: its optical axis passes through its middle.
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
LEAST_SAMPLES = 8  # per side of a pixel that is larger than the photograph's


@dataclass(frozen=True)
class Photograph:
    """A photograph of a camera that is upright.

    Attributes:
        pixels: Of 8 bits, shape (H, W, 3).
        focal_length: The distance of the image plane from the camera in pixels. None for a camera without perspective.
    """

    pixels: UInt8[Array, "height width 3"]
    focal_length: float | None

    def window(self, center: Array, side: float, above: Array) -> Window:
        """Turn the camera to a square, without roll.

        Args:
            center: The middle of the square (column, row) in pixels.
            side: Pixels per side of the square.
            above: The direction of the world's z axis in the axes of the photograph's camera, shape (3,).

        Returns:
            The window, whose optical axis passes through the center.
        """
        focal_length = self.focal_length
        if focal_length is None:
            to_pixels = np.array([[1.0, 0.0, center[0]], [0.0, -1.0, center[1]], [0.0, 0.0, 1.0]])
            return Window(to_pixels, side, np.eye(3))
        height, width = self.pixels.shape[:2]
        # A ray (x, y, z) meets the image plane at (x, y) × focal_length / -z.
        to_pixels = np.array([[focal_length, 0, -width / 2], [0, -focal_length, -height / 2], [0.0, 0.0, -1.0]])
        forward = np.linalg.solve(to_pixels, np.array([*center, 1.0]))
        back = -forward / np.linalg.norm(forward)
        right = np.cross(above, back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back])
        return Window(to_pixels @ axes.T @ np.diag([1.0, 1.0, -focal_length]), side, axes)


@dataclass(frozen=True)
class Window:
    """A square of a photograph, or what a turned camera would see in its place.

    Attributes:
        homography: Maps a point (x right, y up, 1) in pixels from the window's middle to homogeneous (column, row,
            weight) in the photograph, shape (3, 3).
        side: Pixels per side, of the photograph's size at the middle of the photograph.
        axes: Rows right, up and back of the window's camera, in the axes of the photograph's camera, shape (3, 3).
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
            encoding: Encoding of the photograph.
            beyond: Value outside the photograph, 0 to 255. None repeats its border.

        Returns:
            Linear values in [0, 1], shape (C, size, size), float32.
        """
        enlarged = self.side < size
        finer = 1 if enlarged else max(LEAST_SAMPLES, math.ceil(self.side / size))
        columns, rows = self._corners()
        # The part of the photograph that is needed, with a border for interpolation.
        left, top = (math.floor(values.min()) - 2 for values in (columns, rows))
        right, bottom = (math.ceil(values.max()) + 2 for values in (columns, rows))
        height, width = photograph.shape[:2]
        at_columns, at_rows = np.arange(left, right), np.arange(top, bottom)
        part = photograph[at_rows.clip(0, height - 1)[:, None], at_columns.clip(0, width - 1)]
        if beyond is not None:
            outside = ((at_rows < 0) | (at_rows >= height))[:, None] | (at_columns < 0) | (at_columns >= width)
            part[outside] = beyond
        linear = decode(torch.from_numpy(part).permute(2, 0, 1) / 255, encoding)[None]
        # The box filter is the renderer's. Where pixels are enlarged, it would leave steps.
        mode = "bicubic" if enlarged else "nearest"
        offsets = ((np.arange(size * finer) + 0.5) / (size * finer) - 0.5) * self.side
        resampled = []
        for y in -offsets.reshape(size, finer):  # A row of pixels at a time bounds the memory.
            points = np.stack(self.pixels(*np.meshgrid(offsets, y)), axis=-1)
            grid = 2 * (points - [left, top]) / [right - left, bottom - top] - 1
            at_samples = F.grid_sample(linear, torch.from_numpy(grid).to(linear)[None], mode, align_corners=False)
            resampled.append(F.avg_pool2d(at_samples, finer)[0])
        return torch.cat(resampled, dim=1).clamp(0, 1)

    def pixels(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Map points in the window to columns and rows of the photograph."""
        columns, rows, weights = np.tensordot(self.homography, np.stack([x, y, np.ones_like(x)]), 1)
        return columns / weights, rows / weights

    def _corners(self) -> tuple[Array, Array]:
        """Map the window's corners, which are its farthest points, since a homography keeps lines."""
        half = self.side / 2
        return self.pixels(np.array([-half, half, half, -half]), np.array([-half, -half, half, half]))
