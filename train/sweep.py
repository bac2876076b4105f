"""Sweeps, `python -m train --multirun`: a folder per cell, named by its overrides; what is done is not done again.

Hydra's launchers run the cells, in this process or in others; what became of each is read from its folder.
"""

import atexit
import functools
import hashlib
import importlib.metadata
import os
import re
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError
from train.command_line.configuration import read_settings
from train.command_line.entry_points import one_sentence, one_sentence_errors
from train.report.page import report_of
from train.report.summary import format_spread, format_table, is_finished, summarize
from train.run import load_data, run, write_images
from train.run_folder import checkpoint
from train.run_folder.continuation import CIRCUMSTANCES, differing_settings, require_same_inputs
from train.run_folder.files import FAILURE, locked, state
from train.run_folder.logs import console
from train.settings import ExperimentSettings

LONGEST_VALUE, LONGEST_NAME = 24, 200  # characters in a folder's name; file systems take 255
NEEDS = {  # launcher: its extra and the package in it
    "joblib": ("joblib", "hydra-joblib-launcher"),
    "slurm": ("slurm", "hydra-submitit-launcher"),
    "submitit_local": ("slurm", "hydra-submitit-launcher"),
}


def cell_name(overrides: Sequence[str]) -> str:
    """The name of a cell's folder, in alphabetical order: `augment-none+seed-0` for seed=0 augment=none.

    Overrides that only say where and how it runs are left out. What is long is cut, and what a file system or Hydra's
    command line might not take is replaced; both then end in @ and a hash of what was there, so that different cells
    have different names, also where capitals do not count.
    """
    pairs = sorted(override.partition("=")[::2] for override in overrides)
    name = "+".join(f"{_safe(key)}-{_safe(value)}" for key, value in pairs if key not in CIRCUMSTANCES) or "defaults"
    return name if len(name) <= LONGEST_NAME else name[:LONGEST_NAME] + _hash(name)


def _safe(text: str) -> str:
    safe = re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII)
    return text if text == safe.lower() and len(text) <= LONGEST_VALUE else safe[-LONGEST_VALUE:] + _hash(text)


def _hash(text: str) -> str:
    return f"@{hashlib.sha256(text.encode()).hexdigest()[:8]}"


OmegaConf.register_new_resolver("cell_name", cell_name, replace=True)  # launchers hand it on to their processes


def check_launcher(arguments: Sequence[str]) -> None:
    """InputError where the command line chooses a launcher whose extra is not installed, or Slurm where it is not.

    Nor does torchrun start a sweep: its processes train one network together.
    """
    if {"--multirun", "-m"} & set(arguments) and "TORCHELASTIC_RUN_ID" in os.environ:
        raise InputError("torchrun trains one run in several processes: start a sweep with python -m train --multirun")
    chosen = [argument.removeprefix("launcher=") for argument in arguments if argument.startswith("launcher=")]
    for launcher in NEEDS.keys() & set(chosen):
        extra, package = NEEDS[launcher]
        try:
            importlib.metadata.distribution(package)
        except importlib.metadata.PackageNotFoundError as error:
            raise InputError(f'launcher={launcher} needs {package}: pip install ".[{extra}]"') from error
        if launcher == "slurm" and not shutil.which("sbatch"):
            raise InputError("launcher=slurm needs Slurm's sbatch, which is not here: start the sweep on the cluster")


def run_cell(config: DictConfig, folder: Path) -> None:
    """Train a cell in its folder, or go on with it, unless it is finished; why it failed goes to its failed.txt.

    What stops the process (SystemExit, KeyboardInterrupt) stops the sweep.
    """
    with locked(folder) as ours:
        if is_finished(folder) or not ours:
            print(f"{'finished before' if ours else 'in training elsewhere'}: {folder}", flush=True)
            return
        (folder / FAILURE).unlink(missing_ok=True)
        try:
            _train(config, folder)
        except Exception as error:
            with suppress(OSError):  # where there is no room for it, the console alone says it
                reason = _reason(error) + "\n"
                (folder / FAILURE).write_text(reason, encoding="utf-8", errors="backslashreplace")


def _train(config: DictConfig, folder: Path) -> None:
    OmegaConf.resolve(config)
    config.train.resume = checkpoint.exists(folder)
    settings = read_settings(ExperimentSettings, config)
    data = load_data(settings)
    write_images(settings, data.size)
    run(settings, data, folder)


