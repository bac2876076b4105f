import errno
import itertools
import json
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from augment.tasks.classification import complementary_label
from renderer.errors import InputError
from tests.helpers import save_noise
from tests.runs import completed_run, loaded_run
from tests.train.helpers import modification_times
from train import checkpoints, run_folder
from train.checkpoints import load_run
from train.command_settings import LabSettings
from train.data import batches
from train.data.sets import Split, content_hash
from train.device import Interrupted
from train.results.overwrite import remove_run
from train.results.store import is_finished, summarize
from train.run_folder import read_metrics
from train.system import user_message
from train.training import loop
from train.training.inputs import choose_validation, load_data, load_initial
from train.training.run_log import RunLog, epoch_metrics

WITHOUT_RENDERS = ("augment=none", "train.epochs=1")


@pytest.fixture(autouse=True)
def no_figure(monkeypatch) -> None:
    monkeypatch.setattr("train.results.scoring.write_roc", lambda *_: None)


def weight_hashes(folder: Path) -> list[str]:
    names = (run_folder.LAST, run_folder.BEST)
    return [content_hash(checkpoints.load(folder / name)["model"]) for name in names]


def metrics(folder: Path) -> list[dict]:
    lines = read_metrics(folder)
    return [{name: line[name] for name in line if name[:8] != "seconds/"} for line in lines]


def act_at(monkeypatch, round_number: int, step: int, act: Callable[[], None]) -> None:
    def acting(split, renders, batch_size, seed, now, *options):
        shown = batches.training_batches(split, renders, batch_size, seed, now, *options)
        for number, batch in enumerate(shown, 1):
            if (now.number, number) == (round_number, step):
                act()
            yield batch

    monkeypatch.setattr(loop, "training_batches", acting)


def train_with_signal(settings, folder: Path, round_number, step, number) -> None:
    with pytest.MonkeyPatch.context() as patch:
        act_at(patch, round_number, step, lambda: signal.raise_signal(number))
        completed_run(settings, folder)


@pytest.fixture
def renders_of_rounds(monkeypatch) -> list[Split]:
    renders = []

    def recorded(split, shown, *options):
        renders.append(shown)
        return batches.training_batches(split, shown, *options)

    monkeypatch.setattr(loop, "training_batches", recorded)
    return renders


HANDLED_SIGNALS = (signal.SIGTERM, signal.SIGINT)


