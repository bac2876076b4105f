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
        [sys.executable, "-m", "train"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    *_, sheet = re.findall(r"^image: (.*)$", done.stdout, re.M)
    folder = Path(sheet).parents[1]
    assert Path(sheet).read_bytes().startswith(b"\x89PNG")
    auc = {
        network: json.loads((path / "laboratory" / "summary.json").read_text())["auc"]["value"]
        for network, path in [("the initial network", folder / "before"), ("random", folder)]
    }
    assert auc["random"] > auc["the initial network"] + 0.05
    for network, value in auc.items():
        assert re.search(rf"^\| {network} .*\b{value:.3f}\b", done.stdout, re.M)
    *_, last = done.stdout.splitlines()
    page = Path(last.removeprefix("report: "))
    assert page.parent == folder and "Examples of renders" in page.read_text()
