import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from augment.augmentation_settings import AugmentationSettings
from renderer.errors import InputError
from scripts.attack import main as attack_command
from scripts.evaluate import main as evaluate_command
from scripts.render import main as render_command
from tests.runs import loaded_run
from train.__main__ import main as train_command
from train.cli import as_override, explain, quoted
from train.settings import OTHER, ExperimentSettings, TrainingSceneSettings
from train.system import user_message

OTHER_DATA = ["data=npz", "data.path=a.npz", "out=here"]
EXPERIMENTS = ["best", "classifier", "cpu", "demo", "dim", "fast", "harden", "low_light", "paper"]
EXPERIMENTS += ["patterns", "photographs", "stripes"]


CLASSIFIER = ["experiment=classifier", "network=b", "unlabeled=c"]
PHOTOGRAPHS = ["network=b", "unlabeled=c", "train.consistency_weight=1"]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_takes_other_data(experiment):
    settings = train_command.read([f"experiment={experiment}", *OTHER_DATA, "network=b"])
    assert settings.data.name == "npz"
    assert settings.data.path == "a.npz"
    assert settings.network == "b"


def test_a_classifier_of_another_library_needs_no_class_but_the_label():
    files = ["network=b", "out=a", "unlabeled=c"]
    settings = train_command.read(["experiment=classifier", "label=mug", *files])
    assert {item.label for item in settings.objects.values()} == {"mug", OTHER}
    assert settings.data.name == "unlabeled"


def test_a_solid_of_the_label_is_no_hard_negative_unless_it_is_of_another_class():
    negatives = ["solid:lemon", "solid:sweet_pepper", {"mesh": "solid:lemon", "label": "lime"}]
    scene = TrainingSceneSettings(views=1)
    augment = AugmentationSettings(examples=None)
    label = ["lemon", "Sweet pepper"]
    given = ExperimentSettings(label=label, hard_negatives=negatives, scene=scene, augment=augment)
    assert given.hard_negatives == negatives[2:]


def test_training_takes_the_parameters_of_the_attack_command():
    expected = attack_command.read(["attack=[geometry,lighting]"]).attack
    found = train_command.read(["attack@augment.attack=[geometry,lighting]"]).augment.attack
    assert found.parameters == expected.parameters


@pytest.mark.parametrize(
    ("overrides", "start"),
    [
        (["train.epoch=3"], "train.epoch is not a setting: did you mean train.epochs?"),
        (["batch_size=32"], "batch_size is not a setting: did you mean train.batch_size?"),
        (["scene.view=3"], "scene.view is not a setting: did you mean scene.views?"),
        (["tray=3"], "tray is not a setting: --help shows"),
        (["data=mnist"], "data=mnist is not a choice"),
        (["attack@augment.attack=[lightning]"], "attack=lightning is not a choice"),
        (["~seed"], "~seed: a setting cannot be removed"),
        (["out="], "out is empty"),
        (["scene.ground=[a]"], "scene.ground[0]"),
        (["augment.attack.geometry.radius=1"], "augment.attack.geometry is null"),
        (["train.epochs=2", "augment.attack.geometry={radius: 1}"], "augment.attack.geometry is"),
        (
            [
                *("attack@augment.attack=[geometry]", "augment.attack.geometry.radius=1"),
                "augment.attack.lamps={radius: 1}",
            ],
            "augment.attack.lamps is null",
        ),
        (
            ["attack@augment.attack=[geometry]", "augment.attack.geometry.radius=-1"],
            "augment.attack.geometry.radius=-1.0 must be at least 0",
        ),
        (["scene.projector.pixels=abc"], "scene.projector.pixels is 'abc'"),
        (["photos={renders: /x}"], "photos has the name 'renders'"),
        (["photos={random: /x}", "compare=[random]"], "photos has the name 'random'"),
        (["experiment=harden", *OTHER_DATA], "network is empty: give a run or "),
        # These lights have no factors for gradient steps.
        ([*PHOTOGRAPHS, "experiment=stripes", "train.relight_steps=1"], "train.relight_steps"),
        ([*PHOTOGRAPHS, "experiment=low_light", "train.relight_steps=1"], "train.relight_steps"),
        # These settings are of the consistency loss.
        ([*CLASSIFIER, "train.relight_steps=1"], "train.relight_steps"),
        ([*CLASSIFIER, "train.interpolate=1"], "train.interpolate"),
    ],
    ids=lambda given: given[-1] if isinstance(given, list) else "",
)
def test_a_wrong_setting_is_one_sentence_that_starts_with_its_key(overrides, start):
    with pytest.raises(Exception) as refusal:  # The command explains errors of Hydra.
        train_command.read(overrides)
    error = refusal.value
    sentence = user_message(error) or explain(error, train_command.keys, overrides)
    assert sentence.startswith(start)
    assert "\n" not in sentence


