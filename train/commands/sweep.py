"""Sweeps: the runs of `pnb-train --multirun`.

Each run has a folder that is named by its overrides. A finished run is not
repeated. Hydra's launchers start the runs, in this process or in others. The
results are read from the folders.
"""

import logging
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from renderer.errors import InputError
from renderer.io.files import atomic_write
from train import console
from train.command import compose, quoted, read_settings
from train.commands.experiment import LOG, logged_to
from train.report.comparison import format_short_comparison, format_table
from train.report.report_page import PAGE, report_of
from train.report.results import require_new_run, require_replaceable
from train.report.summary import is_finished, summarize
from train.runs import checkpoint
from train.runs.run_config import given_command, require_same_run
from train.runs.run_lock import FAILURE, locked, state
from train.runs.run_names import run_name
from train.settings import ExperimentSettings
from train.system.user_errors import user_message, writable_folder
from train.system.verbosity import is_verbose, shortened
from train.training.run import load_runs

# Largest number of lines of the table that `format_sweep` prints without --verbose.
MAX_TABLE_LINES = 10
# Largest number of lines of the list of unfinished runs without --verbose.
MAX_UNFINISHED = 3


def sweep(start: Callable[[], None], overrides: Sequence[str]) -> None:
    """Make all runs of a sweep, and print their table.

    Args:
        start: Starts Hydra with the words of the command line.
        overrides: The words of the command line, flags included.

    Raises:
        InputError: If two runs are the same, or a folder holds a run with other
            settings. This is checked before the first run.
        SystemExit: With status 1, if a run is not finished at the end.
    """
    runs = _expand([word for word in overrides if not word.startswith("-")])
    first = compose("train", runs[0])
    if first.photographs_first:
        raise InputError("photographs_first is not for sweeps: start the runs one by one")
    overwrite = bool(first.overwrite)
    parent = writable_folder(str(first.sweep), "sweep")
    # The folder may hold the page that an earlier call wrote about the same sweep.
    require_replaceable(parent, "sweep", overwrite, own=[PAGE])
    shared_keys = _shared_keys(runs)
    folders = [parent / run_name(words, shared_keys, str(parent)) for words in runs]
    if len(set(folders)) < len(runs):
        raise InputError("the sweep has a run twice: give each value once")
    for folder, words in zip(folders, runs, strict=True):
        _require_usable_folder(folder, words, overwrite)
    # Hydra names the folder of a run by its overrides, but for these keys.
    excluded = ",".join(map(quoted, shared_keys))
    sys.argv.append(f"hydra.job.config.override_dirname.exclude_keys=[{excluded}]")
    try:
        start()
    finally:
        print(format_sweep(folders), flush=True)
    existing = [folder for folder in folders if folder.exists()]
    print(report_of(existing, parent))
    if not all(map(is_finished, folders)):
        sys.exit(1)


def _shared_keys(runs: Sequence[Sequence[str]]) -> list[str]:
    """List the keys of the overrides that have the same value in all runs of a sweep.

    Args:
        runs: Overrides of each run, such as "train.epochs=3".
    """
    shared = set.intersection(*map(set, runs))
    return [override.partition("=")[0] for override in shared]


def _require_usable_folder(folder: Path, overrides: Sequence[str], overwrite: bool) -> None:
    """Check that a run of a sweep may write to its folder.

    Args:
        folder: Folder of the run.
        overrides: Overrides of the run.
        overwrite: Whether the run may replace results of other commands.

    Raises:
        InputError: If the folder holds a run with other settings, or results of
            another command.
    """
    if is_finished(folder) or checkpoint.exists(folder):
        settings = read_settings(ExperimentSettings, compose("train", overrides))
        require_same_run(folder, settings, finished=True)
    else:
        require_new_run(folder, "sweep", overwrite, resume=True)


def _expand(overrides: Sequence[str]) -> list[tuple[str, ...]]:
    """List the overrides of every run of a sweep, as Hydra's basic sweeper makes them.

    Args:
        overrides: Overrides of the command, such as "seed=0,1" and
            "train.epochs=3".

    Returns:
        For each combination of values, overrides such as
        ("seed=0", "train.epochs=3").
    """
    choices_of_key: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if key == "run":
            raise InputError("run= names the folder of a single run: name a sweep's with sweep=")
        if key == "launcher" and override.value() == "slurm" and not shutil.which("sbatch"):
            raise InputError(
                "launcher=slurm needs Slurm's sbatch, which is missing: "
                "start the sweep on the cluster",
            )
        if override.is_sweep_override():
            values = list(override.sweep_string_iterator())
        else:
            values = [override.get_value_element_as_str()]
        choices_of_key[key] = [f"{key}={value}" for value in values]
    return list(product(*choices_of_key.values()))


