"""Classifiers from files that contain a whole network."""

from copy import deepcopy
from pathlib import Path

import pytest
import torch
from torch import nn

from augment.classifiers import load_classifier
from renderer.errors import InputError

SIZE = 8


def small_network() -> nn.Module:
    torch.manual_seed(0)
    layers = [nn.Conv2d(3, 4, 3), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 3)]
    return nn.Sequential(*layers).eval()


def save_torchscript(network: nn.Module, folder: Path) -> Path:
    path = folder / "network.pt"
    torch.jit.trace(network, torch.rand(2, 3, SIZE, SIZE)).save(path)
    return path


def save_exported(network: nn.Module, folder: Path) -> Path:
    path = folder / "network.pt2"
    # The batch has one image, as in torch's own examples.
    program = torch.export.export(network, (torch.rand(1, 3, SIZE, SIZE),))
    torch.export.save(program, path)
    return path


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("save", [save_torchscript, save_exported])
def test_a_file_gives_the_logits_and_the_gradient_of_its_network(tmp_path, save):
    network = small_network()
    path = save(network, tmp_path)
    classifier = load_classifier(str(path), classes=["a", "b", "c"], size=SIZE)
    images = torch.rand(5, 3, SIZE, SIZE, requires_grad=True)
    expected = network(images)
    found = classifier(images)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    (gradient,) = torch.autograd.grad(found.sum(), images)
    (expected_gradient,) = torch.autograd.grad(expected.sum(), images)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-5, atol=1e-6)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_copy_of_a_torchscript_network_is_trained_without_the_original(tmp_path):
    path = save_torchscript(small_network(), tmp_path)
    original = load_classifier(str(path), size=SIZE).function
    copied = deepcopy(original)
    images = torch.rand(2, 3, SIZE, SIZE)
    before = original(images)
    torch.testing.assert_close(copied(images), before)
    copied.requires_grad_(True)
    copied(images).sum().backward()
    torch.optim.SGD(copied.parameters(), 0.1).step()
    assert not torch.allclose(copied(images), before)
    torch.testing.assert_close(original(images), before)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_names_that_are_not_as_many_as_the_outputs_of_a_file_are_counted(tmp_path):
    path = save_torchscript(small_network(), tmp_path)
    with pytest.raises(InputError, match="classes has 2 names"):
        load_classifier(str(path), classes=["a", "b"], size=SIZE)


def test_onnx_gives_the_scores_of_its_graph(tmp_path):
    """The graph takes the mean of each channel, which is written without a library of networks."""
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    shape = ["N", 3, SIZE, SIZE]
    images = onnx.helper.make_tensor_value_info("images", onnx.TensorProto.FLOAT, shape)
    scores = onnx.helper.make_tensor_value_info("scores", onnx.TensorProto.FLOAT, ["N", 3])
    node = onnx.helper.make_node("ReduceMean", ["images"], ["scores"], axes=[2, 3], keepdims=0)
    graph = onnx.helper.make_graph([node], "means", [images], [scores])
    opsets = [onnx.helper.make_opsetid("", 13)]
    onnx.save(
        onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8), tmp_path / "means.onnx"
    )
    classifier = load_classifier(str(tmp_path / "means.onnx"))
    given = torch.rand(4, 3, SIZE, SIZE)
    assert classifier.size == SIZE
    torch.testing.assert_close(classifier(given), given.mean((2, 3)), rtol=1e-5, atol=1e-6)
