"""Orthographic cameras that look at the origin, and rings of them. World axes are right-handed with z up."""

import math
from dataclasses import dataclass

import numpy as np

from renderer.errors import LARGEST, InputError, require_range


@dataclass(frozen=True)
class OrthographicCamera:
    """A parallel projection from polar angle θ off +z and azimuth φ off +x towards +y, both in radians.

    field_of_view: width of the square image in world units; a normalised mesh spans at most [-1, 1] per axis.
    right, up: where the origin lies in the image, in world units from its middle.
    InputError where the field of view is not positive, an angle is not finite, or any is too large.
    """

    polar: float
    azimuth: float
    field_of_view: float
    right: float = 0.0
    up: float = 0.0

    def __post_init__(self) -> None:
        require_range("scene.field_of_view", self.field_of_view, 1 / LARGEST, LARGEST)
        if not (math.isfinite(self.polar) and math.isfinite(self.azimuth)):
            raise InputError(f"camera angles polar={self.polar}, azimuth={self.azimuth}: give finite ones, in radians")
        if not (abs(self.right) <= LARGEST and abs(self.up) <= LARGEST):  # NaN is not
            raise InputError(f"camera place right={self.right}, up={self.up}: give lengths of at most {LARGEST:g}")

    def axes(self) -> np.ndarray:
        """(3, 3) float64, rows: right, up and back (from the origin to the camera), in world coordinates."""
        sin_polar, cos_polar = math.sin(self.polar), math.cos(self.polar)
        sin_azimuth, cos_azimuth = math.sin(self.azimuth), math.cos(self.azimuth)
        back = [sin_polar * cos_azimuth, sin_polar * sin_azimuth, cos_polar]
        right = [-sin_azimuth, cos_azimuth, 0.0]
        return np.array([right, np.cross(back, right), back])

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (V, 3) to normalised device coordinates (V, 3): x right, y up, z depth.

        The image is [-1, 1]² in x and y. Depth is smaller where nearer and in [-1, 1] within 2 world units of the
        origin, which every normalised mesh (radius at most √3) is.
        """
        scale = np.array([2 / self.field_of_view, 2 / self.field_of_view, -1 / 2])
        return points @ (self.axes() * scale[:, None]).T + np.array([self.right, self.up, 0.0]) * scale


def ring(
    views: int, field_of_view: float, polar: float = math.pi / 3, azimuth: float = 0.0
) -> list[OrthographicCamera]:
    """Cameras at one polar angle and equally spaced azimuths from a first (the paper's appendix C: π/3 and 10)."""
    azimuths = [azimuth + 2 * math.pi * view / views for view in range(views)]
    return [OrthographicCamera(polar, each, field_of_view) for each in azimuths]
