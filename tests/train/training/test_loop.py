import copy
import math
import signal
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment.augmentation_settings import AugmentationSettings
from augment.progress import Phases
from augment.service import AugmentationService
from renderer import errors
from renderer.errors import InputError
from train import checkpoints, run_folder
from train.data.sets import Split
from train.device import MixedPrecision
from train.networks import WideResNet
from train.run_folder import read_metrics
from train.settings import TrainSettings
from train.training import loop
from train.training.loop import Trainer, activation_bytes, evaluate
from train.training.recipe import freeze
from train.training.run_log import RunLog

SHAPE = {"depth": 10, "width": 1, "dropout": 0.0}
ARCHITECTURE = {"classes": ["fig", "lime", "pear"], "size": 16, **SHAPE}
# Noise for training and validation. With 16 images a batch, an epoch has three steps.
TRAINED = 40
VALIDATED = 20
STEPS_PER_EPOCH = 3

State = dict[str, Tensor]


def noise(count: int) -> Split:
    draws = torch.Generator().manual_seed(count)
    images = torch.randint(0, 256, (count, 3, 16, 16), dtype=torch.uint8, generator=draws)
    labels = torch.randint(0, 3, (count,), generator=draws)
    return Split(images, labels)


def single_colors(count: int) -> Split:
    draws = torch.Generator().manual_seed(count)
    colors = torch.randint(0, 256, (count, 3, 1, 1), dtype=torch.uint8, generator=draws)
    return Split(colors.expand(-1, -1, 8, 8), torch.arange(count) % 3)


def color_network() -> nn.Sequential:
    torch.manual_seed(1)
    return nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 3))


def make_trainer(
    folder, network=None, precision="float32", has_initial=True, labeled=True, **settings
):
    torch.manual_seed(0)
    network = network or WideResNet(3, 10, 1, dropout=0.0)
    model = MixedPrecision(network, precision)
    defaults = {"epochs": 3, "batch_size": 16, "learning_rate": 0.05}
    recipe = TrainSettings(**defaults | settings)
    no_labels = torch.zeros(0, dtype=torch.int64)
    none = AugmentationSettings(mode="none")
    no_renders = AugmentationService(none, None, no_labels, 0, Phases())
    return Trainer(recipe, model, ARCHITECTURE, no_renders, folder, labeled, has_initial)


def fit(trainer: Trainer, trained: Split, validated: Split) -> list[dict]:
    trainer.fit(trained, validated, RunLog(trainer.folder))
    return read_metrics(trainer.folder)


def fit_noise(trainer: Trainer) -> list[dict]:
    return fit(trainer, noise(TRAINED), noise(VALIDATED))


def load(folder: Path, name: str = run_folder.LAST) -> dict:
    return checkpoints.load(folder / name)


def states_after_steps(trainer: Trainer) -> list[State]:
    states: list[State] = []

    def record(*_) -> None:
        states.append(copy.deepcopy(trainer.model.network.state_dict()))

    trainer.optimizer.register_step_post_hook(record)
    return states


def test_a_step_is_sgd_with_nesterov_momentum_and_decay_at_the_scheduled_rate(tmp_path):
    """Each of two epochs is one step on all images, whose order does not matter."""
    images = single_colors(12)
    network = color_network()
    linear = network[2]
    parameters = [value.detach().clone().requires_grad_() for value in linear.parameters()]
    recipe = {"learning_rate": 0.5, "momentum": 0.9, "weight_decay": 0.1, "schedule": "cosine"}
    trainer = make_trainer(tmp_path, network, epochs=2, batch_size=12, **recipe)
    lines = fit(trainer, images, single_colors(3))

    colors = images.images[:, :, 0, 0] / 255
    velocities = [torch.zeros_like(value) for value in parameters]
    for step in range(2):
        logits = F.linear(colors, *parameters)
        loss = F.cross_entropy(logits, images.labels)
        accuracy = (logits.argmax(1) == images.labels).double().mean()
        rate = 0.5 * (1 + math.cos(math.pi * step / 2)) / 2
        gradients = torch.autograd.grad(loss, parameters)
        with torch.no_grad():
            for value, gradient, velocity in zip(parameters, gradients, velocities, strict=True):
                gradient = gradient + 0.1 * value
                velocity.mul_(0.9).add_(gradient)
                value -= rate * (gradient + 0.9 * velocity)
        assert lines[step]["train/loss"] == pytest.approx(loss.item())
        assert lines[step]["train/accuracy"] == pytest.approx(accuracy.item())
        assert lines[step]["train/learning_rate"] == pytest.approx(rate)
    torch.testing.assert_close(linear.weight, parameters[0])
    torch.testing.assert_close(linear.bias, parameters[1])


