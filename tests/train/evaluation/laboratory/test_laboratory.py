"""The laboratory: its folder, its random draws, and photographs against closed forms."""

import csv
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.normals import corner_normals
from renderer.geometry.shapes import HARD_NEGATIVES, SOLIDS, solid
from train.command_settings import LabSettings
from train.data.photographs import find_photographs, load_photographs
from train.evaluation.laboratory import lab_patterns as patterns
from train.evaluation.laboratory import laboratory as lab
from train.evaluation.laboratory.lab_patterns import FAMILIES, draw_pattern
from train.evaluation.laboratory.laboratory import lab_parts, path_traced
from train.evaluation.laboratory.shots import FOV, Shot, draw_shots

pytest.importorskip("mitsuba")

MESHES = [
    "solid:orange:7",
    {"mesh": "solid:orange:8", "albedo_scale": 0.5},
    "solid:lemon:7",
    "solid:pear:7",
]


@pytest.fixture(autouse=True, scope="module")
def coarse_patterns():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patterns, "RESOLUTION", 64)
        yield


def settings(out: Path, **changes) -> LabSettings:
    small = {"setups": 4, "patterns": ["stripes", "half"], "size": 8, "spp": 4, "bounces": 2}
    return LabSettings(**{"out": str(out), "meshes": MESHES, **small, **changes})


def draw(
    setups: int,
    families,
    brightness=(0.2, 2.5),
    seed: int = 0,
    environments=None,
    pictures=(),
    **changes,
) -> list[Shot]:
    maps = environments or {}
    changes |= {
        "patterns": list(families),
        "environments": list(maps),
        "brightness": list(brightness),
        "seed": seed,
    }
    return list(draw_shots(LabSettings("out", setups=setups, **changes), maps, pictures))


def rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "photos.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("laboratory") / "lab"
    assert lab.write_laboratory(settings(folder)) == 8
    return folder


def test_a_laboratory_is_a_folder_of_photographs_with_the_pattern_as_the_source_and_its_settings(
    laboratory,
):
    """Each setup shows one object of the label and one other under the same light."""
    photographs = find_photographs(laboratory, sorted(SOLIDS), "orange")
    assert Counter((item.label, item.source) for item in photographs) == {
        (label, pattern): count
        for label, count in {"orange": 2, "other_lemon": 1, "pear": 1}.items()
        for pattern in ("stripes", "half")
    }
    _, images, _ = load_photographs(laboratory, photographs, 8)
    assert len(images.unique(dim=0)) == 8
    described = json.loads((laboratory / "lab.json").read_text())
    assert described["meshes"] == MESHES and described["setups"] == 4 and described["seed"] == 0
    pairs = [{"solid:orange:7", "solid:lemon:7"}, {"solid:orange:8", "solid:pear:7"}] * 2
    for setup, (pair, source) in enumerate(zip(pairs, ["stripes"] * 2 + ["half"] * 2, strict=True)):
        shown = [row for row in rows(laboratory) if int(row["setup"]) == setup]
        assert len(shown) == 2 and {row["mesh"] for row in shown} == pair
        (light,) = {(row["source_tag"], row["brightness"]) for row in shown}
        assert light[0] == source and 0.2 <= float(light[1]) <= 2.5


def test_the_same_settings_write_the_same_bytes_and_another_seed_or_exposure_writes_others(
    laboratory, tmp_path
):
    for name, changes in [("same", {}), ("seed", {"seed": 1}), ("exposure", {"exposure": 4.0})]:
        lab.write_laboratory(settings(tmp_path / name, **changes))
        for row in rows(laboratory):
            first, again = (
                (folder / row["path"]).read_bytes() for folder in (laboratory, tmp_path / name)
            )
            assert (first == again) is (name == "same")
    assert (tmp_path / "same" / "photos.csv").read_bytes() == (
        laboratory / "photos.csv"
    ).read_bytes()


