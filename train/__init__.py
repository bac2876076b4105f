"""The experiment: data, network, training loop, checkpoints, photographs and logs."""

import logging

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, {"runs.saved_networks": ["load_run"]})
console = logging.getLogger("train")  # lines for the console and, in a run, its train.log
