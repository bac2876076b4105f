import copy
import itertools
import math
import signal

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment.progress import Phases
from augment.service import AugmentationService
from augment.settings import AugmentationSettings
from renderer.errors import InputError
from train.data.sets import Split
from train.networks import WideResNet
from train.runs import checkpoint
from train.runs.run_log import RunLog, read_metrics
from train.settings import TrainSettings
from train.system.device import MixedPrecision
from train.training.loop import Trainer, evaluate
from train.training.recipe import SCHEDULE_FACTORS, freeze

ARCHITECTURE = {"classes": ["fig", "lime", "pear"], "depth": 10, "width": 1, "dropout": 0.0}


def noise(count: int) -> Split:
    draws = torch.Generator().manual_seed(count)
    images = torch.randint(0, 256, (count, 3, 16, 16), dtype=torch.uint8, generator=draws)
    return Split(images, torch.randint(0, 3, (count,), generator=draws))


def make_trainer(folder, network: nn.Module | None = None, precision: str = "float32", **settings) -> Trainer:
    torch.manual_seed(0)
    model = MixedPrecision(network or WideResNet(3, 10, 1, dropout=0.0), precision)
    settings = TrainSettings(**{"epochs": 3, "batch_size": 16, "learning_rate": 0.05, "init_from": "base"} | settings)
    no_renders = AugmentationService(AugmentationSettings(arm="none"), None, torch.zeros(0).long(), 0, Phases())
    return Trainer(settings, model, ARCHITECTURE, no_renders, folder)


def fit_noise(trainer: Trainer) -> list[dict]:
    parts = noise(40), noise(20)
    both = Split(torch.cat([part.images for part in parts]), torch.cat([part.labels for part in parts]))
    trainer.fit(both, torch.arange(60) >= 40, RunLog(trainer.folder))
    return read_metrics(trainer.folder)


def state_of(folder, name: str = checkpoint.LAST) -> dict:
    return checkpoint.load(folder / name)


def test_an_epoch_is_sgd_with_nesterov_momentum_and_decay_at_the_scheduled_rate(tmp_path, monkeypatch):
    """Two steps of a linear network against the update written down."""
    images, labels = torch.rand(2, 4, 3, 2, 2), torch.tensor([[0, 1, 2, 0], [1, 1, 2, 0]])
    as_bytes = (images * 255).round().to(torch.uint8)
    images = as_bytes / 255
    batches = list(zip(as_bytes, labels, labels < 0, strict=True))
    monkeypatch.setattr("train.training.loop.training_batches", lambda *rest: iter(batches))
    monkeypatch.setattr("train.training.loop.evaluate", lambda *rest: {"loss": 1.0, "accuracy": 0.0})
    network = nn.Sequential(nn.Flatten(), nn.Linear(12, 3))
    weight, bias = (parameter.detach().clone().requires_grad_() for parameter in network[1].parameters())
    recipe = {"learning_rate": 0.5, "momentum": 0.9, "weight_decay": 0.1, "schedule": "cosine"}
    trainer = make_trainer(tmp_path, network, epochs=1, batch_size=4, **recipe)
    trainer.fit(Split(as_bytes.flatten(0, 1), labels.flatten()), torch.zeros(8, dtype=torch.bool), RunLog(tmp_path))

    velocities, losses = [torch.zeros_like(weight), torch.zeros_like(bias)], []
    for step in range(2):
        loss = F.cross_entropy(images[step].flatten(1) @ weight.T + bias, labels[step])
        losses.append(loss.item())
        gradients = torch.autograd.grad(loss, (weight, bias))
        with torch.no_grad():
            for parameter, gradient, velocity in zip((weight, bias), gradients, velocities, strict=True):
                gradient = gradient + 0.1 * parameter
                velocity.mul_(0.9).add_(gradient)
                parameter -= 0.5 * SCHEDULE_FACTORS["cosine"](step / 2) * (gradient + 0.9 * velocity)
    torch.testing.assert_close(network[1].weight, weight)
    torch.testing.assert_close(network[1].bias, bias)
    (line,) = read_metrics(tmp_path)
    assert line["train/loss"] == pytest.approx(sum(losses) / 2)
    assert line["train/learning_rate"] == pytest.approx(0.5 * SCHEDULE_FACTORS["cosine"](1 / 2))


