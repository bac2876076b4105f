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
    _, steps, errors = page.read_text(encoding="utf-8").split("\n### ")
    for name in BASES:
        assert f"| {name} | " in steps
        [found] = re.findall(rf"\n\| {re.escape(name)} \| (\S+)% \| (\S+)% \| (\S+)% \| (\S+)% \|", errors)
        coarse, coarse_gradient, fine, fine_gradient = map(float, found)
        assert fine < coarse and fine_gradient < coarse_gradient
    dense = dict(re.findall(r"\| (projector of 32².*?) \| 1024 \| \S* ?\| (\S+) \|", steps))
    assert float(dense["projector of 32²"]) < float(dense["projector of 32², all entries"]) / 4
    assert re.search(r"takes \S+ ms at 12² and\s\S+ ms at 16²", steps)


def test_the_committed_page_has_every_light():
    page = Path("docs/performance.md").read_text(encoding="utf-8")
    assert "\n## Lights in the scene\n" in page and all(f"| {name} |" in page for name in BASES)


@pytest.fixture(autouse=True)
def operators_are_sparse_again():
    before = sparse.SPARSE
    yield
    assert before == sparse.SPARSE
