"""Files of COLMAP and nerfstudio that the tests write, compared with scipy's rotations."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import renderer
from renderer.errors import InputError

POINTS = np.random.default_rng(0).uniform(-1, 1, (20, 3))
FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y = 80.0, 85.0, 52.0, 31.0
WIDTH, HEIGHT = 100, 60
ROTATIONS = Rotation.random(2, random_state=0)
TRANSLATIONS = np.array([[0.1, -0.2, 4.0], [0.3, 0.2, 5.0]])
NAMES = ["front.png", "from the side.png"]


def expected_positions(view: int, focal_y: float = FOCAL_Y) -> np.ndarray:
    """Project POINTS to the central square of an image, x right and y up in [-1, 1]."""
    x, y, depth = (ROTATIONS[view].apply(POINTS) + TRANSLATIONS[view]).T
    column = FOCAL_X * x / depth + CENTER_X
    row = focal_y * y / depth + CENTER_Y
    return np.stack([column - WIDTH / 2, HEIGHT / 2 - row], axis=1) / (HEIGHT / 2)


def write_colmap(folder, model, parameters, points_of_images=("", "1.5 2.5 -1 3.5 4.5 12")) -> None:
    """Write two images of one camera; `points_of_images` is the second line of each, or None."""
    values = " ".join(map(str, parameters))
    camera = f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n7 {model} {WIDTH} {HEIGHT} {values}\n"
    (folder / "cameras.txt").write_text(camera)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for view, points in enumerate(points_of_images):
        quaternion = ROTATIONS[view].as_quat(scalar_first=True)
        numbers = " ".join(map(str, [*quaternion, *TRANSLATIONS[view]]))
        lines.append(f"{view + 1} {numbers} 7 {NAMES[view]}")
        lines += [] if points is None else points.split("\n")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def write_transforms(path: Path, of_frame: dict[str, Any] | None = None, **entries: Any) -> None:
    """Write the two views as transforms.json, whose matrices are those from camera to world.

    `of_frame` has entries of the second frame. An entry of `...` is left out.
    """
    frames: list[dict[str, Any]] = []
    for view, name in enumerate(NAMES):
        pose = np.eye(4)
        from_camera = ROTATIONS[view].inv()
        # The camera has y up and z backward.
        pose[:3, :3] = from_camera.as_matrix() @ np.diag([1, -1, -1])
        pose[:3, 3] = -from_camera.apply(TRANSLATIONS[view])
        frames.append({"file_path": name, "transform_matrix": pose[: 3 + len(frames) % 2].tolist()})
    frames[1] |= of_frame or {}
    scene = {"frames": frames, "w": WIDTH, "h": HEIGHT, **entries}
    path.write_text(json.dumps({key: value for key, value in scene.items() if value is not ...}))


CENTER = {"cx": CENTER_X, "cy": CENTER_Y}
ANGLE_X = 2 * math.atan(WIDTH / 2 / FOCAL_X)


def require_expected(path: Path, focal_y: float = FOCAL_Y) -> None:
    cameras = renderer.load_cameras(path)
    assert [*cameras] == NAMES
    for view, camera in enumerate(cameras.values()):
        found = camera.project(POINTS)[:, :2]
        np.testing.assert_allclose(found, expected_positions(view, focal_y), atol=1e-9)


def test_a_transposed_matrix_is_refused(tmp_path):
    write_transforms(tmp_path / "transforms.json", fl_x=FOCAL_X, fl_y=FOCAL_Y)
    content = json.loads((tmp_path / "transforms.json").read_text())
    matrix = np.array(content["frames"][0]["transform_matrix"])
    matrix = np.vstack([matrix, [0, 0, 0, 1]])[:4]
    content["frames"][0]["transform_matrix"] = matrix.T.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="rotation"):
        renderer.load_cameras(tmp_path / "transforms.json")


@pytest.mark.parametrize(
    "points",
    [
        (None, None),
        ("", "1.5 2.5 -1 3.5 4.5 12"),
        ("# comment", "  # comment"),
        ("\n# comment", None),
        ("100 200 7 3 4 8 5 6 9 10 11 12", "1 2 3 4 5 6 7 8 9"),
        ("1e2 2.5 -1", "1 2 -1\n\n"),
        ("1.5 2.5 18446744073709551615", None),
    ],
)
def test_images_of_colmap_are_read_with_and_without_their_lines_of_points(tmp_path, points):
    write_colmap(tmp_path, "PINHOLE", [FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y], points)
    require_expected(tmp_path)


def test_a_line_of_colmap_ends_only_at_a_line_feed(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.NAMES", ["a\x85b.png", "a\u2028b.png"])
    write_colmap(tmp_path, "PINHOLE", [FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y])
    require_expected(tmp_path)


OTHER_KINDS = {"is_fisheye": True, "ortho_scale": 2.5, "rolling_shutter": [0, 0, 0.1, 0]}
OTHER_KINDS |= {"ftheta_p1": 0.4, "camera_type": "fisheye", "camera_model": "OPENCV_FISHEYE"}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        *(({key: value}, key) for key, value in OTHER_KINDS.items()),
        *(({"of_frame": {key: value}}, key) for key, value in OTHER_KINDS.items()),
        ({"of_frame": {"file_path": NAMES[0]}}, r"a\.json: front\.png occurs twice"),
        ({"of_frame": {"file_path": None}}, "file_path"),
        ({"k1": 0.1}, "undistort"),
        ({"camera_angle_x": ..., "fl_x": FOCAL_X, "w": ..., "h": ...}, "image size"),
        ({"camera_angle_x": ...}, "no focal length"),
        ({"camera_angle_x": ..., "fl_x": 0, "fl_y": FOCAL_Y}, "intrinsics"),
    ],
)
def test_transforms_that_describe_no_pinhole_cameras_with_names_are_refused(
    tmp_path, entries, message
):
    path = tmp_path / "a.json"
    write_transforms(path, **{"camera_angle_x": 1.0} | entries)
    with pytest.raises(InputError, match=message):
        renderer.load_cameras(path)


def test_entries_that_change_no_image_are_ignored(tmp_path):
    """Poses stay in the coordinates of the file, whatever was applied to them before."""
    ignored = {"is_fisheye": False, "ortho_scale": None, "rolling_shutter": [0, 0, 0, 0]}
    ignored |= {"aabb_scale": 16, "scale": 0.5, "offset": [1, 2, 3], "applied_scale": 0.25}
    angles = {"camera_angle_x": ANGLE_X, "camera_angle_y": 2 * math.atan(HEIGHT / 2 / FOCAL_Y)}
    write_transforms(tmp_path / "a.json", **angles, **ignored, **CENTER)
    require_expected(tmp_path / "a.json")


def test_a_simple_pinhole_has_one_focal_length(tmp_path):
    write_colmap(tmp_path, "SIMPLE_PINHOLE", [FOCAL_X, CENTER_X, CENTER_Y])
    require_expected(tmp_path, focal_y=FOCAL_X)


def test_points_are_where_cameras_of_nerfstudio_see_them(tmp_path):
    write_transforms(tmp_path / "transforms.json", fl_x=FOCAL_X, fl_y=FOCAL_Y, k1=0.0, **CENTER)
    require_expected(tmp_path)
    require_expected(tmp_path / "transforms.json")
    write_transforms(tmp_path / "a.json", camera_angle_x=ANGLE_X, **CENTER)
    require_expected(tmp_path / "a.json", focal_y=FOCAL_X)


def test_an_angle_of_a_frame_overrides_the_focal_lengths_of_the_scene(tmp_path):
    path = tmp_path / "a.json"
    of_frame = {"camera_angle_x": ANGLE_X}
    write_transforms(path, of_frame, fl_x=3 * FOCAL_X, fl_y=9 * FOCAL_Y, **CENTER)
    found = renderer.load_cameras(path)[NAMES[1]].project(POINTS)[:, :2]
    np.testing.assert_allclose(found, expected_positions(1, FOCAL_X), atol=1e-9)


@pytest.mark.parametrize("suffix", [".png", ""])
def test_without_a_size_that_of_the_images_counts_or_that_of_both_angles(tmp_path, suffix):
    """Without both, images are square. A camera of an image shows its central square."""
    angle_y = 2 * math.atan(HEIGHT / 2 / FOCAL_X)
    sized, other = tmp_path / "sized.json", tmp_path / "other.json"
    write_transforms(sized, camera_angle_x=ANGLE_X)
    expected = [*renderer.load_cameras(sized).values()]
    scene = json.loads(sized.read_text())
    del scene["w"], scene["h"]
    for frame in scene["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png") + suffix

    def project() -> list[np.ndarray]:
        return [camera.project(POINTS) for camera in renderer.load_cameras(other).values()]

    other.write_text(json.dumps(scene | {"camera_angle_y": angle_y}))
    np.testing.assert_allclose(project(), [each.project(POINTS) for each in expected], atol=1e-5)
    del scene["camera_angle_x"]
    # The image is wider than high, so its angle of y is that of its central square.
    for angles, is_same in (
        ({"camera_angle_x": ANGLE_X}, 0),
        ({"camera_angle_y": angle_y, "h": 9}, 1),
    ):
        other.write_text(json.dumps(scene | angles))
        with pytest.warns(UserWarning, match="images are square"):
            found = project()
        assert np.allclose(found[0], expected[0].project(POINTS), atol=1e-5) == is_same
    other.write_text(json.dumps(scene | {"camera_angle_x": ANGLE_X}))
    for name in NAMES:
        Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / name)
    np.testing.assert_allclose(project(), [each.project(POINTS) for each in expected], atol=1e-9)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"frames": []}', '{"frames": [{}]}'])
def test_damaged_transforms_are_refused(tmp_path, content):
    path = tmp_path / "transforms.json"
    path.write_text(content)
    with pytest.raises(InputError, match=str(path)):
        renderer.load_cameras(path)


PARAMETERS = [FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y]


@pytest.mark.parametrize(
    ("model", "parameters", "names", "message"),
    [
        ("OPENCV", [*PARAMETERS, 0.1, 0, 0, 0], NAMES, "undistort"),
        ("PINHOLE", [FOCAL_X], NAMES, r"cameras\.txt"),
        ("PINHOLE", PARAMETERS, ["a b.png"] * 2, r"images\.txt: a b\.png occurs twice"),
        ("PINHOLE", PARAMETERS, ["", ""], r"images\.txt"),
    ],
)
def test_files_of_colmap_that_are_damaged_or_of_distorted_cameras_are_refused(
    tmp_path, monkeypatch, model, parameters, names, message
):
    monkeypatch.setattr(f"{__name__}.NAMES", names)
    write_colmap(tmp_path, model, parameters)
    with pytest.raises(InputError, match=message):
        renderer.load_cameras(tmp_path)


def test_missing_files_of_colmap_are_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        renderer.load_cameras(tmp_path)
