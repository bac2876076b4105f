import copy
import itertools
import math
import signal

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from augment.service import Renders
from augment.utils import Phases
from renderer.errors import InputError
from train.data import Split
from train.device import MixedPrecision
from train.fit.epoch import put_last, rounds_of_epoch, with_room
from train.fit.evaluation import evaluate
from train.fit.recipe import TrainSettings, cosine
from train.fit.resumption import resume
from train.fit.trainer import Trainer
from train.run_folder import checkpoint
from train.run_folder.logs import RunLog, read_metrics
from train.wideresnet import WideResNet

ARCHITECTURE = {"classes": ["fig", "lime", "pear"], "depth": 10, "width": 1, "dropout": 0.0}


class NoRenders:
    """Stands for the augmentation service."""

    class settings:
        arm = "none"
        every = None

    label = None

    def __len__(self):
        return 0

    def regenerate(self, model, number):
        return Renders(torch.zeros(0, 3, 1, 1), torch.zeros(0, dtype=torch.int64), {})

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        assert state == {}


def noise(count: int) -> Split:
    draws = torch.Generator().manual_seed(count)
    images = torch.randint(0, 256, (count, 3, 16, 16), dtype=torch.uint8, generator=draws)
    return Split(images, torch.randint(0, 3, (count,), generator=draws))


def make_trainer(folder, **settings) -> Trainer:
    torch.manual_seed(0)
    model = MixedPrecision(WideResNet(3, 10, 1, dropout=0.0), "float32")
    settings = TrainSettings(**{"epochs": 3, "batch_size": 16, "learning_rate": 0.05} | settings)
    return Trainer(settings, model, ARCHITECTURE, NoRenders(), Phases(), folder, seed=0)


def fit_noise(trainer: Trainer) -> list[dict]:
    trainer.fit(noise(40), noise(20), RunLog(trainer.folder))
    return read_metrics(trainer.folder)


def test_a_ranking_without_look_alikes_is_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"train\.ranking=1\.0 ranks hard negatives: name some in scene\.hard_negatives"
    ):
        make_trainer(tmp_path, ranking=1.0)


@pytest.mark.parametrize(
    "settings, key",
    [
        ({"epochs": 0}, "train.epochs=0"),
        ({"batch_size": 0}, "train.batch_size=0"),
        ({"learning_rate": 0.0}, "train.learning_rate=0.0"),
        ({"learning_rate": math.inf}, "train.learning_rate=inf"),
        ({"learning_rate": math.nan}, "train.learning_rate=nan"),
        ({"ranking": -1.0}, "train.ranking=-1.0"),
        ({"distillation": -1.0}, "train.distillation=-1.0"),
        ({"distillation": 1.0}, r"train\.distillation=1\.0 holds to the network begun with: name one in train\.init"),
        ({"soup": True}, r"train\.soup=True comes back to the network begun with: name one in train\.init_from"),
        ({"momentum": 1.0}, "train.momentum=1.0"),
        ({"momentum": -0.1}, "train.momentum=-0.1"),
        ({"weight_decay": -1.0}, "train.weight_decay=-1.0"),
        ({"weight_decay": math.nan}, "train.weight_decay=nan"),
        ({"weight_decay": 1e300}, "train.weight_decay=1e\\+300 must be"),
        ({"learning_rate": 1e300}, "train.learning_rate=1e\\+300 must be"),
        ({"schedule": "linear"}, "train.schedule=linear: choose one of step, cosine, one_cycle"),
        ({"flips": "vertical"}, "train.flips=vertical: choose one of random, alternating"),
        ({"compile": "maybe"}, "train.compile=maybe: choose one of auto, always, never"),
        ({"label_smoothing": 1.0}, "train.label_smoothing=1.0"),
        ({"averaging": -0.1}, "train.averaging=-0.1"),
        ({"threads": 0}, "train.threads=0"),
        ({"checkpoint_every": 0}, "train.checkpoint_every=0"),
    ],
)
def test_settings_out_of_range_name_their_key(settings, key):
    with pytest.raises(InputError, match=key):
        TrainSettings(**settings)


def test_the_recipe_is_the_papers():
    settings = TrainSettings()
    assert (settings.epochs, settings.batch_size, settings.learning_rate) == (150, 128, 0.125)
    assert (settings.momentum, settings.weight_decay, settings.schedule) == (0.9, 5e-4, "step")


