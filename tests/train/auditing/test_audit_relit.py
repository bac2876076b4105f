from dataclasses import replace

import pytest

import augment
from renderer.errors import InputError
from tests.helpers import bright_or_dark
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


@pytest.fixture
def settings(half_dark, tmp_path) -> AuditSettings:
    return AuditSettings(network="first", unlabeled=str(half_dark), out=str(tmp_path / "out"))


def test_the_page_counts_the_photographs_that_keep_their_class(settings, tmp_path):
    page = run_audit(settings, NETWORKS).path.read_text()
    first = read_relit(tmp_path / "out" / "classifier" / RELIT_FOLDER)
    second = read_relit(tmp_path / "out" / "hardened" / RELIT_FOLDER)
    # The second network answers all images alike.
    assert [second.kept(light).hits for light in second.lights] == [12, 12, 12]
    for light in first.lights:
        kept = sum(item.kept[light] for item in first.photographs)
        assert f"{kept} of 12" in page
    assert first.kept("adversarial").hits < 12


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
    # Of the twelve names in order, these are the first one, the seventh and the last one.
    shown = ["part_0/0.png", "part_1/1.png", "part_1/9.png"]
    assert [item.path for item in scores.photographs] == shown
    assert "has 12 photographs" in text
