"""An image counts as adversarial if it is so after a camera's noise and 8 bits."""

import math
from types import SimpleNamespace

import pytest
import torch
from oracles import draw_uniform
from scipy.stats import norm
from torch import Tensor

import augment
from augment.attacks.loop import minimize
from augment.attacks.objective import NOISE_DRAWS, Objective, add_sensor_noise
from augment.attacks.result import AttackResult
from augment.augmentation_settings import TrainingAttackSettings
from augment.tasks.classification import ClassCriterion
from augment.tasks.task import NO_CLASS

SIZE = 8
PATTERN = torch.randn(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) / SIZE
GAIN = 200.0
# The standard deviation that noise of one step of 8 bits gives the difference of the logits.
# Rounding adds a twelfth to the variance of the noise.
CHANGE_BY_NOISE = 2 * GAIN * float(PATTERN.norm()) / 255 * math.sqrt(1 + 1 / 12)


def resemblance(images: Tensor) -> Tensor:
    return (images * PATTERN.to(images)).sum((1, 2, 3))


def nervous(threshold: float) -> augment.Classifier:
    """Make a classifier by the pattern whose logits noise alone changes by several units."""

    def logits(images: Tensor) -> Tensor:
        excess = GAIN * (resemblance(images) - threshold)
        return torch.stack([-excess, excess], dim=1)

    return augment.Classifier(logits, SIZE, ("orange", "other"), "nervous")


def counted(images, classifier, criterion=None) -> Tensor:
    views = images.shape[:2]
    criterion = criterion or ClassCriterion(torch.zeros(views, dtype=torch.long))
    predicted = classifier(images.flatten(0, 1)).argmax(1).view(views)
    objective = Objective(classifier, criterion, augment.AttackSettings(quantized=False))
    return objective.fooled_in_views(images, predicted, torch.arange(len(images)))


def with_leads(images: Tensor, leads: Tensor) -> Tensor:
    """Change images until their resemblance leads the threshold 0 by some deviations."""
    missing = leads * CHANGE_BY_NOISE / (2 * GAIN) - resemblance(images)
    return images + missing[:, None, None, None] * PATTERN / PATTERN.square().sum()


@pytest.mark.parametrize("lead", [0.3, 1.5])
def test_an_image_counts_with_the_probability_of_gaussian_noise_in_three_draws(lead):
    """Each draw of a linear classifier succeeds with the probability Φ(lead)."""
    images = 0.3 + 0.4 * draw_uniform(1500, 3, SIZE, SIZE, seed=1).float()
    images = with_leads(images, torch.full((1500,), lead))[:, None]
    expected = norm.cdf(lead) ** NOISE_DRAWS
    tolerance = 4 * math.sqrt(expected * (1 - expected) / len(images))
    rate = counted(images, nervous(0.0)).double().mean().item()
    assert rate == pytest.approx(expected, abs=tolerance)


def noisy_images(images: Tensor, rows: Tensor, seed: int) -> list[Tensor]:
    return list(add_sensor_noise(images, 1.0, rows, seed, "noise"))


def test_noise_has_8_bits_and_depends_on_the_seed_and_the_example_alone():
    images = torch.rand(5, 2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(2))
    state = torch.get_rng_state()
    whole = noisy_images(images, torch.arange(5), 3)
    assert torch.equal(torch.get_rng_state(), state)
    assert len(whole) == NOISE_DRAWS
    assert not torch.equal(whole[0], whole[1])
    rows = torch.tensor([3, 1])
    part = noisy_images(images[rows], rows, 3)
    others = noisy_images(images, torch.arange(5), 4)
    for noisy, noisy_part, other in zip(whole, part, others, strict=True):
        assert torch.equal(noisy[rows], noisy_part)
        assert not torch.equal(noisy, other)
        assert torch.equal((noisy * 255).round() / 255, noisy)
        assert 0 <= noisy.min() <= noisy.max() <= 1


def test_noise_comes_before_rounding():
    """A gray between two steps becomes either of them, as often as it is close to it."""
    gray = torch.full((1, 1, 3, 200, 200), 100.25 / 255)
    dithered = 255 * next(add_sensor_noise(gray, 0.6, torch.arange(1), 0))
    assert dithered.mean().item() == pytest.approx(100.25, abs=0.01)


GRAY = torch.full((3, SIZE, SIZE), 0.5)
AT_GRAY = float(resemblance(GRAY[None]))


def test_each_view_is_counted_by_itself():
    """The first view is far above the threshold, the second hardly, and the third below."""
    views = [GRAY + change * PATTERN for change in (0.1, 1e-4, -0.1)]
    images = torch.stack(views).expand(40, -1, -1, -1, -1)
    rates = counted(images, nervous(AT_GRAY)).double().mean(0)
    far, close, below = rates.tolist()
    assert far == 1
    assert 0 < close < 0.5
    assert below == 0


@pytest.mark.parametrize("source", [0, NO_CLASS])
def test_a_target_must_be_reached_with_noise(source):
    """Another class is not enough, and the image is close to the threshold."""
    images = (GRAY + 1e-4 * PATTERN)[None, None]
    criterion = ClassCriterion(torch.tensor([[source]]), torch.tensor([[1]]))
    assert not counted(images, nervous(AT_GRAY), criterion).any()


