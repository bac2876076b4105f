"""pnb-train: train a network, and baselines to compare it with.

The baselines have the same settings, except for the kind of renders (augment.mode).
The setting `compare` names their kinds. Each baseline is trained in a subfolder of
the folder of the main training run.
"""

import logging
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from augment import distributed
from renderer.errors import keyed
from renderer.settings import field_types
from train import checkpoints, console
from train.__main__ import main
from train.cli import read_settings
from train.device import Interrupted, broadcast, process_group
from train.results.compare import format_comparison, format_short_comparison
from train.results.overwrite import remove_run, require_new_run
from train.results.page import report_of
from train.results.store import is_finished, summarize
from train.run_config import CONFIG, format_command, require_same_run, resume_config
from train.run_folder import sole_writer, writable_folder
from train.settings import PHOTOGRAPHS_FIRST, ExperimentSettings, NetworkSettings
from train.system import is_verbose, program
from train.training.inputs import load_inputs, with_label
from train.training.run import Run

# An override such as experiment=photographs chooses a file of settings. These keys
# are the folders of such files in conf/.
CHOICES = ("experiment", "augment", "data", "launcher")
# Name of the log file in the folder of a training run.
LOG = "train.log"
# The first training on photographs takes these settings from the main training.
SHARED = (*field_types(NetworkSettings), "unlabeled", "seed", "overwrite", "data")
SHARED_IN_TRAIN = (
    *("precision", "device", "threads", "deterministic", "checkpoint_every", "resume", "cache"),
)


def train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Train a network and its baselines, in this process or in each process of torchrun."""
    command = format_command(overrides)
    with process_group():
        # The default name of the folder has the time, which differs between processes. All
        # processes take the name of the first one.
        folder = Path(broadcast(str(config.out))).absolute()
        config.out = str(folder)
        # A resumed run keeps its recorded settings, except for single values that the
        # overrides change. An override that chooses a whole file prevents this.
        keys = [override.partition("=")[0] for override in overrides]
        if config.train.resume and not any(key in CHOICES or "@" in key for key in keys):
            config, command = resume_config(config, overrides)
        settings = with_label(read_settings(ExperimentSettings, config))
        if settings.photographs_first:
            settings = _train_on_photographs(settings, folder, command)
        again = (f"out={folder}", "train.resume=true")
        _train_in(folder, settings, command, [*program("train", as_called=True), *again])


def _train_on_photographs(
    settings: ExperimentSettings, folder: Path, command: str
) -> ExperimentSettings:
    """Train on photographs first, as the setting `photographs_first` asks.

    If this first training is already finished, it is not repeated. The returned settings are those
    of the main training, which starts from the network of the first.
    """
    first = folder / PHOTOGRAPHS_FIRST
    values = asdict(settings)
    changes = {name: values[name] for name in SHARED}
    changes["out"] = str(first)
    changes["train"] = {name: values["train"][name] for name in SHARED_IN_TRAIN}
    config = OmegaConf.merge(main.compose(["experiment=photographs"]), changes)
    on_photographs = read_settings(ExperimentSettings, cast(DictConfig, config))
    if settings.train.resume and is_finished(first):
        require_same_run(first, on_photographs, done=True)
    else:
        if settings.overwrite and not settings.train.resume and distributed.rank() == 0:
            remove_run(folder)
        # The folder of the main training has no recorded settings yet. To resume, the
        # user therefore has to give the whole command again.
        again = (f"out={folder}", "train.resume=true")
        _train_in(first, on_photographs, command, [*shlex.split(command), *again])
    # The file of the first network has its weights, classes and normalization, and names the code
    # that the user has named for it.
    cleared: dict[str, Any] = dict.fromkeys(("weights", "classes", "normalization"))
    return replace(settings, photographs_first=False, trust=True, network=str(first), **cleared)


def _train_in(folder: Path, settings: ExperimentSettings, command: str, resume: list[str]) -> None:
    """Check that the folders can be written to, and train a network and its baselines.

    If the training is interrupted, the command that resumes it is printed: `resume`.
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
            first_process.enter_context(sole_writer("out", *settings_of_runs))
        try:
            data, initial = load_inputs(next(iter(settings_of_runs.values())))
            # All mistakes are reported before the first run is trained.
            runs = [Run(of, data, path, initial, command) for path, of in settings_of_runs.items()]
            # The main run is the last one. It begins first, because it also removes the earlier
            # runs in the subfolders of its folder, to which the baselines write.
            for run in reversed(runs):
                run.begin()
            for run in runs:
                console.debug("\n== %s", run.folder)
                run.train()
            if distributed.rank() == 0:
                summaries = [summarize(path) for path in settings_of_runs]
                console.debug("\n%s\n", format_comparison(summaries))
                console.info("%s\n", format_short_comparison(summaries))
                console.info("%s", report_of([folder], folder))
        except (Interrupted, KeyboardInterrupt) as stop:
            cause = f"ended by {stop.signal}; " if isinstance(stop, Interrupted) else ""
            advice = "no checkpoint yet: start again"
            # The first training on photographs may have ended before the main one.
            if any(map(checkpoints.exists, [*settings_of_runs, folder / PHOTOGRAPHS_FIRST])):
                advice = f"to go on: {shlex.join(resume)}"
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
