import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import OmegaConf

from augment.labels import complementary_label
from augment.variation import VariationSettings
from renderer.errors import InputError
from train.command_line.configuration import composed, read_settings
from train.data import DataSet
from train.experiment import load_data, prepare, run
from train.fit import trainer
from train.interruption import Interrupted
from train.run_folder import checkpoint
from train.run_folder.classifier import load_run
from train.run_folder.continuation import require_same_settings
from train.run_folder.logs import read_metrics
from train.settings import ExperimentSettings


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["model"]


def assert_same_weights(first: Path, second: Path) -> None:
    expected = weights(second)
    for name, value in weights(first).items():
        assert torch.equal(value, expected[name]), name


def metrics_without_times(folder: Path) -> list[dict]:
    return [{k: v for k, v in line.items() if not k.startswith("seconds/")} for line in read_metrics(folder)]


def interrupt_in_the_second_epoch(monkeypatch) -> None:
    """After its first batch."""
    training_batches = trainer.training_batches

    def interrupted(images, labels, batch_size, seed, now, *rest, **more):
        for number, batch in enumerate(training_batches(images, labels, batch_size, seed, now, *rest, **more)):
            if (now.epoch, number) == (1, 1):
                raise KeyboardInterrupt
            yield batch

    monkeypatch.setattr(trainer, "training_batches", interrupted)


def interrupt_while_the_second_checkpoint_is_written(monkeypatch) -> None:
    save = torch.save

    def interrupted(state, file):
        if "optimizer" in state and state["epoch"] == 2:
            file.write(b"the beginning of a checkpoint")
            raise KeyboardInterrupt
        save(state, file)

    monkeypatch.setattr(checkpoint.torch, "save", interrupted)


# ---------------------------------------------------------------------------------------- resuming


@pytest.mark.parametrize("interrupt", [interrupt_in_the_second_epoch, interrupt_while_the_second_checkpoint_is_written])
def test_an_interrupted_and_resumed_run_ends_as_an_uninterrupted_one(
    tiny, photos, finished, tmp_path, monkeypatch, interrupt
):
    """Bit for bit, with adversaries whose lights continue from epoch to epoch, and dropout."""
    settings = OmegaConf.load(finished / "config.yaml")
    assert (settings.augment.arm, settings.augment.warm_start, settings.model.dropout) == (
        "adversarial",
        "continue",
        0.3,
    )
    assert all(line["augment/light_change"] > 0 for line in read_metrics(finished)[:-1])
    with monkeypatch.context() as patch:
        interrupt(patch)
        with pytest.raises(KeyboardInterrupt):
            run(tiny(), load_data(tiny()), tmp_path)
    assert checkpoint.load(tmp_path / checkpoint.LAST)["epoch"] == 1
    torch.manual_seed(17)
    resumed = tiny("train.resume=true", f"evaluate.photos={photos}")
    run(resumed, load_data(resumed), tmp_path)
    for name in (checkpoint.LAST, checkpoint.BEST):
        assert_same_weights(tmp_path / name, finished / name)
    assert metrics_without_times(tmp_path) == metrics_without_times(finished)
    for name in ("epoch_002.png", "epoch_003.png"):
        assert (tmp_path / "renders" / name).read_bytes() == (finished / "renders" / name).read_bytes()


def run_with_signal(config, folder: Path, monkeypatch, round_number: int, step: int, number: signal.Signals) -> None:
    """The signal comes while the step is taken."""
    training_batches = trainer.training_batches

    def signalled(images, labels, batch_size, seed, now, *rest, **more):
        for count, batch in enumerate(training_batches(images, labels, batch_size, seed, now, *rest, **more), 1):
            if (now.number, count) == (round_number, step):
                signal.raise_signal(number)
            yield batch

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "training_batches", signalled)
        run(config, load_data(config), folder)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("step", [2, 4])
def test_a_signal_ends_the_run_after_its_step_and_resuming_ends_as_if_it_had_not_come(
    tiny, photos, finished, tmp_path, monkeypatch, number, step
):
    """Bit for bit, in the middle of an epoch and at its end (of 4 steps); with two more signals on the way."""
    handlers = [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)]
    overrides = (f"evaluate.photos={photos}", "train.resume=true")
    for epoch, at in [(0, 1), (1, step), (2, 1)]:
        with pytest.raises(Interrupted) as stopped:
            run_with_signal(tiny(*overrides), tmp_path, monkeypatch, epoch, at, number)
        assert (stopped.value.code, stopped.value.signal) == (128 + number, number.name)
        assert [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)] == handlers
        state = checkpoint.load(tmp_path / checkpoint.LAST)
        under_way = state["under_way"]
        assert (state["epoch"], under_way and under_way["step"]) == ((epoch, at) if at < 4 else (epoch + 1, None))
        assert [line["epoch"] for line in read_metrics(tmp_path)] == list(range(1, state["epoch"] + 1))
    torch.manual_seed(17)
    run(tiny(*overrides), load_data(tiny()), tmp_path)
    for name in (checkpoint.LAST, checkpoint.BEST):
        assert_same_weights(tmp_path / name, finished / name)
    assert metrics_without_times(tmp_path) == metrics_without_times(finished)


