import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Categorical, kl_divergence

from augment import distributed
from augment.network import keep_text_vectors
from renderer.errors import InputError
from renderer.image import to_unit
from train.commands.harden import _trainable_copy
from train.device import MixedPrecision
from train.networks import WideResNet
from train.settings import TRANSFORMS, TrainSettings
from train.training import recipe
from train.training.augmentations import PGD, Augmentation

LABELS = torch.tensor([0, 1, 2, 3, 0, 1])


@pytest.fixture
def images() -> Tensor:
    draws = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (6, 3, 16, 16), dtype=torch.uint8, generator=draws)


@pytest.fixture
def model() -> nn.Module:
    torch.manual_seed(0)
    return WideResNet(4, 10, 1, 0.3)


@pytest.fixture
def teacher() -> nn.Module:
    torch.manual_seed(1)
    return WideResNet(4, 10, 1, dropout=0.0).eval().requires_grad_(False)


def augmentation(name: str, model: nn.Module, seed: int, absent: Sequence[int] = ()):
    return Augmentation(TrainSettings(augmentation=name), model, seed=seed, absent=absent)


def divergence_of(targets: Tensor, logits: Tensor) -> Tensor:
    """Sum the divergences of images, from the softmax of logits to that of targets."""
    return kl_divergence(Categorical(logits=targets), Categorical(logits=logits)).sum()


PROGRESS = np.linspace(0, 1, 1001)


@pytest.mark.parametrize(
    "schedule, expected",
    [
        # The half-angle formula makes this half a period of a cosine.
        ("cosine", np.cos(math.pi / 2 * PROGRESS) ** 2),
        ("one_cycle", np.interp(PROGRESS, [0, 0.2, 1], [0.1, 1, 0])),
        ("step", 0.2 ** np.digitize(PROGRESS, [0.3, 0.6, 0.8])),
    ],
)
def test_a_schedule_is_its_closed_form(schedule, expected):
    settings = TrainSettings(schedule=schedule, learning_rate=0.5)
    rates = [recipe.learning_rate(settings, progress) for progress in PROGRESS]
    np.testing.assert_allclose(rates, 0.5 * expected, atol=1e-12)


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_the_loss_is_the_smoothed_cross_entropy(model, images, smoothing):
    settings = TrainSettings(label_smoothing=smoothing)
    is_render = torch.arange(6) < 2
    cross_entropy = recipe.TrainingLoss(model.eval(), settings, (), None)
    loss, hits = cross_entropy.compute(images, LABELS, is_render)
    logits = model(images / 255)
    log_probabilities = logits.log_softmax(1)
    of_labels = -log_probabilities[torch.arange(6), LABELS].mean()
    of_all = -log_probabilities.mean()
    torch.testing.assert_close(loss, (1 - smoothing) * of_labels + smoothing * of_all)
    assert hits == (logits.argmax(1) == LABELS).sum()


@pytest.mark.parametrize("positive_classes", [(), (1,), (1, 3)])
def test_distillation_adds_the_divergence_from_a_teacher(model, teacher, images, positive_classes):
    """All classes of data count, and on renders those that are not positive_classes."""
    is_render = torch.arange(6) < 2
    settings = TrainSettings(distillation_weight=4.0)
    batch = (images, LABELS, is_render)
    plain = recipe.TrainingLoss(model.eval(), TrainSettings(), positive_classes, None)
    alone, _ = plain.compute(*batch)
    loss, _ = recipe.TrainingLoss(model, settings, positive_classes, teacher).compute(*batch)

    logits = model(images / 255)
    targets = teacher(images / 255)
    divergence = divergence_of(targets[2:], logits[2:])
    if positive_classes:
        others = [label for label in range(4) if label not in positive_classes]
        divergence = divergence + divergence_of(targets[:2, others], logits[:2, others])
    torch.testing.assert_close(loss, alone + 4 * divergence / 6)


def test_unlabeled_images_have_the_teachers_answers_but_no_cross_entropy(model, teacher, images):
    """The ranking loss and the hits use the answers as labels."""
    is_render = torch.arange(6) < 2
    settings = TrainSettings(distillation_weight=4.0, ranking_weight=2.0)
    answers = torch.where(is_render, LABELS, teacher(images / 255).argmax(1))
    positive_classes = (int(answers[-1]),)
    with_labels = recipe.TrainingLoss(model.eval(), settings, positive_classes, teacher)
    labeled, hits = with_labels.compute(images, answers, is_render)
    logits = model(images / 255)
    cross_entropy = F.cross_entropy(logits[2:], answers[2:], reduction="sum") / 6
    without_labels = recipe.TrainingLoss(model, settings, positive_classes, teacher, labeled=False)
    unlabeled = without_labels.compute(images, LABELS * is_render, is_render)
    torch.testing.assert_close(unlabeled, (labeled - cross_entropy, hits))


