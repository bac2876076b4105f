"""Train the runs of one pnb-train command, and print the table that compares them."""

import logging
import shlex
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from augment import distributed
from augment.settings import MODES
from train import console
from train.command import compose, program, read_settings
from train.report.comparison import format_short_comparison, format_table
from train.report.report_page import report_of
from train.report.results import require_new_run
from train.report.summary import is_finished, summarize
from train.runs import checkpoint
from train.runs.run_config import CONFIG, given_command, require_same_run, resumed
from train.runs.run_lock import sole_writer
from train.settings import ExperimentSettings
from train.system.processes import Interrupted, broadcast, process_group
from train.system.user_errors import keyed, writable_folder
from train.system.verbosity import is_verbose
from train.training.initial import with_label
from train.training.run import load_runs

# Folders of conf/ from which an override can choose a file.
CHOICES = ("experiment", "augment", "data", "launcher")
# File with the lines that a run prints.
LOG = "train.log"
# Sub-folder of the training on photographs, see `photographs_first`.
PHOTOGRAPHS = "photographs"
# Settings that the training on photographs has in common with the training after it.
SHARED = ("seed", "overwrite", "data", "weights", "classes", "normalization", "normalize_light")
SHARED_IN_TRAIN = (
    *("init_from", "precision", "device", "threads", "deterministic", "checkpoint_every"),
    *("resume", "cache"),
)


def train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Train the runs of a command, in this process or in each process of torchrun.

    Args:
        config: Configuration of the command.
        overrides: Overrides of the command, such as "train.epochs=3".
    """
    threading.excepthook = _report_thread_error
    with process_group():
        _train(config, overrides)


def _report_thread_error(error: threading.ExceptHookArgs) -> None:
    """Print the error of a thread, unless it is an OSError.

    On a full disk, the thread of TensorBoard raises OSError. The main thread
    raises this error, too, so that it would be printed twice.
    """
    if error.exc_type is not OSError:
        threading.__excepthook__(error)


def _train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Check all settings, and then train the baselines and the main run.

    All processes write to the folder of rank 0, since the default name of the
    folder has the time at which a process started.

    Args:
        config: Configuration of the command. Its `run` becomes an absolute path.
        overrides: Overrides of the command.
    """
    command = given_command(overrides)
    folder = Path(broadcast(str(config.run))).absolute()
    config.run = str(folder)
    # A chosen file sets many values. Only single values can change when a run
    # continues with the settings that it began with.
    if config.train.resume and not any(map(_is_choice, overrides)):
        config, command = resumed(config, overrides)
    settings = with_label(read_settings(ExperimentSettings, config))
    if settings.photographs_first:
        settings = _train_on_photographs(settings, folder, command)
    _train_in(folder, settings, command, program("train", as_called=True))


def _train_on_photographs(
    settings: ExperimentSettings, folder: Path, command: str
) -> ExperimentSettings:
    """Train on photographs as the setting `photographs_first` asks.

    A training that an earlier command finished is not repeated.

    Args:
        settings: Settings of the command.
        folder: Folder of the run.
        command: Command that was given.

    Returns:
        Settings of the training that begins with the result.
    """
    first = folder / PHOTOGRAPHS
    values = asdict(settings)
    changes = {name: values[name] for name in SHARED}
    changes["run"] = str(first)
    changes["train"] = {name: values["train"][name] for name in SHARED_IN_TRAIN}
    config = OmegaConf.merge(compose("train", ["experiment=photographs"]), changes)
    on_photographs = read_settings(ExperimentSettings, cast(DictConfig, config))
    if settings.train.resume and is_finished(first):
        require_same_run(first, on_photographs, finished=True)
    else:
        # The folder of the run has no settings yet, which a short command could read.
        _train_in(first, on_photographs, command, shlex.split(command), folder)
    return replace(
        settings,
        photographs_first=False,
        train=replace(settings.train, init_from=str(first)),
        # The first network has these.
        weights=None,
        classes=None,
        normalization=None,
    )


