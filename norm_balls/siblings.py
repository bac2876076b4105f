"""Imports the packages of this library from its own folder.

Their names are short. A user's folder may hold a train.py or a folder conf/,
which Python would import in their place.
"""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

# The folder that this library is installed in.
HOME = Path(__file__).resolve().parents[1]
# The packages of this library, each after those that it imports.
SIBLINGS = ("renderer", "augment", "train", "conf")


def import_siblings() -> None:
    """Import each package from the folder of this library."""
    for name in SIBLINGS:
        if name in sys.modules:
            _require_own(name)
        else:
            _import_from_home(name)


def _require_own(name: str) -> None:
    """Raise ImportError if the imported module of this name is another one."""
    expected = HOME / name / "__init__.py"
    found = getattr(sys.modules[name], "__file__", None)
    if found is None or Path(found).resolve() != expected:
        raise ImportError(
            f"norm_balls has a package {name!r}, but {found or 'another module'} was imported "
            f"under this name: import norm_balls before it, or rename that module"
        )


def _import_from_home(name: str) -> None:
    """Import a package from the folder of this library, wherever `sys.path` leads."""
    folder = HOME / name
    spec = spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{folder} is missing: install norm_balls again")
    package = module_from_spec(spec)
    sys.modules[name] = package
    try:
        spec.loader.exec_module(package)
    except BaseException:
        del sys.modules[name]
        raise
