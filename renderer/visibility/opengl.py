"""OpenGL rasterizer: moderngl with EGL, which needs no window.

Choose it for large meshes or images on a machine with a GPU.

Several workarounds for drivers are in use:

- Each call creates and releases a context. A context that is kept returns old
  data in another thread.
- After a fork, only the process that created a context first can create another
  one. With Mesa, a child process hangs.
- The index of a face comes from gl_VertexID, because some versions of Mesa count
  gl_PrimitiveID wrongly.
- Triton and the llvmpipe driver of Mesa have an LLVM each, and a process that
  loads Triton second crashes. Triton is therefore loaded before the context is
  created, if it is installed.

If a machine has several EGL devices, moderngl uses the one whose number is in
the environment variable GLCONTEXT_DEVICE_INDEX, and by default the first one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import numpy as np

from renderer.errors import InputError, explained
from renderer.visibility.numpy import FaceIds, Faces, Views

if TYPE_CHECKING:
    import moderngl

VERTEX_SHADER = """
#version 330
in vec3 position;
flat out int face;
void main() {
    gl_Position = vec4(position.x, -position.y, position.z, 1.0);  // The rows of OpenGL go up.
    face = gl_VertexID / 3;
}
"""

FRAGMENT_SHADER = """
#version 330
flat in int face;
layout(location = 0) out int id;
void main() {
    id = face + 1;  // 0 stands for no face.
}
"""


def rasterize(points: Views, faces: Faces, shape: tuple[int, int], closed: bool) -> FaceIds:
    """Find the nearest face at each sample of each view.

    The docstring of the package `renderer.visibility` defines the
    coordinates and the rounding. Samples without a face get -1.
    """
    # Sort the corners, so that two faces with the same corners in another order get exactly
    # the same depth. If the orientation of faces matters, the corners are only rotated, so
    # that the lowest one comes first.
    if closed:
        lowest = faces.argmin(axis=1)[:, None]
        ordered = np.take_along_axis(faces, (lowest + np.arange(3)) % 3, axis=1)
    else:
        ordered = np.sort(faces, axis=1)
    with open_context() as context:
        return _draw(context, points, ordered, shape, closed)


@contextmanager
def open_context() -> Iterator[moderngl.Context]:
    """Yield an OpenGL context; without EGL, or if it draws wrong, `InputError` is raised."""
    # Triton must be loaded before the driver, because a process that loads Triton second
    # crashes.
    with suppress(ImportError):
        import triton  # noqa: F401
    import moderngl

    advice = "apt install libegl1 libgl1, or choose the rasterizer numpy"
    with explained("the rasterizer opengl found no EGL device", advice):
        # The argument `backend` has a wrong type annotation in moderngl.
        context = moderngl.create_context(standalone=True, backend="egl")  # type: ignore[arg-type]
    try:
        with explained("the OpenGL driver failed", "use the rasterizer numpy", "", moderngl.Error):
            _check(context)
            yield context
    finally:
        context.release()


def _check(context: moderngl.Context) -> None:
    """Draw a test image, and raise InputError if the driver renders wrong faces.

    Face 0 is a large triangle that is seen from behind, face 1 is the same
    triangle seen from the front, and face 2 is a small triangle in front of them.
    """
    large_triangle = [[-1, -1, 0], [3, -1, 0], [-1, 3, 0]]
    small_triangle = [[-1, -0.2, -0.5], [0.2, 1, -0.5], [-1, 1, -0.5]]
    points = np.array([large_triangle + small_triangle])
    faces = np.array([[0, 2, 1], [0, 1, 2], [3, 4, 5]])
    # Expected face at each of 4 × 4 samples. Face 0 is seen from behind and is left out.
    expected = [[2, 2, 1, 1], [2, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]]
    if _draw(context, points, faces, (4, 4), closed=True)[0].tolist() != expected:
        name = context.info["GL_RENDERER"]
        raise InputError(f"the OpenGL driver {name} renders wrong faces: use the rasterizer numpy")


def _draw(
    context: moderngl.Context, points: Views, faces: Faces, shape: tuple[int, int], closed: bool
) -> FaceIds:
    """Draw N views and read the face ids."""
    import moderngl

    rows, columns = shape
    size = (columns, rows)
    program = context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
    # Buffer for the three corners of all faces of one view. Each of the three coordinates of a
    # corner takes 4 bytes.
    corners = context.buffer(reserve=faces.size * 3 * 4, dynamic=True)
    triangles = context.vertex_array(program, [(corners, "3f", "position")])
    texture = context.texture(size, 1, dtype="i4")
    framebuffer = context.framebuffer([texture], context.depth_renderbuffer(size))
    framebuffer.use()
    context.enable_only(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if closed else moderngl.NOTHING))
    # The vertex shader turns the image upside down. Front faces, which are
    # counter-clockwise, then become clockwise.
    context.front_face = "cw"
    # Faces are drawn in ascending order of their indices. With "<", the face with the
    # lower index stays if depths are equal.
    context.depth_func = "<"

    ids_from_one = np.empty((len(points), *shape), dtype=np.int32)
    # The image of OpenGL is [-1, 1] along both axes.
    scaled = (points * [1, columns / rows, 1]).astype(np.float32)
    for view, view_ids in zip(scaled, ids_from_one, strict=True):
        corners.write(view[faces])
        framebuffer.clear()
        triangles.render(moderngl.TRIANGLES)
        texture.read_into(view_ids)
    return ids_from_one - 1
