"""pnb-train: train a network, and baselines to compare it with, or all runs of a sweep.

The baselines have the same settings, except for the kind of renders (augment.mode).
The setting `compare` names their kinds. Each baseline is trained in a subfolder of
the folder of the main training run.

A sweep is several training runs that one command, `pnb-train --multirun`, starts. The command line
has several values for some settings, such as seed=0,1. There is a training run for each combination
of values. Its folder is named after the settings that differ between the runs. A finished run is
not repeated. Hydra's launchers start the runs in this process or in others. The results are read
from the folders.
"""

import logging
import os
import re
import shlex
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from augment import distributed
from renderer.errors import InputError, keyed
from renderer.io.files import atomic_write
from renderer.settings import field_types
from train import checkpoints, console
from train.__main__ import main, run_name
from train.cli import quoted, read_settings
from train.device import Interrupted, broadcast, process_group
from train.results.compare import format_comparison, format_short_comparison
from train.results.overwrite import remove_run, require_new_run, require_replaceable
from train.results.page import PAGE, report_of
from train.results.store import is_finished, summarize
from train.run_config import CONFIG, format_command, require_same_run, resume_config
from train.run_folder import FAILURE, ORIGINAL, locked, sole_writer, state, writable_folder
from train.settings import PHOTOGRAPHS_FIRST, ExperimentSettings, NetworkSettings
from train.system import NO_ROOM, is_verbose, program, shortened, user_message
from train.training.inputs import load_inputs, with_label
from train.training.run import Run

# Name of the log file in the folder of a training run.
LOG = "train.log"
# The first training on photographs takes these settings from the main training.
SHARED = (*field_types(NetworkSettings), "unlabeled", "seed", "overwrite", "data")
SHARED_IN_TRAIN = (
    *("precision", "device", "threads", "deterministic", "checkpoint_every", "resume", "cache"),
)
# Largest number of lines of the table of finished runs, if --verbose is not set.
MAX_TABLE_LINES = 10
# Largest number of unfinished runs that are listed, if --verbose is not set.
MAX_UNFINISHED = 3


