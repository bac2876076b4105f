"""The command itself, on networks that it finds in files."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from train.checkpoint import BEST, describe, load_network, save
from train.wideresnet import WideResNet

ROOT = Path(__file__).parents[2]
CLASSES = ["lime", "orange"]


@pytest.fixture
def photos(tmp_path) -> Path:
    rng = np.random.default_rng(0)
    for name in CLASSES:
        (tmp_path / "photos" / name).mkdir(parents=True)
        for number in range(3):
            pixels = rng.integers(0, 256, (64, 64, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(tmp_path / "photos" / name / f"{number}.png")
    return tmp_path / "photos"


@pytest.fixture
def run(tmp_path) -> Path:
    """The folder of a network that was trained on images of 64 pixels per side."""
    torch.manual_seed(0)
    network = WideResNet(2, 10, 1, 0.0)
    described = describe(network, CLASSES, size=64, encoding="linear", depth=10, width=1, dropout=0.0)
    (tmp_path / "run").mkdir()
    save(tmp_path / "run" / BEST, {"model": network.state_dict(), "architecture": described})
    return tmp_path / "run"


def command(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    script = [sys.executable, ROOT / "scripts" / "evaluate_photos.py", "out=out", "device=cpu", "precision=float32"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run([*script, *overrides], env=environment, cwd=folder, capture_output=True, text=True)


def evaluate(run: Path, photos: Path, *overrides: str) -> subprocess.CompletedProcess:
    return command(run.parent, f"run={run}", f"photos={photos}", *overrides)


def test_a_network_is_scored_at_the_size_that_it_was_trained_at(run, photos):
    done = evaluate(run, photos)
    assert done.returncode == 0, done.stderr
    assert json.loads((run.parent / "out" / "summary.json").read_text())["size"] == 64
    rows = (run.parent / "out" / "photographs.csv").read_text().splitlines()
    header, first = (row.split(",") for row in rows[:2])
    image = np.asarray(Image.open(photos / first[0])).transpose(2, 0, 1).copy()
    with torch.no_grad():
        logits = load_network(run).module(torch.from_numpy(image)[None] / 255)[0]
    assert float(first[header.index("orange_log_odds")]) == pytest.approx(float(logits[1] - logits[0]), abs=1e-4)


def test_another_size_than_the_networks_is_one_sentence(run, photos):
    done = evaluate(run, photos, "size=32")
    assert done.returncode == 2
    assert done.stderr.startswith("error: size=32: ") and "trained on images of 64 pixels per side" in done.stderr
    assert not (run.parent / "out").exists()


OWN = """
import torch

class Redness(torch.nn.Module):
    def forward(self, images):
        red = images[:, 0].mean((1, 2)) - 0.5
        return torch.stack([-red, red], 1)

def build():
    return Redness(), 16, ["lime", "orange"]
"""


def test_any_network_of_ones_own_is_scored_at_its_size_and_on_its_classes(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    for name, colour in {"lime": (0, 255, 0), "orange": (255, 128, 0)}.items():
        (tmp_path / "photos" / name).mkdir(parents=True)
        Image.new("RGB", (40, 30), colour).save(tmp_path / "photos" / name / "one.png")
    done = command(tmp_path, "classifier=python:own:build", f"photos={tmp_path / 'photos'}")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["size"], summary["recall"]["value"], summary["false_alarms"]["value"]) == (16, 1, 0)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ([], "give one network"),
        (["run=a", "classifier=python:own:build"], "give one network"),
        (["classifier=python:own:build", "size=32"], "size=32 is for run=FOLDER"),
        (["classifier=python:nowhere:build"], "there is no module nowhere"),
        (["run=a", "weights=b"], "weights=b is not for classifier=run:a"),
    ],
    ids=["none", "two", "size", "unknown", "weights"],
)
def test_a_network_that_cannot_be_meant_is_one_sentence(tmp_path, overrides, said):
    done = command(tmp_path, f"photos={tmp_path}", *overrides)
    assert done.returncode == 2
    assert said in done.stderr and done.stderr.count("\n") == 1