def step_on(monkeypatch, folder, **settings) -> tuple[nn.Linear, dict[str, Tensor], tuple[Tensor, Tensor]]:
    """A linear layer after one step on a batch of eight, its weight and bias before, and the batch's gradients."""
    as_bytes, labels = torch.randint(0, 256, (8, 3, 2, 2)).to(torch.uint8), torch.arange(8) % 3
    batch = [(as_bytes, labels, labels < 0)]
    monkeypatch.setattr("train.training.loop.training_batches", lambda *rest: iter(batch))
    monkeypatch.setattr("train.training.loop.evaluate", lambda *rest: {"loss": 1.0, "accuracy": 0.0})
    torch.manual_seed(1)
    network = nn.Sequential(nn.Flatten(), nn.Linear(12, 3))
    before = {name: value.detach().clone().requires_grad_() for name, value in network[1].named_parameters()}
    loss = F.cross_entropy((as_bytes / 255).flatten(1) @ before["weight"].T + before["bias"], labels)
    gradients = torch.autograd.grad(loss, list(before.values()))
    trainer = make_trainer(folder, network, **{"epochs": 1, "batch_size": 8, "schedule": "cosine"} | settings)
    trainer.fit(Split(as_bytes, labels), torch.zeros(8, dtype=torch.bool), RunLog(folder))
    return network[1], before, gradients


def test_adamw_decays_weights_but_no_biases(tmp_path, monkeypatch):
    """Its first step is as long as the rate, by the gradient's signs."""
    settings = {"optimizer": "adamw", "learning_rate": 0.01, "weight_decay": 0.1}
    layer, before, (weight, bias) = step_on(monkeypatch, tmp_path, **settings)
    torch.testing.assert_close(layer.weight, before["weight"] * (1 - 0.001) - 0.01 * weight.sign())
    torch.testing.assert_close(layer.bias, before["bias"] - 0.01 * bias.sign())


@pytest.mark.parametrize("precision, tolerance", [("float32", 1e-6), ("float16", 2e-3)])
def test_a_step_in_parts_follows_the_clipped_gradient_of_the_whole_batch(tmp_path, monkeypatch, precision, tolerance):
    """In float16 the scale of the loss is taken off before."""
    settings = {
        "precision": precision,
        "accumulate": 4,
        "clip_gradient": 0.1,
        "momentum": 0.0,
        "weight_decay": 0.0,
        "learning_rate": 1.0,
    }
    layer, before, gradients = step_on(monkeypatch, tmp_path, **settings)
    length = torch.cat([part.flatten() for part in gradients]).norm()
    assert length > 0.2
    for name, gradient in zip(("weight", "bias"), gradients, strict=True):
        step = before[name] - getattr(layer, name)
        torch.testing.assert_close(step, 0.1 * gradient / length, rtol=0, atol=tolerance)


def test_a_step_in_parts_is_that_of_the_mean_over_the_whole_batch(tmp_path, monkeypatch):
    settings = {"accumulate": 4, "momentum": 0.0, "weight_decay": 0.0, "learning_rate": 1.0}
    layer, before, gradients = step_on(monkeypatch, tmp_path, **settings)
    for name, gradient in zip(("weight", "bias"), gradients, strict=True):
        torch.testing.assert_close(before[name] - getattr(layer, name), gradient, rtol=0, atol=1e-6)


def test_each_epoch_of_a_soup_begins_without_the_momentum_of_the_last(tmp_path, monkeypatch):
    """All epochs have the same images and rates, so that all end at the weights of the first."""
    draws = torch.Generator().manual_seed(1)
    images, labels = torch.randint(0, 256, (3, 8, 3, 2, 2), generator=draws).to(torch.uint8), torch.arange(8) % 3
    batches = [(batch, labels, labels < 0) for batch in images]
    monkeypatch.setattr("train.training.loop.training_batches", lambda *rest: iter(batches))
    monkeypatch.setattr("train.training.loop.evaluate", lambda *rest: {"loss": 1.0, "accuracy": 0.0})
    ends = []
    for epochs in (1, 3):
        torch.manual_seed(1)
        network = nn.Sequential(nn.Flatten(), nn.Linear(12, 3))
        settings = {"epochs": epochs, "batch_size": 8, "soup": True, "momentum": 0.9, "schedule": "one_cycle"}
        trainer = make_trainer(tmp_path / str(epochs), network, **settings)
        (tmp_path / str(epochs)).mkdir()
        split = Split(images.flatten(0, 1), labels.repeat(3))
        trainer.fit(split, torch.zeros(24, dtype=torch.bool), RunLog(trainer.folder))
        ends.append(trainer.model.state_dict())
    torch.testing.assert_close(ends[1], ends[0], rtol=0, atol=0)


