import re
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torchvision.models import get_model
from torchvision.transforms import Normalize

import augment
import norm_balls as nb
import renderer
from augment.classifier import CheckedNetwork, Classifier, as_network, remembering
from augment.network import ChannelNormalization, Network, gradient_flags_kept, say_once
from renderer import InputError
from tests.detectors import small_detector

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
SIZE = 8
CLASSES = ("orange", "lemon", "apple")
EPS = torch.finfo(torch.float64).eps
SHIFT = (0.1, 0.4, 0.6)
SCALE = (0.2, 0.5, 3.0)


@dataclass
class SimpleLogits:
    logits: Tensor


def random_images(size: int = 8) -> Tensor:
    return torch.rand(2, 3, size, size, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("bgr", "order"), [(False, [0, 1, 2]), (True, [2, 1, 0])])
def test_a_linear_network_gets_normalized_images_in_its_order_of_channels(bgr, order):
    layer = nn.Linear(3 * 5 * 5, 2)
    network = Network(nn.Sequential(nn.Flatten(), layer), [ChannelNormalization(SHIFT, SCALE, bgr)])
    classifier = Classifier(network, 5, ["fig", "lime"]).double()
    images = random_images(5).double().requires_grad_()
    logits = classifier(images)[:, 1]
    (gradient,) = torch.autograd.grad(logits.sum(), images)
    weight = layer.weight[1].view(3, 5, 5) / torch.tensor(SCALE)[:, None, None]
    expected_gradient = weight[order].expand(2, 3, 5, 5)
    torch.testing.assert_close(gradient, expected_gradient, rtol=4 * EPS, atol=0)
    offset = layer.bias[1] - (weight * torch.tensor(SHIFT)[:, None, None]).sum()
    expected = (images * weight[order]).sum((1, 2, 3)) + offset
    # Each logit is a sum of 75 products.
    torch.testing.assert_close(logits, expected, rtol=0, atol=75 * 16 * EPS)


def test_a_classifier_is_frozen_and_stays_in_eval_mode():
    network = nn.Sequential(
        nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Dropout(0.5), nn.Flatten(), nn.Linear(144, 2)
    )
    classifier = Classifier(network, 8, ["fig", "lime"])
    images = random_images()
    statistics = network[1].running_mean.clone()
    before = classifier(images)
    assert classifier.train() is classifier
    assert not any(module.training for module in classifier.modules())
    assert torch.equal(classifier(images), before)
    assert torch.equal(network[1].running_mean, statistics)
    assert not before.requires_grad
    assert not any(parameter.requires_grad for parameter in network.parameters())


@pytest.fixture
def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 3), nn.Tanh()).eval()


@pytest.fixture
def images() -> Tensor:
    return torch.rand(4, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))


def scene(label: str | int) -> augment.Scene:
    return augment.build_scene([("solid:orange", label)], SIZE)


def light() -> augment.AttackSettings:
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
    classifier = as_network(network, SIZE, **options)
    torch.testing.assert_close(classifier(images), network(expected(images)))
    assert classifier.classes == ("0", "1", "2")


def test_parameters_that_the_first_pass_replaces_learn_after_an_attack():
    """FSDP (`fully_shard`) replaces parameters."""
    network = nn.Linear(2, 2)
    network.bias.requires_grad_(False)
    with gradient_flags_kept(network):
        network.requires_grad_(False)
        network.weight = nn.Parameter(network.weight.detach(), requires_grad=False)
        network.made = nn.Parameter(torch.ones(1))
    flags = {name: parameter.requires_grad for name, parameter in network.named_parameters()}
    assert flags == {"weight": True, "bias": False, "made": True}


