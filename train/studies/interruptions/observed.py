"""`python -m train` that tells which phase it is in: python -m train.studies.interruptions.observed FILE run=...

FILE holds one byte, which this process and the one that interrupts it both map into memory: it can be read at any
moment, needs no room on a disk, and is right when the process is killed.
"""

import sys
from collections.abc import Callable
from functools import wraps
from mmap import mmap
from typing import Any

from train import experiment
from train.__main__ import start
from train.fit.trainer import Trainer
from train.run_folder import checkpoint
from train.run_folder.logs import RunLog

PHASES: dict[str, list[tuple[object, str]]] = {  # entered with a function, and left with it
    "attack": [(Trainer, "_regenerate")],
    "training": [(Trainer, "fit"), (Trainer, "_train")],
    "evaluation": [(Trainer, "_end_epoch")],
    "log": [(RunLog, "scalars"), (RunLog, "renders")],
    "checkpoint": [(checkpoint, "save")],
    "scoring": [(experiment, "_test_scores"), (experiment, "_photograph_scores")],
}
NAMES = ("", *PHASES)  # by the byte; the first is outside them all


def observe(memory: mmap) -> None:
    """Let the innermost phase that this process is in be known from now on."""
    for number, functions in enumerate(PHASES.values(), start=1):
        for owner, name in functions:
            setattr(owner, name, _telling(getattr(owner, name), number, memory))


def _telling(function: Callable[..., Any], number: int, memory: mmap) -> Callable[..., Any]:
    @wraps(function)
    def told(*arguments: Any, **keywords: Any) -> Any:
        before, memory[0] = memory[0], number
        try:
            return function(*arguments, **keywords)
        finally:
            memory[0] = before

    return told


if __name__ == "__main__":
    with open(sys.argv.pop(1), "r+b") as file:
        observe(mmap(file.fileno(), 1))
    start()
