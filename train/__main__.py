"""Train a network with and without renders, and score it: pnb-train train.epochs=10 scene.views=5"""

import logging
import os
import re
import shlex
import sys
import threading
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from train import cli  # isort: skip (first, since the others take seconds to import)

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from augment import distributed
from augment.service import ARMS
from renderer.errors import InputError
from train import checkpoint, console
from train.errors import writable_folder
from train.initial import load_initial
from train.load_data import load_data
from train.processes import Interrupted, broadcast, process_group
from train.report.compare import format_table
from train.report.page import report_of
from train.report.summary import summarize
from train.results import require_new_run
from train.run import Run
from train.run_folder import CONFIG, require_same_run, resumed, sole_writer
from train.settings import ExperimentSettings, as_override, compose, given_command, keyed, program, read_settings
from train.sweep import run_in_sweep, sweep

NAMED_MODEL = re.compile(r"^model=(?!\{)")  # short for model.name=
CHOICE = re.compile(r"^\+?(experiment|augment|data|launcher|\w+@[\w.]+)=")  # of a file of conf/
LOG = "train.log"
SWEEP_FLAGS = {"--multirun", "-m"}


def start() -> None:
    """Train what the command line asks for, in this process or in each that torchrun starts."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # or Hydra prints its errors itself, in several lines
    # A full disk in TensorBoard's thread, which the main thread raises, too, is not reported twice.
    threading.excepthook = lambda error: None if error.exc_type is OSError else threading.__excepthook__(error)
    with cli.handled_errors(), process_group():
        arguments = [NAMED_MODEL.sub("model.name=", argument) for argument in sys.argv[1:]]
        sys.argv[1:] = arguments = [as_override(argument) for argument in arguments]
        flags = {argument for argument in arguments if argument.startswith("-")}
        overrides = [argument for argument in arguments if argument not in flags]
        if flags and "TORCHELASTIC_RUN_ID" in os.environ:
            raise InputError("torchrun trains one run in several processes: start a sweep with pnb-train --multirun")
        if flags & SWEEP_FLAGS:
            sweep(main, overrides)
        elif flags:
            main()
        else:
            train(compose("train", overrides), overrides)


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="train")
def main(config: DictConfig) -> None:
    """A run of a sweep, or under another of Hydra's flags."""
    command = HydraConfig.get()
    if command.mode == RunMode.MULTIRUN:
        config.run = command.runtime.output_dir
        run_in_sweep(config, Path(config.run))
    else:
        with cli.handled_errors():  # here, too, or Hydra adds a line
            train(config, command.overrides.task)


def train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Train the arms to compare with and the arm itself in the first process's folder, and print their table."""
    given_folder, first, command = broadcast(str(config.run)), distributed.rank() == 0, given_command(overrides)
    folder = Path(given_folder).absolute()
    config.run = str(folder)
    if config.train.resume and not any(map(CHOICE.match, overrides)):  # which stand for all of a command
        config, command = resumed(config, overrides)
    settings = read_settings(ExperimentSettings, config)
    arms = {}
    for arm in settings.compare:
        with keyed("compare"):
            arms[folder / arm] = replace(settings, compare=[], augment=replace(settings.augment, arm=arm))
    arms[folder] = settings
    for path, arm_settings in arms.items():
        # Before anything is written.
        if settings.train.resume and (path / CONFIG).is_file():
            require_same_run(path, arm_settings)
        require_new_run(path, "run", settings.overwrite, settings.train.resume)
    if first:
        log_to(writable_folder(given_folder, "run") / LOG)
    try:
        with sole_writer("run", *arms) if first else nullcontext():
            initial = load_initial(settings)
            data = load_data(settings, initial)
            runs = [Run(arm_settings, data, path, initial, command) for path, arm_settings in arms.items()]
            for run in runs:  # All runs are loaded before the first trains, so that every mistake shows.
                run.load()
            for run in runs:
                arm = run.settings.augment.arm
                purpose = "" if run.folder == folder else ", for comparison"
                console.info("\n== augment=%s: %s%s", arm, ARMS[arm], purpose)
                run.fit()
                run.score()
                run.export()
            if first:
                console.info("\n%s", format_table([summarize(path) for path in arms]))
                console.info("%s", report_of([folder], folder))
    except (Interrupted, KeyboardInterrupt) as stop:
        again = shlex.join([*program("train", as_called=True), f"run={folder}", "train.resume=true"])
        advice = f"to go on: {again}" if any(map(checkpoint.exists, arms)) else "no checkpoint yet: start again"
        console.info("%s%s", f"ended by {stop.signal}; " if isinstance(stop, Interrupted) else "", advice)
        raise


def log_to(path: Path) -> None:
    """Log to the console and to a file, whose folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    handlers: list[logging.Handler] = [logging.StreamHandler(sys.stdout), file]
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # which tells of its font cache
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=handlers, force=True)


if __name__ == "__main__":
    start()
