"""Import the public names of a package when they are first used (PEP 562).

The names are listed only once, as imports in the stub file `__init__.pyi` of the package. Type
checkers and editors read the same stub file.
"""

from __future__ import annotations

import ast

# Type checkers treat a variable with this name as True. Importing the
# variable from `typing` would take longer than the rest of this module.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable


def attach(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Create the module functions that import public names of a package on first use.

    The public names are the names that the stub file `__init__.pyi` imports. The results
    are values for `__getattr__`, `__dir__` and `__all__`, and `file` is the package's
    `__file__`.
    """
    with open(f"{file}i", encoding="utf-8") as stub:
        statements = ast.parse(stub.read()).body
    imports = [statement for statement in statements if isinstance(statement, ast.ImportFrom)]
    # Module that defines each public name.
    modules = {alias.name: str(item.module) for item in imports for alias in item.names}
    names = sorted(modules)

    def get_attribute(name: str) -> object:
        """Import the module that defines a public name, and return the value of the name."""
        if name == "__version__":
            from importlib.metadata import version

            return version("parametric-norm-balls")
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        # If `name` is a submodule, `fromlist` makes __import__ import it, too.
        return getattr(__import__(modules[name], fromlist=[name]), name)

    return get_attribute, lambda: names, names
