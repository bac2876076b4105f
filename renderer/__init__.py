"""Differentiable renderer of meshes, which knows no classifier and no data set.

The public names are listed in `__init__.pyi`.
"""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
