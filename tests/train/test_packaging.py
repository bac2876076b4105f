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
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PACKAGES = ("norm_balls", "renderer", "augment", "train", "conf", "scripts")
TINY = (*("data.train_per_class=4", "data.test_per_class=2", "data.validation=0.5", "augment=none", "train.epochs=1"),)


def sources() -> set[str]:
    """Every file that an installation holds, relative to it."""
    kinds = ("*.py", "*.pyi", "py.typed", "*.yaml", "*.jinja", "*.safetensors")
    files = [path for name in PACKAGES for kind in kinds for path in (ROOT / name).rglob(kind)]
    return {re.sub("^scripts/", "pnb_scripts/", path.relative_to(ROOT).as_posix()) for path in files}


def test_every_folder_of_modules_is_a_package_that_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    with_modules = {Path(name).parent.as_posix().replace("/", ".") for name in sources() if name.endswith(".py")}
    assert set(settings["packages"]) == with_modules | {"train.pretrained"}


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
def test_an_installation_holds_every_file_and_runs_from_any_folder_also_beside_other_code_of_its_names(tmp_path):
    """Built from a copy, so that nothing is left in the repository."""
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("setuptools is not installed")
    copy, target = tmp_path / "copy", tmp_path / "target"
    for name in (*PACKAGES, "pretrained"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in [*ROOT.glob("README*"), *ROOT.glob("LICENSE*"), ROOT / "pyproject.toml"]:
        shutil.copy(path, copy)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", target]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, copy], check=True)
    assert sources() <= {path.relative_to(target).as_posix() for path in target.rglob("*.*")}
    environment = os.environ | {"PYTHONPATH": str(target)}
    user = tmp_path / "user"
    for name in ("train.py", "conf/__init__.py", "renderer.py", "augment.py", "scripts/__init__.py"):
        (user / name).parent.mkdir(parents=True, exist_ok=True)
        (user / name).write_text("raise SystemExit('not this')")
    small = ["attack.max_steps=1", "attack.checks=false", "attack.force=true", "renderer.shadows=false", "out=out"]
    for name, *arguments in [
        *([path.name, "--help"] for path in sorted((target / "bin").glob("pnb-*"))),
        ["pnb-attack", "classifier=run:pretrained/none", *small],
        ["pnb-train", "--multirun", "launcher=joblib", "seed=0,1", *TINY],
    ]:
        done = subprocess.run(
            [target / "bin" / name, *arguments], cwd=user, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert name in done.stdout or "--help" not in arguments
    assert yaml.safe_load((user / "out" / "config.yaml").read_text())["command"].startswith("pnb-attack ")