def test_a_plain_network_is_attacked_like_its_classifier_and_stays_as_it_is(network):
    network[1].bias.requires_grad_(False)
    options = {"settings": light(), "force": True}
    by_name = augment.attack(network, scene("orange"), classes=CLASSES, **options)
    by_index = augment.attack(network, scene(0), **options)
    assert [parameter.requires_grad for parameter in network.parameters()] == [True, False]
    classifier = augment.Classifier(network, SIZE, CLASSES)
    expected = augment.attack(classifier, scene("orange"), settings=light(), force=True)
    for result in (by_name, by_index):
        assert torch.equal(result.images, expected.images)
        assert torch.equal(result.logits, expected.logits)


def test_a_network_that_changes_its_images_in_place_is_attacked_as_one_that_copies_them():
    def made(is_in_place: bool) -> nn.Module:
        first = Normalize(MEAN, STD, inplace=is_in_place)
        linear = nn.Linear(3, 3)
        linear.load_state_dict({"weight": torch.eye(3), "bias": torch.zeros(3)})
        return nn.Sequential(first, nn.AdaptiveAvgPool2d(1), nn.Flatten(), linear).eval()

    images = (random_images() * 255).to(torch.uint8)
    results = []
    for network in map(made, (False, True)):
        attacked = nb.attack_photographs(network, images)
        torch.manual_seed(0)
        relit = nb.AdversarialLighting(network)(images)
        found = augment.attack(network, scene(0), settings=light(), force=True)
        results.append((attacked.changed, relit, found.images))
    torch.testing.assert_close(*results, rtol=0, atol=0)


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


def without_eval(network: nn.Sequential) -> nn.Module:
    network[2].train()
    return network


def with_pixel_mean(network: nn.Module) -> nn.Module:
    network.register_buffer("pixel_mean", torch.full((3,), 0.5))
    return network


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (without_eval, {}, "training mode"),
        (lambda network: network.to("meta"), {"device": "cpu"}, "load its weights"),
        (lambda _: lambda images: {"scores": images.mean((2, 3))}, {}, "dict"),
        (
            lambda network: nn.Sequential(Normalize(MEAN, STD), network).eval(),
            {"normalization": "imagenet"},
            "leave normalization out",
        ),
        (with_pixel_mean, {"normalization": "imagenet"}, "leave normalization out"),
        (lambda _: small_detector(3, SIZE), {"normalization": "imagenet"}, "normalization out"),
        (lambda network: network, {"classes": CLASSES[:2]}, "classes has 2 names"),
        (lambda network: network, {"normalization": BYTES}, "value_range"),
        (lambda network: network, {"value_range": (0, 1, 2)}, "length 3"),
        (lambda _: nn.Flatten, {}, "Flatten"),
        (partial(Classifier, size=SIZE, classes=CLASSES), {"classes": CLASSES}, "plain network"),
    ],
)
def test_a_mistake_is_refused(network, change, options, message):
    with pytest.raises(InputError, match=message):
        as_network(change(network), SIZE, **options)


@pytest.mark.parametrize("change", [{"dtype": torch.float16}, {"device": "meta"}])
def test_weights_unlike_the_images_are_named_if_a_network_fails(network, change):
    checked = CheckedNetwork(deepcopy(network).float().to(**change), "mine")
    with pytest.raises(
        InputError, match=f"weights are {str(*change.values()).removeprefix('torch.')}"
    ):
        checked(torch.rand(1, 3, SIZE, SIZE))


def test_a_network_with_a_single_output_is_refused():
    """The softmax of one logit is 1, so that no attack could succeed."""
    network = nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 1)).eval()
    for attacked in (network, lambda images: network(images)):
        with pytest.raises(InputError, match="at least two"):
            augment.attack(attacked, scene(0), settings=light())


@pytest.mark.parametrize(("label", "message"), [(3, "label 3"), ("orange", "name the classes")])
def test_a_label_that_is_no_class_is_refused(network, label, message):
    with pytest.raises(InputError, match=message):
        augment.attack(network, scene(label))