def train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Train a network and its baselines, in this process or in each process of torchrun."""
    command = format_command(overrides)
    with process_group():
        # The default name of the folder has the time, which differs between processes. All
        # processes take the name of the first one.
        folder = Path(broadcast(str(config.out))).absolute()
        config.out = str(folder)
        # A resumed run keeps its recorded settings, except for single values that the
        # overrides change. A choice of a whole file, or of photographs_first, prevents this.
        keys = [override.partition("=")[0] for override in overrides]
        is_whole = config.photographs_first or any(key in main.groups or "@" in key for key in keys)
        if config.train.resume and not is_whole:
            config, command = resume_config(config, overrides)
        settings = with_label(read_settings(ExperimentSettings, config))
        if settings.photographs_first:
            settings = _train_on_photographs(settings, command)
        _train_in(folder, settings, command, folder)


def _train_on_photographs(settings: ExperimentSettings, command: str) -> ExperimentSettings:
    """Train on photographs first, as the setting `photographs_first` asks.

    If this first training is already finished, it is not repeated. The returned settings are those
    of the main training, which starts from the network of the first.
    """
    folder = Path(settings.out)
    first = folder / PHOTOGRAPHS_FIRST
    values = asdict(settings)
    changes = {name: values[name] for name in SHARED} | {"out": str(first)}
    changes["train"] = {name: values["train"][name] for name in SHARED_IN_TRAIN}
    config = main.compose(["experiment=photographs"])
    on_photographs = read_settings(ExperimentSettings, config, changes)
    if settings.train.resume and is_finished(first):
        require_same_run(first, on_photographs, done=True)
    else:
        if settings.overwrite and not settings.train.resume and distributed.rank() == 0:
            remove_run(folder)
        _train_in(first, on_photographs, command, folder)
    # The file of the first network has its weights, classes and normalization, and names the code
    # that the user has named for it.
    cleared: dict[str, Any] = dict.fromkeys(("weights", "classes", "normalization", "prompt"))
    return replace(settings, photographs_first=False, trust=True, network=str(first), **cleared)


def _train_in(folder: Path, settings: ExperimentSettings, command: str, out: Path) -> None:
    """Check that the folders can be written to, and train a network and its baselines.

    If the training is interrupted, the command that resumes it is printed. `out` is the folder that
    the user has given.
    """
    # The baselines come first. Each has a sub-folder with the name of its kind of renders.
    settings_of_runs = {}
    for mode in settings.compare:
        with keyed("compare"):
            augment = replace(settings.augment, mode=mode)
            settings_of_runs[folder / mode] = replace(settings, compare=[], augment=augment)
    settings_of_runs[folder] = settings
    for path, run_settings in settings_of_runs.items():
        if settings.train.resume and (path / CONFIG).is_file():
            require_same_run(path, run_settings)
        require_new_run(path, "out", settings.overwrite, settings.train.resume)
    with ExitStack() as first_process:
        if distributed.rank() == 0:
            first_process.enter_context(logged_to(writable_folder(folder, "out") / LOG))
            first_process.enter_context(sole_writer(*settings_of_runs))
        try:
            data, initial = load_inputs(next(iter(settings_of_runs.values())))
            # All mistakes are reported before the first run is trained.
            runs = [Run(of, data, initial, path, command) for path, of in settings_of_runs.items()]
            # The main run is the last one. It begins first, because it also removes the earlier
            # runs in the subfolders of its folder, to which the baselines write.
            for run in reversed(runs):
                run.begin()
            if initial and folder == out / PHOTOGRAPHS_FIRST and distributed.rank() == 0:
                state = {"architecture": initial.architecture, "model": initial.weights}
                checkpoints.save(folder / ORIGINAL, state)
            for run in runs:
                console.debug("\n== %s", run.folder)
                run.train()
            if distributed.rank() == 0:
                summaries = [summarize(path) for path in settings_of_runs]
                console.debug("\n%s\n", format_comparison(summaries))
                console.info("%s\n", format_short_comparison(summaries))
                console.info("%s", report_of([folder], folder))
        except (SystemExit, KeyboardInterrupt, OSError) as stop:
            if isinstance(stop, OSError) and stop.errno not in NO_ROOM:
                raise
            cause = f"ended by {stop.signal}; " if isinstance(stop, Interrupted) else ""
            advice = "no checkpoint yet: start again"
            # The first training on photographs may have ended before the main one.
            folders = [*settings_of_runs, folder / PHOTOGRAPHS_FIRST]
            # A folder with best.pt and no checkpoint is refused, unless the run is resumed.
            if any(checkpoints.exists(path) or checkpoints.selected_file(path) for path in folders):
                # Until the main training begins, its settings are in the whole command alone.
                is_recorded = folder == out and (out / CONFIG).is_file()
                words = program("train", as_called=True) if is_recorded else shlex.split(command)
                advice = f"to go on: {shlex.join([*words, f'out={out}', 'train.resume=true'])}"
            console.info("%s%s", cause, advice)
            raise


@contextmanager
def logged_to(path: Path, prefix: str = "", level: int = logging.INFO) -> Iterator[None]:
    """Write log messages to a file and to the terminal, until the `with` block ends.

    The file gets all messages. The terminal gets messages of at least `level`,
    or with --verbose all messages.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # If the disk is full, the log file lacks lines. The training then raises an error of its own,
    # which is enough for the user.
    logging.raiseExceptions = False
    # Messages of matplotlib about its font cache do not concern the user.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    root = logging.getLogger()
    level_before = root.level
    root.setLevel(logging.INFO)
    console.setLevel(logging.DEBUG)
    file = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    terminal = logging.StreamHandler(sys.stdout)
    terminal.setFormatter(logging.Formatter(f"{prefix}%(message)s"))
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


def sweep(start: Callable[[], None], runs: Sequence[Sequence[str]], first: DictConfig) -> None:
    """Train all runs of a sweep, print a table of their results, and write a report.

    Wrong settings, and folders of other runs, are found before any training. The exit status is 1
    if a run is not finished.
    """
    # torchrun sets this variable in the processes that it starts.
    if "TORCHELASTIC_RUN_ID" in os.environ:
        raise InputError("torchrun cannot start a sweep: start it with pnb-train --multirun")
    if any(override.startswith(("out=", "hydra.sweep.")) for override in runs[0]):
        raise InputError("out= and hydra.sweep name no folder of a sweep: name it with sweep=")
    if "launcher=slurm" in runs[0] and not shutil.which("sbatch"):
        raise InputError("launcher=slurm needs the command sbatch: start on the cluster")
    if first.photographs_first:
        raise InputError("photographs_first=true makes no sweep: start the runs one by one")
    if first.compare:
        raise InputError(f"compare={first.compare} makes no sweep: give augment=none,random")
    parent = writable_folder(str(first.sweep), "sweep")
    # An earlier report about the same sweep may be replaced.
    require_replaceable(parent, "sweep", first.overwrite, own=[PAGE])
    shared_keys = [word.partition("=")[0] for word in set.intersection(*map(set, runs))]
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
            require_new_run(folder, "sweep", settings.overwrite, resume=True)
            texts = [word for word in overrides if not re.search(r"=[-+.e\d]+$", word)]
            new_runs.setdefault(frozenset(texts), (folder, settings))
    # Numbers are checked now. The files and networks that texts name are checked by loading them.
    # The nodes of a cluster have other devices, so their runs are not loaded here.
    for folder, settings in () if "launcher=slurm" in runs[0] else new_runs.values():
        Run(settings, *load_inputs(settings), folder)
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
            run = Run(settings, *load_inputs(settings), folder, format_command(job.overrides.task))
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
