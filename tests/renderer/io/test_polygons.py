"""Polygons are divided into triangles that cover them exactly."""

import numpy as np
import pytest
from trimesh.triangles import area, cross

from renderer.io.mesh_file import triangulate


def shoelace(points: np.ndarray) -> float:
    x, y = points.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def star_shaped(rng: np.random.Generator) -> np.ndarray:
    """Return a random simple polygon around the origin, with corners on straight edges."""
    count = rng.integers(4, 15)
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(0, 0.9, count)) / count
    points = rng.uniform(0.1, 1, (count, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    middles = (points + np.roll(points, -1, axis=0)) / 2
    with_middles = np.stack([points, middles], axis=1).reshape(-1, 2)
    return with_middles[(rng.random((count, 2)) < [1, 0.3]).ravel()]


def comb(rng: np.random.Generator) -> np.ndarray:
    """Return a random simple polygon with many teeth, of which no point sees all."""
    heights = rng.uniform(0.2, 1, 2 * rng.integers(2, 9) + 1) * np.tile([1, 5], 10)[:1]
    heights[::2] += 3
    x = np.arange(len(heights))
    return np.array([[0, 0], [x[-1], 0], *zip(x[::-1], heights[::-1], strict=True)])


def in_space(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.5 else np.eye(3)
    return points @ rng.permutation(axes)[:2] + rng.normal(size=3)


@pytest.mark.parametrize("make", [star_shaped, comb])
def test_triangles_cover_the_area_of_the_shoelace_formula_and_keep_all_edges(make):
    rng = np.random.default_rng(0)
    for _ in range(100):
        points = make(rng)
        corners = in_space(points, rng)
        triangles, _, crossing_count = triangulate(corners, np.array([len(points)]))
        # Triangles that leave the polygon would have a larger sum of areas.
        assert area(corners[triangles]).sum() == pytest.approx(shoelace(points))
        turned = cross(corners[triangles]).sum(axis=0) / 2
        assert np.linalg.norm(turned) == pytest.approx(shoelace(points))
        assert crossing_count == 0
        sides = {tuple(side) for side in triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)}
        boundary = {(a, b) for a, b in sides if (b, a) not in sides}
        indices = np.arange(len(points))
        assert boundary == set(zip(indices, np.roll(indices, -1), strict=True))


def test_polygons_of_all_sizes_are_triangulated_together():
    rng = np.random.default_rng(1)
    polygons = [star_shaped(rng) for _ in range(20)] + [np.eye(3)[:, :2]] * 2
    order = rng.permutation(len(polygons))
    corners = np.concatenate([in_space(polygons[index], rng) for index in order])
    sizes = np.array([len(polygons[index]) for index in order])
    triangles, owners, _ = triangulate(corners, sizes)
    found = np.bincount(owners, area(corners[triangles]))
    expected = [abs(shoelace(polygons[index])) for index in order]
    assert found == pytest.approx(np.array(expected))
    assert (np.diff(owners) >= 0).all()


def test_a_polygon_with_a_bridge_to_its_hole_leaves_the_hole_open():
    outer = [[0, 0], [4, 0], [4, 4], [0, 4]]
    hole = [[1, 1], [1, 3], [3, 3], [3, 1]]
    points = np.array([*outer, outer[0], hole[0], *hole[1:], hole[0]], dtype=float)
    corners = np.column_stack([points, np.zeros(len(points))])
    triangles, _, _ = triangulate(corners, np.array([len(points)]))
    assert area(corners[triangles]).sum() == pytest.approx(12)


def test_a_polygon_that_intersects_itself_is_counted():
    crossed = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float)
    assert triangulate(crossed, np.array([4]))[2] == 1


def test_a_polygon_without_area_gives_triangles_without_area():
    line = np.arange(5)[:, None] * np.ones(3)
    triangles, _, _ = triangulate(line, np.array([5]))
    assert not area(line[triangles]).any()
