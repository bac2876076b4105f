"""Sweeps: several training runs that one command, `pnb-train --multirun`, starts.

The command line has several values for some settings, such as seed=0,1. There is a
training run for each combination of values. Its folder is named after the settings
that differ between the runs. A finished run is not repeated. Hydra's launchers start
the runs in this process or in others. The results are read from the folders.
"""

import logging
import os
import re
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from renderer.errors import InputError
from renderer.io.files import atomic_write
from train import checkpoints, console
from train.__main__ import main, run_name
from train.cli import quoted, read_settings
from train.commands.experiment import LOG, logged_to
from train.results.compare import format_comparison, format_short_comparison
from train.results.overwrite import require_new_run, require_replaceable
from train.results.page import PAGE, report_of
from train.results.store import is_finished, summarize
from train.run_config import format_command, require_same_run
from train.run_folder import FAILURE, locked, state, writable_folder
from train.settings import ExperimentSettings
from train.system import is_verbose, shortened, user_message
from train.training.inputs import load_inputs, with_label
from train.training.run import Run

# Largest number of lines of the table of finished runs, if --verbose is not set.
MAX_TABLE_LINES = 10
# Largest number of unfinished runs that are listed, if --verbose is not set.
MAX_UNFINISHED = 3


def sweep(
    start: Callable[[], None], runs: Sequence[Sequence[str]], first_config: DictConfig
) -> None:
    """Train all runs of a sweep, print a table of their results, and write a report.

    Wrong settings, and folders of other runs, are found before any training. The exit status is 1
    if a run is not finished.
    """
    # torchrun sets this variable in the processes that it starts.
    if "TORCHELASTIC_RUN_ID" in os.environ:
        raise InputError("torchrun cannot start a sweep: start it with pnb-train --multirun")
    if any(override.startswith("out=") for override in runs[0]):
        raise InputError("out= is the folder of a single run: name that of a sweep with sweep=")
    if "launcher=slurm" in runs[0] and not shutil.which("sbatch"):
        raise InputError("launcher=slurm needs the command sbatch: start on the cluster")
    if first_config.photographs_first:
        raise InputError("photographs_first=true makes no sweep: start the runs one by one")
    overwrite = bool(first_config.overwrite)
    parent = writable_folder(str(first_config.sweep), "sweep")
    # An earlier report about the same sweep may be replaced.
    require_replaceable(parent, "sweep", overwrite, own=[PAGE])
    # Settings on the command line that have the same value in all runs.
    shared = set.intersection(*map(set, runs))
    shared_keys = [override.partition("=")[0] for override in shared]
    folders = [parent / run_name(overrides, shared_keys, str(parent)) for overrides in runs]
    if len(set(folders)) < len(runs):
        raise InputError("the sweep has two runs with the same settings: give each value once")
    # Settings of the runs that have not begun, by the texts among their settings.
    new_runs: dict[frozenset[str], tuple[Path, ExperimentSettings]] = {}
    for folder, overrides in zip(folders, runs, strict=True):
        settings = with_label(main.read(overrides, as_typed=False))
        if is_finished(folder) or checkpoints.exists(folder):
            require_same_run(folder, settings, done=True)
        else:
            require_new_run(folder, "sweep", overwrite, resume=True)
            texts = [word for word in overrides if not re.search(r"=[-+.e\d]+$", word)]
            new_runs.setdefault(frozenset(texts), (folder, settings))
    # Numbers are checked now. The files and networks that texts name are checked by loading them.
    # The nodes of a cluster have other devices, so their runs are not loaded here.
    for folder, settings in () if "launcher=slurm" in runs[0] else new_runs.values():
        data, initial = load_inputs(settings)
        Run(settings, data, folder, initial)
    # The names of the folders leave out settings that are the same in all runs.
    excluded = ",".join(map(quoted, shared_keys))
    sys.argv.append(f"hydra.job.config.override_dirname.exclude_keys=[{excluded}]")
    try:
        start()
    finally:
        print(format_sweep(folders), flush=True)
    print(report_of([folder for folder in folders if folder.exists()], parent))
    if not all(map(is_finished, folders)):
        sys.exit(1)


def run_in_sweep(config: DictConfig) -> None:
    """Train one run of a sweep, or resume its training, unless it is finished.

    If the run fails, the reason is written to failed.txt in its folder, and the
    sweep continues with the next run. SystemExit and KeyboardInterrupt stop the
    sweep.
    """
    folder = Path(config.out)
    # Several processes can share a sweep: the one that has the lock trains the run.
    with locked(folder) as has_lock:
        is_over = is_finished(folder)
        doing = "training" if not is_over else "finished before"
        if is_verbose():
            print(f"{doing if has_lock else 'in training elsewhere'}: {folder}", flush=True)
        if has_lock and not is_over:
            (folder / FAILURE).unlink(missing_ok=True)
            _run(config, folder)


def _run(config: DictConfig, folder: Path) -> None:
    """Train (or resume), score and export one run; the reason of a failure goes to failed.txt."""
    job = HydraConfig.get()
    # Hydra's joblib launcher trains several runs at once. Their lines on the terminal
    # then start with the number of the run.
    prefix = f"#{job.job.num} " if "n_jobs" in job.launcher else ""
    with logged_to(folder / LOG, prefix, level=logging.CRITICAL):
        try:
            settings = with_label(read_settings(ExperimentSettings, config))
            settings.train.resume = checkpoints.exists(folder)
            command = format_command(job.overrides.task)
            data, initial = load_inputs(settings)
            run = Run(settings, data, folder, initial, command)
            run.begin()
            run.train()
        except Exception as error:
            sentence = user_message(error)
            reason = sentence or traceback.format_exception_only(error)[-1].strip()
            # `user_message` has a sentence for mistakes of the user. Other errors are faults
            # of the program, which are printed with their traceback.
            console.error("failed: %s", reason, exc_info=None if sentence else error)
            # If the disk is full, the file cannot be written.
            with suppress(OSError):
                atomic_write(folder / FAILURE, f"{reason}\n")


def format_sweep(folders: Sequence[Path]) -> str:
    """Format the results of the training runs of a sweep.

    Without --verbose, the table and the list of unfinished runs are cut off after a few lines.
    """
    finished = [folder for folder in folders if is_finished(folder)]
    lines = [f"{len(finished)} of {len(folders)} runs are finished", ""]
    unfinished = [folder for folder in folders if folder not in finished]
    if finished:
        runs = [summarize(folder) for folder in finished]
        table = format_comparison(runs) if is_verbose() else format_short_comparison(runs)
        # The table and the list of unfinished runs have MAX_TABLE_LINES lines together.
        max_lines = MAX_TABLE_LINES - MAX_UNFINISHED if unfinished else MAX_TABLE_LINES
        lines += shortened(table.splitlines(), max_lines)
    if unfinished:
        lines += shortened([f"{folder}: {state(folder)}" for folder in unfinished], MAX_UNFINISHED)
        lines.append("to go on, give the same command again")
    return "\n".join(lines)