@pytest.mark.parametrize("listens", [True, False])
def test_a_batch_systems_signal_writes_a_checkpoint_before_its_own_handler_acts(tiny, tmp_path, monkeypatch, listens):
    epochs = []

    def requeue(number, frame):
        epochs.append(checkpoint.load(tmp_path / checkpoint.LAST)["epoch"])
        raise SystemExit(-1)

    before = signal.signal(signal.SIGUSR2, requeue if listens else signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as stopped:
            run_with_signal(tiny("augment=none"), tmp_path, monkeypatch, 1, 2, signal.SIGUSR2)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert (stopped.value.code, epochs) == ((-1, [1]) if listens else (128 + signal.SIGUSR2, []))
    assert checkpoint.load(tmp_path / checkpoint.LAST)["under_way"]["step"] == 2


def test_a_signal_at_an_epochs_end_leaves_the_epoch_before_to_fall_back_to(tiny, tmp_path, monkeypatch):
    with pytest.raises(Interrupted):
        run_with_signal(tiny("augment=none"), tmp_path, monkeypatch, 1, 4, signal.SIGTERM)
    epochs = [checkpoint.load(tmp_path / name)["epoch"] for name in (checkpoint.LAST, checkpoint.PREVIOUS)]
    assert epochs == [2, 1]


def test_a_signal_that_is_ignored_stays_so(tiny, tmp_path, monkeypatch):
    """As nohup ignores SIGHUP, a shell ignores SIGINT for what it starts in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        run_with_signal(tiny("augment=none"), tmp_path, monkeypatch, 1, 2, signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert "test/accuracy" in read_metrics(tmp_path)[-1]


def test_a_second_signal_acts_at_once(tiny, tmp_path, monkeypatch):
    def impatient(images, labels, *rest, **more):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        yield images[:1], labels[:1]

    monkeypatch.setattr(trainer, "training_batches", impatient)
    with pytest.raises(KeyboardInterrupt):
        run(tiny("augment=none"), load_data(tiny()), tmp_path)
    assert not checkpoint.exists(tmp_path)


def test_a_damaged_newest_checkpoint_is_told_and_the_one_before_leads_to_the_same_end(
    tiny, photos, finished, tmp_path, caplog
):
    shutil.copytree(finished, tmp_path / "run")
    newest = tmp_path / "run" / checkpoint.LAST
    newest.write_bytes(newest.read_bytes()[:-1000])
    config = tiny("train.resume=true", f"evaluate.photos={photos}")
    with caplog.at_level("WARNING", "train"):
        run(config, load_data(config), tmp_path / "run")
    assert f"checkpoint {newest} is damaged or no checkpoint" in caplog.text and "the one before" in caplog.text
    assert_same_weights(newest, finished / checkpoint.LAST)
    assert metrics_without_times(tmp_path / "run") == metrics_without_times(finished)


def test_checkpoints_of_every_other_epoch_hold_the_same_and_the_last_one(tiny, photos, finished, tmp_path, monkeypatch):
    saved = []
    save = checkpoint.save
    monkeypatch.setattr(checkpoint, "save", lambda path, *rest: saved.append(path.name) or save(path, *rest))
    config = tiny("train.checkpoint_every=2", f"evaluate.photos={photos}")
    run(config, load_data(config), tmp_path)
    assert saved.count(checkpoint.LAST) == 2  # after epochs 2 and 3
    for name in (checkpoint.LAST, checkpoint.BEST):
        assert_same_weights(tmp_path / name, finished / name)


def fail_with(number: int):
    def fail(*arguments, **more):
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize(
    "writer, done",
    [
        pytest.param("train.run_folder.logs.RunLog._show", 0, id="TensorBoard"),
        pytest.param("train.run_folder.logs.RunLog.renders", 0, id="renders"),
        pytest.param("train.run_folder.logs.RunLog.scalars", 0, id="metrics"),
        pytest.param("train.run_folder.files.os.fsync", 0, id="checkpoint"),
        pytest.param("train.experiment.evaluate_photographs", 1, id="photographs"),
    ],
)
def test_a_full_disk_is_one_error_wherever_it_is_met_and_the_run_can_go_on(
    tiny, photos, tmp_path, monkeypatch, writer, done
):
    config = tiny("train.epochs=1", "train.resume=true", f"evaluate.photos={photos}")
    with monkeypatch.context() as patch:
        patch.setattr(writer, fail_with(errno.ENOSPC))
        with pytest.raises(InputError, match=rf"{re.escape(str(tmp_path))}\S* cannot be written \(No space left"):
            run(config, load_data(config), tmp_path)
    assert checkpoint.exists(tmp_path) == bool(done)
    run(config, load_data(config), tmp_path)
    assert len(read_metrics(tmp_path)) == 2


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Callable[[int], Path]]:
    """Makes a file system of so many KiB, or changes its size."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1k", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting is not allowed")

    def sized(kibibytes: int) -> Path:
        subprocess.run(["mount", "-o", f"remount,size={kibibytes}k", str(folder)], check=True)
        return folder

    yield sized
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("kibibytes", [8, 100, 500, 1300])
def test_a_run_on_a_small_disk_ends_in_one_error_and_goes_on_when_there_is_room(tiny, small_disk, kibibytes):
    disk = small_disk(kibibytes)
    config = tiny("train.epochs=2", "train.resume=true", f"renderer.cache={disk / 'cache'}")
    with pytest.raises(InputError, match=rf"{disk}\S* cannot be written \(No space left"):
        run(config, load_data(config), disk / "run")
    small_disk(8000)
    run(config, load_data(config), disk / "run")
    assert [line.get("epoch") for line in read_metrics(disk / "run")] == [1, 2, None]


def test_an_error_of_the_system_that_room_would_not_mend_is_not_called_a_full_disk(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("train.run_folder.logs.RunLog.scalars", fail_with(errno.EIO))
    with pytest.raises(OSError, match="Input/output error"):
        run(tiny("train.epochs=1"), load_data(tiny()), tmp_path)


def test_a_configuration_that_does_not_fit_leaves_the_old_one_whole(tiny, finished, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path / "run")
    before = (tmp_path / "run" / "config.yaml").read_bytes()

    monkeypatch.setattr("train.run_folder.files.os.fsync", fail_with(errno.ENOSPC))
    with pytest.raises(InputError, match=r"make room and go on with train\.resume=true"):
        prepare(tiny("train.resume=true"), load_data(tiny()), tmp_path / "run")
    assert (tmp_path / "run" / "config.yaml").read_bytes() == before


KILLED = """
import os, signal, sys
import torch
from omegaconf import OmegaConf
from train import experiment
from train.fit import trainer

training_batches = trainer.training_batches

def kill_in_the_second_epoch(images, labels, batch_size, seed, now, *rest, **more):
    for number, batch in enumerate(training_batches(images, labels, batch_size, seed, now, *rest, **more)):
        if (now.epoch, number) == (1, 1):
            os.kill(os.getpid(), signal.SIGKILL)
        yield batch

torch.set_num_threads(1)
trainer.training_batches = kill_in_the_second_epoch
config = OmegaConf.load(sys.argv[1])
experiment.run(config, experiment.load_data(config), experiment.Path(sys.argv[2]))
"""


def test_a_killed_run_can_be_resumed_too(tiny, finished, tmp_path):
    OmegaConf.save(OmegaConf.create(OmegaConf.to_container(tiny(), resolve=True)), tmp_path / "config.yaml")
    folder = tmp_path / "run"
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", KILLED, tmp_path / "config.yaml", folder]
    process = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(root)}, cwd=tmp_path, capture_output=True)
    assert process.returncode == -signal.SIGKILL, process.stderr.decode()
    resumed = tiny("train.resume=true")
    run(resumed, load_data(resumed), folder)
    assert_same_weights(folder / checkpoint.LAST, finished / checkpoint.LAST)
    assert metrics_without_times(folder)[:-1] == metrics_without_times(finished)[:-1]


