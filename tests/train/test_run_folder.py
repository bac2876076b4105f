"""A run's folder, also where others write to it or have damaged its files."""

import logging
import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from renderer.errors import InputError
from train import console
from train.configuration import compose, read_settings
from train.report.compare import format_comparison
from train.report.summary import summarize
from train.run_folder import (
    CONFIG,
    LOCK,
    METRICS,
    RunLog,
    decisive_settings,
    fingerprints,
    read_config,
    read_metrics,
    read_numbers,
    require_same_inputs,
    require_same_settings,
    sole_writer,
    write_config,
)
from train.settings import ExperimentSettings


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A copy of a finished run's folder, to be damaged."""
    return shutil.copytree(finished, tmp_path / "run")


def test_a_folder_has_one_writer_at_a_time_and_all_are_held_or_none(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    refused = pytest.raises(InputError, match=rf"run={b} is being written by another process")
    with sole_writer("run", b), refused, sole_writer("run", a, b):
        pass
    for folder in (a, b):
        FileLock(folder / LOCK).acquire(blocking=False)


# ------------------------------------------------------------------------------------ config.yaml


def test_a_configuration_is_read_as_it_was_written_and_trains_the_same_run(tiny, tmp_path):
    settings = tiny("train.learning_rate=3e-7", "label=pear", "+data.images=null", "scene.lamps={power: 3}")
    write_config(tmp_path, settings, precision="bfloat16")
    config = read_config(tmp_path / CONFIG)
    assert config.pop("precision") == "bfloat16"
    assert config.pop("versions").torch == torch.__version__ and config.pop("inputs").keys() == {settings.data.path}
    assert read_settings(ExperimentSettings, config) == settings


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{n + 1}: &a{n + 1} [{', '.join(9 * [f'*a{n}'])}]\n" for n in range(9))


@pytest.mark.parametrize(
    "content",
    [b"", b"seed", b"- 1", b"a: [", b"\xff\xfe", b"seed: ???", b"[" * 5000, BOMB.encode(), b"#" * 2**21, b"{}",
     b"!!python/object/apply:os.system [touch hacked]", b"seed: 1", b"a: ${oc.env:HOME}"],
    ids=["empty", "word", "list", "cut", "utf-16", "unset", "deep", "bomb", "large", "none", "code", "few", "variable"],
)  # fmt: skip
def test_a_damaged_configuration_is_one_sentence_that_names_its_folder(run, content):
    (run / CONFIG).write_bytes(content)
    with pytest.raises(InputError, match=rf"^{run}[^\n]*config\.yaml[^\n]*$"):
        summarize(run)


def test_folders_that_begin_in_the_same_second_have_different_names():
    for name, key in (("train", "run"), ("attack", "out")):
        assert compose(name)[key] != compose(name)[key]


# ------------------------------------------------------------------------------------ resuming


def test_all_settings_but_the_circumstances_decide_a_result(tiny):
    def settings(*overrides):
        return decisive_settings(tiny("+data.images=${run}/images", *overrides))

    here = settings("run=here")
    assert here["data.images"] == "<run>/images" and here["augment.attack.max_steps"] == 3
    assert settings("run=there/a", "sweep=x", "train.resume=true", "renderer.cache=null", "compare=[none]") == here
    changed = settings("run=here", "train.epochs=4")
    assert {key for key in here if here[key] != changed[key]} == {"train.epochs"} and changed.keys() == here.keys()


def test_a_run_resumes_for_more_epochs_and_under_other_circumstances_only(tiny, photos, finished):
    for changes in (["train.epochs=4"], ["train.threads=1", "renderer.cache=null"], ["evaluate.skip_unreadable=true"]):
        require_same_settings(finished, tiny(*changes))
    for change, key in [("seed=8", "seed"), ("augment=none", "augment.arm"), ("train.epochs=2", "train.epochs")]:
        with pytest.raises(InputError, match=rf"was trained with {key}=\w+, not \w+: give the settings of"):
            require_same_settings(finished, tiny(change))
    with pytest.raises(InputError, match=r"was trained with train.epochs=3, not 4"):
        require_same_settings(finished, tiny("train.epochs=4", f"evaluate.photos={photos}"), finished=True)


@pytest.mark.parametrize(
    "override",
    [
        "scene.meshes=[{}]",
        "scene.hard_negatives=[{{mesh: {}, label: apple}}]",
        "scene.meshes=[{{mesh: solid:orange, props: [{{mesh: {}, at: [1, 1]}}]}}]",
        "scene.light={}",
        "scene.backgrounds=[0.5,{}]",
        "augment.vary.environments=[{}]",
        "data.path={}",
    ],
)
def test_an_input_that_changed_is_refused_by_name(tiny, tmp_path, override):
    file, folder = tmp_path / "input.bin", tmp_path / "run"
    file.write_bytes(b"one")
    settings = tiny(override.format(file), "augment.examples=null", "scene.views=1")
    write_config(folder, settings)
    require_same_inputs(folder, settings)
    file.write_bytes(b"two")
    with pytest.raises(InputError, match=rf"{file} has changed since {folder} began: put it back"):
        require_same_inputs(folder, settings)


def test_a_folder_that_changed_has_another_fingerprint(tiny, tmp_path):
    (tmp_path / "apple").mkdir()
    settings, hashes = tiny(f"data.path={tmp_path}"), set()
    for name in ("apple/0.png", "apple/1.png"):
        hashes.add(fingerprints(settings)[str(tmp_path)])
        (tmp_path / name).write_bytes(name.encode())
    assert len(hashes | {fingerprints(settings)[str(tmp_path)]}) == 3


# ------------------------------------------------------------------------------------ metrics


@pytest.mark.parametrize(
    "content",
    [b"{\n", b"\xff\n", b"[1]\n", b'"x"\n', b"[" * 100_000 + b"\n", b'{"test/accuracy": "high"}\n', b"null\n",
     b'{"test/accuracy": 0.5}\n', b'{"seconds/attack": {}}\n', b"{}\n"],
)  # fmt: skip
def test_damaged_metrics_are_one_sentence_that_names_them(run, content):
    (run / METRICS).write_bytes(content)
    with pytest.raises(InputError, match=rf"^{run}[^\n]*metrics\.jsonl[^\n]*$"):
        summarize(run)


@pytest.mark.parametrize("content", ["", "[]", '{"recall": 1}', '{"recall": {"value": 0.5}}', "\ud800"])
def test_a_damaged_summary_of_photographs_is_one_sentence_that_names_it(run, content):
    (run / "photographs" / "summary.json").write_bytes(content.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError, match=rf"^{run}[^\n]*summary\.json[^\n]*$"):
        format_comparison([summarize(run)], [])


def test_a_last_line_that_was_cut_short_is_skipped(tmp_path):
    (tmp_path / "lines").write_text('{"epoch": 1}\n{"epo')
    assert read_numbers(tmp_path / "lines") == [{"epoch": 1}]
    assert read_metrics(tmp_path) == []  # without a file


def write_epochs(folder: Path, epochs: range, history=()) -> None:
    log = RunLog(folder, history)
    for epoch in epochs:
        log.scalars({"train/loss": 1 / epoch, "validation/accuracy": 0.25}, epoch)


def test_each_epoch_is_one_line_of_json_at_once_and_the_final_scores_another(tmp_path):
    log = RunLog(tmp_path)
    log.scalars({"train/loss": 0.1 + 0.2}, epoch=1)
    assert (tmp_path / METRICS).read_text() == '{"epoch": 1, "train/loss": 0.30000000000000004}\n'
    log.scalars({"test/accuracy": 1.0})
    assert read_metrics(tmp_path) == [{"epoch": 1, "train/loss": 0.1 + 0.2}, {"test/accuracy": 1.0}]


@pytest.mark.parametrize("done", [0, 2, 3])
def test_resuming_keeps_the_epochs_of_the_checkpoint_alone(tmp_path, done):
    """Later lines are written again, final scores too; a line cut short and lines that were lost come back."""
    write_epochs(tmp_path, range(1, 4))
    epochs = read_metrics(tmp_path)
    RunLog(tmp_path, epochs).scalars({"test/accuracy": 0.5})
    with open(tmp_path / METRICS, "a") as file:
        file.write('{"epoch": 3, "train/lo')
    if done == 2:
        (tmp_path / METRICS).write_text("")
    write_epochs(tmp_path, range(done + 1, 4), epochs[:done])
    assert read_metrics(tmp_path) == epochs
    board = EventAccumulator(str(tmp_path)).Reload()
    assert [event.step for event in board.Scalars("train/loss")] == [1, 2, 3]


def test_tensorboard_shows_the_final_scores_of_a_run_that_is_scored_again_once(tmp_path):
    write_epochs(tmp_path, range(1, 4))
    epochs = read_metrics(tmp_path)
    for accuracy in (0.5, 0.25):
        RunLog(tmp_path, epochs).scalars({"test/accuracy": accuracy})
    board = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in board.Scalars("test/accuracy")] == [(4, 0.25)]


