import re
from dataclasses import replace
from functools import cache

import pytest

from renderer.errors import InputError
from train import class_names
from train.__main__ import main as train_command
from train.settings import ExperimentSettings

CLASSES = ["banana", "coffee mug", "lemon", "orange"]


@cache
def composed() -> ExperimentSettings:
    return train_command.read(["experiment=classifier", "network=a", "unlabeled=b", "out=c"])


def settings(meshes: list, hard_negatives: list | None = None) -> ExperimentSettings:
    return replace(composed(), meshes=meshes, hard_negatives=hard_negatives or [])


def test_label_lists_the_classes_of_labels_files_and_solids_once():
    scan = {"mesh": "scan.glb", "label": "banana", "albedo_scale": 2.0}
    other = {"mesh": "other_scan.glb", "label": 0}
    meshes = [scan, "objects/Coffee_Mug.glb", other, "solid:lemon:3"]
    named = class_names.with_class_names(settings(meshes), CLASSES)
    assert named.label == ["banana", "coffee mug", "lemon"]
    labels = [item.label for item in named.objects.values()]
    assert labels == ["banana", "coffee mug", "banana", "lemon"]
    assert named.meshes[0]["albedo_scale"] == 2.0


@pytest.mark.parametrize("label", [None, "orange"])
def test_objects_beside_a_mesh_stay_and_get_the_names_of_their_classes(label):
    group = ["solid:orange", {"mesh": "solid:lemon", "label": 2, "at": [2.0, 0.0]}]
    named = class_names.with_class_names(replace(settings([group]), label=label), CLASSES)
    (item,) = named.objects.values()
    (other,) = item.others
    assert (item.mesh, item.label) == ("solid:orange", "orange")
    assert (other.mesh, other.label) == ("solid:lemon", "lemon")


def test_generated_hard_negatives_of_these_classes_are_left_out():
    negatives = ["solid:fruit", "solid:lemon", {"mesh": "solid:orange", "label": 3}]
    named = class_names.with_class_names(settings(["lemon.glb"], negatives), CLASSES)
    assert named.label == "lemon"
    assert named.hard_negatives == ["solid:fruit", {"mesh": "solid:orange", "label": "orange"}]


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ("bananas.glb", "label is not set, and bananas.glb is not named like a class"),
        ("absent.glb", "absent.glb does not exist"),
        ("solid:ornage", "solid:ornage is not a solid: choose one, such as orange"),
        ({"mesh": "a.glb", "label": 4}, "meshes[0].label: the label 4 is not a class"),
        ({"mesh": "a.glb", "label": "mug"}, "meshes[0].label: 'mug' is not a class"),
    ],
)
def test_a_mesh_of_no_class_is_refused_in_one_sentence(mesh, message, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bananas.glb").touch()
    with pytest.raises(InputError, match=re.escape(message)):
        class_names.with_class_names(settings([mesh]), CLASSES)