def test_resuming_a_finished_run_trains_no_further_and_scores_the_same(tiny, tmp_path):
    config = tiny("augment=none", "train.epochs=1")
    run(config, load_data(config), tmp_path)
    before, last = metrics_without_times(tmp_path), (tmp_path / checkpoint.LAST).read_bytes()
    again = tiny("augment=none", "train.epochs=1", "train.resume=true")
    run(again, load_data(again), tmp_path)
    assert metrics_without_times(tmp_path) == before
    assert (tmp_path / checkpoint.LAST).read_bytes() == last


def test_a_folder_that_holds_a_run_is_not_written_over(tiny, finished):
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"holds a run already: set train.resume=true to go on, or choose another"):
        run(tiny(), load_data(tiny()), finished)
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("change", ["seed=8", "augment=none", "model.width=2", "train.epochs=2", "label=pear"])
def test_resuming_with_other_settings_is_refused_by_name_and_changes_nothing(tiny, finished, change):
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    config = tiny("train.resume=true", change)
    key = {"augment=none": "augment.arm"}.get(change, change.partition("=")[0])
    asked = change.partition("=")[2]
    with pytest.raises(
        InputError, match=rf"was trained with {key}=\S+, and train.resume=true asks for {asked}: resume"
    ):
        prepare(config, load_data(config), finished)
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


