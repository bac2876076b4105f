"""The folder of the laboratory, its random draws, and its photographs against closed forms."""

import csv
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh

from augment.scene import patterns
from augment.scene.patterns import LAB_PATTERNS, draw_lab_pattern
from renderer.errors import InputError
from renderer.mesh import Mesh
from renderer.solids import SOLIDS, solid
from train.command_settings import LabSettings
from train.commands.audit import NEGATIVE_SOLIDS
from train.data.photographs import find_photographs, load_photographs
from train.laboratory import laboratory as lab
from train.laboratory.laboratory import FOV, Shot, draw_shots, lab_parts, path_traced

pytest.importorskip("mitsuba")

SCALED = {"mesh": "solid:orange:8", "albedo_scale": 0.5}
MESHES = ["solid:orange:7", SCALED, "solid:lemon:7", "solid:pear:7"]


@pytest.fixture(autouse=True, scope="module")
def coarse_patterns() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patterns, "LAB_RESOLUTION", 64)
        yield


def settings(out: Path, **changes) -> LabSettings:
    small = {"setups": 4, "patterns": ["stripes", "half"], "size": 8, "spp": 4, "bounces": 2}
    return LabSettings(**{"out": str(out), "meshes": MESHES, "label": "orange", **small, **changes})


def draw(
    setups, families, brightness=(0.2, 2.5), seed=0, environments=None, pictures=(), **changes
):
    maps = environments or {}
    changes |= {"patterns": [*families], "environments": [*maps], "brightness": [*brightness]}
    lab_settings = LabSettings("out", setups=setups, seed=seed, **changes)
    return list(draw_shots(lab_settings, maps, pictures))


def rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "photos.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("laboratory") / "lab"
    assert lab.write_laboratory(settings(folder)) == 8
    return folder


def test_a_laboratory_is_a_folder_of_photographs_with_the_pattern_as_the_source(laboratory):
    photographs = find_photographs(laboratory, sorted(SOLIDS), "orange")
    counts = Counter((item.label, item.source) for item in photographs)
    for pattern in ("stripes", "half"):
        assert counts.pop(("orange", pattern)) == 2
        assert counts.pop(("other_lemon", pattern)) == 1
        assert counts.pop(("pear", pattern)) == 1
    assert not counts
    _, images, _ = load_photographs(laboratory, photographs, 8, False)
    assert len(images.unique(dim=0)) == 8


def test_a_setup_shows_an_object_of_the_label_and_another_one_in_the_same_light(laboratory):
    pairs = [{"solid:orange:7", "solid:lemon:7"}, {"solid:orange:8", "solid:pear:7"}]
    shown = []
    for setup, source in enumerate(["stripes", "stripes", "half", "half"]):
        first, second = [row for row in rows(laboratory) if row["setup"] == str(setup)]
        shown.append({first["mesh"], second["mesh"]})
        assert first["source_tag"] == second["source_tag"] == source
        assert first["brightness"] == second["brightness"]
        assert 0.2 <= float(first["brightness"]) <= 2.5
    for of_lighting in (shown[:2], shown[2:]):
        assert sorted(map(sorted, of_lighting)) == sorted(map(sorted, pairs))


@pytest.mark.parametrize("shots", [1, 5, 6])
def test_every_mesh_is_shown_in_dim_and_in_bright_light(tmp_path, monkeypatch, shots):
    """A lighting has as many shots as there are hard negatives, one less or a single one."""
    monkeypatch.setattr(lab, "_write_render", lambda settings, subject, *_: subject.mesh)
    names = ["solid:orange:0", *(f"solid:{name}:0" for name in NEGATIVE_SOLIDS)]
    setups = shots * len(LAB_PATTERNS)
    lab.write_laboratory(settings(tmp_path, meshes=names, setups=setups, patterns=[*LAB_PATTERNS]))
    brightness = defaultdict(list)
    for row in rows(tmp_path):
        brightness[row["mesh"]].append(float(row["brightness"]))
    del brightness["solid:orange:0"]
    counts = [len(values) for values in brightness.values()]
    assert len(counts) == len(NEGATIVE_SOLIDS)
    assert max(counts) - min(counts) <= (setups % len(counts) > 0)
    # The brightness is from 0.2 to 2.5. With as many shots as meshes, each mesh has its lowest and
    # its highest sixth, and otherwise its lower and its upper half.
    ratio = 12.5 ** (1 / 6 if shots == 6 else 1 / 2)
    for values in brightness.values():
        assert shots == 1 or (min(values) < 0.2 * ratio and 2.5 / ratio < max(values))


