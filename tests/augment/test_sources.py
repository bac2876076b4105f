import importlib
import os
import re
import sys
from pathlib import Path
from unittest.mock import Mock
from urllib.error import URLError

import pytest
import torch
from torch import nn
from torchvision.models import get_model, get_model_weights, squeezenet1_0, squeezenet1_1
from torchvision.transforms.functional import normalize

from augment.classifier import Classifier
from augment.sources import imagenet_classes, load_classifier
from renderer.errors import InputError

CLASSES = imagenet_classes()
EPS32 = torch.finfo(torch.float32).eps
LITE_SIZES = {0: 224, 2: 260}


def random_images(size: int, count: int = 2) -> torch.Tensor:
    return torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(0))


def first_input(classifier: Classifier, images: torch.Tensor) -> torch.Tensor:
    inputs = []
    convolutions = (module for module in classifier.modules() if isinstance(module, nn.Conv2d))

    def record(module: nn.Module, arguments: tuple) -> None:
        inputs.append(arguments[0])

    hook = next(convolutions).register_forward_pre_hook(record)
    with torch.no_grad():
        classifier(images)
    hook.remove()
    return inputs[0]


def file_name(weights) -> str:
    return weights.url.rpartition("/")[2]


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def test_imagenet_class_names_are_unique_and_in_the_order_of_the_synsets():
    """The positions are those of n07747607, n02012849, n03126707, n03710637 and n03710721."""
    assert len(CLASSES) == 1000
    assert len(set(CLASSES)) == 1000
    names = [CLASSES[index] for index in (950, 134, 517, 638, 639)]
    assert names == ["orange", "crane bird", "crane", "maillot", "maillot tank suit"]


@pytest.mark.parametrize(("version", "size"), LITE_SIZES.items())
def test_efficientnet_lite_gets_images_in_its_own_units(version, size):
    name = f"efficientnet_lite{version}"
    classifier = load_classifier(name)
    assert classifier.name == name
    assert classifier.size == size
    assert classifier.classes == CLASSES
    images = random_images(size, 1)
    expected = (255 * images.double() - 127) / 128
    # Numbers up to 1, in units of 1/2, are rounded three times.
    found = first_input(classifier, images).double()
    torch.testing.assert_close(found, expected, rtol=0, atol=4 * EPS32)


@pytest.fixture(scope="module")
def squeezenet_file(tmp_path_factory) -> Path:
    torch.manual_seed(0)
    network = squeezenet1_0()
    nn.init.uniform_(network.classifier[1].bias, -0.1, 0.1)
    path = tmp_path_factory.mktemp("weights") / "squeezenet.pth"
    torch.save(network.state_dict(), path)
    return path


@pytest.fixture(scope="module")
def squeezenet(squeezenet_file) -> Classifier:
    return load_classifier("squeezenet_caffe", squeezenet_file)


def test_squeezenet_of_caffe_gets_blue_first_and_unscaled_images(squeezenet):
    assert squeezenet.name == "squeezenet_caffe"
    assert squeezenet.size == 227
    assert squeezenet.classes == CLASSES
    images = random_images(227, 1)
    red, green, blue = 255 * images[0].double()
    expected = torch.stack([blue - 104, green - 117, red - 123])[None]
    # Numbers up to 1, in units of 1/255, are rounded three times.
    found = first_input(squeezenet, images).double()
    torch.testing.assert_close(found, expected, rtol=0, atol=3 * 255 * EPS32)


def test_the_last_convolution_of_squeezenet_is_padded_by_one(squeezenet, squeezenet_file):
    """Of the 15 × 15 values that are averaged, 56 are the bias alone."""
    plain = squeezenet1_0()
    plain.load_state_dict(torch.load(squeezenet_file, weights_only=True))
    images = random_images(227, 1)
    with torch.no_grad():
        # Mean of the inner 13 × 13 features.
        mean_of_inner = plain.eval()(first_input(squeezenet, images))
        border = plain.classifier[1].bias.relu()
        logits = squeezenet(images)
    expected = (13**2 * mean_of_inner + (15**2 - 13**2) * border) / 15**2
    # The sum of up to 512 · 9 products has another order in the two networks.
    rounding = 100 * EPS32 * float(expected.abs().max())
    torch.testing.assert_close(logits, expected, rtol=0, atol=rounding)


