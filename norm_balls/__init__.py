"""Test whether a classifier survives a change of light, and harden it if it does not.

    import norm_balls as nb

    scene = nb.build_scene([("orange.glb", "orange")], classifier.size)
    result = nb.attack(classifier, scene)

The package holds the public names of the renderer, the attacks, the training,
the audit and the scoring. They stand in `__init__.pyi`.

The packages of this library have short names. A user's folder may hold a train.py or a folder
conf/, which Python would import in their place. This module therefore imports them from the folder
of the library.
"""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

# The folder that this library is installed in.
_HOME = Path(__file__).resolve().parents[1]


def _import_from_home(name: str) -> None:
    """Import a package from the folder of this library, wherever `sys.path` leads."""
    path = _HOME / name / "__init__.py"
    if name in sys.modules:
        found = getattr(sys.modules[name], "__file__", None)
        if found is None or Path(found).resolve() != path:
            raise ImportError(
                f"norm_balls has a package {name!r}, but {found or 'another module'} was imported "
                f"under this name: import norm_balls before it, or rename that module"
            )
        return
    spec = spec_from_file_location(name, path, submodule_search_locations=[str(path.parent)])
    if spec is None or spec.loader is None:
        raise ImportError(f"{path.parent} is missing: install norm_balls again")
    sys.modules[name] = module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


# Each package follows those that it imports.
for _name in ("renderer", "augment", "train", "conf"):
    _import_from_home(_name)

from renderer.lazy import attach  # noqa: E402 (The packages are found above.)

__getattr__, __dir__, __all__ = attach(__name__, __file__)
