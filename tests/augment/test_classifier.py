"""A classifier shows normalized images to its network, stays frozen, and refuses wrong calls."""

import re

import pytest
import torch
from torch import nn

from augment.classifier import Classifier
from augment.network import ChannelNormalization, Network
from renderer.errors import InputError

COLORS = ("red", "green", "blue")
EPS = torch.finfo(torch.float64).eps
MEAN = (0.1, 0.4, 0.6)
STD = (0.2, 0.5, 3.0)


def random_images(size: int, count: int = 2) -> torch.Tensor:
    """Draw images (count, 3, size, size)."""
    return torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(0))


def mean_color(images: torch.Tensor) -> torch.Tensor:
    """Return the mean (N, 3) of each channel."""
    return images.mean((2, 3))


@pytest.mark.parametrize(("bgr", "order"), [(False, [0, 1, 2]), (True, [2, 1, 0])])
def test_a_linear_network_gets_normalized_images_in_its_order_of_channels(bgr, order):
    layer = nn.Linear(3 * 5 * 5, 2)
    network = Network(nn.Sequential(nn.Flatten(), layer), [ChannelNormalization(MEAN, STD, bgr)])
    classifier = Classifier(network, 5, ["fig", "lime"]).double()
    images = random_images(5).double().requires_grad_()
    logits = classifier(images)[:, 1]
    (gradient,) = torch.autograd.grad(logits.sum(), images)
    weight = layer.weight[1].view(3, 5, 5) / torch.tensor(STD)[:, None, None]
    expected_gradient = weight[order].expand(2, 3, 5, 5)
    torch.testing.assert_close(gradient, expected_gradient, rtol=4 * EPS, atol=0)
    offset = layer.bias[1] - (weight * torch.tensor(MEAN)[:, None, None]).sum()
    expected = (images * weight[order]).sum((1, 2, 3)) + offset
    # Each logit is a sum of 75 products.
    torch.testing.assert_close(logits, expected, rtol=0, atol=75 * 16 * EPS)


def test_a_callable_is_a_classifier_of_the_images_as_they_are():
    classifier = Classifier(mean_color, 8, COLORS, name="color")
    images = random_images(8).requires_grad_()
    assert torch.equal(classifier(images), images.mean((2, 3)))
    (gradient,) = torch.autograd.grad(classifier(images)[:, 1].sum(), images)
    expected = torch.zeros_like(images)
    expected[:, 1] = 1 / 64
    assert torch.equal(gradient, expected)
    assert [classifier.label(name) for name in COLORS] == [0, 1, 2]


def test_a_classifier_is_frozen_and_stays_in_eval_mode():
    network = nn.Sequential(
        nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Dropout(0.5), nn.Flatten(), nn.Linear(144, 2)
    )
    classifier = Classifier(network, 8, ["fig", "lime"])
    images = random_images(8)
    statistics = network[1].running_mean.clone()
    before = classifier(images)
    assert classifier.train() is classifier
    assert not any(module.training for module in classifier.modules())
    assert torch.equal(classifier(images), before)
    assert torch.equal(network[1].running_mean, statistics)
    assert not before.requires_grad
    assert not any(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize(
    ("function", "shape", "message"),
    [
        (mean_color, (2, 3, 8, 9), "(N, 3, 8, 8), not (2, 3, 8, 9)"),
        (lambda images: images[:, :2, 0, 0], (2, 3, 8, 8), "returned (2, 2)"),
        (lambda images: images.detach().mean((2, 3)), (2, 3, 8, 8), "without a gradient"),
        (lambda images: images.mean((2, 3)) / 0, (2, 3, 8, 8), "NaN or infinite"),
        (lambda images: images @ images.double(), (2, 3, 8, 8), "float32 images (2, 3, 8, 8)"),
    ],
    ids=["shape of images", "number of logits", "no gradient", "no numbers", "an error"],
)
def test_wrong_images_and_logits_are_refused(function, shape, message):
    classifier = Classifier(function, 8, COLORS, name="mine")
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        classifier(torch.rand(shape, requires_grad=True))
    assert str(caught.value).startswith("classifier mine ")


@pytest.mark.parametrize("classes", [["crane", "orange", "crane"], ["crane"], []])
def test_class_names_must_be_unique_and_at_least_two(classes):
    with pytest.raises(InputError, match="classifier mine"):
        Classifier(mean_color, 8, classes, name="mine")


def test_a_wrong_class_name_is_refused_with_similar_ones():
    classifier = Classifier(mean_color, 8, ["lemon", "orange", "pear"], name="mine")
    with pytest.raises(InputError, match=r"'ornage'.*orange"):
        classifier.label("ornage")
