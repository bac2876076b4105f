"""The public names of the packages are all present, documented and imported when used."""

import importlib
import re
import subprocess
import sys
from collections import Counter
from importlib.machinery import PathFinder
from pathlib import Path

import pytest

PACKAGES = ["renderer", "augment", "train", "norm_balls"]
HEAVY = {"torch", "numpy", "trimesh", "scipy", "PIL", "moderngl"}


def test_importing_the_packages_loads_no_library_until_a_name_is_used():
    code = f"import sys, {', '.join(PACKAGES)}; print(sorted({HEAVY} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_all_public_names_exist_and_have_docstrings():
    for package in PACKAGES:
        module = importlib.import_module(package)
        assert dir(module) == module.__all__
        for name in module.__all__:
            assert getattr(module, name).__doc__, name
            # A module of the same name would replace the function once it is imported.
            assert PathFinder.find_spec(f"{package}.{name}", module.__path__) is None


def test_norm_balls_has_the_public_names_of_all_packages():
    packages = [importlib.import_module(name) for name in ("renderer", "augment", "train")]
    names = {name: getattr(package, name) for package in packages for name in package.__all__}
    library = importlib.import_module("norm_balls")
    assert sorted(names) == library.__all__
    assert all(getattr(library, name) is value for name, value in names.items())


@pytest.mark.parametrize("package", PACKAGES)
def test_the_version_is_that_of_the_installation(monkeypatch, package):
    monkeypatch.setattr("importlib.metadata.version", {"parametric-norm-balls": "1.2.3"}.get)
    assert importlib.import_module(package).__version__ == "1.2.3"


def test_each_public_name_is_in_one_group_of_the_reference():
    listed = Counter()
    for page in Path("docs/api").glob("*.rst"):
        _, _, names = page.read_text().partition(".. autosummary::")
        listed.update(re.findall(r"^   (\w+)$", names, re.MULTILINE))
    assert listed == Counter(importlib.import_module("norm_balls").__all__)
