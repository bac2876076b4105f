"""Which face covers each sample: by OpenGL, NumPy or numba, under one contract.

rasterize(points, faces, resolution, closed) -> ids

points      (N, V, 3) float64, the vertices as N views project them: x right, y up, both in [-1, 1] across
            a square image; z is depth, smaller is nearer, and surface outside [-1, 1) is clipped
faces       (F, 3) integer; drawn from both sides unless closed
resolution  samples per side R; sample (i, j) sits at x = (2j + 1)/R - 1, y = 1 - (2i + 1)/R
closed      promises a watertight mesh within the range of depths, its faces counter-clockwise seen from outside, and
            leaves out the faces that wind clockwise in the image: the same samples are covered, with the same ids
            except where a face turned away is as near as the nearest within rounding, as along outlines
ids         (N, R, R) int32, row 0 at the top: the nearest face's index, the lower one where depths tie, or -1

All snap vertices to 1/256 of a sample, so faces that share an edge cover each sample once. NumPy and numba agree to the
bit; OpenGL rounds depths otherwise.
"""

from dataclasses import dataclass
from importlib import import_module

import numpy as np

from renderer.errors import InputError, require_choice
from renderer.settings import RASTERIZERS
from renderer.visibility.rasterizers import opengl

SPAN = 2**21  # samples; vertices outside are pulled in, so that fixed-point edge functions fit in int64


@dataclass(frozen=True)
class Rasterizer:
    """One way to rasterize. `name` is its module, `description` names it, and the device, for the line logged at the
    start."""

    name: str
    description: str

    def rasterize(self, points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool = False) -> np.ndarray:
        """Ids (N, R, R) int32 by the module's contract. ValueError: points that are not finite."""
        low, high = points.min(initial=0), points.max(initial=0)
        if not (np.isfinite(low) and np.isfinite(high)):
            raise ValueError("points hold NaN or infinity")
        limit = SPAN / resolution
        if max(-low, high) > limit:
            points = np.clip(points, -limit, limit)
        module = import_module(f"renderer.visibility.rasterizers.{self.name}")
        return module.rasterize(points, faces, resolution, closed)


def choose(rasterizer: str = "auto") -> Rasterizer:
    """Settle on a rasterizer, once at the start.

    "auto" takes numba where it is installed, else numpy, so that images are the same on every machine. InputError: an
    unknown name, "opengl" on a machine that cannot, or "numba" without numba.
    """
    require_choice("rasterizer", rasterizer, RASTERIZERS)
    if rasterizer == "opengl":
        return Rasterizer("opengl", f"opengl ({opengl.device()})")
    if rasterizer != "numpy":
        try:
            from renderer.visibility.rasterizers import numba  # takes half a second to import

            return Rasterizer("numba", f"numba ({numba.VERSION})")
        except InputError:
            if rasterizer == "numba":
                raise
    return Rasterizer("numpy", "numpy" if rasterizer == "numpy" else "numpy (numba is faster: pip install numba)")
