"""`import renderer` and the like: few names, each there, and nothing loaded before it is used."""

import importlib
import subprocess
import sys
from importlib.machinery import PathFinder

import pytest

DOORS = ["renderer", "augment"]
HEAVY = {"torch", "numpy", "trimesh", "scipy", "PIL", "moderngl"}


@pytest.mark.parametrize("package", DOORS)
def test_importing_a_package_loads_no_library_and_a_name_loads_what_it_needs(package):
    code = (
        f"import sys, {package}; before = set(sys.modules); getattr({package}, {package}.__all__[0]); "
        f"print(sorted({HEAVY} & before), 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[] True\n"


@pytest.mark.parametrize("package", DOORS)
def test_a_door_has_few_names_and_every_one_is_there(package):
    module = importlib.import_module(package)
    assert dir(module) == module.__all__ and 5 < len(module.__all__) <= 20
    for name in module.__all__:
        assert getattr(module, name).__doc__, name
        # Or importing the module would take the name's place.
        assert PathFinder.find_spec(f"{package}.{name}", module.__path__) is None


@pytest.mark.parametrize("package", DOORS)
def test_a_name_that_no_door_has_is_missed_as_usual(package):
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'rendr'"):
        _ = importlib.import_module(package).rendr
