"""What counts as a success: what a camera stores, with its noise and 8 bits, must fool the classifier, too."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import Tensor

import augment
from augment.attacks.attack import AttackResult, fooled_in_views
from augment.attacks.descent import Criterion
from augment.attacks.eot import NOISE_DRAWS, stored
from augment.losses import NO_CLASS
from augment.settings import TrainingAttackSettings
from renderer.errors import InputError

SIZE = 8
PATTERN = torch.randn(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) / SIZE
GAIN = 200.0
# Of the logits' difference: rounding to steps of 1/255 adds a twelfth to the noise's variance of one step squared.
CHANGE_BY_NOISE = 2 * GAIN * float(PATTERN.norm()) / 255 * math.sqrt(1 + 1 / 12)


def nervous(threshold: float, size: int = SIZE) -> augment.Classifier:
    """Orange is what resembles a pattern by less than a threshold; noise alone changes its logits by several units."""

    def logits(images: Tensor) -> Tensor:
        excess = GAIN * ((images * PATTERN.to(images)).sum((1, 2, 3)) - threshold)
        return torch.stack([-excess, excess], dim=1)

    return augment.Classifier(logits, size, ("orange", "other"), "nervous")


def count(images: Tensor, classifier: augment.Classifier, seed: int = 0, **settings) -> Tensor:
    """Which images (A, V, 3, SIZE, SIZE) count as no orange, by the library's function."""
    criterion = Criterion(torch.zeros(images.shape[:2], dtype=torch.long))
    predicted = classifier(images.flatten(0, 1)).argmax(1).view(images.shape[:2])
    chosen = augment.AttackSettings(**settings)
    return fooled_in_views(
        classifier, images, predicted, torch.arange(len(images)), criterion, chosen, seed
    )


def survival(
    images: Tensor, classifier: augment.Classifier, deviation: float, draws: int = 30
) -> float:
    """The fraction of images (A, V, 3, SIZE, SIZE) that are no orange under noise of NumPy's, rounded to 8 bits."""
    rng, hits = np.random.default_rng(7), []
    for _ in range(draws):
        noisy = images.numpy() + rng.normal(0, deviation / 255, images.shape)
        rounded = torch.from_numpy(np.round(255 * noisy.clip(0, 1)) / 255).float()
        hits.append((classifier(rounded.flatten(0, 1)).argmax(1) != 0).double().mean())
    return float(torch.stack(hits).mean())


@pytest.mark.parametrize("lead", [0.3, 0.8, 1.5])
def test_the_fraction_that_counts_is_that_of_gaussian_noise_in_three_draws(lead):
    """Of a linear classifier, whose lead in units of its change by noise decides: Φ(lead) for each draw."""
    images = 0.3 + 0.4 * torch.rand(
        1500, 1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1)
    )
    resemblance = (images * PATTERN).sum((2, 3, 4), keepdim=True)
    wanted = (
        lead * CHANGE_BY_NOISE / (2 * GAIN)
    )  # each image is moved along the pattern to the same lead
    images = images + (wanted - resemblance) * PATTERN / PATTERN.square().sum()
    expected = norm.cdf(lead) ** NOISE_DRAWS
    tolerance = 4 * math.sqrt(expected * (1 - expected) / len(images))
    counted = count(images, nervous(0.0), quantized=False).double().mean().item()
    assert counted == pytest.approx(expected, abs=tolerance)
    assert count(images, nervous(0.0), sensor_noise=0.0, quantized=False).all()


