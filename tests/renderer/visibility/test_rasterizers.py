"""All rasterizers against one contract, a brute-force oracle and each other."""

import subprocess
import sys
import threading
import tracemalloc
from ctypes.util import find_library
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import moderngl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from renderer.errors import InputError
from renderer.settings import RASTERIZERS
from renderer.visibility import rasterizers
from renderer.visibility.rasterizers import SPAN, Rasterizer, choose, opengl

needs_egl = pytest.mark.skipif(find_library("EGL") is None, reason="no EGL library on this machine")
needs_numba = pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed")
SNAP = 1 / 256  # of a sample: no corner moves further than that
FAR = 2**24 - 1  # depth is a 24-bit key


COMPILED = pytest.param("numba", marks=needs_numba)


@pytest.fixture(scope="module", params=["numpy", COMPILED, pytest.param("opengl", marks=needs_egl)])
def rasterizer(request) -> Rasterizer:
    return choose(request.param)


def triangle(*corners) -> tuple[np.ndarray, np.ndarray]:
    """One view of one triangle or more, three corners each."""
    return np.array([corners], dtype=np.float64), np.arange(len(corners)).reshape(-1, 3)


def rectangle(left, right, bottom, top, z) -> list:
    """Two triangles."""
    a, b, c, d = [left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]
    return [a, b, c, a, c, d]


