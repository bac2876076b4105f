import json
from itertools import product
from pathlib import Path

import pytest
import torch

import norm_balls as nb
from tests.helpers import Brightness, save_plain
from tests.train.helpers import attack_shortly
from train.auditing import lights
from train.commands import audit as engine

SIZE = 8
CLASSES = ["orange", "apple"]


@pytest.fixture
def options(monkeypatch, tmp_path_factory) -> dict:
    laboratory = tmp_path_factory.mktemp("laboratory")
    for name, level in product(CLASSES, (60, 200)):
        save_plain(laboratory / name / f"{level}.png", level)
    attack_shortly(monkeypatch, "lighting")
    for name, number in {"FRAME_COUNT": 2, "BALL_SIDE": 8, "SIDE": 8}.items():
        monkeypatch.setattr(lights, name, number)
    for name, count in {"VIEW_COUNT": 2, "ATTACKED_COUNT": 2, "RANDOM_LIGHT_COUNT": 1}.items():
        monkeypatch.setattr(engine, name, count)
    given = {"classes": CLASSES, "size": SIZE, "laboratory": str(laboratory)}
    return given | {"environments": ["grace"]}


@pytest.mark.slow
def test_the_report_has_the_numbers_of_the_files(options, tmp_path):
    network = Brightness(0.5).eval()
    out = tmp_path / "audit"
    report = nb.audit(network, ["solid:orange:0"], out=out, **options)
    counts = json.loads((out / "classifier" / "lighting.json").read_text())
    attack = report.network.attacks["lighting"]
    assert [*attack.adversarial] == counts["adversarial"]
    assert (attack.views, attack.correct) == (counts["n"], counts["correct"])
    summary = json.loads((out / "classifier" / "laboratory" / "summary.json").read_text())
    assert report.network.scores["laboratory"]["recall"].hits == summary["recall"]["hits"]
    page = report.save(tmp_path / "pages" / "audit.html")
    assert page.read_text() == (out / "report.html").read_text()
    assert network.limit.requires_grad


def counts_of(report: nb.AuditReport) -> tuple:
    attack = report.network.attacks["lighting"]
    return attack.views, attack.correct, attack.adversarial


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*deprecated")
def test_a_mesh_in_memory_and_a_networks_file_are_audited_by_index(options, tmp_path, monkeypatch):
    """The numbers are those of the mesh's file and of the network itself, by name."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    network = Brightness(0.5).eval()
    nb.export_mesh(nb.solid("orange", 0), tmp_path / "orange.glb")
    mesh = nb.load_mesh(tmp_path / "orange.glb")
    expected = nb.audit(network, [tmp_path / "orange.glb"], **options)

    path = tmp_path / "network.pt"
    torch.jit.save(torch.jit.trace(network, torch.rand(2, 3, SIZE, SIZE)), path)
    classifier = nb.load_classifier(str(path), classes=CLASSES, size=SIZE, trust_code=True)
    options |= {"classes": None, "size": None}
    found = nb.audit(classifier, [mesh], label=0, **options)
    assert counts_of(found) == counts_of(expected)
    assert found.label == "orange"
    assert not [*Path().iterdir()]  # An audit writes nothing unless it is asked to.
