"""All rasterizers against one contract, a brute-force reference and each other."""

import tracemalloc
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from ctypes.util import find_library
from fractions import Fraction
from typing import NamedTuple

import moderngl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from renderer.errors import InputError
from renderer.visibility import SPAN, Rasterizer, choose, opengl
from renderer.visibility.torch import rasterize

needs_egl = pytest.mark.skipif(find_library("EGL") is None, reason="no EGL library on this machine")
ON_THE_CPU = ("numpy", "torch", "numba")

# Corners are rounded to this number of parts of a sample.
PARTS = 256
# The largest depth, which is a key of 24 bits.
FAR = 2**24 - 1
NO_FACE = -1


@pytest.fixture(scope="module", params=[*ON_THE_CPU, pytest.param("opengl", marks=needs_egl)])
def rasterizer(request) -> Rasterizer:
    return choose(request.param)


class Scene(NamedTuple):
    """Triangles (F, 3) of vertices as N views project them, shape (N, V, 3)."""

    points: np.ndarray
    faces: np.ndarray


def scene_of(*corners: list[float]) -> Scene:
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Scene(np.array([corners], dtype=np.float64), faces)


def rectangle(left: float, right: float, bottom: float, top: float, z: float) -> list[list[float]]:
    a, b, c, d = (
        [x, y, z] for x, y in ((left, bottom), (right, bottom), (right, top), (left, top))
    )
    return [a, b, c, a, c, d]


def random_triangles(seed: int, count: int, reach: float = 1, depth: float = 0.9) -> Scene:
    corners = np.random.default_rng(seed).uniform(-1, 1, (1, count * 3, 3))
    faces = np.arange(count * 3).reshape(-1, 3)
    return Scene(corners * [reach, reach, depth], faces)


class Point(NamedTuple):
    """Position in an image in 1/256 of a sample. x grows to the right, y grows downward."""

    x: int
    y: int


def rounded_coordinate(value: float, resolution: int) -> int:
    """Convert to 1/256 of a sample, with one multiply-add in float32."""
    half = Fraction(resolution, 2)
    sample = float(np.float32(float(half + half * Fraction(float(np.float32(value))))))
    return round(sample * PARTS)


def doubled_area(a: Point, b: Point, c: Point) -> int:
    """Compute twice the area of a triangle. It is positive if a, b and c run clockwise."""
    return (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)


