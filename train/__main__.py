"""`python -m train`: train an arm, score it, and print the table. See conf/train.yaml for every setting."""

import re
import shlex
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import train.command_line.entry_points as command
from augment import utils
from train.command_line.configuration import read_settings
from train.command_line.overrides import quoted
from train.data import DataSet
from train.report.page import report_of
from train.report.summary import format_table, summarize
from train.run import load_data, prepare, write_images
from train.run_folder.files import sole_writer
from train.run_folder.logs import console
from train.runtime import Interrupted, broadcast, first_process_first, process_group
from train.settings import ExperimentSettings
from train.sweep import check_launcher, run_cell

NAMED_MODEL = re.compile(r"^model=(?!\{)")  # by its name alone


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="train")
@command.one_sentence_errors
def main(config: DictConfig) -> None:
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    if utils.rank() == 0:
        broadcast(str(folder))
    config.run = str(folder)
    if hydra_config.mode == RunMode.MULTIRUN:
        run_cell(config, folder)
    else:
        run_arms(config, folder)


def run_arms(config: DictConfig, folder: Path) -> None:
    """Train the arms to compare with and the arm itself, and print their table."""
    OmegaConf.resolve(config)  # before any copy is made, since a copy would read the clock again
    data = load_data(read_settings(ExperimentSettings, config))
    choices = {folder / str(arm): {"augment": {"arm": arm}} for arm in config.compare}
    configs = {path: cast(DictConfig, OmegaConf.merge(config, choice)) for path, choice in choices.items()}
    arms = {path: read_settings(ExperimentSettings, arm) for path, arm in (configs | {folder: config}).items()}
    with sole_writer("run", *arms) if utils.rank() == 0 else nullcontext():
        with first_process_first():
            if utils.rank() == 0:
                write_images(arms[folder], data.size)
        _train_arms(arms, data, folder)


def _train_arms(arms: Mapping[Path, ExperimentSettings], data: DataSet, folder: Path) -> None:
    runs = {path: prepare(arm, data, path) for path, arm in arms.items()}  # all first: a mistake in any shows at once
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
    """The command that goes on with this run."""
    start = f"torchrun --nproc_per_node={utils.world_size()} -m train" if utils.world_size() > 1 else "python -m train"
    overrides = [
        override for override in HydraConfig.get().overrides.task if not override.startswith(("run=", "train.resume="))
    ]
    return shlex.join([*start.split(), *overrides, f"run={folder}", "train.resume=true"])


def start() -> None:
    """`main` in this process, or in each that torchrun starts; all take the first one's folder, and it alone writes."""
    command.one_sentence_errors(check_launcher)(sys.argv[1:])
    with process_group():
        if utils.rank() > 0:
            console.setLevel("WARNING")
            sys.argv.append(f"run={quoted(broadcast())}")
        sys.argv[1:] = [NAMED_MODEL.sub("model.name=", argument) for argument in sys.argv[1:]]
        command.run_command(main, "train")


if __name__ == "__main__":
    start()