@pytest.mark.parametrize("positive_classes", [(1,), (1, 3)])
def test_the_mean_ranking_of_positive_classes_is_added_by_weight(model, images, positive_classes):
    # Two images show anything but class 0.
    labels = LABELS - 1
    batch = (images, labels, labels == 0)
    plain = recipe.TrainingLoss(model.eval(), TrainSettings(), positive_classes, None)
    alone, _ = plain.compute(*batch)
    settings = TrainSettings(ranking_weight=4.0)
    both, _ = recipe.TrainingLoss(model, settings, positive_classes, None).compute(*batch)
    logits = model(images / 255)
    rankings = [recipe.ranking_loss(logits, labels, label) for label in positive_classes]
    torch.testing.assert_close(both, alone + 4 * torch.stack(rankings).mean())


def test_a_hard_negative_shows_none_of_several_positive_classes(model, images):
    """The last image has the complementary label of class 1. Class 3 is positive_classes, too."""
    labels = torch.tensor([1, 3, 0, 2, 1, -2])
    loss_of_both = recipe.TrainingLoss(model.eval(), TrainSettings(), (1, 3), None)
    loss, hits = loss_of_both.compute(images, labels, torch.arange(6) > 1)
    logits = model(images / 255)
    probability_of_others = logits[5].softmax(0)[[0, 2]].sum()
    entropy = F.cross_entropy(logits[:5], labels[:5], reduction="sum")
    torch.testing.assert_close(loss, (entropy - probability_of_others.log()) / 6)
    predicted = logits.argmax(1)
    last_is_right = int(predicted[5]) not in (1, 3)
    assert hits == (predicted[:5] == labels[:5]).sum() + last_is_right


@pytest.mark.parametrize("name", ["none", *TRANSFORMS, "pgd"])
def test_an_augmentation_is_a_function_of_seed_and_step_and_keeps_the_model(name, images, model):
    before = torch.get_rng_state()
    first = augmentation(name, model, 3).apply(images, LABELS, 7)
    assert torch.equal(torch.get_rng_state(), before)
    assert model.training
    assert all(parameter.grad is None for parameter in model.parameters())
    assert first.dtype == torch.uint8
    assert first.shape == images.shape
    assert torch.equal(augmentation(name, model, 3).apply(images, LABELS, 7), first)
    if name == "none":
        assert torch.equal(first, images)
        return
    assert not torch.equal(augmentation(name, model, 3).apply(images, LABELS, 8), first)
    assert not torch.equal(augmentation(name, model, 4).apply(images, LABELS, 7), first)


@pytest.mark.parametrize("name", TRANSFORMS)
def test_an_image_has_the_same_draws_in_any_number_of_processes(name, images, model, monkeypatch):
    same = images[:1].expand(6, -1, -1, -1)
    whole = augmentation(name, model, 0).apply(same, LABELS, 1)
    assert len(whole.unique(dim=0)) > 1
    monkeypatch.setattr(distributed, "rank", lambda: 1)
    second_half = augmentation(name, model, 0).apply(same[3:], LABELS[3:], 1)
    assert torch.equal(second_half, whole[3:])


def test_half_of_a_batch_is_relit_and_half_in_low_light(images, model):
    names = ("relight+low_light", "relight", "low_light")
    both, relit, dark = (augmentation(name, model, 3).apply(images, LABELS, 7) for name in names)
    assert torch.equal(both[::2], relit[::2])
    assert torch.equal(both[1::2], dark[1::2])


def test_pgd_stays_within_its_radius_and_raises_the_loss(images, model):
    adversarial = augmentation("pgd", model, 0).apply(images, LABELS, 0)
    changes = to_unit(adversarial) - to_unit(images)
    assert changes.abs().max() <= PGD.radius + 1e-6
    noise = torch.randint(-8, 9, images.shape, generator=torch.Generator().manual_seed(1))
    noisy = (images.int() + noise).clamp(0, 255)
    model.eval()
    losses = [F.cross_entropy(model(batch / 255), LABELS) for batch in (images, adversarial, noisy)]
    before, attacked, random = losses
    assert attacked > before + 10 * abs(random - before)


def test_pgd_raises_the_probability_of_the_classes_that_hard_negatives_are_not(images, model):
    not_class_2 = torch.full((6,), -1 - 2)
    model.eval()
    attacked = augmentation("pgd", model, 0).apply(images, not_class_2, 0)
    attacked_with_0 = augmentation("pgd", model, 0, [0]).apply(images, not_class_2, 0)
    batches = (images, attacked, attacked_with_0)
    before, with_2, with_both = (model(batch / 255).softmax(1).mean(0) for batch in batches)
    assert with_2[2] > before[2]
    assert with_both[[0, 2]].sum() > max(with_2[[0, 2]].sum(), before[[0, 2]].sum())