def test_gloss_that_renders_do_not_show_is_told(caplog):
    glossy, matte = {"mesh": "solid:orange:8", "gloss": [0.3, 1.0]}, "solid:orange:8"
    shot = draw(1, ["solid"])[0]
    images = [path_traced(lab.read_subject(m, 0).parts, shot, 8, 4, 2, 0) for m in (glossy, matte)]
    np.testing.assert_array_equal(*images)
    assert caplog.messages == ["solid:orange:8: path-traced test images do not show its gloss"]


def test_only_the_object_distinguishes_the_label_from_a_hard_negative(tmp_path):
    """The same mesh under both labels has the same photographs."""
    meshes = ["solid:orange:7", {"mesh": "solid:orange:7", "label": "other_orange"}]
    lab.write_laboratory(settings(tmp_path, meshes=meshes))
    for path in (tmp_path / "orange").iterdir():
        assert path.read_bytes() == (tmp_path / "other_orange" / path.name).read_bytes()


def test_each_setup_shows_an_object_of_each_of_several_classes_and_one_other(tmp_path):
    lab.write_laboratory(settings(tmp_path, label=["orange", "pear"], setups=2))
    for setup in ("0", "1"):
        shown = [Path(row["path"]) for row in rows(tmp_path) if row["setup"] == setup]
        assert sorted(path.parent.name for path in shown) == ["orange", "other_lemon", "pear"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meshes": ["solid:orange"]}, "meshes has .*label=orange"),
        ({"label": ["orange", "apple"]}, "meshes has .*label=apple"),
        ({"meshes": [{"mesh": "solid:orange", "label": "other_../../x"}]}, r"has the label '.*x'"),
        ({"meshes": ["solid:orange", "fruit.glb"]}, r"meshes\[1\] has no label"),
        ({"setups": 5}, "setups=5"),
        ({"patterns": ["stripes+slides"]}, "patterns=.*slides"),
        ({"patterns": ["stripe"]}, "patterns=stripe"),
    ],
)
def test_what_cannot_be_photographed_is_refused_and_nothing_written(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        lab.write_laboratory(settings(tmp_path / "lab", **changes))
    assert not (tmp_path / "lab").exists()


def test_renders_that_replace_others_are_complete_at_their_end(tmp_path, laboratory, monkeypatch):
    folder = tmp_path / "lab"
    shutil.copytree(laboratory, folder)
    again = settings(folder, overwrite=True)
    assert lab.is_laboratory(folder, settings(tmp_path / "elsewhere"))
    assert not lab.is_laboratory(folder, settings(folder, seed=1))
    monkeypatch.setattr(lab, "_write_render", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        lab.write_laboratory(again)
    assert not lab.is_laboratory(folder, again)
    assert not list(folder.rglob("*.json"))


def test_an_environment_is_used_beside_patterns_and_refused_if_it_is_dark_above(tmp_path):
    path = tmp_path / "noon.npy"
    options = {"patterns": ["solid"], "environments": [str(path)], "setups": 2}
    np.save(path, np.ones((8, 16, 3), np.float32))
    lab.write_laboratory(settings(tmp_path / "lab", **options))
    assert {row["source_tag"] for row in rows(tmp_path / "lab")} == {"noon", "solid"}
    np.save(path, np.zeros((8, 16, 3), np.float32))
    with pytest.raises(InputError, match=r"noon\.npy has no light above"):
        lab.write_laboratory(settings(tmp_path / "other", **options))


@pytest.mark.parametrize("family", LAB_PATTERNS)
def test_a_pattern_is_an_image_of_the_colors_of_its_family_that_the_seed_decides(family):
    image, same, other = (draw_lab_pattern(family, np.random.default_rng(s)) for s in (0, 0, 100))
    assert image.shape == (64, 64, 3)
    assert 0 <= image.min() <= image.max() <= 1
    np.testing.assert_array_equal(image, same)
    assert not np.array_equal(image, other)
    colors = np.unique(image.reshape(-1, 3), axis=0)
    has_black = colors.min(axis=0).max() == 0
    if family == "colors":
        assert len(colors) > 100
    elif family == "text":
        assert has_black
    elif family == "gradient":
        # All colors lie on one line.
        assert np.linalg.matrix_rank(colors - colors[0], tol=1e-3) == 1
    elif family == "solid":
        assert (len(colors), has_black) == (1, False)
    else:
        assert (len(colors), has_black) == (2, family not in patterns.TWO_COLORED)


def elevation(direction: np.ndarray) -> float:
    return np.degrees(np.arcsin(direction[2] / np.linalg.norm(direction)))


def horizontal_cosine(first: np.ndarray, second: np.ndarray) -> float:
    product = first[:2] @ second[:2]
    return product / np.linalg.norm(first[:2]) / np.linalg.norm(second[:2])


def test_shots_of_a_family_are_evenly_from_dim_to_bright_and_within_their_ranges():
    shots = draw(88, LAB_PATTERNS, seed=3)
    assert [shot.lighting for shot in shots] == np.repeat([*LAB_PATTERNS], 8).tolist()
    edges = np.geomspace(0.2, 2.5, 9)
    brightness = np.array([shot.brightness for shot in shots]).reshape(-1, 8)
    assert (edges[:-1] <= brightness).all()
    assert (brightness <= edges[1:]).all()
    for shot in shots:
        backwards = shot.camera - shot.aim
        half_width = np.linalg.norm(backwards) * np.tan(np.radians(FOV / 2))
        assert 18 <= elevation(backwards) <= 60
        assert 1.2 <= half_width <= 1.9
        assert np.abs(shot.aim - shot.center).max() <= 0.25
        towards_projector = shot.projectors[0] - shot.center
        assert towards_projector[2] > 0
        cosine = horizontal_cosine(towards_projector, backwards)
        assert cosine >= np.cos(np.radians(70)) - 1e-9
        np.testing.assert_allclose(shot.rotation @ shot.rotation.T, np.eye(3), atol=1e-12)
        assert shot.rotation[2, 2] >= 0.5 - 1e-9


def test_settings_leave_draws_that_they_do_not_name_as_they_were():
    (plain,) = draw(1, ["rings"])
    (changed,) = draw(1, ["rings"], walls=1.0, roughness=[0.1, 0.2])
    assert plain.wall is None
    assert plain.roughness == 0.5
    assert 0.1 <= changed.roughness <= 0.2
    for name in ("camera", "aim", "rotation", "table", "ambient", "patterns", "projectors"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(changed, name))


def test_shots_with_two_projectors_have_two_patterns_and_a_wall_unless_it_would_hide_one():
    shots = draw(30, ["rings+text"], walls=1.0, azimuth=[-180, 180], elevation=[5, 85])
    assert {shot.wall is None for shot in shots} == {True, False}
    for shot in shots:
        assert len(shot.projectors) == len(shot.patterns) == 2
        for position in shot.projectors:
            assert 5 <= elevation(position - shot.center) <= 85
        if shot.wall is not None:
            behind = shot.wall - shot.center
            cosine = horizontal_cosine(behind, shot.camera - shot.aim)
            assert cosine <= -np.cos(np.radians(30)) + 1e-9
            for position in shot.projectors:
                assert (position - shot.center) @ behind < behind @ behind


def test_slides_project_a_picture_in_its_own_colors():
    picture = np.zeros((4, 4, 3), np.float32)
    picture[..., 0] = [[0.25], [0.5], [0.75], [1]]
    for shot in draw(3, ["slides"], slides=["a.png"], pictures=[picture]):
        (pattern,) = shot.patterns
        red = pattern[..., 0]
        assert pattern.shape == (64, 64, 3)
        assert 0.25 <= red.min() < 0.5
        assert red.max() <= 1
        assert not pattern[..., 1:].any()


# The light of the following tests comes from the projectors and the surroundings
# without bounces.


def frontal(**changes) -> Shot:
    """Make a shot in white light on a black table, with camera and projector at one place."""
    (shot,) = draw(1, ["solid"], (1, 1))
    center = np.array([0, 0, 1.0])
    front = np.array([0, -6.0, 1.0])
    white = {"patterns": [np.ones((4, 4, 3), np.float32)], "projectors": [front]}
    black = {"ambient": np.zeros(3), "table": np.zeros(3)}
    pose = {"camera": front, "center": center, "aim": center, "rotation": np.eye(3), "scale": 1.0}
    return replace(shot, **white | black | pose | changes)


def card(texture: np.ndarray) -> Mesh:
    """Make a square that faces -y, with the texture upright on it."""
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = (square[:, [0, 2]] + 1) / 2
    corners = {"corner_uvs": np.float32(uvs[faces]), "texture_ids": np.zeros(2, dtype=np.int32)}
    return replace(Mesh.plain(square, faces), **corners, textures=(texture,))


def directions(shot: Shot, size: int) -> np.ndarray:
    """Return directions through the centers of the pixels, shape (size, size, 3)."""
    ahead = (shot.aim - shot.camera) / np.linalg.norm(shot.aim - shot.camera)
    across = np.cross(ahead, [0, 0, 1])
    right = across / np.linalg.norm(across)
    up = np.cross(right, ahead)
    centers = (np.arange(size) + 0.5) / size * 2 - 1
    offsets = np.tan(np.radians(FOV / 2)) * centers
    return ahead + offsets[None, :, None] * right - offsets[:, None, None] * up


def test_the_table_reflects_projector_and_surroundings_as_formulas_say():
    """A projector lights planes that face it evenly, by 1 / z² at depth z."""
    (shot,) = draw(1, ["solid"], (1.5, 1.5), 1)
    shot = replace(shot, scale=1e-4, ambient=np.array([0.1, 0.2, 0.3]))
    image = path_traced(lab_parts(solid("orange"), 1.0), shot, 8, 4096, bounces=1, seed=0)

    rays = directions(shot, 8)
    positions = shot.camera - rays * (shot.camera[2] / rays[..., 2:])
    axis = shot.center - shot.projectors[0]
    from_projector = positions - shot.projectors[0]
    depth = from_projector @ axis / np.linalg.norm(axis)
    cosine = -from_projector[..., 2] / depth
    projected = axis @ axis / depth**2 * cosine
    color = shot.brightness * shot.patterns[0][0, 0]
    expected = shot.table * (projected[..., None] * color + shot.ambient)
    is_in_cone = np.linalg.norm(positions, axis=-1) < 1.5
    assert is_in_cone.mean() > 0.3
    np.testing.assert_allclose(image[is_in_cone], expected[is_in_cone], rtol=0.03)


GRAY_CARD = card(np.full((4, 4, 3), 128, dtype=np.uint8))


def test_a_wide_render_has_the_middle_rows_of_a_square_one():
    """Means of 12 pixels with 512 paths each differ by the noise."""
    shot = frontal(wall=np.array([0, 3.0, 1.0]), table=np.array([0.2, 0.1, 0.3]))
    parts = lab_parts(GRAY_CARD, 1.0)
    square = path_traced(parts, shot, 12, 512, bounces=1, seed=0)[3:9]
    wide = path_traced(parts, shot, (6, 12), 512, bounces=1, seed=0)
    means = [image.reshape(2, 3, 3, 4, 3).mean((1, 3)) for image in (square, wide)]
    np.testing.assert_allclose(*means, rtol=0.05, atol=0.005)


def test_a_wall_that_faces_projectors_has_the_color_of_the_table_times_the_brightness():
    """The wall is at distance 9. Brightness refers to distance 6, and to all projectors at once."""
    table = np.array([0.2, 0.1, 0.3])
    shot = frontal(wall=np.array([0, 3.0, 1.0]), table=table, scale=1e-4)
    image = path_traced(lab_parts(GRAY_CARD, 1.0), shot, 8, 256, bounces=1, seed=0)
    expected = np.broadcast_to(6**2 / 9**2 * table, (2, 3))
    np.testing.assert_allclose(image[0, 3:5], expected, rtol=0.1)
    two = replace(shot, patterns=2 * shot.patterns, projectors=2 * shot.projectors)
    of_two = path_traced(lab_parts(GRAY_CARD, 1.0), two, 8, 256, bounces=1, seed=0)
    np.testing.assert_allclose(of_two, image, rtol=1e-5)


def test_a_texture_lies_upright_on_its_faces():
    red, green, blue, white = [220, 0, 0], [0, 220, 0], [0, 0, 220], [220, 220, 220]
    quarters = np.array([[red, green], [blue, white]], dtype=np.uint8)
    texture = quarters.repeat(8, axis=0).repeat(8, axis=1)
    image = path_traced(lab_parts(card(texture), 1.0), frontal(), 16, 16, bounces=1, seed=0)
    is_bright = image > image.max() / 2
    for row, column, color in [(5, 5, red), (5, 10, green), (10, 5, blue), (10, 10, white)]:
        np.testing.assert_array_equal(is_bright[row, column], np.array(color) > 0)


def test_a_card_reflects_its_linear_albedo_times_its_scale_and_the_brightness():
    """Add the gloss: 4 % of the light times the peak of the GGX distribution, 1 / (4 α²)."""
    shot = frontal(brightness=0.5)
    image = path_traced(lab_parts(GRAY_CARD, 2), shot, 8, 16, bounces=1, seed=0)
    linear_gray = 0.216
    gloss = 0.04 / (4 * shot.roughness**4)
    assert image[3:5, 3:5].mean() == pytest.approx(0.5 * (2 * linear_gray + gloss), rel=0.05)


def test_an_object_stands_on_the_table():
    """The front of a cube, lit by its surroundings, reaches from the table up to its height."""
    cube = trimesh.creation.box((2, 2, 2))
    parts = lab_parts(Mesh.plain(cube.vertices, cube.faces), 1)
    shot = frontal(ambient=np.ones(3), brightness=1e-9)
    image = path_traced(parts, shot, 32, 64, bounces=1, seed=0)
    rays = directions(shot, 32)[:, 15]
    # The plane of the front is y = -1, at distance 5 from the camera.
    height = shot.camera[2] + rays[:, 2] * (5 / rays[:, 1])
    is_lit = (image[:, 15] > 0.1).all(axis=1)
    # The lower edge of the cube runs through one row, which is left out.
    is_clear = (height < 2) & (np.abs(height) > 0.04)
    np.testing.assert_array_equal(is_lit[is_clear], height[is_clear] > 0)


def test_the_table_under_an_environment_has_the_brightness_times_its_albedo():
    """A map of one direction, off the vertical, is a distant lamp: the table under it is even."""
    sky = np.zeros((64, 128, 3), np.float32)
    sky[16, 40] = 1e4
    (shot,) = draw(1, [], (0.7, 0.7), 1, {"lamp": sky})
    assert shot.lighting == "lamp"
    shot = replace(shot, scale=1e-4)
    image = path_traced(lab_parts(solid("orange"), 1.0), shot, 8, 256, bounces=1, seed=0)
    expected = np.broadcast_to(0.7 * shot.table, image.shape)
    # Bilinear interpolation spreads the lamp over two texels.
    np.testing.assert_allclose(image, expected, rtol=0.02)


def test_paths_of_a_pixel_are_stratified_so_that_their_noise_is_below_that_of_independent_ones():
    """The noise of N independent samples is that of one, divided by the root of N."""
    parts, shot = lab_parts(solid("orange"), 1.0), frontal(ambient=np.ones(3), table=np.ones(3))

    def noise(spp: int) -> float:
        first, second = (path_traced(parts, shot, 24, spp, bounces=2, seed=seed) for seed in (0, 1))
        return float((first - second).std())

    assert noise(16) < 0.75 * noise(1) / 16**0.5