def test_only_the_object_distinguishes_the_label_from_a_hard_negative(tmp_path):
    """One and the same mesh under both labels: the photographs of a setup are the same, byte for byte."""
    meshes = ["solid:orange:7", {"mesh": "solid:orange:7", "label": "other_orange"}]
    lab.write_laboratory(settings(tmp_path, meshes=meshes))
    for path in (tmp_path / "orange").iterdir():
        assert path.read_bytes() == (tmp_path / "other_orange" / path.name).read_bytes()


def test_each_setup_shows_an_object_of_each_of_several_classes_and_one_other(tmp_path):
    lab.write_laboratory(settings(tmp_path, label=["orange", "pear"], setups=2))
    for setup in ("0", "1"):
        labels = sorted(
            Path(row["path"]).parent.name for row in rows(tmp_path) if row["setup"] == setup
        )
        assert labels == ["orange", "other_lemon", "pear"]


def test_a_solid_without_a_label_has_its_own_name_as_a_class_or_as_something_else():
    for name in ("orange", "pear", *HARD_NEGATIVES):
        expected = name if name in SOLIDS else f"other_{name}"
        assert lab.read_subject(f"solid:{name}:1", 0)[0] == expected
    assert lab.read_subject({"mesh": "solid:orange", "label": "pear"}, 0)[0] == "pear"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"meshes": ["solid:orange"]},
            "meshes: name at least one of label=orange and one of another class",
        ),
        (
            {"label": ["orange", "apple"]},
            "meshes: name at least one of label=apple and one of another class",
        ),
        (
            {"meshes": [{"mesh": "solid:orange", "label": "other_../../x"}]},
            r"meshes\[0\]: the label '.*x' names the",
        ),
        (
            {"meshes": ["solid:orange", "fruit.glb"]},
            r"meshes\[1\] has no label: give {mesh: fruit.glb, label: ",
        ),
        ({"setups": 5}, "setups=5 must be a multiple of the 2 patterns"),
        ({"patterns": ["stripes+slides"]}, "patterns has slides: name image files in slides="),
        ({"patterns": ["stripe"]}, "patterns=stripe: choose one of solid, gradient, stripes"),
    ],
)
def test_what_cannot_be_photographed_is_refused_before_anything_is_written(
    tmp_path, changes, message
):
    with pytest.raises(InputError, match=message):
        lab.write_laboratory(settings(tmp_path / "lab", **changes))
    assert not (tmp_path / "lab").exists()


def test_a_folder_that_holds_something_is_left_alone(laboratory):
    before = {path: path.stat().st_mtime_ns for path in laboratory.rglob("*")}
    with pytest.raises(InputError, match=r"out=.*lab .* overwrite=true"):
        lab.write_laboratory(settings(laboratory))
    assert before == {path: path.stat().st_mtime_ns for path in laboratory.rglob("*")}


def test_environments_stand_beside_patterns_and_name_the_source(tmp_path):
    changes = {"patterns": ["solid"], "environments": [str(tmp_path / "noon.npy")], "setups": 2}
    np.save(tmp_path / "noon.npy", np.zeros((8, 16, 3), np.float32))
    with pytest.raises(InputError, match=r"noon\.npy is dark above"):
        lab.write_laboratory(settings(tmp_path / "lab", **changes))
    np.save(tmp_path / "noon.npy", np.ones((8, 16, 3), np.float32))
    lab.write_laboratory(settings(tmp_path / "lab", **changes))
    assert {row["source_tag"] for row in rows(tmp_path / "lab")} == {"noon", "solid"}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("seed", range(3))
