"""What procedural solids are made with: surfaces of revolution and of cells, waves, colours."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from renderer.mesh import Mesh

SEGMENTS = 48  # faces around an axis of revolution
STEP = 0.1  # longest edge along a profile, in world units


def sphere(subdivisions: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a unit sphere of 20·4^subdivisions faces."""
    from trimesh.creation import icosphere  # trimesh takes half a second

    ball = icosphere(subdivisions=subdivisions)
    return np.array(ball.vertices), np.array(ball.faces)


def revolve(*strokes: np.ndarray | Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and the stroke (F,) of each face of a surface of revolution.

    Its profile is drawn in strokes, each a list of (radius, height) points with a paint of its own; a stroke starts
    where the one before it ended. The whole runs from the axis back to the axis, counter-clockwise around the solid's
    half section.
    """
    corners = np.concatenate(strokes)
    stroke_of_corner = np.repeat(np.arange(len(strokes)), [len(stroke) for stroke in strokes])
    profile, edge = _subdivide(corners)
    azimuth = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    radius, height = profile[:, :1], profile[:, 1:]
    rings = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height + 0 * azimuth], axis=-1)
    vertices, faces, band = loft(rings)
    return vertices, faces, stroke_of_corner[edge + 1][band]


def _subdivide(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The polyline (n, 2) with edges cut to at most STEP, and which edge each piece is of.

    A repeated corner leaves no piece.
    """
    edges = np.diff(corners, axis=0)
    pieces = np.ceil(np.linalg.norm(edges, axis=1) / STEP - 1e-9).astype(int)
    edge = np.repeat(np.arange(len(edges)), pieces)
    fraction = np.concatenate([np.arange(n) / n for n in pieces if n])
    return np.concatenate([corners[edge] + fraction[:, None] * edges[edge], corners[-1:]]), edge


def loft(rings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The closed surface through rings (n, s, 3) that run counter-clockwise about the direction of travel.

    The first and the last ring are single points, repeated. Returns vertices (V, 3), faces (F, 3) and the
    band (F,) between two rings that each face lies in.
    """
    n, s = rings.shape[:2]
    vertices = np.concatenate([rings[0, :1], rings[1:-1].reshape(-1, 3), rings[-1, :1]])
    index = np.clip(np.arange(1 - s, (n - 1) * s + 1).reshape(n, s), 0, (n - 2) * s + 1)
    a, d = index[:-1], index[1:]
    b, c = np.roll(a, -1, axis=1), np.roll(d, -1, axis=1)
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    band = np.repeat(np.arange(n - 1), 2 * s)
    real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
    return vertices, faces[real], band[real]


def surface_of_cells(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in cells, and faces (F, 3) between filled cells (nx, ny, nz) and empty ones."""
    padded, unit, quads = np.pad(cells, 1), np.eye(3, dtype=int), []
    for axis in range(3):
        u, v = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
        square = np.array([0 * u, u, u + v, v])  # counter-clockwise about +axis
        for side in (0, 1):
            neighbour = np.roll(padded, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
            exposed = np.argwhere(cells & ~neighbour)
            quads.append(exposed[:, None] + side * unit[axis] + square[:: 2 * side - 1])
    vertices, corners = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, corners.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def paint(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, *paints: ArrayLike) -> Mesh:
    """A mesh whose faces of part i have the colour paints[i]: one RGB (3,) or one per vertex (V, 3)."""
    colors = np.stack([np.broadcast_to(paint, vertices.shape) for paint in paints]).astype(np.float32)
    return replace(Mesh.plain(vertices, faces), corner_colors=colors[part[:, None], faces])


def arc(centre: ArrayLike, radii: ArrayLike, start: float, stop: float) -> np.ndarray:
    """Profile rows (13, 2) along an ellipse, from and to an angle in degrees above the horizontal."""
    angle = np.radians(np.linspace(start, stop, 13))[:, None]
    return np.array(centre) + radii * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def bump(x: np.ndarray) -> np.ndarray:
    """1 at x = 0, falling to nothing within |x| of about 2."""
    return np.exp(-(x**2))


def ripples(rng: np.random.Generator, points: np.ndarray, wavelength: float) -> np.ndarray:
    """A smooth random field of mean 0 and variance 1 at points (V, 3): plane waves, 32 random directions."""
    directions = rng.normal(size=(3, 32))
    directions *= 2 * np.pi / wavelength / np.linalg.norm(directions, axis=0)
    phases = rng.uniform(0, 2 * np.pi, 32)
    return np.cos(points @ directions + phases).sum(axis=1) / 4


def choose(rng: np.random.Generator, *colors: tuple[float, float, float]) -> np.ndarray:
    """One of the RGB colours, a little off."""
    return np.clip(rng.choice(colors) + rng.uniform(-0.04, 0.04, 3), 0, 1)


def mix(from_color: np.ndarray, to_color: ArrayLike, weight: np.ndarray) -> np.ndarray:
    """(V, 3) colours between two, RGB (3,) or (V, 3) each; weight (V,) or a number is clipped to [0, 1]."""
    return from_color + np.clip(weight, 0, 1)[..., None] * (np.asarray(to_color) - from_color)
