"""The commands with a user's own network of ten classes, as it was trained and saved elsewhere."""

import argparse
import json
from functools import cache
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor, nn
from torchvision.models import mobilenet_v3_small
from torchvision.transforms.functional import normalize

import augment
from renderer.errors import InputError
from renderer.image import to_bytes
from train.__main__ import main as train_command
from train.networks import build_network
from train.training.inputs import load_initial
from train.training.run import _network_shape

NAME = "mobilenet_v3_small"
SIZE = 32
CLASSES = (
    *("Apple", "ball", "bottle", "cup", "lemon", "mushroom", "Orange", "pear", "plate"),
    "Sweet pepper",
)
IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
OWN = [
    *(f"network=torchvision:{NAME}", "weights=mine.pth", "classes=classes.txt", f"size={SIZE}"),
    "device=cpu",
]
# Sums of some thousand products in another order.
ROUNDING = {"rtol": 1e-4, "atol": 1e-4}


@cache
def renders() -> Tensor:
    """Return an image of each class in uniform light, shape (10, 3, 32, 32)."""
    images = []
    for name in CLASSES:
        item = (f"solid:{name.lower().replace(' ', '_')}:0", name)
        scene = augment.build_scene([item], SIZE, samples=1)
        example = torch.arange(1)
        images.append(scene.render(scene.conditions(example), example)[0])
    return torch.cat(images)


@cache
def trained_weights() -> dict[str, Tensor]:
    """Fit the last layer, so that the logit of an image is 10 for its class, and otherwise 0."""
    torch.manual_seed(0)
    network = mobilenet_v3_small(num_classes=len(CLASSES))
    images = normalize(renders(), *IMAGENET)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = None  # The statistics are those of the images.
    with torch.no_grad():
        network(images)
        features = network.eval().features(images).mean((2, 3))
        hidden = network.classifier[:3](features).double()
        ones = torch.ones(len(images), 1)
        weights = torch.linalg.pinv(torch.cat([hidden, ones], dim=1)).T * 10
        network.classifier[3].weight.copy_(weights[:, :-1])
        network.classifier[3].bias.copy_(weights[:, -1])
    return network.state_dict()


def trained_network() -> nn.Module:
    network = mobilenet_v3_small(num_classes=len(CLASSES))
    network.load_state_dict(trained_weights())
    return network.eval()


@pytest.fixture
def here(tmp_path) -> Path:
    torch.save(trained_weights(), tmp_path / "mine.pth")
    (tmp_path / "classes.txt").write_text("\n".join(CLASSES) + "\n")
    for name, image in zip(CLASSES, renders(), strict=True):
        (tmp_path / "photos" / name).mkdir(parents=True)
        pixels = to_bytes(image.permute(1, 2, 0)).numpy()
        Image.fromarray(pixels).save(tmp_path / "photos" / name / "0.png")
    return tmp_path


@pytest.mark.parametrize(
    "wrap",
    [
        # The training scripts of torchvision save such a file.
        lambda state: {"model": state, "args": argparse.Namespace(batch_size=32)},
        lambda state: {
            "model_state_dict": {f"module._orig_mod.{key}": value for key, value in state.items()}
        },
    ],
    ids=["torchvision's", "compiled"],
)
def test_weights_load_from_the_usual_wrappers(tmp_path, wrap):
    torch.save(wrap(trained_weights()), tmp_path / "wrapped.pth")
    loaded = augment.load_classifier(f"torchvision:{NAME}", tmp_path / "wrapped.pth")
    for name, value in trained_weights().items():
        torch.testing.assert_close(loaded.network.network.state_dict()[name], value, rtol=0, atol=0)


def test_a_pickled_module_is_refused_with_lines_that_save_its_weights(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(trained_network(), "whole.pth")
    with pytest.raises(InputError) as caught:
        augment.load_classifier(f"torchvision:{NAME}", "whole.pth")
    first, second = str(caught.value).split("the two lines ")[1].split(" and ")
    exec(f"{first}\n{second}", {"torch": torch})
    augment.load_classifier(f"torchvision:{NAME}", "weights.pth")
    with pytest.raises(InputError, match="contains a pickled module"):
        augment.load_classifier("whole.pth")


def test_names_and_weights_of_different_numbers_of_classes_are_counted_in_the_error(here):
    with pytest.raises(InputError, match=r"classes has 9 names, and weights=.* has 10 classes"):
        augment.load_classifier(f"torchvision:{NAME}", here / "mine.pth", CLASSES[:9])


@pytest.mark.slow
def test_an_attack_and_an_evaluation_find_the_class_by_its_index(call, here):
    label = f"label={CLASSES.index('Orange')}"
    words = ["attack.max_steps=1", "attack.checks=false", "attack.verify=null"]
    scene = ["meshes=solid:orange:0", "renderer.shadows=false", "out=attack"]
    assert call("attack", *OWN, label, *words, *scene) == 0
    (line,) = (here / "attack" / "0_solid_orange_0" / "attack.jsonl").read_text().splitlines()
    assert json.loads(line)["label"] == ["Orange"]
    assert call("evaluate", *OWN, "photos=photos", label, "out=scores") == 0
    scores = json.loads((here / "scores" / "summary.json").read_text())
    assert scores["recall"]["value"] == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_a_network_in_a_file_begins_with_the_normalization_of_the_user(here, monkeypatch):
    monkeypatch.chdir(here)
    network = trained_network().eval()
    torch.jit.trace(network, torch.rand(2, 3, SIZE, SIZE)).save("mine.ts")
    words = ["network=mine.ts", "normalization=imagenet"]
    words += ["trust=true", "classes=classes.txt", f"size={SIZE}", "unlabeled=photos"]
    scene = ["meshes=[solid:orange]", "label=Orange"]
    settings = train_command.read(["experiment=classifier", *words, *scene])
    initial = load_initial(settings)
    shape = _network_shape(settings, initial)
    built = build_network(initial.classes, SIZE, trust_code=True, **shape)
    initial.copy_to(built, shape | {"classes": list(initial.classes), "size": SIZE})
    images = renders()[:4]
    torch.testing.assert_close(built(images), network(normalize(images, *IMAGENET)), **ROUNDING)
