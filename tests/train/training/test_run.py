import errno
import gc
import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from augment.losses import complementary_label
from augment.scene.build import build_scene
from renderer.errors import InputError
from renderer.image import to_bytes
from tests.runs import completed_run, finish, loaded_run
from tests.train.helpers import read_markdown
from train.data import batches
from train.data.load import load_data
from train.report.comparison import format_table
from train.report.report_page import write_report
from train.report.summary import summarize
from train.runs import checkpoint
from train.runs.run_log import read_metrics
from train.runs.saved_networks import load_run
from train.system.hashing import content_hash
from train.system.processes import Interrupted
from train.system.user_errors import one_sentence
from train.training import loop
from train.training.initial import choose_validation, load_initial
from train.training.run import describe_test_images


def weights(folder: Path) -> list[str]:
    """Hashes of the last and the selected ones."""
    return [content_hash(checkpoint.load(folder / name)["model"]) for name in ("last.pt", "best.pt")]


def metrics(folder: Path) -> list[dict]:
    """Without the seconds."""
    return [{k: v for k, v in line.items() if not k.startswith("seconds/")} for line in read_metrics(folder)]


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
        completed_run(settings, folder)


@pytest.fixture
def regenerated(monkeypatch) -> list:
    """The renders of each round, as they are handed to training."""
    renders, mixed = [], loop.TrainingImages
    monkeypatch.setattr(loop, "TrainingImages", lambda *mixture: renders.append(mixture[2]) or mixed(*mixture))
    return renders


def test_the_training_set_lies_in_memory_once(tiny, tmp_path, monkeypatch):
    """On the CPU, as it was loaded; a batch is cropped at a time."""
    data, after = load_data(tiny()), []

    def large() -> set[int]:
        tensors = [item for item in gc.get_objects() if type(item) is torch.Tensor and item.dtype == torch.uint8]
        return {t.untyped_storage().data_ptr() for t in tensors if t.numel() > 0.7 * data.train.images.numel()}

    monkeypatch.setattr(batches, "CHUNK_BYTES", 1)
    act_at(monkeypatch, 0, 2, lambda: after.append(large()))
    before = large()
    completed_run(tiny("augment=none", "train.epochs=1"), tmp_path, data)
    assert after == [before] and data.train.images.data_ptr() in before


def test_more_epochs_stretch_the_schedule_and_a_jump_of_its_rate_is_said(tiny, tmp_path, caplog):
    """One cycle's rate ends at zero; half way through, it is .5 / .8 of the highest."""
    keys = "augment=none", "train.schedule=one_cycle", "train.resume=true"
    data = load_data(tiny())
    completed_run(tiny(*keys, "train.epochs=1"), tmp_path, data)
    loaded_run(tiny(*keys, "train.epochs=1"), tmp_path, data)
    assert not any(record.levelname == "WARNING" for record in caplog.records)
    loaded_run(tiny(*keys, "train.epochs=2"), tmp_path, data)
    (message,) = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert message.endswith(f" {0.05 * 0.5 / 0.8:.3g}, not 0")


@pytest.mark.parametrize(
    "number, average", [(signal.SIGTERM, "train.ema_decay=0.8"), (signal.SIGINT, "train.soup=true")], ids=str
)
def test_a_signal_ends_the_run_after_its_step_and_resuming_ends_as_if_it_had_not_come(
    tiny, finished, tmp_path, number, average
):
    """Bit for bit, within a round and at its end: 40 of 54 images an epoch, in rounds of 16, 16 and 8, each with 4
    renders (2, 2 and 1 steps); with lights that continue from round to round, dropout, and a teacher's predictions."""
    rounds = ("train.epochs=2", "augment.every=16", "train.images_per_epoch=40", "train.resume=true")
    settings = tiny(*rounds, f"train.init_from={finished}", "train.distillation=2", average)
    completed_run(settings, tmp_path / "whole")
    folder = tmp_path / "stopped"
    handlers = [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)]
    for round_number, step, done in [(1, 2, (0, 4)), (2, 1, (1, None)), (4, 1, (1, 3))]:
        with pytest.raises(Interrupted) as stopped:
            train_with_signal(settings, folder, round_number, step, number)
        assert (stopped.value.code, stopped.value.signal) == (128 + number, number.name)
        assert [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)] == handlers
        state = checkpoint.load(folder / checkpoint.LAST)
        assert (state["epoch"], state["under_way"] and state["under_way"]["step"]) == done
    torch.manual_seed(17)
    completed_run(settings, folder)
    assert weights(folder) == weights(tmp_path / "whole") and metrics(folder) == metrics(tmp_path / "whole")
    images = [(path / "renders" / "epoch_002.png").read_bytes() for path in (folder, tmp_path / "whole")]
    assert images[0] == images[1]


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
        completed_run(tiny("augment=none"), tmp_path)
    assert not checkpoint.exists(tmp_path)


