import errno
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from augment.losses import complementary_label
from renderer.errors import InputError
from train import checkpoint, loop
from train.errors import one_sentence
from train.networks import load_run
from train.processes import Interrupted
from train.run import load_data, prepare, run
from train.run_folder import read_metrics
from train.settings import ExperimentSettings


def train(settings: ExperimentSettings, folder: Path) -> dict[str, float]:
    return run(settings, load_data(settings), folder)


def assert_same_weights(first: Path, second: Path) -> None:
    expected = torch.load(second, weights_only=True)["model"]
    for name, value in torch.load(first, weights_only=True)["model"].items():
        assert torch.equal(value, expected[name]), name


def metrics_without_times(folder: Path) -> list[dict]:
    return [{k: v for k, v in line.items() if not k.startswith("seconds/")} for line in read_metrics(folder)]


def assert_same_run(folder: Path, expected: Path) -> None:
    """In the last and the selected weights and in all metrics, bit for bit."""
    for name in (checkpoint.LAST, checkpoint.BEST):
        assert_same_weights(folder / name, expected / name)
    assert metrics_without_times(folder) == metrics_without_times(expected)


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def act_at(monkeypatch, round_number: int, step: int, act: Callable[[], None]) -> None:
    """Call `act` while a step of a round is taken, counted from 1."""
    training_batches = loop.training_batches

    def acting(split, batch_size, seed, now, *rest):
        for count, batch in enumerate(training_batches(split, batch_size, seed, now, *rest), 1):
            if (now.number, count) == (round_number, step):
                act()
            yield batch

    monkeypatch.setattr(loop, "training_batches", acting)


def train_with_signal(settings, folder: Path, round_number: int, step: int, number: signal.Signals) -> None:
    with pytest.MonkeyPatch.context() as patch:
        act_at(patch, round_number, step, lambda: signal.raise_signal(number))
        train(settings, folder)


@pytest.fixture
def regenerated(monkeypatch) -> list:
    """The renders of each round, as they are handed to training."""
    renders, put_last = [], loop.put_last
    monkeypatch.setattr(loop, "put_last", lambda split, new: renders.append(new) or put_last(split, new))
    return renders


# ---------------------------------------------------------------------------------------- resuming


@pytest.mark.parametrize("number, step", [(signal.SIGTERM, 2), (signal.SIGINT, 4)])
def test_a_signal_ends_the_run_after_its_step_and_resuming_ends_as_if_it_had_not_come(
    tiny, photos, finished, tmp_path, number, step
):
    """Bit for bit, in the middle of an epoch and at its end (of 4 steps); with two more signals on the way, with lights
    that continue from epoch to epoch, and dropout."""
    assert all(line["augment/light_change"] > 0 for line in read_metrics(finished)[:-1])
    handlers = [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)]
    overrides = (f"evaluate.photos={photos}", "train.resume=true")
    for epoch, at in [(0, 1), (1, step), (2, 1)]:
        with pytest.raises(Interrupted) as stopped:
            train_with_signal(tiny(*overrides), tmp_path, epoch, at, number)
        assert (stopped.value.code, stopped.value.signal) == (128 + number, number.name)
        assert [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)] == handlers
        state = checkpoint.load(tmp_path / checkpoint.LAST)
        under_way = state["under_way"]
        assert (state["epoch"], under_way and under_way["step"]) == ((epoch, at) if at < 4 else (epoch + 1, None))
        assert [line["epoch"] for line in read_metrics(tmp_path)] == list(range(1, state["epoch"] + 1))
    torch.manual_seed(17)
    train(tiny(*overrides), tmp_path)
    assert_same_run(tmp_path, finished)
    for name in ("epoch_002.png", "epoch_003.png"):
        assert (tmp_path / "renders" / name).read_bytes() == (finished / "renders" / name).read_bytes()


