"""The demonstration, run as the README's first command runs it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_demonstration_ends_with_a_table_of_the_effect_an_image_and_a_report(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-m", "train"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    *_, images = re.findall(r"^image: (.*)$", done.stdout, re.M)
    folder = Path(images).parents[1]
    assert Path(images).read_bytes().startswith(b"\x89PNG")
    recall = {
        arm: json.loads((path / "photographs" / "summary.json").read_text())["recall"]["value"]
        for arm, path in [("none", folder / "none"), ("adversarial", folder)]
    }
    assert recall["adversarial"] > recall["none"]
    for arm, value in recall.items():
        assert re.search(rf"^\| {arm} .*\b{value:.3f}\b", done.stdout, re.M)
    *_, last = done.stdout.splitlines()
    page = Path(last.removeprefix("report: "))
    assert page.parent == folder and "Attack examples" in page.read_text()