def run_in_sweep(config: DictConfig) -> None:
    """Make a run of a sweep in its folder, or resume it, unless it is finished.

    The reason of a failure is written to failed.txt. SystemExit and
    KeyboardInterrupt stop the sweep.

    Args:
        config: The configuration of the run. `config.run` is its folder.
    """
    folder = Path(config.run)
    with locked(folder) as has_lock:
        if not has_lock:
            _print_detail(f"in training elsewhere: {folder}")
        elif is_finished(folder):
            _print_detail(f"finished before: {folder}")
        else:
            (folder / FAILURE).unlink(missing_ok=True)
            _print_detail(f"training: {folder}")
            _run_and_record_failure(config, folder)


def _print_detail(line: str) -> None:
    """Print a line about one run of a sweep if details are printed."""
    if is_verbose():
        print(line, flush=True)


def _run_and_record_failure(config: DictConfig, folder: Path) -> None:
    """Make a run of a sweep, and write the reason to failed.txt if it fails.

    Args:
        config: Configuration of the run.
        folder: Folder of the run.
    """
    job = HydraConfig.get()
    # The runs of joblib's launcher print at the same time.
    shares_console = "n_jobs" in job.launcher
    prefix = f"#{job.job.num} " if shares_console else ""
    with logged_to(folder / LOG, prefix, level=logging.CRITICAL):
        try:
            _run(config, folder, list(job.overrides.task))
        except Exception as error:
            sentence = user_message(error)
            reason = sentence or traceback.format_exception_only(error)[-1].strip()
            # If `user_message` has no sentence, the error is a fault of the program.
            # It is shown with its traceback.
            console.error("failed: %s", reason, exc_info=None if sentence else error)
            # If the disk is full, the console alone shows the reason.
            with suppress(OSError):
                atomic_write(folder / FAILURE, f"{reason}\n")


def _run(config: DictConfig, folder: Path, overrides: Sequence[str]) -> None:
    """Train, score and export a run. If it has a checkpoint, it is resumed from there.

    Args:
        config: Configuration of the run.
        folder: Folder of the run.
        overrides: Overrides of the run, as Hydra's sweeper writes them.
    """
    settings = read_settings(ExperimentSettings, config)
    settings.train.resume = checkpoint.exists(folder)
    command = given_command([_unescaped(override) for override in overrides])
    (run,) = load_runs({folder: settings}, command)
    run.fit()
    run.score()
    run.export()


def _unescaped(override: str) -> str:
    r"""Quote a text that Hydra's sweeper escapes: path='a b' instead of path=a\ b."""
    value = OverridesParser.create().parse_override(override).value()
    if "\\" in override and isinstance(value, str):
        key = override.partition("=")[0]
        return f"{key}={quoted(value)}"
    return override


def format_sweep(folders: Sequence[Path]) -> str:
    """Write the results of a sweep.

    Args:
        folders: Folders of all runs of the sweep.

    Returns:
        The number of finished runs, their table with means over several seeds,
        and the state of the other runs. Without --verbose, the table and the
        list are short.
    """
    finished = [folder for folder in folders if is_finished(folder)]
    lines = [f"{len(finished)} of {len(folders)} runs are finished", ""]
    unfinished = [folder for folder in folders if folder not in finished]
    if finished:
        runs = [summarize(folder) for folder in finished]
        table = format_table(runs) if is_verbose() else format_short_comparison(runs)
        # Only a few rows fit beside a list of unfinished runs.
        limit = MAX_TABLE_LINES - MAX_UNFINISHED if unfinished else MAX_TABLE_LINES
        lines += shortened(table.splitlines(), limit)
    if unfinished:
        states = [f"{folder}: {state(folder)}" for folder in unfinished]
        lines += shortened(states, MAX_UNFINISHED)
        lines.append("to go on, give the same command again")
    return "\n".join(lines)
