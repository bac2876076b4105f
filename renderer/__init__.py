"""Scene to pixels, and pixel gradients to scene parameters. Knows no classifier and no data set.

The public names stand in `__init__.pyi`.
"""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