def test_noise_comes_before_rounding_and_depends_on_the_seed_and_the_example_alone():
    images = torch.rand(5, 2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(2))
    state = torch.get_rng_state()
    whole = [*stored(images, 1.0, torch.arange(5), 3, "noise")]
    assert torch.equal(torch.get_rng_state(), state) and len(whole) == NOISE_DRAWS
    part = [*stored(images[[3, 1]], 1.0, torch.tensor([3, 1]), 3, "noise")]
    others = [*stored(images, 1.0, torch.arange(5), 4, "noise")]
    for all_images, some, other in zip(whole, part, others, strict=True):
        assert torch.equal(all_images[[3, 1]], some) and not torch.equal(all_images, other)
        assert torch.equal((all_images * 255).round() / 255, all_images)
        assert all_images.min() >= 0 and all_images.max() <= 1
    assert not torch.equal(whole[0], whole[1])
    # A gray between two steps becomes either of them, as often as it is close to it.
    gray = torch.full((1, 1, 3, 200, 200), 100.25 / 255)
    dithered = next(stored(gray, 0.6, torch.arange(1), 0)) * 255
    assert dithered.mean().item() == pytest.approx(100.25, abs=0.01)


def test_each_view_is_counted_by_itself():
    """The first view is far beyond the threshold, the second hardly so, and the third is an orange."""
    gray, classifier = torch.full((40, 3, SIZE, SIZE), 0.5), nervous(float(0.5 * PATTERN.sum()))
    images = torch.stack([gray + change * PATTERN for change in (0.1, 1e-4, -0.1)], dim=1)
    far, close, orange = count(images, classifier, quantized=False).double().mean(0).tolist()
    assert (far, orange) == (1, 0) and 0 < close < 0.5


# ------------------------------------------------------------------------------------- attacks


FINE = {  # steps that end close to where the classifier errs
    "lighting": augment.StepSettings(step_size=0.1),
    "pose": augment.PoseSettings("linf", 1.0, "sign", 0.02),
    "material": augment.MaterialSettings("linf", 1.0, "sign", 0.02, hue=30.0),
}


def threshold_of(attacked, parameter: str, scene: dict, share: float) -> float:
    """A threshold between what images of a scene show and what the attacks of a parameter reach."""
    far = attacked(parameter, scene, nervous(1e3), max_steps=8, force=True)
    before, after = ((side * PATTERN).sum((1, 2, 3, 4)) for side in (far.images_before, far.images))
    return float(before.max() + share * (after.min() - before.max()).clamp(min=0.02))


def small_attack(attacked, parameter: str = "lighting", **settings) -> AttackResult:
    scene = {"backgrounds": [0.3, 0.4, 0.5, 0.6][: 4 if parameter == "lighting" else 2]}
    share = 0.3 if parameter == "lighting" else 0.1
    classifier = nervous(threshold_of(attacked, parameter, scene, share))
    steps = {parameter: FINE[parameter]}
    return attacked(steps, scene, classifier, force=True, max_steps=12, **settings)


def test_noise_changes_what_counts_and_neither_the_descent_nor_any_other_random_number(attacked):
    torch.manual_seed(5)
    without, state = small_attack(attacked), torch.get_rng_state()
    torch.manual_seed(5)
    with_noise = small_attack(attacked, sensor_noise=1.0)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(without.images, with_noise.images)
    assert all(
        torch.equal(value, getattr(with_noise.descent, name))
        for name, value in vars(without.descent).items()
    )
    assert torch.equal(without.success, without.success_without_noise)
    assert torch.equal(without.success, with_noise.success_without_noise) and without.success.any()
    assert not (with_noise.success & ~without.success).any()
    assert with_noise.success.sum() < without.success.sum()


@pytest.mark.parametrize("parameter", ["pose", pytest.param("material", marks=pytest.mark.slow)])
def test_adversarial_poses_and_materials_survive_the_noise_of_other_seeds(
    attacked, tmp_path, parameter
):
    """From their files; fewer do where the margin is that of the logits alone."""
    rates = {}
    for noise_margin in (0.0, None):
        result = small_attack(
            attacked, parameter, sensor_noise=1.0, noise_margin=noise_margin, margin=0.1
        )
        chosen = (result.clean_correct & result.success_without_noise).nonzero()[:, 0].tolist()
        assert chosen
        augment.save(result, tmp_path / str(noise_margin), verify=())
        folders = [tmp_path / str(noise_margin) / f"example_{row:03d}" for row in chosen]
        images = torch.stack([augment.reload(folder).render() for folder in folders])
        rates[noise_margin] = [
            survival(images, result.classifier, deviation) for deviation in (0.25, 1.0)
        ]
    assert min(rates[None]) > 0.95 and rates[0.0][1] < rates[None][1]