def random_triangles(seed: int, count: int, reach: float = 1, depth: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
    """One view of triangles with corners at |x|, |y| < reach and |z| < depth."""
    points = np.random.default_rng(seed).uniform(-1, 1, (1, count * 3, 3)) * [reach, reach, depth]
    return points, np.arange(count * 3).reshape(-1, 3)


def rotated_sphere() -> tuple[np.ndarray, np.ndarray]:
    """A random view with faces counter-clockwise outward, mirrored as by a camera: depth runs away from it."""
    sphere, turn = trimesh.creation.icosphere(4, radius=0.9), Rotation.random(rng=np.random.default_rng(3))
    return turn.apply(sphere.vertices)[None] * [1, 1, -1], sphere.faces


def snapped(points: np.ndarray, resolution: int) -> list[tuple[int, int]]:
    """x right, y down from the top left of (V, 2) in 1/256 sample; float32 before and after one multiply-add."""
    half = Fraction(resolution, 2)

    def snap(value: float) -> int:
        return round(float(np.float32(float(half + half * Fraction(value)))) / SNAP)

    return [(snap(x), snap(-y)) for x, y in points.astype(np.float32).tolist()]


def doubled_area(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> int:
    """Positive where a, b and c run clockwise, since y runs down."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def reference(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """(R, R) ids of one view (V, 3) by the contract's words: in Python's integers, each sample of each face in turn.

    A sample is inside if every edge function is positive there or, where one is 0, a little to the right or, where it
    stays 0, a little below. Depth is in float64, on the plane from the corner with the least index.
    """
    points = np.clip(points, -SPAN / resolution, SPAN / resolution)
    positions, depths = snapped(points[:, :2], resolution), ((points[:, 2] + 1) / 2 * FAR).tolist()
    ids, nearest = np.full((resolution, resolution), -1), np.full((resolution, resolution), FAR)
    for index, face in enumerate(faces.tolist()):
        if closed and doubled_area(*(positions[corner] for corner in face)) > 0:
            continue
        (a, b, c), (depth_a, depth_b, depth_c) = (
            [values[corner] for corner in sorted(face)] for values in (positions, depths)
        )
        area = doubled_area(a, b, c)
        sides = [(b, c), (c, a), (a, b)] if area > 0 else [(c, b), (a, c), (b, a)]
        (bx, by), (cx, cy) = ((corner[0] - a[0], corner[1] - a[1]) for corner in (b, c))
        b_rise, c_rise, scale = depth_b - depth_a, depth_c - depth_a, 256 / area if area else 0
        by_column, by_row = (b_rise * cy - c_rise * by) * scale, (c_rise * bx - b_rise * cx) * scale
        for row, column in np.ndindex(ids.shape):
            sample = (column * 256 + 128, row * 256 + 128)
            edges = [doubled_area(p, q, sample) for p, q in sides]
            slopes = [(p[1] - q[1], q[0] - p[0]) for p, q in sides]
            if area and all((edge, *slope) > (0, 0, 0) for edge, slope in zip(edges, slopes, strict=True)):
                right, down = ((value - corner) / 256 for value, corner in zip(sample, a, strict=True))
                depth = round((depth_a + down * by_row) + right * by_column)
                if 0 <= depth < nearest[row, column]:
                    ids[row, column], nearest[row, column] = index, depth
    return ids


@st.composite
def scenes(draw) -> tuple[np.ndarray, np.ndarray, int]:
    """Few corners for many faces: shared edges, duplicates, no area, slivers; tiny, huge and off-screen faces."""
    resolution = draw(st.sampled_from([1, 2, 7, 21]))
    center_or_border = st.integers(-resolution, 3 * resolution).map(lambda index: index / resolution - 1)
    a_little_off = st.integers(-3, 3).map(lambda steps: steps * SNAP / resolution)
    far_away = st.sampled_from([-1e300, -1e4, -20.0, 20.0, 1e4, 1e300])
    coordinate = st.one_of(
        center_or_border, st.builds(float.__add__, center_or_border, a_little_off), st.floats(-1.5, 1.5), far_away
    )
    any_depth = st.one_of(st.integers(-5, 5).map(lambda index: index / 4), st.floats(-1.1, 1.1), far_away)
    depth_within_rounding = st.integers(-8, 8).map(lambda steps: steps / FAR / 4)
    depth = draw(st.sampled_from([any_depth, depth_within_rounding]))
    points = draw(st.lists(st.tuples(coordinate, coordinate, depth), min_size=3, max_size=9))
    corner = st.integers(0, len(points) - 1)
    faces = draw(st.lists(st.tuples(corner, corner, corner), min_size=1, max_size=12))
    return np.array([points]), np.array(faces), resolution


def test_row_0_is_the_top_and_x_runs_right(rasterizer):
    upper_left, right = rectangle(-1, 0, 0, 1, 0), rectangle(0, 1, -1, 1, 0)
    ids = rasterizer.rasterize(*triangle(*upper_left, *right), 4)
    assert ids.dtype == np.int32
    expected = [[0, 0, 1, 1], [0, 0, 1, 1], [-1, -1, 1, 1], [-1, -1, 1, 1]]
    np.testing.assert_array_equal(np.where(ids[0] < 0, -1, ids[0] // 2), expected)


@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize(("order", "turned_away"), [([0, 1, 2], False), ([0, 2, 1], True)])
@pytest.mark.parametrize("size", [1, 2, 100, 1e4])
def test_a_face_fills_the_image_unless_it_turns_away_on_a_closed_mesh(rasterizer, size, order, turned_away, closed):
    points, _ = triangle([-size, -size, 0], [3 * size, -size, 0], [-size, 3 * size, 0])
    expected = -1 if turned_away and closed else 0
    assert (rasterizer.rasterize(points, np.array([order]), 16, closed) == expected).all()


@pytest.mark.parametrize(("closed", "lowest"), [(False, 0), (True, 1)], ids=["open", "closed"])
@pytest.mark.parametrize("turn", range(3))
def test_the_lower_index_wins_ties_between_duplicate_faces(rasterizer, turn, closed, lowest):
    points, face = triangle([-0.9, -0.7, 0.3], [0.8, -0.5, -0.4], [0.1, 0.9, 0.7])
    duplicates = np.concatenate([face[:, ::-1], np.roll(face, turn, axis=1), face, np.roll(face, 1, axis=1)])
    assert set(np.unique(rasterizer.rasterize(points, duplicates, 32, closed))) == {-1, lowest}


@pytest.mark.parametrize("z", [-1.00001, -1.0, 0.99999, 1.0, -1e9])
def test_faces_are_drawn_if_their_depth_is_at_least_minus_1_and_below_1(rasterizer, z):
    drawn = rasterizer.rasterize(*triangle(*rectangle(-1, 1, -1, 1, z)), 8) >= 0
    assert drawn.all() if -1 <= z < 1 else not drawn.any()


def test_a_face_across_the_depth_range_is_clipped_to_it(rasterizer):
    """z = 2x, so that what lies in |x| < 1/2 is in range."""
    ids = rasterizer.rasterize(*triangle([-1, -1, -2], [1, -1, 2], [1, 1, 2], [-1, -1, -2], [1, 1, 2], [-1, 1, -2]), 8)
    np.testing.assert_array_equal(ids[0] >= 0, np.broadcast_to([0, 0, 1, 1, 1, 1, 0, 0], (8, 8)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(rasterizer, value):
    points, faces = triangle([0, 0, 0], [1, 0, 0], [0, value, 0])
    with pytest.raises(ValueError, match="NaN or infinity"):
        rasterizer.rasterize(points, faces, 4)


ON_THE_CPU = ("numpy", "numba") if find_spec("numba") else ("numpy",)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(scene=scenes(), closed=st.booleans())
def test_the_cpu_equals_the_reference_on_any_triangles(scene, closed):
    points, faces, resolution = scene
    expected = reference(points[0], faces, resolution, closed)
    for name in ON_THE_CPU:
        ids = Rasterizer(name, "").rasterize(points, faces, resolution, closed)
        np.testing.assert_array_equal(ids[0], expected)


def test_the_cpu_equals_the_reference_where_the_rounding_of_float64_decides():
    """Huge faces, whose edge functions have more than 53 bits, at a depth halfway between two keys."""
    points, faces = random_triangles(seed=5, count=40, reach=1e5, depth=0)
    faces = np.concatenate([faces, np.roll(faces, 1, axis=1)[::-1]])
    expected = reference(points[0], faces, 16, closed=False)
    for name in ON_THE_CPU:
        np.testing.assert_array_equal(choose(name).rasterize(points, faces, 16)[0], expected)


@needs_numba
@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(0, 3), st.integers(1, 60), st.integers(0, 500)),
    resolution=st.integers(1, 300),
    lattice=st.sampled_from([None, 2, 16, 150]),
    scales=st.tuples(*[st.sampled_from([0, 1e-6, 1e-2, 1, 1.5, 30, 1e5, 1e300])] * 3),
    order=st.sampled_from("CF"),
    closed=st.booleans(),
)
def test_numba_equals_numpy_to_the_bit(seed, shape, resolution, lattice, scales, order, closed):
    """Soups of triangles in several views: huge, thin, degenerate, on samples, out of range, as near as one another."""
    views, vertices, faces = shape
    rng = np.random.default_rng(seed)
    points = np.asarray(rng.uniform(-1, 1, (views, vertices, 3)), order=order)
    if lattice:
        points = np.round(points * lattice) / lattice
    points, triangles = points * scales, np.asarray(rng.integers(0, vertices, (faces, 3)), order=order)
    compiled, plain = (choose(name).rasterize(points, triangles, resolution, closed) for name in ("numba", "numpy"))
    assert compiled.dtype == plain.dtype
    np.testing.assert_array_equal(compiled, plain)


@needs_egl
@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 40),
    resolution=st.integers(1, 70),
    lattice=st.sampled_from([None, 4, 64]),
    closed=st.booleans(),
)
def test_opengl_and_numpy_agree_on_any_triangles(seed, count, resolution, lattice, closed):
    """Coverage exactly; ids but for a few samples where two faces are as near within rounding.

    Inside the image, since Mesa's rasterizer cuts triangles at its border and snaps the new corners.
    """
    points, faces = random_triangles(seed, count)
    if lattice:
        points[..., :2] = np.round(points[..., :2] * lattice) / lattice
    gpu, cpu = (choose(name).rasterize(points, faces, resolution, closed) for name in ("opengl", "numpy"))
    np.testing.assert_array_equal(gpu >= 0, cpu >= 0)
    assert (gpu != cpu).sum() <= 2


@needs_egl
@pytest.mark.skipif(find_spec("triton") is None, reason="Triton is not installed")
def test_triton_can_be_loaded_after_opengl():
    """As by torch's optimizers. Its LLVM must not meet Mesa's already there: in a process of its own, which would
    crash."""
    script = "from renderer.visibility import rasterizers; rasterizers.choose('opengl'); import triton"
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parents[3])


@needs_egl
def test_opengl_draws_in_another_thread():
    points, faces = rotated_sphere()
    rasterizer, drawn = choose("opengl"), []
    thread = threading.Thread(target=lambda: drawn.append(rasterizer.rasterize(points, faces, 32)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(drawn[0], rasterizer.rasterize(points, faces, 32))


def test_numpy_takes_less_memory_than_a_list_of_all_candidates():
    tracemalloc.start()
    ids = choose("numpy").rasterize(*triangle(*rectangle(-1, 1, -1, 1, 0)), 1024)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (ids >= 0).all() and peak < 1024**2 * 5 * 8


GPU, NO_GPU = "NVIDIA H200/PCIe/SSE2", "llvmpipe (LLVM 15.0.6, 256 bits)"


@pytest.mark.parametrize(
    ("asked", "device", "with_numba", "name"),
    [
        pytest.param("auto", GPU, True, "numba", marks=needs_numba),
        pytest.param("auto", None, True, "numba", marks=needs_numba),
        ("auto", GPU, False, "numpy"),
        ("auto", None, False, "numpy"),
        ("opengl", NO_GPU, True, "opengl"),
        ("opengl", None, True, "apt install libegl1 libgl1, or choose the rasterizer numpy"),
        ("numba", GPU, False, "numba cannot be imported .*: pip install numba, or choose the rasterizer numpy"),
        ("numpy", GPU, True, "numpy"),
        ("other", GPU, True, "^rasterizer=other: choose one of auto"),
    ],
)
def test_numba_is_chosen_where_it_is_installed_and_opengl_only_by_name(monkeypatch, asked, device, with_numba, name):
    def fail(**_):
        raise Exception("(detect) libEGL not loaded")

    if device is None:
        monkeypatch.setattr(moderngl, "create_context", fail)
    else:
        monkeypatch.setattr(opengl, "device", lambda: device)
    if not with_numba:
        monkeypatch.setitem(sys.modules, "numba", None)
        monkeypatch.delitem(sys.modules, "renderer.visibility.rasterizers.numba", raising=False)
        monkeypatch.delattr(rasterizers, "numba", raising=False)
    if name in RASTERIZERS:
        assert choose(asked).name == name
    else:
        with pytest.raises(InputError, match=name):
            choose(asked)


@needs_egl
def test_a_driver_that_renders_wrong_ids_is_refused(monkeypatch):
    monkeypatch.setattr(opengl, "VERTEX_SHADER", opengl.VERTEX_SHADER.replace("gl_VertexID / 3", "0"))
    with pytest.raises(InputError, match=r"wrong face ids: choose the rasterizer numpy"):
        choose("opengl")
