"""Both rasterisers against one contract, a brute-force oracle and each other."""

import threading
import tracemalloc
from ctypes.util import find_library

import moderngl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from renderer.errors import InputError
from renderer.visibility import Backend, choose, opengl, rasterise

needs_egl = pytest.mark.skipif(find_library("EGL") is None, reason="no EGL library on this machine")
SNAP = 1 / 256  # of a sample: no corner moves further than that
DEPTH_STEP = 2.0**-22  # of z in [-1, 1]: a 24-bit step is half that, and OpenGL interpolates in float32


@pytest.fixture(params=["software", pytest.param("opengl", marks=needs_egl)])
def backend(request) -> Backend:
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


def sample_centres(resolution: int) -> np.ndarray:
    """(R, R, 2) x and y of every sample, by the contract."""
    steps = (2 * np.arange(resolution) + 1) / resolution - 1
    return np.stack(np.meshgrid(steps, -steps), axis=-1)


def planes(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) a, b, c of z = a·x + b·y + c for one view's faces."""
    corners = points[faces]
    ones = np.ones((*corners.shape[:2], 1))
    return np.linalg.solve(np.concatenate([corners[..., :2], ones], axis=2), corners[..., 2:])[..., 0]


def depth_tolerance(slopes: np.ndarray, resolution: int) -> np.ndarray:
    """What snapping and quantisation may do to the depth on planes with such a, b (..., 2)."""
    return np.linalg.norm(slopes, axis=-1) * 2 * SNAP * 2 / resolution + DEPTH_STEP


def rotated_spheres(views: int) -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    turns = Rotation.random(views, rng=np.random.default_rng(3)).as_matrix()
    return 0.9 * np.einsum("nij,vj->nvi", turns, sphere.vertices), sphere.faces


