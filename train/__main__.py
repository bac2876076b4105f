"""`python -m train`: train an arm, score it, and print the table. See conf/train.yaml for every setting."""

import os
import re
import shlex
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from train import cli  # isort: skip (first, since the others take seconds to import)

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from augment import utils
from renderer.errors import InputError
from train import console
from train.data import DataSet
from train.errors import writable_file, writable_folder
from train.report.page import report_of
from train.report.summary import format_table, summarize
from train.run import load_data, prepare, write_images
from train.run_folder import sole_writer
from train.runtime import Interrupted, broadcast, first_process_first, process_group
from train.settings import ExperimentSettings, as_override, compose, given_command, keyed, quoted, read_settings
from train.sweep import run_in_sweep, sweep

NAMED_MODEL = re.compile(r"^model=(?!\{)")  # short for model.name=
LOG = "train.log"
SWEEP_FLAGS = {"--multirun", "-m"}


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="train")
def main(config: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    config.run = str(folder)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        run_in_sweep(config, folder)
        return
    with cli.handled_errors():  # here, too, or Hydra adds a line
        run_arms(read_settings(ExperimentSettings, config), folder)


def run_arms(settings: ExperimentSettings, folder: Path) -> None:
    """Train the arms to compare with and the arm itself, and print their table."""
    arms = {}
    for arm in settings.compare:
        with keyed("compare"):
            arms[folder / arm] = replace(settings, augment=replace(settings.augment, arm=arm))
    arms[folder] = settings
    data = load_data(settings)
    with sole_writer("run", *arms) if utils.rank() == 0 else nullcontext():
        with first_process_first():
            if utils.rank() == 0:
                write_images(settings, data.size)
        _train_arms(arms, data, folder)


def _train_arms(arms: Mapping[Path, ExperimentSettings], data: DataSet, folder: Path) -> None:
    runs = {path: prepare(settings, data, path) for path, settings in arms.items()}  # all first, to meet every mistake
    for path, train_and_score in runs.items():
        console.info("\n== augment=%s%s", arms[path].augment.arm, "" if path == folder else ", for comparison")
        try:
            train_and_score()
        except Interrupted as stop:
            console.info("ended by %s; to go on: %s", stop.signal, resume_command(folder))
            raise
    if utils.rank() == 0:
        console.info("\n%s", format_table([summarize(path) for path in arms]))
        console.info("%s", report_of([folder], folder))


def resume_command(folder: Path) -> str:
    """The command that resumes this run."""
    return f"{given_command()} {shlex.join([f'run={folder}', 'train.resume=true'])}"


def start() -> None:
    """Run `main` in this process, or in each that torchrun starts; all take the first one's folder."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # or Hydra prints its errors itself, in several lines
    with cli.handled_errors(), process_group():
        arguments = [NAMED_MODEL.sub("model.name=", argument) for argument in sys.argv[1:]]
        sys.argv[1:] = arguments = [as_override(argument) for argument in arguments]
        flags = {argument for argument in arguments if argument.startswith("-")}
        overrides = [argument for argument in arguments if argument not in flags]
        if flags and "TORCHELASTIC_RUN_ID" in os.environ:
            raise InputError(
                "torchrun trains one run in several processes: start a sweep with python -m train --multirun"
            )
        if flags & SWEEP_FLAGS:
            sweep(main, overrides)
            return
        if not flags:
            if utils.rank() > 0:
                console.setLevel("WARNING")
            folder = broadcast(_run_folder(overrides) if utils.rank() == 0 else "")
            sys.argv.append(f"run={quoted(folder)}")
        main()


def _run_folder(overrides: list[str]) -> str:
    """The folder of the run, which is still to be made; InputError where settings are wrong or it cannot be written."""
    run = read_settings(ExperimentSettings, compose("train", overrides)).run
    writable_file(writable_folder(run, "run") / LOG, "run")
    return run


if __name__ == "__main__":
    start()