def as_in_2017(state: dict) -> dict:
    """Return the weights with dots in the names of layers and without counts of batches."""
    old = {}
    for key, value in state.items():
        if not key.endswith("num_batches_tracked"):
            old[re.sub(r"(norm|conv)([12])\.", r"\1.\2.", key)] = value
    return old


@pytest.mark.parametrize(
    ("model", "arguments", "published"),
    [("densenet121", {}, as_in_2017), ("googlenet", {"init_weights": False}, dict)],
)
def test_torchvision_models_give_its_logits_from_file_or_download(hub, model, arguments, published):
    """The file lies where torchvision would have downloaded it."""
    torch.manual_seed(0)
    weights = get_model_weights(model).DEFAULT
    path = hub / file_name(weights)
    torch.save(published(get_model(model, **arguments).state_dict()), path)
    own = get_model(model, weights=weights).eval()
    size = weights.transforms().crop_size[0]
    images = random_images(size, 1)
    with torch.no_grad():
        expected = own(weights.transforms(resize_size=size)(images))
    # Thousands of products are summed in another order, over up to 121 layers.
    rounding = 100 * EPS32 * float(expected.abs().max())
    name = f"torchvision:{model}"
    downloaded = load_classifier(name)
    for classifier in (downloaded, load_classifier(name, path.rename(path.with_name("mine.pth")))):
        with torch.no_grad():
            logits = classifier(images)
        torch.testing.assert_close(logits, expected, rtol=0, atol=rounding)
        assert classifier.name == name
        assert classifier.classes == CLASSES


@pytest.mark.parametrize("model", ["googlenet", "inception_v3"])
@pytest.mark.parametrize("has_auxiliary", [False, True])
def test_auxiliary_classifiers_of_training_are_left_out(tmp_path, model, has_auxiliary):
    """Fine-tuning replaces the last layer alone, so that the others keep 1,000 classes."""
    torch.manual_seed(0)
    options = {"transform_input": True, "init_weights": False, "aux_logits": has_auxiliary}
    own = get_model(model, **options).eval()
    own.fc = nn.Linear(own.fc.in_features, 7)
    torch.save(own.state_dict(), tmp_path / "mine.pth")
    classifier = load_classifier(f"torchvision:{model}", tmp_path / "mine.pth", size=96)
    images = random_images(96, 1)
    with torch.no_grad():
        logits = classifier(images)
        expected = own(normalize(images, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    rounding = 100 * EPS32 * float(expected.abs().max())
    torch.testing.assert_close(logits, expected, rtol=0, atol=rounding)


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harm",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (Harmful(), "cannot be read"),
        (None, "a value of type NoneType"),
        (torch.zeros(3), "a value of type Tensor"),
        # Weights whose last bias has ten values.
        ({"classifier.1.bias": torch.zeros(10)}, "torchvision:squeezenet1_1"),
    ],
)
def test_a_file_of_other_weights_is_named_and_runs_no_code(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "squeezenet.pth"
    if isinstance(content, dict):
        content = squeezenet1_1().state_dict() | content
    torch.save(content, path)
    with pytest.raises(InputError, match=message) as caught:
        load_classifier("torchvision:squeezenet1_1", path)
    assert str(caught.value).startswith(f"weights={path}")
    assert not Path("harm").exists()


@pytest.mark.parametrize("cached", [b"", b"half a file"], ids=["no network", "damaged copy"])
def test_a_failed_download_asks_for_a_file(hub, monkeypatch, cached):
    unknown = Mock(side_effect=URLError("Name or service not known"))
    monkeypatch.setattr("torch.hub.urlopen", unknown)
    weights = get_model_weights("squeezenet1_1").DEFAULT
    if cached:
        (hub / file_name(weights)).write_bytes(cached)
    message = f"^name=torchvision:squeezenet1_1 .*weights=FILE.*{weights.url}$"
    with pytest.raises(InputError, match=message):
        load_classifier("torchvision:squeezenet1_1")


def test_a_size_that_the_patches_of_a_transformer_do_not_fill_is_refused(tmp_path):
    torch.save({"weight": torch.zeros(1)}, tmp_path / "a.pth")
    with pytest.raises(InputError, match=r"vit_b_16 cannot be built .*size="):
        load_classifier("torchvision:vit_b_16", tmp_path / "a.pth", size=100)


SOURCE = """
from torch import nn

def red_or_not():
    network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 2))
    return network, 16, ["red", "other"]

def wide(): return red_or_not()[0], (8, 16), ["red", "other"]
def no_size(): return nn.Identity(), "16", ["red"]
def huge(): return nn.Identity(), 10**9, ["red"]
def leaves(): raise SystemExit(0)
def broken(): return 1 / 0
"""


@pytest.fixture
def own_networks(tmp_path, monkeypatch) -> None:
    (tmp_path / "own_networks.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_networks", raising=False)


@pytest.mark.parametrize(("name", "size", "height"), [("red_or_not", 16, 16), ("wide", (8, 16), 8)])
def test_a_function_in_the_current_folder_makes_a_classifier(own_networks, name, size, height):
    classifier = load_classifier(f"python:own_networks:{name}")
    assert classifier.size == size
    assert classifier.classes == ("red", "other")
    assert not classifier.training
    assert classifier(torch.rand(2, 3, height, 16)).shape == (2, 2)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_networks", "python:package.module:function"),
        ("absent:f", "there is no module absent"),
        ("own_networks:hug", "has no function hug: did you mean huge"),
        ("own_networks:no_size", r"\(Identity, str, list\)"),
        ("own_networks:leaves", r"SystemExit.*line \d+ of .*own_networks.py"),
        ("own_networks:broken", r"ZeroDivisionError.*line \d+ of .*own_networks.py"),
    ],
)
def test_a_function_that_makes_no_classifier_is_refused(own_networks, name, message):
    with pytest.raises(InputError, match=f"^(name=|classifier )python:{name}.*{message}"):
        load_classifier(f"python:{name}")


