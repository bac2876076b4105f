"""Classifiers get images of 8 bits and under random transformations; the image itself decides."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

import augment
from augment.attack_settings import EOTSettings
from augment.attacks import objective
from augment.attacks.objective import as_jpeg, average_transformed
from augment.network import Network, Quantization
from augment.random_streams import generator


class Means(nn.Module):
    """A classifier by the channels' means, which records its images."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, images: Tensor) -> Tensor:
        self.seen.append(images.detach())
        return 30 * images.mean((2, 3))


def random_images(*shape: int) -> Tensor:
    """Draw images in [0, 1]."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def transformed(images: Tensor, seed: int = 0, **settings) -> tuple[Tensor, list[Tensor]]:
    """Return the expectation, and the images that the classifier was given for it.

    Keywords are those of `EOTSettings`. Without them, one draw changes nothing.
    """
    nothing = {"draws": 1, "jitter": 0.0, "exposure": 0.0, "noise": 0.0, "jpeg": 100}
    chosen = EOTSettings(**nothing | settings)
    means = Means()
    mean = average_transformed(means, images, means(images), chosen, generator(seed))
    return mean, means.seen


def test_a_model_is_given_bytes_and_its_derivative_ignores_the_rounding():
    means = Means()
    images = random_images(2, 3, 8, 8).requires_grad_()
    Network(means, [Quantization()])(images).sum().backward()
    [seen] = means.seen
    assert torch.equal((seen * 255).round() / 255, seen)
    assert (seen - images).abs().max() <= 0.5 / 255 + 1e-7
    torch.testing.assert_close(images.grad, torch.full_like(images, 30 / 64))


# --------------------------------------------------------------- transformations

ALL_CHANGES = {"draws": 3, "noise": 0.3, "exposure": 1.0, "jitter": 0.2, "jpeg": 50}


def test_the_mean_is_of_log_probabilities_over_the_image_and_its_changes():
    mean, seen = transformed(random_images(4, 3, 16, 16), **ALL_CHANGES)
    assert len(seen) == 4
    log_probabilities = [(30 * images.mean((2, 3))).log_softmax(1) for images in seen]
    torch.testing.assert_close(mean, torch.stack(log_probabilities).mean(0))


def test_all_images_but_the_first_are_changed_and_stay_images():
    images = random_images(4, 3, 16, 16)
    _, (first, *others) = transformed(images, **ALL_CHANGES)
    assert torch.equal(first, images)
    for other in others:
        assert (images - other).abs().amax((1, 2, 3)).min() > 0.1
        assert other.min() >= 0
        assert other.max() <= 1


@pytest.fixture
def without_jpeg(monkeypatch) -> None:
    """Leave the images uncompressed, so that each other change can be measured."""
    monkeypatch.setattr(objective, "as_jpeg", lambda images, quality: images)


def test_exposures_change_by_up_to_the_number_of_stops(without_jpeg):
    images = 0.25 + 0.4 * random_images(64, 3, 8, 8)
    _, (_, brighter) = transformed(images, exposure=0.5)
    stops = (brighter.mean((1, 2, 3)) / images.mean((1, 2, 3))).log2()
    assert stops.abs().max() < 0.51
    assert stops.min() < -0.4
    assert stops.max() > 0.4


def test_noise_has_its_standard_deviation(without_jpeg):
    images = 0.25 + 0.5 * random_images(8, 3, 32, 32)
    _, (_, noisy) = transformed(images, noise=0.05)
    assert (noisy - images).std().item() == pytest.approx(0.05, rel=0.1)


def test_shifts_reach_the_jitter_as_a_fraction_of_the_width(without_jpeg):
    """At the center, which turns and scales keep, a ramp changes by the shift alone."""
    ramp = torch.linspace(0, 1, 32).expand(600, 3, 32, 32)
    _, (_, moved) = transformed(ramp, jitter=0.1)
    changes = (moved - ramp)[..., 15:17, 15:17].mean((1, 2, 3))
    shift = changes.abs().max() * 31 / 32  # The ramp is 31 of 32 pixels long.
    assert 0.095 < shift < 0.105


def test_jpeg_is_pillows():
    images = random_images(2, 3, 16, 16)
    for image, found in zip(images, as_jpeg(images, 60), strict=True):
        file = io.BytesIO()
        pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(file, "JPEG", quality=60)
        expected = torch.from_numpy(np.array(Image.open(file))).permute(2, 0, 1) / 255
        assert torch.equal(found, expected)


# --------------------------------------------------------------- attacks

SMALL_STEPS = augment.StepSettings(step_size=0.02)


@pytest.mark.parametrize("margin", [0.0, 2.0])
@pytest.mark.parametrize("quantized", [False, True])
def test_an_attack_stops_when_the_images_exceed_the_margin(attacked, by_color, quantized, margin):
    result = attacked(
        {"lighting": SMALL_STEPS},
        {"views": 2, "shared": True},
        max_steps=100,
        margin=margin,
        quantized=quantized,
    )
    images = result.images
    if quantized:
        images = (images * 255).round() / 255
    logits = by_color(images[0])[None]
    torch.testing.assert_close(result.logits, logits, rtol=0, atol=1e-4)
    leads = logits[..., 1:].amax(2) - logits[..., 0]
    assert result.success.all()
    assert margin <= leads.min() + 1e-4 < margin + 0.5


def smooth_or_rough(images: Tensor) -> Tensor:
    """Return logits that see a smooth image unless neighboring pixels differ much."""
    roughness = (images[..., 1:] - images[..., :-1]).abs().mean((1, 2, 3))
    return torch.stack([60 * (0.2 - roughness), 0 * roughness], dim=1)


def test_success_is_by_the_image_itself_and_not_by_the_mean_over_transformations(attacked):
    """The classifier errs on noisy images alone."""
    classifier = augment.Classifier(smooth_or_rough, 8, ("smooth", "rough"))
    noise = EOTSettings(draws=4, jitter=0.0, exposure=0.0, noise=0.5)
    result = attacked("lighting", classifier=classifier, max_steps=0, eot=noise)
    assert result.minimum.cost < -1  # The mean log-probability of the right class is low.
    assert not result.minimum.success.any()
    assert not result.success.any()
    assert result.minimum.predicted.item() == 0


CHANGES = {"jitter": 0.2, "exposure": 0.5, "noise": 0.1, "jpeg": 60}


def survival(images: Tensor) -> float:
    """Return the fraction of 200 random changes under which images are no orange."""
    _, (_, *changed) = transformed(images, seed=1, draws=200, **CHANGES)
    means = torch.cat([each.mean((2, 3)) for each in changed])
    return (means.argmax(1) != 0).double().mean().item()


def test_adversaries_of_eot_survive_transformations_that_others_do_not():
    classes = ("orange", "lime", "sky")
    classifier = augment.Classifier(lambda images: 100 * images.mean((2, 3)), 8, classes)
    scene = augment.build_scene([("solid:orange", "orange")], 8, rasterizer="numpy")
    rates = {}
    for draws in (0, 8):
        settings = augment.AttackSettings(
            lighting=SMALL_STEPS,
            max_steps=100,
            margin=0.0,
            quantized=False,
            allow_negative=True,
            eot=EOTSettings(draws=draws, **CHANGES),
        )
        result = augment.attack(classifier, scene, settings=settings)
        rates[draws] = survival(result.images)
    assert rates[8] > rates[0] + 0.1
