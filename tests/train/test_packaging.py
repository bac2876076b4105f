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
TINY = (
    *("data.train_per_class=4", "data.test_per_class=2", "data.validation=0.5", "augment=none"),
    "train.epochs=1",
)
KINDS = ("*.py", "*.pyi", "py.typed", "*.yaml", "*.jinja", "*.safetensors")


def installed_files() -> set[str]:
    names = set()
    for package in PACKAGES:
        for kind in KINDS:
            for path in (ROOT / package).rglob(kind):
                name = path.relative_to(ROOT).as_posix()
                names.add(re.sub("^scripts/", "pnb_scripts/", name))
    return names


def test_every_folder_of_modules_is_a_package_that_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    modules = [Path(name) for name in installed_files() if name.endswith(".py")]
    folders = {module.parent.as_posix().replace("/", ".") for module in modules}
    assert set(settings["packages"]) == folders | {"train.pretrained"}


def dependencies() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [Requirement(line) for line in project["dependencies"]]


def oldest_versions() -> dict[str, str]:
    lines = (ROOT / "tests" / "oldest.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def test_the_versions_that_are_tested_as_the_oldest_are_the_lower_bounds():
    oldest = oldest_versions()
    assert oldest.keys() == {requirement.name for requirement in dependencies()}
    for requirement in dependencies():
        bounds = [bound.version for bound in requirement.specifier if bound.operator == ">="]
        (lower,) = map(Version, bounds)
        tested = Version(oldest[requirement.name])
        assert tested.release[: len(lower.release)] == lower.release, requirement


def install(folder: Path, target: Path) -> None:
    for name in (*PACKAGES, "pretrained"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for path in [*ROOT.glob("README*"), *ROOT.glob("LICENSE*"), ROOT / "pyproject.toml"]:
        shutil.copy(path, folder)
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    pip = [sys.executable, "-m", "pip", "install", *offline, "--target", target, folder]
    subprocess.run(pip, check=True)


def write_modules_of_the_same_names(folder: Path) -> None:
    for name in (
        *("train.py", "renderer.py", "augment.py", "conf/__init__.py", "scripts/__init__.py"),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("raise SystemExit('not this')")


@pytest.mark.slow
class TestAnInstallation:
    @pytest.fixture
    def target(self, tmp_path) -> Path:
        if importlib.util.find_spec("setuptools") is None:
            pytest.skip("setuptools is not installed")
        install(tmp_path / "copy", tmp_path / "target")
        return tmp_path / "target"

    def test_has_every_file(self, target):
        names = {path.relative_to(target).as_posix() for path in target.rglob("*.*")}
        assert installed_files() <= names

    def test_runs_beside_modules_of_the_same_names(self, target, tmp_path):
        user = tmp_path / "user"
        write_modules_of_the_same_names(user)
        for path in sorted((target / "bin").glob("pnb-*")):
            assert path.name in self.run(target, user, path.name, "--help")
        attack = [
            *("network=run:pretrained/none", "attack.max_steps=1", "attack.checks=false"),
            *("attack.force=true", "renderer.shadows=false"),
        ]
        self.run(target, user, "pnb-attack", *attack, "out=out")
        self.run(target, user, "pnb-train", "--multirun", "launcher=joblib", "seed=0,1", *TINY)
        config = yaml.safe_load((user / "out" / "config.yaml").read_text())
        assert config["command"].startswith("pnb-attack ")

    def run(self, target: Path, folder: Path, command: str, *arguments: str) -> str:
        done = subprocess.run(
            [target / "bin" / command, *arguments],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(target)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout
