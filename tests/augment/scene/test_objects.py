import numpy as np
import pytest
import trimesh

from augment.scene.objects import add_table, load_object, resample_instance, rotated
from augment.settings import ObjectSettings, PropSettings
from renderer.errors import InputError
from renderer.geometry.mesh import normalize
from renderer.geometry.shapes import solid


def test_a_mesh_without_colors_takes_the_given_one(tmp_path):
    plain, color = str(tmp_path / "plain.stl"), [0.9, 0.5, 0.1]
    trimesh.creation.icosphere(1).export(plain)
    mesh, white = (
        load_object(ObjectSettings(plain, "orange", color=choice)).mesh for choice in (color, None)
    )
    np.testing.assert_array_equal(
        mesh.corner_colors, np.broadcast_to(np.float32(color), mesh.corner_colors.shape)
    )
    np.testing.assert_array_equal(mesh.vertices, white.vertices)
    assert (white.corner_colors == 1).all()


@pytest.mark.parametrize(
    ("mesh", "color", "message"),
    [
        ("solid:orange", [1.0, 0.0, 0.0], "solid:orange brings colors of its own: leave color out"),
        ("solid:orange", [1.0, 0.5], "color=.* must be red, green and blue"),
        ("solid:orange", [0.0, float("nan"), 0.0], "color=.* must be red, green and blue"),
        ("solid:orange:x", None, "solid:orange:x: "),
    ],
)
def test_colors_and_seeds_that_a_mesh_cannot_have_are_refused(mesh, color, message):
    with pytest.raises(InputError, match=message):
        load_object(ObjectSettings(mesh, "orange", color=color))


def test_props_stand_on_the_objects_ground_shifted_and_turned():
    props = [PropSettings("solid:cup:1", [0.9, -0.2], scale=0.5, azimuth=90)]
    item = load_object(ObjectSettings("solid:apple", "apple", props=props))
    apple, cup = normalize(solid("apple")), normalize(solid("cup", 1))
    np.testing.assert_array_equal(item.mesh.faces[item.own_faces], apple.faces)
    np.testing.assert_array_equal(item.mesh.vertices[item.own_vertices], apple.vertices)
    np.testing.assert_array_equal(item.mesh.corner_colors[~item.own_faces], cup.corner_colors)
    lowest = apple.vertices[:, 2].min() - 0.5 * cup.vertices[:, 2].min()
    expected = 0.5 * cup.vertices[:, [1, 0, 2]] * [-1, 1, 1] + [
        0.9,
        -0.2,
        lowest,
    ]  # x turns to y, and y to -x
    np.testing.assert_allclose(item.mesh.vertices[~item.own_vertices], expected, rtol=0, atol=1e-7)
    assert add_table(item, (0.5, 0.5, 0.5)).lowest == item.lowest == apple.vertices[:, 2].min()


@pytest.mark.parametrize("at", [[0.1, 0.0], [-3.0, 0.4], [0.7, 2.0]])
def test_a_table_reaches_under_everything_that_stands_on_it(at):
    item = load_object(
        ObjectSettings("solid:apple", "apple", props=[PropSettings("solid:cup", at, scale=0.5)])
    )
    table = add_table(item, (0.5, 0.5, 0.5)).mesh.vertices[len(item.mesh.vertices) :]
    (low, high), others = (table.min(0), table.max(0)), item.mesh.vertices
    assert (low[2] == high[2] == others[:, 2].min()) and len(table) == 4
    assert (low[:2] <= others[:, :2].min(0) - 0.19).all() and (
        high[:2] >= others[:, :2].max(0) + 0.19
    ).all()
    assert (low[:2] <= -1.2).all() and (high[:2] >= 1.2).all() and np.ptp(table, axis=0).max() < 5


def test_another_instance_has_the_same_props():
    props, color = [PropSettings("solid:cup", [1.0, 0.0], 0.5)], [0.2, 0.3, 0.4]
    items = [
        ObjectSettings(name, "apple", props=props) for name in ("solid:apple", "solid:apple:5")
    ]
    item, expected = (add_table(load_object(item), color) for item in items)
    other = resample_instance(item, 5)
    np.testing.assert_array_equal(other.mesh.vertices, expected.mesh.vertices)
    np.testing.assert_array_equal(other.own_faces, expected.own_faces)
    assert not np.array_equal(
        other.mesh.vertices[other.own_vertices], item.mesh.vertices[item.own_vertices]
    )


def test_an_object_has_the_gloss_that_it_is_given_and_its_props_stay_matte():
    item = load_object(
        ObjectSettings(
            "solid:pear",
            label="pear",
            gloss=[0.3, 0, 0.5],
            props=[PropSettings("solid:cup", [1, 0])],
        )
    )
    for shown in (item, resample_instance(item, 5), rotated(item, np.eye(3))):
        own = shown.own_faces
        np.testing.assert_allclose(
            shown.mesh.gloss[own], np.tile([0.3, 0, 0.5], (own.sum(), 1)), rtol=1e-6
        )
        assert (shown.mesh.gloss[~own, 2] == 0).all() and len(own) > own.sum()
    for bad in ([2.0], [0.5, 0, 1, 1], "shiny", 0.3, [], "file"):
        with pytest.raises(InputError, match="gloss"):
            ObjectSettings("solid:pear", label="pear", gloss=bad)


def test_a_metal_needs_a_color(tmp_path):
    plain = str(tmp_path / "plain.stl")
    trimesh.creation.icosphere(1).export(plain)
    load_object(ObjectSettings(plain, "orange", color=[0.9, 0.5, 0.1], gloss=[0.3, 1, 1]))
    with pytest.raises(InputError, match="is a metal without a color: give color="):
        load_object(ObjectSettings(plain, "orange", gloss=[0.3, 1, 1]))
