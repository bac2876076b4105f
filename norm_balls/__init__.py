"""Test whether a classifier survives a change of light, and harden it if it does not.

    import norm_balls as nb

    scene = nb.build_scene([("orange.glb", "orange")], classifier.size)
    result = nb.attack(classifier, scene)

The package holds the public names of the renderer, the attacks, the training,
the audit and the scoring. They stand in `__init__.pyi`.
"""

from norm_balls.siblings import import_siblings

import_siblings()

from renderer.lazy import attach  # noqa: E402 (The packages are found above.)

__getattr__, __dir__, __all__ = attach(__name__, __file__)
