from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import nn

import norm_balls as nb
from augment.classifier import OperatingPoint
from tests.helpers import save_noise
from tests.runs import completed_run
from train.__main__ import main

SIZE = 8
CLASSES = ["apple", "orange", "pear"]
# Fields of the settings with which a training takes seconds.
SHORT = {"train": {"epochs": 1, "images_per_epoch": 16, "batch_size": 8}, "data": {"workers": 0}}
SHORT["scene"] = {"views": 1, "backgrounds": [0.5]}
SHORT["renderer"] = {"rasterizer": "numpy", "samples": 1}


def build() -> nn.Sequential:
    layers = [nn.Linear(12, 8), nn.Tanh(), nn.Linear(8, 3)]
    return nn.Sequential(nn.AdaptiveAvgPool2d(2), nn.Flatten(), *layers)


def load() -> tuple[nn.Module, int, list[str]]:
    network = build()
    network.load_state_dict(torch.load("weights.pth"))
    return network.eval(), SIZE, CLASSES


@pytest.fixture
def network() -> nn.Sequential:
    torch.manual_seed(0)
    return build().eval()


@pytest.fixture
def photographs(tmp_path) -> Path:
    rng = np.random.default_rng(0)
    for index in range(20):
        save_noise(tmp_path / "photographs" / f"{index}.png", rng, (SIZE, SIZE))
    return tmp_path / "photographs"


def harden(network, photographs, meshes=("solid:orange:0",), **options) -> nn.Module:
    given = {"classes": CLASSES, "size": SIZE, "hard_negatives": ["solid:lemon"]} | SHORT | options
    return nb.harden(network, meshes, photographs, **given)