def reference(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Rasterize as the contract says: a sample on an edge counts if what is right or below does."""
    points = np.clip(points, -SPAN / resolution, SPAN / resolution)
    positions = [
        Point(rounded_coordinate(x, resolution), rounded_coordinate(-y, resolution))
        for x, y, _ in points.tolist()
    ]
    depths = ((points[:, 2] + 1) / 2 * FAR).tolist()
    ids = np.full((resolution, resolution), NO_FACE)
    nearest = np.full((resolution, resolution), FAR)
    for index, face in enumerate(faces.tolist()):
        a, b, c = (positions[corner] for corner in sorted(face))
        area = doubled_area(a, b, c)
        if area == 0 or (closed and doubled_area(*(positions[corner] for corner in face)) > 0):
            continue
        edges = [(b, c), (c, a), (a, b)] if area > 0 else [(c, b), (a, c), (b, a)]
        # Depth lies on the plane from the corner with the lowest index, in float64.
        depth, *others = (depths[corner] for corner in sorted(face))
        b_rise, c_rise = (other - depth for other in others)
        rise_by_column = (b_rise * (c.y - a.y) - c_rise * (b.y - a.y)) * (PARTS / area)
        rise_by_row = (c_rise * (b.x - a.x) - b_rise * (c.x - a.x)) * (PARTS / area)
        for row, column in np.ndindex(ids.shape):
            sample = Point(column * PARTS + PARTS // 2, row * PARTS + PARTS // 2)
            sides = [
                (doubled_area(start, end, sample), start.y - end.y, end.x - start.x)
                for start, end in edges
            ]
            if min(sides) <= (0, 0, 0):
                continue
            columns, rows = (sample.x - a.x) / PARTS, (sample.y - a.y) / PARTS
            found = round((depth + rows * rise_by_row) + columns * rise_by_column)
            if 0 <= found < nearest[row, column]:
                ids[row, column] = index
                nearest[row, column] = found
    return ids


FAR_AWAY = st.sampled_from([-1e300, -1e4, -20.0, 20.0, 1e4, 1e300])


def coordinates(resolution: int) -> st.SearchStrategy[float]:
    """Draw x or y: at samples or at their borders, close to these, anywhere, and far away."""
    half_sample = st.integers(-resolution, 3 * resolution)
    center_or_border = half_sample.map(lambda index: index / resolution - 1)
    offset = st.integers(-3, 3).map(lambda steps: steps / PARTS / resolution)
    close_by = st.builds(float.__add__, center_or_border, offset)
    return st.one_of(center_or_border, close_by, st.floats(-1.5, 1.5), FAR_AWAY)


def depths() -> st.SearchStrategy[float]:
    quarter = st.integers(-5, 5).map(lambda index: index / 4)
    return st.one_of(quarter, st.floats(-1.1, 1.1), FAR_AWAY)


@st.composite
def small_images(draw) -> tuple[Scene, int]:
    """Draw faces that share edges, occur twice, have no area, are thin, tiny, huge or outside."""
    resolution = draw(st.sampled_from([1, 2, 7, 21]))
    coordinate = coordinates(resolution)
    nearly_equal = st.integers(-8, 8).map(lambda steps: steps / FAR / 4)
    depth = draw(st.sampled_from([depths(), nearly_equal]))
    point = st.tuples(coordinate, coordinate, depth)
    points = draw(st.lists(point, min_size=3, max_size=9))
    corner = st.integers(0, len(points) - 1)
    face = st.tuples(corner, corner, corner)
    faces = draw(st.lists(face, min_size=1, max_size=12))
    return Scene(np.array([points]), np.array(faces)), resolution


def test_row_0_is_the_top_and_x_grows_to_the_right(rasterizer):
    upper_left = rectangle(-1, 0, 0, 1, 0)
    right = rectangle(0, 1, -1, 1, 0)
    points, faces = scene_of(*upper_left, *right)
    [ids] = rasterizer.rasterize(points, faces, 4)
    assert ids.dtype == np.int32
    rectangle_of_sample = np.where(ids < 0, NO_FACE, ids // 2)
    expected = [[0, 0, 1, 1], [0, 0, 1, 1], [-1, -1, 1, 1], [-1, -1, 1, 1]]
    np.testing.assert_array_equal(rectangle_of_sample, expected)


@pytest.mark.parametrize("size", [1, 2, 100, 1e4])
def test_a_face_fills_the_image_unless_it_turns_away_on_a_closed_mesh(rasterizer, size):
    points, _ = scene_of([-size, -size, 0], [3 * size, -size, 0], [-size, 3 * size, 0])
    for order, is_turned_away in (([0, 1, 2], False), ([0, 2, 1], True)):
        for closed in (False, True):
            ids = rasterizer.rasterize(points, np.array([order]), 16, closed)
            assert (ids == (NO_FACE if is_turned_away and closed else 0)).all()


@pytest.mark.parametrize(("turn", "closed", "lowest"), [(0, False, 0), (1, True, 1), (2, True, 1)])
def test_the_lower_index_wins_ties_between_duplicate_faces(rasterizer, turn, closed, lowest):
    points, face = scene_of([-0.9, -0.7, 0.3], [0.8, -0.5, -0.4], [0.1, 0.9, 0.7])
    turned_away = face[:, ::-1]
    turned = np.roll(face, turn, axis=1)
    duplicates = np.concatenate([turned_away, turned, face, np.roll(face, 1, axis=1)])
    ids = rasterizer.rasterize(points, duplicates, 32, closed)
    assert set(np.unique(ids)) == {NO_FACE, lowest}


def test_faces_are_drawn_from_depth_minus_1_to_below_1(rasterizer):
    for z, is_drawn in ((-1e9, 0), (-1.00001, 0), (-1.0, 1), (0.99999, 1), (1.0, 0)):
        points, faces = scene_of(*rectangle(-1, 1, -1, 1, z))
        assert ((rasterizer.rasterize(points, faces, 8) >= 0) == is_drawn).all()


def test_a_face_across_the_depth_range_is_clipped_to_it(rasterizer):
    """With z = 2x, the range contains |x| < 1/2."""
    points, faces = scene_of(*rectangle(-1, 1, -1, 1, 0))
    points[..., 2] = 2 * points[..., 0]
    [ids] = rasterizer.rasterize(points, faces, 8)
    is_covered_column = [False, False, True, True, True, True, False, False]
    np.testing.assert_array_equal(ids >= 0, np.tile(is_covered_column, (8, 1)))


@given(image=small_images(), closed=st.booleans())
def test_the_cpu_equals_the_reference_on_any_triangles(image, closed):
    (points, faces), resolution = image
    expected = reference(points[0], faces, resolution, closed)
    for name in ON_THE_CPU:
        [ids] = Rasterizer(name, "").rasterize(points, faces, resolution, closed)
        np.testing.assert_array_equal(ids, expected)


def test_the_cpu_equals_the_reference_where_the_rounding_of_float64_decides():
    """The edge functions of huge faces have more than 53 bits. The depth is between two keys."""
    points, faces = random_triangles(seed=5, count=40, reach=1e5, depth=0)
    reordered = np.roll(faces, 1, axis=1)[::-1]
    all_faces = np.concatenate([faces, reordered])
    expected = reference(points[0], all_faces, 16, closed=False)
    for name in ON_THE_CPU:
        [ids] = choose(name).rasterize(points, all_faces, 16)
        np.testing.assert_array_equal(ids, expected)


@given(
    seed=st.integers(0, 2**32 - 1),
    view_count=st.integers(0, 3),
    vertex_count=st.integers(1, 60),
    face_count=st.integers(0, 150),
    resolution=st.integers(1, 100),
    lattice=st.sampled_from([None, 2, 16, 150]),
    scales=st.tuples(*[st.sampled_from([0, 1e-6, 1e-2, 1, 1.5, 30, 1e5, 1e300])] * 3),
    order=st.sampled_from("CF"),
    closed=st.booleans(),
)
def test_numba_and_torch_equal_numpy_to_the_bit(
    seed, view_count, vertex_count, face_count, resolution, lattice, scales, order, closed
):
    """Triangles are huge, thin, without area, at samples, out of range, and at equal depths."""
    rng = np.random.default_rng(seed)
    points = np.asarray(rng.uniform(-1, 1, (view_count, vertex_count, 3)), order=order)
    if lattice is not None:
        points = np.round(points * lattice) / lattice
    points = points * scales
    faces = np.asarray(rng.integers(0, vertex_count, (face_count, 3)), order=order)
    plain = choose("numpy").rasterize(points, faces, resolution, closed)
    for name in ("numba", "torch"):
        other = choose(name).rasterize(points, faces, resolution, closed)
        assert other.dtype == plain.dtype
        np.testing.assert_array_equal(other, plain)


@pytest.mark.parametrize("closed", [False, True])
def test_torch_draws_the_same_faces_in_small_tiles(monkeypatch, closed):
    points, faces = random_triangles(3, 40)
    faces = np.concatenate([faces, faces])  # Of equally near faces, the first counts.
    monkeypatch.setattr("renderer.visibility.torch.FACES_PER_TILE", 7)
    plain, tiled = (
        choose(name).rasterize(points, faces, 33, closed) for name in ("numpy", "torch")
    )
    np.testing.assert_array_equal(tiled, plain)


def test_torch_waits_for_a_gpu_once_and_copies_no_constants_there():
    points, faces = map(torch.from_numpy, random_triangles(3, 40))
    with torch.autograd.profiler.profile() as profile:
        rasterize(points, faces, (33, 20), closed=False)
    names = Counter(event.name for event in profile.function_events)
    assert names["aten::_local_scalar_dense"] == 1
    assert names["aten::mul"] > 0 == names["aten::lift_fresh"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_auto_draws_on_a_gpu_what_numpy_draws():
    points, faces = random_triangles(seed=11, count=500)
    ids = choose("auto").rasterize(torch.from_numpy(points).cuda(), faces, (90, 70))
    assert ids.is_cuda
    np.testing.assert_array_equal(ids.cpu(), choose("numpy").rasterize(points, faces, (90, 70)))


@needs_egl
@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 40),
    resolution=st.integers(1, 70),
    lattice=st.sampled_from([None, 4, 64]),
    closed=st.booleans(),
)
def test_opengl_and_numpy_agree_on_any_triangles(seed, count, resolution, lattice, closed):
    """All corners lie inside the image, because Mesa cuts triangles at its border and rounds."""
    points, faces = random_triangles(seed, count)
    if lattice is not None:
        points[..., :2] = np.round(points[..., :2] * lattice) / lattice
    gpu = choose("opengl").rasterize(points, faces, resolution, closed)
    cpu = choose("numpy").rasterize(points, faces, resolution, closed)
    np.testing.assert_array_equal(gpu >= 0, cpu >= 0)
    assert (gpu != cpu).sum() <= 2


@needs_egl
def test_opengl_draws_in_another_thread():
    points, faces = random_triangles(seed=3, count=40)
    rasterizer = choose("opengl")
    with ThreadPoolExecutor(1) as pool:
        ids = pool.submit(rasterizer.rasterize, points, faces, 32).result()
    np.testing.assert_array_equal(ids, rasterizer.rasterize(points, faces, 32))


def test_numpy_takes_less_memory_than_a_list_of_all_candidates():
    """The list would hold five numbers of 8 bytes for each sample."""
    points, faces = scene_of(*rectangle(-1, 1, -1, 1, 0))
    rasterizer = choose("numpy")
    tracemalloc.start()
    ids = rasterizer.rasterize(points, faces, 1024)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (ids >= 0).all()
    assert peak < 1024**2 * 5 * 8


def test_opengl_cannot_be_chosen_without_a_device(monkeypatch):
    def fail(**_) -> None:
        raise Exception("(detect) libEGL not loaded")

    monkeypatch.setattr(moderngl, "create_context", fail)
    with pytest.raises(InputError, match="EGL"):
        choose("opengl")


@needs_egl
def test_a_driver_that_renders_wrong_ids_is_refused(monkeypatch):
    wrong_shader = opengl.VERTEX_SHADER.replace("gl_VertexID / 3", "0")
    monkeypatch.setattr(opengl, "VERTEX_SHADER", wrong_shader)
    with pytest.raises(InputError, match="wrong faces"):
        choose("opengl")