# ---------------------------------------------------------------------------------------- parts


def test_renders_follow_the_data_as_bytes_with_their_labels():
    data = noise(5)
    renders = Renders(torch.rand(2, 3, 16, 16), torch.tensor([1, 1]), {})
    mixed = with_room(data, 2)
    put_last(mixed, renders)
    assert torch.equal(mixed.images[:5], data.images)
    assert (mixed.images[5:] / 255 - renders.images).abs().max() <= 0.5 / 255 + 1e-6
    assert mixed.labels.tolist() == [*data.labels.tolist(), 1, 1]


def test_the_next_epochs_renders_replace_the_last_ones():
    mixed = with_room(noise(5), 2)
    for value in (0.0, 1.0):
        put_last(mixed, Renders(torch.full((2, 3, 16, 16), value), torch.tensor([0, 1]), {}))
    assert len(mixed) == 7
    assert (mixed.images[5:] == 255).all()


def test_without_renders_the_data_stay_as_they_are():
    data = noise(5)
    mixed = with_room(data, 0)
    put_last(mixed, NoRenders().regenerate(None, 0))
    assert torch.equal(mixed.images, data.images)
    assert torch.equal(mixed.labels, data.labels)


def test_without_rounds_an_epoch_is_one_of_all_images_and_renders():
    (only,) = rounds_of_epoch(5, 2, seed=0, epoch=3, images_per_epoch=None, every=None)
    assert (only.number, only.epoch, only.rows.tolist()) == (3, 3, list(range(7)))


def test_rounds_share_out_the_epochs_images_and_each_has_all_renders():
    first, second, third = rounds_of_epoch(100, 7, seed=0, epoch=4, images_per_epoch=50, every=20)
    assert [(each.number, each.epoch) for each in (first, second, third)] == [(12, 4), (13, 4), (14, 4)]
    assert [len(each.rows) for each in (first, second, third)] == [27, 27, 17]
    rows = [each.rows.tolist() for each in (first, second, third)]
    assert all(part == sorted(part) and part[-7:] == list(range(100, 107)) for part in rows)
    shown = [row for part in rows for row in part[:-7]]
    assert len(set(shown)) == 50 and max(shown) < 100


def test_an_epochs_images_are_drawn_anew_and_are_never_more_than_there_are():
    (first,), (second,) = (rounds_of_epoch(100, 0, 0, epoch, 50, None) for epoch in (0, 1))
    assert first.rows.tolist() != second.rows.tolist()
    (everything,) = rounds_of_epoch(100, 0, 0, 0, 5000, None)
    assert everything.rows.tolist() == list(range(100))


@pytest.mark.parametrize("training", [True, False])
def test_evaluation_is_the_mean_over_all_images_in_eval_mode_and_leaves_the_mode(monkeypatch, training):
    monkeypatch.setattr("train.fit.evaluation.BATCH", 7)
    torch.manual_seed(0)
    model = WideResNet(3, 10, 1, dropout=0.5).train(training)
    before = copy.deepcopy(model.state_dict())
    split = noise(40)
    found = evaluate(model, split)
    assert model.training == training
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    logits = model.eval().double()(split.images / 255)
    assert found["loss"] == pytest.approx(F.cross_entropy(logits, split.labels).item(), rel=1e-5)
    assert found["accuracy"] == (logits.argmax(1) == split.labels).double().mean().item()


# ---------------------------------------------------------------------------------------- the loop