def test_the_result_loads_alike_and_nothing_changes(network, photographs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = deepcopy(network.state_dict())
    random_state = torch.get_rng_state()
    threads = torch.get_num_threads()
    files = sorted(tmp_path.rglob("*"))
    hardened = harden(network, photographs, normalization="imagenet")
    assert all(value.equal(weights[name]) for name, value in network.state_dict().items())
    assert all(parameter.requires_grad for parameter in network.parameters())
    assert torch.equal(torch.get_rng_state(), random_state)
    assert torch.get_num_threads() == threads
    assert sorted(tmp_path.rglob("*")) == files

    assert type(hardened) is type(network) and not hardened.training
    fresh = build()
    fresh.load_state_dict(hardened.state_dict(), strict=True)
    assert not torch.equal(fresh[4].weight, network[4].weight)
    # The layers before the last one do not learn.
    assert torch.equal(fresh[2].weight, network[2].weight)


def test_the_weights_are_those_of_the_command(network, photographs, tmp_path, monkeypatch):
    """The command builds the network by a function of a user's module."""
    monkeypatch.chdir(tmp_path)
    torch.save(network.state_dict(), "weights.pth")
    overrides = [
        *("experiment=classifier", "network=python:tests.train.commands.test_harden:load"),
        *(f"unlabeled={photographs}", "data.workers=0", "meshes=[solid:orange:0]"),
        *("hard_negatives=[solid:lemon]", "scene.views=1", "scene.backgrounds=[0.5]"),
        *("renderer.rasterizer=numpy", "renderer.samples=1", "train.epochs=1"),
        *("train.images_per_epoch=16", "train.batch_size=8", "train.cache=null"),
        *("train.device=cpu", "evaluate.laboratory_setups=0"),
    ]
    completed_run(main.read(overrides), tmp_path / "run")
    expected = torch.load(tmp_path / "run" / "weights.pt")
    hardened = harden(network, photographs, out=tmp_path / "hardened")
    assert all(value.equal(expected[name]) for name, value in hardened.state_dict().items())
    written = torch.load(tmp_path / "hardened" / "weights.pt")
    assert all(value.equal(expected[name]) for name, value in written.items())
    other = deepcopy(network)
    other[4].weight.data[0] += 1e-3
    resumed = {"out": tmp_path / "hardened", "train": SHORT["train"] | {"resume": True}}
    again = harden(network, photographs, **resumed)
    assert all(value.equal(expected[name]) for name, value in again.state_dict().items())
    with pytest.raises(nb.InputError, match="other weights"):
        harden(other, photographs, **resumed)


@pytest.mark.parametrize(
    ("key", "section"),
    [
        ("train.epoch", {"train": {"epoch": 1}}),
        ("train.epochs", {"train": {"epochs": "many"}}),
        ("scene.views", {"scene": {"views": [1]}}),
        ("logger", {"logger": print}),
    ],
)
def test_a_wrong_argument_is_refused_by_its_key(network, photographs, key, section):
    with pytest.raises(nb.InputError, match=f"^{key}\\b"):
        harden(network, photographs, **section)


def test_a_hardened_classifier_has_no_threshold_of_the_original(network, photographs):
    classifier = nb.Classifier(network, SIZE, CLASSES, name="mine")
    classifier.operating_points = [OperatingPoint("orange", 0.5, 0.05, "lab", "", 20)]
    hardened = harden(classifier, photographs, classes=None, size=None)
    assert isinstance(hardened, nb.Classifier)
    assert hardened.name == "mine"
    assert not hardened.operating_points
    images = torch.rand(2, 3, SIZE, SIZE)
    assert not torch.equal(hardened(images), classifier(images))


@pytest.mark.slow
def test_each_mesh_trains_the_class_that_it_or_its_file_names(network, photographs, tmp_path):
    file = tmp_path / "PEAR.ply"
    trimesh.creation.box().export(file)
    meshes = ["solid:orange:0", file]
    options = {"hard_negatives": ["solid:fruit"]}
    hardened = harden(network, photographs, meshes=meshes, **options)
    named = harden(network, photographs, [("solid:orange:0", 1), (str(file), "pear")], **options)
    swapped = harden(network, photographs, [("solid:orange:0", "pear"), (str(file), 1)], **options)
    assert torch.equal(hardened[4].weight, named[4].weight)
    assert not torch.equal(hardened[4].weight, swapped[4].weight)


@pytest.mark.slow
def test_a_copy_trained_in_normalized_light_has_the_weights_without_it(network, photographs):
    plain = harden(network, photographs, normalize_light=True)
    classifier = nb.Classifier(deepcopy(network), SIZE, CLASSES, normalize_light=True)
    hardened = harden(classifier, photographs, classes=None, size=None)
    assert type(plain) is type(network)
    assert hardened.normalized_light == nb.NormalizedLightSettings()
    assert torch.equal(hardened.network.network[4].weight, plain[4].weight)
    assert not torch.equal(plain[4].weight, harden(network, photographs)[4].weight)


@pytest.mark.slow
def test_a_mesh_in_memory_trains_as_its_file_does(network, photographs, tmp_path):
    nb.export_mesh(nb.Gloss(0.6).on(nb.solid("orange", 0)), tmp_path / "a.glb")
    nb.export_mesh(nb.solid("lemon"), tmp_path / "b.glb")
    mesh = nb.load_mesh(tmp_path / "a.glb", gloss=True)
    negative = nb.load_mesh(tmp_path / "b.glb")
    item = nb.ObjectSettings(str(tmp_path / "a.glb"), "orange", gloss="file")
    options = {"hard_negatives": [tmp_path / "b.glb"], "seed": 3}
    expected = harden(network, photographs, meshes=[item], **options)
    options = {"hard_negatives": [negative], "seed": 3, "out": tmp_path / "run"}
    hardened = harden(network, photographs, meshes=[(mesh, 1)], **options)
    assert torch.equal(hardened[4].weight, expected[4].weight)
    assert not [*(tmp_path / "run").rglob("*.glb")]


@pytest.mark.filterwarnings("ignore:.*deprecated")
def test_a_network_of_a_file_is_hardened_for_the_index_of_a_class(network, photographs, tmp_path):
    """The file has no class names. The module of the file itself cannot be trained."""
    path = str(tmp_path / "network.pt")
    torch.jit.save(torch.jit.trace(network, torch.rand(2, 3, SIZE, SIZE)), path)
    classifier = nb.load_classifier(path, size=SIZE, trust_code=True)
    hardened = harden(classifier, photographs, classes=None, size=None, label=1)
    expected = harden(network, photographs, classes=None, label=1)
    weights = dict(hardened.named_parameters())
    last = next(value for name, value in weights.items() if name.endswith("4.weight"))
    torch.testing.assert_close(last, expected[4].weight)
    with pytest.raises(nb.InputError, match="load_classifier"):
        harden(torch.jit.load(path), photographs, label=1)