def test_several_processes_that_resume_count_a_loss_once_between_them(tmp_path, monkeypatch):
    trainer, saved = make_trainer(tmp_path, epochs=1, batch_size=8), []
    due = iter([False, False, True, False])  # after each of the first four of five steps
    monkeypatch.setattr(trainer, "_saving_is_due", lambda: next(due))
    monkeypatch.setattr(trainer, "_save", lambda: saved.append(copy.deepcopy(trainer.state_dict())))
    fit_noise(trainer)
    whole = saved[0]["under_way"]["sums"]
    assert saved[0]["under_way"]["step"] == 3 and whole[0] > 0
    parts = []
    for rank in range(2):
        monkeypatch.setattr("train.training.loop.distributed.rank", lambda rank=rank: rank)
        resumed = make_trainer(tmp_path, epochs=1, batch_size=8)
        resumed.load_state_dict(saved[0])
        parts.append(resumed.state_dict()["under_way"]["sums"])
    torch.testing.assert_close(sum(parts), whole, rtol=0, atol=0)


def test_a_run_in_float16_is_resumed_with_its_scale(tmp_path):
    trainer = make_trainer(tmp_path, precision="float16", epochs=1)
    trainer.scaler.load_state_dict(trainer.scaler.state_dict() | {"scale": 256.0})
    fit_noise(trainer)
    resumed = make_trainer(tmp_path, precision="float16", epochs=1)
    resumed.resume()
    assert resumed.scaler.get_scale() == trainer.scaler.get_scale() == 256


@pytest.mark.parametrize("stage, trained", [("groups.1", ("groups.2", "norm", "head")), ("all_but_last", ("head",))])
def test_a_frozen_stage_and_all_before_it_stay_as_they_are(tmp_path, stage, trained):
    network = WideResNet(3, 10, 1, dropout=0.0)
    before = {name: value.clone() for name, value in network.named_parameters()}
    freeze(network, stage)
    fit_noise(make_trainer(tmp_path, network, epochs=1))
    changed = [name for name, value in network.named_parameters() if not torch.equal(value, before[name])]
    assert changed and all(name.startswith(trained) for name in changed)
    with pytest.raises(InputError, match=r"train.freeze=group.1 is no part of the network: choose one, such as groups"):
        freeze(network, "group.1")


@pytest.mark.parametrize("training", [True, False])
def test_evaluation_is_the_mean_over_all_images_in_eval_mode_and_leaves_the_mode(monkeypatch, training):
    monkeypatch.setattr("train.training.loop.EVALUATION_BATCH", 7)
    torch.manual_seed(0)
    model = WideResNet(3, 10, 1, dropout=0.5).train(training)
    before = copy.deepcopy(model.state_dict())
    split = noise(40)
    scores = evaluate(model, split)
    assert model.training == training
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    logits = model.eval().double()(split.images / 255)
    assert scores["loss"] == pytest.approx(F.cross_entropy(logits, split.labels).item(), rel=1e-5)
    assert scores["accuracy"] == (logits.argmax(1) == split.labels).double().mean().item()


def test_the_moving_average_follows_the_steps_and_is_validated_and_kept(tmp_path):
    """Weights and batch statistics alike."""
    trainer, states = make_trainer(tmp_path, epochs=2, ema_decay=0.8), []
    trainer.optimizer.register_step_post_hook(lambda *rest: states.append(copy.deepcopy(trainer.model.state_dict())))
    fit_noise(trainer)
    for name in ("network.head.weight", "network.norm.running_mean"):
        average = states[0][name]
        for state in states[1:]:
            average = 0.8 * average + 0.2 * state[name]
        torch.testing.assert_close(trainer.selected.state_dict()[name], average)
        assert not torch.allclose(trainer.model.state_dict()[name], average)
    accuracy = evaluate(trainer.selected, noise(20))["accuracy"]
    assert accuracy == read_metrics(tmp_path)[-1]["validation/accuracy"]