def learning_layers(network: nn.Module) -> set[str]:
    recipe.freeze(network, "all_but_last", size=2)
    names = [name for name, value in network.named_parameters() if value.requires_grad]
    return {name.rpartition(".")[0] for name in names}


class HeadFirst(nn.Module):
    def __init__(self):
        super().__init__()
        self.head = nn.Linear(5, 2)
        self.body = nn.Linear(12, 5)

    def forward(self, images: Tensor) -> Tensor:
        return self.head(self.body(images.flatten(1)))


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_the_matrix_that_is_called_last_learns_wherever_it_stands():
    network = HeadFirst()
    assert learning_layers(network) == {"head"}
    images = torch.rand(2, 3, 2, 2)
    features = network.body(images.flatten(1))
    expected = features.square().sum(1).mean().sqrt().item()
    assert recipe.feature_norm(network, images) == pytest.approx(expected, rel=1e-6)
    for last in (nn.BatchNorm1d(4), nn.PReLU()):
        assert learning_layers(nn.Sequential(nn.Flatten(), nn.Linear(12, 4), last)) == {"1"}
    script = torch.jit.script(nn.Sequential(nn.Flatten(), nn.Linear(12, 4), nn.Linear(4, 2)))
    assert learning_layers(script) == {"2"}


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize(
    "wrap",
    [
        nn.utils.parametrizations.weight_norm,
        nn.utils.parametrizations.spectral_norm,
        nn.utils.weight_norm,
    ],
)
def test_a_parametrized_last_layer_learns_as_a_whole_and_can_be_copied(wrap):
    network = nn.Sequential(nn.Flatten(), nn.Linear(12, 4), wrap(nn.Linear(4, 2))).eval()
    recipe.freeze(network, "all_but_last", size=2)
    learns = {name: parameter.requires_grad for name, parameter in network.named_parameters()}
    assert learns == {name: name.startswith("2.") for name in learns}
    images = torch.rand(2, 3, 2, 2)
    assert recipe.feature_norm(network, images) > 0
    assert torch.equal(deepcopy(network)(images), network(images))


def test_a_weight_that_the_last_layer_shares_learns_and_changes_the_features():
    network = nn.Sequential(nn.Flatten(), nn.Linear(12, 12), nn.Linear(12, 12))
    network[2].weight = network[1].weight
    recipe.freeze(network, "all_but_last", size=2)
    learning = [name for name, value in network.named_parameters() if value.requires_grad]
    assert learning == ["1.weight", "2.bias"]
    pupil = MixedPrecision(network, "float32")
    teacher = deepcopy(pupil).eval()
    assert recipe.share_layers(TrainSettings(**LAST_LAYER_ONLY), pupil, teacher, 2) is teacher


def test_a_network_that_cannot_learn_in_its_last_layer_is_refused():
    vectors = nn.Sequential(nn.Flatten(), nn.LayerNorm(12))
    recipe.freeze(vectors, "all_but_last", size=2)
    detached = HeadFirst()
    detached.head.register_forward_hook(lambda module, inputs, output: output.detach())
    settings = TrainSettings(freeze="all_but_last", feature_norm=5.0)
    for network in (vectors, detached):
        with pytest.raises(InputError, match="has no gradient"):
            recipe.scale_learning_rate(settings, network, torch.full((1, 3, 2, 2), 0.5))


def test_a_stage_after_which_no_layer_learns_is_refused():
    network = nn.Sequential(nn.Flatten(), nn.Linear(12, 4), nn.Linear(4, 3))
    with pytest.raises(InputError, match=r"stage=2 leaves no layer that learns: .* such as 1$"):
        recipe.freeze(network, "2", size=2)


class Scaled(nn.Module):
    """Classifier whose logits do not depend on the factor of its features."""

    def __init__(self, factor: float):
        super().__init__()
        self.factor = factor
        self.head = nn.Linear(12, 4, bias=False)
        weights = torch.randn(4, 12, generator=torch.Generator().manual_seed(1))
        self.head.weight.data = weights / factor

    def forward(self, images: Tensor) -> Tensor:
        return self.head(self.factor * F.adaptive_avg_pool2d(images, 2).flatten(1))


