"""The first command of the README trains the demonstration."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def read_auc(folder: Path) -> float:
    """Read the AUC on the photographs of the laboratory."""
    summary = json.loads((folder / "laboratory" / "summary.json").read_text())
    return summary["auc"]["value"]


@pytest.mark.slow
def test_the_demonstration_ends_with_a_table_of_the_effect_an_image_and_a_report(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-m", "train"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    # The result fits on a screen.
    assert len(lines) <= 20
    page = Path(lines[-1].removeprefix("report: "))
    folder = page.parent
    *_, sheet = re.findall(r"^image: (.*)$", (folder / "train.log").read_text(), re.M)
    assert Path(sheet).read_bytes().startswith(b"\x89PNG")
    before = read_auc(folder / "before")
    after = read_auc(folder)
    assert after > before + 0.05
    header, _, *rows = [line.split("|") for line in lines if line.startswith("|")]
    column = [cell.strip() for cell in header].index("AUC")
    printed = [row[column].strip() for row in rows]
    assert printed == [f"{before:.3f}", f"{after:.3f}"]
    assert "Examples of renders" in page.read_text()
