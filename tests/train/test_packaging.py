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
    files = [path for name in PACKAGES for kind in ("*.py", "*.yaml") for path in (ROOT / name).rglob(kind)]
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
    assert "experiment: best, cpu, demo, fast" in done.stdout and "learning_rate" in done.stdout


README_BLOCKS = """
import pathlib, re, sys
import torch, trimesh
from torch import nn
import augment, renderer, train
readme, where = sys.argv[1:]
assert all(pathlib.Path(module.__file__).is_relative_to(where) for module in (augment, renderer, train))
trimesh.creation.icosphere(2).export("orange.glb")
CLASSES = [*map(str, range(99)), "orange"]
class Data(torch.utils.data.Dataset):
    __len__ = lambda self: 8
    __getitem__ = lambda self, index: (torch.full((3, 32, 32), index / 8), index)
for block in re.findall(r"```python\\n(.*?)```", pathlib.Path(readme).read_text(), re.DOTALL):
    network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 100))
    network[2].bias.data[99] = 9.0
    optimizer = torch.optim.SGD(network.parameters(), lr=0.01)
    exec(block, dict(torch=torch, network=network, CLASSES=CLASSES, data=Data(), optimizer=optimizer))
"""
USER_NETWORK = """
from torch import nn
def build():
    return nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 2)), 24, ["orange", "plum"]
"""


@pytest.mark.slow
def test_the_examples_of_the_readme_run_from_an_installation_in_an_empty_folder(installed, tmp_path):
    (tmp_path / "mine.py").write_text(USER_NETWORK)
    network = "classifier=python:mine:build"
    attack = [str(ROOT / "scripts" / "attack.py"), network, "attack.force=true", "attack.checks=false", "out=attacked"]
    env = os.environ | {"PYTHONPATH": str(installed), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    for arguments in (["-c", README_BLOCKS, str(ROOT / "README.md"), str(installed)], attack):
        done = subprocess.run([sys.executable, *arguments], cwd=tmp_path, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "adversaries" / "attack.jsonl").is_file() and any((tmp_path / "attacked").rglob("attack.jsonl"))
