import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PACKAGES = ("renderer", "augment", "train", "conf")


def sources() -> set[str]:
    """Every file that an installation needs, relative to the repository."""
    kinds = ("*.py", "*.yaml", "*.jinja", "*.safetensors")
    files = [path for name in PACKAGES for kind in kinds for path in (ROOT / name).rglob(kind)]
    return {path.relative_to(ROOT).as_posix() for path in files}


def test_every_folder_of_modules_is_a_package_that_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    with_modules = {Path(name).parent.as_posix().replace("/", ".") for name in sources() if name.endswith(".py")}
    assert set(settings["packages"]) == with_modules


def dependencies() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [Requirement(line) for line in project["dependencies"]]


def test_the_versions_that_are_tested_as_the_oldest_are_the_lower_bounds():
    lines = [line for line in (ROOT / "tests" / "oldest.txt").read_text().splitlines() if not line.startswith("#")]
    oldest = dict(line.split("==") for line in lines)
    assert oldest.keys() == {requirement.name for requirement in dependencies()}
    for requirement in dependencies():
        (lower,) = (Version(bound.version) for bound in requirement.specifier if bound.operator == ">=")
        assert Version(oldest[requirement.name]).release[: len(lower.release)] == lower.release, requirement


@pytest.mark.parametrize("name", [requirement.name for requirement in dependencies()])
def test_dependencies_have_permissive_licenses(name):
    about = importlib.metadata.metadata(name)
    classifiers = [line for line in about.get_all("Classifier", []) if line.startswith("License")]
    words = " ".join([about.get("License-Expression") or "", (about.get("License") or "")[:100], *classifiers])
    assert re.search(r"MIT|BSD|Apache|Python Software Foundation|MPL-2.0", words) and "GPL" not in words


@pytest.mark.slow
def test_an_installation_holds_every_file_and_runs_from_any_folder(tmp_path):
    """Built from a copy, so that nothing is left in the repository."""
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("setuptools is not installed")
    copy, target = tmp_path / "copy", tmp_path / "target"
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in [*ROOT.glob("README*"), *ROOT.glob("LICENSE*"), ROOT / "pyproject.toml"]:
        shutil.copy(path, copy)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", target]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, copy], check=True)
    assert sources() <= {path.relative_to(target).as_posix() for path in target.rglob("*.*")}
    environment = os.environ | {"PYTHONPATH": str(target)}
    command = [sys.executable, "-m", "train", "--help"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "experiment: best, cpu, demo, fast" in done.stdout and "learning_rate" in done.stdout
