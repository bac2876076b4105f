"""Rasterizers, which find the nearest face at each sample of an image.

There are four: opengl, numpy, numba and torch, which takes and returns tensors.

Each module of this package has a function

    rasterize(points, faces, shape, closed) -> ids

with these arguments:

- points: The V vertices as N views project them, float64, shape (N, V, 3). The
  image is [-1, 1] in x (to the right), and samples are as far apart in y (up) as in
  x. The third coordinate is the depth, which is smaller for nearer points. Surfaces
  outside the depths [-1, 1) are clipped.
- faces: Vertex indices of the faces, shape (F, 3).
- shape: Numbers R and C of rows and columns of samples. The sample in row i and
  column j lies at x = (2 j + 1) / C - 1 and y = (R - 2 i - 1) / C.
- closed: False draws faces from both sides. True promises that the mesh is
  watertight, that it lies within the range of depths, and that its faces are
  counter-clockwise seen from outside. Faces that are clockwise in the image are
  then left out. The same samples are covered with True and False. The face of a
  sample can only differ where a face that is seen from behind is as near as the
  nearest face up to rounding, such as along silhouettes.

The result is the index of the nearest face at each sample, or -1 if there is
none, int32, shape (N, R, C). Row 0 is at the top. If two faces have the same
depth, the face with the lower index is returned.

All rasterizers round vertices to 1/256 of a sample. A sample at the common edge
of two faces is therefore covered by exactly one of them. NumPy, numba and torch give
the same results. OpenGL rounds depths differently.
"""

from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module

import numpy as np
from jaxtyping import Int

# The module `torch` of this package would hide a name `torch`.
from torch import Tensor, as_tensor, from_numpy

from renderer.camera import Points
from renderer.errors import InputError, require_choice, require_memory
from renderer.settings import RASTERIZERS, Size, height_and_width
from renderer.visibility import opengl

# `Rasterizer.rasterize` clips projected points to a square around the image center. This
# is the side of the square in samples. Products of fixed-point coordinates then fit into
# int64.
SPAN = 2**21
# Bytes for each sample of the view that is shaded, at least. A face index has 4 more in each view.
SHADED_BYTES = 40


@dataclass(frozen=True)
class Rasterizer:
    """One of the rasterizers of this package.

    Attributes:
        name: Name of its module in this package.
        is_automatic: Whether points on a GPU are rasterized there by torch instead.
    """

    name: str
    is_automatic: bool = False

    def rasterize(
        self, points: Points, faces: Int[np.ndarray, "F 3"], resolution: Size, closed: bool = False
    ) -> Points:
        """Find the nearest face at each sample of N images, or -1, int32, shape (N, R, C).

        `points` have the shape (N, V, 3) and may be on any device, on which a tensor of results
        is. x is in [-1, 1] in the image, and the third coordinate is the depth. `resolution` is the
        number of samples per side, or of rows and columns. `closed` leaves out faces that are seen
        from behind.
        """
        shape = rows, columns = height_and_width(resolution)
        # Larger coordinates would not fit into the integers of the rasterizers.
        given = as_tensor(points).clamp(-SPAN / columns, SPAN / columns)
        needed = (4 * len(points) + SHADED_BYTES) * rows * columns
        require_memory(f"{len(points)} views of {rows} × {columns} samples", needed, given.device)
        # A rasterizer that was named by the user is kept, also on a GPU.
        name = "torch" if self.is_automatic and given.is_cuda else self.name
        rasterize = import_module(f"renderer.visibility.{name}").rasterize
        if name == "torch":
            ids = rasterize(
                given, as_tensor(faces).to(given.device, non_blocking=True), shape, closed
            )
        else:
            ids = from_numpy(rasterize(given.cpu().numpy(), faces, shape, closed))
        return ids.to(given.device) if isinstance(points, Tensor) else ids.numpy()


def choose(rasterizer: str = "auto") -> Rasterizer:
    """Choose a rasterizer that works on this machine.

    "auto" chooses torch for points on a GPU. Otherwise, it chooses numba if it is installed, and
    numpy if not, so that images are the same on every machine.
    """
    require_choice("rasterizer", rasterizer, RASTERIZERS)
    if rasterizer == "opengl":
        with opengl.open_context():
            pass  # This draws a test image.
    if rasterizer != "auto":
        # numba is only imported when it is needed, which takes 0.5 s. It may be missing.
        import_module(f"renderer.visibility.{rasterizer}")
        return Rasterizer(rasterizer)
    with suppress(InputError):
        import_module("renderer.visibility.numba")
        return Rasterizer("numba", is_automatic=True)
    return Rasterizer("numpy", is_automatic=True)