def test_adversaries_are_shown_to_a_plain_network_as_to_its_classifier(network):
    result = augment.attack(network, scene(0), settings=light(), force=True)
    classifier = augment.Classifier(network, SIZE, ["0", "1", "2"])
    [expected] = augment.transfer(result, [classifier])
    network.requires_grad_(True)
    [row] = augment.transfer(result, [network])
    assert row | {"network": ""} == expected | {"network": ""}
    assert all(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize(
    ("layer", "wrap"),
    [
        (nn.BatchNorm2d(3), lambda network: partial(network.forward)),
        (nn.Dropout(0.5), nn.Module.__call__.__get__),
    ],
)
def test_a_function_whose_network_is_in_training_mode_is_refused(layer, wrap):
    network = nn.Sequential(layer, nn.AdaptiveAvgPool2d(1), nn.Flatten()).train()
    with pytest.raises(InputError, match=r"eval\(\)"):
        as_network(wrap(network), size=8)
    as_network(wrap(network.eval()), size=8)


SMALL = "shufflenet_v2_x0_5"
IMAGENET = "normalized by mean (0.485, 0.456, 0.406) and std (0.229, 0.224, 0.225)"


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    return lambda: [record.message for record in caplog.records if "pixels" in record.message]


@pytest.fixture
def warned(caplog):
    return lambda: re.findall(r"size=\d+(?= is assumed: give size=)", caplog.text)


def test_what_the_user_leaves_out_is_said_once_to_be_assumed(tmp_path, said, warned):
    path = tmp_path / "my64.pth"
    torch.save(get_model(SMALL, num_classes=3).state_dict(), path)
    for options in ({}, {}, {"size": 64, "normalization": (SHIFT, SCALE)}):
        nb.load_classifier(f"torchvision:{SMALL}", path, **options)
    first, second = said()
    assert f"224 × 224 pixels, assumed; {IMAGENET}, assumed; values from 0 to 1, assumed" in first
    stated = "std (0.2, 0.5, 3), stated by you; values from 0 to 1, stated by you"
    assert "64 × 64 pixels, stated by you" in second and stated in second
    assert warned() == ["size=224"]


def test_normalization_is_said_in_the_units_of_the_user_and_as_a_network_states_it(said):
    plain = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten()).eval()
    given = np.array([0, 0.1, 0]).tolist(), [*np.array([1.0, 2, 1])]
    network = as_network(plain, value_range=(-1, 1), normalization=given)
    assert network(torch.rand(1, 3, 224, 224)).dtype == torch.float32
    as_network(nn.Sequential(Normalize(MEAN, STD), plain).eval(), 8)
    first, second = said()
    assert "std (1, 2, 1), stated by you; values from -1 to 1, stated by you" in first
    assert f"{IMAGENET}, stated by the network; values from 0 to 1, assumed" in second


class BaseDataPreprocessor(ChannelNormalization):
    """Preprocessor as those of OpenMMLab, which a network contains and does not call."""


@pytest.mark.parametrize("kind", ["documented", "not called", "of features"])
def test_a_network_that_only_mentions_a_mean_is_normalized_as_the_user_says(kind, network, images):
    if kind == "documented":
        network.image_mean, network.image_std = MEAN, STD
    elif kind == "not called":
        network[0].data_preprocessor = BaseDataPreprocessor(MEAN, STD).eval()
    else:
        network.register_buffer("mean", torch.zeros(5))
        network.register_buffer("std", torch.ones(5))
    assert "; not normalized, assumed" in as_network(network, SIZE).describe_inputs()
    classifier = as_network(network, SIZE, normalization="imagenet")
    assert f"{IMAGENET}, stated by you" in classifier.describe_inputs()
    torch.testing.assert_close(classifier(images), network(Normalize(MEAN, STD)(images)))