def test_resuming_with_another_data_path_is_refused(tiny, finished, tiny_npz, tmp_path):
    shutil.copy(tiny_npz, tmp_path / "other.npz")
    config = tiny("train.resume=true", f"data.path={tmp_path / 'other.npz'}")
    with pytest.raises(InputError, match=r"was trained with data.path="):
        prepare(config, load_data(config), finished)


def test_a_network_alone_is_no_run_to_go_on_with(tiny, finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    shutil.copy(folder / checkpoint.BEST, folder / checkpoint.LAST)
    (folder / checkpoint.PREVIOUS).unlink()
    config = tiny("train.resume=true")
    with pytest.raises(InputError, match=r"has a network and no run to go on with \(\S+ is missing\)"):
        prepare(config, load_data(config), folder)


def test_resuming_for_more_epochs_and_under_other_circumstances_is_no_change(tiny, finished):
    for changes in (["train.epochs=4"], ["train.threads=1", "renderer.cache=null", "train.checkpoint_every=2"]):
        require_same_settings(finished, tiny("train.resume=true", *changes))


# ---------------------------------------------------------------------------------------- rounds and starts


def test_a_signal_between_two_rounds_or_within_one_leads_to_the_same_end(tiny, finished, tmp_path, monkeypatch):
    """Bit for bit: 40 of 54 images an epoch, in rounds of 16, 16 and 8, each with 4 renders (2, 2 and 1 steps); held to
    the answers of the network begun with."""
    rounds = ("augment.every=16", "train.images_per_epoch=40", "train.resume=true")
    overrides = (*rounds, f"train.init_from={finished}", "train.distillation=2")
    run(tiny(*overrides), load_data(tiny()), tmp_path / "whole")
    folder = tmp_path / "stopped"
    for number, at in [(1, 2), (4, 1), (6, 2)]:
        with pytest.raises(Interrupted):
            run_with_signal(tiny(*overrides), folder, monkeypatch, number, at, signal.SIGTERM)
        assert checkpoint.load(folder / checkpoint.LAST)["under_way"]["step"] == {1: 4, 4: 3, 6: 2}[number]
    run(tiny(*overrides), load_data(tiny()), folder)
    assert_same_weights(folder / checkpoint.LAST, tmp_path / "whole" / checkpoint.LAST)
    assert metrics_without_times(folder) == metrics_without_times(tmp_path / "whole")


def test_every_round_is_trained_on_renders_made_for_its_own_weights(tiny, tmp_path, monkeypatch):
    trained = []
    put_last = trainer.put_last
    monkeypatch.setattr(trainer, "put_last", lambda split, renders: trained.append(renders) or put_last(split, renders))
    config = tiny("train.epochs=1", "augment=random", "augment.every=20")
    run(config, load_data(config), tmp_path)
    assert len(trained) == 3  # 54 images
    assert len(torch.cat([renders.images for renders in trained]).unique(dim=0)) == 3 * 4
    (line,) = [line for line in read_metrics(tmp_path) if "epoch" in line]
    assert line["augment/loss"] == pytest.approx(sum(renders.diagnostics["loss"] for renders in trained) / 3)


def test_a_run_starts_from_the_selected_network_of_another(tiny, finished, tmp_path):
    config = tiny(f"train.init_from={finished}", "augment=none", "train.epochs=1", "train.learning_rate=1e-30")
    run(config, load_data(config), tmp_path)
    first, found = checkpoint.load(finished / checkpoint.BEST), checkpoint.load(tmp_path / checkpoint.LAST)
    for name, value in first["model"].items():
        assert "running" in name or "batches" in name or torch.equal(found["model"][name], value), name
    assert found["epoch"] == 1


# ---------------------------------------------------------------------------------------- arms


def test_no_examples_and_no_augmentation_train_the_same_weights(tiny, tmp_path):
    """So the arms differ in their renders alone: nothing else draws from the training's random streams."""
    arms = {"none": ["augment=none"], "empty": ["augment.examples=0"], "renders": []}
    for name, overrides in arms.items():
        config = tiny("train.epochs=2", *overrides)
        run(config, load_data(config), tmp_path / name)
    assert_same_weights(tmp_path / "empty" / checkpoint.LAST, tmp_path / "none" / checkpoint.LAST)
    first, other = (weights(tmp_path / name / checkpoint.LAST)["head.weight"] for name in ("none", "renders"))
    assert not torch.equal(first, other)
    assert not (tmp_path / "none" / "renders").exists()


@pytest.mark.parametrize("arm", ["none", "random", "adversarial"])
def test_a_run_is_a_function_of_its_seed(tiny, tmp_path, arm):
    for name, seed in [("first", 0), ("again", 0), ("other", 1)]:
        torch.manual_seed(len(name))
        config = tiny("train.epochs=1", f"augment={arm}", f"seed={seed}")
        run(config, load_data(config), tmp_path / name)
    assert_same_weights(tmp_path / "again" / checkpoint.LAST, tmp_path / "first" / checkpoint.LAST)
    first, other = (weights(tmp_path / name / checkpoint.LAST)["stem.weight"] for name in ("first", "other"))
    assert not torch.equal(first, other)


def test_meshes_of_several_classes_are_rendered_with_their_own_labels(tiny, tmp_path, monkeypatch):
    trained = []
    put_last = trainer.put_last
    monkeypatch.setattr(trainer, "put_last", lambda split, renders: trained.append(renders) or put_last(split, renders))
    meshes = "scene.meshes=[{mesh: 'solid:pear', label: pear}, 'solid:orange', {mesh: 'solid:apple:2', label: apple}]"
    config = tiny("train.epochs=1", meshes, "augment.examples=12")
    run(config, load_data(config), tmp_path)
    (renders,) = trained
    # mesh by mesh: 2 views × 2 backgrounds each
    assert renders.labels.tolist() == [2] * 4 + [1] * 4 + [0] * 4
    assert len(renders.images.unique(dim=0)) == 12


def test_look_alikes_follow_the_meshes_and_are_anything_but_the_label_unless_they_name_a_class(
    tiny, tmp_path, monkeypatch
):
    trained = []
    put_last = trainer.put_last
    monkeypatch.setattr(trainer, "put_last", lambda split, renders: trained.append(renders) or put_last(split, renders))
    hard_negatives = "scene.hard_negatives=['solid:fruit', {mesh: 'solid:pear', label: pear}]"
    config = tiny("train.epochs=1", "scene.meshes=['solid:orange']", hard_negatives, "augment.examples=6")
    run(config, load_data(config), tmp_path)
    (renders,) = trained
    orange = 1
    assert renders.labels.tolist() == [orange] * 2 + [complementary_label(orange)] * 2 + [2] * 2
    assert np.isfinite(read_metrics(tmp_path)[0]["train/loss"])


# ---------------------------------------------------------------------------------------- what a run leaves


def test_a_run_folder_holds_configuration_metrics_networks_renders_and_scores(finished, tiny_npz, photos):
    config = OmegaConf.load(finished / "config.yaml")
    assert OmegaConf.missing_keys(config) == set()
    assert (config.data.path, config.evaluate.photos, config.train.epochs) == (str(tiny_npz), str(photos), 3)
    assert set(config.versions) == {"python", "torch", "torchvision", "numpy"}
    last, best = (torch.load(finished / name, weights_only=True) for name in ("last.pt", "best.pt"))
    assert (last["epoch"], last["seed"], last["arm"], last["precision"]) == (3, 7, "adversarial", "float32")
    assert last["model"].keys() == best["model"].keys() and "optimizer" not in best
    assert sorted(path.name for path in (finished / "renders").glob("*.png")) == [f"epoch_00{n}.png" for n in (1, 2, 3)]
    assert {path.name for path in (finished / "photographs").iterdir()} == {
        "photographs.csv", "summary.json", "contact_sheet.png", "roc.csv", "roc.png"
    }  # fmt: skip
    assert not list(finished.glob("*.tmp")) and list(finished.glob("events.out.tfevents.*"))


def test_metrics_have_each_epochs_losses_attack_and_seconds_and_the_final_scores(finished):
    *epochs, scores = read_metrics(finished)
    assert [line["epoch"] for line in epochs] == [1, 2, 3]
    for line in epochs:
        assert {
            "train/loss", "train/accuracy", "train/learning_rate", "validation/loss", "validation/accuracy",
            "augment/attack_success_before", "augment/attack_success", "augment/steps", "augment/loss_before",
            "augment/loss", "augment/light_change", "augment/clamped",
            "seconds/attack", "seconds/training", "seconds/evaluation", "seconds/input_output",
        } <= line.keys()  # fmt: skip
        assert all(isinstance(value, int | float) for value in line.values())
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    assert scores.keys() == {
        "test/accuracy", "test/accuracy_last", "test/epoch",
        *(f"photographs/{name}" for name in ("recall", "top5", "false_alarms", "auc")),
        *(f"photographs/recall_at/{rate}" for rate in ("0.05", "0.10", "0.20")),
    }  # fmt: skip
    for name in ("recall", "top5", "false_alarms", "auc"):
        assert scores[f"photographs/{name}"] == summary[name]["value"]
    for rate, figure in summary["recall_at"].items():
        assert scores[f"photographs/recall_at/{rate}"] == figure["value"]


def test_several_folders_of_photographs_are_scored_in_sub_folders_of_their_names(tiny, photos, tmp_path):
    named = f"evaluate.photos={{lab: {photos}, wild-1: {photos / 'orange'}}}"
    config = tiny("augment=none", "train.epochs=1", named)
    run(config, load_data(config), tmp_path / "run")
    scores = read_metrics(tmp_path / "run")[-1]
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


class GuardedData:
    """A data set whose test split can be had only once the last epoch is done."""

    def __init__(self, data: DataSet, folder: Path, epochs: int):
        self.classes, self.train, self.size = data.classes, data.train, data.size
        self._test, self._last, self._epochs = data.test, folder / checkpoint.LAST, epochs
        self.looks = 0

    @property
    def test(self):
        assert checkpoint.load(self._last)["epoch"] == self._epochs
        self.looks += 1
        return self._test


def test_the_test_set_is_looked_at_once_after_the_last_epoch(tiny, tmp_path):
    data = GuardedData(load_data(tiny()), tmp_path, epochs=3)
    run(tiny(), data, tmp_path)
    assert data.looks == 1


def test_training_and_validation_images_are_apart(tiny, tmp_path, monkeypatch):
    seen = {}

    def record(self, train, validation, log):
        seen.update(train=train, validation=validation)
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer.Trainer, "fit", record)
    data = load_data(tiny())
    with pytest.raises(KeyboardInterrupt):
        run(tiny(), data, tmp_path)
    assert (len(seen["train"]), len(seen["validation"])) == (54, 6)
    assert seen["validation"].labels.bincount().tolist() == [2, 2, 2]
    both = torch.cat([seen["train"].images, seen["validation"].images])
    assert torch.equal(both.unique(dim=0), data.train.images.unique(dim=0))


