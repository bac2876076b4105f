import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from augment import distributed
from augment.losses import ranking_loss
from renderer.errors import InputError
from renderer.image import to_unit
from train.networks import WideResNet
from train.settings import AUGMENTATIONS, TRANSFORMS, TrainSettings
from train.training.baselines import PGD, Baseline
from train.training.loss import TrainingLoss
from train.training.recipe import SCHEDULE_FACTORS

LABELS = torch.tensor([0, 1, 2, 3, 0, 1])


@pytest.fixture
def images() -> torch.Tensor:
    return torch.randint(0, 256, (6, 3, 16, 16), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def model() -> nn.Module:
    torch.manual_seed(0)
    return WideResNet(4, 10, 1, 0.3)


@pytest.mark.parametrize("name, value", [("learning_rate", math.nan), ("distillation", 1.0), ("ema_decay", -0.1)])
def test_a_setting_out_of_range_is_named(name, value):
    with pytest.raises(InputError, match=rf"\b{name}\b"):
        TrainSettings(**{name: value})


@pytest.mark.parametrize("epochs", [10, 50, 150])
def test_the_step_schedule_falls_to_a_fifth_at_30_60_and_80_percent_of_the_epochs(epochs):
    rates = [SCHEDULE_FACTORS["step"](epoch / epochs) for epoch in range(epochs)]
    parts = [3, 3, 2, 2]
    assert rates == [0.2**fall for fall, part in enumerate(parts) for _ in range(part * epochs // 10)]


PROGRESS = np.linspace(0, 1, 1001)


@pytest.mark.parametrize(
    "schedule, expected",
    [
        ("cosine", np.cos(math.pi / 2 * PROGRESS) ** 2),  # half a cosine, by the half-angle formula
        ("one_cycle", np.interp(PROGRESS, [0, 0.2, 1], [0.1, 1, 0])),
    ],
)
def test_a_continuous_schedule_is_its_closed_form(schedule, expected):
    np.testing.assert_allclose([SCHEDULE_FACTORS[schedule](progress) for progress in PROGRESS], expected, atol=1e-12)


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_the_loss_is_the_smoothed_cross_entropy_and_on_images_of_the_data_the_divergence_from_a_teacher(
    model, images, smoothing
):
    """The teacher's probabilities q are a constant: Σ q log(q / p)."""
    rendered, teacher = torch.arange(6) < 2, WideResNet(4, 10, 1, dropout=0.0).eval().requires_grad_(False)
    settings = TrainSettings(init_from="base", label_smoothing=smoothing, distillation=4.0)
    loss, hits = TrainingLoss(model.eval(), settings, (), teacher).compute(images, LABELS, rendered)
    logits = model(images / 255)
    p, q = logits[2:].softmax(1), teacher(images[2:] / 255).softmax(1)
    uniform, divergence = -F.log_softmax(logits, 1).mean(), (q * (q / p).log()).sum() / 6
    cross_entropy = F.cross_entropy(logits, LABELS)
    torch.testing.assert_close(loss, (1 - smoothing) * cross_entropy + smoothing * uniform + 4 * divergence)
    assert hits == (logits.argmax(1) == LABELS).sum()

    kept = [0, 2, 3]  # on renders, the classes beside the label, among themselves
    p, q = logits[:2, kept].softmax(1), teacher(images[:2] / 255)[:, kept].softmax(1)
    ranked = TrainingLoss(model, settings, (1,), teacher).compute(images, LABELS, rendered)[0]
    torch.testing.assert_close(ranked, loss + 4 * (q * (q / p).log()).sum() / 6)


def test_unlabeled_images_have_the_teachers_answers_as_labels_but_no_cross_entropy(model, images):
    rendered, teacher = torch.arange(6) < 2, WideResNet(4, 10, 1, dropout=0.0).eval().requires_grad_(False)
    settings = TrainSettings(init_from="base", distillation=4.0, ranking=2.0)
    answers = torch.where(rendered, LABELS, teacher(images / 255).argmax(1))
    studied = (int(answers[-1]),)
    labeled, hits = TrainingLoss(model.eval(), settings, studied, teacher).compute(images, answers, rendered)
    cross_entropy = F.cross_entropy(model(images / 255)[2:], answers[2:], reduction="sum") / 6
    loss = TrainingLoss(model, settings, studied, teacher, labeled=False)
    unlabeled = loss.compute(images, LABELS * rendered, rendered)
    torch.testing.assert_close(unlabeled, (labeled - cross_entropy, hits))


def test_the_ranking_is_added_by_its_weight(model, images):
    labels = LABELS - 1  # two of "anything but class 0"
    alone, both = (
        TrainingLoss(model.eval(), TrainSettings(ranking=weight), (1,), None).compute(images, labels, labels == 0)[0]
        for weight in (0.0, 4.0)
    )
    torch.testing.assert_close(both, alone + 4 * ranking_loss(model(images / 255), labels, 1))


def test_several_classes_are_ranked_alike_and_left_out_of_the_teachers_predictions_on_renders(model, images):
    labels, rendered = torch.tensor([1, 3, 0, 2, 1, -2]), torch.arange(6) > 1
    teacher = WideResNet(4, 10, 1, dropout=0.0).eval().requires_grad_(False)
    logits, answers = model.eval()(images / 255), teacher(images / 255)
    settings = TrainSettings(init_from="base", ranking=4.0, distillation=2.0)
    loss, hits = TrainingLoss(model, settings, (1, 3), teacher).compute(images, labels, rendered)
    entropy = F.cross_entropy(logits[:5], labels[:5], reduction="sum") - logits.softmax(1)[5, [0, 2]].sum().log()
    ranked = (ranking_loss(logits, labels, 1) + ranking_loss(logits, labels, 3)) / 2
    q, p = answers[:2].softmax(1), logits[:2].softmax(1)
    others, kept = answers[2:, [0, 2]].softmax(1), logits[2:, [0, 2]].softmax(1)
    kept_answers = ((q * (q / p).log()).sum() + (others * (others / kept).log()).sum()) / 6
    torch.testing.assert_close(loss, entropy / 6 + 4 * ranked + 2 * kept_answers)
    predicted = logits.argmax(1)
    assert hits == (predicted[:5] == labels[:5]).sum() + (int(predicted[5]) not in (1, 3))


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_an_augmentation_is_a_function_of_seed_and_step_and_leaves_model_and_random_state_alone(name, images, model):
    before = torch.get_rng_state()
    first, again = (Baseline(name, model, 3).apply(images, LABELS, 7) for _ in range(2))
    assert first.dtype == torch.uint8 and first.shape == images.shape
    assert torch.equal(first, again)
    assert torch.equal(torch.get_rng_state(), before)
    assert model.training and all(parameter.grad is None for parameter in model.parameters())
    if name == "none":
        assert torch.equal(first, images)
    else:
        assert not torch.equal(first, Baseline(name, model, 3).apply(images, LABELS, 8))
        assert not torch.equal(first, Baseline(name, model, 4).apply(images, LABELS, 7))


@pytest.mark.parametrize("name", TRANSFORMS)
def test_every_image_is_changed_by_draws_of_its_own_whatever_the_number_of_processes(name, images, model, monkeypatch):
    same = images[:1].expand(6, -1, -1, -1)
    whole = Baseline(name, model, 0).apply(same, LABELS, 1)
    assert len(whole.unique(dim=0)) > 1
    monkeypatch.setattr(distributed, "rank", lambda: 1)
    assert torch.equal(Baseline(name, model, 0).apply(same[3:], LABELS[3:], 1), whole[3:])


def test_pgd_stays_within_its_radius_and_raises_the_loss(images, model):
    adversarial = Baseline("pgd", model, 0).apply(images, LABELS, 0)
    assert (to_unit(adversarial) - to_unit(images)).abs().max() <= PGD.radius + 1e-6
    model.eval()
    before, after = (F.cross_entropy(model(to_unit(batch)), LABELS) for batch in (images, adversarial))
    noise = torch.randint(-8, 9, images.shape, generator=torch.Generator().manual_seed(1))
    random = F.cross_entropy(model(to_unit((images.int() + noise).clamp(0, 255))), LABELS)
    assert after > before + 10 * abs(random - before)


def test_pgd_raises_the_probability_of_the_classes_that_hard_negatives_are_not(images, model):
    labels = torch.full((6,), -1 - 2)
    one, both = (Baseline("pgd", model.eval(), 0, absent).apply(images, labels, 0) for absent in ([], [0]))
    before, with_one, with_both = (model(to_unit(batch)).softmax(1).mean(0) for batch in (images, one, both))
    assert with_one[2] > before[2]
    assert with_both[[0, 2]].sum() > max(with_one[[0, 2]].sum(), before[[0, 2]].sum())