def test_the_normalization_of_a_layer_of_kornia_is_stated_by_the_network(network):
    layer = pytest.importorskip("kornia").augmentation.Normalize(0.5, 0.25)
    inputs = as_network(nn.Sequential(layer, network).eval(), SIZE).describe_inputs()
    assert "mean (0.5, 0.5, 0.5) and std (0.25, 0.25, 0.25), stated by the network" in inputs


@pytest.mark.parametrize("wrap", [lambda x: {"logits": x}, lambda x: (x, 0), SimpleLogits])
def test_logits_in_the_output_of_a_library_are_read_with_their_gradient(wrap, images):
    classifier = as_network(lambda given: wrap(given.mean((2, 3))), 8)
    images.requires_grad_()
    logits = classifier(images)
    assert torch.equal(logits, images.mean((2, 3)))
    (gradient,) = torch.autograd.grad(logits.sum(), images)
    torch.testing.assert_close(gradient, torch.full_like(images, 1 / 64))


def test_facts_of_a_classifier_stay_with_copies_of_it():
    classifier = as_network(lambda images: images.mean((2, 3)), 8, normalization="imagenet")
    for copy in (classifier.normalizing_light(), remembering(classifier)):
        assert copy.describe_inputs() == classifier.describe_inputs()


def test_position_embeddings_tell_the_size(said, tmp_path):
    timm = pytest.importorskip("timm")
    network = timm.create_model("vit_tiny_patch16_224", num_classes=3, img_size=64)
    torch.save(network.state_dict(), tmp_path / "vit.pth")
    classifier = nb.load_classifier("timm:vit_tiny_patch16_224", tmp_path / "vit.pth")
    assert classifier.size == 64
    assert classifier(torch.rand(2, 3, 64, 64)).shape == (2, 3)
    (line,) = said()
    assert "64 × 64 pixels, stated by the file; normalized by mean (0.5, 0.5, 0.5) and std" in line


def save_onnx(
    path: Path,
    kind="FLOAT",
    inputs=("x",),
    outputs="y",
    shape=(SIZE, SIZE),
    axes=(2, 3),
    softmax=False,
) -> str:
    """Write a graph of the means of x, which is of a kind such as FLOAT16, over its axes."""
    import onnx

    helper, kinds = onnx.helper, onnx.TensorProto
    nodes = [helper.make_node("Cast", ["x"], ["images"], to=kinds.FLOAT)]
    options = {"axes": axes, "keepdims": 0}
    means = "m" if softmax else outputs
    nodes += [helper.make_node("ReduceMean", ["images"], [name], **options) for name in means]
    nodes += [helper.make_node("Softmax", ["m"], ["y"], axis=1)] if softmax else []
    sides = ["n", 3, *shape] if axes == (2, 3) else ["n", *shape, 3]
    given = [helper.make_tensor_value_info(name, getattr(kinds, kind), sides) for name in inputs]
    found = [helper.make_tensor_value_info(name, kinds.FLOAT, ["n", 3]) for name in outputs]
    graph = helper.make_graph(nodes, "graph", given, found)
    opsets = [helper.make_opsetid("", 13)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), path)
    return str(path)


def test_onnx_gives_the_scores_of_its_graph_and_a_size_that_it_tells_is_not_assumed(said, tmp_path):
    for size in (64, "size"):
        path = save_onnx(tmp_path / f"{size}.onnx", shape=(size, size))
        classifier = nb.load_classifier(path)
        images = torch.rand(4, 3, classifier.size, classifier.size)
        torch.testing.assert_close(classifier(images), images.mean((2, 3)), rtol=1e-5, atol=1e-6)
    assert nb.load_classifier(path, size=(48, 64)).size == (48, 64)
    fixed, free, given = said()
    assert "64 × 64 pixels, stated by the file; not normalized, assumed" in fixed
    assert "224 × 224 pixels, assumed; not normalized, assumed" in free
    assert "48 × 64 pixels, stated by you" in given