# ---------------------------------------------------------------------------------------- what is skipped


def log_of_a_scene(config, folder: Path, caplog) -> dict[str, str]:
    """What follows the colon on the two lines about what is skipped."""
    caplog.clear()
    with caplog.at_level("INFO", "train"):
        prepare(config, load_data(config), folder)
    lines = [line.partition(": ") for line in caplog.messages]
    return {name: rest for name, _, rest in lines if name in ("operators", "skipped")}


def test_the_log_says_what_is_shared_and_what_is_skipped(tiny, tmp_path, caplog, rasterized):
    """A wall that hides another, both open, and a closed box, seen from the front and above; 1 view, 2 backgrounds.

    The wall covers 15 of the image's 16 rows, and the box no other. Unseen are 2 of the walls' 4 faces and 8 of the
    box's 12.
    """
    wall, box = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]), trimesh.creation.box((1, 2, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    walls = trimesh.Trimesh(np.concatenate([wall, wall / 2 - [0.5, 0, 0]]), np.concatenate([faces, faces + 4]))
    for name, mesh in (("walls", walls), ("box", box)):
        mesh.export(tmp_path / f"{name}.ply")
    meshes = f"scene.meshes=[{tmp_path}/walls.ply, {{mesh: {tmp_path}/box.ply, label: pear}}]"
    skipped = (
        "rasterization in every epoch, 18 of 49 light coefficients, 6 % of the pixels (background), "
        "62 % of the faces (seen by no sample), back faces in 1 of 2 views (closed meshes)"
    )
    for cache, loaded, built in [(f"{tmp_path}/kept", 0, 2), (f"{tmp_path}/kept", 2, 0), ("null", 0, 2)]:
        rasterized.clear()
        log = log_of_a_scene(tiny(meshes, f"renderer.cache={cache}"), tmp_path / "run", caplog)
        shutil.rmtree(tmp_path / "run")
        operators = rf"2 views for 4 examples, {loaded} from the cache, {built} built \(\d\.\d\d s\)"
        assert re.fullmatch(operators, log["operators"]) and log["skipped"] == skipped
        assert rasterized == [1] * built


def test_a_run_whose_operators_are_on_disk_rasterizes_nothing_and_trains_the_same(tiny, tmp_path, rasterized):
    config = tiny(f"renderer.cache={tmp_path}/kept", "train.epochs=1")
    for name, calls in [("first", [1, 1]), ("second", [1, 1])]:
        run(config, load_data(config), tmp_path / name)
        assert rasterized == calls
    assert_same_weights(tmp_path / "second" / checkpoint.LAST, tmp_path / "first" / checkpoint.LAST)


def test_a_cache_that_cannot_be_written_is_said_in_the_log_and_stops_no_run(tiny, tmp_path, caplog):
    (tmp_path / "file").touch()
    log = log_of_a_scene(tiny(f"renderer.cache={tmp_path}/file"), tmp_path / "run", caplog)
    assert re.search(rf"0 from the cache, 2 built .*; not kept: .*{tmp_path}/file", log["operators"])


# ---------------------------------------------------------------------------------------- wrong input


@pytest.mark.parametrize(
    "overrides, fault",
    [
        (["seed=-1"], "seed=-1 must be at least 0"),
        (["seed=abc"], "seed: Value 'abc' of type 'str' could not be converted to Integer"),
        (["train.epochs=abc"], "train.epochs: Value 'abc'"),
        (["train.epochs=0"], "train.epochs=0"),
        (["data.validation=abc"], "data.validation: Value 'abc'"),
        (["data.validation=1.5"], "data.validation=1.5 must lie between 0 and 1"),
        (["data.path=???"], "data.path is not set: give data.path=..."),
        (["data.name=mnist"], "data.name=mnist: choose one of cifar100, npz, folder, shapes"),
        (["+train.epoch=3"], "train.epoch: Key 'epoch' not in"),
        (["augment.attack.step_size=abc"], "augment.attack.step_size: Value 'abc'"),
        (["augment.arm=adverserial"], "augment.arm=adverserial: choose one of"),
        (["augment.random_light=3"], "RandomLightSettings"),
        (["scene.views=3"], "augment.examples=4 is not 2 meshes × 3 views × 2 backgrounds = 12"),
        (["augment.examples=5"], "augment.examples=5 is not a multiple of 2 meshes × 2 backgrounds"),
        (["scene.meshes=solid:orange"], "scene.meshes"),
        (["scene.meshes=[{mesh: 'solid:orange', lable: orange}]"], r"scene.meshes\[0\].lable: Key 'lable'"),
        (["scene.meshes=[{label: orange}]", "augment.examples=2"], r"mesh"),
        (["scene.meshes=['solid:ornage']", "augment.examples=2"], "use 'orange'"),
        (
            ["scene.hard_negatives=[{mesh: 'solid:orange', label: orange}]", "augment.examples=6"],
            r"scene.hard_negatives\[0\] is of the class orange: name it in scene.meshes",
        ),
        (["scene.exposure=0"], "scene.exposure=0.0 must be at least"),
        (["scene.exposure=1e30"], r"scene.exposure=1e\+30 must be at least 1e-05 and at most 100000"),
        (["scene.views=1000000000000"], "scene.views=1000000000000 must be at least 1 and at most 100000"),
        (["train.threads=100000"], "train.threads=100000 must be at least 1 and at most 1024"),
        (["augment.examples=1000000000000"], "augment.examples=1000000000000 must be at least 0"),
        (["augment.random_light.amplitude=1e30"], r"augment.random_light.amplitude=1e\+30 must be"),
        (["augment.attack.step_size=nan"], "attack: step_size=nan must be"),
        (["renderer.samples=65"], "renderer.samples=65 must be at least 1 and at most 64"),
        (["renderer=x"], "renderer: Merge error: str is not a subclass of RendererSettings"),
        (["scene.meshes=['']"], "mesh is '': give a file or solid:NAME"),
        (["train.compile=always"], "train.compile=always is for a GPU"),
        (["train.device=meta"], "device=meta is not available here"),
        (["model.width=100000"], "model.depth=10, model.width=100000 make"),
        (["model.depth=1000000"], "model.depth=1000000, model.width=1 make"),
        (["+data.size=1"], "data.size=1 must be at least 5"),
        (["scene.light=graze"], "'graze' is not known"),
        (
            ["label=ornage"],
            r"label of scene.meshes\[0\]: 'ornage' is not a class of the model: choose one, such as orange",
        ),
        (["renderer.samples=0"], "renderer.samples=0"),
        (["renderer.rasterizer=opengll"], "opengll"),
        (["model.dropout=2"], "model.dropout=2"),
        (["train.device=cuda:99"], "device=cuda:99 is not available here"),
        (["evaluate.photos=/no/such/folder"], "/no/such/folder does not exist"),
        (["evaluate.photos={lab: /no/such/lab}"], "/no/such/lab does not exist"),
        (["evaluate.photos={a/b: /x}"], r"evaluate\.photos\.a/b: name a sub-folder of the run, of letters"),
        (["evaluate.photos={renders: /x}"], r"evaluate\.photos\.renders: name a sub-folder of the run"),
        (["evaluate.photos=[/x]"], r"evaluate\.photos=\['/x'\] must be a folder, or a mapping of names to folders"),
        (["evaluate.photos={lab: null}"], r"evaluate\.photos=\{'lab': None\} must be a folder, or a mapping"),
        (["evaluate.skip_unreadable=perhaps"], "evaluate.skip_unreadable: Value 'perhaps'"),
    ],
)
def test_wrong_input_is_one_error_before_the_first_epoch(tiny, tmp_path, overrides, fault):
    config = tiny(*overrides)
    with pytest.raises(InputError, match=fault) as caught:
        prepare(config, load_data(config), tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_photographs_of_an_unknown_label_are_refused_before_the_first_epoch(tiny, photos, tmp_path):
    config = tiny("augment=none", "label=ornage", f"evaluate.photos={photos}")
    with pytest.raises(InputError, match="'ornage' is not a class of the model: choose one, such as orange"):
        prepare(config, load_data(config), tmp_path)


@pytest.mark.parametrize("choices", [["experiment=demo"], ["experiment=cpu"], ["experiment=paper"]])
def test_every_experiment_is_a_configuration_that_runs_on_other_data_too(tiny_npz, choices):
    """The command line's data set wins over the experiment's, and no photographs are asked for."""
    config = composed("train", [*choices, "data=npz", f"data.path={tiny_npz}", "run=here"])
    assert read_settings(ExperimentSettings, config).evaluate.photos is None
    assert len(load_data(config).train) == 60


def test_the_papers_renders_are_as_they_are_and_have_no_look_alikes():
    settings = read_settings(ExperimentSettings, composed("train", ["experiment=paper", "run=here"]))
    assert settings.augment.vary == VariationSettings() and settings.scene.hard_negatives == []


def test_another_class_takes_a_label_meshes_and_look_alikes_alone(tiny, tmp_path, monkeypatch):
    trained = []
    put_last = trainer.put_last
    monkeypatch.setattr(trainer, "put_last", lambda split, renders: trained.append(renders) or put_last(split, renders))
    meshes = ["label=pear", "scene.meshes=['solid:pear']", "scene.hard_negatives=[{mesh: 'solid:apple', label: apple}]"]
    small = ["augment.examples=null", "scene.views=2", "augment.every=30", "augment.warm_start=false", "train.epochs=1"]
    config = tiny("experiment=best", "train.init_from=null", "train.soup=false", *meshes, *small)
    run(config, load_data(config), tmp_path)
    first, second = trained
    apple, pear = 0, 2
    assert first.labels.tolist() == second.labels.tolist() == [pear] * 4 + [apple] * 4
    assert len(torch.cat([first.images, second.images]).unique(dim=0)) == 16


def test_the_demonstration_is_scored_on_the_images_that_it_renders():
    settings = read_settings(ExperimentSettings, composed("train", ["run=here"]))
    assert settings.evaluate.photos == settings.data.images == "here/rendered_images"


def test_training_takes_the_attacks_of_scripts_attack_and_the_papers_where_none_is_named():
    """The keys that were there before any other kind set the paper's step on the light."""

    def kinds(*overrides: str) -> dict:
        settings = read_settings(ExperimentSettings, composed("train", ["run=here", *overrides]))
        return {name: asdict(each) for name, each in settings.augment.attack.parameters.items()}

    paper = {"norm": "linf", "radius": None, "step": "unit", "step_size": 0.05}
    assert kinds() == kinds("experiment=paper") == {"lighting": paper}
    assert kinds("augment.attack.step=sign", "augment.attack.step_size=0.1") == {
        "lighting": paper | {"step": "sign", "step_size": 0.1}
    }
    alone = composed("attack", ["attack=[geometry,lighting]"]).attack
    both = kinds("attack@augment.attack=[geometry,lighting]", "augment.attack.geometry.radius=0.01")
    assert both == {"lighting": dict(alone.lighting), "geometry": dict(alone.geometry) | {"radius": 0.01}}


def test_photographs_among_which_the_scores_would_lie_are_refused_before_training(tiny, photos, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(photos, folder / "photographs")
    config = tiny(f"evaluate.photos={folder / 'photographs'}")
    with pytest.raises(InputError, match="photographs lies inside the photographs' folder: choose another"):
        prepare(config, load_data(config), folder)
