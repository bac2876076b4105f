"""Objects get their colors, props, gloss and table."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from augment.scene.objects import add_table, load_object, resample_instance, rotated
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.mesh import normalize
from renderer.solids import solid

GRAY = (0.5, 0.5, 0.5)


def test_a_mesh_without_colors_takes_the_given_one_which_a_metal_needs(tmp_path):
    path = str(tmp_path / "plain.stl")
    trimesh.creation.icosphere(1).export(path)
    color = [0.9, 0.5, 0.1]
    metal = [0.3, 1, 1]
    mesh = load_object(ObjectSettings(path, "orange", color=color, gloss=metal)).mesh
    expected = np.broadcast_to(np.float32(color), mesh.corner_colors.shape)
    np.testing.assert_array_equal(mesh.corner_colors, expected)
    with pytest.raises(InputError, match="color="):
        load_object(ObjectSettings(path, "orange", gloss=metal))


def test_an_object_keeps_the_sharp_edges_of_its_file_if_it_is_colored(tmp_path):
    """Each corner of the file has a normal of its own."""
    ball = trimesh.creation.icosphere(1)
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices]
    lines += [f"vn {x} {y} {z}" for x, y, z in ball.face_normals]
    for number, face in enumerate(ball.faces, 1):
        lines.append("f " + " ".join(f"{corner + 1}//{number}" for corner in face))
    path = tmp_path / "facets.obj"
    path.write_text("\n".join(lines))
    for color in (None, [0.5, 0.5, 0.5]):
        mesh = load_object(ObjectSettings(str(path), "ball", color=color)).mesh
        assert len(np.unique(mesh.normal_ids)) == 3 * len(ball.faces)


def test_props_stand_on_the_objects_ground_shifted_and_turned():
    """A quarter turn takes x to y, and y to -x."""
    prop = ObjectSettings("solid:cup:1", at=[0.9, -0.2], scale=0.5, azimuth=90)
    item = load_object(ObjectSettings("solid:apple", "apple", others=[prop]))
    apple = normalize(solid("apple"))
    cup = normalize(solid("cup", 1))
    np.testing.assert_array_equal(item.mesh.faces[item.own_faces], apple.faces)
    np.testing.assert_array_equal(item.mesh.vertices[item.own_vertices], apple.vertices)
    np.testing.assert_array_equal(item.mesh.corner_colors[~item.own_faces], cup.corner_colors)
    turned = cup.vertices[:, [1, 0, 2]] * [-1, 1, 1]
    lift = apple.vertices[:, 2].min() - 0.5 * cup.vertices[:, 2].min()
    expected = 0.5 * turned + [0.9, -0.2, lift]
    found = item.mesh.vertices[~item.own_vertices]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


def test_objects_without_a_position_stand_right_and_left_by_turns():
    places = [[0.0, 2.5], None, [2.0, 0.0], None]
    others = [ObjectSettings(f"solid:ball:{seed}", at=at) for seed, at in enumerate(places)]
    item = load_object(ObjectSettings("solid:apple", "apple", others=others))
    parts = np.split(item.mesh.faces, item.ends[:-1])
    centers = [item.mesh.vertices[faces][..., 1].mean() for faces in parts]
    # The second of these others is at the right end, and the fourth at the left one.
    assert centers[2] > 2.5
    assert centers[4] < -1


@pytest.mark.parametrize("kind", [list, tuple])
def test_settings_of_objects_take_arrays_and_leave_the_callers_objects_alone(kind):
    prop = {"mesh": "solid:cup", "at": np.array([1.0, 0.5])}
    given = kind([prop])
    item = ObjectSettings("solid:apple", "apple", gloss=np.array([0.5, 0.0, 1.0]), others=given)
    cup = ObjectSettings("solid:cup", at=[1.0, 0.5])
    assert item == ObjectSettings("solid:apple", "apple", gloss=[0.5, 0.0, 1.0], others=[cup])
    assert given[0] is prop and len(load_object(item).others) == 1


@pytest.mark.parametrize("at", [[0.1, 0.0], [-3.0, 0.4], [0.7, 2.0]])
def test_a_table_reaches_under_everything_that_stands_on_it(at):
    prop = ObjectSettings("solid:cup", at=at, scale=0.5)
    item = load_object(ObjectSettings("solid:apple", "apple", others=[prop]))
    above = item.mesh.vertices
    table = add_table(item, GRAY).mesh.vertices[len(above) :]
    assert table.shape == (4, 3)
    assert (table[:, 2] == above[:, 2].min()).all()
    low = table.min(0)[:2]
    high = table.max(0)[:2]
    assert (low <= above[:, :2].min(0) - 0.19).all()
    assert (high >= above[:, :2].max(0) + 0.19).all()
    assert (low <= -1.2).all()
    assert (high >= 1.2).all()
    assert (high - low).max() < 5


def test_another_instance_has_the_same_props():
    props = [ObjectSettings("solid:cup", at=[1.0, 0.0], scale=0.5)]
    item = add_table(load_object(ObjectSettings("solid:apple", "apple", others=props)), GRAY)
    other = resample_instance(item, 5)
    settings = ObjectSettings("solid:apple:5", "apple", others=props)
    expected = add_table(load_object(settings), GRAY)
    np.testing.assert_array_equal(other.mesh.vertices, expected.mesh.vertices)
    np.testing.assert_array_equal(other.own_faces, expected.own_faces)
    own = other.mesh.vertices[other.own_vertices]
    assert not np.array_equal(own, item.mesh.vertices[item.own_vertices])


def test_another_instance_is_turned_and_subdivided_as_the_first():
    item = load_object(ObjectSettings("solid:cup", "cup", azimuth=90), 2000)
    expected = load_object(ObjectSettings("solid:cup:5", "cup", azimuth=90), 2000)
    other = resample_instance(item, 5)
    np.testing.assert_array_equal(other.mesh.vertices, expected.mesh.vertices)


@pytest.mark.parametrize(
    "change",
    [
        lambda item: item,
        lambda item: resample_instance(item, 5),
        lambda item: rotated(item, np.eye(3)),
    ],
    ids=["loaded", "another instance", "rotated"],
)
def test_an_object_has_the_gloss_that_it_is_given_and_its_props_stay_matte(change: Callable):
    props = [ObjectSettings("solid:cup", at=[1, 0])]
    item = load_object(ObjectSettings("solid:pear", "pear", gloss=[0.3, 0, 0.5], others=props))
    shown = change(item)
    own = shown.mesh.gloss[shown.own_faces]
    of_props = shown.mesh.gloss[~shown.own_faces]
    np.testing.assert_allclose(own, np.tile([0.3, 0, 0.5], (len(own), 1)), rtol=1e-6)
    assert len(of_props) > 0
    assert (of_props[:, 2] == 0).all()