def test_resuming_a_finished_run_trains_no_further_and_scores_the_same(tiny, tmp_path):
    completed_run(tiny("augment=none", "train.epochs=1"), tmp_path)
    before = metrics(tmp_path), (tmp_path / checkpoint.LAST).read_bytes()
    completed_run(tiny("augment=none", "train.epochs=1", "train.resume=true"), tmp_path)
    assert (metrics(tmp_path), (tmp_path / checkpoint.LAST).read_bytes()) == before


def test_a_run_is_neither_written_over_nor_resumed_with_other_settings(tiny, finished):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    for settings, message in [
        (tiny(), "holds a run already: set train.resume=true to go on or overwrite=true"),
        (tiny("train.resume=true", "seed=8"), "was made with seed=7, not 8"),
    ]:
        with pytest.raises(InputError, match=message):
            loaded_run(settings, finished)
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before


def test_the_threads_that_were_chosen_are_recorded_and_those_of_a_resumed_run(tiny, tmp_path, monkeypatch):
    before, counts = torch.get_num_threads(), []
    try:
        for chosen, asked in [(2, "null"), (1, "null"), (1, "3")]:
            monkeypatch.setattr("train.training.run.choose_threads", Mock(return_value=chosen))
            settings = tiny("augment=none", "train.epochs=1", f"train.threads={asked}", "train.resume=true")
            run = loaded_run(settings, tmp_path)
            torch.set_num_threads(before)  # as another arm's may be
            finish(run)
            counts.append((torch.get_num_threads(), OmegaConf.load(tmp_path / "config.yaml").hardware.threads))
    finally:
        torch.set_num_threads(before)
    assert counts == [(2, 2), (2, 2), (3, 3)]


@pytest.mark.parametrize(
    "writer",
    [
        pytest.param("tensorboard.compat.tensorflow_stub.io.gfile.LocalFileSystem.append", id="TensorBoard"),
        pytest.param("train.runs.run_log.RunLog.scalars", id="metrics"),
        pytest.param("renderer.io.files.os.fsync", id="checkpoint"),
    ],
)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # TensorBoard's, raised here, too
def test_a_full_disk_is_one_error_wherever_it_is_met_and_the_run_can_go_on(tiny, tmp_path, writer):
    settings = tiny("augment=none", "train.epochs=1", "train.resume=true")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        with pytest.raises(OSError) as full:
            completed_run(settings, tmp_path)
    assert one_sentence(full.value).endswith(" cannot be written (No space left on device): make room and start again")
    completed_run(settings, tmp_path)
    assert len(read_metrics(tmp_path)) == 2


def test_no_examples_and_no_augmentation_train_the_same_weights(tiny, tmp_path):
    """So the arms differ in their renders alone: nothing else draws from the training's random streams."""
    arms = {"none": ["augment=none"], "empty": ["augment.examples=0"], "renders": []}
    for name, overrides in arms.items():
        completed_run(tiny("train.epochs=1", *overrides), tmp_path / name)
    assert weights(tmp_path / "empty") == weights(tmp_path / "none") != weights(tmp_path / "renders")
    assert not (tmp_path / "none" / "renders").exists()