def test_the_scale_of_the_features_does_not_change_the_training_of_the_last_layer(images):
    units = to_unit(images)
    settings = TrainSettings(
        freeze="all_but_last", feature_norm=5.0, learning_rate=3.0, weight_decay=0.0
    )
    logits = []
    for network in (Scaled(1.0), Scaled(30.0)):
        rate = recipe.scale_learning_rate(settings, network, units)
        optimizer = recipe.build_optimizer(network, replace(settings, learning_rate=rate))
        for _ in range(5):
            optimizer.zero_grad()
            F.cross_entropy(network(units), LABELS).backward()
            nn.utils.clip_grad_norm_(network.parameters(), 0.001)
            optimizer.step()
        logits.append(network(units).detach())
    torch.testing.assert_close(logits[1], logits[0], rtol=1e-3, atol=1e-3)
    assert not torch.allclose(logits[0], Scaled(1.0)(units), atol=0.1)


@pytest.mark.parametrize("brightness", [1e-9, math.nan, math.inf])
def test_features_whose_norm_is_about_zero_or_not_finite_have_no_learning_rate(images, brightness):
    settings = TrainSettings(freeze="all_but_last", feature_norm=5.0)
    features = torch.full_like(to_unit(images), brightness)
    with pytest.raises(InputError, match="feature_norm"):
        recipe.scale_learning_rate(settings, Scaled(9.0), features)


TINY = 4
LAST_LAYER_ONLY = {"freeze": "all_but_last", "eval_mode": True}


class Counted(nn.Module):
    calls = 0

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return images.flatten(1).tanh()


def pair(*layers_after: nn.Module) -> tuple[MixedPrecision, MixedPrecision]:
    torch.manual_seed(0)
    layers = [Counted(), nn.Linear(3 * TINY**2, 8), nn.Dropout(), nn.Linear(8, 5)]
    pupil = MixedPrecision(nn.Sequential(*layers, *layers_after), "float32")
    return pupil, deepcopy(pupil).eval()


@pytest.mark.parametrize("wrap", [lambda layer: layer, nn.utils.parametrizations.weight_norm])
def test_the_logits_are_those_of_the_teacher_after_the_last_layer_has_learned(wrap):
    pupil, teacher = pair()
    for network in (pupil, teacher):
        wrap(network.network[3])
    pupil.network[:3].requires_grad_(False)
    shared = recipe.share_layers(TrainSettings(**LAST_LAYER_ONLY), pupil, teacher, TINY)
    assert isinstance(shared, recipe.SharedTeacher)
    pupil.eval()
    images = torch.rand(6, 3, TINY, TINY)
    expected = teacher(images)
    calls = teacher.network[0].calls
    with torch.no_grad():
        pupil.network[3].bias += torch.arange(5)
    assert not torch.equal(pupil(images), expected)
    assert torch.equal(shared(images), expected)
    assert teacher.network[0].calls == calls


@pytest.mark.parametrize(
    ("changes", "layers_after"),
    [
        ({"freeze": None}, ()),
        ({"freeze": "1"}, ()),
        ({"eval_mode": False}, ()),
        ({}, (nn.Softmax(1),)),
    ],
)
def test_a_teacher_with_other_features_or_more_layers_computes_its_own(changes, layers_after):
    pupil, teacher = pair(*layers_after)
    settings = TrainSettings(**LAST_LAYER_ONLY | changes)
    assert recipe.share_layers(settings, pupil, teacher, TINY) is teacher


class ByText(nn.Module):
    """Zero-shot network: logits are the scaled cosines of an image and a text for each class."""

    def __init__(self, kind: str):
        super().__init__()
        self.encoder, self.projection = nn.Conv2d(3, 6, 3), nn.Linear(6, 8)
        text = F.normalize(nn.Linear(4, 8)(torch.rand(3, 4)), dim=1)
        if kind == "buffer":
            self.register_buffer("text", text.detach())
        else:
            self.text = nn.Parameter(text.detach()) if kind == "parameter" else text
        self.scale = nn.Parameter(torch.tensor(3.0))

    def forward(self, images: Tensor) -> Tensor:
        features = self.projection(self.encoder(images).mean((2, 3)))
        return self.scale.exp() * F.normalize(features, dim=1) @ self.text.T


@pytest.mark.parametrize("kind", ["buffer", "parameter", "result of an encoder"])
def test_the_last_layer_of_a_zero_shot_network_is_a_copy_of_its_text_vectors(kind):
    network = ByText(kind).eval()
    images = torch.rand(2, 3, 8, 8)
    copy = _trainable_copy(network)
    keep_text_vectors(copy, 3)
    recipe.freeze(copy, "all_but_last", 8)
    trained = [name for name, weight in copy.named_parameters() if weight.requires_grad]
    assert trained == ["text"]
    assert torch.equal(copy(images), network(images))
    # The gradient of a logit with respect to its text is the scale times a vector of length 1.
    assert recipe.feature_norm(copy, images) == pytest.approx(np.exp(3), rel=1e-5)
    with torch.no_grad():
        copy.text.add_(1)
    assert not torch.equal(copy.text, network.text)
