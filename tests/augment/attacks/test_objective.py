"""Costs, gaps and labels agree with scipy; networks get 8 bits and random transformations."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import log_softmax, logit, softmax
from torch import Tensor, nn

import augment
from augment.attack_settings import EOTSettings
from augment.attacks import objective
from augment.attacks.objective import _moved, as_jpeg
from augment.network import Network, Quantization
from augment.random_streams import generator
from augment.tasks.classification import (
    ClassCriterion,
    complementary_label,
    is_correct,
    label_loss,
    log_odds,
)
from augment.tasks.task import NO_CLASS
from train.training.recipe import ranking_loss

EPS = torch.finfo(torch.float64).eps
ROWS = torch.arange(6)
LOGITS = 3 * torch.randn(6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
CLASSES = torch.tensor([0, 1, 2, 3, 4, 0])
EXCLUDED = torch.tensor([complementary_label(label) for label in CLASSES.tolist()])
LOG_PROBABILITIES = torch.from_numpy(log_softmax(LOGITS.numpy(), axis=1))
PROBABILITIES = softmax(LOGITS.numpy(), axis=1)


@pytest.mark.parametrize("gap", [0, 17, 48])
def test_the_gradient_in_float32_is_exact_if_the_network_is_certain(gap):
    logits = torch.tensor([[0.5, 2.0 + gap, 2.0, 0.0]], requires_grad=True)
    probabilities = torch.from_numpy(softmax(logits.detach().double().numpy(), axis=1))
    # The gradient of log p is onehot − softmax. Float64 rounds 1 − p to 0 at a gap of 48, but not
    # the equal sum of the other probabilities.
    expected = -probabilities
    expected[0, 1] = probabilities[0, [0, 2, 3]].sum()
    ClassCriterion(torch.tensor([1]), torch.tensor([NO_CLASS])).cost(logits).sum().backward()
    # The difference of two logits has an error of up to 50 / 2 · ε, which the exponential keeps.
    rtol = 50 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(logits.grad.double(), expected, rtol=rtol, atol=0)


@pytest.mark.parametrize("factor", [100, 1e4])
def test_the_gradient_of_an_overconfident_network_is_that_of_its_log_odds(factor):
    """The other class of the largest logit has all probability that the source does not have."""
    logits = factor * torch.tensor([[0.5, 4.0, 2.0, 0.0]])
    logits.requires_grad_(True)
    ClassCriterion(torch.tensor([1])).cost(logits).sum().backward()
    assert logits.grad.tolist() == [[0.0, 1.0, -1.0, 0.0]]


def test_the_cost_grows_with_the_log_odds_on_both_sides_of_50():
    odds = torch.tensor([40.0, 49.9, 50.0, 50.1, 104.0, 1e5])
    logits = torch.stack([odds, torch.zeros_like(odds)], dim=1)
    cost = ClassCriterion(torch.zeros(len(odds), dtype=torch.int64)).cost(logits)
    assert (cost.diff() > 0).all()
    torch.testing.assert_close(cost[:3], torch.nn.functional.logsigmoid(odds[:3]), rtol=0, atol=0)


def test_a_class_costs_the_cross_entropy_and_a_complementary_label_that_of_all_other_classes():
    is_class = ROWS % 2 == 0
    loss = label_loss(LOGITS, torch.where(is_class, CLASSES, EXCLUDED))
    others = torch.from_numpy(1 - PROBABILITIES[ROWS, CLASSES])
    expected = torch.where(is_class, -LOG_PROBABILITIES[ROWS, CLASSES], -others.log())
    torch.testing.assert_close(loss, expected, rtol=0, atol=32 * EPS)


def test_a_complementary_label_excludes_the_other_studied_classes_too():
    labels = torch.full((6,), complementary_label(1))
    excluded = PROBABILITIES[:, [1, 4]].sum(1)
    expected = torch.from_numpy(-np.log1p(-excluded))
    torch.testing.assert_close(label_loss(LOGITS, labels, absent=[4]), expected)
    predicted = torch.arange(5)
    assert is_correct(predicted, torch.full((5,), 1)).tolist() == [False, True, False, False, False]
    of_all = torch.full((5,), complementary_label(1))
    assert is_correct(predicted, of_all, [4]).tolist() == [True, False, True, True, False]


def test_the_gap_of_a_target_is_its_lead_and_without_one_that_of_the_best_other_class():
    logits = torch.tensor([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0], [0.0, 4.0, 1.5]])
    source = torch.tensor([1, 0, 1])
    target = torch.tensor([0, 2, NO_CLASS])
    assert ClassCriterion(source, target).gap(logits).tolist() == [1.0, -1.0, -2.5]
    assert ClassCriterion(source).gap(logits).tolist() == [2.0, -1.0, -2.5]


def test_the_gradient_is_finite_if_the_excluded_class_is_certain():
    certain = torch.tensor([[100.0, 0.0, 0.0]], requires_grad=True)
    label_loss(certain, torch.tensor([complementary_label(0)])).sum().backward()
    torch.testing.assert_close(certain.grad, torch.tensor([[1.0, -0.5, -0.5]]))


def test_log_odds_are_the_logit_of_the_probability():
    expected = torch.from_numpy(logit(PROBABILITIES[:, 2]))
    torch.testing.assert_close(log_odds(LOGITS, 2), expected, rtol=64 * EPS, atol=64 * EPS)


def test_ranking_is_the_mean_logistic_loss_of_all_pairs_of_the_class_and_another():
    other = complementary_label(2)
    labels = torch.tensor([2, 0, other, 2, other, 4])
    odds = log_odds(LOGITS, 2).numpy()
    pairs = []
    for positive in (0, 3):
        for negative in (1, 2, 4, 5):
            pairs.append(np.log1p(np.exp(odds[negative] - odds[positive])))
    loss = float(ranking_loss(LOGITS, labels, 2))
    assert loss == pytest.approx(np.mean(pairs), rel=64 * EPS)


@pytest.mark.parametrize("label", [2, complementary_label(2)])
def test_ranking_without_a_pair_is_zero_with_a_zero_gradient(label):
    logits = LOGITS.clone().requires_grad_(True)
    loss = ranking_loss(logits, torch.full((6,), label), 2)
    loss.backward()
    assert loss == 0
    assert not logits.grad.any()


def test_the_cost_is_the_log_probability_or_with_a_target_the_difference_of_the_logits():
    expected = LOG_PROBABILITIES[ROWS, CLASSES]
    cost = ClassCriterion(CLASSES).cost(LOGITS)
    torch.testing.assert_close(cost, expected, rtol=16 * EPS, atol=16 * EPS)
    target = (CLASSES + 2) % 5
    expected = LOGITS[ROWS, CLASSES] - LOGITS[ROWS, target]
    cost = ClassCriterion(CLASSES, target).cost(LOGITS)
    torch.testing.assert_close(cost, expected, rtol=0, atol=64 * EPS)


def test_the_cost_without_any_class_is_zero():
    nothing = torch.full_like(CLASSES, NO_CLASS)
    assert NO_CLASS not in EXCLUDED
    assert not ClassCriterion(nothing, nothing).cost(LOGITS).any()


class Means(nn.Module):
    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, images: Tensor) -> Tensor:
        self.seen.append(images.detach())
        return 30 * images.mean((2, 3))


def random_images(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def transformed(images: Tensor, seed: int = 0, **settings) -> tuple[Tensor, list[Tensor]]:
    """Return the expectation, and the images given to the classifier; one draw changes nothing."""
    nothing = {"draws": 1, "jitter": 0.0, "exposure": 0.0, "noise": 0.0, "jpeg": 100}
    chosen = EOTSettings(**nothing | settings)
    means = Means()
    draws = [generator(seed, index) for index in range(len(images))]
    criterion = ClassCriterion(torch.zeros(len(images), 1, dtype=torch.int64))
    settings = augment.AttackSettings(eot=chosen, quantized=False)
    averaged = objective.Objective(means, criterion, settings)
    return averaged._expected(means(images), images, draws), means.seen


def test_a_model_is_given_bytes_and_its_derivative_ignores_the_rounding():
    means = Means()
    images = random_images(2, 3, 8, 8).requires_grad_()
    Network(means, [Quantization()])(images).sum().backward()
    [seen] = means.seen
    assert torch.equal((seen * 255).round() / 255, seen)
    assert (seen - images).abs().max() <= 0.5 / 255 + 1e-7
    torch.testing.assert_close(images.grad, torch.full_like(images, 30 / 64))


ALL_CHANGES = {"draws": 3, "noise": 0.3, "exposure": 1.0, "jitter": 0.2, "jpeg": 50}


def test_the_mean_is_of_log_probabilities_over_the_image_and_its_changes():
    images = random_images(4, 3, 16, 16)
    mean, (first, *others) = transformed(images, **ALL_CHANGES)
    log_probabilities = [(30 * each.mean((2, 3))).log_softmax(1) for each in (first, *others)]
    torch.testing.assert_close(mean, torch.stack(log_probabilities).mean(0))
    assert torch.equal(first, images)
    assert len(others) == 3
    for other in others:
        assert (images - other).abs().amax((1, 2, 3)).min() > 0.1
        assert 0 <= other.min() <= other.max() <= 1


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


def test_turns_are_those_of_square_pixels_in_images_of_any_shape():
    """A turn by 90 degrees about the center moves pixels to pixels."""
    images = random_images(1, 3, 9, 15)
    turned = _moved(images, torch.tensor([[0.0, 0.0, torch.pi / 2, 0.0]]))
    square = images[..., 3:12]  # in the middle of the image
    found = turned[..., 3:12]
    errors = [(found - square.rot90(count, (2, 3))).abs().max() for count in (1, -1)]
    assert min(errors) < 1e-4


def test_jpeg_is_pillows():
    images = random_images(2, 3, 16, 16)
    for image, found in zip(images, as_jpeg(images, 60), strict=True):
        file = io.BytesIO()
        pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(file, "JPEG", quality=60)
        expected = torch.from_numpy(np.array(Image.open(file))).permute(2, 0, 1) / 255
        assert torch.equal(found, expected)


SMALL_STEPS = augment.StepSettings(step_size=0.02)


@pytest.mark.parametrize(("quantized", "margin"), [(False, 2.0), (True, 0.0)])
def test_an_attack_stops_when_the_images_exceed_the_margin(attacked, by_color, quantized, margin):
    options = {"max_steps": 100, "margin": margin, "quantized": quantized}
    result = attacked({"lighting": SMALL_STEPS}, {"views": 2, "shared": True}, **options)
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


# Large changes of the exposure also change the mean, since values are clamped.
CHANGES = {"jitter": 0.4, "exposure": 1.5, "noise": 0.1, "jpeg": 60}


def survival(images: Tensor) -> float:
    """Return the fraction of 100 random changes under which images are no orange."""
    _, (_, *changed) = transformed(images, seed=1, draws=100, **CHANGES)
    means = torch.cat([each.mean((2, 3)) for each in changed])
    return (means.argmax(1) != 0).double().mean().item()


def test_adversaries_of_eot_survive_transformations_that_others_do_not():
    classes = ("orange", "lime", "sky")
    classifier = augment.Classifier(lambda images: 100 * images.mean((2, 3)), 8, classes)
    scene = augment.build_scene([("solid:orange", "orange")], 8, rasterizer="numpy")
    rates = {}
    options = {"max_steps": 100, "margin": 0.0, "quantized": False, "allow_negative": True}
    for draws in (0, 8):
        eot = EOTSettings(draws=draws, **CHANGES)
        settings = augment.AttackSettings(lighting=SMALL_STEPS, eot=eot, **options)
        result = augment.attack(classifier, scene, settings=settings)
        rates[draws] = survival(result.images)
    assert rates[8] > rates[0] + 0.05