def test_row_0_is_the_top_and_x_runs_right(backend):
    upper_left, right = rectangle(-1, 0, 0, 1, 0), rectangle(0, 1, -1, 1, 0)
    ids = backend.rasterise(*triangle(*upper_left, *right), 4)
    assert ids.dtype == np.int32
    expected = [[0, 0, 1, 1], [0, 0, 1, 1], [-1, -1, 1, 1], [-1, -1, 1, 1]]
    np.testing.assert_array_equal(np.where(ids[0] < 0, -1, ids[0] // 2), expected)


def test_samples_sit_at_pixel_centres(backend):
    """A rectangle that ends just beyond, or just before, the centres of columns 1 and 6 and rows 2 and 5."""
    inside, outside = np.zeros((8, 8), bool), np.zeros((8, 8), bool)
    inside[2:6, 1:7] = outside[3:5, 2:6] = True
    for nudge, expected in ((0.01, inside), (-0.01, outside)):
        x, y = 5 / 8 + nudge, 3 / 8 + nudge
        ids = backend.rasterise(*triangle(*rectangle(-x, x, -y, y, 0)), 8)
        np.testing.assert_array_equal(ids[0] >= 0, expected)


def test_ids_equal_a_brute_force_oracle_away_from_edges_and_depth_ties(backend):
    resolution = 40
    points, faces = random_triangles(seed=1, count=30, reach=1.3)
    centres = sample_centres(resolution)
    corners = points[0][faces]

    a, b = corners[:, :, :2], np.roll(corners, -1, axis=1)[:, :, :2]  # (F, 3 edges, 2)
    to_sample = centres[:, :, None, None] - a  # (R, R, F, 3, 2)
    along = ((to_sample * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)).clip(0, 1)
    edge_distance = np.linalg.norm(to_sample - along[..., None] * (b - a), axis=-1).min(axis=-1)
    sides = (b - a)[..., 0] * to_sample[..., 1] - (b - a)[..., 1] * to_sample[..., 0]
    covered = (sides > 0).all(axis=-1) | (sides < 0).all(axis=-1)

    plane = planes(points[0], faces)
    depth = np.where(covered, centres @ plane[:, :2].T + plane[:, 2], np.inf)
    expected = np.where(covered.any(axis=-1), depth.argmin(axis=-1), -1)

    margin = depth_tolerance(plane[:, :2], resolution)
    rivals = depth - margin < (depth + margin).min(axis=-1, keepdims=True)
    clear = (edge_distance > 2 * SNAP * 2 / resolution).all(axis=-1) & (rivals.sum(axis=-1) <= 1)
    assert clear.mean() > 0.7
    np.testing.assert_array_equal(backend.rasterise(points, faces, resolution)[0][clear], expected[clear])


def test_shared_edges_are_covered_exactly_once(backend):
    """A triangulated square, with vertices and edges on sample centres and between; a view for each triangle."""
    rng = np.random.default_rng(0)
    lattice = rng.integers(-16, 17, (25, 2)) / 16
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    xy = np.concatenate([square, lattice, rng.uniform(-1, 1, (15, 2))])
    corners = xy[Delaunay(xy).simplices]
    points = np.concatenate([corners, np.zeros((len(corners), 3, 1))], axis=2)
    covered = backend.rasterise(points, np.array([[0, 1, 2]]), 16) >= 0
    np.testing.assert_array_equal(covered.sum(axis=0), 1)


def test_a_sample_on_an_edge_belongs_to_the_face_on_its_right_or_below(backend):
    """A rectangle between the centres of columns 1 and 4 and of rows 2 and 5: the top-left rule."""
    left, right, top, bottom = -5 / 8, 1 / 8, 3 / 8, -3 / 8
    ids = backend.rasterise(*triangle(*rectangle(left, right, bottom, top, 0)), 8)
    expected = np.zeros((8, 8), bool)
    expected[2:5, 1:4] = True
    np.testing.assert_array_equal(ids[0] >= 0, expected)


@pytest.mark.parametrize("order", [[0, 1, 2], [0, 2, 1]], ids=["counter-clockwise", "clockwise"])
def test_faces_are_drawn_from_both_sides(backend, order):
    points, _ = triangle([-1, -1, 0], [3, -1, 0], [-1, 3, 0])
    assert (backend.rasterise(points, np.array([order]), 5) == 0).all()


@pytest.mark.parametrize(("first", "second", "winner"), [(-0.5, 0.5, 0), (0.5, -0.5, 1)])
def test_the_nearer_face_wins_in_either_order(backend, first, second, winner):
    points, faces = triangle(*rectangle(-1, 1, -1, 1, first), *rectangle(-1, 1, -1, 1, second))
    np.testing.assert_array_equal(backend.rasterise(points, faces, 9)[0] // 2, winner)


def test_intersecting_faces_hide_each_other_along_their_line(backend):
    slope = [[-1, -1, -0.5], [1, -1, 0.5], [1, 1, 0.5], [-1, -1, -0.5], [1, 1, 0.5], [-1, 1, -0.5]]
    ids = backend.rasterise(*triangle(*rectangle(-1, 1, -1, 1, 0), *slope), 8)[0]
    np.testing.assert_array_equal(ids // 2, np.broadcast_to(np.arange(8) < 4, (8, 8)))


@pytest.mark.parametrize("turn", range(3))
def test_the_lower_index_wins_ties_between_duplicate_faces(backend, turn):
    points, faces = random_triangles(seed=2, count=1)
    duplicates = np.concatenate([faces, np.roll(faces, turn, axis=1), faces[:, ::-1]])
    ids = backend.rasterise(points, duplicates, 32)
    assert set(np.unique(ids)) == {-1, 0}


def test_the_lower_index_wins_ties_within_a_plane(backend):
    points, faces = random_triangles(seed=3, count=12, depth=0)
    together = backend.rasterise(points, faces, 32)[0]
    alone = np.stack([backend.rasterise(points, face[None], 32)[0] >= 0 for face in faces])
    np.testing.assert_array_equal(together, np.where(alone.any(axis=0), alone.argmax(axis=0), -1))


@pytest.mark.parametrize("z", [-1.0, 0.99999])
def test_faces_at_the_ends_of_the_depth_range_are_drawn(backend, z):
    assert (backend.rasterise(*triangle(*rectangle(-1, 1, -1, 1, z)), 8) >= 0).all()


@pytest.mark.parametrize("z", [-1.00001, 1.0, 1.00001, 50.0, -1e9])
def test_faces_out_of_the_depth_range_are_not_drawn(backend, z):
    assert (backend.rasterise(*triangle(*rectangle(-1, 1, -1, 1, z)), 8) == -1).all()


def test_a_face_across_the_depth_range_is_clipped_to_it(backend):
    """z = 2x, so that what lies in |x| < 1/2 is in range."""
    ids = backend.rasterise(*triangle([-1, -1, -2], [1, -1, 2], [1, 1, 2], [-1, -1, -2], [1, 1, 2], [-1, 1, -2]), 8)
    np.testing.assert_array_equal(ids[0] >= 0, np.broadcast_to([0, 0, 1, 1, 1, 1, 0, 0], (8, 8)))


@pytest.mark.parametrize("shift", [(2.5, 0, 0), (-2.5, 0, 0), (0, 2.5, 0), (0, -2.5, 0), (1e12, 1e300, 0)])
def test_faces_beside_the_picture_leave_it_empty(backend, shift):
    points, faces = rotated_spheres(views=1)
    assert (backend.rasterise(points * 0.5 + shift, faces, 16) == -1).all()


@pytest.mark.parametrize("size", [2, 100, 1e4])
def test_a_face_larger_than_the_picture_covers_it_all(backend, size):
    points, faces = triangle([-size, -size, 0], [3 * size, -size, 0], [-size, 3 * size, 0])
    assert (backend.rasterise(points, faces, 16) == 0).all()


def test_zero_area_faces_are_not_drawn(backend):
    """A point and a segment on sample centres of a 4×4 picture."""
    centre = [0.25, 0.25, 0]
    ids = backend.rasterise(*triangle(centre, centre, centre, [-0.75, 0.25, 0], centre, [0.75, 0.25, 0]), 4)
    assert (ids == -1).all()


def test_every_view_is_drawn_as_if_alone(backend):
    points, faces = rotated_spheres(views=3)
    alone = [backend.rasterise(view[None], faces, 32)[0] for view in points]
    np.testing.assert_array_equal(backend.rasterise(points, faces, 32), alone)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(backend, value):
    points, faces = triangle([0, 0, 0], [1, 0, 0], [0, value, 0])
    with pytest.raises(ValueError, match="NaN or infinity"):
        backend.rasterise(points, faces, 4)


@needs_egl
@pytest.mark.parametrize("resolution", [32, 224, 333])
def test_the_back_ends_agree_on_spheres(resolution):
    """Coverage exactly; ids but for the rounding of depths, in 1 of 100,000 samples or fewer."""
    points, faces = rotated_spheres(views=4)
    gpu, cpu = (rasterise(points, faces, resolution, name) for name in ("opengl", "software"))
    np.testing.assert_array_equal(gpu >= 0, cpu >= 0)
    assert (gpu != cpu).mean() < 2e-5


@needs_egl
@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 40),
    resolution=st.integers(1, 70),
    lattice=st.sampled_from([None, 4, 64]),
)
def test_the_back_ends_agree_on_any_triangles(seed, count, resolution, lattice):
    """Coverage exactly; ids wherever the two faces' depths are not equal within rounding.

    Inside the picture, since Mesa's rasteriser cuts triangles at its border and snaps the new corners.
    """
    points, faces = random_triangles(seed, count)
    if lattice:
        points[..., :2] = np.round(points[..., :2] * lattice) / lattice
    gpu, cpu = (rasterise(points, faces, resolution, name)[0] for name in ("opengl", "software"))
    np.testing.assert_array_equal(gpu >= 0, cpu >= 0)
    row, column = np.nonzero(gpu != cpu)
    rivals = np.stack([gpu[row, column], cpu[row, column]], axis=1)
    plane = planes(points[0], faces[rivals].reshape(-1, 3)).reshape(-1, 2, 3)
    depth = (plane[..., :2] * sample_centres(resolution)[row, column][:, None]).sum(-1) + plane[..., 2]
    tolerance = depth_tolerance(plane[..., :2], resolution).sum(axis=1)
    assert (np.abs(depth[:, 0] - depth[:, 1]) <= tolerance).all()


@needs_egl
def test_opengl_draws_in_another_thread():
    points, faces = rotated_spheres(views=1)
    backend, drawn = choose("opengl"), []
    thread = threading.Thread(target=lambda: drawn.append(backend.rasterise(points, faces, 32)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(drawn[0], backend.rasterise(points, faces, 32))


def test_a_face_of_a_million_samples_takes_bounded_memory():
    """Less than a candidate (face, sample) list of it would take: 5 int64 numbers each."""
    points, faces = triangle(*rectangle(-1, 1, -1, 1, 0))
    tracemalloc.start()
    ids = rasterise(points, faces, 1024, "software")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (ids >= 0).all()
    assert peak < 1024**2 * 5 * 8


@pytest.mark.parametrize(
    ("asked", "device", "name", "description"),
    [
        ("auto", "NVIDIA H200/PCIe/SSE2", "opengl", "opengl (NVIDIA H200/PCIe/SSE2)"),
        ("auto", "llvmpipe (LLVM 15.0.6, 256 bits)", "software", "software (no GPU drives OpenGL)"),
        ("auto", "softpipe", "software", "software (no GPU drives OpenGL)"),
        ("auto", "Google SwiftShader", "software", "software (no GPU drives OpenGL)"),
        ("opengl", "llvmpipe", "opengl", "opengl (llvmpipe)"),
        ("software", "NVIDIA H200/PCIe/SSE2", "software", "software (NumPy)"),
    ],
)
def test_opengl_is_chosen_where_a_gpu_drives_it(monkeypatch, asked, device, name, description):
    monkeypatch.setattr(opengl, "device", lambda: device)
    assert choose(asked) == Backend(name, description)


@pytest.fixture
def no_egl(monkeypatch):
    def fail(**_):
        raise Exception("(detect) libEGL not loaded")

    monkeypatch.setattr(moderngl, "create_context", fail)


def test_without_egl_auto_takes_software_and_says_why(no_egl):
    backend = choose("auto")
    assert backend.name == "software"
    assert backend.description.startswith("software (no EGL device")


def test_without_egl_opengl_is_refused(no_egl):
    with pytest.raises(InputError, match=r"apt install libegl1 libgl1, or renderer\.visibility=software"):
        choose("opengl")


def test_an_unknown_back_end_is_refused():
    with pytest.raises(InputError, match=r"renderer\.visibility=vulkan: choose one of auto, opengl, software"):
        choose("vulkan")


@needs_egl
def test_a_driver_that_renders_wrong_ids_is_refused(monkeypatch):
    monkeypatch.setattr(opengl, "VERTEX_SHADER", opengl.VERTEX_SHADER.replace("gl_VertexID / 3", "0"))
    with pytest.raises(InputError, match=r"wrong face ids: set renderer\.visibility=software"):
        choose("opengl")