@pytest.mark.parametrize("name", ["projector", "lamps", "positions"])
def test_training_and_renders_add_the_lights_that_an_attack_changes_as_the_attack_does(name):
    expected = attack_command.read([f"attack=[{name}]"]).scene
    for command in (train_command, render_command):
        radius = f"augment.attack.{name}.radius=1"
        scene = command.read(["out=a", f"attack@augment.attack=[{name}]", radius]).scene
        assert (scene.projector, scene.lamps) == (expected.projector, expected.lamps)
        plain = command.read(["out=a"]).scene
        assert plain.projector is plain.lamps is None


@pytest.mark.parametrize("command", [train_command, render_command])
def test_an_attack_on_the_pose_has_gradients_at_silhouettes(command):
    assert command.read(["out=a", "attack@augment.attack=[pose]"]).renderer.silhouettes
    assert not command.read(["out=a"]).renderer.silhouettes


@pytest.mark.parametrize("path", ["/a folder/örange.glb", "'a, b'"])
def test_a_single_value_for_a_list_is_a_list_of_one(path):
    meshes = train_command.read([f"hard_negatives={path}"]).hard_negatives
    assert [str(mesh) for mesh in meshes] == [path.strip("'")]


def test_a_part_of_a_projector_is_set_alone_or_in_a_mapping():
    parts = train_command.read(["scene.projector.pixels=8", "+scene.projector.power=2"])
    whole = train_command.read(["scene.projector={pixels: 8, power: 2}"])
    assert parts.scene.projector.pixels == 8
    assert parts.scene.projector.power == 2
    assert parts.scene.projector == whole.scene.projector


TWO_CLASSES = ["label=[orange,pear]", "meshes=['solid:orange','solid:pear']"]
TWO_CLASSES += ["scene.views=1", "augment.examples=null"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["meshes=[{mesh: 'solid:orange', lable: orange}]"], "meshes[0].lable"),
        (
            ["hard_negatives=[{mesh: 'solid:orange', label: orange}]", "augment.examples=6"],
            "hard_negatives[0] is solid:orange, of the positive class orange",
        ),
        (["label=null"], "label is not set: give a class of the meshes"),
        ([*TWO_CLASSES, "label=[orange,pear,orange]"], "a list of several, each once"),
        (["label=[orange,apple]"], "label=['orange', 'apple'] has no mesh of apple"),
        ([*TWO_CLASSES, "meshes=[a.glb,'solid:pear']"], "meshes[0] has no class"),
        (
            [
                *TWO_CLASSES,
                "label=[orange,pear,apple]",
                "hard_negatives=['solid:fruit',{mesh: 'solid:apple', label: apple}]",
            ],
            "has all classes of the network",
        ),
    ],
    ids=lambda given: given[-1] if isinstance(given, list) else "",
)
def test_wrong_input_is_one_sentence_before_anything_is_written(tiny, tmp_path, overrides, message):
    with pytest.raises(InputError, match=re.escape(message)) as refusal:
        loaded_run(tiny(*overrides), tmp_path / "run")
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "run").exists()


PARSER = OverridesParser.create()


@given(st.text(st.sampled_from("'\"\\ aä,:=[]{}$~\n"), max_size=10))
def test_quoted_text_is_read_as_it_is(text):
    (override,) = PARSER.parse_overrides([f"out={quoted(text)}"])
    assert str(override.value()) == text


KEYS = train_command.keys | evaluate_command.keys
OVERRIDES = ["train.epochs=3", "photos=none", "out=a/b.c", "2024", "out='ä'", "weights=null"]
OVERRIDES += ["photos={lab: 1}", "out=${run}/x"]


@pytest.mark.parametrize(
    ("argument", "override"),
    [
        ("photos=2024,2025", "photos='2024','2025'"),
        ("label=[1, cup]", "label=['1',cup]"),
        ("label=null,1.10, cup", "label=null,'1.10',cup"),
        ("+data.path=1e3", "data.path='1e3'"),
        ("out=a\udcff", "out='a\udcff'"),
        ("out=a;b", "out='a;b'"),
        *((argument, argument) for argument in OVERRIDES),
    ],
)
def test_only_a_name_that_is_no_text_to_hydra_is_quoted(argument, override):
    assert as_override(argument, KEYS) == override
