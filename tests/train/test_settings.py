"""Configurations: what Hydra or a dataclass refuses is one sentence with the key, and every default has one owner."""

import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from renderer.errors import InputError
from scripts.attack import main as attack_command
from scripts.evaluate import main as evaluate_command
from tests.runs import loaded_run
from train.__main__ import main as train_command
from train.command import Command, as_override, quoted
from train.data.batches import rounds_of_epoch
from train.settings import OTHER


@pytest.mark.parametrize("experiment", ["best", "classifier", "cpu", "demo", "fast", "harden", "paper"])
def test_every_experiment_takes_other_data(experiment):
    overrides = [f"experiment={experiment}", "data=npz", "data.path=a.npz", "train.init_from=b", "run=here"]
    settings = train_command.read(overrides)
    assert (settings.data.name, settings.data.path, settings.train.init_from in ("b", None)) == ("npz", "a.npz", True)


@pytest.mark.parametrize("experiment", ["harden", "best", "classifier"])
def test_an_experiment_that_fine_tunes_asks_for_the_network_to_begin_with(experiment):
    overrides = [f"experiment={experiment}", "data=npz", "data.path=a.npz", "run=here"]
    with pytest.raises(InputError, match=r"^train\.init_from is empty"):
        train_command.read(overrides)
    settings = train_command.read(["experiment=harden", "train.init_from=null", "run=here"])
    assert settings.train.init_from is None  # where random weights are asked for


def test_a_classifier_of_others_needs_no_class_but_the_label():
    settings = train_command.read(["experiment=classifier", "train.init_from=b", "run=a", "label=mug", "data.path=c"])
    assert {item.label for item in settings.objects.values()} == {"mug", OTHER} and settings.data.name == "unlabelled"


def test_the_demonstration_keeps_its_last_network_of_three_rounds_with_new_renders_each():
    settings = train_command.read(["run=here"])
    images, renders = round(0.9 * 10 * settings.data.train_per_class), settings.augment.examples
    rounds = rounds_of_epoch(images, renders, 0, 0, settings.train.images_per_epoch, settings.augment.every)
    assert settings.train.epochs == 1 and [len(part.rows) for part in rounds] == [120 + 480] * 3


def test_training_takes_the_parameters_of_the_attack_command_and_the_lighting_by_default():
    def parameters(*overrides: str) -> dict:
        return train_command.read(overrides).augment.attack.parameters

    light = parameters("augment.attack.step=sign", "augment.attack.step_size=0.1")
    assert [*light] == ["lighting"] and (light["lighting"].step, light["lighting"].step_size) == ("sign", 0.1)
    attack = attack_command.read(["attack=[geometry,lighting]"]).attack.parameters
    assert parameters("attack@augment.attack=[geometry,lighting]") == attack


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["train.epoch=3"], "train.epoch is not a setting: did you mean train.epochs?"),
        (["experimnt=best"], "experimnt is not a setting: did you mean experiment?"),
        (["+train.epoch=3"], "train.epoch is not a setting: did you mean train.epochs?"),
        (["data=npz", "data.pth=x"], "data.pth is not a setting: did you mean data.path?"),
        (["data=mnist"], "data=mnist is not a choice: choose one of cifar100, folder, npz"),
        (["attack@augment.attack=[lightning]"], "attack=lightning is not a choice"),
        (["scene.meshes=[~/a.obj]"], "scene.meshes=[~/a.obj] cannot be read"),
        (["seed=0,1"], "Ambiguous value for argument 'seed=0,1'"),
        (["~seed"], "~seed: a setting cannot be removed"),
        (["run="], "run is empty"),
        (["data=npz"], "data.path is not set"),
        (["train=3"], "train is a group of settings"),
        (["train.epochs=abc"], "train.epochs=abc must be a whole number"),
        (["train.epochs=null"], "train.epochs=null must be a whole number"),
        (["train.schedule=stepp"], "train.schedule=stepp: choose one of step, cosine, one_cycle"),
        (["scene.ground=[a]"], "scene.ground[0]"),
        (["compare=[[none]]"], "compare is"),
        ([f"scene.exposure={10**400}"], "scene.exposure is too large"),
        (["seed=-1"], "seed=-1 must be at least 0"),
        (["train.epochs=0"], "train.epochs=0 must be at least 1"),
        (["augment.attack.geometry.radius=1"], "augment.attack.geometry is null"),
        (
            ["attack@augment.attack=[geometry]", "augment.attack.geometry.radius=-1"],
            "augment.attack.geometry.radius=-1.0 must be at least 0",
        ),
        (["attack@augment.attack=[pose]"], "renderer.silhouettes=false"),
        (["scene.projector.pixels=abc"], "scene.projector.pixels is 'abc'"),
        (["scene.projector={pixls: 8}"], "scene.projector.pixls is not a setting"),
        (["evaluate.photos={renders: /x}"], "evaluate.photos: renders must be a name of letters"),
        (["augment=folder"], "augment.folder is None"),
        (["evaluate.photos=[/x]"], "evaluate.photos=['/x'] must be a folder, or a mapping"),
    ],
    ids=lambda given: given[-1] if isinstance(given, list) else "",
)
def test_a_wrong_setting_is_one_sentence_that_begins_with_its_key(overrides, key):
    with pytest.raises(InputError) as refusal:
        train_command.read(overrides)
    assert str(refusal.value).startswith(key) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("path", ["solid:orange", "/a folder/örange.glb", "'a, b'"])
