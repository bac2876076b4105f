import numpy as np
import pytest
import trimesh

from augment.objects import ObjectSettings, another_individual, load_object, on_ground
from renderer.errors import InputError


@pytest.fixture
def plain(tmp_path) -> str:
    """A file that brings neither colours nor textures."""
    trimesh.creation.icosphere(1).export(tmp_path / "plain.stl")
    return str(tmp_path / "plain.stl")


def test_a_mesh_without_colours_is_given_one(plain):
    color = [0.9, 0.5, 0.1]
    mesh = load_object(ObjectSettings(plain, "orange", color=color)).mesh
    np.testing.assert_array_equal(mesh.corner_colors, np.broadcast_to(np.float32(color), mesh.corner_colors.shape))
    white = load_object(ObjectSettings(plain, "orange")).mesh
    np.testing.assert_array_equal(mesh.vertices, white.vertices)
    assert (white.corner_colors == 1).all()


def test_a_mesh_that_brings_colours_keeps_them():
    with pytest.raises(InputError, match="solid:orange brings colours of its own: leave color out"):
        load_object(ObjectSettings("solid:orange", "orange", color=[1.0, 0.0, 0.0]))


@pytest.mark.parametrize("color", [[1.0, 0.5], [1.0, 0.5, 0.1, 1.0], [0.0, 0.0, 1.5], [0.0, float("nan"), 0.0]])
def test_what_is_no_colour_is_refused(plain, color):
    with pytest.raises(InputError, match=r"plain\.stl: color=.* must be red, green and blue from 0 to 1"):
        ObjectSettings(plain, "orange", color=color)


def test_another_individual_stands_on_the_same_table():
    color = [0.2, 0.3, 0.4]
    item = on_ground(load_object(ObjectSettings("solid:apple", "apple")), color)
    other = another_individual(item, 5)
    expected = on_ground(load_object(ObjectSettings("solid:apple:5", "apple")), color)
    np.testing.assert_array_equal(other.mesh.vertices, expected.mesh.vertices)
    np.testing.assert_array_equal(other.mesh.corner_colors, expected.mesh.corner_colors)
