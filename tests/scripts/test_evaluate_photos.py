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


def evaluate(run: Path, photos: Path, *overrides: str) -> subprocess.CompletedProcess:
    command = [sys.executable, ROOT / "scripts" / "evaluate_photos.py", f"run={run}", f"photos={photos}"]
    command += [f"out={run.parent / 'out'}", "device=cpu", "precision=float32", *overrides]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, env=environment, cwd=run.parent, capture_output=True, text=True)


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