def _train_in(
    folder: Path,
    settings: ExperimentSettings,
    command: str,
    resuming: Sequence[str],
    whole: Path | None = None,
) -> None:
    """Train the baselines and the main run in a folder.

    Args:
        folder: Folder of the main run.
        settings: Settings of the main run.
        command: Command that was given, which each run records.
        resuming: Words before run=FOLDER and train.resume=true in the command
            that continues the training.
        whole: This FOLDER. None for `folder`.
    """
    methods = _list_methods(settings, folder)
    for path, method_settings in methods.items():
        if settings.train.resume and (path / CONFIG).is_file():
            require_same_run(path, method_settings)
        require_new_run(path, "run", settings.overwrite, settings.train.resume)
    is_first = distributed.rank() == 0
    log = logged_to(writable_folder(str(folder), "run") / LOG) if is_first else nullcontext()
    with log:
        try:
            with sole_writer("run", *methods) if is_first else nullcontext():
                _train_methods(methods, folder, command)
        except (Interrupted, KeyboardInterrupt) as stop:
            cause = f"ended by {stop.signal}; " if isinstance(stop, Interrupted) else ""
            advice = "no checkpoint yet: start again"
            if any(map(checkpoint.exists, methods)):
                words = [*resuming, f"run={whole or folder}", "train.resume=true"]
                advice = f"to go on: {shlex.join(words)}"
            console.info("%s%s", cause, advice)
            raise


def _list_methods(settings: ExperimentSettings, folder: Path) -> dict[Path, ExperimentSettings]:
    """List the settings of all runs of a command.

    Args:
        settings: Settings of the main run. `compare` names the kinds of renders
            of the baselines.
        folder: Folder of the main run.

    Returns:
        Settings by folder. Each baseline has a sub-folder with the name of its
        kind of renders. The main run is the last.
    """
    methods = {}
    for method in settings.compare:
        with keyed("compare"):
            augment = replace(settings.augment, mode=method)
            methods[folder / method] = replace(settings, compare=[], augment=augment)
    methods[folder] = settings
    return methods


def _train_methods(
    methods: Mapping[Path, ExperimentSettings],
    folder: Path,
    command: str,
) -> None:
    """Train all runs of a command, and print a table that compares them.

    Args:
        methods: Settings of each run by its folder.
        folder: Folder of the main run, which gets the report.
        command: Command that was given, which each run records.
    """
    for run in load_runs(methods, command):
        method = run.settings.augment.mode
        purpose = "" if run.folder == folder else ", for comparison"
        console.debug("\n== augment=%s: %s%s", method, MODES[method], purpose)
        run.fit()
        run.score()
        run.export()
    if distributed.rank() == 0:
        summaries = [summarize(path) for path in methods]
        console.debug("\n%s\n", format_table(summaries))
        console.info("%s\n", format_short_comparison(summaries))
        console.info("%s", report_of([folder], folder))


def _is_choice(override: str) -> bool:
    """Return whether an override chooses a file of conf/."""
    key = override.partition("=")[0]
    return key in CHOICES or "@" in key


class _QuietHandler(logging.Handler):
    """Handler that ignores its own errors.

    On a full disk, train.log lacks lines. The run itself then raises an error,
    which is the only one that the user sees.
    """

    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore the error, where `logging` would print a traceback."""


class _LogFile(_QuietHandler, logging.FileHandler):
    """Handler that writes to a file."""


class _Terminal(_QuietHandler, logging.StreamHandler):
    """Handler that writes to the console."""


@contextmanager
def logged_to(path: Path, prefix: str = "", level: int = logging.INFO) -> Iterator[None]:
    """Log to a file, and what is no detail also to the console, until the block ends.

    With --verbose, the console shows details, too.

    Args:
        path: The file. If its folder does not exist, it is made.
        prefix: Text before each line on the console.
        level: Lowest level of the lines on the console, without --verbose.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    terminal = _Terminal(sys.stdout)
    file.setFormatter(logging.Formatter("%(message)s"))
    terminal.setFormatter(logging.Formatter(f"{prefix}%(message)s"))
    # Matplotlib reports that it builds its font cache.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    root = logging.getLogger()
    level_before = root.level
    root.setLevel(logging.INFO)
    console.setLevel(logging.DEBUG)
    terminal.setLevel(logging.DEBUG if is_verbose() else level)
    for handler in (terminal, file):
        root.addHandler(handler)
    try:
        yield
    finally:
        root.setLevel(level_before)
        console.setLevel(logging.NOTSET)
        for handler in (terminal, file):
            root.removeHandler(handler)
            handler.close()