def test_onnx_with_free_sides_that_needs_one_size_is_read_at_the_given_size(tmp_path):
    import onnx

    path = save_onnx(tmp_path / "network.onnx", shape=("height", "width"))
    model = onnx.load(path)
    # Only images of 3 × 64 × 64 values have two rows of this length.
    shape = onnx.helper.make_tensor("shape", onnx.TensorProto.INT64, [2], [2, 3 * 64 * 64])
    model.graph.initializer.append(shape)
    model.graph.node.append(onnx.helper.make_node("Reshape", ["images", "shape"], ["rows"]))
    onnx.save(model, path)
    assert nb.load_classifier(path, size=64).size == 64


def test_names_of_classes_may_be_texts_of_numpy(tmp_path):
    names = list(np.array(["a", "b", "c"]))
    classifier = nb.load_classifier(save_onnx(tmp_path / "network.onnx"), classes=names)
    assert [type(name) for name in classifier.classes] == [str] * 3


@pytest.mark.parametrize("kind", ["FLOAT16", "DOUBLE"])
def test_onnx_gets_images_of_its_own_precision(tmp_path, images, kind):
    classifier = nb.load_classifier(save_onnx(tmp_path / "network.onnx", kind))
    torch.testing.assert_close(classifier(images), images.mean((2, 3)), rtol=1e-3, atol=0)


@pytest.mark.parametrize(("kind", "inputs"), [("UINT8", ("x",)), ("FLOAT", ("x", "size"))])
def test_onnx_of_bytes_or_of_two_inputs_is_refused_with_a_remedy(tmp_path, kind, inputs):
    with pytest.raises(InputError, match="one input of float32"):
        nb.load_classifier(save_onnx(tmp_path / "network.onnx", kind, inputs))


def test_onnx_of_two_outputs_is_read_by_the_first_which_is_said(tmp_path, images, caplog):
    """A search, which a file without gradients needs, asks a copy that remembers the outputs."""
    say_once.cache_clear()
    path = save_onnx(tmp_path / "network.onnx", outputs="yz")
    classifier = nb.load_classifier(path)
    assert "2 outputs" in caplog.text
    for asked in (classifier, remembering(classifier)):
        torch.testing.assert_close(asked(images), images.mean((2, 3)), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("axes", [(2, 3), (1, 2)], ids=["channels first", "channels last"])
def test_onnx_of_channels_last_and_of_probabilities_has_gradients_of_logits(tmp_path, axes):
    pytest.importorskip("onnx2torch")
    path = save_onnx(tmp_path / "network.onnx", shape=(40, 48), axes=axes, softmax=True)
    classifier = nb.load_classifier(path)
    assert classifier.size == (40, 48)
    images = torch.rand(4, 3, 40, 48, requires_grad=True)
    expected = images.mean((2, 3)).log_softmax(1)
    found = classifier(images)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    gradients = [torch.autograd.grad(each[:, 0].sum(), images)[0] for each in (found, expected)]
    torch.testing.assert_close(*gradients)


def test_timm_tells_the_size_of_a_network_in_memory_which_is_assumed(said, warned):
    timm = pytest.importorskip("timm")
    # timm records the size of the images in the configuration of a network.
    assert as_network(timm.create_model("test_efficientnet", num_classes=3).eval()).size == 160
    assert "160 × 160 pixels, assumed" in said()[0]
    assert warned() == ["size=160"]


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_a_frozen_network_of_torchscript_has_the_same_logits():
    network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Flatten(), nn.Linear(144, 3))
    frozen = torch.jit.freeze(torch.jit.script(network.eval()))
    images = torch.rand(2, 3, 8, 8)
    for given in (frozen, lambda shown: frozen(shown)):
        classifier = nb.Classifier(given, 8, ["red", "green", "blue"])
        torch.testing.assert_close(classifier(images), network(images))
    relit = nb.AdversarialLighting(frozen, lights="linear")(images)
    assert relit.shape == images.shape and not torch.equal(relit, images)
