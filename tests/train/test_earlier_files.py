"""Files of commit 2864486, before settings and folders were rearranged, are still read.

That commit wrote earlier_files/ with one small run and one attack on its network.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import renderer
from train.runs.saved_networks import load_run

EARLIER = Path(__file__).with_name("earlier_files")
EXAMPLE = EARLIER / "attack" / "0_solid_orange_0" / "example_000"


@pytest.fixture
def earlier(tmp_path) -> Path:
    """A copy, since commands write into the folders of runs."""
    return Path(shutil.copytree(EARLIER, tmp_path / "earlier"))


def recorded() -> dict:
    """The first line of the attack's record, which is about its only example."""
    return json.loads((EXAMPLE.parent / "attack.jsonl").read_text().splitlines()[0])


@pytest.mark.parametrize(("image", "field"), [("before", "confidence_before"), ("after", "confidence")])
def test_an_earlier_network_gives_the_probabilities_that_were_recorded(image, field):
    network = load_run(EARLIER / "run")
    images = torch.from_numpy(np.load(EXAMPLE / f"{image}.npy")).view(1, 3, 16, 16)
    with torch.no_grad():
        probabilities = network(images).softmax(dim=1)
    found = probabilities[0, network.classes.index("orange")].item()
    assert found == pytest.approx(recorded()[field][0], abs=1e-3)


def test_an_earlier_adversary_is_rendered_and_gives_the_probabilities_that_were_recorded(earlier, call, capsys):
    folder = earlier / "attack" / "0_solid_orange_0" / "example_000"
    reloaded = f"reload={folder}"
    assert call("attack", reloaded, f"classifier=run:{earlier}/run", "out=again", "renderer.rasterizer=numpy") == 0
    assert f"{recorded()['confidence'][0]:.1%}" in capsys.readouterr().out


def test_an_earlier_light_is_read():
    light = renderer.load_light(str(EXAMPLE / "light_before.json"))
    coefficients = json.loads((EXAMPLE / "light_before.json").read_text())["coefficients"]
    torch.testing.assert_close(light, torch.tensor(coefficients))


def test_an_earlier_run_is_reported(earlier, call):
    assert call("report", str(earlier / "run"), "out=report.html") == 0


def test_an_earlier_run_is_scored_on_photographs(earlier, photos, call):
    assert call("evaluate", f"run={earlier}/run", f"photos={photos}", f"out={earlier}/scores") == 0
    summary = json.loads((earlier / "scores" / "summary.json").read_text())
    assert summary["recall"]["value"] == 1.0


def test_an_earlier_run_is_gone_on_from_as_initial_weights(earlier, call):
    """Settings of the earlier run do not hinder a new one that begins with its network."""
    small = ["data=shapes", "data.train_per_class=10", "data.test_per_class=2", "data.size=16", "train.epochs=1"]
    small += ["model.depth=10", "model.width=1", "train.batch_size=16", "train.device=cpu", "train.threads=1"]
    begun = f"train.init_from={earlier}/run"
    assert call("train", *small, "augment=none", begun, f"run={earlier}/new") == 0