def test_checks_sweeps_transfers_and_files_count_as_the_attack_does(attacked, tmp_path):
    result = small_attack(attacked, sensor_noise=1.0, margin=3.0)
    clean = result.clean_correct
    checks = augment.check(result)
    assert checks["success"] == result.success[clean].double().mean().item()
    assert (
        checks["success_without_noise"]
        == result.success_without_noise[clean].double().mean().item()
    )
    assert checks["success_by_steps"][12] == checks["success"]
    for name in ("success_by_steps", "success_by_steps_without_noise"):
        rates = [*checks[name].values()]
        assert rates == sorted(rates)
    for steps, rate in checks["success_by_steps"].items():
        assert rate <= checks["success_by_steps_without_noise"][steps]
    assert checks["random_search"] <= checks["random_search_without_noise"]
    lines = augment.save(result, tmp_path, checks, verify=["reload"])
    for row, line in enumerate(lines):
        for name in ("success", "success_without_noise"):
            expected = bool(getattr(result, name)[row])
            assert (
                line[name]
                == line["versions"]["float"][name]
                == line["versions"]["reload"][name]
                == expected
            )
    (same,) = augment.transfer(result, [result.classifier])
    assert len(same["success"]) == int((clean & result.success).sum()) and all(same["success"])
    (sweep,) = augment.success_by_radius(result, [100.0])
    assert not (sweep["adversarial"] & ~sweep["adversarial_without_noise"]).any()
    assert not (sweep["random"] & ~sweep["random_without_noise"]).any()


def test_a_target_must_be_reached_with_noise(attacked):
    """Any other class is not enough."""
    images = torch.full((1, 1, 3, SIZE, SIZE), 0.5) + 1e-4 * PATTERN
    classifier = nervous(float(0.5 * PATTERN.sum()))
    predicted = torch.ones(1, 1, dtype=torch.long)
    for source, target in ((0, 1), (NO_CLASS, 1)):
        criterion = Criterion(torch.tensor([[source]]), torch.tensor([[target]]))
        settings = augment.AttackSettings(quantized=False)
        rows = torch.zeros(1, dtype=torch.long)
        assert not fooled_in_views(
            classifier, images, predicted, rows, criterion, settings, 0
        ).any()


def test_training_attacks_stop_as_before_and_count_without_noise_unless_told_otherwise():
    counted = []
    for settings in ({}, {"sensor_noise": 1.0}):
        attack = TrainingAttackSettings(max_steps=4, **settings)
        service = augment.AugmentationService.from_meshes(
            [("solid:orange:0", 0)],
            SIZE,
            augment.AugmentationSettings(attack=attack),
            views=2,
            samples=1,
            backgrounds=[0.3, 0.6],
            rasterizer="numpy",
        )
        renders = service.regenerate(nervous(0.2).train(), 0)
        counted.append((renders.images, renders.diagnostics))
    (images, without), (others, noisy) = counted
    assert torch.equal(images, others)
    assert "attack_success_without_noise" not in without
    assert (
        noisy["attack_success_without_noise"]
        == without["attack_success"]
        >= noisy["attack_success"]
    )


@pytest.mark.parametrize(
    "settings", [{"sensor_noise": -0.1}, {"sensor_noise": 256.0}, {"noise_margin": math.nan}]
)
def test_impossible_noise_is_refused(settings):
    (name,) = settings
    with pytest.raises(InputError, match=f"{name}=.* must be at least 0"):
        augment.AttackSettings(**settings)
