import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from renderer.errors import InputError
from train.run_folder.checkpoint import BEST, save
from train.run_folder.classifier import PUBLISHED, load_classifier, publish
from train.wideresnet import WideResNet

PRETRAINED = Path(__file__).parents[3] / "pretrained"
DATA = Path(__file__).parents[4] / "shared" / "data"


@pytest.fixture
def run(tmp_path) -> Path:
    torch.manual_seed(0)
    network = WideResNet(2, 10, 1, 0.3, mean=(0.1, 0.2, 0.3), std=(0.3, 0.2, 0.1))
    architecture = {"classes": ["fig", "lime"], "size": 48, "depth": 10, "width": 1, "dropout": 0.3}
    save(tmp_path / BEST, {"model": network.state_dict(), "architecture": architecture})
    return tmp_path


@pytest.mark.parametrize("file", ["", BEST], ids=["folder", "file"])
def test_a_run_is_a_classifier_of_its_own_classes_at_its_own_size(run, file):
    classifier = load_classifier(f"run:{run / file}")
    assert (classifier.classes, classifier.size) == (("fig", "lime"), 48)
    assert classifier.name == f"run:{run / file}"
    network = WideResNet(2, 10, 1).eval()
    network.load_state_dict(torch.load(run / BEST, weights_only=True)["model"])
    images = torch.rand(3, 3, 48, 48)
    assert torch.equal(classifier(images), network(images))


def test_a_published_run_is_a_classifier_too(run):
    publish(run / PUBLISHED, torch.load(run / BEST, weights_only=True))
    (run / BEST).unlink()
    assert load_classifier(f"run:{run}").label("lime") == 1


def test_classifiers_of_other_sources_are_loaded_by_the_same_name():
    with pytest.raises(InputError, match="classifier=squeezenet_caffe comes without weights"):
        load_classifier("squeezenet_caffe")


@pytest.mark.parametrize(
    "name, weights, message",
    [
        ("run:absent", None, "run=absent holds neither best.pt nor model.safetensors"),
        ("run:absent", "a.pth", "weights=a.pth is not for classifier=run:absent, which has weights of its own: leave"),
        ("runs/2026-01-01", None, "squeezenet_caffe, torchvision:NAME, python:NAME, run:NAME"),
    ],
)
def test_what_cannot_be_loaded_is_one_sentence(name, weights, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_classifier(name, weights)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("arm", ["none", "random", "adversarial"])
def test_the_published_networks_are_classifiers_of_cifar_100(arm):
    classifier = load_classifier(f"run:{PRETRAINED / arm}")
    assert (len(classifier.classes), classifier.size, classifier.label("orange")) == (100, 32, 53)
    images = torch.full((1, 3, 32, 32), 0.5, requires_grad=True)
    (gradient,) = torch.autograd.grad(classifier(images)[0, 53], images)
    assert gradient.isfinite().all() and gradient.any()


@pytest.mark.realdata
@pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")
def test_the_published_base_recognises_most_oranges_in_rgb():
    """And hardly one with red and blue exchanged, unlike the networks that were hardened against light."""
    classifier = load_classifier(f"run:{PRETRAINED / 'none'}")
    paths = sorted((DATA / "photos" / "orange").iterdir())[::9]
    squares = [ImageOps.fit(Image.open(path).convert("RGB"), (32, 32), Image.Resampling.LANCZOS) for path in paths]
    images = torch.from_numpy(np.stack(squares)).permute(0, 3, 1, 2).float() / 255
    with torch.no_grad():
        recall, swapped = ((classifier(each).argmax(1) == 53).float().mean() for each in (images, images.flip(1)))
    assert recall > 0.6 and swapped < 0.05