def _reason(error: Exception) -> str:
    """One line, which is logged, with the traceback of what is no fault of the user's."""
    sentence = one_sentence(error)
    reason = sentence or traceback.format_exception_only(error)[-1].strip()
    console.error("failed: %s", reason, exc_info=error if sentence is None else None)
    return reason


def _one_outcome(callback: Callable[..., Any]) -> Callable[..., Any]:
    """Of a callback, whose exceptions Hydra turns into warnings, exit status 0 with them: end the process instead."""

    @functools.wraps(callback)
    def wrapped(*arguments: Any, **keywords: Any) -> Any:
        try:
            return one_sentence_errors(callback)(*arguments, **keywords)
        except Exception:
            traceback.print_exc()
            sys.exit(1)

    return wrapped


class SweepReport(Callback):
    """Checks a sweep before its first cell, and ends it with a table; exit status 1 where a cell is not finished."""

    def __init__(self) -> None:
        self.folders: list[Path] = []
        self._handler: Any = signal.SIG_DFL

    @_one_outcome
    def on_multirun_start(self, config: DictConfig, **_: object) -> None:
        """One sentence and exit status 2 rather than two cells in a folder, or a cell where one has other settings."""
        try:
            cells = _compose_cells(config)
        except HydraException:  # Hydra's sweeper composes them again, and says what is wrong
            return
        self.folders = [folder for folder, _ in cells]
        for folder, cell in cells:
            if self.folders.count(folder) > 1:
                raise InputError(f"the sweep asks twice for {folder}: give each value once")
            _check_same_settings(folder, cell)
        atexit.register(self._print)  # where the launcher raises, or a signal stops the sweep:
        # an exception, so that launchers end their processes
        self._handler = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))

    @_one_outcome
    def on_multirun_end(self, config: DictConfig, **_: object) -> None:
        print(report_of([folder for folder in self.folders if folder.exists()], Path(config.hydra.sweep.dir)))
        atexit.unregister(self._print)
        self._print()
        signal.signal(signal.SIGTERM, self._handler)
        if not all(map(is_finished, self.folders)):
            sys.exit(1)

    def _print(self) -> None:
        print(format_sweep(self.folders), flush=True)


def _compose_cells(sweep: DictConfig) -> list[tuple[Path, DictConfig]]:
    """Folder and configuration of every cell that Hydra's basic sweeper makes of a --multirun's configuration."""
    loader = GlobalHydra.instance().config_loader()
    params = [f"{key}={value}" for key, value in (sweep.hydra.sweeper.params or {}).items()]
    overrides = OverridesParser.create(loader).parse_overrides([*params, *sweep.hydra.overrides.task])
    if any(override.key_or_group == "run" for override in overrides):
        raise InputError("run= names the folder of a single run: name a sweep's with sweep=")
    (grid,) = BasicSweeper.split_arguments(overrides, max_batch_size=None)
    cells = [loader.load_sweep_config(sweep, cell) for cell in grid]
    return [(Path(cell.hydra.sweep.dir, cell.hydra.sweep.subdir), cell) for cell in cells]


def _check_same_settings(folder: Path, cell: DictConfig) -> None:
    """InputError where the folder has a run, finished or begun, with other settings than the cell's."""
    if not (is_finished(folder) or checkpoint.exists(folder)):
        return
    own = OmegaConf.masked_copy(cell, [item.name for item in fields(ExperimentSettings)])
    own = OmegaConf.structured(read_settings(ExperimentSettings, own))
    for key, found, asked in differing_settings(folder, own):
        raise InputError(
            f"{folder} has {key}={found}, and {asked} is asked for: give another folder with sweep=, or remove this one"
        )
    require_same_inputs(folder, own)


def format_sweep(folders: Sequence[Path]) -> str:
    """The finished cells' table, means over seeds where there are several, and what became of the others."""
    finished = [summarize(folder) for folder in folders if is_finished(folder)]
    parts = [f"{len(finished)} of {len(folders)} cells are finished"]
    if finished:
        parts += filter(None, [format_table(finished), format_spread(finished)])
    parts += [f"{folder}: {state(folder)}" for folder in folders if not is_finished(folder)]
    return "\n" + "\n\n".join(parts)
