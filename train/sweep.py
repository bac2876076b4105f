"""Sweeps, `pnb-train --multirun`: a folder per run, named by its overrides; finished runs are not repeated.

Hydra's launchers start the runs, in this process or in others; their results are read from their folders.
"""

import hashlib
import re
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from renderer.errors import InputError
from renderer.io.files import write_whole
from train import checkpoint, console
from train.errors import one_sentence, writable_folder
from train.initial import load_initial
from train.load_data import load_data
from train.report.compare import format_table
from train.report.page import PAGE, report_of
from train.report.summary import is_finished, summarize
from train.results import require_new_run, require_replaceable
from train.run import Run
from train.run_folder import CIRCUMSTANCES, FAILURE, locked, require_same_run, state
from train.settings import ExperimentSettings, compose, given_command, quoted, read_settings

LONGEST_PART, LONGEST_NAME = 48, 200  # characters in a folder's name; file systems take 255
HYDRAS_OWN = re.compile(r"\+*hydra[./]")  # overrides that do not concern the run


def run_name(overrides: Sequence[str], fixed: Collection[str] = (), parent: str = "") -> str:
    """The name of a run's folder: `augment-none+seed-0@7d0a3f52` for seed=0 augment=none, in alphabetical order, and a
    hash of its overrides, but of those that only say where and how it runs.

    fixed: keys that all runs of the sweep share, which are not shown. parent: the sweep's folder, where a run keeps the
    name that it has. Characters that a file system or Hydra's command line might refuse are replaced.
    """
    own = (override.partition("=")[::2] for override in overrides if not HYDRAS_OWN.match(override))
    pairs = sorted((key, value) for key, value in own if key not in CIRCUMSTANCES)
    ending = f"@{hashlib.sha256(repr(pairs).encode(errors='surrogatepass')).hexdigest()[:8]}"
    if parent and (known := next(Path(parent).glob(f"*{ending}"), None)):
        return known.name
    texts = (re.sub(r"[^\w.-]+", "_", f"{key}-{value}", flags=re.ASCII) for key, value in pairs if key not in fixed)
    return ("+".join(text[:LONGEST_PART] for text in texts) or "run")[:LONGEST_NAME] + ending


OmegaConf.register_new_resolver("run_name", run_name, replace=True)  # Hydra hands it to the launchers' processes


def sweep(start: Callable[[], None], overrides: Sequence[str]) -> None:
    """Make all runs with `start`, Hydra's main function, and print their table; exit status 1 if any is not finished.

    InputError before the first run where two runs are the same, or a folder holds a run with other settings.
    """
    runs = _runs(overrides)
    first = compose("train", runs[0])
    parent = writable_folder(str(first.sweep), "sweep")
    require_replaceable(parent, "sweep", bool(first.overwrite), own=[PAGE])  # the page of the sweep so far
    fixed = [text.partition("=")[0] for text in set.intersection(*map(set, runs))]
    folders = [parent / run_name(words, fixed, str(parent)) for words in runs]
    if len(set(folders)) < len(runs):
        raise InputError("the sweep has a run twice: give each value once")
    for folder, words in zip(folders, runs, strict=True):
        if is_finished(folder) or checkpoint.exists(folder):
            settings = read_settings(ExperimentSettings, compose("train", words))
            require_same_run(folder, settings, finished=True)
        else:
            require_new_run(folder, "sweep", bool(first.overwrite), resume=True)
    handler = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # so that launchers end theirs
    sys.argv.append(f"hydra.job.config.override_dirname.exclude_keys=[{','.join(map(quoted, fixed))}]")
    try:
        start()
    finally:
        signal.signal(signal.SIGTERM, handler)
        print(format_sweep(folders), flush=True)
    print(report_of([folder for folder in folders if folder.exists()], parent))
    if not all(map(is_finished, folders)):
        sys.exit(1)


def _runs(overrides: Sequence[str]) -> list[tuple[str, ...]]:
    """The overrides of every run, as Hydra's basic sweeper makes them."""
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


def run_in_sweep(config: DictConfig, folder: Path) -> None:
    """Make a run in its folder, or resume it, unless it is finished; the reason of a failure goes to failed.txt.

    SystemExit and KeyboardInterrupt stop the sweep.
    """
    with locked(folder) as ours:
        if is_finished(folder) or not ours:
            print(f"{'finished before' if ours else 'in training elsewhere'}: {folder}", flush=True)
            return
        (folder / FAILURE).unlink(missing_ok=True)
        try:
            settings = read_settings(ExperimentSettings, config)
            settings.train.resume = checkpoint.exists(folder)
            command = given_command([*map(_unescaped, HydraConfig.get().overrides.task)])
            initial = load_initial(settings)
            run = Run(settings, load_data(settings, initial), folder, initial, command)
            run.load()
            run.fit()
            run.score()
            run.export()
        except Exception as error:
            sentence = one_sentence(error)
            reason = sentence or traceback.format_exception_only(error)[-1].strip()
            console.error("failed: %s", reason, exc_info=None if sentence else error)
            with suppress(OSError):  # on a full disk only the console has it
                write_whole(folder / FAILURE, f"{reason}\n")


def _unescaped(override: str) -> str:
    r"""An override as Hydra's sweeper writes it, but with a text in quotes: path='a b' rather than path=a\ b."""
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
