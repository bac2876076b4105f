"""`import norm_balls` works beside a user's own train.py, augment.py, renderer.py and conf/."""

import subprocess
import sys
from pathlib import Path

import pytest

OTHER_PREFIX = ("renderer.py", "augment.py", "train.py", "conf/__init__.py")
USE = """
import norm_balls as nb

light = nb.load_light("grace")
image = nb.render(nb.solid("pear"), nb.orbit_cameras(1, 2.4), light, size=8)
assert image.isfinite().all() and image.max() > 0
assert nb.load_run("pretrained/none").size == 32
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder whose modules must not be imported by the library."""
    for name in OTHER_PREFIX:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("raise SystemExit('this module is not the library')")
    return tmp_path


def run(folder: Path | None, *arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
def test_a_script_named_train_uses_the_library(folder):
    (folder / "train.py").write_text(USE)
    done = run(folder, "train.py")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["renderer", "augment", "train", "conf"])
def test_a_foreign_module_that_was_imported_first_is_named(tmp_path, name):
    (tmp_path / f"{name}.py").write_text("")
    done = run(tmp_path, "-c", f"import sys; sys.path[0] = '.'; import {name}, norm_balls")
    last_line = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1
    assert last_line.startswith("ImportError: ")
    assert str(tmp_path / name) in last_line


@pytest.mark.slow
def test_packages_of_the_library_that_were_imported_before_stay():
    done = run(None, "-c", "import renderer, norm_balls as nb; assert nb.render is renderer.render")
    assert done.returncode == 0, done.stderr
