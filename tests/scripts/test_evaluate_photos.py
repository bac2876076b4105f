"""The command itself, on networks that it finds in files."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from train.command_line.entry_points import USER_ERROR
from train.networks import WideResNet, describe, load_run
from train.run_folder.checkpoint import BEST, save

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


@pytest.fixture
def evaluate(call, photos) -> Callable[..., int]:
    return partial(call, "evaluate_photos", "out=out", "device=cpu", "precision=float32", f"photos={photos}")


def test_a_network_is_scored_at_the_size_that_it_was_trained_at(evaluate, run, photos):
    assert evaluate(f"run={run}") == 0
    assert json.loads((run.parent / "out" / "summary.json").read_text())["size"] == 64
    rows = (run.parent / "out" / "predictions.csv").read_text().splitlines()
    header, first = (row.split(",") for row in rows[:2])
    image = np.asarray(Image.open(photos / first[0])).transpose(2, 0, 1).copy()
    with torch.no_grad():
        logits = load_run(run)(torch.from_numpy(image)[None] / 255)[0]
    assert float(first[header.index("orange_log_odds")]) == pytest.approx(float(logits[1] - logits[0]), abs=1e-4)


OWN = """
import torch

class Redness(torch.nn.Module):
    def forward(self, images):
        red = images[:, 0].mean((1, 2)) - 0.5
        return torch.stack([-red, red], 1)

def build():
    return Redness(), 16, ["lime", "orange"]
"""


def test_any_network_of_ones_own_is_scored_at_its_size_and_on_its_classes(evaluate, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    for name, color in {"lime": (0, 255, 0), "orange": (255, 128, 0)}.items():
        (tmp_path / "lit" / name).mkdir(parents=True)
        Image.new("RGB", (40, 30), color).save(tmp_path / "lit" / name / "one.png")
    assert evaluate("classifier=python:own:build", f"photos={tmp_path / 'lit'}") == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["size"], summary["recall"]["value"], summary["false_positive_rate"]["value"]) == (16, 1, 0)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ([], "give one network"),
        (["run=a", "classifier=python:own:build"], "give one network"),
        (["classifier=python:own:build", "model=python:own:build"], "model=python:own:build is for run=FOLDER"),
        (["classifier=python:nowhere:build"], "there is no module nowhere"),
        (["run=a", "weights=b"], "weights=b is not for classifier=run:a"),
    ],
    ids=["none", "two", "model", "unknown", "weights"],
)
def test_a_network_that_cannot_be_meant_is_one_sentence(evaluate, capsys, overrides, said):
    assert evaluate(*overrides) == USER_ERROR
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1


def test_a_class_that_a_network_lacks_is_refused_by_the_names_of_both(call, run, photos, capsys):
    assert call("evaluate_photos", f"run={run}", f"photos={photos}", "label=pear") == USER_ERROR
    assert capsys.readouterr().err.startswith(
        f"error: classifier=run:{run}: 'pear' is not a class of the model: choose one, such as "
    )
