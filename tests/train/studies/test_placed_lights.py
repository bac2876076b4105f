import re
from pathlib import Path

import pytest

from renderer import sparse
from train.studies import placed_lights
from train.studies.placed_lights import BASES, run
from train.studies.transport.cost import CupSettings


def test_the_page_has_every_light_with_what_is_zero_in_it_and_its_error(monkeypatch, tmp_path):
    monkeypatch.setattr(placed_lights, "SIZES", (12, 16))
    monkeypatch.setattr(placed_lights, "REFERENCE", 16)
    monkeypatch.setattr(sparse, "SMALL", 0)
    page = tmp_path / "lights.md"
    run(CupSettings(str(page), vertices=0, rounds=1))
    _, steps, errors, moved = page.read_text(encoding="utf-8").split("\n## ")
    for name in BASES:
        assert f"| {name} | " in steps and errors.count(f"\n| {name} | ") == 2
        coarse, fine = (float(found) for found in re.findall(rf"\| {re.escape(name)} \| \d² \| (\S+)%", errors))
        assert fine < coarse
    dense = dict(re.findall(r"\| (projector of 32².*?) \| 1024 \| \S* ?\| (\S+) \|", steps))
    assert float(dense["projector of 32²"]) < float(dense["projector of 32², all entries"]) / 4
    assert moved.count(" ms") == 4


def test_the_committed_page_is_the_scripts():
    page = Path("docs/performance_lights.md").read_text(encoding="utf-8")
    assert page.startswith("# Lights in the scene: time and error\n") and all(f"| {name} |" in page for name in BASES)


@pytest.fixture(autouse=True)
def operators_are_sparse_again():
    before = sparse.SPARSE
    yield
    assert before == sparse.SPARSE
