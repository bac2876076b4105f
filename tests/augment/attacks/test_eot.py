"""Images as classifiers get them: of 8 bits, and under random transformations; success is by the former alone."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

import augment
from augment.attack_settings import EOTSettings
from augment.attacks import eot
from augment.attacks.eot import ExpectationOverTransformations, Quantized, as_jpeg
from augment.random_streams import generator


class Means(nn.Module):
    """Logits are the channels' means, over which hangs a record of what was seen."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, images: Tensor) -> Tensor:
        self.seen.append(images.detach())
        return 30 * images.mean((2, 3))


def noise(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def transformed(images: Tensor, seed: int = 0, **settings) -> tuple[Tensor, list[Tensor]]:
    """The expectation, and the images that the model was given for it."""
    nothing = {"draws": 1, "jitter": 0.0, "exposure": 0.0, "noise": 0.0, "jpeg": 100}
    expectation = ExpectationOverTransformations(EOTSettings(**nothing | settings), generator(seed))
    means = Means()
    return expectation(means, images, means(images)), means.seen


def test_a_model_is_given_bytes_and_its_derivative_passes_them_by():
    means, images = Means(), noise(2, 3, 8, 8).requires_grad_()
    Quantized(means)(images).sum().backward()
    assert torch.equal((means.seen[0] * 255).round() / 255, means.seen[0])
    assert (means.seen[0] - images).abs().max() <= 0.5 / 255 + 1e-7
    torch.testing.assert_close(images.grad, torch.full_like(images, 30 / 64))


def test_the_mean_is_of_log_probabilities_over_the_image_and_its_changes():
    images = noise(4, 3, 16, 16)
    mean, seen = transformed(images, draws=3, noise=0.3, exposure=1.0, jitter=0.2, jpeg=50)
    assert torch.equal(seen[0], images) and len(seen) == 4
    assert all((images - other).abs().amax((1, 2, 3)).min() > 0.1 for other in seen[1:])
    assert all(other.min() >= 0 and other.max() <= 1 for other in seen)
    torch.testing.assert_close(
        mean, torch.stack([(30 * x.mean((2, 3))).log_softmax(1) for x in seen]).mean(0)
    )


def test_each_change_does_what_it_says(monkeypatch):
    monkeypatch.setattr(eot, "as_jpeg", lambda images, quality: images)
    images = 0.25 + 0.5 * noise(8, 3, 32, 32)
    _, (_, brighter) = transformed(images, exposure=0.5)
    stops = (brighter.mean((1, 2, 3)) / images.mean((1, 2, 3))).log2()
    assert stops.abs().max() < 0.52 and stops.min() < -0.1 and stops.max() > 0.1
    _, (_, noisy) = transformed(images, noise=0.05)
    assert (noisy - images).std().item() == pytest.approx(0.05, rel=0.1)
    ramp = torch.linspace(0, 1, 32).expand(64, 3, 32, 32)
    _, (_, moved) = transformed(ramp, jitter=0.1)
    inner = (moved - ramp)[..., 12:20, 12:20].mean((1, 2, 3))
    assert (
        0.05 < inner.abs().max() < 0.115
    )  # a shift of a tenth of a ramp from 0 to 1, and a corner's turn


def test_shifts_reach_the_jitter_as_a_fraction_of_the_width(monkeypatch):
    """At the center, which turns and scales leave where it is, a ramp changes by the shift alone."""
    monkeypatch.setattr(eot, "as_jpeg", lambda images, quality: images)
    ramp = torch.linspace(0, 1, 32).expand(600, 3, 32, 32)
    _, (_, moved) = transformed(ramp, jitter=0.1)
    shift = (
        (moved - ramp)[..., 15:17, 15:17].mean((1, 2, 3)).abs().max() * 31 / 32
    )  # of 32 pixels from 0 to 1
    assert 0.095 < shift < 0.105


def test_jpeg_is_pillows():
    images = noise(2, 3, 16, 16)
    for image, found in zip(images, as_jpeg(images, 60), strict=True):
        file = io.BytesIO()
        Image.fromarray((image * 255).round().byte().permute(1, 2, 0).numpy()).save(
            file, "JPEG", quality=60
        )
        expected = torch.from_numpy(np.array(Image.open(file))).permute(2, 0, 1) / 255
        assert torch.equal(found, expected)


@pytest.mark.parametrize("quantized", [False, True])
def test_adversaries_exceed_the_margin_and_without_one_stop_at_the_border(
    attacked, by_color, quantized
):
    """By the classifier's own logits on the images, rounded where they are to be."""
    for margin in (0.0, 2.0):
        light = {"lighting": augment.StepSettings(step_size=0.02)}
        result = attacked(
            light, {"views": 2, "shared": True}, max_steps=100, margin=margin, quantized=quantized
        )
        images = (result.images * 255).round() / 255 if quantized else result.images
        logits = by_color(images[0])[None]
        torch.testing.assert_close(result.logits, logits, rtol=0, atol=1e-4)
        gap = (logits[..., 1:].amax(2) - logits[..., 0]).min()
        assert result.success.all() and margin <= gap + 1e-4 < margin + 0.5


def test_success_is_by_the_image_itself_and_not_by_the_mean_over_transformations(attacked):
    """Of a classifier that errs on noisy images alone."""

    def smooth_or_rough(images: Tensor) -> Tensor:
        roughness = (images[..., 1:] - images[..., :-1]).abs().mean((1, 2, 3))
        return torch.stack([60 * (0.2 - roughness), 0 * roughness], dim=1)

    classifier = augment.Classifier(smooth_or_rough, 8, ("smooth", "rough"))
    noise = EOTSettings(draws=4, jitter=0.0, exposure=0.0, noise=0.5)
    result = attacked("lighting", classifier=classifier, max_steps=0, eot=noise)
    assert result.descent.cost < -1  # the mean log-probability of the right class
    assert (
        not result.descent.success.any()
        and not result.success.any()
        and result.descent.predicted.item() == 0
    )


def test_adversaries_of_eot_survive_transformations_that_others_do_not():
    """Noise and exposure of the classifier's own images, which are other ones than the attack's."""
    classifier = augment.Classifier(
        lambda images: 100 * images.mean((2, 3)), 8, ("orange", "lime", "sky")
    )
    scene = augment.build_scene([("solid:orange", "orange")], 8, rasterizer="numpy")
    steps = {
        "lighting": augment.StepSettings(step_size=0.02),
        "max_steps": 100,
        "margin": 0.0,
        "quantized": False,
    }
    survived = []
    for draws in (0, 8):
        changes = EOTSettings(draws=draws, jitter=0.2, exposure=0.5, noise=0.1, jpeg=60)
        settings = augment.AttackSettings(**steps, allow_negative=True, eot=changes)
        result = augment.attack(classifier, scene, settings=settings)
        _, (_, *others) = transformed(
            result.images[:, 0], 1, draws=200, jitter=0.2, exposure=0.5, noise=0.1, jpeg=60
        )
        means = torch.cat([image.mean((2, 3)) for image in others])
        survived.append((means.argmax(1) != 0).double().mean().item())
    assert survived[1] > survived[0] + 0.1