def test_an_epoch_is_sgd_with_nesterov_momentum_and_decay_at_the_scheduled_rate(tmp_path, monkeypatch):
    """Two steps of a linear network against the update written down."""
    images, labels = torch.rand(2, 4, 3, 2, 2), torch.tensor([[0, 1, 2, 0], [1, 1, 2, 0]])
    as_bytes = (images * 255).round().to(torch.uint8)
    images = as_bytes / 255
    monkeypatch.setattr(
        "train.fit.trainer.training_batches", lambda *arguments, first: zip(as_bytes, labels, labels < 0, strict=True)
    )
    monkeypatch.setattr("train.fit.trainer.evaluate", lambda *arguments: {"loss": 1.0, "accuracy": 0.0})
    torch.manual_seed(0)
    network = nn.Sequential(nn.Flatten(), nn.Linear(12, 3))
    weight, bias = (parameter.detach().clone().requires_grad_() for parameter in network[1].parameters())
    settings = TrainSettings(
        epochs=1, batch_size=4, learning_rate=0.5, momentum=0.9, weight_decay=0.1, schedule="cosine"
    )
    trainer = Trainer(settings, MixedPrecision(network, "float32"), {}, NoRenders(), Phases(), tmp_path, seed=0)
    trainer.fit(Split(as_bytes.flatten(0, 1), labels.flatten()), noise(1), RunLog(tmp_path))

    velocities = [torch.zeros_like(weight), torch.zeros_like(bias)]
    losses = []
    for step in range(2):
        loss = F.cross_entropy(images[step].flatten(1) @ weight.T + bias, labels[step])
        losses.append(loss.item())
        gradients = torch.autograd.grad(loss, (weight, bias))
        with torch.no_grad():
            for parameter, gradient, velocity in zip((weight, bias), gradients, velocities, strict=True):
                gradient = gradient + 0.1 * parameter
                velocity.mul_(0.9).add_(gradient)
                parameter -= 0.5 * cosine(step / 2) * (gradient + 0.9 * velocity)
    torch.testing.assert_close(network[1].weight, weight)
    torch.testing.assert_close(network[1].bias, bias)
    (line,) = read_metrics(tmp_path)
    assert line["train/loss"] == pytest.approx(sum(losses) / 2, rel=1e-6)
    assert line["train/learning_rate"] == 0.5 * cosine(1 / 2)


def test_best_is_the_first_epoch_of_the_highest_validation_accuracy(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path, epochs=5)
    accuracies, weights = [0.2, 0.6, 0.5, 0.6, 0.1], []

    def scripted(model, split):
        weights.append(copy.deepcopy(model.network.state_dict()))
        return {"loss": 1.0, "accuracy": accuracies[len(weights) - 1]}

    monkeypatch.setattr("train.fit.trainer.evaluate", scripted)
    fit_noise(trainer)
    best, last = (checkpoint.load(tmp_path / name) for name in (checkpoint.BEST, checkpoint.LAST))
    assert (best["epoch"], best["validation_accuracy"]) == (2, 0.6)
    assert (last["epoch"], last["epoch_best"], last["validation_accuracy_best"]) == (5, 2, 0.6)
    for state, expected in [(best, weights[1]), (last, weights[4])]:
        assert all(torch.equal(value, expected[name]) for name, value in state["model"].items())


def test_a_resumed_run_remembers_the_best_epoch(tmp_path, monkeypatch):
    for epochs, accuracy in [(1, 0.6), (2, 0.5)]:
        monkeypatch.setattr(
            "train.fit.trainer.evaluate", lambda *arguments, value=accuracy: {"loss": 1.0, "accuracy": value}
        )
        trainer = make_trainer(tmp_path, epochs=epochs)
        if epochs > 1:
            resume(trainer)
        fit_noise(trainer)
    assert checkpoint.load(tmp_path / checkpoint.BEST)["epoch"] == 1
    last = checkpoint.load(tmp_path / checkpoint.LAST)
    assert (last["epoch"], last["epoch_best"], last["validation_accuracy_best"]) == (2, 1, 0.6)


def test_a_damaged_checkpoint_does_not_take_the_place_of_the_whole_one_before(tmp_path):
    """So a second accident, while the next one is written, is not the end of the run."""
    fit_noise(make_trainer(tmp_path, epochs=2))
    (tmp_path / checkpoint.LAST).write_bytes(b"")
    trainer = make_trainer(tmp_path, epochs=2)
    resume(trainer)
    assert trainer.epoch == 1
    fit_noise(trainer)
    assert [checkpoint.load(tmp_path / name)["epoch"] for name in (checkpoint.PREVIOUS, checkpoint.LAST)] == [1, 2]


def test_epochs_train_in_training_mode_however_the_network_is_found(tmp_path):
    trainer = make_trainer(tmp_path, epochs=2)
    trainer.learner.model.eval()
    fit_noise(trainer)
    assert trainer.learner.model.network.norm.num_batches_tracked == 2 * math.ceil(40 / 16)