@pytest.mark.parametrize("listens", [True, False])
def test_a_batch_systems_signal_writes_a_checkpoint_before_its_own_handler_acts(tiny, tmp_path, listens):
    epochs = []

    def requeue(number, frame):
        epochs.append(checkpoint.load(tmp_path / checkpoint.LAST)["epoch"])
        raise SystemExit(-1)

    before = signal.signal(signal.SIGUSR2, requeue if listens else signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as stopped:
            train_with_signal(tiny("augment=none"), tmp_path, 1, 2, signal.SIGUSR2)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert (stopped.value.code, epochs) == ((-1, [1]) if listens else (128 + signal.SIGUSR2, []))
    assert checkpoint.load(tmp_path / checkpoint.LAST)["under_way"]["step"] == 2


def test_a_second_signal_acts_at_once(tiny, tmp_path, monkeypatch):
    act_at(monkeypatch, 0, 1, lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):
        train(tiny("augment=none"), tmp_path)
    assert not checkpoint.exists(tmp_path)


def test_checkpoints_of_every_other_epoch_hold_the_same_and_the_last_one(tiny, photos, finished, tmp_path, monkeypatch):
    saved, save = [], checkpoint.save
    monkeypatch.setattr(checkpoint, "save", lambda path, *rest: saved.append(path.name) or save(path, *rest))
    train(tiny("train.checkpoint_every=2", f"evaluate.photos={photos}"), tmp_path)
    assert saved.count(checkpoint.LAST) == 2  # after epochs 2 and 3
    assert_same_run(tmp_path, finished)


def test_resuming_a_finished_run_trains_no_further_and_scores_the_same(tiny, tmp_path):
    train(tiny("augment=none", "train.epochs=1"), tmp_path)
    before, last = metrics_without_times(tmp_path), (tmp_path / checkpoint.LAST).read_bytes()
    train(tiny("augment=none", "train.epochs=1", "train.resume=true"), tmp_path)
    assert metrics_without_times(tmp_path) == before
    assert (tmp_path / checkpoint.LAST).read_bytes() == last


@pytest.mark.parametrize(
    "overrides, message",
    [
        ([], r"holds a run already: set train.resume=true to go on, or choose another"),
        (["train.resume=true", "seed=8"], "was trained with seed=7, not 8"),
    ],
)
def test_a_run_is_neither_written_over_nor_resumed_with_other_settings(tiny, finished, overrides, message):
    before, settings = files_in(finished), tiny(*overrides)
    with pytest.raises(InputError, match=message):
        prepare(settings, load_data(settings), finished)
    assert files_in(finished) == before


# ---------------------------------------------------------------------------------------- full disks


@pytest.mark.parametrize(
    "writer, done",
    [
        pytest.param("tensorboard.compat.tensorflow_stub.io.gfile.LocalFileSystem.append", 0, id="TensorBoard"),
        pytest.param("train.run_folder.RunLog.scalars", 0, id="metrics"),
        pytest.param("train.run_folder.os.fsync", 0, id="checkpoint"),
        pytest.param("train.run.evaluate_photographs", 1, id="photographs"),
    ],
)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # TensorBoard's, raised here, too
def test_a_full_disk_is_one_error_wherever_it_is_met_and_the_run_can_go_on(tiny, photos, tmp_path, writer, done):
    settings = tiny("train.epochs=1", "train.resume=true", f"evaluate.photos={photos}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        with pytest.raises(OSError) as full:
            train(settings, tmp_path)
    assert one_sentence(full.value).endswith(" cannot be written (No space left on device): make room and start again")
    assert checkpoint.exists(tmp_path) == bool(done)
    train(settings, tmp_path)
    assert len(read_metrics(tmp_path)) == 2


# ---------------------------------------------------------------------------------------- rounds and starts


def test_a_signal_between_two_rounds_or_within_one_leads_to_the_same_end(tiny, finished, tmp_path):
    """Bit for bit: 40 of 54 images an epoch, in rounds of 16, 16 and 8, each with 4 renders (2, 2 and 1 steps); held to
    the predictions of the network begun with."""
    rounds = ("augment.every=16", "train.images_per_epoch=40", "train.resume=true")
    settings = tiny(*rounds, f"train.init_from={finished}", "train.distillation=2")
    train(settings, tmp_path / "whole")
    folder = tmp_path / "stopped"
    for number, at in [(1, 2), (4, 1), (6, 2)]:
        with pytest.raises(Interrupted):
            train_with_signal(settings, folder, number, at, signal.SIGTERM)
        assert checkpoint.load(folder / checkpoint.LAST)["under_way"]["step"] == {1: 4, 4: 3, 6: 2}[number]
    train(settings, folder)
    assert_same_weights(folder / checkpoint.LAST, tmp_path / "whole" / checkpoint.LAST)
    assert metrics_without_times(folder) == metrics_without_times(tmp_path / "whole")


def test_every_round_is_trained_on_renders_made_for_its_own_weights(tiny, tmp_path, regenerated):
    train(tiny("train.epochs=1", "augment=random", "augment.every=20"), tmp_path)
    assert len(regenerated) == 3  # 54 images
    assert len(torch.cat([renders.images for renders in regenerated]).unique(dim=0)) == 3 * 4
    (line,) = [line for line in read_metrics(tmp_path) if "epoch" in line]
    assert line["augment/loss"] == pytest.approx(sum(renders.diagnostics["loss"] for renders in regenerated) / 3)


# ---------------------------------------------------------------------------------------- arms


def test_no_examples_and_no_augmentation_train_the_same_weights(tiny, tmp_path):
    """So the arms differ in their renders alone: nothing else draws from the training's random streams."""
    arms = {"none": ["augment=none"], "empty": ["augment.examples=0"], "renders": []}
    for name, overrides in arms.items():
        train(tiny("train.epochs=2", *overrides), tmp_path / name)
    assert_same_weights(tmp_path / "empty" / checkpoint.LAST, tmp_path / "none" / checkpoint.LAST)
    with pytest.raises(AssertionError):
        assert_same_weights(tmp_path / "renders" / checkpoint.LAST, tmp_path / "none" / checkpoint.LAST)
    assert not (tmp_path / "none" / "renders").exists()


APPLE, ORANGE, PEAR = range(3)
ANOTHER_CLASS = [
    "experiment=best", "train.init_from=null", "train.soup=false", "label=pear", "scene.meshes=['solid:pear']",
    "scene.hard_negatives=[{mesh: 'solid:apple', label: apple}]", "augment.examples=null", "scene.views=2",
    "augment.every=30", "augment.warm_start=false",
]  # fmt: skip


@pytest.mark.parametrize(
    "overrides, rounds, expected",
    [
        pytest.param(
            [
                "scene.meshes=[{mesh: 'solid:pear', label: pear}, 'solid:orange']",
                "scene.hard_negatives=['solid:fruit', {mesh: 'solid:apple:2', label: apple}]",
                "augment.examples=16",
            ],
            1,
            [PEAR, ORANGE, complementary_label(ORANGE), APPLE],
            id="several",
        ),
        pytest.param(ANOTHER_CLASS, 2, [PEAR, APPLE], id="another class"),
    ],
)
def test_meshes_and_hard_negatives_are_rendered_with_their_own_labels(
    tiny, tmp_path, regenerated, overrides, rounds, expected
):
    """A hard negative that names no class has the complementary label. Of each mesh, 2 views × 2 backgrounds."""
    train(tiny("train.epochs=1", *overrides), tmp_path)
    assert len(regenerated) == rounds
    for renders in regenerated:
        assert renders.labels.tolist() == [label for label in expected for _ in range(4)]
    assert len(torch.cat([renders.images for renders in regenerated]).unique(dim=0)) == 4 * len(expected) * rounds
    assert np.isfinite(read_metrics(tmp_path)[0]["train/loss"])


# ---------------------------------------------------------------------------------------- what a run leaves


def test_a_run_folder_holds_configuration_metrics_networks_renders_and_scores(finished, tiny_npz, photos):
    config = OmegaConf.load(finished / "config.yaml")
    assert OmegaConf.missing_keys(config) == set()
    assert (config.data.path, config.evaluate.photos, config.train.epochs) == (str(tiny_npz), str(photos), 3)
    assert set(config.versions) == {"python", "torch", "torchvision", "numpy"}
    assert config.hardware == {"device": "cpu", "precision": "float32"}
    last, best = (torch.load(finished / name, weights_only=True) for name in ("last.pt", "best.pt"))
    assert (last["epoch"], last["seed"], last["arm"], last["precision"]) == (3, 7, "adversarial", "float32")
    assert last["model"].keys() == best["model"].keys() and "optimizer" not in best
    assert sorted(path.name for path in (finished / "renders").glob("*.png")) == [f"epoch_00{n}.png" for n in (1, 2, 3)]
    assert {path.name for path in (finished / "photographs").iterdir()} == {
        "predictions.csv", "summary.json", "contact_sheet.png", "roc.csv", "roc.png"
    }  # fmt: skip
    assert not list(finished.glob("*.tmp")) and list(finished.glob("events.out.tfevents.*"))


def test_metrics_have_each_epochs_losses_attack_and_seconds_and_the_final_scores(finished):
    *epochs, scores = read_metrics(finished)
    assert [line["epoch"] for line in epochs] == [1, 2, 3]
    for line in epochs:
        assert {
            "train/loss", "train/accuracy", "train/learning_rate", "validation/loss", "validation/accuracy",
            "augment/attack_success_before", "augment/attack_success", "augment/steps", "augment/loss_before",
            "augment/loss", "augment/light_change",
            "seconds/attack", "seconds/training", "seconds/evaluation", "seconds/input_output",
        } <= line.keys()  # fmt: skip
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    metrics = {name: summary[name] for name in ("recall", "top5", "false_positive_rate", "auc")}
    metrics |= {f"recall_at/{rate}": metric for rate, metric in summary["recall_at"].items()}
    assert scores == {name: scores[name] for name in ("test/accuracy", "test/accuracy_last", "test/epoch")} | {
        f"photographs/{name}": metric["value"] for name, metric in metrics.items()
    }


def test_several_folders_of_photographs_are_scored_in_sub_folders_of_their_names(tiny, photos, tmp_path):
    named = f"evaluate.photos={{lab: {photos}, wild-1: {photos / 'orange'}}}"
    scores = train(tiny("augment=none", "train.epochs=1", named), tmp_path / "run")
    assert scores == read_metrics(tmp_path / "run")[-1]
    for name in ("lab", "wild-1"):
        summary = json.loads((tmp_path / "run" / name / "summary.json").read_text())
        assert scores[f"{name}/recall"] == summary["recall"]["value"]
    assert "lab/auc" in scores and "wild-1/auc" not in scores  # a folder of oranges alone
    assert not (tmp_path / "run" / "photographs").exists()


def test_the_selected_network_is_the_best_on_validation_and_the_one_that_is_scored(finished, tiny):
    *epochs, scores = read_metrics(finished)
    accuracies = [line["validation/accuracy"] for line in epochs]
    best = checkpoint.load(finished / checkpoint.BEST)
    assert best["epoch"] == scores["test/epoch"] == accuracies.index(max(accuracies)) + 1
    network = load_run(finished)
    test = load_data(tiny()).test
    logits = network(test.images / 255)
    assert scores["test/accuracy"] == pytest.approx((logits.argmax(1) == test.labels).double().mean().item())
    assert network.classes == ("apple", "orange", "pear") and network.size == 16


def test_the_test_set_is_looked_at_once_after_the_last_epoch(tiny, tmp_path):
    data, looks = load_data(tiny()), []

    class GuardedData:
        classes, train, size = data.classes, data.train, data.size

        @property
        def test(self):
            looks.append(checkpoint.load(tmp_path / checkpoint.LAST)["epoch"])
            return data.test

    run(tiny(), GuardedData(), tmp_path)
    assert looks == [3]


# ---------------------------------------------------------------------------------------- cached operators


def test_a_run_whose_operators_are_on_disk_rasterizes_nothing_and_trains_the_same(tiny, tmp_path, rasterized):
    settings = tiny(f"renderer.cache={tmp_path}/cache", "train.epochs=1")
    for name, calls in [("first", [1, 1]), ("second", [1, 1])]:
        train(settings, tmp_path / name)
        assert rasterized == calls
    assert_same_weights(tmp_path / "second" / checkpoint.LAST, tmp_path / "first" / checkpoint.LAST)