def test_a_process_without_validation_images_shows_the_network_none(monkeypatch):
    monkeypatch.setattr(loop.distributed, "world_size", lambda: 2)
    monkeypatch.setattr(loop.distributed, "rank", lambda: 1)
    monkeypatch.setattr(loop, "all_reduce_sum", lambda own: own + torch.tensor([0.5, 1.0]))
    network = color_network()
    network.register_forward_pre_hook(lambda *_: pytest.fail("an empty batch"))
    assert loop.evaluate(network, single_colors(1)) == {"loss": 0.5, "accuracy": 1.0}


@pytest.mark.parametrize(("settings", "expected"), [({}, 40), ({"images_per_epoch": 9}, 9)])
def test_a_batch_larger_than_the_data_is_the_data(tmp_path, settings, expected):
    trainer = make_trainer(tmp_path, color_network(), epochs=1, batch_size=960_000, **settings)
    steps = states_after_steps(trainer)
    fit_noise(trainer)
    assert (trainer.settings.batch_size, len(steps)) == (expected, 1)


def test_a_step_keeps_the_inputs_of_each_layer_that_learns():
    """A layer keeps its input for the gradient of its weights: 3 × 8 × 8 and 5 × 8 × 8 floats."""
    network = nn.Sequential(nn.Conv2d(3, 5, 1), nn.Conv2d(5, 2, 1))
    assert activation_bytes(network, 8) == 4 * 64 * (3 + 5)
    network[0].requires_grad_(False)
    assert activation_bytes(network, 8) == 4 * 64 * 5
    assert network.training


def test_a_batch_whose_activations_need_more_than_the_free_memory_is_refused(tmp_path, monkeypatch):
    (tmp_path / "meminfo").write_text("MemAvailable: 100 kB\n")
    monkeypatch.setattr(errors, "MEMORY", tmp_path / "meminfo")
    with pytest.raises(InputError, match=r"batch_size=16 need .* free"):
        fit_noise(make_trainer(tmp_path))


