import json
import logging
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from train.run_folder.logs import METRICS, RunLog, console, read_metrics


def write_epochs(folder, epochs: range, history=()) -> None:
    log = RunLog(folder, history)
    for epoch in epochs:
        log.scalars({"train/loss": 1 / epoch, "validation/accuracy": 0.25}, epoch)


def test_each_epoch_is_one_line_of_json_and_the_final_scores_another(tmp_path):
    log = RunLog(tmp_path)
    log.scalars({"train/loss": 0.1 + 0.2}, epoch=1)
    first = (tmp_path / METRICS).read_text()  # at once, for whoever looks on
    log.scalars({"test/accuracy": 1.0})
    assert first == '{"epoch": 1, "train/loss": 0.30000000000000004}\n'
    lines = (tmp_path / METRICS).read_text().splitlines()
    assert [json.loads(line) for line in lines] == read_metrics(tmp_path)
    assert read_metrics(tmp_path) == [{"epoch": 1, "train/loss": 0.1 + 0.2}, {"test/accuracy": 1.0}]


def test_a_folder_without_metrics_has_no_lines(tmp_path):
    assert read_metrics(tmp_path) == []


@pytest.mark.parametrize("done", [0, 2, 3])
def test_resuming_keeps_the_epochs_of_the_checkpoint_alone(tmp_path, done):
    """Later lines come again, final scores too, and one that a crash cut short does not count."""
    write_epochs(tmp_path, range(1, 4))
    epochs = read_metrics(tmp_path)
    log = RunLog(tmp_path, epochs)
    log.scalars({"test/accuracy": 0.5})
    with open(tmp_path / METRICS, "a") as file:
        file.write('{"epoch": 3, "train/lo')
    assert len(read_metrics(tmp_path)) == 4
    write_epochs(tmp_path, range(done + 1, 4), epochs[:done])
    assert read_metrics(tmp_path) == epochs


def test_lines_that_a_file_has_lost_come_back_from_the_checkpoint(tmp_path):
    write_epochs(tmp_path, range(1, 4))
    epochs = read_metrics(tmp_path)
    (tmp_path / METRICS).write_text("")
    RunLog(tmp_path, epochs)
    assert read_metrics(tmp_path) == epochs


def test_tensorboard_reads_the_scalars_and_the_renders(tmp_path):
    renders = torch.rand(5, 3, 16, 16)
    log = RunLog(tmp_path)
    log.scalars({"train/loss": 0.5}, epoch=1)
    log.scalars({"train/loss": 0.25}, epoch=2)
    log.renders(renders, epoch=2)
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/loss")] == [(1, 0.5), (2, 0.25)]
    (image,) = events.Images("renders")
    png = image.encoded_image_string
    assert image.step == 2 and struct.unpack(">II", png[16:24]) == (image.width, image.height)
    with Image.open(tmp_path / "renders" / "epoch_002.png") as grid:
        pixels = np.asarray(grid)
    assert pixels.shape == (image.height, image.width, 3) == (18, 5 * 17 + 1, 3)
    for number, render in enumerate(renders):
        shown = pixels[1:17, 17 * number + 1 : 17 * number + 17]
        np.testing.assert_allclose(shown / 255, render.permute(1, 2, 0), atol=0.5 / 255 + 1e-6)


def test_a_clock_that_steps_back_loses_no_epoch(tmp_path, monkeypatch):
    hours = iter(range(10**6, 0, -3600))
    monkeypatch.setattr("train.run_folder.logs.time.time", lambda: float(next(hours)))
    write_epochs(tmp_path, range(1, 4))
    board = EventAccumulator(str(tmp_path)).Reload()
    assert [event.step for event in board.Scalars("train/loss")] == [1, 2, 3]
    assert [line["epoch"] for line in read_metrics(tmp_path)] == [1, 2, 3]


def test_tensorboard_shows_each_epoch_of_a_resumed_run_once(tmp_path):
    write_epochs(tmp_path, range(1, 4))
    write_epochs(tmp_path, range(2, 5), read_metrics(tmp_path)[:1])
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [event.step for event in events.Scalars("train/loss")] == [1, 2, 3, 4]


def test_tensorboard_shows_the_final_scores_of_a_run_that_is_scored_again_once(tmp_path):
    write_epochs(tmp_path, range(1, 4))
    epochs = read_metrics(tmp_path)
    for accuracy in (0.5, 0.25):
        RunLog(tmp_path, epochs).scalars({"test/accuracy": accuracy})
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("test/accuracy")] == [(4, 0.25)]


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


def test_a_pipe_in_the_place_of_the_metrics_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / METRICS)
    reader = os.open(tmp_path / METRICS, os.O_RDWR)  # so that this test fails, and does not hang
    RunLog(tmp_path, [{"epoch": 1}])
    os.close(reader)
    assert read_metrics(tmp_path) == [{"epoch": 1}]
