"""pnb-train: the runs of one command, and the table that compares them."""

import logging
import shlex
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from augment import distributed
from augment.settings import ARMS
from train import console
from train.command import program, read_settings
from train.commands.results import require_new_run
from train.data.load import load_data
from train.report.comparison import format_table
from train.report.report_page import report_of
from train.report.summary import summarize
from train.runs import checkpoint
from train.runs.run_folder import CONFIG, given_command, require_same_run, resumed, sole_writer
from train.settings import ExperimentSettings
from train.system.processes import Interrupted, broadcast, process_group
from train.system.user_errors import keyed, writable_folder
from train.training.initial import load_initial
from train.training.run import Run

CHOICES = ("experiment", "augment", "data", "launcher")  # groups of conf/
LOG = "train.log"


def train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Train what a command asks for, in this process or in each that torchrun starts.

    Args:
        config: The configuration of the command.
        overrides: Its overrides.
    """
    # A full disk in TensorBoard's thread, which the main thread raises, too, is not reported twice.
    threading.excepthook = lambda error: None if error.exc_type is OSError else threading.__excepthook__(error)
    with process_group():
        _train(config, overrides)


def _train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Train the arms to compare with and the arm itself in the first process's folder, and print their table."""
    run, first, command = broadcast(str(config.run)), distributed.rank() == 0, given_command(overrides)
    folder = Path(run).absolute()
    config.run = str(folder)
    if config.train.resume and not any(map(_is_choice, overrides)):  # which stand for all of a command
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
    log = logged_to(writable_folder(run, "run") / LOG) if first else nullcontext()
    with log:
        try:
            with sole_writer("run", *arms) if first else nullcontext():
                _train_arms(arms, folder, command)
        except (Interrupted, KeyboardInterrupt) as stop:
            again = [*program("train", as_called=True), f"run={folder}", "train.resume=true"]
            advice = "no checkpoint yet: start again"
            if any(map(checkpoint.exists, arms)):
                advice = f"to go on: {shlex.join(again)}"
            cause = f"ended by {stop.signal}; " if isinstance(stop, Interrupted) else ""
            console.info("%s%s", cause, advice)
            raise


def _train_arms(arms: dict[Path, ExperimentSettings], folder: Path, command: str) -> None:
    """Train each arm in its folder, the main one last in `folder`, and compare them."""
    main = arms[folder]
    initial = load_initial(main)
    data = load_data(main, initial.size if initial else None)
    runs = [Run(settings, data, path, initial, command) for path, settings in arms.items()]
    for run in runs:  # All are loaded before the first one trains, so that every mistake shows.
        run.load()
    for run in runs:
        arm = run.settings.augment.arm
        purpose = "" if run.folder == folder else ", for comparison"
        console.info("\n== augment=%s: %s%s", arm, ARMS[arm], purpose)
        run.fit()
        run.score()
        run.export()
    if distributed.rank() == 0:
        console.info("\n%s", format_table([summarize(path) for path in arms]))
        console.info("%s", report_of([folder], folder))


def _is_choice(override: str) -> bool:
    """Tell whether an override chooses a file of conf/."""
    key = override.partition("=")[0]
    return key in CHOICES or "@" in key


@contextmanager
def logged_to(path: Path, prefix: str = "") -> Iterator[None]:
    """Log to the console and to a file, until the block ends.

    Args:
        path: The file. Its folder is made.
        prefix: Text before each line on the console.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    terminal = logging.StreamHandler(sys.stdout)
    file.setFormatter(logging.Formatter("%(message)s"))
    terminal.setFormatter(logging.Formatter(f"{prefix}%(message)s"))
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it reports its font cache
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.INFO)
    for handler in (terminal, file):
        root.addHandler(handler)
    try:
        yield
    finally:
        root.setLevel(level)
        for handler in (terminal, file):
            root.removeHandler(handler)
            handler.close()
