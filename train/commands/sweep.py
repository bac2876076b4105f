"""Sweeps: `pnb-train --multirun`.

Each run has a folder that is named by its overrides. A finished run is not repeated. Hydra's
launchers start the runs, in this process or in others. The results are read from the folders.
"""

import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path

import hydra
from hydra import initialize_config_module
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from renderer.errors import InputError
from renderer.io.files import write_whole
from train import console
from train.command import quoted, read_settings
from train.commands.experiment import LOG, logged_to
from train.commands.results import require_new_run, require_replaceable
from train.data.load import load_data
from train.report.comparison import format_table
from train.report.report_page import PAGE, report_of
from train.report.summary import is_finished, summarize
from train.runs import checkpoint
from train.runs.run_config import given_command, require_same_run
from train.runs.run_lock import FAILURE, locked, state
from train.runs.run_names import run_name
from train.settings import ExperimentSettings
from train.system.user_errors import one_sentence, writable_folder
from train.training.initial import load_initial
from train.training.run import Run


def sweep(start: Callable[[], None], overrides: Sequence[str]) -> None:
    """Make all runs of a sweep, and print their table.

    Args:
        start: Starts Hydra with the words of the command line.
        overrides: The words of the command line, flags included.

    Raises:
        InputError: Before the first run, if two runs are the same, or a folder holds a run with other settings.
        SystemExit: With status 1, if a run is not finished at the end.
    """
    runs = _expand([word for word in overrides if not word.startswith("-")])
    first = _compose(runs[0])
    parent = writable_folder(str(first.sweep), "sweep")
    # The folder may hold the page that an earlier call wrote about the same sweep.
    require_replaceable(parent, "sweep", bool(first.overwrite), own=[PAGE])
    fixed = [text.partition("=")[0] for text in set.intersection(*map(set, runs))]
    folders = [parent / run_name(words, fixed, str(parent)) for words in runs]
    if len(set(folders)) < len(runs):
        raise InputError("the sweep has a run twice: give each value once")
    for folder, words in zip(folders, runs, strict=True):
        if is_finished(folder) or checkpoint.exists(folder):
            settings = read_settings(ExperimentSettings, _compose(words))
            require_same_run(folder, settings, finished=True)
        else:
            require_new_run(folder, "sweep", bool(first.overwrite), resume=True)
    # `run_name` does not show what all runs share.
    sys.argv.append(f"hydra.job.config.override_dirname.exclude_keys=[{','.join(map(quoted, fixed))}]")
    try:
        start()
    finally:
        print(format_sweep(folders), flush=True)
    print(report_of([folder for folder in folders if folder.exists()], parent))
    if not all(map(is_finished, folders)):
        sys.exit(1)


def _expand(overrides: Sequence[str]) -> list[tuple[str, ...]]:
    """List the overrides of every run, as Hydra's basic sweeper makes them."""
    values: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if key == "run":
            raise InputError("run= names the folder of a single run: name a sweep's with sweep=")
        if key == "launcher" and override.value() == "slurm" and not shutil.which("sbatch"):
            raise InputError("launcher=slurm needs Slurm's sbatch, which is missing: start the sweep on the cluster")
        swept = override.is_sweep_override()
        choices = override.sweep_string_iterator() if swept else [override.get_value_element_as_str()]
        values[key] = [f"{key}={value}" for value in choices]
    return list(product(*values.values()))


def _compose(overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration of one run."""
    with initialize_config_module("conf", version_base="1.3"):
        return hydra.compose("train", list(overrides))


def run_in_sweep(config: DictConfig) -> None:
    """Make a run of a sweep in its folder, or resume it, unless it is finished.

    The reason of a failure is written to failed.txt. SystemExit and KeyboardInterrupt stop the sweep.

    Args:
        config: The configuration of the run. `config.run` is its folder.
    """
    folder = Path(config.run)
    with locked(folder) as ours:
        if is_finished(folder) or not ours:
            print(f"{'finished before' if ours else 'in training elsewhere'}: {folder}", flush=True)
            return
        (folder / FAILURE).unlink(missing_ok=True)
        job = HydraConfig.get()
        # The runs of joblib's launcher print at the same time.
        shares_console = "n_jobs" in job.launcher
        print(f"training: {folder}", flush=True)
        prefix = f"#{job.job.num} " if shares_console else ""
        with logged_to(folder / LOG, prefix):
            try:
                settings = read_settings(ExperimentSettings, config)
                settings.train.resume = checkpoint.exists(folder)
                command = given_command([*map(_unescaped, job.overrides.task)])
                initial = load_initial(settings)
                run = Run(settings, load_data(settings, initial.size if initial else None), folder, initial, command)
                run.load()
                run.fit()
                run.score()
                run.export()
            except Exception as error:
                sentence = one_sentence(error)
                reason = sentence or traceback.format_exception_only(error)[-1].strip()
                console.error("failed: %s", reason, exc_info=None if sentence else error)
                with suppress(OSError):  # On a full disk, only the console shows the reason.
                    write_whole(folder / FAILURE, f"{reason}\n")


def _unescaped(override: str) -> str:
    r"""Quote a text that Hydra's sweeper escapes: path='a b' instead of path=a\ b."""
    value = OverridesParser.create().parse_override(override).value()
    if "\\" in override and isinstance(value, str):
        return f"{override.partition('=')[0]}={quoted(value)}"
    return override


def format_sweep(folders: Sequence[Path]) -> str:
    """The table of the finished runs, means over several seeds, and the state of the other runs."""
    finished = [summarize(folder) for folder in folders if is_finished(folder)]
    parts = [f"{len(finished)} of {len(folders)} runs are finished"]
    if finished:
        parts.append(format_table(finished))
    if unfinished := [f"{folder}: {state(folder)}" for folder in folders if not is_finished(folder)]:
        parts += [*unfinished, "to go on, give the same command again"]
    return "\n" + "\n\n".join(parts)
