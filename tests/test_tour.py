"""The notebook docs/tour.ipynb runs."""

import gc
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
TOUR = ROOT / "docs" / "tour.ipynb"


@pytest.mark.slow
# nbclient ends the kernel and does not wait for it.
@pytest.mark.filterwarnings("ignore:subprocess:ResourceWarning")
def test_the_attacks_of_the_tour_succeed_from_its_own_folder(monkeypatch):
    tour = nbformat.read(TOUR, as_version=4)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    NotebookClient(tour, timeout=600, resources={"metadata": {"path": str(TOUR.parent)}}).execute()
    gc.collect()  # Otherwise a later test is warned of the kernel.
    outputs = [output for cell in tour.cells for output in cell.get("outputs", [])]
    printed = "".join(output.text for output in outputs if output.get("name") == "stdout")
    successes, _, correct, *_ = printed.split()
    assert int(correct) > 0
    assert int(successes) >= 0.9 * int(correct)
