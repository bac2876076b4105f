"""Files of commit 2864486, before settings and folders were rearranged, are still read.

That commit wrote earlier_files/ with one small run and one attack on its network.
"""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import augment
import renderer
from augment.attacks.adversary import write_adversary
from renderer.light.files import read_light
from renderer.light.projector import Projector
from train.__main__ import main
from train.run_config import read_config
from train.saved_networks import load_run

EARLIER = Path(__file__).with_name("earlier_files")
EXAMPLE = EARLIER / "attack" / "0_solid_orange_0" / "example_000"


@pytest.fixture
def earlier(tmp_path) -> Path:
    """Copy the files, since commands write into the folders of runs."""
    return Path(shutil.copytree(EARLIER, tmp_path / "earlier"))


def recorded() -> dict:
    """Read what the attack recorded of its only example."""
    first, *_ = (EXAMPLE.parent / "attack.jsonl").read_text().splitlines()
    return json.loads(first)


@pytest.mark.parametrize(
    ("image", "field"),
    [("before", "confidence_before"), ("after", "confidence")],
)
def test_an_earlier_network_gives_the_probabilities_that_were_recorded(image, field):
    network = load_run(EARLIER / "run")
    images = torch.from_numpy(np.load(EXAMPLE / f"{image}.npy")).view(1, 3, 16, 16)
    with torch.no_grad():
        probabilities = network(images).softmax(dim=1)
    found = probabilities[0, network.classes.index("orange")].item()
    assert found == pytest.approx(recorded()[field][0], abs=1e-3)


def test_an_earlier_adversary_gives_the_probabilities_that_were_recorded(earlier, call, capsys):
    folder = earlier / "attack" / "0_solid_orange_0" / "example_000"
    classifier = f"classifier=run:{earlier}/run"
    options = "out=again", "renderer.rasterizer=numpy"
    assert call("attack", f"reload={folder}", classifier, *options) == 0
    assert f"{recorded()['confidence'][0]:.1%}" in capsys.readouterr().out


class TestTheAnglesOfAnEarlierAdversary:
    def test_are_read_as_radians(self):
        (camera,) = augment.reload(EXAMPLE).cameras
        described = json.loads((EXAMPLE / "adversary.json").read_text())["cameras"][0]
        assert math.radians(camera.polar) == pytest.approx(described["polar"], rel=1e-15)
        assert math.radians(camera.azimuth) == pytest.approx(described["azimuth"], rel=1e-15)

    def test_give_the_same_image(self):
        rendered = augment.reload(EXAMPLE).render("numpy")
        expected = torch.from_numpy(np.load(EXAMPLE / "after.npy")).view(3, 16, 16)
        torch.testing.assert_close(rendered, expected, rtol=0, atol=1e-5)

    def test_are_written_in_degrees(self, tmp_path):
        adversary = augment.reload(EXAMPLE)
        write_adversary(adversary, tmp_path)
        assert augment.reload(tmp_path).cameras == adversary.cameras


class TestTheAnglesOfAnEarlierProjector:
    @pytest.fixture
    def path(self, tmp_path) -> Path:
        described = {
            "basis": "projector",
            "pixels": 1,
            "polar": math.pi / 3,
            "azimuth": 0.5,
            "distance": 4.0,
            "fov": math.pi / 6,
            "power": 1.0,
            "coefficients": [[0.5, 0.25, 1.0]],
        }
        (tmp_path / "projector.json").write_text(json.dumps(described))
        return tmp_path / "projector.json"

    def test_are_read_as_radians(self, path):
        projector, _ = read_light(path, Projector)
        assert projector.polar == pytest.approx(60.0, rel=1e-15)
        assert projector.azimuth == pytest.approx(math.degrees(0.5), rel=1e-15)
        assert projector.fov == pytest.approx(30.0, rel=1e-15)

    def test_are_written_in_degrees(self, path, tmp_path):
        projector, pattern = read_light(path, Projector)
        renderer.save_light(tmp_path / "new.json", pattern, projector)
        written, _ = read_light(tmp_path / "new.json", Projector)
        assert written == projector


def test_an_earlier_light_is_read():
    light = renderer.load_light(str(EXAMPLE / "light_before.json"))
    coefficients = json.loads((EXAMPLE / "light_before.json").read_text())["coefficients"]
    torch.testing.assert_close(light, torch.tensor(coefficients))


def test_an_earlier_run_is_reported(earlier, call):
    assert call("report", str(earlier / "run"), "out=report.html") == 0


def test_an_earlier_run_is_scored_on_photographs(earlier, photos, call):
    scores = earlier / "scores"
    assert call("evaluate", f"run={earlier}/run", f"photos={photos}", f"out={scores}") == 0
    summary = json.loads((scores / "summary.json").read_text())
    assert summary["recall"]["value"] == 1.0


def test_a_new_run_starts_from_an_earlier_network_whose_settings_were_other_ones(earlier, call):
    small = [
        "data=shapes",
        "data.train_per_class=4",
        "data.test_per_class=2",
        "data.size=16",
        "data.validation=0.25",
        "model.depth=10",
        "model.width=1",
        "augment=none",
        "train.epochs=1",
        "train.batch_size=16",
        "train.device=cpu",
        "train.threads=1",
    ]
    initial = f"train.init_from={earlier}/run"
    assert call("train", *small, initial, f"run={earlier}/new") == 0


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("augment.arm=none", "augment.mode=none"),
        ("augment.every=60", "augment.regenerate_every=60"),
        ("augment.attack.shorten=true", "augment.attack.backtracking=true"),
        ("augment.attack.rounded=true", "augment.attack.quantized=true"),
        ("augment.vary.gloss.strength=[0.1,0.2]", "augment.vary.gloss.specular_factor=[0.1,0.2]"),
        ("train.accumulate=2", "train.accumulation_steps=2"),
        ("train.ranking=1.0", "train.ranking_weight=1.0"),
        ("train.distillation=1.0", "train.distillation_weight=1.0"),
    ],
)
def test_a_former_key_on_the_command_line_sets_the_present_setting(former, present):
    others = ["run=somewhere", "train.init_from=run:another"]
    assert main.read([*others, former]) == main.read([*others, present])
    assert main.read([*others, former]) != main.read(others)


def test_the_settings_of_an_earlier_run_are_read_under_their_present_names():
    written = yaml.safe_load((EARLIER / "run" / "config.yaml").read_text())
    config = read_config(EARLIER / "run" / "config.yaml")
    assert config.augment.mode == written["augment"]["arm"]
    assert config.augment.regenerate_every == written["augment"]["every"]
    assert config.augment.attack.quantized == written["augment"]["attack"]["rounded"]
    assert config.train.accumulation_steps == written["train"]["accumulate"]
    assert "arm" not in config.augment