@pytest.mark.parametrize(
    ("number", "average"),
    [
        (signal.SIGTERM, "train.ema_decay=0.8"),
        pytest.param(signal.SIGINT, "train.soup=true", marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_signal_ends_a_run_after_the_step_and_resuming_ends_as_if_it_had_not_come(
    tiny, finished, tmp_path, number, average
):
    """Epochs have rounds of 2, 2 and 1 steps, through which lights, dropout and teacher go on."""
    rounds = ("augment.regenerate_every=16", "train.images_per_epoch=38")
    teacher = ("train.distillation_weight=2", f"network={finished}")
    settings = tiny("train.epochs=2", "train.resume=true", *rounds, *teacher, average)
    whole = tmp_path / "whole"
    stopped = tmp_path / "stopped"
    completed_run(settings, whole)

    # Round and step at which a signal comes, and epochs and steps in the checkpoint then.
    for round_number, step, epoch, steps in ((1, 2, 0, 4), (2, 1, 1, None), (4, 1, 1, 3)):
        handlers = [signal.getsignal(name) for name in HANDLED_SIGNALS]
        with pytest.raises(Interrupted) as stop:
            train_with_signal(settings, stopped, round_number, step, number)
        assert (stop.value.code, stop.value.signal) == (128 + number, number.name)
        assert [signal.getsignal(name) for name in HANDLED_SIGNALS] == handlers
        state = checkpoints.load(stopped / run_folder.LAST)
        assert state["epoch"] == epoch
        assert (state["under_way"] and state["under_way"]["step"]) == steps

    torch.manual_seed(17)  # The run does not depend on the global random stream.
    completed_run(settings, stopped)
    assert weight_hashes(stopped) == weight_hashes(whole)
    assert metrics(stopped) == metrics(whole)
    picture = Path("renders", "epoch_002.png")
    assert (stopped / picture).read_bytes() == (whole / picture).read_bytes()


def test_the_signal_of_a_batch_system_writes_a_checkpoint_before_its_handler_acts(tiny, tmp_path):
    epochs = []

    def requeue(number, frame):
        epochs.append(checkpoints.load(tmp_path / run_folder.LAST)["epoch"])
        raise SystemExit(-1)

    before = signal.signal(signal.SIGUSR2, requeue)
    try:
        with pytest.raises(SystemExit) as stopped:
            train_with_signal(tiny("augment=none"), tmp_path, 1, 2, signal.SIGUSR2)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert stopped.value.code == -1
    assert epochs == [1]
    assert checkpoints.load(tmp_path / run_folder.LAST)["under_way"]["step"] == 2


def test_a_second_signal_acts_at_once(tiny, tmp_path, monkeypatch):
    def interrupt_twice() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    act_at(monkeypatch, 0, 1, interrupt_twice)
    with pytest.raises(KeyboardInterrupt):
        completed_run(tiny("augment=none"), tmp_path)
    assert not checkpoints.exists(tmp_path)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [("", "train.resume=true .* overwrite=true"), ("train.resume=true seed=8", "seed=7, not 8")],
)
def test_no_run_is_written_over_or_resumed_with_other_settings(tiny, finished, overrides, message):
    before = modification_times(finished)
    with pytest.raises(InputError, match=message):
        loaded_run(tiny(*overrides.split()), finished)
    assert modification_times(finished) == before


class TestARunThatReplacesAnother:
    """A run that is killed leaves nothing of the earlier run that its resumption would take."""

    @pytest.mark.slow
    def test_renders_once_if_resumed_and_anew_if_changed(self, tiny, tmp_path, photos, monkeypatch):
        """Photographs take the place of the renders kept aside."""
        setups = []

        def write(settings: LabSettings) -> None:
            setups.append(settings.setups)
            shutil.copytree(photos, settings.out, dirs_exist_ok=True)
            (Path(settings.out) / "lab.json").write_text(json.dumps(asdict(settings)))

        monkeypatch.setattr("train.training.run.write_laboratory", write)
        rendered = (*WITHOUT_RENDERS, "train.resume=true")
        for count in (5, 5, 10):
            completed_run(tiny(*rendered, f"evaluate.laboratory_setups={count}"), tmp_path)
        assert setups == [5, 10]

    @pytest.mark.parametrize("kept", range(12))
    def test_removes_an_earlier_run_or_leaves_it_as_configured(self, tmp_path, monkeypatch, kept):
        names = ["metrics.jsonl", "last.pt", "best.pt", "report.html", "photographs/summary.json"]
        names += ["before/summary.json", "kept_aside/lab.json", "random/metrics.jsonl"]
        for name in names:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text('{"test/accuracy": 1}\n')
        (tmp_path / "config.yaml").write_text("train: {}\ncompare: [random]\n")
        (tmp_path / "random" / "config.yaml").write_text("train: {}\n")
        (tmp_path / "mine.txt").touch()
        steps = itertools.count()

        def counted(function: Callable[..., None]) -> Callable[..., None]:
            def call(path: Path, **options: bool) -> None:
                if path.exists() and next(steps) == kept:
                    raise KeyboardInterrupt
                function(path, **options)

            return call

        monkeypatch.setattr(Path, "unlink", counted(Path.unlink))
        monkeypatch.setattr(shutil, "rmtree", counted(shutil.rmtree))
        with suppress(KeyboardInterrupt):
            remove_run(tmp_path)
        left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")}
        assert is_finished(tmp_path) == (kept == 0)
        assert left == {"mine.txt"} or "config.yaml" in left
        assert (left == {"mine.txt"}) == (next(steps) <= kept)


@pytest.mark.slow
def test_a_resumed_run_has_its_recorded_threads_unless_given_others(tiny, tmp_path, monkeypatch):
    before = torch.get_num_threads()
    try:
        for chosen, threads, expected in ((2, "null", 2), (1, "null", 2), (1, "3", 3)):
            monkeypatch.setattr("train.training.run.choose_threads", lambda *_, n=chosen: n)
            keys = (f"train.threads={threads}", f"train.resume={str(chosen == 1).lower()}")
            settings = tiny(*WITHOUT_RENDERS, "train.images_per_epoch=16", *keys)
            run = loaded_run(settings, tmp_path)
            torch.set_num_threads(1)
            run.train()
            assert torch.get_num_threads() == expected
            assert OmegaConf.load(tmp_path / "config.yaml").hardware.threads == expected
    finally:
        torch.set_num_threads(before)


TENSORBOARD_APPEND = "tensorboard.compat.tensorflow_stub.io.gfile.LocalFileSystem.append"


# The thread of TensorBoard raises the error, too.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("writer", [TENSORBOARD_APPEND, "renderer.io.files.os.fsync"])
def test_a_full_disk_is_one_error_for_each_writer_and_a_run_can_be_resumed(tiny, tmp_path, writer):
    settings = tiny(*WITHOUT_RENDERS, "train.resume=true")
    full_disk = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, Mock(side_effect=full_disk))
        with pytest.raises(OSError) as raised:
            completed_run(settings, tmp_path)
    assert "(No space left on device)" in user_message(raised.value)
    completed_run(settings, tmp_path)
    assert len(read_metrics(tmp_path)) == 2


def test_arms_with_and_without_renders_draw_the_same_in_training(tiny, tmp_path):
    completed_run(tiny(*WITHOUT_RENDERS), tmp_path / "none")
    completed_run(tiny("train.epochs=1", "augment.examples=0"), tmp_path / "empty")
    assert weight_hashes(tmp_path / "empty") == weight_hashes(tmp_path / "none")
    assert not (tmp_path / "none" / "renders").exists()


APPLE, ORANGE, PEAR = range(3)


def test_meshes_and_negatives_are_rendered_with_their_own_labels(tiny, tmp_path, renders_of_rounds):
    """A hard negative without a class has the complementary label."""
    meshes = "meshes=[{mesh: 'solid:pear', label: pear}, 'solid:orange']"
    negatives = "hard_negatives=['solid:fruit', {mesh: 'solid:apple:2', label: apple}]"
    completed_run(tiny("train.epochs=1", meshes, negatives, "augment.examples=16"), tmp_path)
    (renders,) = renders_of_rounds
    labels = [PEAR, ORANGE, complementary_label(ORANGE), APPLE]
    assert renders.labels.tolist() == np.repeat(labels, 4).tolist()
    assert len(renders.images.unique(dim=0)) == 16


def test_folders_of_photographs_are_scored_for_each_class_with_a_folder(tiny, photos, tmp_path):
    (tmp_path / "oranges").mkdir()
    (tmp_path / "oranges/orange").symlink_to(photos / "orange")
    named = f"photos={{lab: {photos}, wild-1: {tmp_path / 'oranges'}}}"
    run = tmp_path / "run"
    scores = completed_run(tiny(*WITHOUT_RENDERS, "label=null", named), run)
    assert scores == read_metrics(run)[-1]
    summaries = {}
    for name in ("lab", "wild-1"):
        summaries[name] = json.loads((run / name / "summary.json").read_text())
        assert scores[f"{name}/recall"] == summaries[name]["recall"]["value"]
    assert summaries["lab"]["label"] == ["apple", "orange"]
    assert "lab/auc" in scores
    assert "wild-1/auc" not in scores  # The folder has oranges alone.
    assert not (run / "photographs").exists()


@pytest.mark.parametrize(
    ("source", "scored", "is_warned"),
    [
        ("unlabeled={}/train", "train", True),
        ("unlabeled={}/train", "link", True),
        ("unlabeled={}/train/orange", "train", True),
        ("unlabeled={}", "test", True),
        ("unlabeled={}/train", "test", False),
        ("data.path={}", "train", True),
        ("data.path={}", "test", False),
        ("data.path={}/test", "test", True),
    ],
)
def test_a_run_warns_if_it_would_score_images_that_it_trains_on(
    tiny, finished, tmp_path, caplog, source, scored, is_warned
):
    images = tmp_path / "images"
    rng = np.random.default_rng(0)
    for split, name in itertools.product(("train", "test"), ("apple", "orange", "pear")):
        for number in range(3):
            save_noise(images / split / name / f"{number}.png", rng, (16, 16))
    (images / "link").symlink_to(images / "train")
    options = source.format(images), f"photos={images / scored}", f"network={finished}"
    recipe = "train.distillation_weight=1", "data.test_fraction=0.3", "size=16", "label=orange"
    name = "folder" if source.startswith("data") else "unlabeled"
    loaded_run(tiny(f"data={name}", *options, *recipe, *WITHOUT_RENDERS), tmp_path / "run")
    assert ("which is trained on" in caplog.text) == is_warned


@pytest.mark.parametrize(
    "source", ["data.path={}", "unlabeled={}", "unlabeled={0}/apple,augment.vary.backgrounds={0}"]
)
def test_no_run_lies_among_the_images_that_it_trains_on(tiny, finished, tmp_path, source):
    rng = np.random.default_rng(0)
    for name, number in itertools.product(("apple", "orange"), range(3)):
        save_noise(tmp_path / name / f"{number}.png", rng, (16, 16))
    options = *source.format(tmp_path).split(","), f"network={finished}", "data.test_fraction=0.4"
    recipe = "size=16", "train.distillation_weight=1", *WITHOUT_RENDERS
    name = "folder" if source.startswith("data") else "unlabeled"
    settings = tiny(f"data={name}", *options, *recipe)
    with pytest.raises(InputError, match="lies inside"):
        loaded_run(settings, tmp_path / "run")


def test_a_damaged_file_is_replaced_by_a_trained_or_a_held_out_one_as_it_is_itself(
    tiny, finished, tmp_path, monkeypatch
):
    """The level of gray of an image tells its file."""
    monkeypatch.setattr("train.data.sets.MAX_SIZE_IN_MEMORY", 0)
    (tmp_path / "images").mkdir()
    for level in range(40):
        Image.new("L", (16, 16), level).save(tmp_path / "images" / f"{level:02}.png")
    source = "data=unlabeled", f"unlabeled={tmp_path / 'images'}", f"network={finished}"
    options = "evaluate.skip_unreadable=true", "data.workers=0", "train.distillation_weight=1"
    run = loaded_run(tiny(*source, *options, *WITHOUT_RENDERS), tmp_path / "run")
    levels = torch.tensor([int(path.stem) for path in run.data.train.images.paths])
    is_last = run.held_out[:-1] != run.held_out[1:]  # The next file is of the other part.
    for level in levels[:-1][is_last].tolist():
        (tmp_path / "images" / f"{level:02}.png").write_bytes(b"damaged")
    shown = {True: [], False: []}  # Levels by whether they validate.

    def recorded_batches(*options):
        for batch in batches.training_batches(*options):
            shown[False] += batch[0][:, 0, 0, 0].tolist()
            yield batch

    def recorded_evaluate(model, split):
        shown[True] += split.sample(len(split))[:, 0, 0, 0].tolist()
        return evaluate(model, split)

    evaluate = loop.evaluate
    monkeypatch.setattr(loop, "training_batches", recorded_batches)
    monkeypatch.setattr(loop, "evaluate", recorded_evaluate)
    run.train()
    for validates, found in shown.items():
        assert found
        assert not {*found} & {*levels[run.held_out != validates].tolist()}


def test_the_network_best_on_validation_is_scored_once_after_the_last_epoch(tiny, tmp_path):
    data = load_data(tiny())
    epochs_of_looks = []

    class GuardedData(SimpleNamespace):
        @property
        def test(self):
            epochs_of_looks.append(checkpoints.load(tmp_path / run_folder.LAST)["epoch"])
            return data.test

    guarded = GuardedData(
        classes=data.classes, train=data.train, size=data.size, labeled=True, rendered=False
    )
    scores = completed_run(tiny("augment=none"), tmp_path, guarded)
    assert epochs_of_looks == [3]

    accuracies = [line["validation/accuracy"] for line in read_metrics(tmp_path)[:-1]]
    best_epoch = accuracies.index(max(accuracies)) + 1
    assert scores["test/epoch"] == best_epoch
    assert checkpoints.load(tmp_path / run_folder.BEST)["epoch"] == best_epoch
    is_correct = load_run(tmp_path)(data.test.images / 255).argmax(1) == data.test.labels
    assert scores["test/accuracy"] == pytest.approx(is_correct.double().mean().item())


@pytest.mark.parametrize("positive", ["orange", ORANGE])
def test_a_folder_of_renders_is_shown_in_turn_with_its_labels(
    tiny, tmp_path, renders_of_rounds, positive
):
    """Two epochs of two rounds each show 4 of 9 images."""
    rng = np.random.default_rng(0)
    label_of_image = {}
    labels = {"orange": ORANGE, "apple": APPLE, "other_ball": complementary_label(ORANGE)}
    for (name, label), number in itertools.product(labels.items(), range(3)):
        path = tmp_path / "lab" / name / f"{number}.png"
        save_noise(path, rng, (16, 16))
        label_of_image[np.asarray(Image.open(path)).tobytes()] = label
    folder = ("augment=folder", f"augment.folder={tmp_path / 'lab'}", "augment.examples=4")
    rounds = ("augment.warm_start=false", "augment.regenerate_every=27", "train.epochs=2")
    ranked = (f"label={positive}", "train.ranking_weight=1")
    completed_run(tiny(*folder, *rounds, *ranked), tmp_path / "run")
    assert len(renders_of_rounds) == 4
    shown = []
    for renders in renders_of_rounds:
        images = [image.permute(1, 2, 0).numpy().tobytes() for image in renders.images]
        assert [label_of_image[image] for image in images] == renders.labels.tolist()
        shown += images
    assert len(set(shown[:9])) == 9


@pytest.mark.parametrize(
    ("left_out", "asked", "fraction", "recorded", "is_warned"),
    [
        (0.05, "null", 0.05, 0.05, False),
        (0.1, "0.05", 0.05, 0.05, False),
        (0.05, "0.2", 0.2, 0.05, True),
        (None, "null", 0.1, None, True),
    ],
)
def test_validation_images_are_those_that_the_initial_network_left_out_or_the_run_warns(
    tiny, finished, caplog, left_out, asked, fraction, recorded, is_warned
):
    """`left_out` is None for a network that does not say which images it left out."""
    settings = tiny(*WITHOUT_RENDERS, f"network={finished}", f"data.validation={asked}")
    data = load_data(settings)
    initial = load_initial(settings)
    record = initial.architecture["validation"] | {"fraction": left_out}
    initial.architecture["validation"] = record if left_out else None
    with caplog.at_level("DEBUG", "train"):
        chosen, record = choose_validation(settings, data, initial)
    assert chosen == fraction
    assert (record or {}).get("fraction") == recorded
    assert any(line.startswith("validation: ") for line in caplog.messages) == is_warned


def test_rendered_solids_are_new_to_a_network_of_other_images_alone(tiny, finished):
    settings = tiny(f"network={finished}")
    initial = load_initial(settings)
    data = replace(load_data(settings), rendered=True)
    _, record = choose_validation(settings, data, initial)
    assert record
    initial.architecture["validation"] = record
    fewer = replace(data, train=data.train[:9])
    assert choose_validation(settings, data, initial)[1] == record
    assert choose_validation(settings, fewer, initial)[1] is None


def test_the_initial_network_is_scored_on_the_same_images(tiny, finished, photos, tmp_path):
    files = f"network={finished}", f"photos={photos}"
    scores = completed_run(tiny(*WITHOUT_RENDERS, *files), tmp_path)
    accuracy = read_metrics(finished)[-1]["test/accuracy"]
    assert scores["test/accuracy_before"] == pytest.approx(accuracy)
    assert summarize(tmp_path).before.accuracy == scores["test/accuracy_before"]
    for file in ("predictions.csv", "summary.json"):
        before = tmp_path / "before" / "photographs" / file
        assert before.read_text() == (finished / "photographs" / file).read_text()


def test_a_run_killed_in_its_first_epoch_goes_on_to_the_same_end(tiny, tmp_path, monkeypatch):
    """After KeyboardInterrupt nothing is saved, as after a kill."""
    settings = tiny(*WITHOUT_RENDERS, "train.resume=true")
    completed_run(settings, tmp_path / "whole")
    killed = tmp_path / "killed"
    with monkeypatch.context() as patch:
        # Save after each step instead of each minute.
        patch.setattr(loop, "SAVING_EVERY", 0.0)
        patch.setattr(loop, "SAVING_SHARE", 1e9)
        act_at(patch, 0, 4, Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            completed_run(settings, killed)
    state = checkpoints.load(killed / run_folder.LAST)
    assert state["epoch"] == 0
    assert state["under_way"]["step"] == 3

    completed_run(settings, killed)
    assert weight_hashes(killed) == weight_hashes(tmp_path / "whole")
    assert metrics(killed) == metrics(tmp_path / "whole")


def test_a_resumed_run_is_stopped_without_its_best_network_before_it_writes(tiny, tmp_path):
    run = tmp_path / "run"
    completed_run(tiny(*WITHOUT_RENDERS), run)
    (run / run_folder.BEST).unlink()
    before = modification_times(run)
    settings = tiny("augment=none", "train.epochs=2", "train.resume=true")
    with pytest.raises(InputError, match=r"best\.pt"):
        loaded_run(settings, run)
    assert modification_times(run) == before


def test_a_resumed_run_has_no_scores_of_its_earlier_network(tiny, finished, photos, tmp_path):
    started = f"network={finished}", "augment=none"
    completed_run(tiny(*started, "train.epochs=1", f"photos={{a: {photos}}}"), tmp_path)
    resumed = "train.epochs=2", "train.resume=true", f"photos={{c: {photos}}}"
    completed_run(tiny(*started, *resumed), tmp_path)
    run = summarize(tmp_path)
    assert {*run.photographs} == {"c"}
    assert {*run.before.photographs} >= {"a"}  # The initial network is the same as before.


def test_a_logger_gets_the_metrics_of_each_epoch_in_place_of_tensorboard(tmp_path):
    lines = []
    recorder = SimpleNamespace(log=lambda values, step: lines.append((step, dict(values))))
    log = RunLog(tmp_path, logger=recorder)
    log.scalars({"loss": 2.0}, 1)
    log.renders(torch.zeros(1, 3, 8, 8), 1)
    log.scalars({"loss": 1.0}, 2)
    log.scalars({"accuracy": 0.5}, 3, is_final=True)
    assert lines == [(1, {"loss": 2.0}), (2, {"loss": 1.0}), (3, {"accuracy": 0.5})]
    assert len(read_metrics(tmp_path)) == 3
    assert not list(tmp_path.glob("events.out*"))


@pytest.mark.parametrize("order", [1, -1])
def test_means_over_rounds_leave_out_rounds_without_a_visible_object(order):
    rounds = [{"light_change": 1.0}, {"light_change": 3.0, "loss": 0.5}][::order]
    found = epoch_metrics({}, {}, rounds, {})
    assert (found["augment/light_change"], found["augment/loss"]) == (2.0, 0.5)