def test_a_pattern_mixes_two_colors_one_of_which_is_darkness_in_some_families(family, seed):
    image, again, other = (
        draw_pattern(family, np.random.default_rng(number)) for number in (seed, seed, seed + 100)
    )
    np.testing.assert_array_equal(image, again)
    assert (
        image.shape == (64, 64, 3)
        and image.min() >= 0
        and image.max() <= 1
        and not np.array_equal(image, other)
    )
    colors = np.unique(image.reshape(-1, 3), axis=0)
    if family in ("colors", "text"):
        assert len(colors) > 100 if family == "colors" else colors.min(axis=0).max() == 0
    elif family == "gradient":
        assert np.linalg.matrix_rank(colors - colors[0], tol=1e-3) == 1
    else:
        assert len(colors) == (1 if family == "solid" else 2)
        assert (colors.min(axis=0).max() == 0) == (family not in (*patterns.TWO_COLORED, "solid"))


def test_every_family_has_as_many_setups_from_dim_to_bright_that_differ_and_stay_within_their_ranges():
    shots = draw(220, FAMILIES, seed=3)
    assert [shot.family for shot in shots] == [name for name in FAMILIES for _ in range(20)]
    edges = np.geomspace(0.2, 2.5, 21)
    brightness = np.array([shot.brightness for shot in shots]).reshape(-1, 20)
    assert (edges[:-1] <= brightness).all() and (brightness <= edges[1:]).all()
    other = draw(11, FAMILIES, seed=4)
    assert len({tuple(shot.camera) for shot in [*shots, *other]}) == 231
    for shot in shots:
        back, towards = shot.camera - shot.aim, shot.projectors[0] - shot.center
        assert 18 <= np.degrees(np.arcsin(back[2] / np.linalg.norm(back))) <= 60
        assert (
            1.2 <= np.linalg.norm(back) * np.tan(np.radians(FOV / 2)) <= 1.9
        )  # the object fits the view
        assert np.abs(shot.aim - shot.center).max() <= 0.25
        across = towards[:2] @ back[:2] / np.linalg.norm(towards[:2]) / np.linalg.norm(back[:2])
        assert (
            towards[2] > 0 and across >= np.cos(np.radians(70)) - 1e-9
        )  # above, on the camera's side
        np.testing.assert_allclose(shot.rotation @ shot.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(shot.rotation) == pytest.approx(1)  # turned, not mirrored
        assert shot.rotation[2, 2] >= 0.5 - 1e-9  # tilted by at most 60 degrees
        assert shot.ambient.max() <= 0.06 and shot.table.max() <= 0.16


def test_wider_settings_leave_the_draws_that_they_do_not_name_as_they_were():
    """Another roughness, walls and a second projector: the same camera, pose, table and first projector."""
    (one,), (other,) = draw(1, ["rings"]), draw(1, ["rings"], walls=1.0, roughness=[0.1, 0.2])
    assert one.wall is None and one.roughness == 0.5 and 0.1 <= other.roughness <= 0.2
    for name in ("camera", "aim", "rotation", "table", "ambient", "patterns", "projectors"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    behind, camera = (other.wall - other.center)[:2], (other.camera - other.aim)[:2]
    assert (
        behind @ camera / np.linalg.norm(behind) / np.linalg.norm(camera)
        <= -np.cos(np.radians(30)) + 1e-9
    )
    shots = draw(60, ["rings+text"], walls=1.0, azimuth=[-180, 180], elevation=[5, 85])
    assert {len(shot.projectors) for shot in shots} == {len(shot.patterns) for shot in shots} == {2}
    assert any(shot.wall is None for shot in shots) and any(shot.wall is not None for shot in shots)
    for shot in shots:
        towards = np.array([position - shot.center for position in shot.projectors])
        above = np.degrees(np.arcsin(towards[:, 2] / np.linalg.norm(towards, axis=1)))
        assert (above >= 5).all() and (above <= 85).all()
        assert (
            shot.wall is None
            or (towards @ (shot.wall - shot.center) < np.sum((shot.wall - shot.center) ** 2)).all()
        )


def test_slides_project_a_picture_in_its_own_colors():
    picture = np.zeros((4, 4, 3), np.float32)
    picture[..., 0] = [[0.25], [0.5], [0.75], [1]]
    for shot in draw(3, ["slides"], slides=["a.png"], pictures=[picture]):
        assert (
            shot.patterns[0].shape == (64, 64, 3) and 0.25 <= shot.patterns[0][..., 0].min() < 0.5
        )
        assert shot.patterns[0][..., 0].max() <= 1 and not shot.patterns[0][..., 1:].any()


# The light comes from the table and the surroundings without bounces.


def frontal(**changes) -> Shot:
    """A camera and a projector in front of an upright object, in white light on a black table."""
    [shot] = draw(1, ["solid"], (1, 1))
    center, front = np.array([0, 0, 1.0]), np.array([0, -6.0, 1.0])
    plain = {
        "patterns": [np.ones((4, 4, 3), np.float32)], "ambient": np.zeros(3), "table": np.zeros(3),
        "projectors": [front], "camera": front, "center": center, "aim": center, "rotation": np.eye(3), "scale": 1.0,
    }  # fmt: skip
    return replace(shot, **plain | changes)


def card(texture: np.ndarray) -> Mesh:
    """A square that faces -y, with the texture upright on it."""
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = (square[:, [0, 2]] + 1) / 2
    return replace(
        Mesh.plain(square, faces),
        corner_uvs=uvs[faces].astype(np.float32),
        texture_ids=np.zeros(2, dtype=np.int32),
        textures=(texture,),
    )


def directions(shot: Shot, size: int) -> np.ndarray:
    """(size, size, 3) from the camera through the pixels' middles."""
    ahead = (shot.aim - shot.camera) / np.linalg.norm(shot.aim - shot.camera)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    reach = np.tan(np.radians(FOV / 2)) * ((np.arange(size) + 0.5) / size * 2 - 1)
    return ahead + reach[None, :, None] * right - reach[:, None, None] * np.cross(right, ahead)


@pytest.mark.parametrize("seed", range(3))
def test_the_table_reflects_projector_and_surroundings_as_formulas_say(seed):
    """Beyond an object too small to see. A projector lights the planes that face it evenly: by 1 / z² at depth z."""
    [shot] = draw(1, ["solid"], (1.5, 1.5), seed)
    shot = replace(shot, scale=1e-4, ambient=np.array([0.1, 0.2, 0.3]))
    image = path_traced(lab_parts(solid("orange"), 1.0), shot, 8, 4096, bounces=1, seed=0)

    rays = directions(shot, 8)
    positions = shot.camera - rays * (shot.camera[2] / rays[..., 2:])
    axis, ray = shot.center - shot.projectors[0], positions - shot.projectors[0]
    depth = ray @ axis / np.linalg.norm(axis)
    evenly = axis @ axis / depth**2 * (-ray[..., 2] / depth)
    lit = evenly[..., None] * shot.brightness * shot.patterns[0][0, 0] + shot.ambient
    inside = np.linalg.norm(positions, axis=-1) < 1.5  # the projector's cone
    assert inside.mean() > 0.3
    np.testing.assert_allclose(image[inside], (shot.table * lit)[inside], rtol=0.03)


def test_two_projectors_share_the_brightness_and_a_wall_behind_is_lit_like_the_table():
    """From one place they light as one does; a wall that faces the projector has its color times the brightness."""
    card_parts = lab_parts(card(np.full((4, 4, 3), 128, dtype=np.uint8)), 1.0)
    shot = frontal(wall=np.array([0, 3.0, 1.0]), table=np.array([0.2, 0.1, 0.3]))
    twice = replace(shot, patterns=2 * shot.patterns, projectors=2 * shot.projectors)
    one, two = (path_traced(card_parts, item, 8, 64, bounces=1, seed=0) for item in (shot, twice))
    np.testing.assert_allclose(two, one, rtol=1e-5)
    evenly = 6**2 / 9**2  # the wall is three units behind what the brightness is of
    lit = path_traced(card_parts, replace(shot, scale=1e-4), 8, 256, bounces=1, seed=0)
    np.testing.assert_allclose(lit[0, 3:5], np.broadcast_to(evenly * shot.table, (2, 3)), rtol=0.1)


def test_a_texture_lies_upright_on_its_faces():
    red, green, blue, white = [220, 0, 0], [0, 220, 0], [0, 0, 220], [220, 220, 220]
    texture = (
        np.array([[red, green], [blue, white]], dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    )
    image = path_traced(lab_parts(card(texture), 1.0), frontal(), 16, 16, bounces=1, seed=0)
    strong = image > image.max() / 2
    for row, column, expected in [(5, 5, red), (5, 10, green), (10, 5, blue), (10, 10, white)]:
        np.testing.assert_array_equal(strong[row, column], np.array(expected) > 0)


def test_a_card_reflects_its_linear_albedo_times_the_albedo_scale_and_the_brightness():
    """Facing projector and camera, with its gloss: 4 % of the light times the GGX peak, 1 / (4 α²)."""
    gray = np.full((4, 4, 3), 128, dtype=np.uint8)  # linear 0.216
    gloss = 0.04 / (4 * frontal().roughness ** 4)  # α is the roughness's square
    for albedo_scale, brightness in [(1, 1), (2, 1), (1, 0.5)]:
        shot = frontal(brightness=brightness)
        image = path_traced(lab_parts(card(gray), albedo_scale), shot, 8, 16, bounces=1, seed=0)
        assert image[3:5, 3:5].mean() == pytest.approx(
            (0.216 * albedo_scale + gloss) * brightness, rel=0.05
        )


def test_an_object_stands_on_the_table():
    """A cube's front, lit by its surroundings, reaches from the table up to its height."""
    cube = trimesh.creation.box((2, 2, 2))
    shot = frontal(ambient=np.ones(3), brightness=1e-9)
    image = path_traced(
        lab_parts(Mesh.plain(cube.vertices, cube.faces), 1), shot, 32, 64, bounces=1, seed=0
    )
    ray = directions(shot, 32)[:, 15]
    height = shot.camera[2] + ray[:, 2] * (
        5 / ray[:, 1]
    )  # where it meets the plane of the front, y = -1
    clear = (height < 2) & (np.abs(height) > 0.04)  # not the row that the lower edge runs through
    np.testing.assert_array_equal((image[:, 15] > 0.1).all(axis=1)[clear], (height > 0)[clear])


def test_the_table_under_an_environment_has_the_brightness_times_its_albedo_at_every_azimuth():
    """A map of one direction, off the vertical, is a distant lamp: the table under it is even."""
    sky = np.zeros((64, 128, 3), np.float32)
    sky[16, 40] = 1e4, 1e4, 1e4
    for seed in range(2):
        [shot] = draw(1, [], (0.7, 0.7), seed, {"lamp": sky})
        shot = replace(shot, scale=1e-4)
        image = path_traced(lab_parts(solid("orange"), 1.0), shot, 8, 256, bounces=1, seed=0)
        assert shot.family == "lamp"
        # The map is sampled by bilinear interpolation, which spreads the lamp over two texels.
        np.testing.assert_allclose(image, np.broadcast_to(0.7 * shot.table, image.shape), rtol=0.02)


@pytest.mark.parametrize("divisions", [0, 2])
def test_right_angles_stay_sharp_and_round_surfaces_are_smooth(divisions):
    cube, ball = trimesh.creation.box((2, 2, 2)), trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = cube.vertices, cube.faces
    for _ in range(divisions):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    mesh = Mesh.plain(vertices, faces)
    flat = mesh.face_normals()[:, None].repeat(3, axis=1)
    np.testing.assert_array_equal(
        corner_normals(mesh.vertices, mesh.faces, "smooth", lab.MIN_SMOOTH_COSINE), flat
    )
    mesh = Mesh.plain(ball.vertices, ball.faces)
    smooth = corner_normals(mesh.vertices, mesh.faces, "smooth", lab.MIN_SMOOTH_COSINE)
    np.testing.assert_allclose(smooth, mesh.vertices[mesh.faces], atol=0.02)
