import csv
import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

import renderer
from renderer.errors import InputError
from renderer.image import to_bytes
from renderer.io.images import read_image
from tests.helpers import save_noise
from tests.train.helpers import save_untrained_network
from train import console
from train.checkpoints import load_run
from train.cli import USER_ERROR
from train.commands.experiment import logged_to
from train.commands.fit import grab_cut
from train.results.store import trained_labels
from train.run_folder import LOCK, sole_writer

EVALUATE = ["evaluate", "run=1.10", "photos=2024", "device=cpu", "precision=float32"]
EVALUATE_CLASSIFIER = [*EVALUATE, "run=null"]
ATTACK = ["attack", "network=run:pretrained/none", "device=cpu", "renderer.rasterizer=numpy"]
RENDER = ["render", "out=out", "device=cpu", "meshes=[solid:orange]"]
# Settings that nothing reads in a data set that is rendered without a network.
OF_NETWORKS = (
    *("weights=b", "classes=['a', 'b']", "decode=a:b", "threshold=0.5", "augment.init=random"),
    *("augment.attack.max_steps=3", "augment.attack.eot.draws=2", "augment.regenerate_every=9"),
)


@pytest.fixture
def here(tmp_path) -> Path:
    """Make a folder with a network for images of 64 pixels in 1.10, and photographs in 2024."""
    save_untrained_network(tmp_path / "1.10", size=64)
    rng = np.random.default_rng(0)
    for name in ("orange", "other_\udcff"):
        save_noise(tmp_path / "2024" / name / "a.png", rng, (64, 64))
    (tmp_path / "file").touch()
    return tmp_path


