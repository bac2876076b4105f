"""Meshes that are hard to shade, with one color per face, and a rasterizer that shows any face."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from numpy.typing import ArrayLike
from torch import Tensor
from trimesh.util import unitize

from renderer.camera import Points
from renderer.mesh import Mesh, concatenate
from renderer.settings import height_and_width
from renderer.visibility import Rasterizer

NO_FACE = -1


@dataclass(frozen=True)
class Chart(Rasterizer):
    """Rasterizer whose sample i sees face i, however thin the face is."""

    name: str = "chart"
    description: str = "a chart of the faces"

    def rasterize(self, points, faces, resolution, closed=False) -> Points:
        shape = height_and_width(resolution)
        ids = np.full((len(points), math.prod(shape)), NO_FACE, dtype=np.int32)
        ids[:, : len(faces)] = np.arange(len(faces))
        ids = ids.reshape(-1, *shape)
        return torch.from_numpy(ids) if isinstance(points, Tensor) else ids


def painted(vertices: ArrayLike, faces: Sequence[Sequence[int]] | np.ndarray) -> Mesh:
    """Create a mesh with one random color per face, a multiple of 1/64, which every type holds."""
    colors = np.random.default_rng(0).integers(16, 65, (len(faces), 1, 3)) / 64
    corner_colors = colors.repeat(3, axis=1).astype(np.float32)
    return replace(Mesh.plain(vertices, faces), corner_colors=corner_colors)


def sphere(subdivisions: int = 2, lowest: float = 0.8) -> Mesh:
    """Create a dented sphere of 20 · 4^subdivisions faces, with radii from `lowest` to 1."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    radii = np.random.default_rng(1).uniform(lowest, 1, (len(shape.vertices), 1))
    return painted(shape.vertices * radii, shape.faces)


def slivers(height: float, count: int, towards: np.ndarray) -> Mesh:
    """Create needles and caps in all orders of corners, whose longest edges are about 1."""
    rng = np.random.default_rng(2)
    shape = (2 * count, 3)
    normal = unitize(rng.normal(size=shape) + 3 * towards)
    along = unitize(np.cross(normal, rng.normal(size=shape)))
    across = np.cross(normal, along)
    # Position of the third corner along the edge between the other two.
    foot = np.repeat([1.0, 0.4], count)[:, None]
    first = rng.uniform(-1, 1, shape)
    second = first + along
    third = first + foot * along + height * across
    corners = np.stack([first, second, third], axis=1)
    orders = [np.roll(corners, shift, axis=1) for shift in range(3)]
    vertices = np.concatenate(orders).reshape(-1, 3)
    return painted(vertices, np.arange(len(vertices)).reshape(-1, 3))


def with_faces_without_area(mesh: Mesh) -> Mesh:
    """Add an edge, a point, and an edge with its center as faces for each face of a mesh."""
    # Sums of two float32 numbers are exact in float64, and so are the centers.
    vertices = mesh.vertices.astype(np.float32).astype(np.float64)
    first = mesh.faces[:, 0]
    second = mesh.faces[:, 1]
    centers = (vertices[first] + vertices[second]) / 2
    center = len(vertices) + np.arange(len(mesh.faces))
    edges = np.stack([first, second, second], axis=1)
    points = np.stack([first, first, first], axis=1)
    divided_edges = np.stack([first, second, center], axis=1)
    return painted(
        np.concatenate([vertices, centers]),
        np.concatenate([mesh.faces, edges, points, divided_edges]),
    )


def box() -> Mesh:
    shape = trimesh.creation.box((1.2, 1.0, 0.8))
    return painted(shape.vertices, shape.faces)


def opened(mesh: Mesh) -> Mesh:
    heights = mesh.vertices[mesh.faces][:, :, 2].mean(axis=1)
    return painted(mesh.vertices, mesh.faces[heights < 0.2])


def heap() -> Mesh:
    """Create a ball that touches a plate, and a thin wall beside it."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.4)
    lifted_ball = painted(ball.vertices + np.array([0, 0, 0.4]), ball.faces)
    plate = painted([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    wall = painted([[-0.7, -0.8, 0], [-0.7, 0.8, 0], [-0.6, 0.7, 0.9]], [[0, 1, 2]])
    return concatenate([lifted_ball, plate, wall])


def boards() -> Mesh:
    board = trimesh.creation.box((0.8, 0.8, 0.02))
    heights = [0.0, 0.05, 0.1, 0.15, 0.2]
    lifted = [board.vertices + np.array([0, 0, height]) for height in heights]
    return concatenate([painted(vertices, board.faces) for vertices in lifted])