def test_a_single_value_for_a_list_is_a_list_of_one(path):
    meshes = train_command.read([f"scene.hard_negatives={path}"]).scene.hard_negatives
    assert [str(mesh) for mesh in meshes] == [path.strip("'")]


def test_a_part_of_a_projector_is_set_alone_or_in_a_mapping():
    parts = train_command.read(["scene.projector.pixels=8", "+scene.projector.power=2"]).scene.projector
    whole = train_command.read(["scene.projector={pixels: 8, power: 2}"]).scene.projector
    assert (parts.pixels, parts.power) == (8, 2) and parts == whole


BOTH = ["label=[orange,pear]", "scene.meshes=['solid:orange','solid:pear']", "augment.examples=null", "scene.views=1"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data.validation=1.5"], "data.validation=1.5 must lie between 0 and 1"),
        (["data.name=mnist"], "data.name=mnist: choose one of cifar100, npz, folder, unlabelled, shapes"),
        (["scene.views=3"], "augment.examples=4 is not 2 meshes × 3 views × 2 backgrounds"),
        (["scene.meshes=[{mesh: 'solid:orange', lable: orange}]"], "scene.meshes[0].lable is not a setting"),
        (
            ["scene.hard_negatives=[{mesh: 'solid:orange', label: orange}]", "augment.examples=6"],
            "scene.hard_negatives[0] is of the class orange: name it in scene.meshes",
        ),
        (["train.device=cuda:99"], "device=cuda:99 is not available here"),
        (["scene.light=graze"], "'graze' is not known"),
        (["label=ornage"], "'ornage' is not a class of the model: choose one, such as orange"),
        ([*BOTH, "label=[orange,pear,lemon]"], "label: 'lemon' is not a class of the model"),
        (
            [*BOTH, "label=[orange,pear,orange]"],
            "label=[orange, pear, orange] must name a class, or several, each once",
        ),
        (["label=[]"], "label=[] must name a class, or several, each once"),
        (["label=[orange,apple]"], "label=['orange', 'apple'] has no mesh of apple: name one in scene.meshes"),
        (
            [*BOTH, "scene.meshes=[a.glb,'solid:pear']"],
            "scene.meshes[0] must name its class: give {mesh: a.glb, label",
        ),
        (
            [*BOTH, "label=[orange,pear,apple]", "scene.hard_negatives=['solid:fruit','solid:apple']"],
            "label=['orange', 'pear', 'apple'] has no mesh of apple",
        ),
        (
            [
                *BOTH,
                "label=[orange,pear,apple]",
                "scene.hard_negatives=['solid:fruit',{mesh: 'solid:apple', label: apple}]",
            ],
            "leaves no class of the network for other things: leave these out",
        ),
        (["augment=folder", "augment.folder=/no/lab"], "augment.folder: /no/lab is not a folder"),
        (["evaluate.photos={lab: /no/such/lab}"], "/no/such/lab is not a folder"),
    ],
    ids=lambda given: given[-1] if isinstance(given, list) else "",
)
def test_wrong_input_is_one_sentence_before_anything_is_written(tiny, tmp_path, overrides, message):
    with pytest.raises(InputError, match=re.escape(message)) as refusal:
        settings = tiny(*overrides)
        loaded_run(settings, tmp_path / "run")
    assert "\n" not in str(refusal.value) and not (tmp_path / "run").exists()


@given(st.text())
def test_quoted_text_is_read_as_it_is(text):
    (override,) = OverridesParser.create().parse_overrides([f"run={quoted(text)}"])
    assert str(override.value()) == text


KEYS = train_command.keys | evaluate_command.keys


@pytest.mark.parametrize(
    ("argument", "override"),
    [
        ("photos=2024", "photos='2024'"),
        ("evaluate.photos=1.10", "evaluate.photos='1.10'"),
        ("+data.path=1e3", "data.path='1e3'"),
        ("run=a\udcff", "run='a\udcff'"),
        ("out=a;b", "out='a;b'"),
        *((same, same) for same in ["train.epochs=3", "photos=none", "photos=2024,2025", "run=a/b.c", "2024"]),
        *((same, same) for same in ["run='ä'", "weights=null", "evaluate.photos={lab: 1}", "out=${run}/x", "out=~/a"]),
    ],
)
def test_a_name_stays_text_whatever_it_looks_like_to_hydra(argument, override):
    assert as_override(argument, KEYS) == override


def test_commands_that_need_outlines_take_the_samples_of_their_documented_accuracy():
    def samples(command: Command, *overrides: str) -> int:
        return command.read(overrides).renderer.image(8).samples

    attack = attack_command, "scene.meshes=[solid:orange]"
    assert samples(*attack, "attack=lighting") == 2
    assert samples(*attack, "attack=pose") == 8
    assert samples(*attack, "attack=geometry", "renderer.silhouettes=true") == 8
    assert samples(*attack, "attack=pose", "renderer.samples=4") == 4
    train = train_command, "run=here", "renderer.silhouettes=true"
    assert samples(*train, "renderer.samples=null") == 8
