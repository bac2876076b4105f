"""Every file that comes from outside, damaged at random: it is used, or refused in one sentence that names it."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from renderer.errors import InputError
from renderer.io.lights import save_light
from renderer.light.environment import read_map, write_map
from renderer.light.presets import load_light, probe
from train.checkpoint import BEST, save
from train.data import load_npz
from train.networks import PUBLISHED, WideResNet, describe, load_run, publish
from train.photographs.folder import Photograph, find_photographs, load_photographs
from train.photographs.predictions import PREDICTIONS, Prediction, read_predictions, write_predictions
from train.run_folder import read_config, read_json, read_numbers

CLASSES = ["fig", "lime"]


def write_npz(path: Path) -> None:
    images, labels = np.zeros((2, 3, 8, 8), dtype=np.uint8), np.array([0, 1])
    np.savez(
        path,
        train_images=images,
        train_labels=labels,
        test_images=images,
        test_labels=labels,
        classes=np.array(CLASSES),
    )


def network_state() -> dict:
    torch.manual_seed(0)
    network = WideResNet(2, 10, 1, 0.0)
    architecture = describe(network, CLASSES, 8, "srgb", depth=10, width=1, dropout=0.0)
    return {"model": network.state_dict(), "architecture": architecture}


def write_scores(path: Path) -> None:
    item = Prediction(Photograph(PurePosixPath("a.png"), "fig", "web"), "fig", 0.5, 0.5, 1, 0.5, 1, 0.0)
    write_predictions(path, [item], "fig")


def write_table(path: Path) -> None:
    Image.new("RGB", (4, 4)).save(path.with_name("a.png"))
    path.write_text("path,source_tag\na.png,web\n")


def read_photographs(path: Path) -> None:
    load_photographs(path.parent, find_photographs(path.parent, CLASSES, "fig"), 8)


@dataclass(frozen=True)
class Door:
    """A file's name, what makes a good one, and who reads it."""

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], object]


DOORS = [
    Door("map.npy", lambda path: write_map(path, torch.ones(8, 16, 3)), read_map),
    Door("map.hdr", lambda path: write_map(path, torch.ones(8, 16, 3)), read_map),
    Door("light.npy", lambda path: write_map(path, torch.ones(8, 16, 3)), lambda path: load_light(str(path))),
    Door("light.json", lambda path: save_light(path, probe("grace")), lambda path: load_light(str(path))),
    Door("data.npz", write_npz, lambda path: load_npz(str(path))),
    Door(BEST, lambda path: save(path, network_state()), load_run),
    Door(PUBLISHED, lambda path: publish(path, network_state()), load_run),
    Door("config.yaml", lambda path: path.write_text("seed: 1\ndata: {path: '${a}', size: [1, 2]}\n"), read_config),
    Door("metrics.jsonl", lambda path: path.write_text('{"epoch": 1}\n{"test/accuracy": 0.5}\n'), read_numbers),
    Door("summary.json", lambda path: path.write_text(json.dumps({"recall": {"value": None, "n": 0}})), read_json),
    Door(PREDICTIONS, write_scores, lambda path: read_predictions(path, "fig")),
    Door("photos.csv", write_table, read_photographs),
    Door("photo.png", lambda path: Image.new("RGB", (1, 2)).save(path), read_photographs),
    Door("photo.jpg", lambda path: Image.new("RGB", (2, 1)).save(path), read_photographs),
]


ALLOWED = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]  # which is another process on the machine


@pytest.mark.filterwarnings("ignore")  # of a library, on what it then refuses or reads
@pytest.mark.parametrize("door", DOORS, ids=[door.name for door in DOORS])
def test_a_damaged_file_is_used_or_refused_by_name(tmp_path, door):
    path = tmp_path / door.name
    door.write(path)
    door.read(path)
    whole = path.read_bytes()

    @settings(max_examples=25, deadline=None, suppress_health_check=ALLOWED)
    @given(
        st.integers(0, len(whole) - 1) | st.integers(0, 130), st.binary(max_size=6), st.integers(0, 9) | st.just(10**9)
    )
    def check(at, inserted, cut):
        path.write_bytes(whole[:at] + inserted + whole[at + cut :])
        try:
            door.read(path)
        except InputError as error:
            assert str(path) in str(error) and "\n" not in str(error)

    check()


@pytest.mark.parametrize("door", DOORS, ids=[door.name for door in DOORS])
@pytest.mark.parametrize("what", ["folder", "pipe", "nothing"])
def test_what_is_no_file_is_refused_by_name_and_not_waited_for(tmp_path, door, what):
    path = tmp_path / door.name
    door.write(path)
    path.unlink()
    if what == "folder":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    if door.name == "photos.csv" and what == "nothing":
        return door.read(path)  # as without a table
    with pytest.raises(InputError, match=str(path if door.read is not read_photographs else tmp_path)):
        door.read(path)
