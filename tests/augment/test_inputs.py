"""The size and the normalization of the images of a network are said, and what is assumed."""

import sys

import pytest
import torch
from torch import nn

import norm_balls as nb
from augment import plain_networks
from augment.plain_networks import as_classifier

IMAGENET = "mean (0.485, 0.456, 0.406) and std (0.229, 0.224, 0.225)"
ASSUMED = "size and normalization are assumed"


@pytest.fixture
def said(caplog):
    """Function that returns the lines about images so far."""
    plain_networks._say_once.cache_clear()
    return lambda: [record.message for record in caplog.records if "pixels" in record.message]


@pytest.fixture(scope="module")
def resnet_weights(tmp_path_factory):
    from torchvision.models import resnet18

    path = tmp_path_factory.mktemp("weights") / "my64.pth"
    torch.save(resnet18(num_classes=3).state_dict(), path)
    return path


def test_size_and_normalization_of_own_weights_are_said_once_and_that_they_are_assumed(
    resnet_weights, said
):
    for _ in range(2):
        nb.load_classifier("torchvision:resnet18", resnet_weights)
    (line,) = said()
    assert "torchvision:resnet18" in line
    assert "224 × 224" in line
    assert IMAGENET in line
    assert ASSUMED in line


def test_only_what_the_user_leaves_out_is_assumed(resnet_weights, said):
    half = ((0.5, 0.5, 0.5), (0.25, 0.25, 0.25))
    nb.load_classifier("torchvision:resnet18", resnet_weights, size=64)
    nb.load_classifier("torchvision:resnet18", resnet_weights, size=64, normalization=half)
    first, second = said()
    assert "64 × 64" in first
    assert "normalization is assumed" in first
    assert "size" not in first
    assert "mean (0.5, 0.5, 0.5) and std (0.25, 0.25, 0.25)" in second
    assert "assumed" not in second


def test_published_weights_are_not_assumed(resnet_weights, said, tmp_path):
    path = tmp_path / "resnet18-f37072fd.pth"
    path.write_bytes(resnet_weights.read_bytes())
    nb.load_classifier("torchvision:resnet18", path)
    (line,) = said()
    assert "224 × 224" in line
    assert "assumed" not in line


@pytest.mark.parametrize("source", ["torchvision", "timm"])
def test_position_embeddings_tell_the_size(source, said, tmp_path):
    path = tmp_path / "vit.pth"
    if source == "torchvision":
        from torchvision.models import vit_b_32

        name, network = "vit_b_32", vit_b_32(num_classes=3, image_size=64)
    else:
        timm = pytest.importorskip("timm")
        name = "vit_tiny_patch16_224"
        network = timm.create_model(name, num_classes=3, img_size=64)
    torch.save(network.state_dict(), path)
    classifier = nb.load_classifier(f"{source}:{name}", path)
    assert classifier.size == 64
    assert classifier(torch.rand(2, 3, 64, 64)).shape == (2, 3)
    (line,) = said()
    assert "64 × 64" in line
    assert "normalization is assumed" in line


def test_the_shape_in_an_onnx_file_is_not_assumed(said, tmp_path):
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    for size, path in ((64, tmp_path / "fixed.onnx"), ("size", tmp_path / "free.onnx")):
        graph = helper.make_graph(
            [helper.make_node("ReduceMean", ["x"], ["y"], axes=[2, 3], keepdims=0)],
            "graph",
            [helper.make_tensor_value_info("x", kind, ["n", 3, size, size])],
            [helper.make_tensor_value_info("y", kind, ["n", 3])],
        )
        opsets = [helper.make_opsetid("", 13)]
        onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), path)
        nb.load_classifier(str(path))
    fixed, free = said()
    assert "64 × 64" in fixed
    assert "not normalized" in fixed
    assert "normalization is assumed" in fixed
    assert "size" not in fixed
    assert "224 × 224" in free
    assert ASSUMED in free


def test_a_run_and_a_function_tell_their_own_size(said, tmp_path, monkeypatch):
    (tmp_path / "own_network_of_8.py").write_text(
        "import torch\n"
        "from torchvision.transforms import Normalize\n"
        "def load():\n"
        "    layers = [Normalize((0.1, 0.2, 0.3), (0.4, 0.5, 0.6)), torch.nn.Flatten()]\n"
        "    return torch.nn.Sequential(*layers, torch.nn.Linear(192, 2)), 8, ['a', 'b']\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    nb.load_classifier("python:own_network_of_8:load")
    (line,) = said()
    assert "8 × 8" in line
    assert "mean (0.1, 0.2, 0.3) and std (0.4, 0.5, 0.6)" in line
    assert "assumed" not in line
    monkeypatch.undo()
    nb.load("none")
    line = said()[-1]
    assert "32 × 32" in line
    assert "normalized by mean" in line
    assert "assumed" not in line


def test_a_plain_network_is_mentioned_only_if_its_size_is_assumed(said):
    network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten()).eval()
    folder = "pretrained/laboratory"
    classes = ["orange", "lemon", "pear"]
    nb.evaluate(network, folder, "orange", classes=classes, size=8)
    assert said() == []
    nb.evaluate(network, folder, "orange", classes=classes)
    (line,) = said()
    assert "224 × 224" in line
    assert ASSUMED in line


def test_a_transformer_in_memory_tells_its_size(said):
    from torchvision.models import vit_b_32

    network = vit_b_32(num_classes=3, image_size=64).eval()
    assert as_classifier(network, normalization="imagenet").size == 64
    (line,) = said()
    assert "64 × 64" in line
    assert "assumed" not in line


def test_a_network_of_timm_in_memory_has_the_size_of_its_configuration(said):
    timm = pytest.importorskip("timm")
    network = timm.create_model("test_efficientnet", num_classes=3).eval()
    assert network.pretrained_cfg["input_size"] == (3, 160, 160)
    assert as_classifier(network).size == 160
    (line,) = said()
    assert "160 × 160" in line
    assert ASSUMED in line