APPLE, ORANGE, PEAR = range(3)
SEVERAL = [
    "scene.meshes=[{mesh: 'solid:pear', label: pear}, 'solid:orange']", "augment.examples=16",
    "scene.hard_negatives=['solid:fruit', {mesh: 'solid:apple:2', label: apple}]",
]  # fmt: skip
ANOTHER_CLASS = [
    "experiment=best", "train.init_from=null", "train.soup=false", "label=pear", "scene.meshes=['solid:pear']",
    "scene.hard_negatives=[{mesh: 'solid:apple', label: apple}]", "augment.examples=null", "scene.views=2",
    "augment.every=30", "augment.warm_start=false",
]  # fmt: skip


@pytest.mark.parametrize(
    "overrides, rounds, expected",
    [
        pytest.param(SEVERAL, 1, [PEAR, ORANGE, complementary_label(ORANGE), APPLE], id="several"),
        pytest.param(ANOTHER_CLASS, 2, [PEAR, APPLE], id="another class"),
    ],
)
def test_meshes_and_hard_negatives_are_rendered_with_their_own_labels(
    tiny, tmp_path, regenerated, overrides, rounds, expected
):
    """A hard negative that names no class has the complementary label. Of each mesh, 2 views × 2 backgrounds."""
    completed_run(tiny("train.epochs=1", *overrides), tmp_path)
    assert len(regenerated) == rounds
    for renders in regenerated:
        assert renders.labels.tolist() == [label for label in expected for _ in range(4)]
    assert len(torch.cat([renders.images for renders in regenerated]).unique(dim=0)) == 4 * len(expected) * rounds
    assert np.isfinite(read_metrics(tmp_path)[0]["train/loss"])


