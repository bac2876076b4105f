"""A plain network is attacked as it is, after a check on gray images."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torchvision.transforms import Normalize

import augment
import renderer
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
    return augment.AttackSettings(lighting=lighting, max_steps=2)


def test_classes_without_names_are_indices(network):
    assert as_classifier(network, SIZE).classes == ("0", "1", "2")


def test_imagenet_normalization_is_that_of_torchvision(network, images):
    classifier = as_classifier(network, SIZE, normalization="imagenet")
    torch.testing.assert_close(classifier(images), network(Normalize(MEAN, STD)(images)))


def test_own_mean_and_std_are_in_units_of_the_value_range(network, images):
    mean, std = (100.0, 110.0, 120.0), (50.0, 60.0, 70.0)
    classifier = as_classifier(network, SIZE, normalization=(mean, std), value_range=(0, 255))
    torch.testing.assert_close(classifier(images), network(Normalize(mean, std)(255 * images)))


@pytest.mark.parametrize(("black", "white"), [(0, 255), (-1, 1)])
def test_imagenet_normalization_is_scaled_to_the_value_range(network, images, black, white):
    span = white - black
    mean, std = [black + span * value for value in MEAN], [span * value for value in STD]
    classifier = as_classifier(network, SIZE, normalization="imagenet", value_range=(black, white))
    expected = network(Normalize(mean, std)(black + span * images))
    torch.testing.assert_close(classifier(images), expected)


def test_values_are_scaled_to_the_range_of_the_network(network, images):
    classifier = as_classifier(network, SIZE, value_range=(-1, 1))
    torch.testing.assert_close(classifier(images), network(2 * images - 1))


def test_a_plain_network_is_attacked_like_its_classifier(network):
    classifier = augment.Classifier(network, SIZE, CLASSES)
    expected = augment.attack(classifier, scene("orange"), settings=light(), force=True)
    options = {"settings": light(), "force": True}
    by_name = augment.attack(network, scene("orange"), classes=CLASSES, **options)
    by_index = augment.attack(network, scene(0), **options)
    for result in (by_name, by_index):
        assert torch.equal(result.images, expected.images)
        assert torch.equal(result.logits, expected.logits)


def test_an_index_is_a_target_as_its_name_is(network):
    classifier = augment.Classifier(network, SIZE, CLASSES)
    options = {"settings": light(), "force": True}
    by_name = augment.attack(classifier, scene("orange"), target="apple", **options)
    by_index = augment.attack(classifier, scene("orange"), target=2, **options)
    assert torch.equal(by_name.images, by_index.images)


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


class WithDictionary(nn.Module):
    """A network that returns a dictionary."""

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        return {"logits": images.mean((2, 3))}


def test_a_network_in_training_mode_is_refused(network):
    with pytest.raises(InputError, match="training mode"):
        as_classifier(network.train(), SIZE)


def test_an_output_that_is_no_tensor_is_refused():
    with pytest.raises(InputError, match="dict"):
        as_classifier(WithDictionary().eval(), SIZE)


def test_normalizing_twice_is_refused(network):
    normalized = nn.Sequential(Normalize(MEAN, STD), network).eval()
    with pytest.raises(InputError, match="normalization"):
        as_classifier(normalized, SIZE, normalization="imagenet")


def test_a_wrong_number_of_names_is_refused(network):
    with pytest.raises(InputError, match="classes"):
        as_classifier(network, SIZE, classes=CLASSES[:2])


def test_a_network_with_a_single_output_is_refused():
    """The softmax of one logit is 1, so that no attack could succeed."""
    network = nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 1)).eval()
    for attacked in (network, lambda images: network(images)):
        with pytest.raises(InputError, match="at least two"):
            augment.attack(attacked, scene(0), settings=light())


@pytest.mark.parametrize("options", [{"classes": CLASSES}, {"value_range": (0, 255)}])
def test_a_classifier_takes_no_options_of_plain_networks(network, options):
    classifier = augment.Classifier(network, SIZE, CLASSES)
    with pytest.raises(InputError, match="plain network"):
        as_classifier(classifier, SIZE, **options)


def test_an_index_beyond_the_classes_is_refused(network):
    with pytest.raises(InputError, match="label 3"):
        augment.attack(network, scene(3))


def test_a_network_with_a_part_in_training_mode_is_refused(network):
    network[2].train()
    with pytest.raises(InputError, match="training mode"):
        as_classifier(network, SIZE)


def test_a_network_that_normalizes_by_a_buffer_is_not_normalized_again(network):
    network.register_buffer("pixel_mean", torch.zeros(3))
    with pytest.raises(InputError, match="pixel_mean"):
        as_classifier(network, SIZE, normalization="imagenet")


def test_a_mean_outside_of_the_value_range_is_refused(network):
    bytes_of_imagenet = ((123.0, 116.0, 103.0), (58.0, 57.0, 57.0))
    with pytest.raises(InputError, match="value_range"):
        as_classifier(network, SIZE, normalization=bytes_of_imagenet)


def test_a_class_in_place_of_a_network_is_refused():
    with pytest.raises(InputError, match="Flatten"):
        as_classifier(nn.Flatten, SIZE)


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
