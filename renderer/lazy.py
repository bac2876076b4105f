"""A package's names, each imported with its module when it is first used (PEP 562)."""

from __future__ import annotations

TYPE_CHECKING = False  # as type checkers know it; to import typing would take longer than all of this
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


def attach(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose names come from modules below it.

    A module's own name stands for the module, unless it has such an attribute. No other name may be that of a module
    directly in the package, which importing the module would put in its place. `__version__` is the installation's.
    """
    home = {name: module for module, names in modules.items() for name in names}

    def getattribute(name: str) -> object:
        if name == "__version__":
            from importlib.metadata import version

            return version("parametric-norm-balls")
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        from importlib import import_module

        module = import_module(f"{package}.{home[name]}")
        return getattr(module, name, module)

    return getattribute, lambda: sorted(home), sorted(home)
