"""The OpenGL rasterizer: moderngl over EGL, without a window.

A context is made, used and released in one call, since one that is kept returns stale data in another thread.
After a fork only the process that made a context first can make another: under Mesa a child hangs. Ids come from
gl_VertexID, since some Mesa versions count gl_PrimitiveID wrongly. Triton and Mesa's llvmpipe each bring an LLVM of
their own, and a process that loads Triton second crashes; so it is loaded here, where it is installed.
Of several EGL devices moderngl takes the one whose number is in GLCONTEXT_DEVICE_INDEX, by default the first.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import numpy as np

from renderer.errors import InputError

if TYPE_CHECKING:
    import moderngl

VERTEX_SHADER = """
#version 330
in vec3 position;
flat out int face;
void main() {
    gl_Position = vec4(position.x, -position.y, position.z, 1.0);  // OpenGL's rows go up, ours down
    face = gl_VertexID / 3;
}
"""

FRAGMENT_SHADER = """
#version 330
flat in int face;
layout(location = 0) out int id;
void main() {
    id = face + 1;  // 0 is what the image is cleared to
}
"""


def rasterize(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Ids by the contract in `renderer.visibility.rasterizers`, for finite points.
    InputError: no EGL device, or a driver that renders wrong ids or fails."""
    least = faces.argmin(axis=1)[:, None]  # first, so that duplicate faces have one depth, and tie
    ordered = np.take_along_axis(faces, (least + np.arange(3)) % 3, axis=1) if closed else np.sort(faces, axis=1)
    with _context() as context:
        return _draw(context, points, ordered, resolution, closed)


def device() -> str:
    """The name of the OpenGL driver's device. InputError: no EGL device, or a driver that renders wrong ids."""
    with _context() as context:
        return context.info["GL_RENDERER"]


@contextmanager
def _context() -> Iterator[moderngl.Context]:
    with suppress(ImportError):
        import triton  # noqa: F401
    import moderngl

    try:
        context = moderngl.create_context(standalone=True, backend="egl")  # type: ignore[arg-type]  # annotated as though a dict
    except Exception as error:  # moderngl raises no narrower class
        raise InputError("no EGL device: apt install libegl1 libgl1, or choose the rasterizer numpy") from error
    try:
        _check(context)
        yield context
    except moderngl.Error as error:
        raise InputError(f"the OpenGL driver failed ({error}): choose the rasterizer numpy") from error
    finally:
        context.release()


def _check(context: moderngl.Context) -> None:
    """InputError unless a test image is right: a large triangle, first turned away and then not, behind a small one."""
    points = np.array([[[-1, -1, 0], [3, -1, 0], [-1, 3, 0], [-1, -0.2, -0.5], [0.2, 1, -0.5], [-1, 1, -0.5]]])
    ids = _draw(context, points, np.array([[0, 2, 1], [0, 1, 2], [3, 4, 5]]), 4, closed=True)
    if ids[0].tolist() != [[2, 2, 1, 1], [2, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]]:
        name = context.info["GL_RENDERER"]
        raise InputError(f"the OpenGL driver {name} renders wrong face ids: choose the rasterizer numpy")


def _draw(
    context: moderngl.Context, points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool
) -> np.ndarray:
    import moderngl

    size = (resolution, resolution)
    program = context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
    corners = context.buffer(reserve=faces.size * 3 * 4, dynamic=True)
    triangles = context.vertex_array(program, [(corners, "3f", "position")])
    texture = context.texture(size, 1, dtype="i4")
    framebuffer = context.framebuffer([texture], context.depth_renderbuffer(size))
    framebuffer.use()
    context.enable_only(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if closed else moderngl.NOTHING))
    context.front_face = "cw"  # counter-clockwise in the image, whose rows go down
    context.depth_func = "<"  # of equal depths the face drawn first stays, the one with the lower index

    ids = np.empty((len(points), *size), dtype=np.int32)
    for view, view_ids in zip(points.astype(np.float32), ids, strict=True):
        corners.write(view[faces])
        framebuffer.clear()
        triangles.render(moderngl.TRIANGLES)
        texture.read_into(view_ids)
    return ids - 1