def test_tensorboard_reads_the_scalars_and_the_renders(tmp_path):
    renders = torch.rand(5, 3, 16, 16)
    log = RunLog(tmp_path)
    log.scalars({"train/loss": 0.5}, epoch=1)
    log.scalars({"train/loss": 0.25}, epoch=2)
    log.renders(renders, epoch=2)
    board = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in board.Scalars("train/loss")] == [(1, 0.5), (2, 0.25)]
    (image,) = board.Images("renders")
    assert image.step == 2 and struct.unpack(">II", image.encoded_image_string[16:24]) == (image.width, image.height)
    with Image.open(tmp_path / "renders" / "epoch_002.png") as grid:
        pixels = np.asarray(grid)
    assert pixels.shape == (image.height, image.width, 3) == (18, 5 * 17 + 1, 3)
    for number, render in enumerate(renders):
        tile = pixels[1:17, 17 * number + 1 : 17 * number + 17]
        np.testing.assert_allclose(tile / 255, render.permute(1, 2, 0), atol=0.5 / 255 + 1e-6)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_console_line_that_finds_no_room_is_lost_and_nothing_else(capsys):
    handler = logging.StreamHandler(open("/dev/full", "w"))  # noqa: SIM115 (closing it fails, too)
    console.addHandler(handler)
    try:
        console.warning("a line")
    finally:
        console.removeHandler(handler)
        with pytest.raises(OSError, match="No space left"):
            handler.stream.close()
    assert capsys.readouterr() == ("", "")


def test_a_pipe_in_place_of_the_metrics_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / METRICS)
    reader = os.open(tmp_path / METRICS, os.O_RDWR)  # so that this test fails rather than hangs
    RunLog(tmp_path, [{"epoch": 1}])
    os.close(reader)
    assert read_metrics(tmp_path) == [{"epoch": 1}]
