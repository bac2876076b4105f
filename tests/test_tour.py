"""docs/tour.ipynb."""

import gc
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
TOUR = ROOT / "docs" / "tour.ipynb"


@pytest.fixture
def tour() -> nbformat.NotebookNode:
    return nbformat.read(TOUR, as_version=4)


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:subprocess:ResourceWarning"
)  # nbclient ends the kernel and does not wait for it
def test_the_attacks_of_the_tour_succeed_from_its_own_folder(tour, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    NotebookClient(tour, timeout=600, resources={"metadata": {"path": str(TOUR.parent)}}).execute()
    gc.collect()  # so that no later test is warned of the kernel
    outputs = [
        output
        for cell in tour.cells
        for output in cell.get("outputs", [])
        if output.get("name") == "stdout"
    ]
    printed = "".join(output.text for output in outputs)  # without the progress of what took long
    successes, _, correct, *_ = printed.split()
    assert int(correct) > 0 and int(successes) >= 0.9 * int(correct)


def test_the_tour_contains_its_images_and_no_path_of_a_machine(tour):
    cells = [cell for cell in tour.cells if cell.cell_type == "code"]
    images = [
        output for cell in cells for output in cell.outputs if "image/png" in output.get("data", {})
    ]
    assert len(images) >= 7 and not any(
        output.output_type == "error" for cell in cells for output in cell.outputs
    )
    assert (
        TOUR.stat().st_size < 500_000
        and "/home/" not in TOUR.read_text()
        and "/work/" not in TOUR.read_text()
    )
