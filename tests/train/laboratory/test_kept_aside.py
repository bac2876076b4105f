from dataclasses import replace

import pytest

from train.__main__ import main as train_command
from train.command_settings import TRAINED_PATTERNS
from train.laboratory.laboratory import kept_aside_settings
from train.settings import ExperimentSettings


@pytest.fixture(scope="module")
def settings() -> ExperimentSettings:
    """Read the settings of the hardening of a classifier by an orange and other fruit."""
    words = ("experiment=classifier", "network=pretrained/none", "unlabeled=photos")
    meshes = "meshes=[solid:orange:0,solid:orange]"
    return train_command.read([*words, "label=orange", meshes])


def test_no_instance_and_no_pattern_is_one_of_training(settings, tmp_path):
    aside = kept_aside_settings(settings, ["orange", "apple"], 32, tmp_path)
    trained = {item.mesh for item in settings.objects.values()}
    meshes = [item["mesh"] for item in aside.meshes]
    assert trained.isdisjoint(meshes)
    assert all(len(mesh.split(":")) == 3 for mesh in meshes)
    assert set(aside.patterns).isdisjoint(TRAINED_PATTERNS)
    # The runs of a sweep are compared on the same images.
    other = replace(settings, seed=5)
    assert kept_aside_settings(other, ["orange", "apple"], 32, tmp_path) == aside


def test_hard_negatives_have_the_class_of_the_network_or_none(settings, tmp_path):
    aside = kept_aside_settings(settings, ["orange", "Sweet pepper"], 32, tmp_path)
    labels = {item["label"] for item in aside.meshes}
    assert {"orange", "Sweet pepper", "other_apple", "other_lemon"} <= labels
    assert "other_orange" not in labels


@pytest.mark.parametrize("label", ["mug", "sweet pepper"])
def test_a_class_has_meshes_of_training_only_if_it_cannot_be_generated(settings, label, tmp_path):
    own = replace(settings, label=label, meshes=[{"mesh": "own.glb", "label": label}])
    aside = kept_aside_settings(own, [label], 32, tmp_path)
    meshes = [item["mesh"] for item in aside.meshes if item["label"] == label]
    assert (meshes == ["own.glb"]) == (label == "mug")