def test_an_evaluation_writes_the_log_odds_of_the_network_for_each_photograph(call, here, capsys):
    """The folders of photographs have names that are numbers or not in UTF-8."""
    assert call(*EVALUATE, "out=1e3") == 0
    assert "1 images of orange, 1 negatives" in capsys.readouterr().out
    scores = here / "1e3"
    names = {"predictions.csv", "summary.json", "contact_sheet.png", "roc.csv", "roc.png", LOCK}
    assert {path.name for path in scores.iterdir()} == names
    assert json.loads((scores / "summary.json").read_text())["size"] == 64
    with open(scores / "predictions.csv", encoding="utf-8", newline="") as file:
        rows = {row["path"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"orange/a.png", r"other_\udcff/a.png"}
    image = read_image(here / "2024" / "orange" / "a.png", 64)
    with torch.no_grad():
        fig, lime, orange = load_run(here / "1.10")(image[None])[0]
    log_odds = float(orange - torch.logaddexp(fig, lime))
    assert float(rows["orange/a.png"]["orange_log_odds"]) == pytest.approx(log_odds, abs=1e-4)


class TestEvaluationWithoutALabel:
    def test_needs_one_for_a_folder_without_class_folders(self, call, here, capsys):
        save_noise(here / "bottles" / "a.png", np.random.default_rng(0), (64, 64))
        words = [*EVALUATE[:2], "photos=bottles", *EVALUATE[3:]]
        assert call(*words) == USER_ERROR
        assert "give classes or label" in capsys.readouterr().err

    @pytest.mark.parametrize("recorded", [False, True])
    def test_takes_the_runs_class_or_else_folders(self, call, here, capsys, monkeypatch, recorded):
        save_noise(here / "2024" / "fig" / "a.png", np.random.default_rng(0), (64, 64))
        monkeypatch.setattr("train.results.scoring.write_roc", lambda *_: None)
        if recorded:
            monkeypatch.setattr("train.commands.evaluate.trained_labels", lambda run: ["orange"])
        assert call(*EVALUATE, "out=scores") == 0
        summary = json.loads((here / "scores" / "summary.json").read_text())
        assert summary["label"] == ("orange" if recorded else ["fig", "orange"])
        assert "orange" in capsys.readouterr().out.partition("\n")[0]


@pytest.mark.parametrize(
    ("name", "labels"), [("best", ["orange"]), ("none", ["orange"]), ("laboratory", [])]
)
def test_published_networks_record_what_they_were_trained_for(name, labels):
    assert trained_labels(Path("pretrained", name)) == labels


MISTAKES = [
    ([*EVALUATE, "label=pear"], "label: classifier run:1.10: 'pear'"),
    (
        [*EVALUATE, "network=torchvision:resnet18"],
        "run=1.10 and network=torchvision:resnet18 do not",
    ),
    ([*EVALUATE_CLASSIFIER, "network=python:nowhere:build"], "network=python:nowhere:build"),
    ([*EVALUATE, "weights=b"], "weights=b"),
    ([*EVALUATE, "decode=a:b"], "decode=a:b"),
    ([*EVALUATE, "network=python:a:b"], "not by python:a:b"),
    ([*EVALUATE_CLASSIFIER, "network=run:1.10", "decode=json:loads"], "error: decode cannot"),
    ([*ATTACK, "decode=json:loads"], "error: decode cannot be set"),
    (["compare", "runs=[2024]"], "runs: 2024 holds no run"),
    (["lab", "out=file/out"], "out=file/out"),
    ([*RENDER, "augment.mode=folder", "augment.folder=2024"], "augment.mode=folder does not"),
    ([*RENDER, "augment.mode=none", "network=best"], "augment.mode=none does not"),
    ([*RENDER, "augment.examples=5", "network=best"], "augment.examples=5 does not"),
    *(([*RENDER, word], f"{word} does not count") for word in OF_NETWORKS),
    ([*RENDER, "label=[a,b]"], "label=['a', 'b']"),
    ([*ATTACK, "transfer.networks=[resnet18]"], "transfer.networks=resnet18"),
    ([*ATTACK, "transfer.meshes=[{mesh: 'solid:pear', label: paer}]"], "'paer' is not a class"),
    ([*ATTACK, "attack=geometry", "transfer.meshes=[a.glb]"], "meshes: attacked geometry"),
    ([*ATTACK, "attack=pixels", "transfer.azimuths=[3]"], "azimuths: attacked pixels"),
    ([*ATTACK, "attack=[]"], "attack: "),
    ([*ATTACK, "reload=absent"], "absent/adversary.json does not exist"),
]


@pytest.mark.parametrize(
    ("command", "message"), MISTAKES, ids=[" ".join([c[0], *c[-2:]]) for c, _ in MISTAKES]
)
def test_a_mistake_is_one_line_of_error_and_nothing_written(call, here, capsys, command, message):
    before = sorted(here.rglob("*"))
    assert call(*command) == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ") and message in printed.err
    assert printed.err.count("\n") == 1
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize(
    "command", [EVALUATE, ["attack", "network=run:1.10"], ["lab"]], ids=lambda given: given[0]
)
def test_two_commands_do_not_write_in_one_folder(call, here, capsys, command):
    with sole_writer(here / "out"):
        assert call(*command, "out=out") == USER_ERROR
    assert "error: out=out " in capsys.readouterr().err
    assert not (here / "out").exists()


def test_grab_cut_finds_the_outline_of_a_solid_in_a_box_around_it():
    (camera,) = renderer.orbit_cameras(1, 4.0)
    shown = renderer.solid("orange"), camera, renderer.load_light("uniform"), 96
    generator = torch.Generator().manual_seed(0)
    background = 0.2 + 0.1 * torch.rand(3, 96, 96, generator=generator)
    image = renderer.render(*shown, background, encoding="srgb")
    is_object = (renderer.render(*shown, 0.0).amax(0) > 0).numpy()
    pixels = to_bytes(image.permute(1, 2, 0)).numpy()
    is_found = grab_cut(pixels, [10, 10, 86, 86]) > 0
    intersection = (is_found & is_object).sum()
    union = (is_found | is_object).sum()
    assert intersection > 0.95 * union


@pytest.mark.parametrize("box", [[10, 10, 10, 86], [0, 0, 97, 96], [1, 2, 3]])
def test_grab_cut_refuses_a_box_outside_the_image(box):
    with pytest.raises(InputError, match="within 96 × 96 pixels"):
        grab_cut(np.zeros((96, 96, 3), np.uint8), box)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_on_a_full_disk_prints_no_traceback(capsys):
    with suppress(OSError), logged_to(Path("/dev/full")):
        console.info("a line")
    printed = capsys.readouterr()
    assert printed.out == "a line\n"
    assert printed.err == ""
