import json
import shutil
from pathlib import Path

import pytest
from bs4 import BeautifulSoup
from omegaconf import OmegaConf
from PIL import Image

from train.results.page import images_folder, report_of, write_report
from train.results.store import RunSummary
from train.run_config import write_config
from train.run_folder import LOCK, locked

HOSTILE = "<script>alert(1)</script>|*x*"


def rows_of(page: Path) -> list[list[str]]:
    rows = BeautifulSoup(page.read_text(), "html.parser").find_all("tr")
    return [[cell.get_text() for cell in row.find_all("td")] for row in rows]


def write_unfinished_runs(folder: Path) -> None:
    for name in ("going", "damaged", "failed", "weights", "begun"):
        (folder / name).mkdir()
    (folder / "weights" / "best.pt").write_bytes(b"")
    for name in ("config.yaml", "train.log"):
        (folder / "begun" / name).touch()
    lines = '{"epoch": 1, "train/accuracy": 0.5}\n{"epoch": 2, "train/accuracy": 0.75}\n{"epo'
    (folder / "going" / "metrics.jsonl").write_text(lines)
    (folder / "damaged" / "metrics.jsonl").write_bytes(b"\xff{\n")
    (folder / "failed" / "failed.txt").write_text(HOSTILE)
    shutil.copytree(folder / "weights", folder / "closed")
    # A folder of this name cannot be locked, as no file can be in a read-only folder.
    (folder / "closed" / LOCK).mkdir()


SUCCESSFUL_EXAMPLE = {
    **{"example": 0, "label": [HOSTILE], "predicted": ["b"], "predicted_before": ["a"], "steps": 3},
    **{"confidence": [0.5], "confidence_before": [0.5], "success_before": False},
    **{"success": True, "success_without_noise": True},
}


def write_attack(folder: Path) -> None:
    folder.mkdir(parents=True)
    unsuccessful = SUCCESSFUL_EXAMPLE | {"success": False, "success_without_noise": False}
    wrong = SUCCESSFUL_EXAMPLE | {"example": 1, "steps": 0, "success_before": True}
    noisy = unsuccessful | {"example": 3, "success_without_noise": True}
    lines = [SUCCESSFUL_EXAMPLE, wrong, unsuccessful | {"example": 2}, noisy]
    lines.append({"checks": {"random_search": 0.5}})
    (folder / "attack.jsonl").write_text("\n".join(map(json.dumps, lines)))
    Image.new("RGB", (8, 8)).save(folder / "example_000.png")


@pytest.fixture(scope="module")
def page(finished, made_up_run, tiny, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("all")
    shutil.copytree(finished, folder / "finished")
    write_config(folder / "finished", tiny())
    for seed in (0, 1):
        made_up_run(folder / f"plain{seed}", "none", None, f"seed={seed}")
    made_up_run(folder / "old", "none", {"photographs": {"recall": {"value": 0.5}}})
    write_unfinished_runs(folder)
    write_attack(folder / "attacks" / HOSTILE.replace("/", "_"))
    (folder / "other").mkdir()
    other_attack = json.dumps(SUCCESSFUL_EXAMPLE | {"confidence": "high"})
    (folder / "other" / "attack.jsonl").write_text(other_attack)
    with locked(folder / "begun"):
        return write_report([folder], folder / "out")[0]


def test_a_page_loads_nothing_from_elsewhere_escapes_texts_and_describes_its_images(page):
    text = page.read_text()
    parsed = BeautifulSoup(text, "html.parser")
    addresses = [tag[name] for name in ("src", "href") for tag in parsed.find_all(**{name: True})]
    outside = [address for address in addresses if not address.startswith("#")]
    assert {address.partition(":")[0] for address in outside} == {"data"}
    assert not parsed.find("script")
    assert "&lt;script&gt;" in text
    images = parsed.find_all("img")
    assert images and all(image.get("alt") for image in images)


def test_runs_in_every_state_are_shown_or_named(page):
    rows = rows_of(page)
    states = {Path(cells[0]).name: cells[1:] for cells in rows if cells and "/" in cells[0]}
    assert states["going"] == ["interrupted", "2"]
    assert states["closed"] == ["not finished", "0"]
    assert states["weights"] == ["interrupted", "0"]
    assert states["failed"] == [f"failed: {HOSTILE}", "0"]
    assert states["begun"] == ["in training", "0"]
    for name in ("damaged", "old", "other"):
        assert states[name][0].startswith(f"cannot be read: {page.parents[1]}/{name}")
    assert any(cells[:3] == ["none", "2 seeds", "0.765 ± 0.000"] for cells in rows)


def test_images_of_a_relative_folder_are_those_of_the_folder_of_the_run(tmp_path, monkeypatch):
    for folder in ("there", "here"):
        (tmp_path / folder / "photographs").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    config = OmegaConf.create({"photos": "photographs", "working_folder": f"{tmp_path}/there"})
    run = RunSummary(tmp_path / "run", "", {}, {}, None, config=config)
    assert images_folder(run, "photographs") == tmp_path / "there" / "photographs"


def test_an_attack_is_shown_with_its_rates_and_the_outcome_of_each_example(page):
    text = page.read_text()
    assert "Attacks succeed on 1 of 3 examples, 2 without a sensor's noise; 1 more" in text
    assert "renders succeeds on 50%." in text
    outcomes = [cells[-1] for cells in rows_of(page) if cells[1:2] == [HOSTILE]]
    assert outcomes[:2] == ["success in 3 steps", "wrong before any step"]
    assert outcomes[2:] == ["no success in 3 steps", "success only without noise in 3 steps"]


def test_an_exception_of_a_report_is_printed_and_ends_no_training(finished, tmp_path, monkeypatch):
    monkeypatch.setattr("train.results.page.plot_curves", lambda *_: 1 / 0)
    first, *_, last = report_of([finished], tmp_path).strip().splitlines()
    assert first.startswith("no report: Traceback")
    assert last.startswith("ZeroDivisionError")