def small_attack(attacked, **settings) -> AttackResult:
    """Attack by small steps, which end close to where the classifier errs."""
    scene = {"backgrounds": [0.3, 0.4, 0.5, 0.6]}
    far = attacked("lighting", scene, nervous(1e3), max_steps=8, force=True)
    before = resemblance(far.images_before).max()
    change = resemblance(far.images).min() - before
    threshold = float(before + 0.3 * change.clamp(min=0.02))
    steps = {"lighting": augment.StepSettings(step_size=0.1)}
    options = {"force": True, "max_steps": 12}
    return attacked(steps, scene, nervous(threshold), **options, **settings)


def dark_center(images: Tensor) -> Tensor:
    brightness = 60 * (images[:, 0, SIZE // 2, SIZE // 2] - 0.61)
    return torch.stack([brightness, 0 * brightness], dim=1)


def test_restarts_go_on_with_successes_that_do_not_survive_noise():
    """The first start ends just below the threshold, where noise undoes the success."""
    scene = augment.build_scene([("solid:orange", 0)], SIZE, rasterizer="numpy")

    def run(**options) -> AttackResult:
        lighting = augment.StepSettings("l2", 1.0, step_size=0.004)
        settings = augment.AttackSettings(lighting=lighting, max_steps=50, margin=0.0, **options)
        return augment.attack(dark_center, scene, settings=settings, seed=6)

    first = run(sensor_noise=6.0)
    assert first.success_without_noise.all()
    assert not first.success.any()
    assert run(sensor_noise=6.0, restarts=10).success.all()
    assert torch.equal(run(sensor_noise=0.0, restarts=10).steps, first.steps)


def test_noise_changes_no_descent_and_no_other_random_number_and_fewer_attacks_count(attacked):
    torch.manual_seed(5)
    without = small_attack(attacked)
    state = torch.get_rng_state()
    torch.manual_seed(5)
    with_noise = small_attack(attacked, sensor_noise=1.0)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(without.images, with_noise.images)
    for name, value in vars(without.minimum).items():
        assert torch.equal(value, getattr(with_noise.minimum, name)), name
    assert torch.equal(without.success, without.success_without_noise)
    assert torch.equal(without.success, with_noise.success_without_noise)
    assert (with_noise.success <= without.success).all()
    assert with_noise.success.sum() < without.success.sum()


def still_scene(views: Tensor) -> SimpleNamespace:
    return SimpleNamespace(
        start=torch.zeros(1, 1),
        group_size=1,
        render=lambda values, examples: views[None] + 0 * values[:, :, None, None, None],
        scale_gradient=lambda gradient: gradient,
        project=lambda values, examples: torch.zeros_like(values),
    )


@pytest.mark.parametrize(("leads", "steps"), [((20.0, 20.0), 0), ((20.0, 0.1), 3)])
def test_descent_goes_on_until_every_view_leads_by_the_noise_margin(leads, steps):
    """Leads are in standard deviations of the change of the logits by noise."""
    views = with_leads(torch.full((2, 3, SIZE, SIZE), 0.5), torch.tensor(leads))
    criterion = ClassCriterion(torch.zeros(1, 2, dtype=torch.long))
    settings = augment.AttackSettings(
        max_steps=3, margin=0.0, sensor_noise=1.0, noise_margin=1.0, quantized=False
    )
    result = minimize(still_scene(views), Objective(nervous(0.0), criterion, settings))
    assert result.success.tolist() == [True]
    assert result.steps.tolist() == [steps]


def test_checks_files_transfers_and_sweeps_count_as_the_attack_does(attacked, tmp_path):
    result = small_attack(attacked, sensor_noise=1.0, margin=3.0)
    checks = augment.check(result)
    lines = augment.save(result, tmp_path, checks, verify=["reload"])
    for name in ("success", "success_without_noise"):
        success = getattr(result, name)
        assert checks[name] == success[result.clean_correct].double().mean().item()
        for line, expected in zip(lines, success.tolist(), strict=True):
            versions = line["versions"]
            assert line[name] == versions["float"][name] == versions["reload"][name] == expected
    assert checks["success_by_steps"][12] == checks["success"]
    assert checks["random_search"] <= checks["random_search_without_noise"]
    with_noise = list(checks["success_by_steps"].values())
    without = list(checks["success_by_steps_without_noise"].values())
    assert with_noise == sorted(with_noise)
    assert all(noisy <= exact for noisy, exact in zip(with_noise, without, strict=True))
    (row,) = augment.transfer(result, [result.classifier])
    assert row["success"] == [True] * int((result.clean_correct & result.success).sum())
    (row,) = augment.success_by_radius(result, [100.0])
    for method in ("adversarial", "random"):
        assert (row[method] <= row[f"{method}_without_noise"]).all()


def test_training_attacks_count_without_noise_unless_told_otherwise():
    options = {"views": 2, "samples": 1, "backgrounds": [0.3, 0.6], "rasterizer": "numpy"}
    renders = []
    for settings in ({}, {"sensor_noise": 1.0}):
        attack = TrainingAttackSettings(max_steps=4, **settings)
        chosen = augment.AugmentationSettings(attack=attack)
        meshes = [("solid:orange:0", 0)]
        service = augment.AugmentationService.from_meshes(meshes, SIZE, chosen, **options)
        renders.append(service.regenerate(nervous(0.2).train(), 0))
    without, noisy = renders
    assert torch.equal(without.images, noisy.images)
    assert "attack_success_without_noise" not in without.diagnostics
    success_without_noise = noisy.diagnostics["attack_success_without_noise"]
    assert success_without_noise == without.diagnostics["attack_success"]
    assert success_without_noise >= noisy.diagnostics["attack_success"]
