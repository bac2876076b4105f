"""The public names of renderer and augment: few, all present, and lazily imported."""

import importlib
import subprocess
import sys
from importlib.machinery import PathFinder

import pytest

PACKAGES = ["renderer", "augment"]
HEAVY = {"torch", "numpy", "trimesh", "scipy", "PIL", "moderngl"}


def test_importing_the_packages_loads_no_library_until_a_name_is_used():
    code = f"import sys, {', '.join(PACKAGES)}; print(sorted({HEAVY} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("package", PACKAGES)
def test_all_public_names_exist_and_have_docstrings(package):
    module = importlib.import_module(package)
    assert dir(module) == module.__all__ and 5 < len(module.__all__) <= 30
    for name in module.__all__:
        assert getattr(module, name).__doc__, name
        # A module of the same name would replace the function once it is imported.
        assert PathFinder.find_spec(f"{package}.{name}", module.__path__) is None


@pytest.mark.parametrize("package", [*PACKAGES, "train"])
def test_the_version_is_that_of_the_installation(monkeypatch, package):
    monkeypatch.setattr("importlib.metadata.version", {"parametric-norm-balls": "1.2.3"}.get)
    assert importlib.import_module(package).__version__ == "1.2.3"


@pytest.mark.parametrize("package", PACKAGES)
def test_an_unknown_name_raises_attribute_error(package):
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'rendr'"):
        _ = importlib.import_module(package).rendr