def one_step(folder: Path, **settings) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return weights and biases before and after a step on eight images, and their gradient."""
    images = single_colors(8)
    network = color_network()
    linear = network[2]
    before = [value.detach().clone().requires_grad_() for value in linear.parameters()]
    colors = images.images[:, :, 0, 0] / 255
    loss = F.cross_entropy(F.linear(colors, *before), images.labels)
    gradients = torch.autograd.grad(loss, before)
    once = {"epochs": 1, "batch_size": 8, "schedule": "cosine"}
    fit(make_trainer(folder, network, **once | settings), images, single_colors(3))
    return list(zip(before, linear.parameters(), gradients, strict=True))


def test_adamw_decays_weights_but_no_biases(tmp_path):
    """The first step of Adam is as long as the rate, by the signs of the gradient."""
    weight, bias = one_step(tmp_path, optimizer="adamw", learning_rate=0.01, weight_decay=0.1)
    for (before, after, gradient), decay in ((weight, 0.001), (bias, 0)):
        torch.testing.assert_close(after, before * (1 - decay) - 0.01 * gradient.sign())


PLAIN_SGD = {"momentum": 0.0, "weight_decay": 0.0, "learning_rate": 1.0}


@pytest.mark.parametrize(
    "precision, clip, tolerance",
    [("float32", None, 1e-6), ("float32", 0.1, 1e-6), ("float16", 0.1, 2e-3)],
)
def test_a_step_follows_the_clipped_mean_gradient_of_a_batch(tmp_path, precision, clip, tolerance):
    """In float16 the gradient is clipped after the scale of the loss is divided out."""
    parts = one_step(tmp_path, precision=precision, clip_gradient=clip, **PLAIN_SGD)
    length = torch.cat([gradient.flatten() for *_, gradient in parts]).norm()
    assert length > 0.2
    scale = 1 if clip is None else clip / length
    for before, after, gradient in parts:
        torch.testing.assert_close(before - after, scale * gradient, rtol=0, atol=tolerance)


def test_each_epoch_of_a_soup_begins_without_the_momentum_of_the_last(tmp_path):
    """All batches are alike, so that every epoch ends with the weights of the first."""
    one = single_colors(1)
    images = Split(one.images.expand(24, -1, -1, -1), one.labels.expand(24).clone())
    ends = []
    for epochs in (1, 3):
        folder = tmp_path / str(epochs)
        folder.mkdir()
        recipe = {"batch_size": 8, "soup": True, "momentum": 0.9, "schedule": "one_cycle"}
        trainer = make_trainer(folder, color_network(), epochs=epochs, **recipe)
        fit(trainer, images, single_colors(3))
        ends.append(trainer.model.state_dict())
    torch.testing.assert_close(ends[1], ends[0], rtol=0, atol=0)


def test_a_run_in_float16_is_resumed_with_its_scale(tmp_path):
    trainer = make_trainer(tmp_path, precision="float16", epochs=1)
    trainer.scaler.load_state_dict(trainer.scaler.state_dict() | {"scale": 256.0})
    fit_noise(trainer)
    resumed = make_trainer(tmp_path, precision="float16", epochs=1)
    resumed.resume()
    assert resumed.scaler.get_scale() == 256
    assert trainer.scaler.get_scale() == 256


@pytest.mark.parametrize(
    "stage, trained", [("groups.1", ("groups.2", "norm", "head")), ("all_but_last", ("head",))]
)
def test_a_frozen_stage_and_all_before_it_stay_as_they_are(tmp_path, stage, trained):
    network = WideResNet(3, 10, 1, dropout=0.0)
    # The statistics of batch normalization are in the state dict, too.
    before = copy.deepcopy(network.state_dict())
    freeze(network, stage, size=8)
    fit_noise(make_trainer(tmp_path, network, epochs=1))
    after = network.state_dict()
    changed = {name for name in before if not torch.equal(after[name], before[name])}
    assert changed == {name for name in before if name.startswith(trained)}


@pytest.mark.parametrize("training", [True, False])
def test_evaluation_is_the_mean_of_images_in_eval_mode_and_leaves_the_mode(monkeypatch, training):
    monkeypatch.setattr(loop, "EVALUATION_BATCH", 7)
    torch.manual_seed(0)
    model = WideResNet(3, 10, 1, dropout=0.5).train(training)
    before = copy.deepcopy(model.state_dict())
    split = noise(40)
    scores = evaluate(model, split)
    assert model.training == training
    torch.testing.assert_close(model.state_dict(), before, rtol=0, atol=0)
    logits = model.eval().double()(split.images / 255)
    loss = F.cross_entropy(logits, split.labels).item()
    accuracy = (logits.argmax(1) == split.labels).double().mean().item()
    assert scores["loss"] == pytest.approx(loss, rel=1e-5)
    assert scores["accuracy"] == accuracy


def moving_average(states: list[State], name: str) -> Tensor:
    """Average an entry of the states with decay 0.8, from the first state on."""
    average = states[0][name].double()
    for state in states[1:]:
        average = 0.8 * average + 0.2 * state[name].double()
    return average


def test_the_moving_average_follows_the_steps_and_is_validated_and_kept(tmp_path):
    trainer = make_trainer(tmp_path, epochs=2, ema_decay=0.8)
    states = states_after_steps(trainer)
    lines = fit_noise(trainer)
    selected = trainer.selected.network.state_dict()
    for name in ("head.weight", "norm.running_mean"):
        expected = moving_average(states, name).float()
        torch.testing.assert_close(selected[name], expected)
        assert not torch.allclose(states[-1][name], expected)
    accuracy = evaluate(trainer.selected, noise(VALIDATED))["accuracy"]
    assert accuracy == lines[-1]["validation/accuracy"]


@pytest.mark.parametrize("ema_decay", [0.0, 0.8])
def test_a_soup_is_the_mean_of_the_ends_of_its_epochs(tmp_path, ema_decay):
    """With a moving average, it is the mean of the moving averages of the epochs."""
    trainer = make_trainer(tmp_path, soup=True, ema_decay=ema_decay, schedule="one_cycle")
    states = states_after_steps(trainer)
    fit_noise(trainer)
    epochs = [states[first : first + STEPS_PER_EPOCH] for first in range(0, len(states), 3)]
    assert len(epochs) == 3
    for name, kept in trainer.selected.network.state_dict().items():
        if not kept.is_floating_point():
            continue
        ends = [epoch[-1][name].double() for epoch in epochs]
        if ema_decay:
            ends = [moving_average(epoch, name) for epoch in epochs]
        expected = torch.stack(ends).mean(0)
        torch.testing.assert_close(kept.double(), expected, rtol=0, atol=1e-6)
    assert not torch.equal(states[2]["head.weight"], states[5]["head.weight"])
    # The last network of a soup is kept, whatever its validation.
    assert load(tmp_path, run_folder.BEST)["epoch"] == 3


def test_best_pt_holds_the_first_epoch_of_the_highest_validation_accuracy(tmp_path, monkeypatch):
    accuracies = iter([0.2, 0.6, 0.5, 0.6, 0.1])
    monkeypatch.setattr(loop, "evaluate", lambda *_: {"loss": 1.0, "accuracy": next(accuracies)})
    trainer = make_trainer(tmp_path, color_network(), epochs=5, batch_size=12)
    states = states_after_steps(trainer)
    fit(trainer, single_colors(12), single_colors(3))
    best = load(tmp_path, run_folder.BEST)
    last = load(tmp_path)
    assert best["epoch"] == 2
    assert best["validation_accuracy"] == 0.6
    assert last["epoch"] == 5
    torch.testing.assert_close(best["model"], states[1], rtol=0, atol=0)
    torch.testing.assert_close(last["model"], states[4], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("in_training", "first_pass"),
    [pytest.param(True, 5, id="in a step, before a signal"), pytest.param(False, 2)],
)
def test_a_run_that_diverges_ends_with_the_last_good_checkpoint(tmp_path, in_training, first_pass):
    """In the second epoch of three, the logits are infinite from one pass on."""

    def diverge(module: nn.Module, _: object, logits: Tensor) -> Tensor:
        module.passes = getattr(module, "passes", 0) + (module.training == in_training)
        if module.passes < first_pass or module.training != in_training:
            return logits
        if in_training and module.passes == first_pass:
            signal.raise_signal(signal.SIGTERM)
        return logits * math.inf

    trainer = make_trainer(tmp_path, has_initial=False)
    trainer.model.network.register_forward_hook(diverge)
    with pytest.raises(InputError, match=r"\blearning_rate=0.05\b.*\bweight_decay\b.*epoch 2\b"):
        fit_noise(trainer)
    assert load(tmp_path)["epoch"] == 1
    assert [line["epoch"] for line in read_metrics(tmp_path)] == [1]


def test_a_damaged_checkpoint_does_not_take_the_place_of_the_whole_one_before(tmp_path):
    """A second accident, while the next one is written, is then not the end of the run."""
    fit_noise(make_trainer(tmp_path, epochs=2))
    (tmp_path / run_folder.LAST).write_bytes(b"")
    trainer = make_trainer(tmp_path, epochs=2)
    trainer.resume()
    assert trainer.epoch == 1
    fit_noise(trainer)
    assert load(tmp_path, run_folder.PREVIOUS)["epoch"] == 1
    assert load(tmp_path, run_folder.LAST)["epoch"] == 2


@pytest.mark.parametrize(
    "changes, settings",
    [
        ({}, {"ema_decay": 0.8}),
        ({}, {"soup": True}),
        ({"optimizer": [1]}, {}),
        ({"under_way": {"step": 1}}, {}),
        ({"architecture": {**ARCHITECTURE, "classes": ["fig", "lime", "plum"]}}, {}),
    ],
    ids=str,
)
def test_the_checkpoint_of_another_run_is_refused(tmp_path, changes, settings):
    trainer = make_trainer(tmp_path, color_network(), epochs=1, batch_size=12)
    fit(trainer, single_colors(12), single_colors(3))
    checkpoints.save(tmp_path / run_folder.LAST, load(tmp_path) | changes)
    with pytest.raises(InputError) as refused:
        make_trainer(tmp_path, color_network(), **settings).resume()
    sentence = str(refused.value)
    assert str(tmp_path) in sentence
    assert "\n" not in sentence


def test_the_last_layer_learns_from_augmented_photographs_alike_if_the_others_are_frozen(tmp_path):
    """The network has no other layer with weights, so that freezing them changes nothing."""
    settings = {"eval_mode": True, "consistency_weight": 1.0, "augmentation": "low_light"}
    weights = []
    for frozen in (None, "all_but_last"):
        options = settings | {"labeled": False, "freeze": frozen}
        trainer = make_trainer(tmp_path, color_network(), **options)
        before = copy.deepcopy(trainer.model.state_dict())
        fit(trainer, single_colors(TRAINED), single_colors(VALIDATED))
        weights.append(trainer.model.state_dict())
        assert not torch.equal(weights[-1]["network.2.weight"], before["network.2.weight"])
    torch.testing.assert_close(*weights, rtol=0, atol=0)


def test_an_attack_on_the_labels_of_photographs_without_labels_is_refused(tmp_path):
    options = {"labeled": False, "consistency_weight": 1.0, "augmentation": "pgd"}
    with pytest.raises(InputError, match="pgd"):
        make_trainer(tmp_path, color_network(), **options)
