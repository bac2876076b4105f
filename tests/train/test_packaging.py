import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("renderer", "augment", "train", "conf")


def sources() -> set[str]:
    """Every file that an installation needs, relative to the repository."""
    files = [path for name in PACKAGES for kind in ("*.py", "*.yaml") for path in (ROOT / name).rglob(kind)]
    return {path.relative_to(ROOT).as_posix() for path in files}


def test_every_folder_of_modules_is_a_package_that_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    with_modules = {Path(name).parent.as_posix().replace("/", ".") for name in sources() if name.endswith(".py")}
    assert set(settings["packages"]) == with_modules


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with an installation, built from a copy so that nothing is left in the repository."""
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("setuptools is not installed")
    copy, target = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("target")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in [*ROOT.glob("README*"), *ROOT.glob("LICENSE*"), ROOT / "pyproject.toml"]:
        shutil.copy(path, copy)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", target]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, copy], check=True)
    return target


@pytest.mark.slow
def test_an_installation_holds_every_module_and_configuration(installed):
    found = {path.relative_to(installed).as_posix() for name in PACKAGES for path in (installed / name).rglob("*.*")}
    assert sources() <= found
    assert {"conf/train.yaml", "conf/experiment/paper.yaml", "train/photographs/__init__.py"} <= found


@pytest.mark.slow
def test_an_installation_runs_from_any_folder(installed, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "train", "--help"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("train is powered by Hydra")
    assert "experiment: cpu, demo, fast, paper" in done.stdout and "learning_rate" in done.stdout
