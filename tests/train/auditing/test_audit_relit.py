from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import augment
from renderer.errors import InputError
from tests.helpers import bright_or_dark, save_noise
from train.auditing.relit import RELIT_FOLDER, read_relit
from train.command_settings import AuditSettings
from train.commands.audit import run_audit
from train.results.predictions import RELIT

NETWORKS = {
    "classifier": augment.Classifier(bright_or_dark, 16, ["bright", "dark"], "first"),
    "hardened": augment.Classifier(
        lambda x: bright_or_dark(0 * x), 16, ["bright", "dark"], "second"
    ),
}


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(0)
    for index in range(10):
        save_noise(folder / f"{index}.png", rng, high=2 * (20 + 3 * index))
    return folder


@pytest.fixture
def settings(photographs, tmp_path) -> AuditSettings:
    return AuditSettings(network="first", unlabeled=str(photographs), out=str(tmp_path / "out"))


def test_the_page_counts_the_photographs_that_keep_their_class(settings, tmp_path):
    page = run_audit(settings, NETWORKS).path.read_text()
    first = read_relit(tmp_path / "out" / "classifier" / RELIT_FOLDER)
    second = read_relit(tmp_path / "out" / "hardened" / RELIT_FOLDER)
    # The second network answers all images alike.
    assert [second.kept(light).hits for light in second.lights] == [10, 10, 10]
    for light in first.lights:
        kept = sum(item.kept[light] for item in first.photographs)
        assert f"{kept} of 10" in page
    assert first.kept("adversarial").hits < 10


def test_a_part_that_exists_is_not_measured_again(settings, tmp_path):
    name = "python:tests.train.commands.test_attack_photographs:load_bright_or_dark"
    named = replace(settings, network=name, budget=0.02)
    run_audit(named)
    path = tmp_path / "out" / "classifier" / RELIT_FOLDER / RELIT
    marked = path.read_text().replace('"predicted": "', '"predicted": "marked ')
    path.write_text(marked)
    assert "marked" in run_audit(named).path.read_text()
    with pytest.raises(InputError, match="budget"):
        run_audit(replace(named, budget=0.05))


def test_the_budget_limits_the_photographs(settings, tmp_path):
    few = replace(settings, budget=0.03)
    text = run_audit(few, {"classifier": NETWORKS["classifier"]}).path.read_text()
    scores = read_relit(tmp_path / "out" / "classifier" / RELIT_FOLDER)
    assert [item.path for item in scores.photographs] == ["0.png", "4.png", "9.png"]
    assert "holds 10 photographs" in text
