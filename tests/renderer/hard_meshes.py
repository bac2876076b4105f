"""Meshes that are hard to shade, one color per face, and a rasterizer that shows any face."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from renderer.geometry.mesh import Mesh, concatenate
from renderer.visibility.rasterizers import Rasterizer


@dataclass(frozen=True)
class Chart(Rasterizer):
    """Whose every image is a chart: sample i sees face i, however thin that is."""

    name: str = "chart"
    description: str = "a chart of the faces"

    def rasterize(self, points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool = False) -> np.ndarray:
        ids = np.full((len(points), resolution**2), -1, dtype=np.int32)
        ids[:, : len(faces)] = np.arange(len(faces))
        return ids.reshape(-1, resolution, resolution)


def painted(vertices: ArrayLike, faces: Sequence[Sequence[int]] | np.ndarray) -> Mesh:
    """One color per face, in multiples of 1/64, which every number type holds exactly."""
    colors = np.random.default_rng(0).integers(16, 65, (len(faces), 1, 3)) / 64
    return replace(Mesh.plain(vertices, faces), corner_colors=colors.repeat(3, axis=1).astype(np.float32))


def sphere(subdivisions: int = 2, lowest: float = 0.8) -> Mesh:
    """A dented sphere of 20·4^subdivisions faces, of radius `lowest` to 1."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    rng = np.random.default_rng(1)
    return painted(shape.vertices * rng.uniform(lowest, 1, (len(shape.vertices), 1)), shape.faces)


def slivers(height: float, count: int, towards: np.ndarray) -> Mesh:
    """Needles and flat caps with edges of 1, `count` of each in all three orders of corners, facing a camera."""
    rng = np.random.default_rng(2)
    normal = _unit(rng.normal(size=(2 * count, 3)) + 3 * towards)
    along = _unit(np.cross(normal, rng.normal(size=(2 * count, 3))))
    across = np.cross(normal, along)
    foot = np.repeat([1.0, 0.4], count)[:, None]  # where the third corner is: beside the second, or between the two
    corner = rng.uniform(-1, 1, (2 * count, 3))
    corners = np.stack([corner, corner + along, corner + foot * along + height * across], axis=1)
    orders = [np.roll(corners, shift, axis=1) for shift in range(3)]
    return painted(np.concatenate(orders).reshape(-1, 3), np.arange(18 * count).reshape(-1, 3))


def with_faces_without_area(mesh: Mesh) -> Mesh:
    """Beside each face one on its own first edge, one that is a point, and one with a third corner in mid-edge."""
    mesh = replace(mesh, vertices=mesh.vertices.astype(np.float32).astype(np.float64))  # the middles are then exact
    first, second = mesh.faces[:, 0], mesh.faces[:, 1]
    middle = len(mesh.vertices) + np.arange(len(mesh.faces))
    vertices = np.concatenate([mesh.vertices, (mesh.vertices[first] + mesh.vertices[second]) / 2])
    lines = [(first, second, second), (first, first, first), (first, second, middle)]
    return painted(vertices, np.concatenate([mesh.faces, *(np.stack(line, axis=1) for line in lines)]))


def box() -> Mesh:
    """Its normals are the axes, the harmonics' poles among them."""
    shape = trimesh.creation.box((1.2, 1.0, 0.8))
    return painted(shape.vertices, shape.faces)


def opened(mesh: Mesh) -> Mesh:
    """Without its upper faces, so that the inside is seen."""
    return painted(mesh.vertices, mesh.faces[mesh.vertices[mesh.faces][:, :, 2].mean(axis=1) < 0.2])


def heap() -> Mesh:
    """A ball that touches the plate below it, beside a thin wall: open, self-touching and of several parts."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.4)
    plate = painted([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    wall = painted([[-0.7, -0.8, 0], [-0.7, 0.8, 0], [-0.6, 0.7, 0.9]], [[0, 1, 2]])
    return concatenate([painted(ball.vertices + np.array([0, 0, 0.4]), ball.faces), plate, wall])


def boards() -> Mesh:
    """Five thin boards, 0.03 apart."""
    box = trimesh.creation.box((0.8, 0.8, 0.02))
    return concatenate([painted(box.vertices + np.array([0, 0, 0.05 * each]), box.faces) for each in range(5)])


def non_manifold() -> Mesh:
    """Three faces on one edge, and two tetrahedra that share a corner."""
    fan = [[0, 0, -0.7], [0, 0, 0.7], [0.8, 0, 0], [-0.4, 0.7, 0], [-0.4, -0.7, 0]]
    tips = [[0.3, 0, 0.1], [0, 0.3, 0.2], [0.2, 0.2, 0.5]]
    edge = painted(fan, [[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    bow = painted([[0, 0, 0], *tips, *(-np.array(tips)).tolist()], tetrahedron + [_after(f, 3) for f in tetrahedron])
    return concatenate([edge, bow])


def _after(face: list[int], count: int) -> list[int]:
    """A face of the second tetrahedron, mirrored: the shared corner is the first of both."""
    return [corner + count if corner else 0 for corner in reversed(face)]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


TRIANGLE = painted([[-0.9, -0.8, 0.1], [0.8, -0.5, 0.3], [0.1, 0.9, -0.2]], [[0, 1, 2]])
