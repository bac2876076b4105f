"""The experiment: data, network, training loop, checkpoints, photographs and logs.

The public names stand in `__init__.pyi`.
"""

import logging

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
# Lines for the console and, in a run, for its train.log.
console = logging.getLogger("train")