@pytest.mark.parametrize("model", ["eva02_tiny_patch14_224", "tiny_vit_5m_224"])
def test_weights_tell_the_classes_of_a_network_that_was_published_with_others(tmp_path, model):
    """timm builds these without classes, and with 21,841, if nothing else is said."""
    timm = pytest.importorskip("timm")
    network = timm.create_model(model, num_classes=2).eval()
    torch.save(network.state_dict(), tmp_path / "own.pth")
    mean, std = (torch.tensor(network.pretrained_cfg[key]) for key in ("mean", "std"))
    images = random_images(224, 1)
    expected = network((images - mean.view(3, 1, 1)) / std.view(3, 1, 1))
    classifier = load_classifier(f"timm:{model}", tmp_path / "own.pth")
    torch.testing.assert_close(classifier(images), expected)


def test_a_network_of_timm_comes_from_a_repository_of_the_hub(tmp_path, monkeypatch, caplog):
    timm = pytest.importorskip("timm")
    hub = importlib.import_module("timm.models._hub")
    torch.manual_seed(0)
    options = {"pretrained_cfg_overlay": {"input_size": (3, 64, 64), "mean": (0.1, 0.2, 0.3)}}
    published = timm.create_model("test_efficientnet", num_classes=3, **options).eval()
    names = ["orange", "apple", "cup"]
    hub.save_for_hf(
        published, tmp_path, safe_serialization=True, model_config={"label_names": names}
    )

    def download(repo_id, filename, **_):
        return str(tmp_path / filename)

    monkeypatch.setattr(hub, "hf_hub_download", download)
    classifier = load_classifier("timm:hf-hub:someone/tiny")
    assert (classifier.size, list(classifier.classes)) == (64, names)
    assert caplog.text.count("stated by timm") == 3
    images = torch.rand(2, 3, 64, 64)
    std = torch.tensor(published.pretrained_cfg["std"]).view(3, 1, 1)
    expected = published((images - torch.tensor([0.1, 0.2, 0.3]).view(3, 1, 1)) / std)
    torch.testing.assert_close(classifier(images), expected)
    torch.save(published.state_dict(), tmp_path / "own.pth")
    own = load_classifier("timm:hf-hub:someone/tiny", tmp_path / "own.pth")
    assert list(own.classes) == names
    with pytest.raises(InputError, match="has 3 classes"):
        load_classifier("timm:hf-hub:someone/tiny", classes=["orange", "apple"])
