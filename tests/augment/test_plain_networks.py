"""A plain network is attacked as it is; what it does not tell is said and assumed."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torchvision.transforms import Normalize

import augment
import norm_balls as nb
import renderer
from augment import plain_networks
from augment.plain_networks import as_classifier
from renderer import InputError

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
SIZE = 8
CLASSES = ("orange", "lemon", "apple")


@pytest.fixture
def network() -> nn.Module:
    """Return a network of three classes, in evaluation mode."""
    torch.manual_seed(0)
    return nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 3), nn.Tanh()).eval()


@pytest.fixture
def images() -> Tensor:
    return torch.rand(4, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))


def scene(label: str | int) -> augment.Scene:
    """Build the scene of an orange under any label."""
    return augment.build_scene([("solid:orange", label)], SIZE)


def light() -> augment.AttackSettings:
    """Return settings of an attack on light of two steps."""
    lighting = augment.StepSettings(step_size=0.5)
    return augment.AttackSettings(lighting=lighting, max_steps=2, allow_negative=True)


BYTES = ((100.0, 110.0, 120.0), (50.0, 60.0, 70.0))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"normalization": "imagenet"}, Normalize(MEAN, STD)),
        (
            {"normalization": BYTES, "value_range": (0, 255)},
            lambda images: Normalize(*BYTES)(255 * images),
        ),
        # The mean and the standard deviation of ImageNet are scaled to the range of the network.
        ({"normalization": "imagenet", "value_range": (0, 255)}, Normalize(MEAN, STD)),
        ({"normalization": "imagenet", "value_range": (-1, 1)}, Normalize(MEAN, STD)),
        ({"value_range": (-1, 1)}, lambda images: 2 * images - 1),
    ],
)
def test_a_network_gets_images_in_its_own_units(network, images, options, expected):
    classifier = as_classifier(network, SIZE, **options)
    torch.testing.assert_close(classifier(images), network(expected(images)))
    assert classifier.classes == ("0", "1", "2")


def test_a_plain_network_is_attacked_like_its_classifier(network):
    classifier = augment.Classifier(network, SIZE, CLASSES)
    expected = augment.attack(classifier, scene("orange"), settings=light(), force=True)
    options = {"settings": light(), "force": True}
    by_name = augment.attack(network, scene("orange"), classes=CLASSES, **options)
    by_index = augment.attack(network, scene(0), **options)
    for result in (by_name, by_index):
        assert torch.equal(result.images, expected.images)
        assert torch.equal(result.logits, expected.logits)


def test_a_number_is_an_index_even_if_a_class_has_this_number_as_its_name(network):
    options = {"settings": light(), "force": True, "classes": ("1", "2", "0")}
    by_index = augment.attack(network, scene(1), target=2, **options).criterion
    assert (by_index.source.item(), by_index.target.item()) == (1, 2)
    by_name = augment.attack(network, scene("1"), target="2", **options).criterion
    assert (by_name.source.item(), by_name.target.item()) == (0, 1)
    of_a_list = augment.attack(network, scene(1), target=[np.int64(2)], **options).criterion
    assert of_a_list.target.item() == 2
    mesh = renderer.solid("orange", 0)
    of_a_mesh = augment.attack(network, augment.build_scene([(mesh, 1)], SIZE), **options)
    assert of_a_mesh.criterion.source.item() == 1


def test_the_parameters_of_the_network_require_gradients_as_before(network):
    network[1].bias.requires_grad_(False)
    augment.attack(network, scene(0), settings=light(), force=True)
    assert [parameter.requires_grad for parameter in network.parameters()] == [True, False]


class Mistakes:
    """Each function changes the network, and returns it with wrong options of `as_classifier`."""

    def training(network):
        network[2].train()
        return network, {}

    def dictionary(network):
        return lambda images: {"logits": images.mean((2, 3))}, {}

    def normalized(network):
        return nn.Sequential(Normalize(MEAN, STD), network).eval(), {"normalization": "imagenet"}

    def pixel_mean(network):
        network.register_buffer("pixel_mean", torch.zeros(3))
        return network, {"normalization": "imagenet"}

    def nine(network):
        return network, {"classes": CLASSES[:2]}

    def value_range(network):
        return network, {"normalization": BYTES}

    def type(network):
        return nn.Flatten, {}

    def classifier(network):
        return augment.Classifier(network, SIZE, CLASSES), {"classes": CLASSES}


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (Mistakes.training, "training mode"),
        (Mistakes.dictionary, "dict"),
        (Mistakes.normalized, "Normalize"),
        (Mistakes.pixel_mean, "pixel_mean"),
        (Mistakes.nine, "classes has 2 names"),
        (Mistakes.value_range, "value_range"),
        (Mistakes.type, "Flatten"),
        (Mistakes.classifier, "plain network"),
    ],
)
def test_a_mistake_is_refused(network, mistake, message):
    network, options = mistake(network)
    with pytest.raises(InputError, match=message):
        as_classifier(network, SIZE, **options)


def test_a_network_with_a_single_output_is_refused():
    """The softmax of one logit is 1, so that no attack could succeed."""
    network = nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 1)).eval()
    for attacked in (network, lambda images: network(images)):
        with pytest.raises(InputError, match="at least two"):
            augment.attack(attacked, scene(0), settings=light())


def test_an_index_beyond_the_classes_is_refused(network):
    with pytest.raises(InputError, match="label 3"):
        augment.attack(network, scene(3))


def test_a_name_is_refused_if_the_classes_have_none(network):
    with pytest.raises(InputError, match="name the classes"):
        augment.attack(network, scene("orange"))


def test_adversaries_are_shown_to_a_plain_network_as_to_its_classifier(network):
    result = augment.attack(network, scene(0), settings=light(), force=True)
    classifier = augment.Classifier(network, SIZE, ["0", "1", "2"])
    [expected] = augment.transfer(result, [classifier])
    network.requires_grad_(True)
    [row] = augment.transfer(result, [network])
    assert row | {"network": ""} == expected | {"network": ""}
    assert all(parameter.requires_grad for parameter in network.parameters())


class Calling:
    """Object that calls a network."""

    def __init__(self, network: nn.Module):
        self.network = network

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        return self.network(images)


@pytest.mark.parametrize("layer", [nn.BatchNorm2d(3), nn.Dropout(0.5)])
@pytest.mark.parametrize(
    "wrap", [Calling, lambda network: partial(network.forward), nn.Module.__call__.__get__]
)
def test_a_function_whose_network_is_in_training_mode_is_refused(layer, wrap):
    network = nn.Sequential(layer, nn.AdaptiveAvgPool2d(1), nn.Flatten()).train()
    with pytest.raises(InputError, match=r"eval\(\)"):
        as_classifier(wrap(network), size=8)
    as_classifier(wrap(network.eval()), size=8)


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


@pytest.mark.parametrize("source", [pytest.param("torchvision", marks=pytest.mark.slow), "timm"])
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


def test_a_plain_network_is_mentioned_only_if_its_size_is_assumed(said):
    network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten()).eval()
    as_classifier(network, 8)
    assert said() == []
    as_classifier(network)
    (line,) = said()
    assert "224 × 224" in line
    assert ASSUMED in line


def test_a_network_of_timm_in_memory_has_the_size_of_its_configuration(said):
    timm = pytest.importorskip("timm")
    network = timm.create_model("test_efficientnet", num_classes=3).eval()
    assert network.pretrained_cfg["input_size"] == (3, 160, 160)
    assert as_classifier(network).size == 160
    (line,) = said()
    assert "160 × 160" in line
    assert ASSUMED in line
