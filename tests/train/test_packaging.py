import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PACKAGES = ("norm_balls", "renderer", "augment", "train", "conf", "scripts")
DATA = (".pyi", ".yaml", ".jinja", ".safetensors", ".typed", ".json", ".js")


def test_every_folder_of_modules_is_a_package_that_is_installed_with_its_data():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders, data = set(), set()
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.*"):
            name = re.sub("^scripts/", "pnb_scripts/", path.relative_to(ROOT).as_posix())
            if path.suffix == ".py":
                folders.add(name.rpartition("/")[0].replace("/", "."))
            elif path.suffix in DATA:
                data.add(name)
    assert set(settings["packages"]) == folders | {"train.pretrained"}
    installed = set()
    for package, patterns in settings["package-data"].items():
        folder = settings["package-dir"].get(package, package.replace(".", "/"))
        for pattern in patterns:
            installed |= {
                path.relative_to(ROOT).as_posix() for path in (ROOT / folder).glob(pattern)
            }
    assert data <= installed


def dependencies() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [Requirement(line) for line in project["dependencies"]]


def test_the_versions_that_are_tested_as_the_oldest_are_the_lower_bounds():
    lines = (ROOT / "tests" / "oldest.txt").read_text().splitlines()
    oldest = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert oldest.keys() == {requirement.name for requirement in dependencies()}
    for requirement in dependencies():
        bounds = [bound.version for bound in requirement.specifier if bound.operator == ">="]
        (lower,) = map(Version, bounds)
        tested = Version(oldest[requirement.name])
        assert tested.release[: len(lower.release)] == lower.release, requirement