def test_a_loss_that_is_not_finite_ends_the_run_with_the_last_good_checkpoint(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path)
    losses = iter([1.0, math.nan])
    monkeypatch.setattr("train.fit.trainer.evaluate", lambda *arguments: {"loss": next(losses), "accuracy": 0.5})
    with pytest.raises(
        InputError,
        match=r"_rate=0.05 with .*_decay=.* made the loss NaN or infinite in epoch 2",
    ):
        fit_noise(trainer)
    assert checkpoint.load(tmp_path / checkpoint.LAST)["epoch"] == 1
    assert [line["epoch"] for line in read_metrics(tmp_path)] == [1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"history": "x"}, "lines of history"),
        ({"history": []}, "lines of history"),
        ({"epoch": -1}, "after epoch -1"),
        ({"epoch": "x"}, "after epoch 'x'"),
        ({"optimizer": {}}, "param_groups"),
        ({"optimizer": [1]}, "holds what no run wrote"),
        ({"precision": "int3"}, "precision 'int3'"),
        ({"random_state": "x"}, "no random state"),
        ({"under_way": {"step": 1}}, "holds what no run wrote"),
        ({"model": []}, "other things than weights"),
        ({"architecture": {**ARCHITECTURE, "version": 99}}, "later version"),
    ],
)
def test_a_forged_checkpoint_with_a_right_hash_is_refused_in_one_sentence(tmp_path, changes, message):
    fit_noise(make_trainer(tmp_path, epochs=1))
    checkpoint.save(tmp_path / checkpoint.LAST, checkpoint.load(tmp_path / checkpoint.LAST) | changes)
    with pytest.raises(InputError, match=message) as caught:
        resume(make_trainer(tmp_path))
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_weights_of_nan_are_not_gone_on_with(tmp_path):
    fit_noise(make_trainer(tmp_path, epochs=1))
    state = checkpoint.load(tmp_path / checkpoint.LAST)
    state["model"]["stem.weight"].fill_(math.nan)
    checkpoint.save(tmp_path / checkpoint.LAST, state)
    with pytest.raises(InputError, match=r"last.pt has NaN or infinity in stem.weight: use another one"):
        resume(make_trainer(tmp_path))


@pytest.mark.parametrize("ended", ["by itself", "by a signal"])
def test_weights_that_are_not_finite_are_named_and_the_last_good_checkpoint_stays(tmp_path, monkeypatch, ended):
    trainer, steps = make_trainer(tmp_path), itertools.count(1)
    whole = trainer.learner._training_pass

    def spoilt(*batch):
        loss, hits = whole(*batch)
        if next(steps) < 5:  # the second of three steps of the second epoch
            return loss, hits
        if ended == "by a signal":
            signal.raise_signal(signal.SIGTERM)
        return loss * math.inf, hits

    monkeypatch.setattr(trainer.learner, "_training_pass", spoilt)
    with pytest.raises(InputError, match=r"made the weight stem.weight NaN or infinite in epoch 2: set lower"):
        fit_noise(trainer)
    assert checkpoint.load(tmp_path / checkpoint.LAST)["epoch"] == 1


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory"), MemoryError(), RuntimeError("can't allocate memory: you ")]
)
def test_where_memory_runs_out_in_training_the_setting_is_named(tmp_path, monkeypatch, error):
    trainer = make_trainer(tmp_path)

    def too_large(*batch):
        raise error

    monkeypatch.setattr(trainer.learner, "_training_pass", too_large)
    with pytest.raises(InputError, match=r"train.batch_size=16 needs more memory than there is: set a lower one"):
        fit_noise(trainer)


def test_training_learns_what_can_be_told_apart(tmp_path):
    data = noise(64)
    data.images[torch.arange(64), data.labels] //= 4
    make_trainer(tmp_path, epochs=5, schedule="one_cycle").fit(data, data, RunLog(tmp_path))
    assert read_metrics(tmp_path)[-1]["validation/accuracy"] > 0.95


def test_resuming_with_another_architecture_is_an_error(tmp_path):
    fit_noise(make_trainer(tmp_path, epochs=1))
    other = make_trainer(tmp_path)
    other.architecture = {**ARCHITECTURE, "classes": ["fig", "lime", "plum"]}
    with pytest.raises(
        InputError, match=r"checkpoint in .* is from another architecture or other classes: resume with"
    ):
        resume(other)


def test_every_epoch_has_its_line_before_its_checkpoint(tmp_path, monkeypatch):
    """A crash between the two then loses nothing: the epoch comes again."""
    lines_at_save = []
    save = checkpoint.save

    def recorded(path, state, *previous):
        lines_at_save.append((path.name, state["epoch"], [line["epoch"] for line in read_metrics(tmp_path)]))
        save(path, state, *previous)

    monkeypatch.setattr(checkpoint, "save", recorded)
    fit_noise(make_trainer(tmp_path, epochs=2))
    last = [entry[1:] for entry in lines_at_save if entry[0] == checkpoint.LAST]
    assert last == [(1, [1]), (2, [1, 2])]


def test_the_average_follows_the_steps_and_is_what_is_validated_and_kept(tmp_path):
    trainer, weights = make_trainer(tmp_path, epochs=2, averaging=0.8), []
    trainer.learner.optimizer.register_step_post_hook(
        lambda *arguments: weights.append(trainer.learner.model.network.head.weight.detach().clone())
    )
    fit_noise(trainer)
    average = weights[0]
    for weight in weights[1:]:
        average = 0.8 * average + 0.2 * weight
    torch.testing.assert_close(trainer.learner.selected.network.head.weight, average)
    assert not torch.allclose(trainer.learner.model.network.head.weight, average)
    validated = evaluate(trainer.learner.selected, noise(20))
    assert validated["accuracy"] == read_metrics(tmp_path)[-1]["validation/accuracy"]


@pytest.mark.parametrize("soup", [False, True])
def test_a_resumed_average_goes_on_bit_for_bit(tmp_path, soup):
    settings = {"averaging": 0.8, "init_from": "base", "soup": soup}
    fit_noise(make_trainer(tmp_path, **settings))
    whole = checkpoint.load(tmp_path / checkpoint.LAST)
    (tmp_path / checkpoint.LAST).unlink()  # the epoch before the last is left
    resumed = make_trainer(tmp_path, **settings)
    resume(resumed)
    assert resumed.epoch == 2
    fit_noise(resumed)
    again = checkpoint.load(tmp_path / checkpoint.LAST)
    kept = "soup" if soup else "average"
    found, expected = again[kept]["module"], whole[kept]["module"]
    assert found.keys() == expected.keys()
    assert all(torch.equal(value, expected[name]) for name, value in found.items())


@pytest.mark.parametrize("key, value", [("averaging", 0.8), ("soup", True)])
def test_resuming_with_an_average_that_the_run_has_not_is_an_error(tmp_path, key, value):
    fit_noise(make_trainer(tmp_path, epochs=1))
    with pytest.raises(InputError, match=f"the checkpoint in {tmp_path} holds what no run wrote"):
        resume(make_trainer(tmp_path, init_from="base", **{key: value}))


@pytest.mark.parametrize("averaging", [0.0, 0.8])
def test_a_soup_is_the_mean_of_epochs_that_each_begin_anew(tmp_path, averaging):
    trainer = make_trainer(tmp_path, epochs=3, init_from="base", soup=True, averaging=averaging, schedule="one_cycle")
    learner, begun, ends, rates = trainer.learner, [], [], []
    begin, end = learner.begin_epoch, learner.end_epoch
    learner.begin_epoch = lambda: (begin(), begun.append(copy.deepcopy(learner.model.state_dict())))
    learner.end_epoch = lambda: (ends.append(copy.deepcopy(learner._trained.state_dict())), end())
    learner.optimizer.register_step_post_hook(lambda *arguments: rates.append(learner.learning_rate))
    whole = copy.deepcopy(learner.model.state_dict())
    fit_noise(trainer)
    for name, value in whole.items():
        assert all(torch.equal(each[name], value) for each in begun)
        mean = torch.stack([each[name].double() for each in ends]).mean(0)
        kept = learner.selected.state_dict()[name]
        torch.testing.assert_close(kept.double(), mean, rtol=0, atol=1e-6 if kept.is_floating_point() else 1)
    assert rates == 3 * rates[: len(rates) // 3]
    assert not torch.equal(ends[0]["network.head.weight"], ends[1]["network.head.weight"])


def test_of_a_soup_the_last_is_kept_whatever_its_validation(tmp_path, monkeypatch):
    accuracies = iter([0.9, 0.5])
    monkeypatch.setattr("train.fit.trainer.evaluate", lambda *arguments: {"loss": 1.0, "accuracy": next(accuracies)})
    trainer = make_trainer(tmp_path, epochs=2, init_from="base", soup=True)
    fit_noise(trainer)
    kept = checkpoint.load(tmp_path / checkpoint.BEST)
    assert kept["epoch"] == 2
    expected = trainer.learner.selected.network.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in kept["model"].items())
