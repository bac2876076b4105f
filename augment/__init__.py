"""Renders labeled images for a classifier and attacks it. Optimizers and data sets are in `train`.

The public names are listed in `__init__.pyi`.
"""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
