import numpy as np
import pytest
import torch
from oracles import linear_of, srgb_of
from scipy.special import softmax
from torch import Tensor, nn

from augment.classifier import Classifier, as_network
from augment.exposure import MeanOfLights, normalize_light
from augment.settings import NormalizedLightSettings
from renderer import InputError

SIZE = 12


@pytest.fixture
def radiance() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 0.3, (4, 3, SIZE, SIZE))


def normalized(linear: np.ndarray, **settings) -> np.ndarray:
    """Normalize linear images, with half of a white balance, and return linear images."""
    images = torch.from_numpy(srgb_of(linear))
    defaults = {"white_balance": 0.5, "gamma": 1.0}
    result = normalize_light(images, NormalizedLightSettings(**(defaults | settings)))
    return linear_of(result.numpy())


@pytest.mark.parametrize("exposure", [0.05, 0.5, 3.0])
def test_images_at_any_exposure_become_the_same_image(radiance, exposure):
    expected = normalized(radiance)
    np.testing.assert_allclose(normalized(exposure * radiance), expected, rtol=1e-9)
    # Each image is normalized alone.
    np.testing.assert_array_equal(normalized(radiance[:1]), expected[:1])


def test_the_percentile_gets_the_level(radiance):
    result = normalized(radiance, percentile=90, level=0.4)
    bright = np.quantile(result.reshape(4, -1), 0.9, axis=1, method="inverted_cdf")
    np.testing.assert_allclose(bright, 0.4, rtol=1e-9)


@pytest.mark.parametrize(("degree", "left"), [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)])
def test_a_cast_on_gray_keeps_a_part_of_its_logarithm(degree, left):
    gray = np.random.default_rng(1).uniform(0.05, 0.2, (1, 1, SIZE, SIZE))
    cast = np.array([1.5, 1.0, 0.4])
    result = normalized(gray * cast[:, None, None], white_balance=degree, level=0.5, percentile=100)
    means = result.mean((0, 2, 3))
    expected = left * np.log(cast / cast[1])
    np.testing.assert_allclose(np.log(means / means[1]), expected, atol=1e-9)


def test_gamma_is_the_exponent_of_the_encoded_image(radiance):
    plain = srgb_of(normalized(radiance))
    powered = srgb_of(normalized(radiance, gamma=0.7))
    is_bright = plain > 0.01
    np.testing.assert_allclose(powered[is_bright], plain[is_bright] ** 0.7, rtol=1e-9)


@pytest.mark.parametrize("gamma", [0.6, 1.8])
def test_the_gradient_is_that_of_finite_differences(gamma):
    generator = torch.Generator().manual_seed(2)
    images = 0.1 + 0.8 * torch.rand(2, 3, 4, 4, generator=generator, dtype=torch.float64)
    settings = NormalizedLightSettings(gamma=gamma, percentile=90)
    weights = torch.randn(2, 3, 4, 4, generator=generator, dtype=torch.float64)

    def weighted(values: Tensor) -> Tensor:
        return (weights * normalize_light(values, settings)).sum()

    assert torch.autograd.gradcheck(weighted, images.requires_grad_(), eps=1e-7, atol=1e-4)


@pytest.mark.parametrize("gamma", [0.5, 1.0])
@pytest.mark.parametrize(
    "image",
    [
        torch.zeros(3, SIZE, SIZE),
        torch.ones(3, SIZE, SIZE),
        torch.full((3, SIZE, SIZE), 0.3),
        torch.eye(3)[0].view(3, 1, 1).expand(3, SIZE, SIZE),
        torch.full((3, SIZE, SIZE), 1e-6),
    ],
    ids=["black", "white", "constant", "red", "almost black"],
)
def test_images_without_contrast_are_finite_with_finite_gradients(image, gamma):
    images = image[None].clone().requires_grad_()
    result = normalize_light(images, NormalizedLightSettings(gamma=gamma))
    result.sum().backward()
    assert result.min() >= 0 and result.max() <= 1
    assert images.grad.isfinite().all()
    assert (result == 0).all() == (image == 0).all()


class Spy(nn.Module):
    def forward(self, images: Tensor) -> Tensor:
        return images.mean((2, 3))


def test_a_classifier_sees_normalized_images(radiance):
    images = torch.from_numpy(srgb_of(radiance))
    settings = NormalizedLightSettings(white_balance=0.25)
    expected = normalize_light(images, settings).mean((2, 3))
    classes = ["red", "green", "blue"]
    for classifier in (
        Classifier(Spy(), SIZE, classes, normalize_light={"white_balance": 0.25}),
        Classifier(Spy(), SIZE, classes).normalizing_light(settings),
        as_network(Spy().eval(), SIZE, classes, normalize_light={"white_balance": 0.25}),
    ):
        torch.testing.assert_close(classifier(images), expected)
        assert classifier.normalized_light == settings


def test_light_is_normalized_before_the_mean_is_subtracted(radiance):
    images = torch.from_numpy(srgb_of(radiance)).float()
    mean, std = (0.4, 0.5, 0.6), (0.1, 0.2, 0.3)
    classifier = as_network(Spy().eval(), SIZE, normalization=(mean, std), normalize_light=True)
    light = normalize_light(images, NormalizedLightSettings())
    expected = (light.mean((2, 3)) - torch.tensor(mean)) / torch.tensor(std)
    torch.testing.assert_close(classifier(images), expected)


def test_light_is_not_normalized_twice():
    classifier = Classifier(Spy(), SIZE, ["red", "green", "blue"], normalize_light=True)
    with pytest.raises(InputError, match="normalize_light"):
        classifier.normalizing_light()


def test_probabilities_are_averaged_over_both_lights_of_dim_images_alone(radiance):
    def probabilities(linear: np.ndarray, **given) -> np.ndarray:
        network = as_network(Spy().eval(), SIZE, classes=list("rgb"), normalize_light=given or None)
        return softmax(network(torch.from_numpy(srgb_of(linear))).numpy(), axis=1)

    dim, bright = radiance / 9, radiance + 0.3
    mean = (probabilities(dim) + probabilities(dim, level=0.1)) / 2
    np.testing.assert_allclose(probabilities(dim, level=0.1, average=True), mean, rtol=1e-6)
    np.testing.assert_allclose(probabilities(bright, average=True), probabilities(bright), 1e-6)
    with pytest.raises(InputError, match="classifiers"):
        MeanOfLights(lambda images: [{"boxes": images}])(torch.zeros(1, 3, SIZE, SIZE))
