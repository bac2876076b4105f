import pytest

from renderer.errors import InputError
from train.classes import class_index

CLASSES = ("apple", "orange", "sweet_pepper")


def test_a_class_is_found_by_name():
    assert [class_index(CLASSES, name, "label") for name in CLASSES] == [0, 1, 2]


def test_a_mistyped_class_is_answered_with_its_key_and_the_nearest():
    with pytest.raises(
        InputError, match=r"scene\.meshes: 'ornage' is not a class of the model: choose one, such as orange"
    ):
        class_index(CLASSES, "ornage", "scene.meshes")
