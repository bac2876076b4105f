"""The experiment: data, network, training loop, checkpoints, photographs and logs."""

import logging

console = logging.getLogger("train")  # lines for the console and, in a run, its train.log
