"""Imports the public names of a package when they are first used (PEP 562).

The names are listed only once, as imports in the stub `__init__.pyi` beside the package's
`__init__.py`. Type checkers and editors read the same stub.
"""

from __future__ import annotations

import ast

# Type checkers take this for true. To import typing would take longer than all
# of this module.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable


def attach(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Make the public names of a package from its stub.

    Args:
        package: `__name__` of the package.
        file: `__file__` of the package. The stub lies beside it.

    Returns:
        `__getattr__`, `__dir__` and `__all__` of the package.

    Example:
        >>> import renderer
        >>> attach("renderer", renderer.__file__)[2][0]
        'Camera'
    """
    modules = _read_stub(f"{file}i")
    names = sorted(modules)

    def get_attribute(name: str) -> object:
        if name == "__version__":
            from importlib.metadata import version

            return version("parametric-norm-balls")
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        # The name may be a module, too, as in `from module import name`.
        return getattr(__import__(modules[name], fromlist=[name]), name)

    return get_attribute, lambda: names, names


def _read_stub(path: str) -> dict[str, str]:
    """Return the module that each name of a stub is imported from."""
    with open(path, encoding="utf-8") as stub:
        tree = ast.parse(stub.read())
    return {
        alias.name: str(statement.module)
        for statement in tree.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