@pytest.mark.parametrize("ema_decay", [0.0, 0.8])
def test_a_soup_is_the_mean_of_epochs_that_each_begin_anew(tmp_path, monkeypatch, ema_decay):
    trainer = make_trainer(tmp_path, soup=True, ema_decay=ema_decay, schedule="one_cycle")
    begun, ends, rates = [], [], []
    regenerate = trainer._regenerate

    def regenerated(*rest):
        begun.append(copy.deepcopy(trainer.model.state_dict()))
        return regenerate(*rest)

    end_epoch = trainer.averages.end_epoch

    def updated():
        averaged = trainer.averages._ema.module if ema_decay else trainer.model
        ends.append(copy.deepcopy(averaged.state_dict()))
        end_epoch()

    monkeypatch.setattr(trainer, "_regenerate", regenerated)
    monkeypatch.setattr(trainer.averages, "end_epoch", updated)
    trainer.optimizer.register_step_post_hook(lambda *rest: rates.append(trainer.optimizer.param_groups[0]["lr"]))
    initial = copy.deepcopy(trainer.model.state_dict())
    fit_noise(trainer)
    for name, value in initial.items():
        assert all(torch.equal(state[name], value) for state in begun)
        mean = torch.stack([state[name].double() for state in ends]).mean(0)
        kept = trainer.selected.state_dict()[name]
        torch.testing.assert_close(kept.double(), mean, rtol=0, atol=1e-6 if kept.is_floating_point() else 1)
    assert rates == 3 * rates[: len(rates) // 3]
    assert state_of(tmp_path, checkpoint.BEST)["epoch"] == 3  # a soup's last, whatever its validation
    assert not torch.equal(ends[0]["network.head.weight"], ends[1]["network.head.weight"])


def test_best_pt_holds_the_first_epoch_of_the_highest_validation_accuracy(tmp_path, monkeypatch):
    trainer, weights, accuracies = make_trainer(tmp_path, epochs=5), [], iter([0.2, 0.6, 0.5, 0.6, 0.1])

    def scripted(model, *images):
        weights.append(copy.deepcopy(model.network.state_dict()))
        return {"loss": 1.0, "accuracy": next(accuracies)}

    monkeypatch.setattr("train.training.loop.evaluate", scripted)
    fit_noise(trainer)
    best, last = state_of(tmp_path, checkpoint.BEST), state_of(tmp_path)
    assert (best["epoch"], best["validation_accuracy"], last["epoch"]) == (2, 0.6, 5)
    for state, expected in [(best, weights[1]), (last, weights[4])]:
        assert all(torch.equal(value, expected[name]) for name, value in state["model"].items())


@pytest.mark.parametrize("diverges", ["in a step, before a signal", "in validation"])
def test_what_is_not_finite_ends_the_run_with_the_last_good_checkpoint(tmp_path, monkeypatch, diverges):
    trainer, steps, losses = make_trainer(tmp_path), itertools.count(1), iter([1.0, math.nan])
    finite = trainer._loss

    def infinite(*batch):
        loss, hits = finite(*batch)
        if next(steps) < 5:  # the second of three steps of the second epoch
            return loss, hits
        signal.raise_signal(signal.SIGTERM)
        return loss * math.inf, hits

    if diverges == "in validation":
        monkeypatch.setattr("train.training.loop.evaluate", lambda *rest: {"loss": next(losses), "accuracy": 0.5})
    else:
        monkeypatch.setattr(trainer, "_loss", infinite)
    with pytest.raises(
        InputError, match=r"_rate=0.05 with .*_decay=.* made the loss or weights NaN .* in epoch 2: set"
    ):
        fit_noise(trainer)
    assert state_of(tmp_path)["epoch"] == 1
    assert [line["epoch"] for line in read_metrics(tmp_path)] == [1]


def test_a_damaged_checkpoint_does_not_take_the_place_of_the_whole_one_before(tmp_path):
    """So a second accident, while the next one is written, is not the end of the run."""
    fit_noise(make_trainer(tmp_path, epochs=2))
    (tmp_path / checkpoint.LAST).write_bytes(b"")
    trainer = make_trainer(tmp_path, epochs=2)
    trainer.resume()
    assert trainer.epoch == 1
    fit_noise(trainer)
    assert [state_of(tmp_path, name)["epoch"] for name in (checkpoint.PREVIOUS, checkpoint.LAST)] == [1, 2]


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
def test_the_checkpoint_of_another_run_is_refused_in_one_sentence(tmp_path, changes, settings):
    fit_noise(make_trainer(tmp_path, epochs=1))
    checkpoint.save(tmp_path / checkpoint.LAST, state_of(tmp_path) | changes)
    with pytest.raises(InputError, match=rf"^the checkpoint in {tmp_path} is not one that this run [^\n]*$"):
        make_trainer(tmp_path, **settings).resume()