def test_training_with_two_classes_raises_the_recall_of_both_and_shows_each(tiny, tmp_path, monkeypatch):
    """On renders of other instances before other backgrounds. The run is stopped within its first epoch and resumed;
    the network that it begins with knows neither class. Tables and page have a row for both and one for each."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **options: None)
    shown = [(f"solid:{name}:5", name) for name in ("apple", "pear")]
    scene = build_scene(shown, 16, 3, backgrounds=[0.3, 0.6], rasterizer="numpy")
    images = scene.render(scene.conditions(torch.arange(len(scene))), torch.arange(len(scene)))[:, 0]
    for number, (name, image) in enumerate(zip(scene.labels, images, strict=True)):
        (tmp_path / "photos" / name).mkdir(parents=True, exist_ok=True)
        Image.fromarray(to_bytes(image).permute(1, 2, 0).numpy()).save(tmp_path / "photos" / name / f"{number}.png")
    completed_run(tiny("augment=none", "train.epochs=1"), tmp_path / "base")
    keys = [f"train.init_from={tmp_path / 'base'}", f"evaluate.photos={tmp_path / 'photos'}", "train.resume=true"]
    keys += ["label=[apple,pear]", "scene.meshes=['solid:apple','solid:pear']", "train.ranking=1", "train.epochs=6"]
    settings, folder = (
        tiny(*keys, "augment=random", "augment.warm_start=false", "augment.examples=24"),
        tmp_path / "run",
    )
    with pytest.raises(Interrupted):
        train_with_signal(settings, folder, 0, 2, signal.SIGTERM)
    scores, names = completed_run(settings, folder), ["random", "random, label=apple", "random, label=pear"]
    before = json.loads((folder / "before" / "photographs" / "summary.json").read_text())["by_label"]
    for label, part in before.items():
        assert scores[f"photographs/{label}/recall"] > 0.4 > 0.1 > part["recall"]["value"]
    summary = summarize(folder)
    (_, scored, differences) = read_markdown(format_table([summary])).values()
    assert [row[0] for row in scored if row[0] in names] == names
    for row, part in zip(scored[-3:], ["", "apple/", "pear/"], strict=True):
        assert row[4].partition(" ")[0] == f"{scores[f'photographs/{part}auc']:.3f}"
    assert [row[0].rpartition(", ")[2] for row in differences[2:]] == ["label=apple", "label=pear"]
    page = write_report([folder], folder).read_text()
    assert page.count("<td>random, label=pear</td>") == 1 and "apple and pear, trained with renders" in page


def test_a_run_folder_holds_configuration_metrics_networks_renders_and_scores(finished):
    config = OmegaConf.load(finished / "config.yaml")
    assert config.hardware == {"device": "cpu", "precision": "float32", "threads": 1}
    assert set(config.versions) == {"python", "torch", "torchvision", "numpy"}
    last, best = (torch.load(finished / name, weights_only=True) for name in ("last.pt", "best.pt"))
    assert (last["epoch"], last["seed"], last["arm"], last["precision"]) == (3, 7, "adversarial", "float32")
    assert last["model"].keys() == best["model"].keys() and "optimizer" not in best
    renders = {path.name for path in (finished / "renders").glob("*.png")}
    attacks = {f"attacks_00{n}.png" for n in (1, 2, 3)}  # of epochs in which one succeeds
    assert renders - attacks == {f"epoch_00{n}.png" for n in (1, 2, 3)}
    assert {path.name for path in (finished / "photographs").iterdir()} == {
        "predictions.csv", "summary.json", "contact_sheet.png", "roc.csv", "roc.png"
    }  # fmt: skip
    assert not list(finished.glob("*.tmp")) and list(finished.glob("events.out.tfevents.*"))
    *epochs, scores = read_metrics(finished)
    assert [line["epoch"] for line in epochs] == [1, 2, 3]
    for line in epochs:
        assert {
            "train/loss", "train/accuracy", "train/learning_rate", "validation/loss", "validation/accuracy",
            "augment/attack_success_before", "augment/attack_success", "augment/steps", "augment/loss",
            "seconds/attack", "seconds/training", "seconds/evaluation", "seconds/input_output",
        } <= line.keys()  # fmt: skip
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    assert scores["photographs/auc"] == summary["auc"]["value"]
    assert scores["photographs/recall_at/0.10"] == summary["recall_at"]["0.10"]["value"]


def test_several_folders_of_photographs_are_scored_in_sub_folders_of_their_names(tiny, photos, tmp_path):
    named = f"evaluate.photos={{lab: {photos}, wild-1: {photos / 'orange'}}}"
    scores = completed_run(tiny("augment=none", "train.epochs=1", named), tmp_path / "run")
    assert scores == read_metrics(tmp_path / "run")[-1]
    for name in ("lab", "wild-1"):
        summary = json.loads((tmp_path / "run" / name / "summary.json").read_text())
        assert scores[f"{name}/recall"] == summary["recall"]["value"]
    assert "lab/auc" in scores and "wild-1/auc" not in scores  # a folder of oranges alone
    assert not (tmp_path / "run" / "photographs").exists()


def test_the_selected_network_is_the_best_on_validation_and_scored_once_after_the_last_epoch(tiny, tmp_path):
    data, looks = load_data(tiny()), []

    class GuardedData:
        classes, train, size = data.classes, data.train, data.size
        labeled, rendered = True, False

        @property
        def test(self):
            looks.append(checkpoint.load(tmp_path / checkpoint.LAST)["epoch"])
            return data.test

    completed_run(tiny("augment=none"), tmp_path, GuardedData())
    assert looks == [3]
    *epochs, scores = read_metrics(tmp_path)
    accuracies = [line["validation/accuracy"] for line in epochs]
    best = checkpoint.load(tmp_path / checkpoint.BEST)
    assert best["epoch"] == scores["test/epoch"] == accuracies.index(max(accuracies)) + 1
    network = load_run(tmp_path)
    logits = network(data.test.images / 255)
    assert scores["test/accuracy"] == pytest.approx((logits.argmax(1) == data.test.labels).double().mean().item())
    assert network.classes == ("apple", "orange", "pear") and network.size == 16


def test_a_folders_images_train_in_place_of_renders_and_a_resumed_run_shows_those_of_the_whole_one(
    tiny, tmp_path, regenerated
):
    rng, by_image = np.random.default_rng(0), {}
    for name, label in {"orange": 1, "apple": 0, "other_ball": complementary_label(1)}.items():
        (tmp_path / "lab" / name).mkdir(parents=True)
        for number in range(3):
            pixels = rng.integers(0, 256, (16, 16, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(tmp_path / "lab" / name / f"{number}.png")
            by_image[pixels.tobytes()] = label
    keys = [
        f"augment.folder={tmp_path / 'lab'}",
        "augment.warm_start=false",
        "train.resume=true",
        "train.ranking=1",
        "train.epochs=6",
    ]
    settings = tiny("augment=folder", *keys, "train.epochs=2", "augment.every=27", "augment.examples=4")
    completed_run(settings, tmp_path / "whole")
    shown, rounds = [], list(regenerated)
    for part in rounds:
        shown += [image.permute(1, 2, 0).numpy().tobytes() for image in part.images]
        assert [by_image[image] for image in shown[-4:]] == part.labels.tolist()
    assert len(rounds) == 4 and len(set(shown[:9])) == 9
    with pytest.raises(Interrupted):
        train_with_signal(settings, tmp_path / "stopped", 3, 1, signal.SIGTERM)
    completed_run(settings, tmp_path / "stopped")
    assert weights(tmp_path / "stopped") == weights(tmp_path / "whole")
    (tmp_path / "lab" / "apple" / "0.png").unlink()
    with pytest.raises(InputError, match=r"lab has changed since .*stopped began"):
        completed_run(settings, tmp_path / "stopped")
    (tmp_path / "lab" / "orange").rename(tmp_path / "lab" / "pear")
    with pytest.raises(InputError, match=r"^augment.folder: .*lab holds no image of label=orange"):
        completed_run(settings, tmp_path / "new")


def test_a_network_is_validated_on_images_that_the_one_it_began_with_left_out(tiny, finished, tmp_path, caplog):
    """Of 20 images per class a tenth, which lies within a fifth, is left out by its base, and so by all after it."""
    caplog.set_level("INFO", "train")
    stored = checkpoint.load(finished / checkpoint.BEST)
    unknown = tmp_path / "unknown.pt"
    checkpoint.save(unknown, stored | {"architecture": {**stored["architecture"], "validation": None}})
    keys = "augment=none", "train.epochs=1"
    completed_run(tiny(*keys, "data.validation=0.05"), tmp_path / "base")
    for name, init, asked, images, left_out, warned in [
        ("as its base", tmp_path / "base", "null", 3, 0.05, False),
        ("less", finished, "0.05", 3, 0.05, False),
        ("more", tmp_path / "base", "0.2", 12, 0.05, True),
        ("unknown", unknown, "null", 6, None, True),
    ]:
        caplog.clear()
        completed_run(tiny(*keys, f"train.init_from={init}", f"data.validation={asked}"), tmp_path / name)
        state = checkpoint.load(tmp_path / name / checkpoint.BEST)["architecture"]["validation"]
        assert (state and state["fraction"]) == left_out
        assert f"{60 - images} images, 3 classes" in caplog.text
        assert sum(line.startswith("validation: ") for line in caplog.messages) == warned
    assert load_run(unknown).classes == ("apple", "orange", "pear")


def test_rendered_solids_are_new_to_a_network_of_other_images_alone(tiny, finished):
    settings = tiny(f"train.init_from={finished}")
    initial = load_initial(settings)
    data = replace(load_data(settings), rendered=True)
    own = choose_validation(settings, data, initial).record
    initial.architecture["validation"] = own
    fewer = replace(data, train=data.train[:9])
    assert own and choose_validation(settings, data, initial).record == own
    assert choose_validation(settings, fewer, initial).record is None


def test_the_test_accuracy_says_how_many_classes_it_leaves_out(tiny):
    data = load_data(tiny())
    assert " 2 " in describe_test_images(tiny(), replace(data, classes=(*data.classes, "worm", "tulip")))


def test_the_network_begun_with_is_scored_on_the_same_images(tiny, finished, photos, tmp_path):
    keys = "train.epochs=1", "augment=none", f"train.init_from={finished}", f"evaluate.photos={photos}"
    scores = completed_run(tiny(*keys), tmp_path)
    assert scores["test/accuracy_before"] == pytest.approx(read_metrics(finished)[-1]["test/accuracy"])
    for file in ("predictions.csv", "summary.json"):
        base, before = (folder / "photographs" / file for folder in (finished, tmp_path / "before"))
        assert base.read_text() == before.read_text()
    assert summarize(tmp_path).before.accuracy == scores["test/accuracy_before"]


def test_statistics_are_those_of_the_network_begun_with_after_training_in_eval_mode(tiny, finished, tmp_path):
    completed_run(tiny("train.epochs=1", f"train.init_from={finished}", "train.eval_mode=true"), tmp_path)
    begun, trained = (checkpoint.load(folder / checkpoint.BEST)["model"] for folder in (finished, tmp_path))
    for name, value in trained.items():
        is_statistic = name.rpartition(".")[2] in ("running_mean", "running_var", "num_batches_tracked", "mean", "std")
        assert torch.equal(value, begun[name]) == is_statistic, name


def test_a_run_killed_within_its_first_epoch_goes_on_within_it_and_ends_the_same(tiny, tmp_path, monkeypatch):
    """A checkpoint after each step stands for one each minute; KeyboardInterrupt, which saves nothing, for the kill."""
    settings = tiny("train.epochs=2", "train.resume=true")
    completed_run(settings, tmp_path / "whole")
    with monkeypatch.context() as patch:
        patch.setattr(loop, "SAVING_EVERY", 0.0)
        patch.setattr(loop, "SAVING_SHARE", 1e9)

        def kill():
            raise KeyboardInterrupt

        act_at(patch, 0, 4, kill)
        with pytest.raises(KeyboardInterrupt):
            completed_run(settings, tmp_path / "killed")
    state = checkpoint.load(tmp_path / "killed" / checkpoint.LAST)
    assert (state["epoch"], state["under_way"]["step"]) == (0, 3)
    completed_run(settings, tmp_path / "killed")
    assert weights(tmp_path / "killed") == weights(tmp_path / "whole")
    assert metrics(tmp_path / "killed") == metrics(tmp_path / "whole")


def test_checkpoints_within_an_epoch_take_a_small_share_of_its_time(tmp_path, tiny, monkeypatch):
    """The clock of the test goes on by 10 s in each step, and by 3 s in each checkpoint: one in 150 s or more."""
    now, saved = [0.0], []
    save, requested = checkpoint.save, loop.Interruption.requested
    monkeypatch.setattr(loop.time, "perf_counter", lambda: now[0])

    def slow_save(*arguments):
        now[0] += 3
        saved.append(now[0])
        save(*arguments)

    def slow_step(self):
        now[0] += 10
        return requested(self)

    monkeypatch.setattr(checkpoint, "save", slow_save)
    monkeypatch.setattr(loop.Interruption, "requested", slow_step)
    completed_run(tiny("augment=none", "train.epochs=1", "train.batch_size=1", "train.accumulate=1"), tmp_path)
    *within, _, _ = saved  # the last two are best.pt and last.pt at the end
    assert len(within) >= 3 and within[0] <= 75
    assert all(later - earlier >= 150 for earlier, later in pairwise(within))


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda path, other: path.unlink(), id="missing"),
        pytest.param(lambda path, other: path.write_bytes(path.read_bytes()[:2000]), id="cut"),
        pytest.param(lambda path, other: path.write_bytes((other / "best.pt").read_bytes()), id="another run's"),
    ],
)
def test_a_missing_or_foreign_best_network_stops_a_resumed_run_before_it_trains(tiny, finished, tmp_path, spoil):
    """The other run differs in its seed alone."""
    completed_run(tiny("augment=none", "train.epochs=1", "seed=8"), tmp_path / "other")
    completed_run(tiny("augment=none", "train.epochs=1"), tmp_path / "run")
    spoil(tmp_path / "run" / "best.pt", tmp_path / "other")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
    settings = tiny("augment=none", "train.epochs=2", "train.resume=true")
    with pytest.raises(InputError, match=r"best\.pt is not the network that this run kept"):
        loaded_run(settings, tmp_path / "run")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before
